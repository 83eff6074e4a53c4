"""What obstacles do to a body."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from pbdkit.components.fields import Modulus
from pbdkit.components.forces import Thickness, contact_pushes, forces_on_particles
from pbdkit.interfaces import Diagnostic, Moment, Variable
from pbdkit.interfaces.diagnostic import Need
from pbdkit.interfaces.units import FORCE, unset


class Contact(Diagnostic):
    """The force that each obstacle exerts on the body, and on every particle.

    On a follower that touches an obstacle, f = max(0, -F·n) n: what balances the force F of its
    neighbours and of loads along the normal n out of the obstacle. On one that touches several, or
    lies where two sides of one meet, the pushes along all normals balance F together. On a guided
    particle they balance it along the axis along which it follows.
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
        forces, touching = forces_on_particles(now), now.touching()
        each, sums = 0.0 * forces, np.zeros((len(touching), 2))  # NaN at frame points
        size = self.youngs_modulus * self.thickness
        for n, pushes in enumerate(contact_pushes(now, touching, forces)):
            np.add.at(each, touching[n].rows, size * pushes)
            sums[n] = size * pushes.sum(axis=0)
        return sums, each
