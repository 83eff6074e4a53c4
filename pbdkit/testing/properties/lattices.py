"""What is asked of lattices."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.interfaces import BasisSite, Cell, Lattice
from pbdkit.scene.neighbourhood import checked_cell
from pbdkit.testing.property import PropertyError, asked_of
from pbdkit.testing.subject import Subject


@asked_of(Lattice)
def has_a_sound_cell(subject: Subject) -> None:
    """The cell vectors span an area, no two basis sites share an index, a place or a primitive
    index, and all lie within the period."""
    lattice = subject.component
    assert isinstance(lattice, Lattice)
    try:
        cell = checked_cell(lattice)
    except ExperimentError as error:
        raise PropertyError(str(error)) from None
    _refuse_equal(cell, "place", np.array(cell.vectors), lambda site: site.at)
    if np.linalg.det(cell.primitive) == 0.0:
        raise PropertyError(f"`primitive` gives the cell vectors {cell.primitive}: in line")
    _refuse_equal(cell, "primitive index", np.array(cell.primitive), lambda site: site.primitive)


def _refuse_equal(
    cell: Cell, what: str, steps: np.ndarray, of: Callable[[BasisSite], tuple[float, ...]]
) -> None:
    """Raises where two sites have the same value up to whole steps of the cell."""
    for (m, one), (n, other) in combinations(enumerate(cell.sites), 2):
        apart = np.linalg.solve(steps.T, np.array(of(other), float) - np.array(of(one), float))
        if np.abs(apart - np.round(apart)).max() < 1e-9:
            raise PropertyError(
                f"basis sites {m} and {n} have the same {what} {tuple(of(one))}, up to whole "
                "cells: they must differ"
            )


@asked_of(Lattice, needs=("has-a-sound-cell",))
def keeps_its_cell_wherever_it_lies(subject: Subject) -> None:
    """The origin moves the lattice and does not enter its cell: no digit of a run depends on where
    the body lies."""
    lattice = subject.component
    assert isinstance(lattice, Lattice)
    moved = lattice.model_copy(update={"origin": (1000.3, -77.1)})
    if moved.cell() != lattice.cell():
        raise PropertyError("another origin gives another cell: leave `self.origin` out of `cell`")
