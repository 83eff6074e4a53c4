"""What was measured while an experiment runs.

Predictions are read off the run at the steps that they need; how they change with a parameter comes
by central differences of order 8 of whole runs, between which no bond may break otherwise. Where
the run settles, the runs of the differences make as many steps as it did: the step at which a run
settles is no smooth function of parameters.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pbdkit.equilibrium.certificate import UnconvergedError
from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.experiment.record import Record
from pbdkit.fitting.observation import Near, Observation, Seen
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.sensitivity import scene_like
from pbdkit.runs.course import FAILED, Run
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stepping.state import Floats, State


def read_at(experiment: Experiment, steps: Sequence[int] | None = None) -> Scene:
    """The scene of an experiment that comes by at these steps, or at those that it records, and
    measures nothing itself. Raises ExperimentError."""
    changed: dict[str, Any] = {"diagnostics": ()}
    if steps is not None:
        changed["record"] = Record(at=tuple(steps))
    return build_scene(experiment.model_copy(update=changed))


@dataclass(frozen=True, kw_only=True)
class RunObservation(Observation):
    """Of a whole run."""

    scene: Scene

    def at(
        self,
        experiment: Experiment,
        parameters: Sequence[Parameter],
        own: Floats,
        modulus: float,
        near: Near | None = None,
    ) -> Seen:
        """By one run, and eight for each parameter."""
        predicted, broken, steps = self._run(experiment)
        columns = [self._change(experiment, each, broken, steps) for each in parameters]
        rows = len(self.measured)
        scale = modulus if self.needs_modulus else 1.0
        return Seen(
            (self.measured - scale * predicted) / self.weighted_noise,
            scale * np.array(columns).T.reshape(rows, len(columns)) / self.weighted_noise,
            np.zeros((rows, 0)),
            predicted / self.weighted_noise if self.needs_modulus else np.zeros(rows),
        )

    def modulus_terms(self, experiment: Experiment) -> tuple[float, float]:
        """Of one run."""
        if not self.needs_modulus:
            return 0.0, 0.0
        predicted, *_ = self._run(experiment)
        over = self.weighted_noise**2
        return float(self.measured @ predicted) / over, float(predicted @ predicted) / over

    def _change(
        self, experiment: Experiment, parameter: Parameter, broken: Floats, steps: int
    ) -> Floats:
        """The derivative of the predictions of a run that made so many steps."""

        def predicted(changed: Experiment) -> Floats:
            found, others, _ = self._run(_of_steps(changed, steps))
            if (others != broken).any():
                raise ExperimentError(
                    f"a little more or less of {parameter.path} breaks other bonds: what was "
                    "measured is no smooth function of it; take data before the first break, or "
                    "fit thresholds to repeated tests"
                )
            return found

        return np.asarray(parameter.derivative(experiment, predicted))

    def _run(self, experiment: Experiment) -> tuple[Floats, Floats, int]:
        """What it predicts, (number,), when which bond broke, and after how many steps it ended."""
        mine = self.scene.experiment
        asked = experiment.model_copy(
            update={"record": mine.record, "diagnostics": mine.diagnostics}
        )
        run = Run(scene_like(self.scene, asked))
        found = self._read(run)
        broken = run.state.broken_step
        when = np.zeros(0) if broken is None else np.asarray(broken, float)
        return found, when, run.state.step

    def _recorded(self, run: Run) -> Iterator[tuple[float, State]]:
        """The states that a run records and the moment of each, in steps, and that at which it
        ends. Raises UnconvergedError where it ends without a result."""
        last = -1.0
        for state in run:
            within = run.driver.within
            moment = state.step if within is None else within
            wanted = within is not None or run.scene.experiment.records(state.step)
            if (wanted or run.driver.ending) and moment > last:
                last = moment
                yield moment, state
        if run.outcome is None or run.outcome.status in FAILED:
            reason = run.outcome.stop_reason if run.outcome else "the run did not end"
            raise UnconvergedError(reason)

    @abstractmethod
    def _read(self, run: Run) -> Floats:
        """What a run predicts of the numbers that were measured."""


def _of_steps(experiment: Experiment, steps: int) -> Experiment:
    """The experiment with so many steps, all of which are made."""
    changed: dict[str, Any] = {"steps": steps}
    if experiment.solver.makes_steps:
        changed["solver"] = experiment.stepping.model_copy(update={"settle": None})
    return experiment.model_copy(update=changed)
