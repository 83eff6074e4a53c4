"""Where a state is heading for, and how far that is at most."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.operator import StepOperator, step_operator
from pbdkit.equilibrium.finding import FIRST_ORDER, LINEAR
from pbdkit.equilibrium.moves import Moves, owed_by, rounding
from pbdkit.equilibrium.system import System
from pbdkit.errors import ExperimentError
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import Floats, State

Vectors = NDArray[np.float64]
ACCURACY = 1e-8
"""How well linear systems are solved; the bound takes in what that leaves."""
TELLING = 1e3
"""How many times what rounding does moves must be to tell a linear rule from another."""


@dataclass(frozen=True)
class Outlook:
    """`u` is the equilibrium ahead as far as it is known, and no follower is farther from it than
    `distance`; `residual` is the largest move at the state, `bound` says how the distance was
    obtained, by which linear `method`, and whether the rule was `linearised`; `obstacle` why there
    is no distance, where it is infinite."""

    u: Floats
    distance: float
    residual: float
    method: str
    bound: str
    linearised: bool
    obstacle: str


@dataclass(frozen=True)
class _Linearised:
    """A linearisation of the step, and where its unknowns are on the flat raster."""

    operator: StepOperator
    system: System
    place: NDArray[np.intp]


class Foresight:
    """The outlook from states of a scene with the roles of its last step.

    The correction c, A c = move, leads from u to the equilibrium, and what it fails to do is seen
    in the moves where it leads:

        distance ≤ max |c| + (bound on |A⁻¹|) · |move(u + c)|,

    for rules that are not linear with A linearised at u, the second term to first order, doubled.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene, self._moves = scene, Moves(scene)
        self._at_rest: _Linearised | None = None
        self._broken = 0
        self._linear = False
        self._past_iterations = 0
        self.linearisations = 0
        """How often a system was set up."""

    def from_(self, state: State) -> Outlook:
        """The outlook from the end of a step, which is left as it is.

        The distance is infinite where no bound is known: for what is pushed on for ever, and for
        parts that nothing holds under rules that are not linear.
        """
        u, previous = (np.array(u, np.float64) for u in (state.u, state.previous))
        here = replace(state, u=u, previous=previous)
        broken = 0 if state.broken_step is None else int((state.broken_step >= 0).sum())
        if self._at_rest is None or broken != self._broken:
            self._at_rest, self._broken = self._linearised(here, np.zeros_like(u)), broken
            self._linear = False
        found = self._outlook(here, self._at_rest)
        if not self._linear:
            known = self._linearised(here, u)
            found = self._outlook(here, known, anew=True)
            self._past_iterations += known.system.iterations
        return found

    @property
    def iterations(self) -> int:
        """Those of the linear solvers."""
        own = self._at_rest.system.iterations if self._at_rest else 0
        return self._past_iterations + own

    def _linearised(self, state: State, u: Floats) -> _Linearised:
        operator = step_operator(self._scene, replace(state, u=u))
        reference = self._scene.raster.reference(operator.followers)
        self.linearisations += 1
        system = System(operator, "auto", reference)
        return _Linearised(operator, system, self._scene.raster.place_of(operator.followers))

    def _outlook(self, here: State, known: _Linearised, *, anew: bool = False) -> Outlook:
        """By the system of the scene at rest, which also tells whether the rule is linear, or by
        one that was linearised `anew` at the state."""
        moves = self._moves.at(here.u, here.broken_step, known.place)
        ahead, distance = here.u.copy(), math.inf
        correction, obstacle = self._correction(here, known, moves, anew)
        if correction is not None:
            ahead.reshape(2, -1)[:, known.place] += correction.T
            left = self._moves.at(ahead, here.broken_step, known.place)
            if not anew:
                self._compare(moves, left, moves - known.system.times(correction), ahead)
            bound = known.system.distance(left, rounding(ahead)) * (FIRST_ORDER if anew else 1.0)
            distance = float(np.hypot(*correction.T).max(initial=0.0)) + bound
        return Outlook(
            u=ahead,
            distance=distance if math.isfinite(distance) else math.inf,
            residual=float(np.abs(moves).max(initial=0.0)),
            method=known.system.methods,
            bound=known.system.how,
            linearised=anew,
            obstacle=obstacle,
        )

    def _correction(
        self, here: State, known: _Linearised, moves: Vectors, anew: bool
    ) -> tuple[Vectors | None, str]:
        """(follower, axis); None, and why, where there is no equilibrium, or none that is known."""
        try:
            if anew:
                known.system.refuse_moving_floats(moves, rounding(here.u))
            owed = owed_by(known.operator, here, known.place)
            return known.system.solve(moves, ACCURACY, owed), ""
        except ExperimentError as error:
            return None, str(error).partition("; ")[0] + "; let a leader hold it"

    def _compare(self, moves: Vectors, left: Vectors, expected: Vectors, ahead: Floats) -> None:
        """Whether the correction left what the system says it would: the rule is linear. Moves as
        small as what rounding does tell nothing; what was known before holds then."""
        floor = rounding(ahead) * math.sqrt(max(1, moves.size))
        with np.errstate(all="ignore"):
            size, wrong = float(np.linalg.norm(moves)), float(np.linalg.norm(left - expected))
        if size > TELLING * floor:
            self._linear = wrong <= LINEAR * size + floor
