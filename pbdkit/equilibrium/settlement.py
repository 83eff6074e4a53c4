"""Whether a run has settled: nothing is left to happen that would take it farther than asked."""

from __future__ import annotations

import math

import numpy as np

from pbdkit.equilibrium.certificate import CORRECTION, Certificate, scale_of
from pbdkit.equilibrium.outlook import Foresight, Outlook
from pbdkit.equilibrium.pace import NEVER, Pace
from pbdkit.equilibrium.watch import Watch
from pbdkit.experiment.solvers import Settle
from pbdkit.scene.scene import Scene
from pbdkit.stepping.fracturing import Fracturing
from pbdkit.stepping.leaders import is_cut_short, last_event
from pbdkit.stepping.state import State


class Settling:
    """Looks at the states of a run that is to end once it has settled: roles no longer change,
    leaders rest, no follower can be farther from equilibrium than the tolerance, and no bond is so
    near to breaking that it might on the way there.

    Where the step looks back, a body may swing through its equilibrium: what memory and frames
    with lag can carry it on counts as distance.
    """

    def __init__(self, scene: Scene, settle: Settle, start: State, watch: Watch) -> None:
        self._scale = scale_of(scene, start)
        self._tolerance = settle.tolerance * self._scale
        steps, leading = scene.experiment.steps, scene.leading
        ends = not any(is_cut_short(group, steps) for group in leading)
        first = max(last_event(scene), start.step + 1) if ends else NEVER
        self.pace = Pace(first, self._tolerance, first - 1)
        self._foresight = Foresight(scene, watch)
        self._fracturing = Fracturing(scene) if scene.has_fracture else None
        self._carrying = _carrying(scene)
        self.obstacle = (
            "steps are too few" if ends else "leaders do not come to rest before its end"
        )
        """Why the run has not settled, as found at the last look."""

    def look(self, state: State) -> Certificate | None:
        """At the end of that step: the certificate where the run has settled. Raises StoppedError
        where the watch says so."""
        with np.errstate(all="ignore"):
            way = (state.u - state.previous).ravel()
            longest, size = float(np.abs(way).max()), float(np.linalg.norm(way))
        if not self.pace.is_near(state.step, longest, size):
            self.obstacle = f"in step {state.step} particles still moved by up to {longest:.2g}"
            return None
        outlook = self._foresight.from_(state)
        distance = outlook.distance + self._carrying * longest
        self.obstacle = self._obstacle(state, outlook, distance)
        if not self.obstacle:
            return self._certificate(outlook, distance)
        self.pace.note_distance(state.step, distance)
        return None

    def _obstacle(self, state: State, outlook: Outlook, distance: float) -> str:
        at = f"at step {state.step}"
        if not math.isfinite(distance):
            return f"{at} {outlook.obstacle or 'nothing bounds the distance from equilibrium'}"
        if distance > self._tolerance:
            return f"{at} within {distance:.2g} of equilibrium, not within {self._tolerance:.2g}"
        if self._may_break(state, outlook):
            return f"{at} a bond may break on the last {distance:.2g} to equilibrium"
        return ""

    def _may_break(self, state: State, outlook: Outlook) -> bool:
        """Whether a bond might break within the distance of the equilibrium at both its ends."""
        if self._fracturing is None:
            return False
        return self._fracturing.may_break(outlook.u, state, 2.0 * outlook.distance)

    def _certificate(self, outlook: Outlook, distance: float) -> Certificate:
        return Certificate(
            method=outlook.method,
            iterations=self._foresight.linearisations,
            inner_iterations=self._foresight.iterations,
            residual=outlook.residual,
            distance=distance,
            share=distance / self._scale,
            bound=CORRECTION + outlook.bound,
            linearised=outlook.linearised,
        )


def _carrying(scene: Scene) -> float:
    """How many times the last step a body may be carried on: |b| / (1 - |b|) by memory b, which
    makes each step b times the last, and once by a frame that lags."""
    memory = abs(scene.experiment.stepping.memory)
    lag = scene.frame.map.lag if scene.frame else 0
    return (memory / (1.0 - memory) if memory < 1.0 else np.inf) + lag
