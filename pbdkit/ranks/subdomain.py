"""Parts of a lattice: rows of repeat cells.

A part holds its own rows and, beyond them, a halo of those of its neighbours. Its outermost rows,
as many as neighbours reach, are empty; as many stand as frame points that follow nobody, but for
leaders. In each step what is known
shrinks from there by what a step reaches, so that several can be made before the halo is renewed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.scene.scene import Scene
from pbdkit.stepping.passes import Skew

Array = NDArray[Any]
MOST_STEPS = 16
"""Steps between two exchanges, at most: by then halos are a hundredth of a part of 1500 rows."""
MADE_TWICE = 0.05
"""This share of its own rows a part makes on either side that others make too, at most."""
LOOKED_AT = 3
"""So many rows beside its own that move a part has at least, where somebody measures."""


@dataclass(frozen=True)
class Subdomain:
    """Rows `begin` to `end` of repeat cells with those from `low` to `high` around them, of which
    the outermost `edge` are empty, and as many stand still; `steps` can be made between two
    exchanges."""

    begin: int
    end: int
    low: int
    high: int
    edge: int
    steps: int

    @property
    def own(self) -> slice:
        """Its own rows, in arrays of the part."""
        return slice(self.begin - self.low, self.end - self.low)

    def after(self, rows: int) -> Subdomain:
        """The same, counted from a row that is so many after the first."""
        begin, end, low, high = (n - rows for n in (self.begin, self.end, self.low, self.high))
        return replace(self, begin=begin, end=end, low=low, high=high)

    def cut(self, array: Array, axes: int) -> Array:
        """The part of an array whose last `axes` are those of cells, in memory of its own."""
        return rows_of(array, axes, slice(self.low, self.high)).copy()

    def seen(self, rows: int) -> tuple[int, int]:
        """The rows of a lattice of so many that are not empty."""
        return self._within(rows, self.edge)

    def inner(self, rows: int) -> tuple[int, int]:
        """Those that do not stand still either."""
        return self._within(rows, 2 * self.edge)

    def _within(self, rows: int, edge: int) -> tuple[int, int]:
        low = self.low + edge if self.low > 0 else 0
        return low, self.high - edge if self.high < rows else rows


def rows_of(array: Array, axes: int, rows: slice) -> Array:
    """Some rows of an array whose last `axes` are those of cells, as a view."""
    return array[(*(slice(None),) * (array.ndim - axes), rows)]


def reaches(scene: Scene) -> tuple[int, int]:
    """How many rows a step reaches, and its neighbours."""
    skew, levels, below = Skew(scene).axes[0], 1, scene.inner
    while below:
        levels, below = levels + 1, below.inner
    # Masses see their neighbours before these see where the masses have gone.
    levels += any(leading.share is not None for leading in scene.leading)
    return levels * (skew.reach + farthest_apart(scene)), skew.reach


def farthest_apart(scene: Scene) -> int:
    """How many rows at most a frame point lies apart from those whom it follows."""
    return int(max(scene.raster.others.every(Skew(scene).axes[0].apart)))


def subdomains(scene: Scene, parts: int) -> list[Subdomain]:
    """Parts with about equally many particles, of whole rows. Raises ExperimentError where rows
    are too few."""
    (each, edge), experiment = reaches(scene), scene.experiment
    counts = scene.raster.row_counts
    bounds = bounds_of(counts, parts)
    steps = _steps(each, int(np.diff(bounds).min()))
    # After the last of these steps all of its own rows are right, and whom frame points follow.
    looked_at = edge + LOOKED_AT * any(d.local for d in experiment.diagnostics)
    # Bonds from own frame points lead to particles that do not stand still.
    halo = max(steps * each, looked_at, 2 * edge * experiment.shows_bonds) + edge
    if scene.has_fracture and not experiment.fracture.breaks_frame_bonds():
        halo += edge  # bonds to what stands are spared: it must be beyond those of own rows
    return [
        Subdomain(b, e, max(0, b - halo), min(len(counts), e + halo), edge, steps)
        for b, e in pairwise(bounds)
    ]


def widest_halo(each: int, edge: int, least: int, parts: int) -> int:
    """More rows than `subdomains` take as halos, where a step reaches `each` rows at most, and
    neighbours `edge`, of parts of `least` rows."""
    return _steps(each, least) * each + 3 * edge + LOOKED_AT + int(MADE_TWICE * least)


def bounds_of(counts: NDArray[Any], parts: int) -> list[int]:
    """The rows at which parts begin, and the end of the last; `counts` are the particles of each
    row. Raises ExperimentError where rows are too few."""
    share = np.cumsum(counts) / max(1, counts.sum())
    cuts = np.searchsorted(share, np.arange(1, parts) / parts) + 1
    bounds = [0, *cuts.tolist(), len(counts)]
    if np.diff(bounds).min() < 1:
        raise ExperimentError(
            f"has {np.count_nonzero(counts)} rows of cells, too few for {parts} processes; start "
            "fewer",
            ("body",),
        )
    return bounds


def _steps(each: int, least: int) -> int:
    """Between two exchanges, where a step reaches so many rows, of parts of so many rows."""
    return min(MOST_STEPS, 1 + int(MADE_TWICE * least / each)) if each else MOST_STEPS
