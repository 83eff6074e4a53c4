"""Tracks in time: how points of a body move while an experiment runs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.fitting.interpolation import OUTSIDE, Interpolation
from pbdkit.fitting.run_observation import RunObservation, read_at
from pbdkit.runs.course import Run
from pbdkit.stepping.state import Floats, State

ON_STEP = 1e-9
"""The share of a step by which a time beside one counts as on it."""


@dataclass(frozen=True, kw_only=True)
class TracksObservation(RunObservation):
    """Displacements of points at times, x of all, then y of all. Between steps, and between
    particles, they are linear; after a run has settled they stay."""

    kind: ClassVar[str] = "tracks"
    along: Floats
    points: Floats
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
            rows=np.flatnonzero(inside),
            left_out=int((~inside).sum()),
            left_out_because=OUTSIDE,
            scene=scene,
            along=times[inside],
            points=points[inside],
            interpolation=found,
        )

    @property
    def names(self) -> tuple[str, str, bool]:
        """What its numbers are, what they go over, and whether they are one curve."""
        return "displacements (lattice unit)", "time (step)", False

    def places(self) -> Floats:
        """The points."""
        return self.points

    def part(self, chosen: NDArray[np.bool_]) -> TracksObservation:
        """Of some of them."""
        return replace(
            super().part(chosen),
            along=self.along[chosen],
            points=self.points[chosen],
            interpolation=self.interpolation.part(chosen),
        )

    def _read(self, run: Run) -> Floats:
        found, left = np.zeros((len(self.along), 2)), np.ones(len(self.along))
        for moment, state in self._recorded(run):
            share = np.maximum(0.0, 1.0 - np.abs(self.along - moment))
            self._add(found, share, state, run)
            left -= share
        # A run that has settled stays where it is.
        after = self.along > run.state.step
        self._add(found, np.where(after, left, 0.0), run.state, run)
        if (missing := ~after & (left > ON_STEP)).any():
            raise ExperimentError(
                f"the run gives no state at time {self.along[missing][0]:g}; leave that time out",
                ("measured", "file"),
            )
        return np.asarray(found.T.ravel())

    def _add(self, found: Floats, share: Floats, state: State, run: Run) -> None:
        """Adds a share of a state, by row, to the displacements that were found."""
        if (rows := np.flatnonzero(share)).size:
            part = self.interpolation.part(rows)
            found[rows] += share[rows, None] * part.of(state.u, run.scene)
