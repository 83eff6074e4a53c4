"""What a body feels at each particle: strain, rotation and stress."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pbdkit.interfaces import Diagnostic, Moment, Variable
from pbdkit.interfaces.diagnostic import Need
from pbdkit.interfaces.units import STRESS, FromUnits, unset

Floats = NDArray[np.floating[Any]]
Measure = Annotated[
    Literal["small", "green-lagrange"],
    Field(
        alias="measure",
        description="Small strain, or that of finite deformation.",
        examples=["green-lagrange"],
    ),
]
Modulus = Annotated[
    float,
    Field(
        gt=0.0,
        description="E, in the units that stresses shall have, unless `units` gives it.",
        examples=[210e9],
    ),
    FromUnits("youngs_modulus"),
]
COMPONENTS = ("xx", "yy", "xy")


class Strain(Diagnostic):
    """The strain of every body particle; 0 where no cell is.

    From the displacement gradient H = ∂u/∂X of the cells around the particle. `measure: small` is
    ε = (H + Hᵀ)/2, which takes rotations for strain; `green-lagrange`, for finite deformation, is
    (FᵀF - 1)/2 = (H + Hᵀ + HᵀH)/2 with F = 1 + H, which does not. xy is the tensor's component,
    half the angle of shear.
    """

    type: Literal["strain"] = "strain"
    measure_: Measure = "small"

    local: ClassVar[bool] = True
    needs: ClassVar[frozenset[Need]] = frozenset({"cells"})

    def variables(self) -> tuple[Variable, ...]:
        """`strain_xx`, or `green_lagrange_xx`, and so on."""
        name = "strain" if self.measure_ == "small" else "green_lagrange"
        meaning = "small strain" if self.measure_ == "small" else "Green-Lagrange strain"
        return _components(name, meaning, "1")

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """(xx, yy, xy)."""
        return strain(now.cells.gradient(), self.measure_)


class Rotation(Diagnostic):
    """The angle by which the surroundings of every body particle have turned, counterclockwise,
    from -π to π; 0 where no cell is.

    That of R in the polar decomposition F = R U: atan2(F_yx - F_xy, F_xx + F_yy).
    """

    type: Literal["rotation"] = "rotation"

    local: ClassVar[bool] = True
    needs: ClassVar[frozenset[Need]] = frozenset({"cells"})

    def variables(self) -> tuple[Variable, ...]:
        """`rotation`."""
        return (Variable("rotation", ("particle",), "angle of rotation", "rad"),)

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """The angle."""
        H = now.cells.gradient()
        return (np.arctan2(H[:, 1, 0] - H[:, 0, 1], 2.0 + H[:, 0, 0] + H[:, 1, 1]),)


class Stress(Diagnostic):
    """The stress of every body particle in the material that the rule is calibrated to, in plane
    stress or plane strain as the rule; 0 where no cell is.

    Young's modulus times the rule's stiffness times the strain. With `measure: small` it is the
    Cauchy stress of linear elasticity; with `green-lagrange`, for finite rotation (rule `springs`),
    the second Piola-Kirchhoff stress.
    """

    type: Literal["stress"] = "stress"
    youngs_modulus: Modulus = Field(default_factory=unset)
    measure_: Measure = "small"

    local: ClassVar[bool] = True
    needs: ClassVar[frozenset[Need]] = frozenset({"cells", "material"})

    def variables(self) -> tuple[Variable, ...]:
        """`stress_xx`, or `piola_kirchhoff_xx`, and so on."""
        name = "stress" if self.measure_ == "small" else "piola_kirchhoff"
        meaning = "stress" if self.measure_ == "small" else "second Piola-Kirchhoff stress"
        return _components(name, meaning, STRESS.lattice)

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """(xx, yy, xy)."""
        c, E = now.forces.stiffness, self.youngs_modulus
        xx, yy, xy = strain(now.cells.gradient(), self.measure_)
        return E * (c.xx * xx + c.xy * yy), E * (c.xy * xx + c.yy * yy), E * (2 * c.shear * xy)


def strain(H: Floats, measure: Measure) -> tuple[Floats, Floats, Floats]:
    """(xx, yy, xy), each (particle,), of displacement gradients H (particle, component, axis)."""
    tensor = H + np.swapaxes(H, 1, 2)
    if measure == "green-lagrange":
        tensor += np.einsum("nka,nkb->nab", H, H)
    tensor /= 2
    return tensor[:, 0, 0], tensor[:, 1, 1], tensor[:, 0, 1]


def _components(name: str, meaning: str, units: str) -> tuple[Variable, ...]:
    return tuple(
        Variable(f"{name}_{part}", ("particle",), f"{meaning}, {part} component", units)
        for part in COMPONENTS
    )
