"""Built-in diagnostics: pseudo-energies, displacements, tracks and broken bonds of the paper;
strain, rotation and stress at particles; reactions, strain energy and load curves; contact
forces."""

from __future__ import annotations

import math
from itertools import combinations
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pbdkit.array_types import Floats
from pbdkit.errors import ExperimentError
from pbdkit.plugin import Diagnostic, Moment, TouchingRows, Variable, Vector, length
from pbdkit.plugin.diagnostic import Need
from pbdkit.plugin.fracture_model import breaking_order
from pbdkit.plugin.lattice import area_share
from pbdkit.plugin.units import AREA, ENERGY, FORCE, LENGTH, STRESS, FromUnits, Place, unset


class PE1(Diagnostic):
    """Pseudo-energy PE1_j = Σ_k (|x_j - x_k| - |X_j - X_k|)² over all reference neighbours.

    It is evaluated at every particle of the body, including leaders. The sum includes broken bonds
    and bonds to frame points.
    """

    type: Literal["pe1"] = "pe1"

    local: ClassVar[bool] = True
    needs: ClassVar[frozenset[Need]] = frozenset({"bonds"})

    def variables(self) -> tuple[Variable, ...]:
        """Declare the variable `pe1`."""
        return (Variable("pe1", ("particle",), "pseudo-energy PE1", AREA.lattice),)

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Return the sum of squared extensions."""
        return (now.sum_over_neighbours(_squared_extension),)


class PE1Intact(Diagnostic):
    """Pseudo-energy PE1 over unbroken bonds only."""

    type: Literal["pe1-intact"] = "pe1-intact"

    local: ClassVar[bool] = True
    needs: ClassVar[frozenset[Need]] = frozenset({"bonds"})

    def variables(self) -> tuple[Variable, ...]:
        """Declare the variable `pe1_intact`."""
        name = "pseudo-energy PE1 of intact bonds"
        return (Variable("pe1_intact", ("particle",), name, AREA.lattice),)

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Return the sum of squared extensions of intact bonds."""
        return (now.sum_over_neighbours(_squared_extension, intact_only=True),)


class PE2(Diagnostic):
    """Pseudo-energy PE2_j(t) = |x_j(t) - x_j(t-1)|, 0 at time 0.

    The previous step is used even if it is not recorded.
    """

    type: Literal["pe2"] = "pe2"

    local: ClassVar[bool] = True

    def variables(self) -> tuple[Variable, ...]:
        """Declare the variable `pe2`."""
        return (Variable("pe2", ("particle",), "pseudo-energy PE2", LENGTH.lattice),)

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Return the length of the last move."""
        move = now.displacement() - now.previous_displacement()
        return (np.sqrt((move * move).sum(axis=1)),)


class Displacement(Diagnostic):
    """Displacement u = x - X, with a precision that does not depend on the position of the body."""

    type: Literal["displacement"] = "displacement"

    local: ClassVar[bool] = True

    def variables(self) -> tuple[Variable, ...]:
        """Declare the variable `u`."""
        return (Variable("u", ("particle", "axis"), "displacement", LENGTH.lattice),)

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Return the displacements of particles."""
        return (now.displacement(),)


class Track(Diagnostic):
    """Positions of selected particles at every step."""

    type: Literal["track"] = "track"
    numbers: Annotated[
        tuple[Annotated[int, Field(ge=1, lt=2**62)], ...], Field(strict=False, min_length=1)
    ] = Field(description="Numbers of the particles that are tracked.", examples=[[3, 1]])

    every_step: ClassVar[bool] = True

    def variables(self) -> tuple[Variable, ...]:
        """Declare the variable `track`."""
        return (
            Variable("track", ("tracked", "axis"), "position of tracked particles", LENGTH.lattice),
        )

    def check(self, particles: int, leader_groups: int) -> None:
        """Raise ExperimentError for a number that no particle has."""
        refuse_numbers_beyond(particles, self.numbers)

    def coordinates(self) -> dict[str, NDArray[Any]]:
        """Return `tracked`, the numbers of the particles."""
        return {"tracked": np.array(self.numbers, np.int64)}

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Return X + u of the selected particles."""
        rows = now.rows(self.numbers)
        return (now.reference(rows) + now.displacement(rows),)


class BrokenBonds(Diagnostic):
    """Number of broken bonds, including those with an end in the frame or outside the outline."""

    type: Literal["broken"] = "broken"

    def variables(self) -> tuple[Variable, ...]:
        """Declare the variable `broken_bonds`."""
        return (Variable("broken_bonds", (), "number of broken bonds", "1", dtype="i8"),)

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Return the number of broken bonds."""
        return (now.broken_bonds(),)


class SmallestCellArea(Diagnostic):
    """Smallest signed area of a cell, relative to its area at rest.

    It is 1 at rest, 0 if a cell is flat and negative if a cell is inverted. Cells with broken bonds
    are included. Cells with a corner that does not belong to the body are excluded.
    """

    type: Literal["smallest-cell-area"] = "smallest-cell-area"

    needs: ClassVar[frozenset[Need]] = frozenset({"cells"})

    def variables(self) -> tuple[Variable, ...]:
        """Declare the variable `smallest_cell_area`."""
        name = "smallest signed cell area over that at rest, negative inside out"
        return (Variable("smallest_cell_area", (), name, "1"),)

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Return the minimum over all cells."""
        return (now.cells.over(area_share).min(),)


class CrackPath(Diagnostic):
    """Broken bonds in the order in which they broke, and in a step by decreasing strain.

    In each step bonds that were cut come before all others. They have no strain, and neither have
    bonds that were broken from the start.
    """

    type: Literal["crack-path"] = "crack-path"

    needs: ClassVar[frozenset[Need]] = frozenset({"bonds"})
    at_end: ClassVar[bool] = True
    own_dimension: ClassVar[str] = "crack"

    def variables(self) -> tuple[Variable, ...]:
        """Declare `crack_bond`, `crack_step`, `crack_strain` and `crack_midpoint`."""
        crack, no_strain = ("crack",), "NaN if the bond was cut, or broken from the start"
        midpoint = "reference position of the middle of the broken bond"
        return (
            Variable("crack_bond", crack, "number of the broken bond", "1", dtype="i8"),
            Variable("crack_step", crack, "time of breaking", "step", dtype="i4"),
            Variable(
                "crack_strain", crack, "strain at breaking", "1", attributes={"comment": no_strain}
            ),
            Variable("crack_midpoint", (*crack, "axis"), midpoint, LENGTH.lattice),
        )

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Return number, step, strain and midpoint of each broken bond."""
        bonds = now.bonds()
        step, strain = bonds.broken_step, bonds.broken_strain
        order = breaking_order(step, strain)
        return order + 1, step[order], strain[order], bonds.midpoint[order]


def _squared_extension(d: Vector, r: Vector) -> Any:
    extension = length(Vector(r.x + d.x, r.y + d.y)) - length(r)
    return extension * extension


def refuse_numbers_beyond(particles: int, numbers: tuple[int, ...]) -> None:
    """Raise ExperimentError for a number that no particle has."""
    for n, number in enumerate(numbers):
        if number > particles:
            text = f"there is no particle {number}; they are numbered 1 to {particles}"
            raise ExperimentError(text, ("numbers", n))


Measure = Annotated[
    Literal["small", "green-lagrange"],
    Field(
        alias="measure",
        description="Small strain, or Green-Lagrange strain for finite deformation.",
        examples=["green-lagrange"],
    ),
]
"""Type of the parameter `measure`: small or Green-Lagrange strain."""
Modulus = Annotated[
    float,
    Field(
        gt=0.0,
        description="Young's modulus, in the unit of the stresses; by default that of `units`.",
        examples=[210e9],
    ),
    FromUnits("youngs_modulus"),
]
"""Type of Young's modulus as a parameter."""
COMPONENTS = ("xx", "yy", "xy")
"""Names of the components of a plane symmetric tensor."""
ROOT_3 = math.sqrt(3.0)
"""Square root of 3."""
ROOT_12 = math.sqrt(12.0)
"""Square root of 12."""


class Strain(Diagnostic):
    """Strain of the particles inside the outline of the body; 0 at a particle without cells.

    The strain is computed from the displacement gradient H = ∂u/∂X of the cells around the
    particle. With `measure: small` it is ε = (H + Hᵀ)/2, which is not invariant under rotations.
    With `measure: green-lagrange`, for finite deformation, it is (FᵀF - 1)/2 = (H + Hᵀ + HᵀH)/2
    with F = 1 + H. The component xy is that of the tensor, half the engineering shear strain. The
    equivalent strain is the von Mises strain √(2/3 ε:ε) at constant volume, that is, with ε_zz =
    -(ε_xx + ε_yy). It is equal to (2/√3) √(ε_xx² + ε_yy² + ε_xx ε_yy + ε_xy²). Principal values are
    those in the plane.
    """

    type: Literal["strain"] = "strain"
    measure_: Measure = "small"

    local: ClassVar[bool] = True
    needs: ClassVar[frozenset[Need]] = frozenset({"cells"})

    def variables(self) -> tuple[Variable, ...]:
        """Declare `strain_xx` or `green_lagrange_xx`, the other components, `_von_mises` and
        `_principal`.
        """
        name = "strain" if self.measure_ == "small" else "green_lagrange"
        meaning = "small strain" if self.measure_ == "small" else "Green-Lagrange strain"
        return _components(name, meaning, f"equivalent {meaning}", "1")

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Return xx, yy, xy, the equivalent strain and the principal strains."""
        xx, yy, xy = strain(now.cells.gradient(), self.measure_)
        equivalent = 2.0 * np.hypot(np.hypot((xx + yy) / 2, (xx - yy) / ROOT_12), xy / ROOT_3)
        return _inside(now, xx, yy, xy, equivalent, principal(xx, yy, xy))


class LocalRotation(Diagnostic):
    """Rotation angle of the cells around each particle inside the outline; 0 without cells.

    With the polar decomposition F = R U, it is the angle of the rotation R, counterclockwise from
    -π to π: atan2(F_yx - F_xy, F_xx + F_yy).
    """

    type: Literal["rotation"] = "rotation"

    local: ClassVar[bool] = True
    needs: ClassVar[frozenset[Need]] = frozenset({"cells"})

    def variables(self) -> tuple[Variable, ...]:
        """Declare the variable `rotation`."""
        return (Variable("rotation", ("particle",), "angle of rotation", "rad"),)

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Return the angle of rotation."""
        H = now.cells.gradient()
        return _inside(now, np.arctan2(H[:, 1, 0] - H[:, 0, 1], 2.0 + H[:, 0, 0] + H[:, 1, 1]))


class Stress(Diagnostic):
    """Stress of the particles inside the outline of the body; 0 at a particle without cells.

    The stress is computed from the strain with Young's modulus and the stiffness of the calibrated
    rule, in plane stress or plane strain as in the rule. The stress that softened bonds of the
    surrounding cells have lost is subtracted. With `measure: small` it is the Cauchy stress of
    linear elasticity. With `measure: green-lagrange`, which is meant for finite rotations (rule
    `springs`), it is the second Piola-Kirchhoff stress. The von Mises stress includes σ_zz, which
    is 0 in plane stress and ν (σ_xx + σ_yy) in plane strain. Principal values are those in the
    plane.
    """

    type: Literal["stress"] = "stress"
    youngs_modulus: Modulus = Field(default_factory=unset)
    measure_: Measure = "small"

    local: ClassVar[bool] = True
    needs: ClassVar[frozenset[Need]] = frozenset({"cells", "material"})

    def variables(self) -> tuple[Variable, ...]:
        """Declare `stress_xx` or `piola_kirchhoff_xx`, the other components, `_von_mises`,
        `_principal`.
        """
        name = "stress" if self.measure_ == "small" else "piola_kirchhoff"
        meaning = "stress" if self.measure_ == "small" else "second Piola-Kirchhoff stress"
        return _components(name, meaning, f"von Mises {meaning}", STRESS.lattice)

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Return xx, yy, xy, the von Mises stress and the principal stresses."""
        c, E = now.forces.stiffness, self.youngs_modulus
        e_xx, e_yy, e_xy = strain(now.cells.gradient(), self.measure_)
        xx, yy, xy = c.xx * e_xx + c.xy * e_yy, c.xy * e_xx + c.yy * e_yy, 2 * c.shear * e_xy
        if (lost_stress := now.cells.lost_stress()) is not None:
            xx, yy, xy = self._subtract(now, lost_stress, xx, yy, xy)
        xx, yy, xy = E * xx, E * yy, E * xy
        zz = now.forces.through_thickness * (xx + yy)
        deviator = np.hypot(np.hypot(xx - yy, yy - zz), zz - xx) / math.sqrt(2.0)
        return _inside(now, xx, yy, xy, np.hypot(deviator, ROOT_3 * xy), principal(xx, yy, xy))

    def _subtract(self, now: Moment, lost: Floats, *stress: Floats) -> tuple[Floats, ...]:
        """Subtract the stress that softened bonds have lost, which is a first Piola-Kirchhoff
        stress."""
        # S = F⁻¹ P
        if self.measure_ == "green-lagrange":
            lost = np.linalg.solve(np.nan_to_num(now.cells.gradient()) + np.eye(2), lost)
        xx, yy = lost[:, 0, 0], lost[:, 1, 1]
        xy = (lost[:, 0, 1] + lost[:, 1, 0]) / 2
        return tuple(value - part for value, part in zip(stress, (xx, yy, xy), strict=True))


def strain(H: Floats, measure: Measure) -> tuple[Floats, Floats, Floats]:
    """Compute the strain from the displacement gradient.

    Parameters
    ----------
    H
        Displacement gradients, (particle, component, axis).
    measure
        ``"small"`` for (H + Hᵀ)/2, ``"green-lagrange"`` for (H + Hᵀ + HᵀH)/2.

    Returns
    -------
    tuple
        Components xx, yy and xy of the tensors, each (particle,).
    """
    tensor = H + np.swapaxes(H, 1, 2)
    if measure == "green-lagrange":
        tensor += np.einsum("nka,nkb->nab", H, H)
    tensor /= 2
    return tensor[:, 0, 0], tensor[:, 1, 1], tensor[:, 0, 1]


def principal(xx: Floats, yy: Floats, xy: Floats) -> Floats:
    """Return the larger and the smaller principal value of plane tensors, (particle, principal)."""
    middle, radius = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    return np.stack([middle + radius, middle - radius], axis=1)


def _inside(now: Moment, *values: Floats) -> tuple[Floats, ...]:
    """Set the values of particles outside the outline to NaN, in arrays (particle, ...)."""
    outside = ~now.inside
    for value in values:
        value[outside] = np.nan
    return values


def _components(name: str, meaning: str, equivalent: str, units: str) -> tuple[Variable, ...]:
    parts = {part: f"{meaning}, {part} component" for part in COMPONENTS}
    parts["von_mises"] = equivalent
    variables = [Variable(f"{name}_{n}", ("particle",), text, units) for n, text in parts.items()]
    dims = ("particle", "principal")
    return (*variables, Variable(f"{name}_principal", dims, f"principal {meaning}", units))


Thickness = Annotated[
    float,
    Field(
        gt=0.0,
        description="Thickness of the body; by default that of `units`, or 1.",
        examples=[2.0],
    ),
    FromUnits("thickness", otherwise=1.0),
]
"""Type of the thickness of the body as a parameter."""
Group = Annotated[int, Field(ge=0)]
"""Type of the index of a leader group, from 0."""
TwoNumbers = Annotated[
    tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]], Field(strict=False)
]
"""Type of the numbers of two particles."""
TwoPoints = Annotated[tuple[Place, Place], Field(strict=False)]
"""Type of two points."""


class StrainEnergy(Diagnostic):
    """Strain energy of the body.

    For a linear calibrated rule with the stiffness K, it is ½ uᵀK u, for a nonlinear rule
    ('springs') the energy of the bonds. With a frame that has points, it is -½ Σ u·f with the
    forces f. In linear elasticity, this is the work of the leaders.
    """

    type: Literal["strain-energy"] = "strain-energy"
    youngs_modulus: Modulus = Field(default_factory=unset)
    thickness: Thickness = Field(default_factory=unset)

    needs: ClassVar[frozenset[Need]] = frozenset({"forces"})

    def variables(self) -> tuple[Variable, ...]:
        """Declare the variable `strain_energy`."""
        return (Variable("strain_energy", (), "strain energy", ENERGY.lattice),)

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Return the energy of the rule, multiplied by Young's modulus and the thickness."""
        return (self.youngs_modulus * self.thickness * now.forces.energy(),)


class Reaction(Diagnostic):
    """Reaction force of each leader group; 0 while the group is inactive.

    The reaction is minus the sum of the forces that neighbours and loads exert on the particles of
    the group. For a particle in two groups, half of these forces is assigned to each group. If a
    group prescribes the motion along some axes only, its reaction is 0 along the other axes. Along
    the prescribed axes the reaction includes the forces of obstacles on the particles of the group.
    With the natural frame the reactions of all groups, the loads and the forces of obstacles sum to
    zero. In other frames, frame points exert forces too. At the corners of prescribed edges these
    forces are artefacts of the frame, and a warning is issued.
    """

    type: Literal["reaction"] = "reaction"
    youngs_modulus: Modulus = Field(default_factory=unset)
    thickness: Thickness = Field(default_factory=unset)

    needs: ClassVar[frozenset[Need]] = frozenset({"forces"})

    def variables(self) -> tuple[Variable, ...]:
        """Declare the variable `reaction`."""
        name = "force that the leader group exerts"
        return (Variable("reaction", ("leader_group", "axis"), name, FORCE.lattice),)

    def check(self, particles: int, leader_groups: int) -> None:
        """Raise ExperimentError if the experiment has no leaders."""
        if leader_groups == 0:
            raise ExperimentError(f"'{self.type}' requires leader groups; the experiment has none")

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Return the reactions, multiplied by Young's modulus and the thickness."""
        return (self.youngs_modulus * self.thickness * reactions(now),)


class LoadDisplacement(Diagnostic):
    """Load-displacement curve of each load.

    The curve consists of the resultant of the load, which is 0 while the load does not act, and the
    mean displacement of its particles. The mean is weighted by the shares of the particles in the
    load, so that the area under the curve is the work of the load.
    """

    type: Literal["load-displacement"] = "load-displacement"
    youngs_modulus: Modulus = Field(default_factory=unset)
    thickness: Thickness = Field(default_factory=unset)

    needs: ClassVar[frozenset[Need]] = frozenset({"loads"})

    def variables(self) -> tuple[Variable, ...]:
        """Declare `load_resultant` and `load_displacement`."""
        dims, mean = ("load", "axis"), "mean displacement of the load's particles"
        return (
            Variable("load_resultant", dims, "resultant of the load", FORCE.lattice),
            Variable("load_displacement", dims, mean, LENGTH.lattice),
        )

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Return E t times the resultants, and the mean displacements."""
        loads = now.loads()
        resultant = np.stack([load.share.sum() * load.force for load in loads])
        means = [load.share @ now.displacement(load.rows) / load.share.sum() for load in loads]
        return self.youngs_modulus * self.thickness * resultant, np.stack(means)


class StressStrain(Diagnostic):
    """Stress-strain curve of a tensile test along `axis`.

    The nominal stress is a reaction along the axis, divided by the initial cross-section. The
    reaction is that of the leader group `group`, an index among the leaders of the experiment, from
    0. The cross-section is `width` times the thickness, so that the stress does not depend on the
    thickness. The nominal strain is the elongation of the gauge along the axis, divided by the
    initial length of the gauge. The ends of the gauge are the body particles nearest to two
    `points`, or two particles given by `numbers`, or by default the mean positions of the groups
    `group` and `against`.
    """

    type: Literal["stress-strain"] = "stress-strain"
    youngs_modulus: Modulus = Field(default_factory=unset)
    width: Annotated[float, Field(gt=0.0), LENGTH] = Field(
        description="Width of the initial cross-section (lattice units).", examples=[2.5]
    )
    axis: Literal["x", "y"] = Field("x", description="The axis of loading.", examples=["x"])
    group: Group = Field(1, description="Index of the pulling leader group.", examples=[1])
    against: Group = Field(0, description="Index of the opposite leader group.", examples=[0])
    points: TwoPoints | None = Field(
        None,
        description="Ends of the gauge length; the nearest particles are used.",
        examples=[((0.0, 0.0), (1.0, 0.0))],
    )
    numbers: TwoNumbers | None = Field(
        None, description="Ends of the gauge length, as numbers of particles.", examples=[(1, 30)]
    )

    needs: ClassVar[frozenset[Need]] = frozenset({"forces"})

    @model_validator(mode="after")
    def _one_gauge(self) -> StressStrain:
        if self.points and self.numbers:
            raise ValueError("the gauge has both points and numbers; give only one of them")
        return self

    def variables(self) -> tuple[Variable, ...]:
        """Declare `nominal_stress` and `nominal_strain`."""
        return (
            Variable("nominal_stress", (), "nominal stress", STRESS.lattice),
            Variable("nominal_strain", (), "nominal strain", "1"),
        )

    def check(self, particles: int, leader_groups: int) -> None:
        """Raise ExperimentError for numbers and leader groups that do not exist."""
        refuse_numbers_beyond(particles, self.numbers or ())
        by_leaders = not (self.points or self.numbers)
        for name in ("group", "against") if by_leaders else ("group",):
            if (group := getattr(self, name)) >= leader_groups:
                numbers = f"there are {leader_groups}, counted from 0"
                raise ExperimentError(f"there is no leader group {group}; {numbers}", (name,))

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Return nominal stress and nominal strain."""
        axis = "xy".index(self.axis)
        start, end = self._ends(now)
        first, last = (now.reference(rows)[:, axis].mean() for rows in (start, end))
        if abs(last - first) <= 1e-9 * max(abs(first), abs(last)):
            raise ExperimentError(
                f"the gauge has no length along {self.axis}: both ends are at {first:g}; choose "
                "points that differ along this axis"
            )
        u, v = (now.displacement(rows)[:, axis].mean() for rows in (start, end))
        group_position = now.reference(now.leader_groups()[self.group].rows)[:, axis].mean()
        outwards = group_position - (first + last) / 2
        if abs(outwards) <= 1e-9 * max(abs(first), abs(last)):
            raise ExperimentError(
                f"leader group {self.group} is in the middle of the gauge along {self.axis}, at "
                f"{group_position:g}, so that tension and compression cannot be distinguished; "
                "choose points with the middle at one side of the group, or another group"
            )
        pull = np.sign(outwards) * reactions(now)[self.group, axis]
        return self.youngs_modulus * pull / self.width, (v - u) / (last - first)

    def _ends(self, now: Moment) -> tuple[Any, Any]:
        """Return the rows at the start and at the end of the gauge."""
        if self.points or self.numbers:
            rows = now.nearest(self.points) if self.points else now.rows(self.numbers or ())
            return rows[:1], rows[1:]
        groups = now.leader_groups()
        return groups[self.against].rows, groups[self.group].rows


MIN_SINE = 1e-6
"""Two normals are treated as parallel if the sine of their angle is below this number.

It also limits the sine below which a normal is treated as perpendicular to an axis.
"""
RESIDUAL_RTOL = 1e-9
"""Relative difference between residuals below which two sets of contact forces are equally good."""


def reactions(now: Moment) -> Floats:
    """Compute the reaction of each leader group, divided by Young's modulus and thickness.

    Returns
    -------
    NDArray
        Reactions of shape (leader group, axis); 0 along axes on which no motion is prescribed.
    """
    forces, groups = forces_on_particles(now), now.leader_groups()
    touching = now.touching()
    pushes = contact_pushes(now, touching, forces)
    for contact, push in zip(touching, pushes, strict=True):
        np.add.at(forces, contact.rows, push)
    counts, result = np.zeros(forces.shape), np.zeros((len(groups), forces.shape[1]))
    active = [(n, group.rows, list(group.axes)) for n, group in enumerate(groups) if group.leads]
    for _, rows, axes in active:
        counts[rows[:, None], axes] += 1
    for n, rows, axes in active:
        share = forces[rows] / np.maximum(counts[rows], 1)
        result[n, axes] = 0.0 - share.sum(axis=0)[axes]
    return result


def forces_on_particles(now: Moment) -> Floats:
    """Return the forces of neighbours and loads, (particle, axis).

    They are divided by Young's modulus and thickness.
    """
    forces = np.array(now.forces.on_particles())
    for load in now.loads():
        forces[load.rows] += np.outer(load.share, load.force)
    return forces


def contact_pushes(now: Moment, touching: tuple[TouchingRows, ...], forces: Floats) -> list[Floats]:
    """Compute the contact forces of each obstacle on the rows that touch it.

    Parameters
    ----------
    now
        State of the run at the step.
    touching
        Rows of the particles that touch each obstacle, with the normals of the obstacle at the
        particles.
    forces
        Forces on particles divided by Young's modulus and thickness, (particle, axis).

    Returns
    -------
    list
        Contact forces of each obstacle, (row, axis). They are nonnegative multiples of the normals
        and balance the forces in the least-squares sense. Only the axes along which a particle is a
        follower are considered.
    """
    if not touching:
        return []
    rows = np.concatenate([contact.rows for contact in touching])
    normals = np.concatenate([contact.normals for contact in touching])
    follows = np.ones((len(rows), 2))
    for group in now.leader_groups():
        if group.leads:
            follows[np.isin(rows, group.rows)[:, None] & np.isin([0, 1], group.axes)] = 0.0
    targets, directions = -forces[rows] * follows, normals * follows
    sizes = _single_pushes(targets, directions)
    order, count = np.unique(rows, return_inverse=True, return_counts=True)[1:]
    for n in np.flatnonzero(count > 1).tolist():
        entries = np.flatnonzero(order == n)
        sizes[entries] = _joint_pushes(targets[entries[0]], directions[entries])
    ends = np.cumsum([len(contact.rows) for contact in touching])[:-1]
    return np.split(sizes[:, None] * normals, ends)


def _single_pushes(targets: Floats, directions: Floats) -> Floats:
    """Return the number λ ≥ 0 that minimises |λ · direction - target|, for each target."""
    squares = (directions * directions).sum(axis=-1)
    is_pushed = squares > MIN_SINE * MIN_SINE
    sizes = np.maximum(0.0, (targets * directions).sum(axis=-1)) / np.where(is_pushed, squares, 1.0)
    return np.where(is_pushed, sizes, 0.0)


def _joint_pushes(target: Floats, directions: Floats) -> Floats:
    """Return the numbers λ ≥ 0 that minimise |Σ λ · direction - target|, one for each direction.

    The result is the mean over all minimisers with at most two nonzero entries, so that it does not
    depend on the order of the directions.
    """
    singles = _single_pushes(target[None], directions)
    candidates = [size * unit for size, unit in zip(singles, np.eye(len(directions)), strict=True)]
    for a, b in combinations(range(len(directions)), 2):
        pair = directions[[a, b]].T
        if abs(np.linalg.det(pair)) > MIN_SINE:
            sizes = np.linalg.solve(pair, target)
            if (sizes >= 0.0).all():
                candidates.append(np.zeros(len(directions)))
                candidates[-1][[a, b]] = sizes
    residuals = np.array([math.hypot(*(sizes @ directions - target)) for sizes in candidates])
    best = residuals <= residuals.min() + RESIDUAL_RTOL * math.hypot(*target)
    return np.asarray(np.array(candidates)[best].mean(axis=0))


class ContactForces(Diagnostic):
    """Force of each obstacle on the body and on every particle.

    A follower that touches one obstacle is subject to the contact force f = max(0, -F·n) n. It
    balances the force F of neighbours and loads along the outward normal n of the obstacle. If a
    follower touches several obstacles, or an edge at which two sides of an obstacle meet, the
    contact forces along all normals balance F together. If the motion of a particle is prescribed
    along one axis, contact forces balance F along the other axis.
    """

    type: Literal["contact"] = "contact"
    youngs_modulus: Modulus = Field(default_factory=unset)
    thickness: Thickness = Field(default_factory=unset)

    needs: ClassVar[frozenset[Need]] = frozenset({"forces"})

    def variables(self) -> tuple[Variable, ...]:
        """Declare `contact_force` and `contact`."""
        name = "force that the obstacle exerts"
        on_particle = "force that obstacles exert on the particle"
        return (
            Variable("contact_force", ("obstacle", "axis"), name, FORCE.lattice),
            Variable("contact", ("particle", "axis"), on_particle, FORCE.lattice),
        )

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Return contact forces by obstacle and by particle, multiplied by E and the thickness."""
        forces, touching = forces_on_particles(now), now.touching()
        on_particles, sums = 0.0 * forces, np.zeros((len(touching), 2))  # NaN at frame points.
        size = self.youngs_modulus * self.thickness
        for n, pushes in enumerate(contact_pushes(now, touching, forces)):
            np.add.at(on_particles, touching[n].rows, size * pushes)
            sums[n] = size * pushes.sum(axis=0)
        return sums, on_particles
