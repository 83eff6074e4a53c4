"""Words in pictures: what a variable is, in which units, never longer than there is room for."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Any

from pbdkit.registry.blame import one_line
from pbdkit.results.physical import FACTOR, UNITS

LONGEST = 200
"""So many characters of a title or name are shown."""
RAISED = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
SIGNS = {"^2": "²", "^3": "³", " * ": " × "}


def plain(text: object) -> str:
    """A text for a picture: short, and never taken for a formula."""
    return one_line(str(text)[:LONGEST]).replace("$", r"\$")


def signed(units: str) -> str:
    """Units with the signs of print; nothing of plain numbers."""
    for typed, sign in SIGNS.items():
        units = units.replace(typed, sign)
    return "" if units == "1" else units


def in_its_units(attributes: Mapping[Any, Any]) -> tuple[float, str]:
    """By what the values of a variable are multiplied to be in mm and so on, and those units, as
    far as it says them; else 1 and its own."""
    if UNITS in attributes and FACTOR in attributes:
        return float(attributes[FACTOR]), str(attributes[UNITS])
    return 1.0, str(attributes.get("units", ""))


def label(
    meaning: object, units: object = "", exponent: int = 0, *, broad: int | None = None
) -> str:
    """A quantity and its units, as they stand at an axis whose numbers are to be multiplied by ten
    to the `exponent`; in lines of so many characters if it is said how `broad`, the units on one of
    their own where both are too long for one."""
    said, counted = plain(meaning), signed(plain(units))
    ten = f"10{str(exponent).translate(RAISED)}" if exponent else ""
    counted = " ".join(filter(None, (ten, counted)))
    whole = f"{said} ({counted})" if counted else said
    if broad is None or len(whole) <= broad:
        return whole
    units_below = f"\n{textwrap.fill(f'({counted})', broad)}" if counted else ""
    return f"{_even(said, broad)}{units_below}"


def _even(text: str, broad: int) -> str:
    """The text on as few lines as it takes, and these as equal as can be."""
    lines = len(textwrap.wrap(text, broad))
    every = (textwrap.wrap(text, width) for width in range(1, broad + 1))
    return "\n".join(next((wrapped for wrapped in every if len(wrapped) == lines), []))
