"""Pseudo-energies, displacements, tracks, broken bonds, cells inside out (model.md, section 8)."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pbdkit.errors import ExperimentError
from pbdkit.interfaces import Diagnostic, Moment, Variable, Vector, length
from pbdkit.interfaces.diagnostic import Need
from pbdkit.interfaces.fracture_model import breaking_order
from pbdkit.interfaces.polygons import area_share
from pbdkit.interfaces.units import AREA, LENGTH


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


class Broken(Diagnostic):
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
