"""What was measured while an experiment runs: tracks of points in time, and the curve of the force
that a leader group exerts.

Predictions are read off the run at the steps that they need; how they change with a parameter comes
by central differences of order 8 of whole runs, between which no bond may break otherwise.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from pbdkit.components.forces import reactions
from pbdkit.equilibrium.certificate import UnconvergedError
from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.experiment.record import Record
from pbdkit.fitting.interpolation import Interpolation
from pbdkit.fitting.observation import Observation, Seen
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.sensitivity import scene_like
from pbdkit.results.moment import StateMoment
from pbdkit.results.tables import Tables
from pbdkit.runs.course import Run
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
        self, experiment: Experiment, parameters: Sequence[Parameter], own: Floats, modulus: float
    ) -> Seen:
        """By one run, and eight for each parameter."""
        predicted, broken = self._run(experiment)
        columns = [self._change(experiment, parameter, broken) for parameter in parameters]
        rows = len(self.measured)
        scale = modulus if self.needs_modulus else 1.0
        return Seen(
            (self.measured - scale * predicted) / self.noise,
            scale * np.array(columns).T.reshape(rows, len(columns)) / self.noise,
            np.zeros((rows, 0)),
            predicted / self.noise if self.needs_modulus else np.zeros(rows),
        )

    def modulus_terms(self, experiment: Experiment) -> tuple[float, float]:
        """Of one run."""
        if not self.needs_modulus:
            return 0.0, 0.0
        predicted, _ = self._run(experiment)
        over = self.noise**2
        return float(self.measured @ predicted) / over, float(predicted @ predicted) / over

    def _change(self, experiment: Experiment, parameter: Parameter, broken: Floats) -> Floats:
        def predicted(changed: Experiment) -> Floats:
            found, others = self._run(changed)
            if (others != broken).any():
                raise ExperimentError(
                    f"a little more or less of {parameter.path} breaks other bonds: what was "
                    "measured is no smooth function of it; take data before the first break, or "
                    "fit thresholds to repeated tests"
                )
            return found

        return np.asarray(parameter.derivative(experiment, predicted))

    def _run(self, experiment: Experiment) -> tuple[Floats, Floats]:
        """What it predicts, (number,), and when which bond broke."""
        mine = self.scene.experiment
        asked = experiment.model_copy(
            update={"record": mine.record, "diagnostics": mine.diagnostics}
        )
        run = Run(scene_like(self.scene, asked))
        found = self._read(run)
        if run.outcome is None or run.outcome.status in ("diverged", "unconverged"):
            reason = run.outcome.stop_reason if run.outcome else "the run did not end"
            raise UnconvergedError(reason)
        broken = run.state.broken_step
        return found, np.zeros(0) if broken is None else np.asarray(broken, float)

    @abstractmethod
    def _read(self, run: Run) -> Floats:
        """What a run predicts of the numbers that were measured."""


@dataclass(frozen=True, kw_only=True)
class TracksObservation(RunObservation):
    """Displacements of points at times, x of all, then y of all. Between steps, and between
    particles, they are linear."""

    kind: ClassVar[str] = "tracks"
    times: Floats
    interpolation: Interpolation

    @classmethod
    def of(
        cls, experiment: Experiment, times: Floats, points: Floats, u: Floats, noise: float
    ) -> TracksObservation:
        """Of times (row,), points (row, axis) and displacements (row, axis). Raises
        ExperimentError where a time lies beyond the run."""
        if times.min() < 0.0 or times.max() > experiment.steps:
            raise ExperimentError(
                f"times go from {times.min():g} to {times.max():g}, and the run from 0 to "
                f"{experiment.steps}; times are counted in steps",
                ("measured", "file"),
            )
        steps = np.unique(np.concatenate([np.floor(times), np.ceil(times)])).astype(int)
        scene = read_at(experiment, steps.tolist())
        found = Interpolation.at(scene, points)
        inside = found.inside
        return cls(
            experiment=experiment,
            measured=u[inside].T.ravel(),
            noise=noise,
            left_out=int((~inside).sum()),
            scene=scene,
            times=times[inside],
            interpolation=found,
        )

    def _read(self, run: Run) -> Floats:
        found = np.zeros((len(self.times), 2))
        for state in run:
            share = np.maximum(0.0, 1.0 - np.abs(self.times - state.step))
            if (rows := np.flatnonzero(share)).size:
                part = replace(
                    self.interpolation,
                    rows=self.interpolation.rows[rows],
                    shares=self.interpolation.shares[rows],
                )
                found[rows] += share[rows, None] * part.of(state.u, run.scene)
        return np.asarray(found.T.ravel())


@dataclass(frozen=True, kw_only=True)
class CurveObservation(RunObservation):
    """The force that a leader group exerts along a direction, at displacements of the group along
    it, or at times; over the thickness, and over Young's modulus unless that is to be `scaled` by
    what fits. It is linear between recorded steps."""

    kind: ClassVar[str] = "curve"
    group: int
    way: tuple[float, float]
    at_times: bool
    scaled: bool
    places: Floats

    @property
    def needs_modulus(self) -> bool:
        """Where it is not known."""
        return self.scaled

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        places: Floats,
        forces: Floats,
        noise: float,
        group: int,
        way: tuple[float, float],
        *,
        at_times: bool,
        scaled: bool,
    ) -> CurveObservation:
        """Raises ExperimentError for a group that is not there, and for places that the run does
        not come to."""
        scene = read_at(experiment)
        if group >= len(scene.leading):
            raise ExperimentError(f"there is no leader group {group}", ("measured", "group"))
        found = cls(
            experiment=experiment,
            measured=forces,
            noise=noise,
            scene=scene,
            group=group,
            way=way,
            at_times=at_times,
            scaled=scaled,
            places=places,
        )
        come, _ = found.curve(Run(scene))
        inside = (places >= come.min()) & (places <= come.max())
        if not inside.any():
            what = "steps" if at_times else "displacements of the group"
            raise ExperimentError(
                f"the curve goes from {places.min():g} to {places.max():g}, and the run's {what} "
                f"from {come.min():g} to {come.max():g}",
                ("measured", "file"),
            )
        return replace(
            found,
            measured=forces[inside],
            places=places[inside],
            left_out=int((~inside).sum()),
        )

    def _read(self, run: Run) -> Floats:
        come, force = self.curve(run)
        return np.interp(self.places, come, force)

    def curve(self, run: Run) -> tuple[Floats, Floats]:
        """At each recorded step, the place (step,) and the force over Young's modulus and
        thickness (step,)."""
        tables, places, forces = Tables(run.scene), [], []
        for state in run:
            if run.scene.experiment.record.keeps(state.step, run.scene.experiment.steps):
                moment = StateMoment(state, tables)
                places.append(state.step if self.at_times else self._gone(state))
                forces.append(np.dot(self.way, reactions(moment)[self.group]))
        come = np.array(places, float)
        if (np.diff(come) <= 0.0).any():
            raise ExperimentError(
                "the group does not go on and on along the force, so that a displacement names no "
                "moment: give `against: time`",
                ("measured", "against"),
            )
        return come, np.array(forces)

    def _gone(self, state: State) -> float:
        place = self._leading_place
        flat = state.u.reshape(len(state.u), -1)[:, place]
        return float(np.dot(self.way, flat.mean(axis=1)))

    @cached_property
    def _leading_place(self) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        return np.asarray(self.scene.leading[self.group].place)
