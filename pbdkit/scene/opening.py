"""The opening: the relative displacement of two particles along a direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pbdkit.array_types import Floats, Indices
from pbdkit.errors import ExperimentError
from pbdkit.model.solver import OpeningControl
from pbdkit.scene.scene import Scene
from pbdkit.scene.selection import Selecting


@dataclass(frozen=True)
class Opening:
    """Relative displacement of two particles along a direction.

    Parameters
    ----------
    place : (particle,)
        Flat places of the two particles.
    weights : (particle, axis)
        The opening is the sum of these weights times displacements.
    """

    place: Indices
    weights: Floats

    @classmethod
    def of(cls, scene: Scene) -> Opening:
        """Return the opening that controls the equilibria of a scene.

        Raises
        ------
        ExperimentError
            If both points belong to the same particle, or the lattice is not plane.
        """
        control = scene.experiment.solver.equilibrium.control
        assert isinstance(control, OpeningControl)
        if scene.axes != 2:
            raise ExperimentError("is defined for plane lattices", ("solver", "control"))
        rows = Selecting(scene.raster).nearest(control.between)
        first, second = scene.raster.reference(rows)
        if rows[0] == rows[1]:
            raise ExperimentError(
                f"both points are nearest to particle {rows[0] + 1}; choose points that are "
                "farther apart",
                ("solver", "control", "between"),
            )
        direction = np.array(control.direction or second - first)
        direction = direction / np.linalg.norm(direction)
        weights = np.array([-direction, direction])
        return cls(scene.raster.place_of(rows), weights)

    def at(self, u: Floats) -> float:
        """Return the opening at displacements, given as planes."""
        return float((u.reshape(len(u), -1)[:, self.place].T * self.weights).sum())
