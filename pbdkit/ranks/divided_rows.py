"""The rows of a part, in the search for an equilibrium."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.equilibrium.rows import Rows
from pbdkit.equilibrium.strip import Strip
from pbdkit.ranks.communicator import Ranks
from pbdkit.ranks.halo import Halo
from pbdkit.ranks.subdomain import MOST_STEPS, Subdomain, farthest_apart, reaches, subdomains
from pbdkit.scene.scene import Scene
from pbdkit.stepping.passes import Skew

Floats = NDArray[np.floating[Any]]
SHARE = 4
"""The first grid that all processes have is by so much smaller than the part of one."""
A_CYCLE = 6
"""Rows of that grid beyond its own that a process takes into a cycle: what is right shrinks by 4
on the way down, and by 2 on the way up."""


class DividedRows(Rows):
    """Those of one of some ranks."""

    def __init__(self, ranks: Ranks, halo: Halo, strip: Strip) -> None:
        self._ranks, self._halo = ranks, halo
        self.strip, self.rank = strip, ranks.rank

    def every(self, value: Any) -> list[Any]:
        """By rank."""
        return self._ranks.every(value)

    def agreeing(self) -> AbstractContextManager[None]:
        """As the ranks do."""
        return self._ranks.agreeing()

    def meet(self, field: NDArray[Any]) -> None:
        """From other parts."""
        self._halo.meet(field)

    def random(self, shape: tuple[int, ...]) -> Floats:
        """What one process draws for these rows: a number is one turn of its generator."""
        assert self.strip
        planes, (rows, places) = shape[:-2], shape[-2:]
        found: Floats = np.empty((math.prod(planes), rows, places))
        for n, plane in enumerate(found):
            turned = np.random.PCG64(0).advance((n * self.strip.count + self.strip.low) * places)
            plane[...] = np.random.Generator(turned).uniform(-1.0, 1.0, (rows, places))
        return found.reshape(shape)


def deep_subdomains(scene: Scene, parts: int) -> list[Subdomain]:
    """Parts with halos that serve for a cycle of multigrid, and arrays that begin where all grids
    that are parted have a row. Raises ExperimentError where rows are too few."""
    spread = 2 ** _depth(parts)
    each, edge = reaches(scene)
    halo, rows = _margin(scene) + A_CYCLE * spread, len(scene.raster.row_counts)
    found = []
    for own in subdomains(scene, parts):
        low = max(0, own.begin - halo) // spread * spread
        high = min(rows, own.end + halo)
        steps = max(1, min(MOST_STEPS, (halo - edge) // max(1, each)))
        found.append(Subdomain(own.begin, own.end, low, high, edge, steps))
    return found


def deep_halo(each: int, edge: int, least: int, parts: int) -> int:
    """More rows than `deep_subdomains` take as halos, as `widest_halo` is."""
    return 3 * edge + each + (A_CYCLE + 1) * int(2 ** _depth(parts))


def strip_of(scene: Scene, own: Subdomain, parts: int) -> Strip:
    """What a part knows of the grid of a scene."""
    count, margin = scene.raster.whole_shape[1], _margin(scene)
    first = own.low + margin if own.low else 0
    last = own.high - margin if own.high < count else count
    return Strip(count, own.low, own.begin, own.end, first, last, _depth(parts))


def _depth(parts: int) -> int:
    """How many grids are parted among so many processes."""
    return math.ceil(math.log(SHARE * parts, 4))


def _margin(scene: Scene) -> int:
    """The outermost rows of a part that are empty, that stand still, and whose particles see those,
    or frame points that follow them."""
    return 3 * Skew(scene).axes[0].reach + farthest_apart(scene)
