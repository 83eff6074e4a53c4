"""What a body feels at each particle: strain, rotation and stress."""

from __future__ import annotations

import math
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
ROOT_3, ROOT_12 = math.sqrt(3.0), math.sqrt(12.0)


class Strain(Diagnostic):
    """The strain of every body particle inside the outline; 0 where no cell is.

    From the displacement gradient H = ∂u/∂X of the cells around the particle. `measure: small` is
    ε = (H + Hᵀ)/2, which takes rotations for strain; `green-lagrange`, for finite deformation, is
    (FᵀF - 1)/2 = (H + Hᵀ + HᵀH)/2 with F = 1 + H, which does not. xy is the tensor's component,
    half the angle of shear. The equivalent strain is that of von Mises where the volume stays,
    √(2/3 ε:ε) with ε_zz = -(ε_xx + ε_yy): (2/√3) √(ε_xx² + ε_yy² + ε_xx ε_yy + ε_xy²). Principal
    values are those in the plane.
    """

    type: Literal["strain"] = "strain"
    measure_: Measure = "small"

    local: ClassVar[bool] = True
    needs: ClassVar[frozenset[Need]] = frozenset({"cells"})

    def variables(self) -> tuple[Variable, ...]:
        """`strain_xx`, or `green_lagrange_xx`, and so on; `_von_mises`, `_principal`."""
        name = "strain" if self.measure_ == "small" else "green_lagrange"
        meaning = "small strain" if self.measure_ == "small" else "Green-Lagrange strain"
        return _components(name, meaning, f"equivalent {meaning}", "1")

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """(xx, yy, xy, the equivalent strain, principal strains)."""
        xx, yy, xy = strain(now.cells.gradient(), self.measure_)
        equivalent = 2.0 * np.hypot(np.hypot((xx + yy) / 2, (xx - yy) / ROOT_12), xy / ROOT_3)
        return _inside(now, xx, yy, xy, equivalent, principal(xx, yy, xy))


class Rotation(Diagnostic):
    """The angle by which the surroundings of every body particle inside the outline have turned,
    counterclockwise, from -π to π; 0 where no cell is.

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
        return _inside(now, np.arctan2(H[:, 1, 0] - H[:, 0, 1], 2.0 + H[:, 0, 0] + H[:, 1, 1]))


class Stress(Diagnostic):
    """The stress of every body particle inside the outline in the material that the rule is
    calibrated to, in plane stress or plane strain as the rule; 0 where no cell is.

    Young's modulus times the rule's stiffness times the strain, less what softened bonds of the
    cells around no longer carry. With `measure: small` it is the
    Cauchy stress of linear elasticity; with `green-lagrange`, for finite rotation (rule `springs`),
    the second Piola-Kirchhoff stress. The stress of von Mises counts σ_zz, which is 0 in plane
    stress and ν (σ_xx + σ_yy) in plane strain; principal values are those in the plane.
    """

    type: Literal["stress"] = "stress"
    youngs_modulus: Modulus = Field(default_factory=unset)
    measure_: Measure = "small"

    local: ClassVar[bool] = True
    needs: ClassVar[frozenset[Need]] = frozenset({"cells", "material"})

    def variables(self) -> tuple[Variable, ...]:
        """`stress_xx`, or `piola_kirchhoff_xx`, and so on; `_von_mises`, `_principal`."""
        name = "stress" if self.measure_ == "small" else "piola_kirchhoff"
        meaning = "stress" if self.measure_ == "small" else "second Piola-Kirchhoff stress"
        return _components(name, meaning, f"von Mises {meaning}", STRESS.lattice)

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """(xx, yy, xy, the stress of von Mises, principal stresses)."""
        c, E = now.forces.stiffness, self.youngs_modulus
        e_xx, e_yy, e_xy = strain(now.cells.gradient(), self.measure_)
        xx, yy, xy = c.xx * e_xx + c.xy * e_yy, c.xy * e_xx + c.yy * e_yy, 2 * c.shear * e_xy
        if (lost := now.cells.lost_stress()) is not None:
            xx, yy, xy = self._less(now, lost, xx, yy, xy)
        xx, yy, xy = E * xx, E * yy, E * xy
        zz = now.forces.through_thickness * (xx + yy)
        apart = np.hypot(np.hypot(xx - yy, yy - zz), zz - xx) / math.sqrt(2.0)
        return _inside(now, xx, yy, xy, np.hypot(apart, ROOT_3 * xy), principal(xx, yy, xy))

    def _less(self, now: Moment, lost: Floats, *stress: Floats) -> tuple[Floats, ...]:
        """The stress without what softened bonds no longer carry, P = F S."""
        if self.measure_ == "green-lagrange":
            lost = np.linalg.solve(np.nan_to_num(now.cells.gradient()) + np.eye(2), lost)
        xx, yy = lost[:, 0, 0], lost[:, 1, 1]
        xy = (lost[:, 0, 1] + lost[:, 1, 0]) / 2
        return tuple(value - part for value, part in zip(stress, (xx, yy, xy), strict=True))


def strain(H: Floats, measure: Measure) -> tuple[Floats, Floats, Floats]:
    """(xx, yy, xy), each (particle,), of displacement gradients H (particle, component, axis)."""
    tensor = H + np.swapaxes(H, 1, 2)
    if measure == "green-lagrange":
        tensor += np.einsum("nka,nkb->nab", H, H)
    tensor /= 2
    return tensor[:, 0, 0], tensor[:, 1, 1], tensor[:, 0, 1]


def principal(xx: Floats, yy: Floats, xy: Floats) -> Floats:
    """The larger and the smaller principal value of plane tensors, (particle, principal)."""
    middle, radius = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    return np.stack([middle + radius, middle - radius], axis=1)


def _inside(now: Moment, *values: Floats) -> tuple[Floats, ...]:
    """Values of particles, (particle, ...), NaN beyond the outline."""
    beyond = ~now.inside
    for value in values:
        value[beyond] = np.nan
    return values


def _components(name: str, meaning: str, equivalent: str, units: str) -> tuple[Variable, ...]:
    parts = {part: f"{meaning}, {part} component" for part in COMPONENTS}
    parts["von_mises"] = equivalent
    found = [Variable(f"{name}_{n}", ("particle",), text, units) for n, text in parts.items()]
    of_principal = ("particle", "principal"), f"principal {meaning}", units
    return (*found, Variable(f"{name}_principal", *of_principal))
