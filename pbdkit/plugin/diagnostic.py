"""The Diagnostic interface: a quantity measured from the run, with its units."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbdkit.plugin.component import Bonds, Component, Pair
from pbdkit.plugin.rule import Stiffness

Floats = NDArray[np.floating[Any]]
Need = Literal["bonds", "cells", "material", "forces", "loads"]


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

    def is_recordable(self, values: Any, inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which values can go into the dataset: finite ones, and NaN at particles that are not
        `inside` the body's outline, such as frame points."""
        fine: NDArray[np.bool_] = np.isfinite(values)
        if "particle" in self.dims:
            shape = [-1 if dim == "particle" else 1 for dim in self.dims]
            fine |= np.isnan(values) & ~inside.reshape(shape)
        return fine


class LeaderRows(NamedTuple):
    """The rows of a leader group's particles, whether it leads during this step, and the numbers of
    the axes along which it does."""

    rows: NDArray[np.intp]
    leads: bool
    axes: tuple[int, ...] = (0, 1)


class LoadRows(NamedTuple):
    """The rows of a load's particles, what each bears of it (its share of a force, its area of a
    body force), and the force now, in all or of a unit of area, over Young's modulus and
    thickness, (axis,)."""

    rows: NDArray[np.intp]
    share: Floats
    force: Floats


class TouchingRows(NamedTuple):
    """The rows of the followers that touch an obstacle, and the normals there, which point out of
    it, (row, axis)."""

    rows: NDArray[np.intp]
    normals: NDArray[np.float64]


@dataclass(frozen=True)
class BondHistory(Bonds):
    """The table of bonds and when they broke, (bond,): `broken_step`, -1 where one has not, 0 at a
    given crack; `broken_strain` in the intermediate configuration, NaN where it has not broken, was
    cut or broken from the start."""

    broken_step: NDArray[np.int32]
    broken_strain: NDArray[np.float64]


class CellValues(ABC):
    """What cells show. A cell is a polygon of neighbouring sites with no other site in its
    circumcircle: on the square and rectangular lattice the rectangles, on the others triangles;
    together they tile the plane, whatever the neighbours are."""

    @abstractmethod
    def over(
        self,
        function: Callable[[tuple[Any, ...], tuple[Any, ...]], Any],
        *,
        intact_only: bool = False,
    ) -> Floats:
        """function(d, r) of every cell whose corners are all of the body, (cell,).

        d and r hold a vector a corner, counter-clockwise: d[k] = u_k - u_0, r[k] = X_k - X_0; r is
        constant. Elementwise, and called once a shape and part of the body. Cells with a broken
        bond between corners count unless `intact_only`.
        """

    @abstractmethod
    def gradient(self) -> Floats:
        """H = ∂u/∂X at every particle, (particle, component of u, axis); F = 1 + H.

        The mean over the cells that meet there, by the share of each that belongs to the body,
        carried on from the middle of those cells to the particle. Cells with a broken bond between
        corners do not count. NaN at frame points, 0 at body particles without a cell. Beyond the
        outline (`Moment.inside`) it is carried on from the part of the body nearby.
        """

    def lost_stress(self) -> Floats | None:
        """The first Piola-Kirchhoff stress over Young's modulus that softened bonds no longer
        carry, (particle, component, axis), as the mean over the cells that `gradient` counts; None
        where nothing has softened."""
        return None


class ForceValues(ABC):
    """What the material that the rule is calibrated to makes of a state, over Young's modulus and
    thickness, in lattice units."""

    @property
    @abstractmethod
    def stiffness(self) -> Stiffness:
        """The material."""

    @property
    @abstractmethod
    def through_thickness(self) -> Any:
        """σ_zz over σ_xx + σ_yy: 0 in plane stress, Poisson's ratio in plane strain; one number, or
        one for each particle."""

    @abstractmethod
    def on_particles(self) -> Floats:
        """The forces of the neighbours on every particle, leaders too, (particle, axis); NaN at
        frame points. Of broken bonds they are what the rule sees."""

    @abstractmethod
    def energy(self) -> float:
        """The strain energy: ½ uᵀK u, which is -½ Σ u·force, or that of the rule's own bonds where
        it is not linear."""


class Moment(ABC):
    """The run at the end of a step, as a diagnostic sees it. Tables have a row a particle; nobody
    can write to them."""

    step: int

    @property
    @abstractmethod
    def body(self) -> NDArray[np.bool_]:
        """(particle,): which are leaders or followers; the others are frame points."""

    @property
    @abstractmethod
    def inside(self) -> NDArray[np.bool_]:
        """(particle,): which particles of the body lie inside or on its outline; corners of cut
        cells may lie beyond it."""

    @property
    @abstractmethod
    def cells(self) -> CellValues:
        """What the cells of the body show."""

    @property
    @abstractmethod
    def forces(self) -> ForceValues:
        """Forces and energy of the material, for diagnostics that need it."""

    @abstractmethod
    def rows(self, numbers: tuple[int, ...]) -> NDArray[np.intp]:
        """The rows of the particles with these numbers."""

    @abstractmethod
    def nearest(self, points: tuple[Pair, ...]) -> NDArray[np.intp]:
        """The row of the body particle that is nearest to each point at rest, the lowest number on
        ties."""

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
        the real neighbour, unless `intact_only`. Frame points get NaN.
        """

    @abstractmethod
    def leader_groups(self) -> tuple[LeaderRows, ...]:
        """The leader groups in the order of the experiment."""

    @abstractmethod
    def loads(self) -> tuple[LoadRows, ...]:
        """The loads in the order of the experiment; none acts yet at time 0."""

    @abstractmethod
    def touching(self) -> tuple[TouchingRows, ...]:
        """Who touches each obstacle, in their order; nobody while one is not there."""

    @abstractmethod
    def broken_bonds(self) -> int:
        """How many bonds have broken so far."""

    @abstractmethod
    def bonds(self) -> BondHistory:
        """The table of bonds, in the order of the dataset: row n is the bond with number n + 1."""

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

    needs: ClassVar[frozenset[Need]] = frozenset()
    """What it makes no sense without. "bonds": the table of bonds in the dataset; "cells"
    (`Moment.cells`): a body that has none, a single row for instance, is refused; "material"
    (`Moment.forces.stiffness`), "forces" (all of `Moment.forces`): rules that are not calibrated
    are refused; "loads" (`Moment.loads`): experiments without loads are. Variables can then have
    a dimension `load`, an entry a load."""
    every_step: ClassVar[bool] = False
    """Measure at every step (dimension `step`) instead of at recorded ones (`time`)."""
    at_end: ClassVar[bool] = False
    """Measure once, after the last step; the variables have no leading dimension."""
    local: ClassVar[bool] = False
    """Whether what it measures at a particle depends on that and its neighbours alone. Each process
    then measures on its own part of a lattice that is cut up; else one gathers the whole."""
    own_dimension: ClassVar[str] = ""
    """With `at_end`: a dimension that gets its length from the values, known only then."""

    @abstractmethod
    def variables(self) -> tuple[Variable, ...]:
        """The variables that it adds to the dataset."""

    def coordinates(self) -> dict[str, NDArray[Any]]:
        """Dimensions of its own with their values; by default none."""
        return {}

    def check(self, particles: int, leader_groups: int) -> None:
        """Raise ExperimentError where it does not go with a scene of so many particles and leader
        groups. A variable can have a dimension `leader_group`, an entry a group,
        `obstacle`, or `principal`, the larger and the smaller principal value in the plane."""
        return

    @abstractmethod
    def measure(self, now: Moment) -> tuple[Any, ...]:
        """The values of its variables, one array each, shaped as their `dims` say; finite, but for
        NaN at frame points in what is measured of the body, and at particles that are not
        `inside` in what has no meaning beyond the outline."""
