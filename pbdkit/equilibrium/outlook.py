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
from pbdkit.stepping.state import State

Vectors = NDArray[np.float64]
ACCURACY = 1e-8
"""How well linear systems are solved; the bound takes in what that leaves."""
TELLING = 1e3
"""How many times what rounding does moves must be to tell a linear rule from another."""


@dataclass(frozen=True)
class Outlook:
    """`u` is the equilibrium ahead as far as it is known, and no follower is farther from it than
    `distance`; `residual` is the largest move at the state, `bound` says how the distance was
    obtained, by which linear `method`, and whether the rule was `linearised`."""

    u: Vectors
    distance: float
    residual: float
    method: str
    bound: str
    linearised: bool


@dataclass(frozen=True)
class _Linearised:
    """The system of an operator, and where its unknowns are on the flat raster."""

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
        broken = 0 if state.broken_step is None else np.count_nonzero(state.broken_step >= 0)
        if self._at_rest is None or broken != self._broken:
            self._at_rest, self._broken = self._linearised(here, np.zeros_like(u)), broken
            self._linear = False
        found = self._corrected(here, self._at_rest, at_rest=True)
        if found is None:
            found = self._corrected(here, self._linearised(here, u), at_rest=False)
        assert found is not None
        return found

    @property
    def iterations(self) -> int:
        """Those of the linear solvers."""
        own = self._at_rest.system.iterations if self._at_rest else 0
        return self._past_iterations + own

    def _linearised(self, state: State, u: Vectors) -> _Linearised:
        operator = step_operator(self._scene, replace(state, u=u))
        reference = self._scene.raster.reference(operator.followers)
        self.linearisations += 1
        system = System(operator, "auto", reference)
        return _Linearised(operator, system, self._scene.raster.place_of(operator.followers))

    def _corrected(self, here: State, known: _Linearised, *, at_rest: bool) -> Outlook | None:
        """None where the system is that of the scene at rest and the rule not known to be
        linear."""
        system, place = known.system, known.place
        moves = self._moves.at(here.u, here.broken_step, place)
        ahead, distance = here.u.copy(), math.inf
        try:
            if not at_rest:
                system.refuse_moving_floats(moves, rounding(here.u))
            correction = system.solve(moves, ACCURACY, owed_by(known.operator, here, place))
        except ExperimentError:
            if at_rest and not self._linear:
                return None
        else:
            ahead.reshape(2, -1)[:, place] += correction.T
            left = self._moves.at(ahead, here.broken_step, place)
            if at_rest and not self._is_linear(
                moves, left, moves - system.times(correction), ahead
            ):
                return None
            bound = system.distance(left, rounding(ahead)) * (1.0 if at_rest else FIRST_ORDER)
            distance = float(np.hypot(*correction.T).max(initial=0.0)) + bound
        if not at_rest:
            self._past_iterations += system.iterations
        return Outlook(
            u=ahead,
            distance=distance if math.isfinite(distance) else math.inf,
            residual=float(np.abs(moves).max(initial=0.0)),
            method=system.methods,
            bound=system.how,
            linearised=not at_rest,
        )

    def _is_linear(self, moves: Vectors, left: Vectors, expected: Vectors, ahead: Vectors) -> bool:
        """Whether the correction left what the system says. Moves as small as what rounding does
        tell nothing; then what was known before holds."""
        floor = rounding(ahead) * math.sqrt(max(1, moves.size))
        with np.errstate(all="ignore"):
            size, wrong = np.linalg.norm(moves), np.linalg.norm(left - expected)
        if size > TELLING * floor:
            self._linear = bool(wrong <= LINEAR * size + floor)
        return self._linear
