"""Linear system of an equilibrium, A c = move with A = 1 - (step operator), and its parts.

`Moves` evaluates the right side by means of the rule. `System` is the interface of the solvers.
`Rows` describes the rows of the lattice that a process stores, and offers the collective operations
among the processes that share the lattice. Fields are arrays (…, row, place). Sums over the whole
lattice are computed row by row, so that they do not depend on the number of processes. Moves and
displacements are planes of shape (axis, sublattice, cell, cell) as in a state.
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
from pbdkit.stepping.followers import MoveFollowers, SlotFollowers
from pbdkit.stepping.numpy_engine import Engine
from pbdkit.stepping.program import Program, moves_of
from pbdkit.stepping.state import State
from pbdkit.stepping.step import Step

LARGEST_BY_NUMPY = 20_000
"""Number of particles up to which moves are always evaluated by numpy."""
MAX_BY_NUMPY = 1_000_000
"""Number of moves, summed over evaluations, above which the next ones are evaluated by the compiled
engine. It was measured that numpy needs half a second for them, and compiling 4 to 8 s."""
ROUNDING = 4 * float(np.finfo(float).eps)
"""Relative rounding error of a move."""


class Moves:
    """Evaluation of the moves of a scene's followers.

    Moves include relaxation but not momentum. Frame points follow the body, and obstacles have
    their positions at the given moment. With `compiles`, the evaluation is compiled for large
    bodies if many states are evaluated. Compiling takes seconds; the results have the same bits.
    """

    def __init__(self, scene: Scene, *, compiles: bool = True) -> None:
        stepping = Stepping(relaxation=scene.experiment.stepping.relaxation, threads=1)
        self._scene = scene
        self._engine: Engine | None = None
        self.contact = Contact(scene) if scene.barriers else None
        renews = isinstance(scene.experiment.rule, RenewsParticles)
        self._loads = replace(scene.loads) if scene.loads else None
        stepped = replace(scene, loads=self._loads)
        large = compiles and scene.raster.count > LARGEST_BY_NUMPY
        self._compilable: Scene | None = None
        if large and not (scene.has_fracture or renews or obstacle()):
            experiment = scene.experiment.model_copy(update={"solver": stepping})
            bare = stepped.bare
            self._compilable = replace(bare, experiment=experiment, leading=_resting(scene))
        self._evaluated = 0
        sweep = MoveFollowers(stepped, SlotFollowers(stepped, stepping))
        self._operations: Program = moves_of(stepped, sweep)

    def scale_loads(self, factor: float) -> None:
        """Multiply the loads by a factor from now on."""
        if self._loads:
            self._loads.factor = factor

    def compile(self) -> bool:
        """Compile the evaluation of a large body in place of that by numpy. Return whether it is
        compiled."""
        if self._compilable:
            self._engine, _ = make_engine(self._compilable, Choice("compiled", 1, "requested"))
            self._compilable, self._operations = None, ()
        return self._engine is not None and self._engine.name == "compiled"

    def at(self, state: State, moment: float) -> Floats:
        """Return the moves at a moment as planes, zero for leaders and prescribed axes. A particle
        that would enter an obstacle moves onto its outline. Frame points of the state are
        updated."""
        moves = self.free(state, moment)
        if self.contact:
            targets = state.u + moves
            with np.errstate(all="ignore"):
                self.contact.push_out(targets, moment)
                np.subtract(targets, state.u, out=moves)
            self._stop(moves, math.ceil(moment))
        return moves

    def rounding(self, u: Floats) -> float:
        """Return the rounding error of a move at displacements u; with obstacles it includes the
        rounding error of positions."""
        reach = self.contact.reach if self.contact else 0.0
        return ROUNDING * max(float(np.abs(u).max()), reach)

    def free(self, state: State, moment: float) -> Floats:
        """Return the moves without obstacles."""
        u, frame, step = state.u, self._scene.frame, math.ceil(moment)
        if self._loads:
            self._loads.held_at = moment
        flat = u.reshape(len(u), -1)
        if frame:
            frame.follow(flat, flat)
        self._evaluated += self._scene.raster.count
        if self._evaluated > MAX_BY_NUMPY:
            self.compile()
        if self._engine:
            none = (None,) * len(self._scene.leading)
            start = replace(state, step=step - 1, previous=np.zeros_like(u), starts=none)
            moves = self._engine.advance(start).u
        else:
            moves = u.astype(float)
            for operation in self._operations:
                operation.apply(Step(step, u, moves, state))
        with np.errstate(all="ignore"):
            moves -= u
        self._stop(moves, step)
        return moves

    def _stop(self, moves: Floats, step: int) -> None:
        """Set the moves of leaders and frame points to zero. At time 0, the leaders are those of
        step 1."""
        still, frame = moves.reshape(len(moves), -1), self._scene.frame
        for leading in self._scene.leading:
            for axis in leading.axes if leading.group.leads(max(step, 1)) else ():
                still[axis, leading.place] = 0.0
        if frame:
            still[:, frame.place] = 0.0


def _resting(scene: Scene) -> tuple[Leading, ...]:
    """Return the leader groups that do not move."""
    groups = [leading.group.model_copy(update={"motion": Hold()}) for leading in scene.leading]
    pairs = zip(scene.leading, groups, strict=True)
    return tuple(replace(leading, group=group) for leading, group in pairs)


def random_displacements(scene: Scene, size: float) -> Floats:
    """Return random displacements of the followers of the last step, of at most `size` along each
    axis."""
    kinds = kinds_at(scene.raster, scene.leading, scene.experiment.steps)
    place = scene.raster.place_of(np.flatnonzero(kinds == FOLLOWER))
    displacements: Floats = np.zeros((scene.axes, *scene.raster.shape))
    random = np.random.default_rng(0).uniform(-size, size, (len(displacements), len(place)))
    displacements.reshape(len(displacements), -1)[:, place] = random
    return displacements


def coarser_size(size: int) -> int:
    """Return the number of places along an axis of the next coarser grid."""
    return (size - 2) // 2 + 3


def outside(rows: slice, count: int) -> tuple[slice, slice]:
    """Return the ranges of rows before and after the range `rows`, for a grid of `count` rows."""
    first, last, _ = rows.indices(count)
    return slice(0, first), slice(last, count)


@dataclass(frozen=True)
class Strip:
    """Rows that a process stores of a grid of `count` rows, given by their indices in the grid. The
    arrays of the process start at row `low`. It owns the rows `begin` to `end`, and has the
    stencils of the rows `first` to `last`. If the next coarser grid has half the rows, `low` is
    even. Row n of that grid then coincides with row 2n - 1 of this grid, also if rows are counted
    from the start of the arrays. This is so for `depth` coarser grids."""

    count: int
    low: int
    begin: int
    end: int
    first: int
    last: int
    depth: int

    @property
    def own(self) -> slice:
        """Range of the owned rows in arrays."""
        return slice(self.begin - self.low, self.end - self.low)

    @property
    def known(self) -> slice:
        """Range of the rows with stencils in arrays."""
        return slice(self.first - self.low, max(self.first, self.last) - self.low)

    def coarser(self, half: int) -> Strip:
        """Return the rows of the next coarser grid. If it has half the rows, a stencil of that grid
        depends on two rows of this grid on either side of its place, otherwise on one."""
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
    """Rows of a grid that a process stores. These are all rows or, in `pbdkit.mpi.driver`, a strip
    of them if the processes of a communicator share the grid."""

    strip: Strip | None = None
    """The strip; None for all rows."""

    def __init__(self, communicator: Communicator = SERIAL) -> None:
        self.communicator = communicator

    @property
    def own(self) -> slice:
        """Range of the owned rows in arrays."""
        return self.strip.own if self.strip else slice(None)

    @property
    def known(self) -> slice:
        """Range of the rows with stencils in arrays."""
        return self.strip.known if self.strip else slice(None)

    def exchange_halo(self, field: Array) -> None:
        """Update the halo of a field, in place."""

    def random(self, shape: tuple[int, ...]) -> Floats:
        """Return a field of random numbers from [-1, 1), the same for any number of processes."""
        return np.random.default_rng(0).uniform(-1.0, 1.0, shape)

    def whole(self, numbers: Array) -> Array:
        """Gather an array of shape (..., row) from each process, and return the array for all
        rows."""
        return numbers

    def total(self, numbers: Array) -> float:
        """Return the sum of numbers, one for each row, over the rows of all processes."""
        return float(self.whole(numbers).sum())

    def size(self, field: Array) -> int:
        """Return the number of entries of a field."""
        return int(self.communicator.sum(field[..., self.own, :].size))

    def max_norm(self, field: Floats) -> float:
        """Return the largest magnitude; 0 for an empty field."""
        return self.communicator.largest(float(np.abs(field[..., self.own, :]).max(initial=0.0)))

    def norm(self, field: Floats) -> float:
        """Return the root of the sum of squares."""
        with np.errstate(over="ignore"):
            norm = float(np.linalg.norm(field[..., self.own, :]))
        return math.hypot(*self.communicator.allgather(norm))


ALL: Final = Rows()
"""Rows of a lattice that is stored in a single process."""


@cache
def _libraries(with_scipy: bool) -> ThreadpoolController:
    """Return a controller of the libraries loaded so far.

    The result is cached for each value of the argument: true after scipy has loaded a library of
    its own.
    """
    return ThreadpoolController()


def one_thread() -> AbstractContextManager[object]:
    """Limit the loaded libraries of linear algebra to one thread. Otherwise the order of summation,
    and therefore the last digits of results, would depend on the number of threads."""
    loaded = _libraries("scipy.linalg" in sys.modules)
    limits: AbstractContextManager[object] = loaded.limit(limits=1, user_api="blas")
    return limits


ACCURACY = 1e-2
"""Relative accuracy of rough solutions."""
FAR = 8.0
"""A solution is computed again if the assumed size is more than this number times the actual
size."""
TURNS = 4
"""Maximum number of times that a solution is computed again."""


PUSH = 1e-10
"""A load on a floating part is ignored if its ratio to the moves is at most this number. The reason
is that moves may have an error of this size, for instance if they are computed by differences."""


class StagnationError(Exception):
    """An iteration makes no progress."""


class NoEquilibriumError(ExperimentError):
    """A part of the body has no equilibrium, or no unique one."""


class IndefiniteError(StagnationError):
    """The energy decreases along some direction: the body is not stable."""


class System(ABC):
    """Linear system A c = move for the followers of a scene, linearised at a state with the roles
    of a step."""

    @property
    @abstractmethod
    def methods(self) -> str:
        """Names of the methods used."""

    @property
    @abstractmethod
    def bound_kind(self) -> str:
        """Kind of the bound on the distance from the solution, a key of `BOUND_KINDS`."""

    @property
    @abstractmethod
    def iterations(self) -> int:
        """Number of iterations of all linear solvers."""

    @property
    def has_stagnated(self) -> bool:
        """True if an iteration makes no progress and the method has no alternative."""
        return False

    @property
    def amplification(self) -> float:
        """Largest ratio of a move to the displacement that causes it. The rounding errors of moves
        are multiplied by it."""
        return 1.0

    @abstractmethod
    def solve(
        self,
        moves: Floats,
        tolerance: float,
        invariant_state: State | None = None,
        rounding: float = 0.0,
    ) -> Floats:
        """Solve for the correction c with an error of at most `tolerance`, a length.

        `invariant_state` is given if the step also depends on the previous state: it is the current
        state, by which the invariants of floating parts have to change. `rounding` is the rounding
        error of the moves.

        Raises ExperimentError if a floating part is under a load.
        """

    @abstractmethod
    def answer(self, moves: Floats, share: float, near: Sequence[Floats] = ()) -> Floats:
        """Return x with A x = moves, with an error of at most `share` times the largest entry of x.
        Fields `near` that resemble the solution, for instance solutions of similar systems, save
        iterations."""

    @abstractmethod
    def pushed_by(self, led: Floats) -> Floats | None:
        """Return, to first order, the moves of followers that displacements of their leaders cause.
        Return None if the system does not contain leaders."""

    @abstractmethod
    def solve_transposed(self, weights: Floats, share: float) -> Floats:
        """Return λ with Aᵀ λ = weights, with an error of at most `share` times the largest entry of
        λ. λ is zero except at followers, and Σ λ · moves = Σ weights · A⁻¹ moves for all moves."""

    @abstractmethod
    def mismatch(self, c: Floats, before: Floats, after: Floats) -> float:
        """Return ‖A c + after - before‖ / ‖A c‖, a measure of the nonlinearity, where `before` and
        `after` are the moves before and after a displacement c."""

    @abstractmethod
    def distance(self, moves: Floats, rounding: float) -> float:
        """Return a bound on the distance of any follower from the solution, for moves with a
        rounding error."""

    @abstractmethod
    def refuse_moving_floats(self, moves: Floats, rounding: float) -> None:
        """Raise ExperimentError if the moves of a floating part exceed their rounding error,
        because the equilibrium of such a part is defined for linear rules only."""

    @abstractmethod
    def is_stable(self) -> bool:
        """Return whether none of the examined eigenvalues of A is negative. A small disturbance of
        the solution then decays if the relaxation is small enough."""


def solved(system: System, moves: Floats, size: float, rows: Rows = ALL) -> Floats:
    """Return the solution of A x = moves with a relative accuracy, starting from an assumed size of
    x."""
    solution = system.solve(moves, ACCURACY * size)
    for _ in range(TURNS):
        magnitude = rows.max_norm(solution)
        if magnitude * FAR >= size:
            break
        size = magnitude
        solution = system.solve(moves, ACCURACY * size)
    return solution
