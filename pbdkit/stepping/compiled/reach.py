"""How far the leaders' motion can have reached: nothing beyond is touched.

At rest a rule moves nothing, exactly; so a step can only move particles that adjoin one that has
moved. Where that is plain from the scene nothing has moved before the leaders do; elsewhere the
first step looks at every particle and finds those that are not at rest. From then on the box around
what has moved, and around leaders that are not at home, grows by one bond a step.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import StartsCracked
from pbdkit.interfaces.vector import vector
from pbdkit.registry.blame import blaming
from pbdkit.scene.scene import Scene
from pbdkit.stepping.evaluator import Evaluator
from pbdkit.stepping.prescription import Led
from pbdkit.stepping.state import Floats, State
from pbdkit.stepping.surroundings import presence

Box = NDArray[np.int64]
"""(first row, last row + 1, first column, last column + 1) of repeat cells."""


class Reach:
    """`blocks` hold the body's cells of each sublattice, (sublattice, 4); `box` what has been
    reached, `growth` how it grows in a step, (4,)."""

    def __init__(self, scene: Scene) -> None:
        raster = scene.raster
        self._shape = raster.shape
        self.blocks = np.zeros((raster.shape[0], 4), np.int64)
        for s in range(raster.shape[0]):
            if block := raster.body_block(s):
                (i0, j0), (i1, j1) = block.start, block.stop
                self.blocks[s] = i0, i1, j0, j1
        self._everything = np.array([0, raster.shape[1], 0, raster.shape[2]], np.int64)
        self._bond = _growth(scene)
        self._leaders = [np.unravel_index(led.place, raster.shape) for led in scene.leading]
        self._rests = _rests_by_construction(scene)
        self._known = self._empty = False
        self.box, self.growth = self._everything.copy(), np.zeros(4, np.int64)

    def begin(self, state: State) -> None:
        """A state that did not come from here: what has moved is known only where nothing has."""
        self._known = self._empty = self._rests and state.step == 0
        self.box = np.zeros(4, np.int64) if self._known else self._everything.copy()
        self.growth = np.zeros(4, np.int64)

    def before(self, led: Led, count: int) -> int:
        """Takes the leaders of the coming steps in; returns how many of `count` can be made in
        one go."""
        if not self._known:
            return 1
        for place, values in led:
            away = place[(values != 0.0).any(axis=0)]
            if len(away):
                _, i, j = np.unravel_index(away, self._shape)
                self._join(_around(i, j))
        return count

    def after(self, now: Floats, before: Floats) -> None:
        """Looks once at what the first step has moved."""
        if self._known:
            np.clip(self.box, 0, self._everything.max(), out=self.box)
            return
        self._known = True
        moved = (now != 0.0).any(axis=(0, 1)) | (before != 0.0).any(axis=(0, 1))
        for _, m, n in self._leaders:  # who is held where it would not rest moves once released
            moved[m, n] = True
        i, j = np.nonzero(moved)
        self.box = _around(i, j) if len(i) else np.array([0, 0, 0, 0], np.int64)
        self._empty = not len(i)
        self.growth = self._bond.copy() if len(i) else np.zeros(4, np.int64)

    def _join(self, box: Box) -> None:
        if self._empty:
            self.box, self.growth, self._empty = box, self._bond.copy(), False
        self.box[::2] = np.minimum(self.box[::2], box[::2])
        self.box[1::2] = np.maximum(self.box[1::2], box[1::2])


def _rests_by_construction(scene: Scene) -> bool:
    """Whether the reference configuration stays as it is: every neighbour is there, all start at
    rest, no bond is broken or breaks at rest, and the rule's move from there is zero."""
    experiment, evaluator = scene.experiment, Evaluator(scene)
    rule, fracture = experiment.rule, experiment.fracture
    cracked = isinstance(fracture, StartsCracked) and fracture.segments()
    if not experiment.initial.at_rest or rule.uses_reference or cracked:
        return False
    still = vector(np.zeros(scene.axes))
    for s, slots in enumerate(scene.neighbourhood.slots):
        block = scene.raster.body_block(s)
        if block and any(there is not None for there in presence(scene.raster, block, slots)):
            return False
        with blaming(rule, "when asked whether it rests"):
            if any(component != 0.0 for component in evaluator.at_rest(slots)):
                return False
        with blaming(fracture, "when asked what breaks at rest"):
            limits = scene.constants.limits
            if fracture.can_break and any(
                evaluator.breaks(still, k.rest, limits[k], ()) for k in slots
            ):
                return False
    return True


def _around(i: NDArray[np.intp], j: NDArray[np.intp]) -> Box:
    return np.array([i.min(), i.max() + 1, j.min(), j.max() + 1], np.int64)


def _growth(scene: Scene) -> Box:
    """How far, in cells, a step carries a motion along each direction: by a bond, or by a frame
    point that follows one particle and is a neighbour of another."""
    steps = [slot.cell for own in scene.neighbourhood.slots for slot in own]
    carried = [np.array(steps)]
    if scene.frame:
        _, i, j = np.unravel_index(scene.frame.place[scene.frame.map.point], scene.raster.shape)
        _, m, n = np.unravel_index(scene.frame.body_place, scene.raster.shape)
        kinds = scene.raster.kind
        for own in scene.neighbourhood.slots:
            for slot in own:
                # The particle at (p, q) sees the frame point at (i, j) through this slot.
                p, q = i - slot.cell[0], j - slot.cell[1]
                inside = (p >= 0) & (p < kinds.shape[1]) & (q >= 0) & (q < kinds.shape[2])
                p, q, b, c = p[inside], q[inside], m[inside], n[inside]
                follows = kinds[slot.source, p, q] == 1
                carried.append(np.stack([p - b, q - c], axis=1)[follows])
    most = np.concatenate(carried)
    return np.array(
        [min(most[:, 0].min(), 0), max(most[:, 0].max(), 0),
         min(most[:, 1].min(), 0), max(most[:, 1].max(), 0)], np.int64
    )  # fmt: skip
