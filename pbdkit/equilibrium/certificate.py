"""What is known of the distance between a state and its equilibrium, and where that lies."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from pbdkit.equilibrium.linearisation import linearised
from pbdkit.equilibrium.moves import Moves, random_displacements
from pbdkit.equilibrium.rows import ALL, Rows
from pbdkit.equilibrium.system import StuckError, System, one_thread, solved
from pbdkit.errors import ExperimentError
from pbdkit.results.progress import Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.guard import way_of
from pbdkit.stepping.prescription import bends_of
from pbdkit.stepping.state import Floats, State

WAYS = {
    "inverse": "the solution for what is left of the moves, and the inverse for their rounding",
    "solution": "the solution for what is left of the moves",
    "iteration": "some iterations more, and how they fall",
    "damped": "the solution for what is left of the moves, but for motions that cost next to "
    "nothing, as of what hangs by one bond",
    "energy": "some iterations more, and the energy of what they leave",
    "nothing to solve": "nobody follows",
}
CORRECTION = "correction, "
"""Before the name of a way: it bounds only what a correction that was solved for leaves."""


@dataclass(frozen=True)
class Certificate:
    """`residual` is the largest move of the rule at the state; `distance` bounds how far any
    follower is from equilibrium, both lengths; `share` is the distance as a share of the largest
    prescribed displacement; `iterations` counts linearisations and `inner_iterations` those of the
    linear solvers; `bound` says how the distance was obtained; `linearised` whether the rule is not
    linear, so that it holds to first order, with a factor of 2."""

    method: str
    iterations: int
    inner_iterations: int
    residual: float
    distance: float
    share: float
    bound: str
    linearised: bool

    def as_dict(self) -> dict[str, Any]:
        """The same as plain values, for JSON."""
        return asdict(self)

    def __str__(self) -> str:
        way = WAYS[self.bound.removeprefix(CORRECTION)]
        if self.bound.startswith(CORRECTION):
            way = f"the correction to there; what it leaves is bounded by {way}"
        return (
            f"within {self.distance:.2g} of equilibrium ({self.share:.1g} of the largest "
            f"prescribed displacement), by {way}"
        )


UNKNOWN = Certificate(
    method="nothing to solve",
    iterations=0,
    inner_iterations=0,
    residual=math.inf,
    distance=math.inf,
    share=math.inf,
    bound="nothing to solve",
    linearised=True,
)


class UnconvergedError(Exception):
    """The best state found is no equilibrium; its certificate comes along."""

    def __init__(self, reason: str, certificate: Certificate = UNKNOWN) -> None:
        super().__init__(reason)
        self.certificate = certificate


class RoundingError(UnconvergedError):
    """A state is as near to an equilibrium as rounding allows, and the tolerance is less."""


"""Where a search met a body that is not stable."""


def scale_of(scene: Scene, start: State, rows: Rows = ALL) -> float:
    """The largest prescribed displacement: of the leaders, or of the start; where nothing is
    prescribed but rest the largest that loads make, and without any the lattice's spacing."""
    ways = [way_of(leading, scene.experiment.steps) for leading in scene.driven]
    prescribed = rows.most(max([rows.largest(start.u), *ways]))
    return prescribed or _way_under_loads(scene, start, rows) or spacing_of(scene)


def _way_under_loads(scene: Scene, rest: State, rows: Rows) -> float:
    """The largest displacement that loads make when they change, linearised at rest; 0 where
    nothing holds the body against them. Obstacles may stop all of it: then the largest move that
    loads would make without them."""
    steps, moves, ways = scene.experiment.steps, Moves(scene), [0.0]
    rest = replace(rest, u=np.zeros(rest.u.shape))
    moments = {*scene.loads.changes(steps), *bends_of(scene)} if scene.loads else ()
    pushes = [moves.at(rest, moment) for moment in sorted(moments)]
    if scene.barriers:
        ways += [rows.largest(moves.free(rest, moment)) for moment in moments]
    if rows.any(any(push.any() for push in pushes)):
        with suppress(ExperimentError, StuckError), one_thread():
            system = linearised(scene, rest, steps, "auto", Watch(), rows=rows)
            for push in pushes:
                found = solved(system, push, spacing_of(scene), rows)
                ways.append(rows.largest(found))
    return max(ways)


def spacing_of(scene: Scene) -> float:
    """The length of the shortest bond."""
    return min(min(lengths) for lengths in scene.neighbourhood.shells())


def broken_bonds(state: State) -> int:
    """How many bonds are broken."""
    return 0 if state.broken_step is None else int(np.count_nonzero(state.broken_step >= 0))


LINEAR = 1e-9
"""A correction that leaves less than this share of the moves came from the right linearisation."""
FIRST_ORDER = 2.0
"""What a bound is multiplied with that holds to first order only."""
ACCURACY = 1e-8
"""How well linear systems are solved; the bound takes in what that leaves."""

CONTRACTION = 0.1
"""The share of the moves that a correction may leave for its linearisation to be trusted: further
ones, each that much smaller, then lie within a ninth of the first."""
BENT = "the rule bends too much between there and equilibrium for a bound"


@dataclass(frozen=True)
class Outlook:
    """`u` is the equilibrium ahead as far as it is known, and the certificate says how far at most
    any follower is from it; `obstacle` why there is no distance, where it is infinite."""

    u: Floats
    certificate: Certificate
    obstacle: str


class Foresight:
    """The outlook from states of a scene with the roles of its last step.

    The correction c, A c = move, leads from u to the equilibrium, and what it fails to do is seen
    in the moves where it leads:

        distance ≤ max |c| + (bound on |A⁻¹|) · |move(u + c)|,

    for rules that are not linear with A linearised at u, the second term to first order, doubled,
    and only where the correction leaves a tenth of the moves at most.

    An outlook follows from the state alone, so that a run that is gone on with has those of the
    uninterrupted one. Between two of them only factors are kept: iterative solvers remember what
    they have solved before.
    """

    def __init__(self, scene: Scene, scale: float, watch: Watch) -> None:
        self._scene, self._scale, self._watch = scene, scale, watch
        self._moves = Moves(scene)
        self._at_rest: System | None = None
        self._broken = 0

    def from_(self, state: State) -> Outlook:
        """The outlook from the end of a step, which is left as it is.

        The distance is infinite where no bound is known: for what is pushed on for ever, and for
        parts that nothing holds under rules that are not linear.
        """
        with one_thread():
            return self._from(state)

    def _from(self, state: State) -> Outlook:
        u, previous = (np.array(u, np.float64) for u in (state.u, state.previous))
        here = replace(state, u=u, previous=previous)
        if not self._scene.barriers:
            at_rest = self._system_at_rest(here)
            if self._is_linear(here, at_rest):
                return self._outlook(here, at_rest)
        return self._outlook(here, self._linearised(here, u), anew=True)

    def _system_at_rest(self, here: State) -> System:
        system, broken = self._at_rest, broken_bonds(here)
        if system is None or broken != self._broken or system.iterations:
            system = self._linearised(here, np.zeros_like(here.u))
            self._at_rest, self._broken = system, broken
        return system

    def _linearised(self, state: State, u: Floats) -> System:
        at, steps = replace(state, u=u), self._scene.experiment.steps
        return linearised(self._scene, at, steps, "auto", self._watch)

    def _outlook(self, here: State, known: System, *, anew: bool = False) -> Outlook:
        """By the system of the scene at rest, or by one that was linearised `anew` at the state."""
        moves = self._moves.at(here, self._scene.experiment.steps)
        ahead, distance = here.u.copy(), math.inf
        correction, obstacle = self._correction(here, known, moves, anew)
        if correction is not None:
            ahead += correction
            left = self._moves.at(replace(here, u=ahead), self._scene.experiment.steps)
            bound = known.distance(left, self._moves.rounding(ahead)) * (
                FIRST_ORDER if anew else 1.0
            )
            distance = float(np.sqrt((correction**2).sum(axis=0)).max(initial=0.0)) + bound
            most = CONTRACTION * float(np.abs(moves).max(initial=0.0)) + self._moves.rounding(ahead)
            if anew and not np.abs(left).max(initial=0.0) <= most:
                distance, obstacle = math.inf, BENT
        distance = math.inf if math.isnan(distance) else distance
        certificate = Certificate(
            method=known.methods,
            iterations=1,
            inner_iterations=known.iterations,
            residual=float(np.abs(moves).max(initial=0.0)),
            distance=distance,
            share=distance / self._scale,
            bound=CORRECTION + known.how,
            linearised=anew,
        )
        return Outlook(ahead, certificate, obstacle)

    def _correction(
        self, here: State, known: System, moves: Floats, anew: bool
    ) -> tuple[Floats | None, str]:
        """None, and why, where there is no equilibrium, or none that is known."""
        try:
            if anew:
                known.refuse_moving_floats(moves, self._moves.rounding(here.u))
            rounding = known.amplification * self._moves.rounding(here.u)
            return known.solve(moves, ACCURACY * self._scale, here, rounding), ""
        except ExperimentError as error:
            return None, str(error).partition("; ")[0] + "; let a leader hold it"

    def _is_linear(self, here: State, known: System) -> bool:
        """Whether followers put elsewhere, at random and as far as the body has come, move by what
        the linearisation at rest says."""
        size = float(np.abs(here.u).max()) or spacing_of(self._scene)
        put, steps = random_displacements(self._scene, size), self._scene.experiment.steps
        moves, moved = (self._moves.at(replace(here, u=u), steps) for u in (here.u, here.u + put))
        return known.mismatch(put, moves, moved) <= LINEAR
