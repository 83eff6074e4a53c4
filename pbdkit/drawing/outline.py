"""The outline of a body within the cells that it cuts: fields end there, and not with the cells."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from pbdkit.drawing.labels import in_its_units
from pbdkit.drawing.mesh import outline
from pbdkit.experiment.body import Body as Shape
from pbdkit.experiment.body import Sites
from pbdkit.experiment.body_algebra import AnyBody
from pbdkit.interfaces import Vector
from pbdkit.results.carried import carried

if TYPE_CHECKING:
    import xarray

Array = NDArray[Any]
PARTS = 8
"""Parts along each side of a cut cell, in each of which the outline is straight."""
MOST_POINTS = 400_000
"""Points at which the distance to the outline is computed at most: where more cells are cut, these
are small on the page, and have fewer parts."""
ON_IT = 1e-6
"""Of a cell's size: a point that lies no farther beyond the outline counts as on it."""


def shape_of(dataset: xarray.Dataset) -> Shape | None:
    """Return the outline of the body that a dataset carries; None where it carries none, and of a
    body of given sites, which has none."""
    try:
        shape: Shape = TypeAdapter(AnyBody).validate_python(carried(dataset, "experiment")["body"])
    except (KeyError, ValidationError):
        return None
    return None if any(box.in_sites for box in shape.boxes()) else shape


def lattice_unit(dataset: xarray.Dataset) -> float:
    """Return what a lattice unit is in the units in which lengths of a dataset are drawn."""
    lengths = dataset["position"].attrs
    return float(in_its_units(lengths)[0] / lengths.get("lattice_factor", 1.0))


@dataclass(frozen=True)
class CutCells:
    """The cells that an outline cuts.

    `row` (cell,) is the row of each cell in `distance`, -1 where it is not cut; `distance` (cut
    cell, point, point) is the signed distance, positive beyond the outline, at points along both
    sides of the cell: [v, u] lies between the corners as (1 - u)(1 - v), u(1 - v), uv, (1 - u)v
    weigh them.
    """

    row: Array
    distance: Array

    @classmethod
    def of(cls, shape: Shape, cells: Array, reference: Array, beyond: Array) -> CutCells:
        """Of cells by the rows of their corners, (cell, 4), at their places at rest, some of which
        lie `beyond` the outline."""
        near = np.zeros(len(reference), bool)
        near[cells[beyond[cells].any(axis=1)]] = True
        candidates = np.flatnonzero(near[cells].any(axis=1))
        parts = int(min(PARTS, max(1.0, math.sqrt(MOST_POINTS / max(1, len(candidates))) - 1.0)))
        at = between(reference[cells[candidates]], np.linspace(0.0, 1.0, parts + 1))
        size = np.ptp(reference[cells[candidates]], axis=1).max(initial=0.0)
        distance = distance_from(shape, at) - ON_IT * size
        is_cut = (distance > 0.0).any(axis=(1, 2))
        row = np.full(len(cells), -1, np.int32)
        row[candidates[is_cut]] = np.arange(np.count_nonzero(is_cut))
        return cls(row, distance[is_cut].astype(np.float32))

    def beyond(self, rows: Array, middles: Array) -> Array:
        """Return which samples of some cut cells lie beyond the outline, (cell, v, u): those at
        `middles` along both sides."""
        points = np.linspace(0.0, 1.0, self.distance.shape[1])
        hats = np.maximum(0.0, 1.0 - np.abs(middles[:, None] - points) * (len(points) - 1))
        hats = hats.astype(np.float32)
        return np.asarray(hats @ self.distance[rows] @ hats.T > 0.0)


def outline_at_rest(shape: Shape, cut: CutCells, cells: Array, reference: Array) -> Array:
    """Return the sides (side, end, axis) of the outline of a body, where cells are cut within
    them."""
    corners = reference[cells[cut.row >= 0]]
    return np.concatenate(
        [
            _through_cells(cut, corners),
            _along_cells(shape, reference[outline(cells, len(reference))]),
        ]
    )


def _through_cells(cut: CutCells, corners: Array) -> Array:
    """Where the distance changes its sign, in triangles, each half of a part of a cut cell."""
    at = between(corners, np.linspace(0.0, 1.0, cut.distance.shape[1]))
    low, high, found = slice(None, -1), slice(1, None), []
    first, last = (low, low), (high, high)
    for triangle in ((first, (low, high), last), (first, last, (high, low))):
        place = np.stack([at[:, v, u].reshape(-1, 2) for v, u in triangle], axis=1)
        away = np.stack([cut.distance[:, v, u].ravel() for v, u in triangle], axis=1)
        mixed = (away > 0.0).any(axis=1) & (away <= 0.0).any(axis=1)
        place, away = place[mixed], away[mixed]
        after, away_after = np.roll(place, -1, axis=1), np.roll(away, -1, axis=1)
        crossed = (away > 0.0) != (away_after > 0.0)
        share = np.where(crossed, away / np.where(crossed, away - away_after, 1.0), 0.0)
        found.append((place + share[..., None] * (after - place))[crossed].reshape(-1, 2, 2))
    return np.concatenate(found)


def _along_cells(shape: Shape, sides: Array) -> Array:
    """Sides (side, end, axis) of one cell only, as far as they lie inside."""
    share = np.linspace(0.0, 1.0, PARTS + 1)[:, None]
    points = sides[:, :1] * (1.0 - share) + sides[:, 1:] * share
    size = np.ptp(sides, axis=1).max(initial=0.0)
    inside = distance_from(shape, points) <= ON_IT * size
    whole = inside.all(axis=1)
    pieces = np.stack([points[~whole, :-1], points[~whole, 1:]], axis=2)
    return np.concatenate([sides[whole], pieces[inside[~whole, :-1] & inside[~whole, 1:]]])


def between(corners: Array, along: Array) -> Array:
    """Return the places (cell, v, u, axis) between the corners (cell, 4, axis) of cells."""
    u, v = np.meshgrid(along, along)
    weights = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=-1)
    return np.asarray(np.einsum("vuk,cka->cvua", weights, corners))


def distance_from(shape: Shape, at: Array) -> Array:
    """Return the signed distance of places (..., axis) to an outline."""
    nowhere = np.zeros(at.shape[:-1], int)
    distance: Array = shape.distance(Sites((nowhere, nowhere), Vector(at[..., 0], at[..., 1])))
    return distance
