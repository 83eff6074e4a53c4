"""Functions of the place and random fields, as values over a grid: so an experiment says all in its
file."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.experiment.body import Body, Box
from pbdkit.experiment.parts import fault
from pbdkit.interfaces import Lattice
from pbdkit.interfaces.fields import TakesFields
from pbdkit.interfaces.random_field import RandomField
from pbdkit.interfaces.varying import MOST_VALUES, OfPlace, Varying

Floats = NDArray[np.float64]
SLACK = 1e-9
"""Of spacings: so far a body reaches beyond a place by rounding."""


def sampled(part: TakesFields, lattice: Lattice, body: Body, seed: int, field: str) -> Any:
    """The part at a field of the experiment with values in place of functions, and of random fields
    from the seed, half a spacing apart: on the square and the rectangular lattice particles,
    middles of bonds and of cells are places of the grid.

    Raises ValidationError where the part does not take a value, PydanticCustomError where none can
    be drawn.
    """
    found: dict[str, Varying] = {}
    for name, varying in part.varying.items():
        try:
            if isinstance(varying, OfPlace):
                found[name] = varying.sampled(*_grid(lattice, body))
            elif isinstance(varying, RandomField):
                found[name] = varying.drawn_at(*_grid(lattice, body), seed, field)
        except ValueError as error:
            raise fault(str(error), key=(field, name)) from None
    return part.with_more(**found) if found else part


def _grid(lattice: Lattice, body: Body) -> tuple[Floats, Floats]:
    """Raises ValueError for more places than a field takes, before they are made."""
    cell = lattice.cell()
    steps = np.array(cell.vectors) / np.array(cell.period)[:, None]
    spacing = np.abs(np.diag(steps))
    corners = np.concatenate([_corners(box, steps, lattice) for box in body.boxes()])
    origin = np.array(lattice.origin)
    low = np.floor((corners.min(axis=0) - origin) / spacing + SLACK)
    high = np.ceil((corners.max(axis=0) - origin) / spacing - SLACK)
    if not (count := np.prod(2 * (high - low) + 1)) <= MOST_VALUES:
        raise ValueError(f"{count:.3g} values are more than {MOST_VALUES}; make the body smaller")
    x, y = (
        o + s / 2 * np.arange(2 * a, 2 * b + 1)
        for o, s, a, b in zip(origin, spacing, low, high, strict=True)
    )
    return x, y


def _corners(box: Box, steps: Floats, lattice: Lattice) -> Floats:
    """Of a rectangle around a body, in coordinates."""
    corners = np.array(list(product(*zip(box.low, box.high, strict=True))), float)
    return corners @ steps + lattice.origin if box.in_sites else corners
