"""Built-in diagnostics: pseudo-energies, displacements, tracks and broken bonds (model.md, section
8); strain, rotation and stress at particles; reactions, strain energy and load curves; contact
forces.
"""

from __future__ import annotations

import math
from itertools import combinations
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pbdkit.errors import ExperimentError
from pbdkit.plugin import Diagnostic, Moment, TouchingRows, Variable, Vector, length
from pbdkit.plugin.diagnostic import Need
from pbdkit.plugin.fracture import breaking_order
from pbdkit.plugin.lattice import area_share
from pbdkit.plugin.units import AREA, ENERGY, FORCE, LENGTH, STRESS, FromUnits, Place, unset


class PE1(Diagnostic):
    """PE1_j = Σ_k (|x_j - x_k| - |X_j - X_k|)² over all reference neighbours, broken or not.

    For every body particle, leaders included; frame points are neighbours.
    """

    type: Literal["pe1"] = "pe1"

    local: ClassVar[bool] = True
    needs: ClassVar[frozenset[Need]] = frozenset({"bonds"})

    def variables(self) -> tuple[Variable, ...]:
        """`pe1`."""
        return (Variable("pe1", ("particle",), "pseudo-energy PE1", AREA.lattice),)

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Squared length changes, summed."""
        return (now.sum_over_neighbours(_squared_extension),)


class PE1Intact(Diagnostic):
    """PE1 over unbroken bonds only."""

    type: Literal["pe1-intact"] = "pe1-intact"

    local: ClassVar[bool] = True
    needs: ClassVar[frozenset[Need]] = frozenset({"bonds"})

    def variables(self) -> tuple[Variable, ...]:
        """`pe1_intact`."""
        name = "pseudo-energy PE1 of intact bonds"
        return (Variable("pe1_intact", ("particle",), name, AREA.lattice),)

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Squared length changes of intact bonds, summed."""
        return (now.sum_over_neighbours(_squared_extension, intact_only=True),)


class PE2(Diagnostic):
    """PE2_j(t) = |x_j(t) - x_j(t-1)|, against the step before whatever is recorded; 0 at time 0."""

    type: Literal["pe2"] = "pe2"

    local: ClassVar[bool] = True

    def variables(self) -> tuple[Variable, ...]:
        """`pe2`."""
        return (Variable("pe2", ("particle",), "pseudo-energy PE2", LENGTH.lattice),)

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """The length of the last step."""
        moved = now.displacement() - now.previous_displacement()
        return (np.sqrt((moved * moved).sum(axis=1)),)


class Displacement(Diagnostic):
    """u = x - X, with all its digits however far from the origin the body lies."""

    type: Literal["displacement"] = "displacement"

    local: ClassVar[bool] = True

    def variables(self) -> tuple[Variable, ...]:
        """`u`."""
        return (Variable("u", ("particle", "axis"), "displacement", LENGTH.lattice),)

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """The displacements."""
        return (now.displacement(),)


class Track(Diagnostic):
    """The position of chosen particles at every step."""

    type: Literal["track"] = "track"
    numbers: Annotated[
        tuple[Annotated[int, Field(ge=1, lt=2**62)], ...], Field(strict=False, min_length=1)
    ] = Field(description="The particles to follow, by number.", examples=[[3, 1]])

    every_step: ClassVar[bool] = True

    def variables(self) -> tuple[Variable, ...]:
        """`track`."""
        return (
            Variable("track", ("tracked", "axis"), "position of tracked particles", LENGTH.lattice),
        )

    def check(self, particles: int, leader_groups: int) -> None:
        """Refuses numbers that no particle has."""
        refuse_numbers_beyond(particles, self.numbers)

    def coordinates(self) -> dict[str, NDArray[Any]]:
        """`tracked`, the numbers of the particles."""
        return {"tracked": np.array(self.numbers, np.int64)}

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """X + u of the chosen rows."""
        rows = now.rows(self.numbers)
        return (now.reference(rows) + now.displacement(rows),)


class BrokenBonds(Diagnostic):
    """The number of broken bonds."""

    type: Literal["broken"] = "broken"

    def variables(self) -> tuple[Variable, ...]:
        """`broken_bonds`."""
        return (Variable("broken_bonds", (), "number of broken bonds", "1", dtype="i8"),)

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """The count."""
        return (now.broken_bonds(),)


class SmallestCellArea(Diagnostic):
    """The smallest signed area of a cell, as a share of its area at rest: 1 at rest, 0 where a cell
    is flat, negative where one is inside out. Cells with broken bonds count too. For cells whose
    corners are all of the body.
    """

    type: Literal["smallest-cell-area"] = "smallest-cell-area"

    needs: ClassVar[frozenset[Need]] = frozenset({"cells"})

    def variables(self) -> tuple[Variable, ...]:
        """`smallest_cell_area`."""
        name = "smallest signed cell area over that at rest, negative inside out"
        return (Variable("smallest_cell_area", (), name, "1"),)

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """The smallest of all cells."""
        return (now.cells.over(area_share).min(),)


class CrackPath(Diagnostic):
    """The bonds that broke, in the order in which they did: by step, and within a step the most
    stretched first. Bonds that were cut or broken from the start come first, with no strain."""

    type: Literal["crack-path"] = "crack-path"

    needs: ClassVar[frozenset[Need]] = frozenset({"bonds"})
    at_end: ClassVar[bool] = True
    own_dimension: ClassVar[str] = "crack"

    def variables(self) -> tuple[Variable, ...]:
        """`crack_bond`, `crack_step`, `crack_strain`, `crack_midpoint`."""
        crack, no_strain = ("crack",), "NaN where it was cut, or broken from the start"
        where = "reference position of the broken bond's middle"
        return (
            Variable("crack_bond", crack, "number of the broken bond", "1", dtype="i8"),
            Variable("crack_step", crack, "time of breaking", "step", dtype="i4"),
            Variable(
                "crack_strain", crack, "strain at breaking", "1", attributes={"comment": no_strain}
            ),
            Variable("crack_midpoint", (*crack, "axis"), where, LENGTH.lattice),
        )

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """A row a broken bond."""
        bonds = now.bonds()
        step, strain = bonds.broken_step, bonds.broken_strain
        order = breaking_order(step, strain)
        return order + 1, step[order], strain[order], bonds.midpoint[order]


def _squared_extension(d: Vector, r: Vector) -> Any:
    extension = length(Vector(r.x + d.x, r.y + d.y)) - length(r)
    return extension * extension


def refuse_numbers_beyond(particles: int, numbers: tuple[int, ...]) -> None:
    """Raises ExperimentError for a number that no particle has."""
    for n, number in enumerate(numbers):
        if number > particles:
            text = f"there is no particle {number}; they are numbered 1 to {particles}"
            raise ExperimentError(text, ("numbers", n))


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


class LocalRotation(Diagnostic):
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


Thickness = Annotated[
    float,
    Field(
        gt=0.0,
        description="Of the body, out of its plane; 1 unless `units` gives it.",
        examples=[2.0],
    ),
    FromUnits("thickness", otherwise=1.0),
]
Group = Annotated[int, Field(ge=0)]
TwoNumbers = Annotated[
    tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]], Field(strict=False)
]
TwoPoints = Annotated[tuple[Place, Place], Field(strict=False)]


class StrainEnergy(Diagnostic):
    """The strain energy of the body: ½ uᵀK u with the stiffness K that the rule is, or the energy
    of the rule's own bonds where it is not linear ('springs').

    Under a frame with points it is -½ Σ u·force, the work of the leaders in linear elasticity.
    """

    type: Literal["strain-energy"] = "strain-energy"
    youngs_modulus: Modulus = Field(default_factory=unset)
    thickness: Thickness = Field(default_factory=unset)

    needs: ClassVar[frozenset[Need]] = frozenset({"forces"})

    def variables(self) -> tuple[Variable, ...]:
        """`strain_energy`."""
        return (Variable("strain_energy", (), "strain energy", ENERGY.lattice),)

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """E t times the rule's."""
        return (self.youngs_modulus * self.thickness * now.forces.energy(),)


class Reaction(Diagnostic):
    """The resultant force that each leader group must exert; 0 while it does not lead.

    Minus the forces of the neighbours on its particles, and the loads on them; a particle of two
    groups counts half with each. A group that leads along some axes exerts nothing along the
    others, and bears what obstacles that its particles touch exert along its own. Under the natural
    frame all groups together exert nothing, or minus the loads and what obstacles exert. Frame
    points pull too: at the corners of held edges that is no force of the body, and a warning says
    so.
    """

    type: Literal["reaction"] = "reaction"
    youngs_modulus: Modulus = Field(default_factory=unset)
    thickness: Thickness = Field(default_factory=unset)

    needs: ClassVar[frozenset[Need]] = frozenset({"forces"})

    def variables(self) -> tuple[Variable, ...]:
        """`reaction`."""
        name = "force that the leader group exerts"
        return (Variable("reaction", ("leader_group", "axis"), name, FORCE.lattice),)

    def check(self, particles: int, leader_groups: int) -> None:
        """Refuses experiments without leaders."""
        if leader_groups == 0:
            raise ExperimentError(f"'{self.type}' is of leader groups, and there is none")

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """E t times the sums."""
        return (self.youngs_modulus * self.thickness * reactions(now),)


class LoadDisplacement(Diagnostic):
    """The load-displacement curve of each load: its resultant, 0 while it does not act, and the
    mean displacement of its particles, each counted by what it bears of the load, so that the area
    under the curve is the work of the load.
    """

    type: Literal["load-displacement"] = "load-displacement"
    youngs_modulus: Modulus = Field(default_factory=unset)
    thickness: Thickness = Field(default_factory=unset)

    needs: ClassVar[frozenset[Need]] = frozenset({"loads"})

    def variables(self) -> tuple[Variable, ...]:
        """`load_resultant`, `load_displacement`."""
        dims, mean = ("load", "axis"), "mean displacement of the load's particles"
        return (
            Variable("load_resultant", dims, "resultant of the load", FORCE.lattice),
            Variable("load_displacement", dims, mean, LENGTH.lattice),
        )

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """E t times the sums, and the means."""
        loads = now.loads()
        resultant = np.stack([load.share.sum() * load.force for load in loads])
        means = [load.share @ now.displacement(load.rows) / load.share.sum() for load in loads]
        return self.youngs_modulus * self.thickness * resultant, np.stack(means)


class StressStrain(Diagnostic):
    """The stress-strain curve of a tensile test along `axis`.

    Nominal stress is the reaction of the leader group `group` (its place among the experiment's
    leaders, from 0) along the axis over the initial cross-section, `width` times thickness, which
    cancels. Nominal strain is the elongation of the gauge along the axis over its initial length;
    the gauge lies between the body particles nearest to two `points`, or between two particles by
    their `numbers`, or, where neither is given, between the mean places of `group` and `against`.
    """

    type: Literal["stress-strain"] = "stress-strain"
    youngs_modulus: Modulus = Field(default_factory=unset)
    width: Annotated[float, Field(gt=0.0), LENGTH] = Field(
        description="Of the initial cross-section (lattice units).", examples=[2.5]
    )
    axis: Literal["x", "y"] = Field("x", description="The axis of the pull.", examples=["x"])
    group: Group = Field(1, description="The leader group that pulls, from 0.", examples=[1])
    against: Group = Field(0, description="The group that it pulls away from.", examples=[0])
    points: TwoPoints | None = Field(
        None,
        description="Ends of the gauge length; the nearest particles count.",
        examples=[((0.0, 0.0), (1.0, 0.0))],
    )
    numbers: TwoNumbers | None = Field(
        None, description="Ends of the gauge length by number.", examples=[(1, 30)]
    )

    needs: ClassVar[frozenset[Need]] = frozenset({"forces"})

    @model_validator(mode="after")
    def _one_gauge(self) -> StressStrain:
        if self.points and self.numbers:
            raise ValueError("give the gauge by points or by numbers, not by both")
        return self

    def variables(self) -> tuple[Variable, ...]:
        """`nominal_stress`, `nominal_strain`."""
        return (
            Variable("nominal_stress", (), "nominal stress", STRESS.lattice),
            Variable("nominal_strain", (), "nominal strain", "1"),
        )

    def check(self, particles: int, leader_groups: int) -> None:
        """Refuses numbers and groups that are not there."""
        refuse_numbers_beyond(particles, self.numbers or ())
        by_leaders = not (self.points or self.numbers)
        for name in ("group", "against") if by_leaders else ("group",):
            if (group := getattr(self, name)) >= leader_groups:
                known = f"they are numbered from 0, and there are {leader_groups}"
                raise ExperimentError(f"there is no leader group {group}; {known}", (name,))

    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Stress and strain."""
        axis = "xy".index(self.axis)
        start, end = self._ends(now)
        first, last = (now.reference(rows)[:, axis].mean() for rows in (start, end))
        if abs(last - first) <= 1e-9 * max(abs(first), abs(last)):
            raise ExperimentError(
                f"the gauge has no length along {self.axis}: both ends lie at {first:g}; give two "
                "points apart"
            )
        u, v = (now.displacement(rows)[:, axis].mean() for rows in (start, end))
        pulled = now.reference(now.leader_groups()[self.group].rows)[:, axis].mean()
        outwards = np.sign(pulled - (first + last) / 2)
        pull = outwards * reactions(now)[self.group, axis]
        return self.youngs_modulus * pull / self.width, (v - u) / (last - first)

    def _ends(self, now: Moment) -> tuple[Any, Any]:
        """The rows at the start of the gauge and at its end."""
        if self.points or self.numbers:
            rows = now.nearest(self.points) if self.points else now.rows(self.numbers or ())
            return rows[:1], rows[1:]
        groups = now.leader_groups()
        return groups[self.against].rows, groups[self.group].rows


FLAT = 1e-6
"""Sine of an angle below which normals count as parallel, or as without a share along an axis."""
AS_GOOD = 1e-9
"""Relative difference of residuals below which pushes balance a force equally well."""


def reactions(now: Moment) -> Floats:
    """What each leader group exerts over Young's modulus and thickness, (leader group, axis): along
    axes along which it leads."""
    forces, groups = forces_on_particles(now), now.leader_groups()
    touching = now.touching()
    pushes = contact_pushes(now, touching, forces)
    for each, own in zip(touching, pushes, strict=True):
        np.add.at(forces, each.rows, own)
    times, found = np.zeros(forces.shape), np.zeros((len(groups), forces.shape[1]))
    leading = [(n, each.rows, list(each.axes)) for n, each in enumerate(groups) if each.leads]
    for _, rows, axes in leading:
        times[rows[:, None], axes] += 1
    for n, rows, axes in leading:
        share = forces[rows] / np.maximum(times[rows], 1)
        found[n, axes] = 0.0 - share.sum(axis=0)[axes]
    return found


def forces_on_particles(now: Moment) -> Floats:
    """The forces of neighbours and loads over Young's modulus and thickness, (particle, axis)."""
    forces = np.array(now.forces.on_particles())
    for load in now.loads():
        forces[load.rows] += np.outer(load.share, load.force)
    return forces


def contact_pushes(now: Moment, touching: tuple[TouchingRows, ...], forces: Floats) -> list[Floats]:
    """What each obstacle exerts on the rows that touch it, (row, axis), where `forces` act on
    particles: pushes along the normals that balance the forces best, along the axes along which a
    particle follows."""
    if not touching:
        return []
    rows = np.concatenate([each.rows for each in touching])
    normals = np.concatenate([each.normals for each in touching])
    follows = np.ones((len(rows), 2))
    for group in now.leader_groups():
        if group.leads:
            follows[np.isin(rows, group.rows)[:, None] & np.isin([0, 1], group.axes)] = 0.0
    needs, ways = -forces[rows] * follows, normals * follows
    sizes = _single_pushes(needs, ways)
    order, count = np.unique(rows, return_inverse=True, return_counts=True)[1:]
    for n in np.flatnonzero(count > 1).tolist():
        some = np.flatnonzero(order == n)
        sizes[some] = _joint_pushes(needs[some[0]], ways[some])
    ends = np.cumsum([len(each.rows) for each in touching])[:-1]
    return np.split(sizes[:, None] * normals, ends)


def _single_pushes(needs: Floats, ways: Floats) -> Floats:
    """λ ≥ 0 of which λ · way comes nearest to each of some vectors."""
    squares = (ways * ways).sum(axis=-1)
    is_pushed = squares > FLAT * FLAT
    sizes = np.maximum(0.0, (needs * ways).sum(axis=-1)) / np.where(is_pushed, squares, 1.0)
    return np.where(is_pushed, sizes, 0.0)


def _joint_pushes(need: Floats, ways: Floats) -> Floats:
    """λ ≥ 0 of which Σ λ · way comes nearest to a vector; the mean of all with at most two that
    are not 0 and that come as near as any, so that their order does not matter."""
    singles = _single_pushes(need[None], ways)
    found = [size * one for size, one in zip(singles, np.eye(len(ways)), strict=True)]
    for a, b in combinations(range(len(ways)), 2):
        pair = ways[[a, b]].T
        if abs(np.linalg.det(pair)) > FLAT:
            sizes = np.linalg.solve(pair, need)
            if (sizes >= 0.0).all():
                found.append(np.zeros(len(ways)))
                found[-1][[a, b]] = sizes
    left = np.array([math.hypot(*(sizes @ ways - need)) for sizes in found])
    best = left <= left.min() + AS_GOOD * math.hypot(*need)
    return np.asarray(np.array(found)[best].mean(axis=0))


class ContactForces(Diagnostic):
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
