"""Finds the configuration at which no follower moves, leaders and bonds being what they are."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pbdkit.equilibrium.certificate import FIRST_ORDER, LINEAR, Certificate
from pbdkit.equilibrium.linearisation import linearised
from pbdkit.equilibrium.moves import Moves, rounding
from pbdkit.equilibrium.system import System, one_thread
from pbdkit.results.progress import Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import Floats, State

MOST_CORRECTIONS, MOST_LINEARISATIONS = 8, 60
SHARE = 0.25
"""Of the tolerance, for linear systems."""
SHORTEST = 2.0**-14
"""The shortest share of a correction that is tried."""


class UnconvergedError(Exception):
    """The best state found is no equilibrium; its certificate comes along."""

    def __init__(self, reason: str, certificate: Certificate) -> None:
        super().__init__(reason)
        self.certificate = certificate


@dataclass(frozen=True)
class Finder:
    """Looks for the equilibria of a scene, to a tolerance that is a length, by one of the solver's
    methods. `scale` is the length that shares are of."""

    scene: Scene
    tolerance: float
    scale: float
    method: str
    watch: Watch

    @cached_property
    def moves(self) -> Moves:
        """Of the scene's followers."""
        return Moves(self.scene)

    def find(self, state: State, step: int) -> Certificate:
        """Moves the followers of `state`, in place, to where they rest, with the roles of `step`.

        The first linearisation is that of the scene at rest, exact for linear rules. Others are
        linearised anew where they have come to (Newton's iteration, with shorter corrections where
        the moves would grow). Raises ExperimentError where a part of the body has no equilibrium,
        UnconvergedError, and StoppedError.
        """
        with one_thread():
            return _Search(self, state, step).run()


class _Search:
    def __init__(self, finder: Finder, state: State, step: int) -> None:
        self._finder, self._state, self._step = finder, state, step
        self._linearisations = self._inner = 0
        self._linear = False
        at_rest = replace(state, u=np.zeros_like(state.u))
        self._system = self._linearised(at_rest, "assembling")
        self._owed: State | None = state.copy()
        self._left = self._moves()
        self._known: tuple[float, Floats | None, System | None] = math.inf, None, None
        """The last distance, of which moves, by which system."""

    def run(self) -> Certificate:
        if not self._left.any() and not self._state.u.any() and not self._state.previous.any():
            self._linear = True  # nothing is prescribed but rest
            return self._certified()
        start, moves = self._state.u.copy(), self._left
        if self._correct_linearly():
            return self._certified()
        if not self._linear:
            if not _size(self._left) < _size(moves):
                self._state.u[...], self._left = start, moves
            self._correct_anew()
        return self._certified()

    def _correct_linearly(self) -> bool:
        """Corrections by the first system; whether the tolerance is reached, or the rule is known
        not to be linear."""
        for n in range(MOST_CORRECTIONS):
            moves, before = self._left, _size(self._left)
            correction = self._system.solve(moves, self._wanted, self._owed)
            self._shift(correction, 1.0)
            self._owed = None
            after, floor = _size(self._left), self._floor()
            if n == 0 and before > 1e3 * floor:
                mismatch = self._system.mismatch(correction, moves, self._left)
                self._linear = mismatch <= LINEAR + floor / before
            if not self._linear or not math.isfinite(after):
                return False
            if self._distance() <= self._finder.tolerance:
                return True
            if after > 0.5 * before:
                return False
        return False

    def _correct_anew(self) -> None:
        """Newton's iteration."""
        while self._linearisations < MOST_LINEARISATIONS:
            what = f"linearising for the {self._linearisations + 1}. time"
            self._system = self._linearised(self._state, what)
            self._system.refuse_moving_floats(self._left, self._rounding())
            if self._distance() <= self._finder.tolerance or not self._search_along(
                self._system.solve(self._left, self._wanted)
            ):
                return

    def _search_along(self, correction: Floats) -> bool:
        """Whether some share of the correction makes the moves smaller; takes it."""
        start, moves, share = self._state.u.copy(), self._left, 1.0
        while share >= SHORTEST:
            self._shift(correction, share)
            if _size(self._left) < (1.0 - 1e-4 * share) * _size(moves):
                return True
            self._state.u[...], self._left = start, moves
            share /= 2.0
        return False

    def _certified(self) -> Certificate:
        distance = self._distance()
        certificate = Certificate(
            method=self._system.methods,
            iterations=self._linearisations,
            inner_iterations=self._inner + self._system.iterations,
            residual=float(np.abs(self._left).max(initial=0.0)),
            distance=distance,
            share=distance / self._finder.scale,
            bound=self._system.how,
            linearised=not self._linear,
        )
        if not distance <= self._finder.tolerance:
            raise UnconvergedError(self._why(), certificate)
        return certificate

    def _why(self) -> str:
        if not np.isfinite(self._left).all():
            return "it left the finite numbers"
        if self._left.size and np.abs(self._left).max() <= 8 * self._rounding():
            return "rounding alone allows no better"
        if self._linearisations >= MOST_LINEARISATIONS:
            return f"{MOST_LINEARISATIONS} linearisations did not get there"
        return "no correction makes the moves smaller"

    def _linearised(self, at: State, what: str) -> System:
        finder = self._finder
        finder.watch.begin(what)
        if self._linearisations:
            self._inner += self._system.iterations
        self._linearisations += 1
        return linearised(finder.scene, at, self._step, finder.method, finder.watch)

    def _shift(self, correction: Floats, share: float) -> None:
        self._state.u += correction if share == 1.0 else share * correction
        self._left = self._moves()

    def _moves(self) -> Floats:
        return self._finder.moves.at(self._state, self._step)

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
        return self._system.amplification * rounding(self._state.u)

    def _floor(self) -> float:
        return self._rounding() * math.sqrt(max(1, self._left.size))


def _size(moves: Floats) -> float:
    with np.errstate(over="ignore"):
        return float(np.linalg.norm(moves))
