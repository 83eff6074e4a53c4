"""Everything that is asked of components, in the order in which it is asked."""

from __future__ import annotations

from pbdkit.interfaces import Component
from pbdkit.testing.properties import (
    directions,
    elementwise,
    every,
    invariance,
    lattice_parts,
    loads,
    mechanics,
    particulars,
    repetition,
    start,
    steps,
)
from pbdkit.testing.subject import Property

PROPERTIES: tuple[Property, ...] = tuple(
    found
    for page in (
        every,
        lattice_parts,
        start,
        repetition,
        elementwise,
        particulars,
        loads,
        steps,
        directions,
        invariance,
        mechanics,
    )
    for found in vars(page).values()
    if isinstance(found, Property)
)
"""Page by page, as they stand there."""


def properties_of(component: type[Component]) -> list[Property]:
    """Those that are asked of components of this class."""
    return [p for p in PROPERTIES if issubclass(component, p.interfaces)]
