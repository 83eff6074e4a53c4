"""Search for the equilibrium of given roles, bonds and obstacles.

Linear rules need one linearisation, at rest. Others are followed from the equilibrium before by
Newton's iteration, bodies whose bonds have just broken by pseudo-transient continuation, and bodies
before obstacles by an active set of held particles.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pbdkit.array_types import Floats
from pbdkit.equilibrium.certificate import (
    FIRST_ORDER,
    LINEAR,
    UNKNOWN,
    Certificate,
    RoundingError,
    UnconvergedError,
    spacing_of,
)
from pbdkit.equilibrium.contact_system import ContactSystem
from pbdkit.equilibrium.linearise import linearised, mismatch_at_rest
from pbdkit.equilibrium.sparse import MatrixSystem
from pbdkit.equilibrium.system import (
    ALL,
    IndefiniteError,
    Moves,
    Rows,
    StuckError,
    System,
    one_thread,
)
from pbdkit.progress import Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

MOST_CORRECTIONS = 12
LOOSEST = 0.1
"""No tolerance from here on is proposed."""
CONTRACTION = 0.5
"""What share of the last a correction may be: then there is one equilibrium nearby, and Newton's
iteration leads there (Deuflhard)."""
SERVES, NEAR = 0.02, 1e-3
"""What share of an error a correction may leave for its linearisation to serve once more; how
accurately corrections are solved for at least, as a share of themselves."""
NOT_LINEAR = "the rule declares itself linear, and does not move as its linearisation says"
NUDGE, SHARE = 1e-6, 0.25
"""By so much, in lattice spacings, leaders are moved to see what their way does to others; the
share of the tolerance that linear systems have."""
UNSTABLE = "what is found is not stable"
ROUNDING = "rounding alone allows no better"
FIRM = 1e5
"""Distance over rounding up to which a body counts as firm: farther, it may be about to give way,
so that a shorter way could help."""
MOST_IMPLICIT_STEPS = 200
LEAP = 0.2
"""The longest move of an implicit step, in lattice spacings."""
LEAST_DAMPING, FASTEST, FALL, SLOWEST = 1e-10, 0.05, 0.5, 2.0
"""The least damping, relative to the stiffness of a particle among others at rest. Between implicit
steps it falls by this share of what the moves do, and no faster than this; it rises with them, up
to twofold."""
NEXT_TO_NOTHING, MUCH = 1e-6, 100.0
"""The stiffness, as a damping, below which motions are left out of a certificate. It is tried once
the moves are so many times what softer ones would allow."""


@dataclass(frozen=True)
class Finder:
    """Looks for equilibria of a scene, to within a length, by one of the solver's methods, shares
    being of the length `scale`; `compiles` is of the moves; `rows` are those of the scene;
    `at_rest` the last system there, and `rest` of what it is the system."""

    scene: Scene
    tolerance: float
    scale: float
    method: str
    watch: Watch
    compiles: bool = True
    rows: Rows = ALL
    at_rest: list[System] = field(default_factory=list, repr=False, compare=False)
    rest: list[Rest] = field(default_factory=list, repr=False, compare=False)

    @cached_property
    def moves(self) -> Moves:
        """Of the scene's followers."""
        return Moves(self.scene, compiles=self.compiles)

    @cached_property
    def linear(self) -> bool:
        """Whether the rule is, and there is no obstacle: it says so, or followers put elsewhere, at
        random and as far as the load goes, move by what the linearisation at rest says."""
        scene = self.scene
        if scene.barriers:
            return False
        if scene.experiment.rule.linear:
            return True
        off = mismatch_at_rest(scene, self.moves, self.scale, self.method, self.watch)
        return off <= LINEAR

    def at(self, moment: float) -> Finder:
        """The same with the numbers of a moment."""
        now = self.scene.at(moment)
        return self if now is self.scene else replace(self, scene=now)

    def find(self, state: State, moment: float) -> Certificate:
        """Moves the followers of `state`, in place, to where they rest with the roles, loads and
        numbers of a moment, by the linearisation at rest, exact for linear rules. Raises
        ExperimentError where a part has no equilibrium, UnconvergedError and StoppedError."""
        with one_thread():
            return _Linear(self.at(moment), state, moment).run()

    def relax(self, state: State, moment: float) -> Certificate:
        """The same for rules that are not linear, from a state in which bonds have just broken, by
        implicit steps: to where steps lead that are small enough. Raises UnconvergedError."""
        with one_thread():
            return _Relaxing(self.at(moment), state, moment).run()

    def follow(self, state: State, moment: float, before: State) -> Certificate:
        """The same for rules that are not linear, from the equilibrium `before` all went on a
        little: by Newton's iteration, as long as each correction is much smaller than the last,
        so that no other equilibrium is nearer. What is found is stable."""
        with one_thread():
            try:
                return _Newton(self.at(moment), state, moment, before).run()
            except IndefiniteError:
                raise UnconvergedError(UNSTABLE) from None


@dataclass(frozen=True)
class Rest:
    """What a system at rest depends on, so that a later search takes it up again: the scene with
    its numbers, which groups lead, the bonds, and by which methods it was to be solved."""

    scene: Scene
    leads: tuple[bool, ...]
    bonds: tuple[Floats, ...]
    methods: str

    @classmethod
    def of(cls, finder: Finder, state: State, moment: float, methods: str) -> Rest:
        """That of a state with the roles of a moment's step."""
        leads = tuple(led.group.leads(math.ceil(moment)) for led in finder.scene.leading)
        broken = () if state.broken_step is None else (state.broken_step >= 0,)
        bonds = (*broken, *(value.copy() for value in state.bond_values))
        return cls(finder.scene, leads, bonds, methods)

    def serves(self, other: Rest) -> bool:
        """Whether both have the same system."""
        same = self.scene is other.scene and (self.leads, self.methods) == (
            other.leads,
            other.methods,
        )
        return same and all(map(np.array_equal, self.bonds, other.bonds))


class Search(ABC):
    """Goes from a state, in place, to an equilibrium, with the roles of a moment's step."""

    _linear = False

    def __init__(self, finder: Finder, state: State, moment: float, at: State, what: str) -> None:
        self._finder, self._state, self._moment = finder, state, moment
        self._linearisations = self._inner = 0
        self._system = self._linearised(at, what)
        self._left = self._moves()
        self._known: tuple[float, Floats | None, System | None] = math.inf, None, None
        """The last distance, of which moves, by which system."""

    @abstractmethod
    def run(self) -> Certificate:
        """To the equilibrium."""

    def _certified(self) -> Certificate:
        certificate = self._certificate(self._distance())
        if not certificate.distance <= self._finder.tolerance:
            best = self._floor() / self._finder.scale
            is_near = certificate.distance <= FIRM * self._rounding()
            kind = RoundingError if is_near and self._is_rounding(best) else UnconvergedError
            raise kind(self._why(best), certificate)
        return certificate

    def _floor(self) -> float:
        """The distance that rounding of the moves alone makes."""
        with suppress(StuckError):
            nothing = np.zeros_like(self._left)
            found = self._system.distance(nothing, self._rounding())
            return found * (1.0 if self._linear else FIRST_ORDER)
        return 0.0

    def _is_rounding(self, share: float) -> bool:
        """Whether rounding by that share is what keeps the tolerance from being reached."""
        finite = math.isfinite(self._finder.rows.max_norm(self._left))
        return (
            finite
            and not self._system.is_stuck
            and share * self._finder.scale > SHARE * self._finder.tolerance
        )

    def _certificate(self, distance: float) -> Certificate:
        return Certificate(
            method=self._system.methods,
            iterations=self._linearisations,
            inner_iterations=self._inner + self._system.iterations,
            residual=self._finder.rows.max_norm(self._left),
            distance=distance,
            share=distance / self._finder.scale,
            bound=self._system.how,
            linearised=not self._linear,
        )

    def _why(self, best: float) -> str:
        finder = self._finder
        if not math.isfinite(finder.rows.max_norm(self._left)):
            return "it left the finite numbers"
        if self._system.is_stuck:
            return (
                f"{self._system.methods} got stuck, as where a body is slender or soft; take "
                "solver.method: lu"
            )
        if self._is_rounding(best):
            return f"{ROUNDING} than {best:.1g}{_reachable(best)}"
        return "no correction makes the moves smaller"

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
        self._left = self._moves()

    def _moves(self) -> Floats:
        with self._finder.rows.communicator.raise_together():
            return self._finder.moves.at(self._state, self._moment)

    def _distance(self) -> float:
        known, of, by = self._known
        if of is not self._left or by is not self._system:
            known = self._system.distance(self._left, self._rounding())
            self._known = known, self._left, self._system
        return math.inf if math.isnan(known) else known * (1.0 if self._linear else FIRST_ORDER)

    @property
    def _wanted(self) -> float:
        """How near a linear system must be solved: what the certificate adds has room besides."""
        return SHARE * self._finder.tolerance

    def _rounding(self) -> float:
        finder, own = self._finder, self._state.u[..., self._finder.rows.own, :]
        return self._system.amplification * finder.rows.communicator.largest(
            finder.moves.rounding(own)
        )


def _reachable(share: float) -> str:
    """A tolerance with room for a bound of so much, in words; a remedy where there is none."""
    tolerance = 10.0 ** math.ceil(math.log10(share / SHARE)) if 0.0 < share < math.inf else 1.0
    if tolerance < LOOSEST:
        return f"; take solver.tolerance: {tolerance:.0e}"
    return ": the body is too slender or soft for double precision"


class _Linear(Search):
    """By one linearisation."""

    def __init__(self, finder: Finder, state: State, moment: float) -> None:
        at_rest = replace(state, u=np.zeros_like(state.u))
        super().__init__(finder, state, moment, at_rest, "assembling")
        finder.at_rest[:] = [self._system]
        finder.rest[:] = [Rest.of(finder, state, moment, self._system.methods)]
        self._owed: State | None = state.copy()

    def _linearised(self, at: State, what: str) -> System:
        """Factorised once for as long as roles, numbers and bonds stay."""
        known = self._finder.at_rest
        if known and self._finder.rest:
            here = Rest.of(self._finder, at, self._moment, known[0].methods)
            if self._finder.rest[0].serves(here):
                self._linearisations, self._inner = 1, -known[0].iterations
                return known[0]
        return super()._linearised(at, what)

    def run(self) -> Certificate:
        """Corrects until the tolerance is reached."""
        self._linear = True
        start = self._left, self._state.u, self._state.previous
        if self._finder.rows.communicator.any(any(planes.any() for planes in start)):
            self._correct()  # else nothing is prescribed but rest
        return self._certified()

    def _correct(self) -> None:
        for n in range(MOST_CORRECTIONS):
            moves, before = self._left, self._finder.rows.norm(self._left)
            correction = self._system.solve(moves, self._wanted, self._owed, self._rounding())
            self._shift(correction)
            self._owed = None
            after = self._finder.rows.norm(self._left)
            floor = self._rounding() * math.sqrt(self._finder.rows.size(self._left))
            if n == 0 and before > 1e3 * floor:
                off = self._system.mismatch(correction, moves, self._left)
                if not off <= LINEAR + floor / before:
                    raise UnconvergedError(NOT_LINEAR, self._certificate(self._distance()))
            if not after <= 0.5 * before or self._distance() <= self._finder.tolerance:
                return


class _Newton(Search):
    """By linearisations at each state it comes to, from an equilibrium nearby."""

    def __init__(self, finder: Finder, state: State, moment: float, before: State) -> None:
        super().__init__(finder, state, moment, before, "following the load")
        self._before, self._led = before, state.u - before.u
        self._way = float(np.abs(self._led).max())
        """How far leaders went on, or others under loads that did."""

    def run(self) -> Certificate:
        """Raises UnconvergedError where corrections do not shrink, or lead to nothing stable."""
        self._go_ahead()
        self._correct()
        certificate = self._certified()
        if not self._system.is_stable():
            raise UnconvergedError(UNSTABLE, certificate)
        return certificate

    def _go_ahead(self) -> None:
        """As far as the equilibrium before says, leaders their whole way: by what moves a small
        part of it makes."""
        nudge = NUDGE * self._finder.scene.neighbourhood.nudge_unit
        moves, part = self._finder.moves, min(1.0, nudge / self._way) if self._way else 1.0
        here = moves.at(self._before, self._moment)
        nudged = replace(self._before, u=self._before.u + part * self._led)
        pull = here + (moves.at(nudged, self._moment) - here) / part
        wanted = max(self._wanted, NEAR * self._way)
        correction = self._system.solve(pull, wanted, None, self._rounding() / part)
        if self._finder.scene.loads:
            self._way = max(self._way, float(np.abs(correction).max(initial=0.0)))
        self._shift(correction)

    def _correct(self) -> None:
        far, size, farther = math.inf, math.inf, self._way
        for _ in range(MOST_CORRECTIONS):
            if far > SERVES * farther:
                self._system = self._linearised(self._state, "following the load")
                self._system.refuse_moving_floats(self._left, self._rounding())
                far = self._distance()
            if far <= self._finder.tolerance or not math.isfinite(far):
                return
            # Solved as well as it is linear (Eisenstat and Walker).
            share = min(NEAR, (far / farther) ** 2) if farther else NEAR
            wanted = max(self._wanted, share * far)
            correction = self._system.solve(self._left, wanted, None, self._rounding())
            before, size = size, float(np.abs(correction).max(initial=0.0))
            if not size <= CONTRACTION * min(before, self._way or math.inf):
                if size <= self._floor():
                    return  # of rounding
                reason = "corrections do not become smaller"
                raise UnconvergedError(reason, self._certificate(math.inf))
            self._shift(correction)
            farther, far = far, self._distance()


class _Relaxing(Search):
    """Pseudo-transient continuation (Kelley and Keyes, 1998): implicit steps, (A + damping) c =
    move, with a damping that falls with the moves.

    Parts that hang by one bond, or that nothing holds, stay where implicit steps have them.
    """

    def __init__(self, finder: Finder, state: State, moment: float) -> None:
        self._damping = 1.0
        super().__init__(finder, state, moment, state, "relaxing what broke")

    def _linearised(self, at: State, what: str) -> System:
        finder = self._finder
        finder.watch.begin(what)
        self._linearisations += 1
        step, method = math.ceil(self._moment), finder.method
        return MatrixSystem(finder.scene, at, method, finder.watch, step, self._damping)

    def run(self) -> Certificate:
        """Raises UnconvergedError where moves do not die away, or do so where nothing is stable."""
        leap, size = LEAP * spacing_of(self._finder.scene), self._finder.rows.norm(self._left)
        for _ in range(MOST_IMPLICIT_STEPS):
            if self._is_near():
                break
            correction = self._system.solve(self._left, self._wanted, None, self._rounding())
            most = float(np.abs(correction).max(initial=0.0))
            if not math.isfinite(most):
                break
            self._shift(correction * min(1.0, leap / most if most else 1.0))
            before, size = size, self._finder.rows.norm(self._left)
            share = size / before if before and most <= leap else 1.0
            share = max(FASTEST, FALL * share) if share < 1.0 else min(SLOWEST, share)
            self._damping = min(1.0, max(LEAST_DAMPING, self._damping * share))
            self._system = self._linearised(self._state, "relaxing what broke")
        certificate = self._certified()
        if not self._system.is_stable():
            raise UnconvergedError(UNSTABLE, certificate)
        return certificate

    def _is_near(self) -> bool:
        """Whether the tolerance is reached but for motions that cost next to nothing."""
        most, tolerance = self._finder.rows.max_norm(self._left), self._finder.tolerance
        if most > MUCH * NEXT_TO_NOTHING * tolerance:
            return False
        self._damping = NEXT_TO_NOTHING
        self._system = self._linearised(self._state, "relaxing what broke")
        return self._distance() <= tolerance


MOST_SETS = 60
"""So often who is held by obstacles may change."""
LEAST_PART = 2.0**-6
"""Smallest part of a correction that is tried where the whole takes particles off obstacles that
hold them."""


def follow_contact(finder: Finder, state: State, moment: float) -> Certificate:
    """Moves the followers of `state`, in place, to an equilibrium nearby that is stable, with
    obstacles where they are at a moment.

    Raises ExperimentError where there is no unique one, UnconvergedError and StoppedError.
    """
    with one_thread():
        try:
            return _ContactSearch(finder, state, moment, state, "finding the contact").run()
        except IndefiniteError:
            raise UnconvergedError(UNSTABLE, UNKNOWN) from None


class _ContactSearch(Search):
    """By linearisations at each state it comes to, with those held who would enter an obstacle,
    until nobody else would. What nothing holds yet is led on by weak springs."""

    def run(self) -> Certificate:
        """Raises UnconvergedError where who is held goes on changing, where corrections do not
        become smaller once it stays, or where what they lead to is not stable."""
        held, size, went_loose = None, math.inf, False
        system = self._newest()
        for _ in range(MOST_SETS):
            loose = system.is_loose(self._left, self._rounding())
            if not loose and not self._finder.tolerance < self._distance() < math.inf:
                break
            same, held = held is not None and np.array_equal(held, system.held), system.held
            if loose:
                went_loose = True
                correction = system.solve_loose(self._left, spacing_of(self._finder.scene))
            else:
                correction = system.solve(self._left, self._wanted, None, self._rounding())
            before, size = size, float(np.abs(correction).max(initial=0.0))
            if same and not loose and not size <= CONTRACTION * before:
                break
            self._go(correction)
            part, system = 1.0, self._newest()
            while not loose and part > LEAST_PART and system.is_loose(self._left, self._rounding()):
                part /= 2.0  # farther on what was held would come off again
                self._go(-part * correction)
                system = self._newest()
        if went_loose:
            system.refuse_floats()
        # What is held stands on its outline, as after a step, and not beside it by what is left.
        self._shift(system.of_held(self._left))
        certificate = self._certified()
        if not system.is_stable():
            raise UnconvergedError(UNSTABLE, certificate)
        return certificate

    def _go(self, correction: Floats) -> None:
        system = self._newest()
        self._shift(correction)
        self._shift(system.of_held(self._left))
        self._system = self._linearised(self._state, "finding the contact")

    def _newest(self) -> ContactSystem:
        assert isinstance(self._system, ContactSystem)
        return self._system
