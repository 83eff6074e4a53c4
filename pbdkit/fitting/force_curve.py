"""The curve of the force that a leader group exerts while an experiment runs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pbdkit.components.forces import reactions
from pbdkit.equilibrium.certificate import UnconvergedError
from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.fitting.run_observation import RunObservation, read_at
from pbdkit.results.moment import StateMoment
from pbdkit.results.tables import Tables
from pbdkit.runs.course import Run
from pbdkit.stepping.state import Floats, State

SLACK = 1e-9
"""The share of a run's way by which a row may lie beyond its end."""


@dataclass(frozen=True, kw_only=True)
class CurveObservation(RunObservation):
    """The force that a leader group exerts along a direction, at displacements of the group along
    it until it stops or turns, or at times; over the thickness, and over Young's modulus unless
    that is to be `scaled` by what fits. It is linear between recorded steps."""

    kind: ClassVar[str] = "curve"
    group: int
    way: tuple[float, float]
    at_times: bool
    scaled: bool
    along: Floats

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
        return cls(
            experiment=experiment,
            measured=forces,
            noise=noise,
            rows=np.arange(len(forces)),
            scene=scene,
            group=group,
            way=way,
            at_times=at_times,
            scaled=scaled,
            along=places,
        )._within_the_run()

    def _within_the_run(self) -> CurveObservation:
        """Without the rows to which the run does not come. Raises ExperimentError where none is
        left, and for times beyond the run."""
        come, _ = self.curve(Run(self.scene))
        inside = (self.along >= come.min()) & (self.along <= come.max())
        what = "times" if self.at_times else "displacements of the group"
        ends = f"the run's {what} go from {come.min():g} to {come.max():g}"
        if not inside.any() or (self.at_times and not inside.all()):
            raise ExperimentError(
                f"the curve goes from {self.along.min():g} to {self.along.max():g}, and {ends}; "
                "leave other rows out, or let the experiment go as far",
                ("measured", "file"),
            )
        left_out = int((~inside).sum())
        return replace(self.part(inside), left_out=left_out, left_out_because=ends)

    @property
    def names(self) -> tuple[str, str, bool]:
        """What its numbers are, what they go over, and whether they are one curve."""
        over = "time (step)" if self.at_times else f"displacement of group {self.group}"
        return f"force on group {self.group}", over, True

    def places(self) -> Floats:
        """The displacements or times."""
        return self.along[:, None]

    def part(self, chosen: NDArray[np.bool_]) -> CurveObservation:
        """Of some of them."""
        return replace(super().part(chosen), along=self.along[chosen])

    def _read(self, run: Run) -> Floats:
        come, force = self.curve(run)
        beyond = SLACK * (come.max() - come.min())
        if self.along.min() < come.min() - beyond or self.along.max() > come.max() + beyond:
            raise UnconvergedError(
                f"the group goes from {come.min():g} to {come.max():g}, and the curve from "
                f"{self.along.min():g} to {self.along.max():g}"
            )
        return np.interp(self.along, come, force)

    def curve(self, run: Run) -> tuple[Floats, Floats]:
        """At each recorded moment, until the group stops or turns, the place (step,) and the force
        over Young's modulus and thickness (step,). After a run has settled its force stays."""
        tables, places, forces = Tables(run.scene), [], []
        for moment, state in self._recorded(run):
            places.append(moment if self.at_times else self._gone(state))
            forces.append(np.dot(self.way, reactions(StateMoment(state, tables))[self.group]))
        if self.at_times and places[-1] < self.experiment.steps:
            places.append(self.experiment.steps)
            forces.append(forces[-1])
        return _going_on(np.array(places, float), np.array(forces))

    def _gone(self, state: State) -> float:
        place = self._leading_place
        flat = state.u.reshape(len(state.u), -1)[:, place]
        return float(np.dot(self.way, flat.mean(axis=1)))

    @cached_property
    def _leading_place(self) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        return np.asarray(self.scene.leading[self.group].place)


def _going_on(places: Floats, forces: Floats) -> tuple[Floats, Floats]:
    """Places as far as they go on one way, rising, and the forces there. Raises ExperimentError
    where they do not at all."""
    ways = np.sign(np.diff(places))
    if not ways.size or ways[0] == 0.0:
        raise ExperimentError(
            "the group does not move along the force in its first recorded step, so that a "
            "displacement names no moment: give `against: time`",
            ("measured", "against"),
        )
    other = np.flatnonzero(ways != ways[0])
    count = int(other[0]) + 1 if other.size else len(places)
    order = slice(None) if ways[0] > 0.0 else slice(None, None, -1)
    return places[:count][order], forces[:count][order]
