"""Measured boundaries as modes: smooth displacements of a leader group, few enough to be estimated.

What is measured at a boundary carries noise, and whoever prescribes it prescribes the noise. So the
displacement of each group that moves by `measured` is a polynomial along it, of which the
measured values are only where the search begins: its coefficients are estimated with all else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.experiment.measured_motion import Measured
from pbdkit.experiment.model import Experiment
from pbdkit.scene.leader_groups import Leading
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import Floats

STRAIGHT = 1e-6
"""The share of its length by which a group may be off a line."""


@dataclass(frozen=True)
class Boundary:
    """A leader group, by its place among them, and its modes (particle, mode)."""

    group: int
    leading: Leading
    modes: Floats

    @property
    def size(self) -> int:
        """How many coefficients: a mode along each axis."""
        return int(self.modes.shape[1]) * len(self.leading.axes)

    def start(self, steps: int) -> Floats:
        """The coefficients of what was measured, (axis · mode,)."""
        n = steps - self.leading.group.from_ + 1
        found, *_ = np.linalg.lstsq(self.modes, self.leading.offset(n), rcond=None)
        return np.asarray(found.T.ravel())

    def displacements(self, coefficients: Floats) -> Floats:
        """(particle, axis): what they come to."""
        return np.asarray(self.modes @ coefficients.reshape(len(self.leading.axes), -1).T)

    def moved(self, experiment: Experiment, coefficients: Floats) -> Experiment:
        """The experiment with these in place of what was measured."""
        given = self.leading.group
        full = np.zeros_like(self.leading.reference)
        full[:, list(self.leading.axes)] = self.displacements(coefficients)
        motion = Measured(
            points=tuple(map(tuple, self.leading.reference.tolist())),
            displacements=tuple(map(tuple, full.tolist())),
            ramp=given.motion.ramp if isinstance(given.motion, Measured) else 1,
        )
        leaders = list(experiment.leaders)
        leaders[self.group] = given.model_copy(update={"motion": motion})
        return experiment.model_copy(update={"leaders": tuple(leaders)})

    def planes(self, scene: Scene, n: int) -> Floats:
        """The displacement of coefficient n alone, (axis, sublattice, cell, cell)."""
        axis, mode = divmod(n, self.modes.shape[1])
        planes = np.zeros((scene.axes, *scene.raster.shape))
        flat = planes.reshape(scene.axes, -1)
        flat[self.leading.axes[axis], self.leading.place] = self.modes[:, mode]
        return planes


def boundaries(scene: Scene, modes: int) -> tuple[Boundary, ...]:
    """Of every group that moves as it was measured. Raises ExperimentError for one that is no
    line, for too few particles, and for one that another group leads along the same axis."""
    found = []
    for n, leading in enumerate(scene.leading):
        if isinstance(leading.group.motion, Measured):
            _refuse_shared(scene, n)
            found.append(Boundary(n, leading, _polynomials(leading.reference, modes, n)))
    return tuple(found)


def _refuse_shared(scene: Scene, n: int) -> None:
    own, steps = scene.leading[n], scene.experiment.steps
    for k, other in enumerate(scene.leading):
        alike = {*own.axes} & {*other.axes} and own.group.leads(steps) and other.group.leads(steps)
        shared = np.intersect1d(own.rows, other.rows)
        if k != n and alike and len(shared):
            x, y = scene.raster.reference(shared[:1])[0]
            raise ExperimentError(
                f"leader groups {min(k, n)} and {max(k, n)} share the particle at ({x:g}, {y:g}), "
                "and the displacement of a measured boundary is estimated by itself, so that there "
                "would be two of it; select it in one group, by a box that ends before the corner, "
                "or let `modes: 0` take boundaries as they were measured",
                ("leaders", n, "select"),
            )


def _polynomials(at: Floats, modes: int, n: int) -> Floats:
    """Legendre's along a line, (particle, mode)."""
    middle = at.mean(axis=0)
    _, sizes, ways = np.linalg.svd(at - middle, full_matrices=False)
    if sizes[1] > STRAIGHT * sizes[0]:
        raise ExperimentError(
            "the particles of a measured boundary should lie on a line, so that their displacement "
            "can be smooth along it",
            ("leaders", n, "select"),
        )
    if len(at) < modes:
        raise ExperimentError(
            f"{modes} modes are more than the {len(at)} particles of the boundary; take fewer",
            ("leaders", n, "select"),
        )
    along = (at - middle) @ ways[0]
    return np.polynomial.legendre.legvander(along / np.abs(along).max(), modes - 1)
