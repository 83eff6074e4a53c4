"""Search for the equilibrium of given roles, bonds and obstacles.

For linear rules a single linearisation, at rest, is sufficient. For other rules there are three
methods: Newton's iteration from the previous equilibrium, pseudo-transient continuation after bonds
have broken, and an active set of constrained particles in contact with obstacles.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pbdkit.array_types import Floats
from pbdkit.equilibrium.contact_system import ContactSystem
from pbdkit.equilibrium.error_bound import (
    FIRST_ORDER,
    LINEAR,
    UNKNOWN,
    DisplacementScale,
    ErrorBound,
    RoundingError,
    UnconvergedError,
    spacing_of,
)
from pbdkit.equilibrium.linearise import linearised, mismatch_at_rest
from pbdkit.equilibrium.sparse import MatrixSystem
from pbdkit.equilibrium.system import (
    ALL,
    IndefiniteError,
    Moves,
    Rows,
    StagnationError,
    System,
    one_thread,
)
from pbdkit.progress import Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

MAX_CORRECTIONS = 12
"""Maximum number of corrections."""
MAX_PROPOSED_TOLERANCE = 0.1
"""Largest tolerance that messages propose."""
CONTRACTION = 0.5
"""Largest accepted ratio of a correction to the previous one. With smaller ratios, Newton's
iteration converges, and the equilibrium is the only one nearby (Deuflhard, Newton Methods for
Nonlinear Problems, 2004)."""
MAX_REUSE_RATIO = 0.02
"""A linearisation is used again if the ratio of the error after a correction to the error before it
is at most this number."""
MAX_CORRECTION_RTOL = 1e-3
"""Largest relative error of corrections."""
NOT_LINEAR = "the rule declares itself linear, but its moves differ from the linearisation"
"""Message for a rule that is wrongly declared linear."""
NUDGE = 1e-6
"""Displacement of leaders, in lattice spacings, for derivatives with respect to the load."""
SHARE = 0.25
"""Fraction of the tolerance that is reserved for the errors of linear systems."""
UNSTABLE = "the equilibrium is not stable"
"""Message for an unstable equilibrium."""
ROUNDING = "rounding errors limit the relative distance"
"""Message for a tolerance that cannot be reached because of rounding."""
MAX_ROUNDING_RATIO = 1e5
"""Largest ratio of the distance to the rounding error up to which rounding is regarded as the
reason why the search does not converge. Above it the body may be near a limit point, and a smaller
increment could converge."""
MAX_IMPLICIT_STEPS = 200
"""Maximum number of implicit steps."""
MAX_MOVE = 0.2
"""Longest move of an implicit step, in lattice spacings."""
MIN_DAMPING = 1e-10
"""Smallest damping, relative to the stiffness of a particle in the interior at rest."""
MIN_DAMPING_RATIO = 0.05
"""Smallest ratio of a damping to the previous one."""
DAMPING_FACTOR = 0.5
"""If moves decrease, the next damping is the current one, times the ratio of the new moves to the
old ones, times this factor."""
MAX_DAMPING_RATIO = 2.0
"""Largest ratio of a damping to the previous one."""
NEGLIGIBLE_STIFFNESS = 1e-6
"""Motions with a smaller stiffness, in the units of the damping, are excluded from an error
bound."""
MAX_SOFT_RATIO = 100.0
"""A bound that excludes soft motions is computed only if the moves are small: at most this number
times the moves that a soft motion of the size of the tolerance causes."""


@dataclass(frozen=True)
class Finder:
    """Search for equilibria of a scene. `method` is the method of the solver settings, and
    `tolerance` the largest distance from equilibrium, a length.

    Relative values are lengths divided by `scale`. `compiles` is passed to `Moves`, and `rows` are
    the rows of the scene within this process. `at_rest` contains the last system that was
    linearised at rest, and `rest` the data on which it depends.
    """

    scene: Scene
    tolerance: float
    scale: DisplacementScale
    method: str
    watch: Watch
    compiles: bool = True
    rows: Rows = ALL
    at_rest: list[System] = field(default_factory=list, repr=False, compare=False)
    rest: list[RestSystem] = field(default_factory=list, repr=False, compare=False)

    @cached_property
    def moves(self) -> Moves:
        """Evaluation of the moves of the scene."""
        return Moves(self.scene, compiles=self.compiles)

    @cached_property
    def linear(self) -> bool:
        """True if the rule is linear and there are no obstacles.

        A rule that is not declared linear is tested at random displacements of the size of the
        load.
        """
        scene = self.scene
        if scene.barriers:
            return False
        if scene.experiment.rule.linear:
            return True
        off = mismatch_at_rest(scene, self.moves, self.scale, self.method, self.watch)
        return off <= LINEAR

    def at(self, moment: float) -> Finder:
        """Return the finder with the parameters at a moment, which is a time in steps and need not
        be an integer."""
        scene = self.scene.at(moment)
        return self if scene is self.scene else replace(self, scene=scene)

    def find(self, state: State, moment: float) -> ErrorBound:
        """Move the followers of `state`, in place, to the equilibrium with the roles, loads and
        parameters of a moment. Corrections are computed with the linearisation at rest, which is
        exact for linear rules.

        Raises ExperimentError if a part has no equilibrium, UnconvergedError and StoppedError.
        """
        with one_thread():
            return _Linear(self.at(moment), state, moment).run()

    def relax(self, state: State, moment: float) -> ErrorBound:
        """Move the followers by implicit steps to the equilibrium that sufficiently small steps
        approach. This method is used for rules that are not linear, after bonds have just broken.

        Raises UnconvergedError.
        """
        with one_thread():
            return _Relaxing(self.at(moment), state, moment).run()

    def follow(self, state: State, moment: float, before: State) -> ErrorBound:
        """Move the followers by Newton's iteration, for rules that are not linear and a small
        change of the load since the equilibrium at the moment `before`. Each correction has to be
        much smaller than the previous one, so that no other equilibrium is nearer. The result is
        stable."""
        with one_thread():
            try:
                return _Newton(self.at(moment), state, moment, before).run()
            except IndefiniteError:
                raise UnconvergedError(UNSTABLE) from None


@dataclass(frozen=True)
class RestSystem:
    """Data that determine a system at rest: the scene with its parameters, the leader groups that
    act, the bonds, and the methods of the solver. If they are unchanged, a later search uses the
    system again."""

    scene: Scene
    leads: tuple[bool, ...]
    bonds: tuple[Floats, ...]
    methods: str

    @classmethod
    def of(cls, finder: Finder, state: State, moment: float, methods: str) -> RestSystem:
        """Return the data of a state with the roles of a moment's step."""
        leads = tuple(led.group.leads(math.ceil(moment)) for led in finder.scene.leading)
        broken = () if state.broken_step is None else (state.broken_step >= 0,)
        bonds = (*broken, *(value.copy() for value in state.bond_values))
        return cls(finder.scene, leads, bonds, methods)

    def serves(self, other: RestSystem) -> bool:
        """Return whether `self` and `other` determine the same system."""
        same = self.scene is other.scene and (self.leads, self.methods) == (
            other.leads,
            other.methods,
        )
        return same and all(map(np.array_equal, self.bonds, other.bonds))


class Search(ABC):
    """Search from a state, in place, for an equilibrium with the roles of a moment's step."""

    _linear = False

    def __init__(self, finder: Finder, state: State, moment: float, at: State, what: str) -> None:
        self._finder, self._state, self._moment = finder, state, moment
        self._linearisations = self._inner = 0
        self._system = self._linearised(at, what)
        self._residual = self._moves()
        self._last_distance: tuple[float, Floats | None, System | None] = math.inf, None, None
        """The last distance, with the moves and the system for which it was computed."""

    @abstractmethod
    def run(self) -> ErrorBound:
        """Move the state to the equilibrium, and return its error bound."""

    def _checked_error_bound(self) -> ErrorBound:
        error_bound = self._error_bound(self._distance())
        if not error_bound.distance <= self._finder.tolerance:
            best = self._floor() / self._finder.scale
            is_near = error_bound.distance <= MAX_ROUNDING_RATIO * self._rounding()
            kind = RoundingError if is_near and self._is_rounding(best) else UnconvergedError
            raise kind(self._why(best), error_bound)
        return error_bound

    def _floor(self) -> float:
        """Return the part of the distance that is caused by rounding of the moves."""
        with suppress(StagnationError):
            nothing = np.zeros_like(self._residual)
            distance = self._system.distance(nothing, self._rounding())
            return distance * (1.0 if self._linear else FIRST_ORDER)
        return 0.0

    def _is_rounding(self, share: float) -> bool:
        """Return whether rounding errors that cause the relative distance `share` prevent
        convergence to the tolerance."""
        finite = math.isfinite(self._finder.rows.max_norm(self._residual))
        return (
            finite
            and not self._system.has_stagnated
            and share * self._finder.scale > SHARE * self._finder.tolerance
        )

    def _error_bound(self, distance: float) -> ErrorBound:
        return ErrorBound(
            method=self._system.methods,
            iterations=self._linearisations,
            inner_iterations=self._inner + self._system.iterations,
            residual=self._finder.rows.max_norm(self._residual),
            distance=distance,
            share=distance / self._finder.scale,
            bound=self._system.bound_kind,
            linearised=not self._linear,
            scale=self._finder.scale.meaning,
        )

    def _why(self, best: float) -> str:
        finder = self._finder
        if not math.isfinite(finder.rows.max_norm(self._residual)):
            return "displacements are not finite"
        if self._system.has_stagnated:
            return (
                f"{self._system.methods} does not converge, as for slender or soft bodies; "
                "set solver.method: lu"
            )
        if self._is_rounding(best):
            return f"{ROUNDING} to {best:.1g}{_reachable(best)}"
        return "no correction reduces the residual"

    def _linearised(self, at: State, what: str) -> System:
        finder = self._finder
        finder.watch.begin(what)
        if self._linearisations:
            self._inner += self._system.iterations
        self._linearisations += 1
        how = finder.method, finder.watch, finder.moves, finder.rows
        return linearised(finder.scene, at, self._moment, *how)

    def _shift(self, correction: Floats) -> None:
        self._state.u += correction
        self._finder.rows.exchange_halo(self._state.u)
        self._residual = self._moves()

    def _moves(self) -> Floats:
        with self._finder.rows.communicator.raise_together():
            return self._finder.moves.at(self._state, self._moment)

    def _distance(self) -> float:
        distance, of, by = self._last_distance
        if of is not self._residual or by is not self._system:
            distance = self._system.distance(self._residual, self._rounding())
            self._last_distance = distance, self._residual, self._system
        return (
            math.inf if math.isnan(distance) else distance * (1.0 if self._linear else FIRST_ORDER)
        )

    @property
    def _wanted(self) -> float:
        """Required accuracy of linear systems. It is a fraction of the tolerance; the rest is for
        the other terms of the error bound."""
        return SHARE * self._finder.tolerance

    def _rounding(self) -> float:
        finder, u = self._finder, self._state.u[..., self._finder.rows.own, :]
        return self._system.amplification * finder.rows.communicator.largest(
            finder.moves.rounding(u)
        )


def _reachable(share: float) -> str:
    """Return the end of the message about a tolerance that is not reached: a tolerance for which
    the relative bound `share` suffices or, if there is none, the cause."""
    tolerance = 10.0 ** math.ceil(math.log10(share / SHARE)) if 0.0 < share < math.inf else 1.0
    if tolerance < MAX_PROPOSED_TOLERANCE:
        return f"; set solver.tolerance: {tolerance:.0e}"
    return ": the body is too slender or soft for double precision"


class _Linear(Search):
    """Search by one linearisation."""

    def __init__(self, finder: Finder, state: State, moment: float) -> None:
        at_rest = replace(state, u=np.zeros_like(state.u))
        super().__init__(finder, state, moment, at_rest, "assembling")
        finder.at_rest[:] = [self._system]
        finder.rest[:] = [RestSystem.of(finder, state, moment, self._system.methods)]
        self._invariant_state: State | None = state.copy()

    def _linearised(self, at: State, what: str) -> System:
        """Return the system. It is factorised again only if roles, parameters or bonds have
        changed."""
        systems = self._finder.at_rest
        if systems and self._finder.rest:
            rest = RestSystem.of(self._finder, at, self._moment, systems[0].methods)
            if self._finder.rest[0].serves(rest):
                self._linearisations, self._inner = 1, -systems[0].iterations
                return systems[0]
        return super()._linearised(at, what)

    def run(self) -> ErrorBound:
        """Correct until the tolerance is reached."""
        self._linear = True
        start = self._residual, self._state.u, self._state.previous
        if self._finder.rows.communicator.any(any(planes.any() for planes in start)):
            self._correct()  # Otherwise the initial state is already the equilibrium.
        return self._checked_error_bound()

    def _correct(self) -> None:
        for n in range(MAX_CORRECTIONS):
            moves, previous = self._residual, self._finder.rows.norm(self._residual)
            correction = self._system.solve(
                moves, self._wanted, self._invariant_state, self._rounding()
            )
            self._shift(correction)
            self._invariant_state = None
            norm = self._finder.rows.norm(self._residual)
            floor = self._rounding() * math.sqrt(self._finder.rows.size(self._residual))
            if n == 0 and previous > 1e3 * floor:
                mismatch = self._system.mismatch(correction, moves, self._residual)
                if not mismatch <= LINEAR + floor / previous:
                    raise UnconvergedError(NOT_LINEAR, self._error_bound(self._distance()))
            if not norm <= 0.5 * previous or self._distance() <= self._finder.tolerance:
                return


class _Newton(Search):
    """Newton's iteration that starts from an equilibrium nearby."""

    def __init__(self, finder: Finder, state: State, moment: float, before: State) -> None:
        super().__init__(finder, state, moment, before, "following the load")
        self._before, self._leader_change = before, state.u - before.u
        self._load_change = float(np.abs(self._leader_change).max())
        """Largest change of the displacements of leaders or, under loads, of followers."""

    def run(self) -> ErrorBound:
        """Correct until the tolerance is reached.

        Raises UnconvergedError if corrections do not shrink or the result is not stable.
        """
        self._go_ahead()
        self._correct()
        error_bound = self._checked_error_bound()
        if not self._system.is_stable():
            raise UnconvergedError(UNSTABLE, error_bound)
        return error_bound

    def _go_ahead(self) -> None:
        """Predict the equilibrium at the end of the increment from the previous equilibrium. The
        moves are computed for a small part of the increment and extrapolated."""
        nudge = NUDGE * self._finder.scene.neighbourhood.nudge_unit
        moves, part = (
            self._finder.moves,
            min(1.0, nudge / self._load_change) if self._load_change else 1.0,
        )
        moves_before = moves.at(self._before, self._moment)
        nudged = replace(self._before, u=self._before.u + part * self._leader_change)
        pull = moves_before + (moves.at(nudged, self._moment) - moves_before) / part
        wanted = max(self._wanted, MAX_CORRECTION_RTOL * self._load_change)
        correction = self._system.solve(pull, wanted, None, self._rounding() / part)
        if self._finder.scene.loads:
            self._load_change = max(self._load_change, float(np.abs(correction).max(initial=0.0)))
        self._shift(correction)

    def _correct(self) -> None:
        distance, size, previous_distance = math.inf, math.inf, self._load_change
        for _ in range(MAX_CORRECTIONS):
            if distance > MAX_REUSE_RATIO * previous_distance:
                self._system = self._linearised(self._state, "following the load")
                self._system.refuse_moving_floats(self._residual, self._rounding())
                distance = self._distance()
            if distance <= self._finder.tolerance or not math.isfinite(distance):
                return
            # The accuracy of a solution is adapted to the nonlinearity of the moves (Eisenstat and
            # Walker, 1996).
            share = (
                min(MAX_CORRECTION_RTOL, (distance / previous_distance) ** 2)
                if previous_distance
                else MAX_CORRECTION_RTOL
            )
            wanted = max(self._wanted, share * distance)
            correction = self._system.solve(self._residual, wanted, None, self._rounding())
            previous, size = size, float(np.abs(correction).max(initial=0.0))
            if not size <= CONTRACTION * min(previous, self._load_change or math.inf):
                if size <= self._floor():
                    return  # The difference is only rounding.
                reason = "corrections do not decrease"
                raise UnconvergedError(reason, self._error_bound(math.inf))
            self._shift(correction)
            previous_distance, distance = distance, self._distance()


class _Relaxing(Search):
    """Pseudo-transient continuation (Kelley and Keyes, 1998): implicit steps, (A + damping) c =
    move, with a damping that is reduced as the moves become smaller.

    Floating parts, and parts that are connected by one bond only, have free motions. They are
    therefore moved by implicit steps only.
    """

    def __init__(self, finder: Finder, state: State, moment: float) -> None:
        self._damping = 1.0
        super().__init__(finder, state, moment, state, "relaxing after bonds broke")

    def _linearised(self, at: State, what: str) -> System:
        finder = self._finder
        finder.watch.begin(what)
        self._linearisations += 1
        step, method = math.ceil(self._moment), finder.method
        return MatrixSystem(finder.scene, at, method, finder.watch, step, self._damping)

    def run(self) -> ErrorBound:
        """Make implicit steps until the tolerance is reached.

        Raises UnconvergedError if moves do not decay or the result is not stable.
        """
        leap = MAX_MOVE * spacing_of(self._finder.scene)
        size = self._finder.rows.norm(self._residual)
        for _ in range(MAX_IMPLICIT_STEPS):
            if self._is_near():
                break
            correction = self._system.solve(self._residual, self._wanted, None, self._rounding())
            longest = float(np.abs(correction).max(initial=0.0))
            if not math.isfinite(longest):
                break
            self._shift(correction * min(1.0, leap / longest if longest else 1.0))
            previous, size = size, self._finder.rows.norm(self._residual)
            share = size / previous if previous and longest <= leap else 1.0
            if share < 1.0:
                share = max(MIN_DAMPING_RATIO, DAMPING_FACTOR * share)
            else:
                share = min(MAX_DAMPING_RATIO, share)
            self._damping = min(1.0, max(MIN_DAMPING, self._damping * share))
            self._system = self._linearised(self._state, "relaxing after bonds broke")
        error_bound = self._checked_error_bound()
        if not self._system.is_stable():
            raise UnconvergedError(UNSTABLE, error_bound)
        return error_bound

    def _is_near(self) -> bool:
        """Return whether the tolerance is reached if motions of almost no stiffness are excluded
        from the error bound."""
        longest, tolerance = self._finder.rows.max_norm(self._residual), self._finder.tolerance
        if longest > MAX_SOFT_RATIO * NEGLIGIBLE_STIFFNESS * tolerance:
            return False
        self._damping = NEGLIGIBLE_STIFFNESS
        self._system = self._linearised(self._state, "relaxing after bonds broke")
        return self._distance() <= tolerance


MAX_SETS = 60
"""Maximum number of changes of the active set."""
MIN_PART = 2.0**-6
"""Smallest fraction of a correction that is applied. Fractions are applied if the complete
correction would separate particles from obstacles that hold them."""
MAX_CYCLE_RATIO = 1e-3
"""Corrections repeat themselves if the active set changes and the state is that of an earlier set,
up to this fraction of the tolerance."""


def follow_contact(finder: Finder, state: State, moment: float) -> ErrorBound:
    """Move the followers of `state`, in place, to a stable equilibrium nearby, with obstacles at a
    moment.

    Raises ExperimentError if there is no unique equilibrium, UnconvergedError and StoppedError.
    """
    with one_thread():
        try:
            return _ContactSearch(finder, state, moment, state, "finding the contact").run()
        except IndefiniteError:
            raise UnconvergedError(UNSTABLE, UNKNOWN) from None


class _ContactSearch(Search):
    """Newton's iteration with an active set, which contains the particles in contact. Particles
    that would enter an obstacle are added to the set and constrained, until the set does not change
    any more. Floating parts that no obstacle holds yet are moved with weak springs."""

    def run(self) -> ErrorBound:
        """Correct until the active set and the state converge.

        Raises UnconvergedError if the active set does not become constant, corrections do not
        shrink afterwards, or the result is not stable.
        """
        contacts, size, went_loose = None, math.inf, False
        system, earlier = self._newest(), self._state.u
        for n in range(MAX_SETS):
            loose = system.is_loose(self._residual, self._rounding())
            if not loose and not self._finder.tolerance < self._distance() < math.inf:
                break
            same = contacts is not None and np.array_equal(contacts, system.held)
            contacts = system.held
            if n and not same and self._returned_to(earlier):
                break
            if n & (n - 1) == 0:  # at powers of two: finds cycles of any length (Brent, 1980)
                earlier = self._state.u.copy()
            if loose:
                went_loose = True
                correction = system.solve_loose(self._residual, spacing_of(self._finder.scene))
            else:
                correction = system.solve(self._residual, self._wanted, None, self._rounding())
            previous, size = size, float(np.abs(correction).max(initial=0.0))
            if same and not loose and not size <= CONTRACTION * previous:
                break
            self._go(correction)
            part, system = 1.0, self._newest()
            while (
                not loose and part > MIN_PART and system.is_loose(self._residual, self._rounding())
            ):
                part /= 2.0  # A larger one would separate particles from obstacles.
                self._go(-part * correction)
                system = self._newest()
        if went_loose:
            system.refuse_floats()
        # A step would place particles in contact exactly on the outline. The linear solution moves
        # them along its tangent, so that they have to be placed on it.
        self._shift(system.of_held(self._residual))
        error_bound = self._checked_error_bound()
        if not system.is_stable():
            raise UnconvergedError(UNSTABLE, error_bound)
        return error_bound

    def _returned_to(self, u: Floats) -> bool:
        """Return whether the displacements are `u`, so that the sets since then follow again."""
        change = self._finder.rows.max_norm(self._state.u - u)
        return change <= MAX_CYCLE_RATIO * self._finder.tolerance

    def _go(self, correction: Floats) -> None:
        system = self._newest()
        self._shift(correction)
        self._shift(system.of_held(self._residual))
        self._system = self._linearised(self._state, "finding the contact")

    def _newest(self) -> ContactSystem:
        assert isinstance(self._system, ContactSystem)
        return self._system
