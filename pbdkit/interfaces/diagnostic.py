"""The Diagnostic interface: a quantity measured from the run, with its units."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces.component import Component, Pair
from pbdkit.interfaces.rule import Stiffness
from pbdkit.interfaces.values import Bonds

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Variable:
    """One variable of the dataset: its name, dimensions, dtype and attributes.

    `dims` are without the leading time or step, which the framework adds unless the diagnostic is
    measured at the end.
    """

    name: str
    dims: tuple[str, ...]
    long_name: str
    units: str
    dtype: str = "f8"
    attributes: dict[str, Any] = field(default_factory=dict)


class LeaderRows(NamedTuple):
    """The rows of a leader group's particles, and whether it leads during this step."""

    rows: NDArray[np.intp]
    leads: bool


class Moment(ABC):
    """The run at the end of a step, as a diagnostic sees it. Tables have a row a particle."""

    step: int

    @abstractmethod
    def rows(self, numbers: tuple[int, ...]) -> NDArray[np.intp]:
        """The rows of the particles with these numbers."""

    @abstractmethod
    def displacement(self, rows: NDArray[np.intp] | None = None) -> Floats:
        """u = x - X, (particle, axis), of all particles or of some rows."""

    @abstractmethod
    def previous_displacement(self) -> Floats:
        """u at the end of the step before, (particle, axis); at time 0 that of time 0."""

    @abstractmethod
    def reference(self, rows: NDArray[np.intp] | None = None) -> Floats:
        """X, (particle, axis)."""

    @abstractmethod
    def sum_over_neighbours(
        self, function: Callable[[Any, Any], Any], *, intact_only: bool = False
    ) -> Floats:
        """Σ_k function(d, r) over the reference neighbours k of each body particle, (particle,).

        d = u_k - u_j, r = X_k - X_j; elementwise, like a rule's `gather`. Broken bonds count, with
        the real neighbour, unless `intact_only`. Frame points get 0.
        """

    @abstractmethod
    def over_cells(
        self,
        function: Callable[[tuple[Any, ...], tuple[Any, ...]], Any],
        *,
        intact_only: bool = False,
    ) -> Floats:
        """function(d, r) of every cell whose corners are all of the body, (cell,).

        A cell is a polygon of neighbouring sites with no other site in its circumcircle: on the
        square and rectangular lattice the rectangles, on the others triangles; together they tile
        the plane, whatever the neighbours are. d and r hold a vector a corner, counter-clockwise:
        d[k] = u_k - u_0, r[k] = X_k - X_0; r is constant. Elementwise, and called once a shape and
        part of the body. Cells with a broken bond between corners count unless `intact_only`.
        """

    @abstractmethod
    def displacement_gradient(self) -> Floats:
        """H = ∂u/∂X at every body particle, (particle, component of u, axis); F = 1 + H.

        The mean over the cells that meet there, by the share of each that belongs to the body,
        carried on from the middle of those cells to the particle. Cells with a broken bond between
        corners do not count. Zero at frame points and where there is no cell.
        """

    @abstractmethod
    def stiffness(self) -> Stiffness:
        """The material that the rule is calibrated to."""

    @abstractmethod
    def forces(self) -> Floats:
        """The forces of the neighbours on every body particle, leaders too, over Young's modulus
        and thickness, (particle, axis), lattice units; zero at frame points. Of broken bonds they
        are what the rule sees."""

    @abstractmethod
    def energy(self) -> float:
        """The strain energy over Young's modulus and thickness, lattice units squared: ½ uᵀK u,
        which is -½ Σ u·force, or that of the rule's own bonds where it is not linear."""

    @abstractmethod
    def leader_groups(self) -> tuple[LeaderRows, ...]:
        """The leader groups in the order of the experiment."""

    @abstractmethod
    def nearest(self, points: tuple[Pair, ...]) -> NDArray[np.intp]:
        """The row of the body particle that is nearest to each point at rest, the lowest number on
        ties."""

    @abstractmethod
    def broken_bonds(self) -> int:
        """How many bonds have broken so far."""

    @abstractmethod
    def bonds(self) -> Bonds:
        """The table of bonds, in the order of the dataset."""

    @abstractmethod
    def broken_step(self) -> NDArray[np.int32]:
        """(bond,): the step at which each bond broke, -1 where it has not, 0 at a given crack."""

    @abstractmethod
    def broken_strain(self) -> NDArray[np.float64]:
        """(bond,): the strain with which each bond broke, in the intermediate configuration; NaN
        where it has not, or was broken from the start."""

    @abstractmethod
    def remembered(self, name: str) -> NDArray[Any]:
        """A number that the fracture model remembers, (bond,) in the order of the dataset, or the
        rule, (particle,); frame points have its initial value."""


class Diagnostic(Component):
    """A quantity of the run that goes into the dataset.

    To add a diagnostic, write `variables` and `measure`. It is evaluated at recorded steps only,
    at every step where it declares `every_step`, or once, after the last step, where it declares
    `at_end`; nothing of it exists where nobody asks.
    """

    uses_bonds: ClassVar[bool] = False
    """Whether readers of the dataset need the table of bonds to make sense of it."""
    uses_cells: ClassVar[bool] = False
    """Whether it makes no sense without cells (`Moment.over_cells`); a body that has none, a single
    row for instance, is then refused."""
    uses_material: ClassVar[bool] = False
    """Whether it asks for `Moment.stiffness`; rules that are not calibrated are then refused."""
    uses_forces: ClassVar[bool] = False
    """Whether it asks for `Moment.forces` or `Moment.energy`; the same are refused."""
    every_step: ClassVar[bool] = False
    """Measure at every step (dimension `step`) instead of at recorded ones (`time`)."""
    at_end: ClassVar[bool] = False
    """Measure once, after the last step; the variables have no leading dimension."""
    own_dimension: ClassVar[str] = ""
    """With `at_end`: a dimension that gets its length from the values, known only then."""

    @abstractmethod
    def variables(self) -> tuple[Variable, ...]:
        """The variables that it adds to the dataset."""

    def coordinates(self) -> dict[str, NDArray[Any]]:
        """Dimensions of its own with their values; by default none."""
        return {}

    def check(self, particles: int) -> None:
        """Raise ExperimentError where it does not go with a scene of so many particles."""
        return

    def check_leaders(self, groups: int) -> None:
        """Raise ExperimentError where it does not go with so many leader groups. A variable can
        have a dimension `leader_group`, an entry a group."""
        return

    @abstractmethod
    def measure(self, now: Moment) -> tuple[Any, ...]:
        """The values of its variables, one array each, shaped as their `dims` say."""
