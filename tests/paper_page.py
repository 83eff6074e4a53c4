"""The page validation/reproduction.md: its claims, what was measured of each, and its verdict."""

import re
from pathlib import Path

DOCS = Path(__file__).parent.parent / "docs"
PAGE = (DOCS / "validation/reproduction.md").read_text("utf-8")


def rows(text):
    """Return the claims of a section: quote, measurement, verdict."""
    pattern = r"^\d+\. (“.*”) – \*\*(.*)\*\*\n\n    (\S.*)$"
    return [[quote, text, verdict] for quote, verdict, text in re.findall(pattern, text, re.M)]


def verdict(quote):
    (found,) = [row[2] for row in rows(PAGE) if quote in row[0]]
    return found


def measured(quote):
    (found,) = [row[1] for row in rows(PAGE) if quote in row[0]]
    return found
