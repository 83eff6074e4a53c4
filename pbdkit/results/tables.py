"""What every moment of a scene shares, made where somebody asks."""

from __future__ import annotations

from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Slot
from pbdkit.scene.places import Block
from pbdkit.scene.raster import FOLLOWER
from pbdkit.scene.scene import Scene
from pbdkit.stepping.followers import SlotFollowers
from pbdkit.stepping.state import Floats, State
from pbdkit.stepping.surroundings import presence

Array = TypeVar("Array", bound=NDArray[Any])


def read_only(values: Array) -> Array:
    """The same values, as diagnostics see them: nobody writes to what others read."""
    view: Array = values.view()
    view.flags.writeable = False
    return view


def broken_along(scene: Scene, state: State, block: Block, slot: Slot) -> NDArray[np.bool_]:
    """Where on a block the bond along a slot is broken, in a scene with fracture."""
    assert state.broken_step is not None
    plane, at_this_end = scene.neighbourhood.home[slot]
    home = block if at_this_end else block.seen_through(slot)
    return np.asarray(home.within(state.broken_step[plane]) >= 0)


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

    def of_body(self, planes: Floats) -> Floats:
        """The values of planes by particle, (particle, ...); NaN at frame points."""
        table = self.raster.table(planes)
        table[~self.body] = np.nan
        return read_only(table)

    @cached_property
    def reference(self) -> Floats:
        """X, (particle, axis)."""
        return read_only(self.raster.reference())

    @cached_property
    def body(self) -> NDArray[np.bool_]:
        """(particle,): which are leaders or followers."""
        return read_only(self.raster.table_kind == FOLLOWER)

    @cached_property
    def followers(self) -> SlotFollowers:
        """The rule on the scene, which knows forces and energy."""
        return SlotFollowers(self.scene)

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
