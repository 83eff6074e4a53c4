"""What every moment of a scene shares, made where somebody asks."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.scene.mesh import Patch
from pbdkit.scene.scene import Scene
from pbdkit.scene.shares import cells_with_shares
from pbdkit.stepping.slots import SlotFollowers
from pbdkit.stepping.state import Floats
from pbdkit.stepping.surroundings import presence


class Tables:
    """What every moment of a scene shares: the reference, and who is present around whom."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.raster = scene.raster

    def add_reference(self, u: Floats) -> Floats:
        """X + u, (particle, axis), in place; X is kept where it is wanted more than twice."""
        experiment = self.scene.experiment
        if experiment.recording.count(experiment.steps) > 2:
            u += self.reference
            return u
        for rows in self.raster.chunks():
            u[rows[0] : rows[-1] + 1] += self.raster.reference(rows)
        return u

    @cached_property
    def reference(self) -> Floats:
        """X, (particle, axis)."""
        return self.raster.reference()

    @cached_property
    def followers(self) -> SlotFollowers:
        """The rule on the scene, which knows forces and energy."""
        return SlotFollowers(self.scene)

    @cached_property
    def shares(self) -> list[tuple[Patch, NDArray[np.float64]]]:
        """The cells of the body with the share of each."""
        return list(cells_with_shares(self.raster, self.scene.cells))

    @cached_property
    def blocks(self) -> list[tuple[Any, ...]]:
        """(block, slots, presence) of the body's particles of each sublattice."""
        slots = self.scene.neighbourhood.slots
        blocks = [self.raster.body_block(s) for s in range(self.raster.shape[0])]
        return [
            (b, slots[b.sublattice], presence(self.raster, b, slots[b.sublattice]))
            for b in blocks
            if b
        ]
