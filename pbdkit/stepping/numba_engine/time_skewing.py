"""Distances between the steps of a pass over the memory, and the conditions under which several
steps can be made in a pass.

Step s of a pass follows step s - 1 through the lattice at a distance. A particle is moved in step s
only after all particles on which its move depends have been moved in step s - 1. A value is
overwritten only after all earlier steps have read it. Both conditions hold if the distance is the
reach of the operations. The results are the same as those of separate steps, because only the order
in which particles are computed differs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pbdkit.scene.scene import Scene
from pbdkit.stepping.program import reach_of, reason_against
from pbdkit.stepping.step import Mode, Reach

CACHE = 2**24
"""Number of bytes of displacements up to which passes of one step are as fast as passes of several
steps (measured)."""
FARTHEST = 8
"""Maximum distance, in cells, between steps of a pass. The distance becomes large if frame points
follow distant particles."""
MAX_SLOTS = 32
"""Number of neighbours up to which steps are limited by memory bandwidth rather than
computation."""


def cell_bytes(scene: Scene) -> int:
    """Return the number of bytes of each repeat cell that a step reads and writes."""
    real = np.dtype(scene.experiment.stepping.precision)
    return 2 * scene.axes * real.itemsize * scene.raster.shape[0]


def exceeds_cache(scene: Scene) -> bool:
    """Return whether displacements exceed the cache, so that several steps in a pass are faster."""
    return cell_bytes(scene) * math.prod(scene.raster.shape[1:]) > CACHE


def single_steps(scene: Scene) -> str:
    """Return the reason why every step is a pass of its own. The text is empty if several steps can
    be made in a pass."""
    if reason := reason_against(scene, Mode.PASSES):
        return reason
    if max(map(len, scene.neighbourhood.slots)) > MAX_SLOTS:
        return "there are many neighbours"
    if max(Skew(scene).along) > FARTHEST:
        return "frame points follow particles far away"
    return ""


@dataclass(frozen=True)
class Skew:
    """Distances between the steps of a pass, along the first axis and the last."""

    scene: Scene

    @cached_property
    def axes(self) -> tuple[Reach, Reach]:
        """Distances over which operations read values, along the first axis and the last."""
        return reach_of(self.scene, 0), reach_of(self.scene, -1)

    @property
    def along(self) -> tuple[int, int]:
        """Distance by which each step follows the previous one, along the first axis and the
        last."""
        rows, columns = self.axes
        return rows.step, columns.step
