"""The page validation/reproduction.md: its claims, what was measured of each, and its verdict."""

from pathlib import Path

DOCS = Path(__file__).parent.parent / "docs"
PAGE = (DOCS / "validation/reproduction.md").read_text("utf-8")


def rows(text):
    """The claims of a section: quote, measured, verdict."""
    lines = [line for line in text.splitlines() if line.startswith("| “")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]


def verdict(quote):
    (found,) = [row[2].strip("*") for row in rows(PAGE) if quote in row[0]]
    return found


def measured(quote):
    (found,) = [row[1] for row in rows(PAGE) if quote in row[0]]
    return found
