"""What variables are called in pages, and what they are counted in."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbdkit.drawing.labels import counted_in, signed

if TYPE_CHECKING:
    import xarray


def meaning_of(variable: xarray.DataArray) -> str:
    """Its long name, or else its name."""
    return str(variable.attrs.get("long_name") or variable.name)


def units_of(variable: xarray.DataArray) -> str:
    """Its units, those of the lattice with what they are; nothing of plain numbers."""
    return signed(counted_in(variable.attrs))
