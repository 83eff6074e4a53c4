"""Frames of a live session. A frame contains positions in single precision. If there are many
particles, it contains only some of them."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from functools import cached_property
from operator import is_
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Bytes
from pbdkit.scene.leader_groups import kinds_at
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

MAX_POINTS = 50_000
"""Maximum number of particles that are shown."""
MAX_LEADERS = 2000
"""Maximum number of leaders of a group that are shown."""
MAX_BONDS = 500_000
"""Maximum number of bonds that are shown."""
COLOURS = {"kind": "kind", "displacement": "displacement", "last-step": "move in the last step"}
"""Variables that can colour particles, with their names."""
HEAD = struct.Struct("<IIIIIIIIdd")
"""Layout of the head of a frame."""
VALUES = 1
"""Flag for values of particles in a frame."""
KINDS = 2
"""Flag for kinds of particles in a frame."""
BROKEN = 4
"""Flag for states of bonds in a frame."""


@dataclass(frozen=True)
class ViewFrame:
    """A state as it is shown: the positions of particles in an array of shape (particle, 2), a
    value and the kind of each particle, and which bonds are broken. If the values are None,
    particles are coloured by their kinds. `kinds` and `broken` are the same objects as in the
    previous frame until they change. `end` is the last step that was made, `picture` is the number
    of the picture, and `step_s` the duration of a step in seconds."""

    step: int
    end: int
    picture: int
    step_s: float
    positions: NDArray[np.float32]
    values: NDArray[np.float32] | None
    kinds: Bytes
    broken: Bytes

    def encoded(self, previous: ViewFrame | None) -> bytes:
        """Encode the frame for a viewer. The viewer has the previous frame. Parts that are the same
        in both frames are omitted."""
        parts: list[NDArray[Any]] = [self.positions]
        holds = 0
        for bit, part, previous_part in (
            (VALUES, self.values, None),
            (KINDS, self.kinds, previous and previous.kinds),
            (BROKEN, self.broken, previous and previous.broken),
        ):
            if part is not None and part is not previous_part:
                holds |= bit
                parts.append(part)
        low, high = _range(self.values)
        nanoseconds = min(int(1e9 * self.step_s), 2**32 - 1)
        steps = self.step % 2**32, self.end % 2**32, self.picture % 2**32, nanoseconds
        sizes = len(self.positions), len(self.broken), 0
        head = HEAD.pack(holds, *steps, *sizes, low, high)
        return b"".join([head, *(part.tobytes() for part in parts)])


class Camera:
    """Builder of frames from states of a body.

    For large bodies every n-th particle along both axes is shown, with n = `every`. The last
    particles along the axes and leaders are shown, too. `rows` are the shown particles, and
    `spacing` is their distance at rest.
    """

    def __init__(self, scene: Scene) -> None:
        raster = scene.raster
        self.every = max(1, math.ceil(math.sqrt(raster.count / MAX_POINTS)))
        self.rows = np.arange(raster.count)
        if self.every > 1:
            self.rows = _thinned(scene, self.every)
        self.reference = raster.reference(self.rows)
        self.spacing = min(map(min, scene.neighbourhood.shells())) * self.every
        self.colour = "kind"
        self._scene, self._place = scene, raster.place_of(self.rows)
        self._leading: list[Any] = []
        self._kinds = self._broken = np.zeros(0, np.uint8)

    @cached_property
    def bonds(self) -> NDArray[np.uint32]:
        """Rows of both ends of bonds, (bond, end). The array is empty if particles or bonds are
        omitted."""
        table = self._scene.bonds.ends if self._shows_bonds else np.zeros((0, 2))
        return table.astype(np.uint32) if len(table) <= MAX_BONDS else np.zeros((0, 2), np.uint32)

    @property
    def _shows_bonds(self) -> bool:
        return self.every == 1 and not self._scene.experiment.neighbours.nearness()

    def positions(self, state: State) -> NDArray[np.float64]:
        """Return the positions of the visible particles, (particle, axis)."""
        u = state.u.reshape(len(state.u), -1)[:, self._place]
        return np.asarray(self.reference + u.T, np.float64)

    def frame(
        self, scene: Scene, state: State, end: int, pictures: int, step_s: float
    ) -> ViewFrame:
        """Return the frame of a state."""
        # In a diverging run, displacements may be too large for single precision.
        with np.errstate(over="ignore"):
            positions = self.positions(state).astype(np.float32)
            values = self._values(state)
        kinds, broken = self._kinds_of(scene, state.step), self._broken_of(state)
        return ViewFrame(state.step, end, pictures, step_s, positions, values, kinds, broken)

    def _values(self, state: State) -> NDArray[np.float32] | None:
        if self.colour == "kind":
            return None
        u = state.u if self.colour == "displacement" else state.u - state.previous
        displacements = u.reshape(len(u), -1)[:, self._place]
        return np.asarray(np.sqrt((displacements.astype(np.float64) ** 2).sum(axis=0)), np.float32)

    def _kinds_of(self, scene: Scene, step: int) -> Bytes:
        leading = [group.rows for group in scene.leading if group.group.leads(step + 1)]
        same = len(leading) == len(self._leading) and all(map(is_, leading, self._leading))
        if not (same and len(self._kinds)):
            self._leading = leading
            kinds = kinds_at(scene.raster, scene.leading, step + 1)
            self._kinds = kinds[self.rows].astype(np.uint8)
        return self._kinds

    def _broken_of(self, state: State) -> Bytes:
        broken = np.zeros(len(self.bonds), np.uint8)
        if state.broken_step is not None and len(broken):
            table = self._scene.bonds
            planes = state.broken_step.reshape(len(state.broken_step), -1)
            broken[...] = planes[table.plane, table.place] >= 0
        if not np.array_equal(broken, self._broken):
            self._broken = broken
        return self._broken


def _thinned(scene: Scene, every: int) -> NDArray[np.intp]:
    """Return the rows of every n-th particle along both axes, of the last particles along them, and
    of leaders unless there are many."""
    raster = scene.raster
    site = raster.site_table()
    selection = ((site % every == 0) | (site == site.max(axis=0))).all(axis=1)
    for leading in scene.leading:
        selection[leading.rows[:: max(1, len(leading.rows) // MAX_LEADERS)]] = True
    return np.flatnonzero(selection)


def _range(values: NDArray[np.float32] | None) -> tuple[float, float]:
    if values is None or not len(values):
        return 0.0, 1.0
    finite = values[np.isfinite(values)]
    high = float(finite.max(initial=0.0))
    return 0.0, high if high > 0.0 else 1.0
