"""What an equilibrium shows: displacements at points, and what leader groups carry."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pbdkit.components.forces import reactions
from pbdkit.fitting.interpolation import Interpolation
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.sensitivity import Resting, scene_like
from pbdkit.results.moment import StateMoment
from pbdkit.results.tables import Tables
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import Floats


@dataclass(frozen=True)
class FieldEvidence:
    """Displacements measured at points within the body (point, axis): x of all, then y of all.
    `terms` are the exponents of x and y of what the measurement shows besides, of ux and of uy,
    over a `box`, from its lower left to its upper right corner."""

    points: Floats
    measured: Floats
    interpolation: Interpolation = field(repr=False)
    terms: tuple[tuple[tuple[int, int], ...], ...]
    box: tuple[Floats, Floats]

    @classmethod
    def of(
        cls,
        scene: Scene,
        points: Floats,
        displacements: Floats,
        terms: tuple[tuple[tuple[int, int], ...], ...] = ((), ()),
    ) -> FieldEvidence:
        """Of scattered points (point, axis); those outside of the body are left out."""
        found = Interpolation.at(scene, points)
        inside = found.inside
        points = points[inside]
        box = (points.min(axis=0), points.max(axis=0)) if len(points) else (points[0:1], points)
        return cls(points, displacements[inside].T.ravel(), found, terms, box)

    def part(self, chosen: NDArray[np.bool_]) -> FieldEvidence:
        """Of some of the points."""
        return replace(
            self,
            points=self.points[chosen],
            measured=self.measured.reshape(2, -1)[:, chosen].ravel(),
            interpolation=self.interpolation.part(chosen),
        )

    @cached_property
    def distortions(self) -> Floats:
        """The polynomials over the box, from -1 to 1 in it."""
        low, high = self.box
        x, y = (2.0 * (self.points - low) / np.maximum(high - low, 1e-300) - 1.0).T
        columns, n = [], len(x)
        for axis, terms in enumerate(self.terms):
            for p, q in terms:
                column = np.zeros(2 * n)
                column[axis * n : (axis + 1) * n] = x**p * y**q
                columns.append(column)
        return np.stack(columns, axis=1) if columns else np.zeros((2 * n, 0))

    def seen(self, planes: Floats, resting: Resting) -> Floats:
        """Displacements that are given as planes, there."""
        return self.interpolation.of(planes, resting.scene).T.ravel()


@dataclass(frozen=True)
class Carried:
    """What a leader group carries at rest along each axis, over Young's modulus and thickness."""

    resting: Resting
    group: int

    @cached_property
    def predicted(self) -> Floats:
        """(axis,)."""
        return self._reaction(self.resting.scene, self.resting.state.u)

    def change(self, du: Floats, parameter: Parameter | None = None) -> Floats:
        """How that changes, (axis,), where displacements change by du and, if one is named, a
        parameter by 1 with them."""
        scene, u = self.resting.scene, self.resting.state.u
        if self.resting.finder.linear:
            found: Floats = self._reaction(scene, u + du) - self.predicted
        else:
            found = self.resting.along(lambda u: self._reaction(scene, u), du)
        if parameter is not None:
            found = found + parameter.derivative(
                scene.experiment, lambda e: self._reaction(scene_like(scene, e), u)
            )
        return np.asarray(found)

    def _reaction(self, scene: Scene, u: Floats) -> Floats:
        state = self.resting.state.copy()
        state.u = u
        moment = StateMoment(state, Tables(scene))
        return np.asarray(reactions(moment)[self.group])
