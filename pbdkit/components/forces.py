"""What leaders must do to a body, and what it stores: reactions, strain energy, tensile tests."""

from __future__ import annotations

import math
from itertools import combinations
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pbdkit.components.diagnostics import refuse_numbers_beyond
from pbdkit.components.fields import Modulus
from pbdkit.errors import ExperimentError
from pbdkit.interfaces import Diagnostic, Moment, TouchingRows, Variable
from pbdkit.interfaces.diagnostic import Need
from pbdkit.interfaces.units import ENERGY, FORCE, LENGTH, STRESS, FromUnits, Place, unset

Floats = NDArray[np.floating[Any]]
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
