"""The linear system of an equilibrium, A c = move with A = 1 - (step operator), and its parts.

`Moves` evaluates the right side by the rule, `System` is the interface of the solvers. `Rows` are
the rows of the lattice that a process has, and the collective operations among the processes that
share one; fields are (…, row, place), and what concerns the whole lattice is summed row by row, so
that it is the same for any number of processes. Moves and displacements are planes, (axis,
sublattice, cell, cell), as in a state.
"""

from __future__ import annotations

import math
import sys
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cache
from typing import Final

import numpy as np
from threadpoolctl import ThreadpoolController

from pbdkit.array_types import Array, Floats
from pbdkit.communicator import SERIAL, Communicator
from pbdkit.errors import ExperimentError
from pbdkit.lattice.raster import FOLLOWER
from pbdkit.model.motions import Hold
from pbdkit.model.solver import Stepping
from pbdkit.plugin import RenewsParticles
from pbdkit.scene.leader_groups import Leading, kinds_at
from pbdkit.scene.scene import Scene
from pbdkit.stepping.contact import Contact
from pbdkit.stepping.engine_choice import Choice, make_engine, obstacle
from pbdkit.stepping.followers import SlotFollowers
from pbdkit.stepping.leaders import Guidance
from pbdkit.stepping.numpy_engine import Engine
from pbdkit.stepping.state import State

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
            free = stepped.bare
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


def coarser_size(size: int) -> int:
    """How many places a grid has along an axis where one of that size is halved."""
    return (size - 2) // 2 + 3


def outside(rows: slice, count: int) -> tuple[slice, slice]:
    """Those of so many rows that some are not."""
    first, last, _ = rows.indices(count)
    return slice(0, first), slice(last, count)


@dataclass(frozen=True)
class Strip:
    """Rows of a grid of so many, `count`, by their numbers there: an array has those from `low` on,
    a process `begin` to `end` as its own, and knows the stencils of `first` to `last`. Where rows
    are halved `low` is even, so that row n of the next grid lies at 2n - 1 in the arrays too:
    `low` and what follows from it serve for so many coarser grids, `depth`."""

    count: int
    low: int
    begin: int
    end: int
    first: int
    last: int
    depth: int

    @property
    def own(self) -> slice:
        """Its own rows, in arrays."""
        return slice(self.begin - self.low, self.end - self.low)

    @property
    def known(self) -> slice:
        """Those with known stencils, in arrays."""
        return slice(self.first - self.low, max(self.first, self.last) - self.low)

    def coarser(self, half: int) -> Strip:
        """That of the next grid: a stencil there depends on two rows on either side of its place;
        where rows are not halved, on one."""
        if not half:
            first = self.first + 1 if self.first else 0
            last = self.last - 1 if self.last < self.count else self.last
            return replace(self, first=first, last=last, depth=self.depth - 1)
        count = coarser_size(self.count)
        return Strip(
            count,
            self.low // 2,
            (self.begin + 1) // 2,
            (self.end + 1) // 2 if self.end < self.count else count,
            (self.first + 4) // 2 if self.first else 0,
            self.last // 2 if self.last < self.count else count,
            self.depth - 1,
        )


class Rows:
    """The rows of a grid that this process has: all of them, or, in `pbdkit.mpi.driver`, a strip
    of those that the processes of a communicator share."""

    strip: Strip | None = None
    """Which rows those are; None of all."""

    def __init__(self, communicator: Communicator = SERIAL) -> None:
        self.communicator = communicator

    @property
    def own(self) -> slice:
        """Its own, among the rows of its arrays."""
        return self.strip.own if self.strip else slice(None)

    @property
    def known(self) -> slice:
        """Those of its arrays with known stencils."""
        return self.strip.known if self.strip else slice(None)

    def exchange_halo(self, field: Array) -> None:
        """Update the halo of a field, in place."""

    def random(self, shape: tuple[int, ...]) -> Floats:
        """Return a field of numbers from [-1, 1), always the same for the same lattice."""
        return np.random.default_rng(0).uniform(-1.0, 1.0, shape)

    def whole(self, numbers: Array) -> Array:
        """Return the numbers of all rows, (..., row), from those of the rows of this process."""
        return numbers

    def total(self, numbers: Array) -> float:
        """Return the sum of one number a row."""
        return float(self.whole(numbers).sum())

    def size(self, field: Array) -> int:
        """Return how many numbers a field has."""
        return int(self.communicator.sum(field[..., self.own, :].size))

    def max_norm(self, field: Floats) -> float:
        """Return the largest magnitude; 0 of none."""
        return self.communicator.largest(float(np.abs(field[..., self.own, :]).max(initial=0.0)))

    def norm(self, field: Floats) -> float:
        """Return the root of the sum of squares."""
        with np.errstate(over="ignore"):
            own = float(np.linalg.norm(field[..., self.own, :]))
        return math.hypot(*self.communicator.allgather(own))


ALL: Final = Rows()


@cache
def _libraries(with_scipy: bool) -> ThreadpoolController:
    """Those that are loaded by now; scipy has one of its own."""
    return ThreadpoolController()


def one_thread() -> AbstractContextManager[object]:
    """Libraries of linear algebra that are loaded by now work on one thread meanwhile: on how many
    they work decides the order of their sums, and the last digits."""
    loaded = _libraries("scipy.linalg" in sys.modules)
    found: AbstractContextManager[object] = loaded.limit(limits=1, user_api="blas")
    return found


ACCURACY = 1e-2
"""Of solutions that only have to be known roughly, as a share of themselves."""
FAR, TURNS = 8.0, 4
"""Where they come to so many times less than was taken they are solved for once more, at most so
often."""


PUSH = 1e-10
"""The share of moves, known by differences perhaps, that may push a part that nothing holds."""


class StuckError(Exception):
    """An iteration got nowhere."""


class NoEquilibriumError(ExperimentError):
    """A part of the body has no equilibrium, or none that is unique."""


class IndefiniteError(StuckError):
    """Some way does not lead uphill: the body is not stable there."""


class System(ABC):
    """A c = move for the followers of a scene, linearised at a state with the roles of a step."""

    @property
    @abstractmethod
    def methods(self) -> str:
        """The names of the methods used."""

    @property
    @abstractmethod
    def how(self) -> str:
        """How the distance from the solution is obtained."""

    @property
    @abstractmethod
    def iterations(self) -> int:
        """Of all linear solvers together."""

    @property
    def is_stuck(self) -> bool:
        """Whether an iteration has got nowhere, and its method allows no other."""
        return False

    @property
    def amplification(self) -> float:
        """How much larger moves are, in rounding too, than the displacements that make them."""
        return 1.0

    @abstractmethod
    def solve(
        self, moves: Floats, tolerance: float, owed: State | None = None, rounding: float = 0.0
    ) -> Floats:
        """The correction c, to within a length. A state is `owed` to where the step looks back:
        what the invariants of parts that nothing holds have yet to gain. `rounding` is how far it
        may have put the moves off.

        Raises ExperimentError where a part is pushed on for ever.
        """

    @abstractmethod
    def answer(self, moves: Floats, share: float, near: Sequence[Floats] = ()) -> Floats:
        """A⁻¹ moves to a share of its largest number; answers that are `near`, as those of systems
        alike, save iterations."""

    @abstractmethod
    def pushed_by(self, led: Floats) -> Floats | None:
        """The moves of followers whose leaders are displaced so much, as linear as A; None where
        the system does not know of leaders."""

    @abstractmethod
    def solve_transposed(self, weights: Floats, share: float) -> Floats:
        """λ, zero but at followers, with Σ λ · moves = Σ weights · A⁻¹ moves for all moves: Aᵀ λ =
        weights, to a share of its largest number."""

    @abstractmethod
    def mismatch(self, c: Floats, before: Floats, after: Floats) -> float:
        """|A c + after - before| / |A c|: how far from linear the moves before and after a
        displacement c are."""

    @abstractmethod
    def distance(self, moves: Floats, rounding: float) -> float:
        """How far any follower is from the solution at most, given its moves and what rounding may
        have done to them."""

    @abstractmethod
    def refuse_moving_floats(self, moves: Floats, rounding: float) -> None:
        """Raises ExperimentError where a part that nothing holds has moves left: only linear rules
        tell where it ends."""

    @abstractmethod
    def is_stable(self) -> bool:
        """Whether no eigenvalue of A, as far as they are looked at, is negative: a small
        disturbance of the solution then dies away, with a relaxation that is small enough."""


def solved(system: System, moves: Floats, size: float, rows: Rows = ALL) -> Floats:
    """A⁻¹ moves, taken to come to that size, to a share of what it comes to."""
    found = system.solve(moves, ACCURACY * size)
    for _ in range(TURNS):
        most = rows.max_norm(found)
        if most * FAR >= size:
            break
        size = most
        found = system.solve(moves, ACCURACY * size)
    return found
