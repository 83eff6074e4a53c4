"""What variables are called in pages, and in which units they are."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbdkit.drawing.labels import in_its_units, signed

if TYPE_CHECKING:
    import xarray


def meaning_of(variable: xarray.DataArray) -> str:
    """Its long name, or else its name."""
    return str(variable.attrs.get("long_name") or variable.name)


def units_of(variable: xarray.DataArray) -> str:
    """Its units in a page, mm and so on where it says its scale; nothing of plain numbers."""
    return signed(in_its_units(variable.attrs)[1])


def factor_of(variable: xarray.DataArray) -> float:
    """By what its values are multiplied to be in these."""
    return in_its_units(variable.attrs)[0]
