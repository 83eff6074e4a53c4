"""Claims of the paper with measurements and verdicts, and their Markdown."""

from collections import Counter
from dataclasses import dataclass, field

OUT, ONLY, NOT = "reproduced", "reproduced only with", "not reproduced"
VERDICTS = (OUT, ONLY, NOT)


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, a measurement, and whether it holds for the shipped case.

    `variant` names an experiment or settings; it counts only if the shipped case fails and
    `with_variant`, which is measured too, is true.
    """

    quote: str
    measured: str
    holds: bool
    variant: str = ""
    with_variant: bool = False

    @property
    def kind(self) -> str:
        """The verdict without the variant, one of `VERDICTS`."""
        if self.holds:
            return OUT
        return ONLY if self.with_variant else NOT

    @property
    def verdict(self) -> str:
        """The kind, with the variant if the claim holds only for it."""
        return f"{ONLY} {self.variant}" if self.kind == ONLY else self.kind


@dataclass(frozen=True)
class Section:
    """A case on the page: introduction, pictures (file, caption), claims and closing text."""

    title: str
    words: str
    claims: list[Claim]
    pictures: list[tuple[str, str]] = field(default_factory=list)
    after: str = ""


def render(section: Section) -> str:
    """Return the Markdown of a section."""
    parts = [f"## {section.title}\n", section.words.strip() + "\n"]
    for file, caption in section.pictures:
        parts.append(f"![{caption}](../pictures/reproduction/{file})\n\n*{caption}*\n")
    parts += [
        f"{n}. “{c.quote}” – **{c.verdict}**\n\n    {c.measured}\n"
        for n, c in enumerate(section.claims, 1)
    ]
    return "\n".join(parts) + (f"\n{section.after}\n" if section.after else "")


def counted(sections: list[Section]) -> str:
    """Return a sentence and a table with the number of claims of each verdict."""
    table = {s.title: Counter(c.kind for c in s.claims) for s in sections}
    total = sum(table.values(), Counter())
    head = ["| part of the paper | reproduced | only with changes | not reproduced |"]
    rows = [f"| {name} | {' | '.join(str(n[v]) for v in VERDICTS)} |" for name, n in table.items()]
    return (
        f"The table counts {total.total()} claims. {total[OUT]} are reproduced, {total[ONLY]} only "
        f"with the named changes, and {total[NOT]} are not reproduced:\n\n"
        + "\n".join([*head, "| --- | --- | --- | --- |", *rows])
    )
