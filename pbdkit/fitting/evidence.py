"""What was measured, and what an equilibrium has to say of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from pbdkit.components.forces import reactions
from pbdkit.fitting.interpolation import Interpolation
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.sensitivity import Resting, along, scene_like
from pbdkit.results.moment import StateMoment
from pbdkit.results.tables import Tables
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import Floats


class Evidence(ABC):
    """Numbers that were measured, with their noise, and what a scene at rest predicts of them."""

    measured: Floats
    noise: float

    @cached_property
    def distortions(self) -> Floats:
        """(number, strength): what the measurement may show beside what the scene does, as much of
        each as fits."""
        return np.zeros((len(self.measured), 0))

    @abstractmethod
    def predicted(self, resting: Resting) -> Floats:
        """(number,)."""

    @abstractmethod
    def change(self, resting: Resting, du: Floats, parameter: Parameter | None) -> Floats:
        """How these change, (number,), where displacements change by du and, if one is named, a
        parameter by 1 with them."""


@dataclass(frozen=True)
class FieldEvidence(Evidence):
    """Displacements at points within the body, (point, axis): x of all, then y of all. `terms` are
    the exponents of x and y of what the measurement shows besides, of ux and of uy."""

    points: Floats
    measured: Floats
    noise: float
    interpolation: Interpolation = field(repr=False)
    terms: tuple[tuple[tuple[int, int], ...], ...] = ((), ())

    @classmethod
    def of(
        cls,
        scene: Scene,
        points: Floats,
        displacements: Floats,
        noise: float,
        terms: tuple[tuple[tuple[int, int], ...], ...] = ((), ()),
    ) -> FieldEvidence:
        """Of scattered points (point, axis); those outside of the body are left out."""
        found = Interpolation.at(scene, points)
        inside = found.inside
        return cls(points[inside], displacements[inside].T.ravel(), noise, found, terms)

    @cached_property
    def distortions(self) -> Floats:
        """The polynomials, over the points' box from -1 to 1."""
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        x, y = (2.0 * (self.points - low) / np.maximum(high - low, 1e-300) - 1.0).T
        columns, n = [], len(x)
        for axis, terms in enumerate(self.terms):
            for p, q in terms:
                column = np.zeros(2 * n)
                column[axis * n : (axis + 1) * n] = x**p * y**q
                columns.append(column)
        return np.stack(columns, axis=1) if columns else np.zeros((2 * n, 0))

    def predicted(self, resting: Resting) -> Floats:
        """u there."""
        return self.interpolation.of(resting.state.u, resting.scene).T.ravel()

    def change(self, resting: Resting, du: Floats, parameter: Parameter | None) -> Floats:
        """du there: parameters act on it alone."""
        return self.interpolation.of(du, resting.scene).T.ravel()


@dataclass(frozen=True)
class ForceEvidence(Evidence):
    """What a leader group carries along each axis, over Young's modulus and thickness."""

    group: int
    measured: Floats
    noise: float

    def predicted(self, resting: Resting) -> Floats:
        """(axis,)."""
        return self._reaction(resting, resting.scene, resting.state.u)

    def change(self, resting: Resting, du: Floats, parameter: Parameter | None) -> Floats:
        """Of followers that go on, and of rules that pull otherwise."""
        u = resting.state.u

        def at(u: Floats) -> Floats:
            return self._reaction(resting, resting.scene, u)

        found = along(at, u, du, resting.finder.linear)
        if parameter is not None:
            found = found + parameter.derivative(
                resting.scene.experiment,
                lambda e: self._reaction(resting, scene_like(resting.scene, e), u),
            )
        return np.asarray(found)

    def _reaction(self, resting: Resting, scene: Scene, u: Floats) -> Floats:
        state = resting.state.copy()
        state.u = u
        moment = StateMoment(state, Tables(scene))
        return np.asarray(reactions(moment)[self.group])
