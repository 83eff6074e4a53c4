"""Tracks in time: how points of a body move while an experiment runs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.fitting.interpolation import Interpolation
from pbdkit.fitting.run_observation import RunObservation, read_at
from pbdkit.runs.course import Run
from pbdkit.stepping.state import Floats


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
