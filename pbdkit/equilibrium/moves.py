"""The moves of a scene's followers at a state, as the rule makes them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from pbdkit.experiment.motions import Hold
from pbdkit.experiment.solvers import Stepping
from pbdkit.interfaces import RenewsParticles
from pbdkit.scene.leader_groups import Leading, kinds_at
from pbdkit.scene.raster import FOLLOWER
from pbdkit.scene.scene import Scene
from pbdkit.stepping.choice import Choice, make_engine, obstacle
from pbdkit.stepping.contact import Contact
from pbdkit.stepping.followers import SlotFollowers
from pbdkit.stepping.guidance import Guidance
from pbdkit.stepping.numpy_engine import Engine
from pbdkit.stepping.state import Floats, State

LARGEST_BY_NUMPY = 20_000
"""Particles beyond which moves are evaluated by the compiled engine."""
ROUNDING = 4 * float(np.finfo(float).eps)


class Moves:
    """Evaluates the moves of a scene's followers, relaxed as in its steps but without memory, the
    frame standing where the body tells it to, and obstacles where they are at a moment.

    Of large bodies they are compiled, which is worth its seconds where they are asked for often
    with the same numbers; `compiles` says whether that is so.
    """

    def __init__(self, scene: Scene, *, compiles: bool = True) -> None:
        stepping = Stepping(relaxation=scene.experiment.stepping.relaxation, threads=1)
        self._scene = scene
        self._engine: Engine | None = None
        self._guidance = Guidance(scene)
        self.contact = Contact(scene) if scene.barriers else None
        renews = isinstance(scene.experiment.rule, RenewsParticles)
        self._loads = replace(scene.loads) if scene.loads else None
        stepped = replace(scene, loads=self._loads)
        large = compiles and scene.raster.count > LARGEST_BY_NUMPY
        if large and not (scene.has_fracture or renews):
            experiment = scene.experiment.model_copy(update={"solver": stepping})
            free = replace(stepped, barriers=())
            stepped = replace(free, experiment=experiment, leading=_resting(scene))
            choice = Choice("numpy" if obstacle() else "compiled", 1, "asked for")
            self._engine, _ = make_engine(stepped, choice)
        self._followers = None if self._engine else SlotFollowers(stepped, stepping)

    @property
    def is_compiled(self) -> bool:
        """Whether evaluating them is cheap."""
        return self._engine is not None and self._engine.name == "compiled"

    def at(self, state: State, moment: float) -> Floats:
        """Planes, zero where nobody follows in the moment's step, or along that axis, under the
        loads of that moment; who would enter an obstacle moves onto its outline. Brings the state's
        frame into line."""
        moves = self.free(state, moment)
        if self.contact:
            there = state.u + moves
            with np.errstate(all="ignore"):
                self.contact.push_out(there, moment)
                np.subtract(there, state.u, out=moves)
            self._stop(moves, math.ceil(moment))
        return moves

    def rounding(self, u: Floats) -> float:
        """How far rounding alone may put a move off at displacements u: before obstacles, where
        places count, by what it leaves of those."""
        reach = self.contact.reach if self.contact else 0.0
        return ROUNDING * max(float(np.abs(u).max()), reach)

    def free(self, state: State, moment: float) -> Floats:
        """The same without obstacles."""
        u, frame, step = state.u, self._scene.frame, math.ceil(moment)
        if self._loads:
            self._loads.held_at = moment
        flat = u.reshape(len(u), -1)
        if frame:
            frame.follow(flat, flat)
        if self._engine:
            none = (None,) * len(self._scene.leading)
            here = replace(state, step=step - 1, previous=np.zeros_like(u), starts=none)
            moves = self._engine.advance(here).u
        else:
            assert self._followers
            moves = u.astype(float)
            with np.errstate(all="ignore"):
                self._followers.move(u, moves, state)
                self._guidance.correct(moves, u, step)
        with np.errstate(all="ignore"):
            moves -= u
        self._stop(moves, step)
        return moves

    def _stop(self, moves: Floats, step: int) -> None:
        """Only followers move."""
        still, frame = moves.reshape(len(moves), -1), self._scene.frame
        for led in self._scene.leading:
            for axis in led.axes if led.group.leads(step) else ():
                still[axis, led.place] = 0.0
        if frame:
            still[:, frame.place] = 0.0


def _resting(scene: Scene) -> tuple[Leading, ...]:
    """The leader groups, holding."""
    groups = [leading.group.model_copy(update={"motion": Hold()}) for leading in scene.leading]
    pairs = zip(scene.leading, groups, strict=True)
    return tuple(replace(leading, group=group) for leading, group in pairs)


def random_displacements(scene: Scene, size: float) -> Floats:
    """Planes with followers of the last step put elsewhere, up to that far along each axis."""
    kinds = kinds_at(scene.raster, scene.leading, scene.experiment.steps)
    place = scene.raster.place_of(np.flatnonzero(kinds == FOLLOWER))
    put: Floats = np.zeros((scene.axes, *scene.raster.shape))
    random = np.random.default_rng(0).uniform(-size, size, (len(put), len(place)))
    put.reshape(len(put), -1)[:, place] = random
    return put
