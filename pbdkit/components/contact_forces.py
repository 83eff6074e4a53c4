"""What obstacles do to a body."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from pbdkit.components.fields import Modulus
from pbdkit.components.forces import Thickness
from pbdkit.interfaces import Diagnostic, Moment, Variable
from pbdkit.interfaces.diagnostic import Need
from pbdkit.interfaces.units import FORCE, unset


class Contact(Diagnostic):
    """The force that each obstacle exerts on the body, and on every particle.

    On a follower that touches an obstacle, f = max(0, -F·n) n: what balances the force F of its
    neighbours and of loads along the normal n out of the obstacle. In a corner between two
    obstacles each takes its own part.
    """

    type: Literal["contact"] = "contact"
    youngs_modulus: Modulus = Field(default_factory=unset)
    thickness: Thickness = Field(default_factory=unset)

    needs: ClassVar[frozenset[Need]] = frozenset({"forces"})

    def variables(self) -> tuple[Variable, ...]:
        """`contact_force`, `contact`."""
        name = "force that the obstacle exerts"
        here = "force that obstacles exert on the particle"
        return (
            Variable("contact_force", ("obstacle", "axis"), name, FORCE.lattice),
            Variable("contact", ("particle", "axis"), here, FORCE.lattice),
        )

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """E t times the parts along normals."""
        forces, obstacles = np.array(now.forces.on_particles()), now.touching()
        for load in now.loads():
            forces[load.rows] += np.outer(load.share, load.force)
        each, sums = 0.0 * forces, np.zeros((len(obstacles), 2))  # NaN at frame points
        size = self.youngs_modulus * self.thickness
        for n, (rows, normals) in enumerate(obstacles):
            pull = (forces[rows] * normals).sum(axis=1, keepdims=True)
            pushes = size * np.maximum(0.0, -pull) * normals
            each[rows] += pushes
            sums[n] = pushes.sum(axis=0)
        return sums, each
