"""Check the prose of docstrings, comments, messages and pages: `python tests/prose.py`.

Prints a line for each expression that docs/glossary.md replaces, for each docstring that opens
elliptically or has at most three words, and for each count beyond its limit, and then a table of
counts. Exits with 1 if there is such a line.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
FILES = ("*.py", "*.md", "docs/**/*.md", "[dpt]*/**/*.py", "[dp]*/**/*.yaml")
"""Files that are checked: pages, sources and experiments."""
LEFT_OUT = ("CHANGELOG.md",)
"""Files that are not checked: the changelog also describes earlier versions, in their words."""
REPLACED = "\n## Replaced expressions\n"
"""Heading of the table in the glossary that lists expressions and what to write instead."""

ELLIPTIC = re.compile(
    r"(what|of|how|whether|where|who|whom|whose|those|by|for whom|in which|which|so many|it is|now"
    r"|here|all|the same|as)\b",
    re.IGNORECASE,
)
PERSONS = re.compile(
    r"\b(who|whom|whoever|whose|somebody|anybody|nobody|everybody|told|tells|says|said|asks|asked"
    r"|speaks)\b",
    re.IGNORECASE,
)
VERBS = re.compile(
    r"\b(comput|calculat|evaluat|assembl|return|appl(y|ies)|solv|updat|estimat|interpolat|raise)",
    re.IGNORECASE,
)
CODE = re.compile(
    r"^ *(```+|~~~+).*?^ *\1 *$|``.*?``|`[^`]*`|\]\([^)]*\)|<[^>\n]*>|\$[^$\n]*\$"
    r"|^ *(>>>|\.\.\.) .*?$|^ *[*\w, ]+ : .*?$|^ *\w+( or \w+)?$",
    re.MULTILINE | re.DOTALL,
)

STRING_OR_COMMENT = re.compile(
    r'''("""|\'\'\')(?:\\.|.)*?\1|"(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*'|(?P<comment>\#[^\n]*)''',
    re.DOTALL,
)
"""Strings and comments of Python; the module tokenize takes ten times as long to find them."""

GLOSSARY = re.compile(r"^```{glossary}\n(.*?)^```$", re.MULTILINE | re.DOTALL)
"""Block of a page that is prose and not code."""


class Text(NamedTuple):
    """Text in a file, with its kind ("docstring", "comment", "message", "page") and first line."""

    file: str
    line: int
    kind: str
    text: str


def texts_of(file: str, content: str) -> Iterator[Text]:
    """Yield the texts of a file: paragraphs of a page, comments, docstrings and other strings."""
    if file.endswith(".md"):
        prose = without_code(GLOSSARY.sub(r"\n\1\n", content.split(REPLACED)[0]))
        for paragraph in re.finditer(r"\S.*?(?=\n\s*\n|\Z)", prose, re.DOTALL):
            line = prose.count("\n", 0, paragraph.start()) + 1
            yield Text(file, line, "page", paragraph[0])
    elif file.endswith(".yaml"):
        for number, line in enumerate(content.splitlines(), 1):
            yield Text(file, number, "comment", line.partition("#")[2])
    else:
        yield from _strings(file, list(ast.walk(ast.parse(content))))
        yield from _comments(file, content)


def _comments(file: str, content: str) -> Iterator[Text]:
    line, counted = 1, 0
    for match in STRING_OR_COMMENT.finditer(content):
        if match["comment"]:
            line += content.count("\n", counted, match.start())
            counted = match.start()
            yield Text(file, line, "comment", match["comment"])


def _strings(file: str, nodes: list[ast.AST]) -> Iterator[Text]:
    """Yield docstrings, and other strings that contain a space."""
    documents = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    joined = {id(part) for n in nodes if isinstance(n, ast.JoinedStr) for part in n.values}
    for node in nodes:
        text = "" if id(node) in joined else _text_of(node)
        if text and id(node) in documents:
            yield Text(file, node.lineno, "docstring", text)
        elif " " in text.strip():
            yield Text(file, node.lineno, "message", text)


def _text_of(node: ast.AST) -> str:
    """Return the text of a string, with "…" for each value in an f-string."""
    if isinstance(node, ast.JoinedStr):
        return "".join(_text_of(part) or "…" for part in node.values)
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""


def without_code(text: str) -> str:
    """Return a text with code and formulas replaced by their line breaks."""
    return CODE.sub(lambda code: "\n" * code[0].count("\n"), text)


def replacements() -> dict[str, str]:
    """Read from the glossary what to write instead of which expressions."""
    table = (ROOT / "docs" / "glossary.md").read_text("utf-8").split(REPLACED)[1]
    rows = re.findall(r"^\| (\w.*) \| (.*) \|$", table, re.MULTILINE)[1:]
    return {word: term for words, term in rows for word in words.split(", ")}


def faults(texts: Iterable[Text]) -> Iterator[str]:
    """Yield a line for each fault of the texts."""
    terms = replacements()
    words = "|".join(sorted(terms, reverse=True)).replace(" ", r"\s+")
    pattern = re.compile(rf"(?<![\w.])({words})(?![\w]|\.\w)", re.IGNORECASE)
    for file, line, kind, text in texts:
        prose = without_code(text)
        for match in pattern.finditer(prose):
            place, word = prose.count("\n", 0, match.start()), " ".join(match[0].split())
            yield f"{file}:{line + place}: '{word}': {terms[word.lower()]}"
        if kind == "docstring" and (opening := ELLIPTIC.match(text)):
            yield f"{file}:{line}: opens with '{opening[0]}': begin with a verb, or name the thing"
        if kind == "docstring" and len(text.split()) <= 3:
            yield f"{file}:{line}: '{text}': write a sentence, or no docstring"


def counts(texts: list[str]) -> dict[str, float]:
    """Count texts and words; persons and verbs in 10 000 words; percentage of elliptic openings."""
    words = sum(len(text.split()) for text in texts)
    persons, verbs = (sum(len(p.findall(t)) for t in texts) for p in (PERSONS, VERBS))
    elliptic = sum(ELLIPTIC.match(text) is not None for text in texts)
    return {
        "texts": len(texts),
        "words": words,
        "person words per 10 000": 1e4 * persons / words,
        "plain verbs per 10 000": 1e4 * verbs / words,
        "elliptic openings, %": 100 * elliptic / len(texts),
    }


def project_texts() -> list[Text]:
    """Return the texts of all files that are checked; strings in tests are data and left out."""
    paths = {path.relative_to(ROOT).as_posix() for glob in FILES for path in ROOT.glob(glob)}
    files = sorted(paths - {*LEFT_OUT})
    texts = (t for file in files for t in texts_of(file, (ROOT / file).read_text("utf-8")))
    return [t for t in texts if t.kind != "message" or "tests/" not in t.file]


KINDS = {"docstring": "pbdkit/", "message": "pbdkit/", "page": "docs/"}
"""Kinds of texts that are counted, each with its folder."""
LIMITS = {"person words per 10 000": 8, "elliptic openings, %": 3}
"""Largest counts, which well-kept packages have too."""
MIN_VERBS = 200
"""Smallest number of plain verbs in 10 000 words of docstrings."""


def unusual(kind: str, found: dict[str, float]) -> Iterator[str]:
    """Yield a line for each count of a kind of texts that is beyond its limit."""
    for name, limit in LIMITS.items():
        if found[name] > limit:
            yield f"{kind}s: {found[name]:.3g} {name}; at most {limit}"
    if kind == "docstring" and found["plain verbs per 10 000"] < MIN_VERBS:
        yield f"{kind}s: {found['plain verbs per 10 000']:.3g} verbs; at least {MIN_VERBS}"


def main() -> int:
    """Print faults and counts, and return the exit status."""
    texts = project_texts()
    found = {
        kind: counts([t.text for t in texts if t.file.startswith(folder) and t.kind == kind])
        for kind, folder in KINDS.items()
    }
    lines = [*faults(texts), *(line for item in found.items() for line in unusual(*item))]
    print(*lines, sep="\n")
    for kind, values in found.items():
        print(f"{kind}s:", *(f"{v:.4g} {k}" for k, v in values.items()), sep="\n  ")
    return bool(lines)


if __name__ == "__main__":
    sys.exit(main())
