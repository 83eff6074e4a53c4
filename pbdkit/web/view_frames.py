"""Frames of a live session. A frame contains positions in single precision. If there are many
particles, it contains only some of them."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import is_
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Bytes
from pbdkit.io.snapshot import Tables
from pbdkit.lattice.raster import FRAME
from pbdkit.model.bodies import Sites
from pbdkit.plotting.data import cell_triangles
from pbdkit.plugin import Diagnostic
from pbdkit.scene.leader_groups import kinds_at
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State
from pbdkit.web.live_fields import FieldEvaluator

MAX_POINTS = 50_000
"""Maximum number of particles that are shown."""
MAX_LEADERS = 2000
"""Maximum number of leaders of a group that are shown."""
MAX_BONDS = 500_000
"""Maximum number of bonds that are shown."""
KIND = "kind"
"""Name of the colours by the kinds of particles."""
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
    particles along the axes and leaders are shown, too. The `diagnostics` of the experiment, and
    others, provide the fields that determine colours. `rows` are the shown particles, and
    `spacing` is their distance at rest.
    """

    def __init__(self, scene: Scene, diagnostics: Sequence[Diagnostic] = ()) -> None:
        raster = scene.raster
        self.every = max(1, math.ceil(math.sqrt(raster.count / MAX_POINTS)))
        self.rows = np.arange(raster.count)
        if self.every > 1:
            self.rows = _thinned(scene, self.every)
        self.reference = raster.reference(self.rows)
        self.spacing = min(map(min, scene.neighbourhood.shells())) * self.every
        self.colour = KIND
        self.fields = FieldEvaluator(scene, diagnostics)
        self._scene, self._place = scene, raster.place_of(self.rows)
        self._leading: list[Any] = []
        self._kinds = self._broken = np.zeros(0, np.uint8)

    @cached_property
    def bonds(self) -> NDArray[np.uint32]:
        """Rows of both ends of bonds, (bond, end). The array is empty if particles or bonds are
        omitted."""
        table = self._scene.bonds.ends if self._shows_bonds else np.zeros((0, 2))
        return table.astype(np.uint32) if len(table) <= MAX_BONDS else np.zeros((0, 2), np.uint32)

    @cached_property
    def triangles(self) -> NDArray[np.uint32]:
        """Rows of the corners of the triangles that fields fill, (triangle, corner). The array is
        empty if particles are omitted or neighbours are re-evaluated."""
        raster, rows = self._scene.raster, np.flatnonzero(self._scene.raster.table_kind != FRAME)
        if not self._shows_bonds or len(rows) < 3:
            return np.zeros((0, 3), np.uint32)
        triangles = cell_triangles(raster.site_table()[rows], self.reference[rows])
        return rows[triangles].astype(np.uint32)

    @cached_property
    def beyond(self) -> NDArray[np.float32]:
        """Signed distance of the particles from the outline, negative inside. The array is empty if
        the outline cuts no cells."""
        tables, body = Tables(self._scene), self._scene.experiment.body
        if not self._shows_bonds or (tables.inside == tables.body).all():
            return np.zeros(0, np.float32)
        places = Sites(tuple(self._scene.raster.site_table().T), tuple(self.reference.T))
        return np.asarray(body.distance(places), np.float32)

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
            values = self._values(scene, state)
        kinds, broken = self._kinds_of(scene, state.step), self._broken_of(state)
        return ViewFrame(state.step, end, pictures, step_s, positions, values, kinds, broken)

    def _values(self, scene: Scene, state: State) -> NDArray[np.float32] | None:
        if self.colour == KIND:
            return None
        return self.fields.values(self.colour, scene, state)[self.rows].astype(np.float32)

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
    """Return the least and the largest finite value, 0 and 1 if there is none."""
    finite = np.zeros(0) if values is None else values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
