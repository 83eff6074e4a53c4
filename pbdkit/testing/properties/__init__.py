"""Everything that is asked of components, in the order in which it is asked."""

from __future__ import annotations

from pbdkit.interfaces import Component
from pbdkit.testing.properties import (
    breakage,
    elementwise,
    every,
    lattice_parts,
    measurements,
    remembrance,
    repetition,
    steps,
)
from pbdkit.testing.property import Property

PROPERTIES: tuple[Property, ...] = tuple(
    found
    for room in (
        every,
        lattice_parts,
        remembrance,
        repetition,
        elementwise,
        breakage,
        measurements,
        steps,
    )
    for found in vars(room).values()
    if isinstance(found, Property)
)


def properties_of(component: type[Component]) -> list[Property]:
    """Those that are asked of components of this class."""
    return [p for p in PROPERTIES if p.is_asked_of(component)]
