"""How far the leaders' motion can have reached: nothing beyond is touched.

At rest a rule moves nothing, exactly; so a step can only move particles that bear a load or adjoin
one that has moved. Where that is plain from the scene nothing has moved before the leaders do;
elsewhere the first step looks at every particle and finds those that are not at rest. From then on
the box around what has moved, and around leaders that are not at home, grows by one bond a step,
and by as many as rules work on each other's moves. Where something is remembered that changes,
everything is looked at in every step.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import RenewsBonds, RenewsParticles, StartsCracked
from pbdkit.interfaces.vector import vector
from pbdkit.registry.blame import blaming
from pbdkit.scene.declarations import bond_numbers, particle_numbers
from pbdkit.scene.raster import FOLLOWER
from pbdkit.scene.scene import Scene
from pbdkit.stepping.compiled.level import Level
from pbdkit.stepping.evaluator import Evaluator
from pbdkit.stepping.prescription import Led
from pbdkit.stepping.state import Floats, State
from pbdkit.stepping.surroundings import presence

Box = NDArray[np.int64]
"""(first, last + 1) of repeat cells along each axis, one after the other."""


class Reach:
    """`box` is what has been reached, `growth` how it grows in a step, (2 axes,)."""

    def __init__(self, levels: Sequence[Level]) -> None:
        scene = levels[-1].scene
        experiment, self._shape = scene.experiment, scene.raster.shape
        self._everything = _interleaved(np.zeros(scene.axes), np.array(self._shape[1:]))
        self._renews = isinstance(experiment.rule, RenewsParticles) or (
            scene.has_fracture and isinstance(experiment.fracture, RenewsBonds)
        )
        # What rests with some numbers may not with others.
        self._renews |= any(field != "solver" for field, _ in experiment.courses)
        self._rests = not self._renews and _rests_by_construction(levels)
        self._bond = len(levels) * _growth(scene)
        self._leaders = [np.unravel_index(led.place, self._shape)[1:] for led in scene.leading]
        self._known = False
        self._keep_to(self._everything)

    def begin(self, state: State) -> None:
        """A state that did not come from here: what has moved is known only where nothing has."""
        self._known = self._rests and state.step == 0 and not state.u.any()
        self._keep_to(np.zeros_like(self._bond) if self._known else self._everything)

    def before(self, led: Led, load: Floats | None, count: int) -> int:
        """Takes the leaders and the load of the coming steps in; returns how many of `count` can be
        made in one go."""
        if not self._known:
            return count if self._renews else 1
        for place, values, _ in led:
            self._join(np.unravel_index(place[(values != 0.0).any(axis=0)], self._shape)[1:])
        if load is not None:
            self._join(np.nonzero((load != 0.0).any(axis=(0, 1))))
        return count

    def take_in(self, state: State, rows: slice) -> None:
        """Takes in what has moved in some rows of cells that somebody else has written."""
        if self._known:
            some = (u[:, :, rows] != 0.0 for u in (state.u, state.previous))
            first, *cells = np.nonzero(np.logical_or(*some).any(axis=(0, 1)))
            self._join((first + rows.start, *cells))

    def touch(self, touched: Iterable[tuple[NDArray[np.intp], ...]]) -> None:
        """Takes in the cells that obstacles push from where they rest."""
        for cells in touched if self._known else ():
            self._join(cells)

    def after(self, now: Floats, before: Floats) -> None:
        """Looks once at what the first step has moved."""
        if self._known:
            np.clip(self.box, 0, self._everything.max(), out=self.box)
        elif not self._renews:
            self._known = True
            moved = (now != 0.0).any(axis=(0, 1)) | (before != 0.0).any(axis=(0, 1))
            for cells in self._leaders:  # who is held where it would not rest moves once released
                moved[cells] = True
            self._keep_to(np.zeros_like(self._bond))
            self._join(np.nonzero(moved))

    def _keep_to(self, box: Box) -> None:
        self.box, self.growth = box.copy(), np.zeros_like(box)

    def _join(self, cells: tuple[NDArray[np.intp], ...]) -> None:
        """Takes in cells that have moved."""
        if not len(cells[0]):
            return
        box = _interleaved([n.min() for n in cells], [n.max() + 1 for n in cells])
        if not self.box.any():  # nothing has been reached yet
            self.box, self.growth = box, self._bond
        self.box[::2] = np.minimum(self.box[::2], box[::2])
        self.box[1::2] = np.maximum(self.box[1::2], box[1::2])


def _rests_by_construction(levels: Sequence[Level]) -> bool:
    """Whether the reference configuration stays as it is: every neighbour is there, all start at
    rest, no bond is broken or breaks at rest, and the rules' moves from there are zero. Where
    particles or bonds have numbers of their own it is looked at instead."""
    scene = levels[-1].scene
    experiment, raster, fracture = scene.experiment, scene.raster, scene.experiment.fracture
    cracked = (isinstance(fracture, StartsCracked) and fracture.segments()) or experiment.cuts
    fields = scene.constants.by_particle or scene.constants.by_bond
    remembered = particle_numbers(experiment) or bond_numbers(experiment) or fields
    if not experiment.initial.at_rest or experiment.rule.uses_reference or cracked or remembered:
        return False
    for s, slots in enumerate(scene.neighbourhood.slots):
        block = raster.body_block(s)
        if block and any(there is not None for there in presence(raster, block, slots)):
            return False
    return all(_stays(level.scene) for level in levels)


def _stays(scene: Scene) -> bool:
    """Whether a particle with all its neighbours moves nowhere at rest, and no bond breaks."""
    experiment, evaluator = scene.experiment, Evaluator(scene)
    still, slots = vector(np.zeros(scene.axes)), scene.neighbourhood.slots
    with blaming(experiment.rule, "when asked whether it rests"):
        if any(component != 0.0 for own in slots for component in evaluator.at_rest(own)):
            return False
    if not scene.has_fracture:
        return True
    with blaming(experiment.fracture, "when asked what breaks at rest"):
        limits = scene.constants.limits
        return not any(evaluator.breaks(still, k.rest, limits[k], ()) for k in chain(*slots))


def _interleaved(low: Any, high: Any) -> Box:
    return np.stack([low, high], axis=1).astype(np.int64).ravel()


def _growth(scene: Scene) -> Box:
    """How far, in cells, a step of a rule carries a motion along each direction: by a bond, or
    by a frame point that follows one particle and is a neighbour of another."""
    slots = list(chain(*scene.neighbourhood.slots))
    carried = [np.array([slot.cell for slot in slots])]
    if scene.frame:
        kinds = scene.raster.kind
        places = scene.frame.place[scene.frame.map.point], scene.frame.body_place
        at, body = (np.stack(np.unravel_index(p, kinds.shape)[1:], axis=1) for p in places)
        for slot in slots:
            # The particle at `seeing` sees the frame point through this slot.
            seeing = at - slot.cell
            inside = ((seeing >= 0) & (seeing < kinds.shape[1:])).all(axis=1)
            follows = kinds[(slot.source, *seeing[inside].T)] == FOLLOWER
            carried.append((seeing - body)[inside][follows])
    most = np.concatenate(carried)
    return _interleaved(np.minimum(most.min(axis=0), 0), np.maximum(most.max(axis=0), 0))
