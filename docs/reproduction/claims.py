"""A claim of the paper with what was measured, and the page made of them."""

from dataclasses import dataclass, field

OUT, ONLY, NOT = "reproduced", "reproduced only with", "not reproduced"
VERDICTS = (OUT, ONLY, NOT)


@dataclass(frozen=True)
class Claim:
    """A claim, the numbers, and whether it holds of the case as shipped, or of a variant.

    `variant` names an experiment or says the settings; it counts only where the case as shipped
    fails and `with_variant`, measured too, is true.
    """

    quote: str
    measured: str
    holds: bool
    variant: str = ""
    with_variant: bool = False

    @property
    def verdict(self) -> str:
        """One of the three, computed."""
        if self.holds:
            return OUT
        return f"{ONLY} {self.variant}" if self.with_variant else NOT


@dataclass(frozen=True)
class Section:
    """A case on the page: words before, pictures (file, caption), claims and words after."""

    title: str
    words: str
    claims: list[Claim]
    pictures: list[tuple[str, str]] = field(default_factory=list)
    after: str = ""


def render(section: Section) -> str:
    """Markdown."""
    parts = [f"## {section.title}\n", section.words.strip() + "\n"]
    for file, caption in section.pictures:
        parts.append(f"![{caption}](../pictures/reproduction/{file})\n\n*{caption}*\n")
    parts.append("| the paper says | measured | verdict |\n| --- | --- | --- |")
    parts += [f"| “{c.quote}” | {c.measured} | **{c.verdict}** |" for c in section.claims]
    return "\n".join(parts) + "\n" + (f"\n{section.after}\n" if section.after else "")


def counted(sections: list[Section]) -> str:
    """How many claims have which verdict."""
    claims = [claim for section in sections for claim in section.claims]
    only = sum(claim.verdict.startswith(ONLY) for claim in claims)
    out = sum(claim.verdict == OUT for claim in claims)
    return (
        f"Of {len(claims)} claims {out} are reproduced, {only} only with what is named there, "
        f"and {len(claims) - out - only} are not reproduced."
    )
