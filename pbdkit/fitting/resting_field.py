"""A field of displacements, measured at rest: of an equilibrium, with boundaries that are unknown
too, and with what the measurement shows beside the body's displacement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pbdkit.experiment.model import Experiment
from pbdkit.fitting.boundary import Boundary, boundaries
from pbdkit.fitting.evidence import FieldEvidence
from pbdkit.fitting.interpolation import OUTSIDE
from pbdkit.fitting.observation import Near, Observation, Seen
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.sensitivity import Resting
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import Floats

DERIVATIVES = 1e-5
"""How accurate they are, as a share of the largest: far within any noise."""
CLOSE = 0.02
"""Parameters that are away by so little leave the answers to boundaries as they were, to such a
share: residuals stay exact, and estimates move by that share of their errors."""

NEAR = ", or nearer to its outline than the margin"


@dataclass(frozen=True)
class FieldSeen(Seen):
    """With the scene at rest, and the derivative of its displacements by each parameter and by each
    coefficient of boundaries, as planes; the latter may be those of an equilibrium nearby."""

    resting: Resting
    changes: tuple[Floats, ...] = field(repr=False)
    answers: tuple[Floats, ...] = field(repr=False)
    answering: Resting = field(repr=False)
    """Whose answers these are."""
    away: float = 0.0
    """How far these parameters are from there at most, as `Near.away` counts."""


@dataclass(frozen=True, kw_only=True)
class FieldObservation(Observation):
    """Its own unknowns are the coefficients of the boundaries, then the strengths of the
    distortions."""

    kind: ClassVar[str] = "field"
    scene: Scene
    evidence: FieldEvidence
    boundaries: tuple[Boundary, ...]

    @classmethod
    def of(
        cls,
        scene: Scene,
        evidence: FieldEvidence,
        noise: float,
        modes: int,
        among: NDArray[np.bool_] | None = None,
    ) -> FieldObservation:
        """With so many modes along each measured boundary; 0 takes it as it was measured. The
        evidence was chosen `among` the rows that are True."""
        inside = evidence.interpolation.inside if among is None else among
        rows = np.flatnonzero(among) if among is not None else np.arange(len(inside))
        return cls(
            experiment=scene.experiment,
            measured=evidence.measured,
            noise=noise,
            rows=rows[evidence.interpolation.inside],
            left_out=len(inside) - len(evidence.points),
            left_out_because=OUTSIDE + (NEAR if among is not None and not among.all() else ""),
            scene=scene,
            evidence=evidence,
            boundaries=boundaries(scene, modes) if modes else (),
        )

    @property
    def own(self) -> int:
        """Coefficients and strengths."""
        return self._coefficients + int(self.evidence.distortions.shape[1])

    @property
    def _coefficients(self) -> int:
        return sum(b.size for b in self.boundaries)

    def start(self) -> Floats:
        """Boundaries as they were measured, and no distortion."""
        known = [b.start(self.experiment.steps) for b in self.boundaries]
        return np.concatenate([*known, np.zeros(self.own - self._coefficients)])

    def places(self) -> Floats:
        """The points."""
        return self.evidence.points

    def part(self, chosen: NDArray[np.bool_]) -> FieldObservation:
        """Of some of them."""
        return replace(super().part(chosen), evidence=self.evidence.part(chosen))

    def at(
        self,
        experiment: Experiment,
        parameters: Sequence[Parameter],
        own: Floats,
        modulus: float,
        near: Near | None = None,
    ) -> FieldSeen:
        """At its equilibrium."""
        n = 0
        for boundary in self.boundaries:
            experiment = boundary.moved(experiment, own[n : n + boundary.size])
            n += boundary.size
        before = near.seen if near and isinstance(near.seen, FieldSeen) else None
        resting = Resting.of(experiment, before.resting if before else self.scene, DERIVATIVES)
        changes = [resting.change(parameter) for parameter in parameters]
        away = before.away + near.away if before and near else np.inf
        if before and away < CLOSE and resting.finder.linear:
            answers, answering = before.answers, before.answering
        else:
            answers, answering, away = self._answers(resting), resting, 0.0
        by = [self.evidence.seen(du, resting) / self.weighted_noise for du in (*changes, *answers)]
        rows, count = len(self.measured), len(parameters)
        beside = self.evidence.distortions / self.weighted_noise
        predicted = self.evidence.seen(resting.state.u, resting)
        residuals = (self.measured - predicted) / self.weighted_noise - beside @ own[n:]
        return FieldSeen(
            residuals,
            np.array(by[:count]).T.reshape(rows, count),
            np.column_stack([*by[count:], beside]) if by[count:] else beside,
            np.zeros(rows),
            resting,
            tuple(changes),
            answers,
            answering,
            away,
        )

    def _answers(self, resting: Resting) -> tuple[Floats, ...]:
        """The derivative of the displacements by each coefficient of the boundaries."""
        return tuple(
            resting.answer(boundary.planes(resting.scene, m))
            for boundary in self.boundaries
            for m in range(boundary.size)
        )
