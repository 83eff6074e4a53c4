"""Interface of diagnostics: quantities computed from a run, with their units."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, NamedTuple, Self, cast

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats
from pbdkit.plugin.component import Bonds, Component, Pair
from pbdkit.plugin.rule import Stiffness

Need = Literal["bonds", "cells", "cracks", "material", "forces", "loads"]
"""Type of the names of data that a diagnostic can require."""


@dataclass(frozen=True)
class Variable:
    """Variable of the dataset.

    Parameters
    ----------
    name : str
        Name of the variable.
    dims : tuple of str
        Dimensions without the first one. `time` or `step` is added as the first dimension, unless
        the diagnostic is evaluated at the end only.
    long_name, units : str
        Attributes of the variable.
    dtype : str
        Data type.
    attributes : dict
        Further attributes.
    may_be_nan : bool
        Whether NaN is allowed anywhere, for quantities that are not always defined.
    """

    name: str
    dims: tuple[str, ...]
    long_name: str
    units: str
    dtype: str = "f8"
    attributes: dict[str, Any] = field(default_factory=dict)
    may_be_nan: bool = False

    def __post_init__(self) -> None:
        if isinstance(cast(Any, self.dims), str):
            raise TypeError(f"the dims of '{self.name}' are a text; write ('{self.dims}',)")

    def is_recordable(self, values: Any, inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return a mask of the values that are allowed in the dataset.

        All finite values are allowed, and NaN at particles outside the outline, such as frame
        points. NaN is allowed everywhere if the variable has `may_be_nan`.

        Parameters
        ----------
        values : array
            Values of the variable, without the leading dimension.
        inside : array of bool, shape (particle,)
            Mask of the particles inside the outline.

        Returns
        -------
        array of bool
            Mask, in the shape of `values`.
        """
        allowed: NDArray[np.bool_] = np.isfinite(values)
        if self.may_be_nan:
            allowed |= np.isnan(values)
        if "particle" in self.dims:
            shape = [-1 if dim == "particle" else 1 for dim in self.dims]
            allowed |= np.isnan(values) & ~inside.reshape(shape)
        return allowed


class LeaderRows(NamedTuple):
    """State of a leader group at a step.

    Parameters
    ----------
    rows : array of int
        Rows of its particles in the tables of `Moment`.
    leads : bool
        Whether the group is active at this step.
    axes : tuple of int
        Axes along which the group prescribes displacements.
    """

    rows: NDArray[np.intp]
    leads: bool
    axes: tuple[int, ...] = (0, 1)


class LoadRows(NamedTuple):
    """State of a load at a step.

    Parameters
    ----------
    rows : array of int
        Rows of the particles on which it acts.
    share : array of float
        Share of each particle in the force; for a body force, the area of the particle.
    force : array of float, shape (axis,)
        Total force divided by Young's modulus and thickness; for a body force, the force per area.
    """

    rows: NDArray[np.intp]
    share: Floats
    force: Floats


class TouchingRows(NamedTuple):
    """Followers that touch an obstacle.

    Parameters
    ----------
    rows : array of int
        Rows of the particles.
    normals : array of float, shape (row, axis)
        Outward unit normals of the obstacle at the particles.
    """

    rows: NDArray[np.intp]
    normals: Floats


class CrackEnd(NamedTuple):
    """End of a cut, or of an initial crack, inside the body.

    Parameters
    ----------
    place : tuple of float
        Position in lattice units.
    direction : tuple of float
        Unit vector from the crack into the uncracked body.
    """

    place: Pair
    direction: Pair


@dataclass(frozen=True)
class CellTable:
    """Cells of one shape, with one row for each cell.

    Parameters
    ----------
    corners : array of int, shape (cell, corner)
        Rows of the corners in the tables of `Moment`, counterclockwise.
    share : array of float, shape (cell,)
        Area fraction of each cell inside the outline.
    bonds : array of int, shape (bond, 2)
        Corners between which each cell has a bond.
    broken : array of bool, shape (cell, bond)
        Whether the bond is broken.
    """

    corners: NDArray[np.intp]
    share: Floats
    bonds: NDArray[np.intp]
    broken: NDArray[np.bool_]

    @property
    def torn(self) -> NDArray[np.bool_]:
        """Mask of the cells of which a bond is broken, (cell,)."""
        return np.asarray(self.broken.any(axis=1))


@dataclass(frozen=True)
class BondHistory(Bonds):
    """Bonds, with step and strain at which each bond broke.

    Parameters
    ----------
    ends : array of int, shape (bond, 2)
        Numbers of both particles, lower first.
    shell : array of int, shape (bond,)
        Shell of each bond, from 1.
    rest : array of float, shape (bond, axis)
        Rest offset from the first particle to the second, in lattice units.
    midpoint : array of float, shape (bond, axis)
        Midpoint in the reference configuration, in lattice units.
    broken_step : array of int, shape (bond,)
        Step at which each bond broke, -1 if it is intact, 0 for an initial crack.
    broken_strain : array of float, shape (bond,)
        Strain in the intermediate configuration in which the bond broke. NaN if the bond is intact,
        was cut, or was broken from the start.
    """

    broken_step: NDArray[np.int32]
    broken_strain: Floats


class CellValues(ABC):
    """Quantities of the cells of the body.

    A cell is a polygon of neighbouring sites with no other site in its circumcircle: a rectangle on
    the square and rectangular lattices, a triangle on the others. Cells tile the plane, and do not
    depend on the neighbour metric.
    """

    @abstractmethod
    def over(
        self,
        function: Callable[[tuple[Any, ...], tuple[Any, ...]], Any],
        *,
        intact_only: bool = False,
    ) -> Floats:
        """Evaluate a function on every cell of which all corners belong to the body.

        Parameters
        ----------
        function : callable
            Elementwise function of (d, r). Both are sequences with one vector for each corner,
            counterclockwise: d[k] = u_k - u_0 and r[k] = X_k - X_0. The function is called once for
            each shape of cells in each part of the body.
        intact_only : bool
            Whether to exclude cells with a broken bond between corners.

        Returns
        -------
        array of float, shape (cell,)
            Values.
        """

    @abstractmethod
    def gradient(self) -> Floats:
        """Return the displacement gradient H = ∂u/∂X at every particle.

        Returns
        -------
        array of float, shape (particle, component, axis)
            Gradient. It is NaN at frame points and 0 at particles without cells, and is
            extrapolated to particles outside the outline.

        Notes
        -----
        The gradient is the mean over the cells at the particle, weighted by their area fractions
        inside the outline. It is extrapolated from the common centre of these cells to the
        particle. Cells with a broken bond between two of their corners are excluded.
        """

    @abstractmethod
    def table(self, near: tuple[Pair, float] | None = None) -> tuple[CellTable, ...]:
        """Return some of the cells of which all corners belong to the body.

        Parameters
        ----------
        near : tuple of (point, float), optional
            Point and distance in lattice units: the cells are those of which the first corner is at
            most so far from the point along each axis. By default they are the torn cells.

        Returns
        -------
        tuple of CellTable
            One table for each shape of cells in each part of the body.
        """

    def lost_stress(self) -> Floats | None:
        """Return the stress that softened bonds have lost.

        Returns
        -------
        array of float, shape (particle, component, axis), or None
            First Piola–Kirchhoff stress divided by Young's modulus, as a mean over the same cells
            as in `gradient`; None if no bond softens.
        """
        return None


class ForceValues(ABC):
    """Forces and energy of the material, divided by Young's modulus and thickness.

    They are in lattice units.
    """

    @property
    @abstractmethod
    def stiffness(self) -> Stiffness:
        """Stiffness of the material."""

    @property
    @abstractmethod
    def through_thickness(self) -> Any:
        """Ratio σ_zz / (σ_xx + σ_yy): 0 in plane stress, Poisson's ratio in plane strain.

        It is a single number, or an array with a number for each particle.
        """

    @abstractmethod
    def on_particles(self) -> Floats:
        """Return the force that its neighbours exert on every particle, including leaders.

        At broken bonds, the force that the rule computes is included.

        Returns
        -------
        array of float, shape (particle, axis)
            Forces divided by Young's modulus and thickness, in lattice units; NaN at frame points.
        """

    @abstractmethod
    def energy(self) -> float:
        """Return the strain energy.

        Returns
        -------
        float
            Energy divided by Young's modulus and thickness. For a linear rule it is ½ uᵀK u = -½ Σ
            u·f, for a nonlinear one the sum of the energies of the bonds.
        """


class Moment(ABC):
    """State of the run at the end of a step, as input of diagnostics.

    Its arrays have one row for each particle and are read-only.
    """

    step: int

    @property
    @abstractmethod
    def body(self) -> NDArray[np.bool_]:
        """Mask of shape (particle,) of the particles of the body; all other particles are frame
        points."""

    @property
    @abstractmethod
    def inside(self) -> NDArray[np.bool_]:
        """Mask of the particles inside or on the outline, (particle,).

        Particles of the body can lie outside the outline, as corners of cells that it cuts.
        """

    @property
    @abstractmethod
    def cells(self) -> CellValues:
        """Quantities of the cells of the body."""

    @property
    @abstractmethod
    def forces(self) -> ForceValues:
        """Forces and energy of the material, for diagnostics with "material" or "forces" in
        `needs`."""

    @abstractmethod
    def rows(self, numbers: tuple[int, ...]) -> NDArray[np.intp]:
        """Return the rows of the particles with the given numbers.

        Parameters
        ----------
        numbers : tuple of int
            Particle numbers, from 1.

        Returns
        -------
        array of int
            Rows, in the order of the numbers.
        """

    @abstractmethod
    def nearest(self, points: tuple[Pair, ...]) -> NDArray[np.intp]:
        """Return the row of the body particle nearest to each point, in the reference
        configuration.

        Parameters
        ----------
        points : tuple of (float, float)
            Points in lattice units. If several particles are equally near, the one with the lowest
            number is chosen.

        Returns
        -------
        array of int, shape (point,)
            Rows.
        """

    @abstractmethod
    def displacement(self, rows: NDArray[np.intp] | None = None) -> Floats:
        """Return the displacements u = x - X.

        Parameters
        ----------
        rows : array of int, optional
            Rows of particles; by default all.

        Returns
        -------
        array of float, shape (particle, axis)
            Displacements in lattice units.
        """

    @abstractmethod
    def previous_displacement(self) -> Floats:
        """Return the displacements at the end of the previous step.

        Returns
        -------
        array of float, shape (particle, axis)
            Displacements in lattice units; at time 0 the initial displacements.
        """

    @abstractmethod
    def reference(self, rows: NDArray[np.intp] | None = None) -> Floats:
        """Return the reference positions X.

        Parameters
        ----------
        rows : array of int, optional
            Rows of particles; by default all.

        Returns
        -------
        array of float, shape (particle, axis)
            Positions in lattice units.
        """

    @abstractmethod
    def sum_over_neighbours(
        self, function: Callable[[Any, Any], Any], *, intact_only: bool = False
    ) -> Floats:
        """Return Σ_k function(d, r) for each body particle.

        The sum includes all neighbours k in the reference configuration.

        Parameters
        ----------
        function : callable
            Function of d = u_k - u_j and r = X_k - X_j, evaluated elementwise like the method
            `gather` of a rule.
        intact_only : bool
            Whether to exclude broken bonds. If they are included, d is computed from the
            displacement of the real neighbour and not from that of the fictitious point.

        Returns
        -------
        array of float, shape (particle,)
            Sums; NaN at frame points.
        """

    @abstractmethod
    def leader_groups(self) -> tuple[LeaderRows, ...]:
        """Return the leader groups in the order of the experiment.

        Returns
        -------
        tuple of LeaderRows
            One entry for each group.
        """

    @abstractmethod
    def loads(self) -> tuple[LoadRows, ...]:
        """Return the loads in the order of the experiment.

        At time 0 no load acts.

        Returns
        -------
        tuple of LoadRows
            One entry for each load.
        """

    @abstractmethod
    def touching(self) -> tuple[TouchingRows, ...]:
        """Return the followers that touch each obstacle, in the order of the experiment.

        Returns
        -------
        tuple of TouchingRows
            One entry for each obstacle; without rows if the obstacle does not exist at this step.
        """

    @abstractmethod
    def broken_bonds(self) -> int:
        """Return the number of bonds that have broken so far.

        Returns
        -------
        int
            Number of bonds.
        """

    @abstractmethod
    def bonds(self) -> BondHistory:
        """Return the table of bonds in the order of the dataset.

        Row n is the bond with number n + 1.

        Returns
        -------
        BondHistory
            Bonds, with step and strain at which each bond broke.
        """

    @abstractmethod
    def remembered(self, name: str) -> NDArray[Any]:
        """Return a state variable of the fracture model or of the rule.

        Parameters
        ----------
        name : str
            Name of the state variable.

        Returns
        -------
        array, shape (bond,) or (particle,)
            Values for each bond, in the order of the dataset, if the fracture model has the
            variable; values for each particle if the rule has it. Frame points have the initial
            value.
        """


class Diagnostic(Component):
    """Quantity of the run that is stored in the dataset.

    To implement a diagnostic, define `variables` and `measure`. By default it is evaluated at
    recorded steps. It is evaluated at every step if it declares `every_step`, and only once after
    the last step if it declares `at_end`.
    """

    needs: ClassVar[frozenset[Need]] = frozenset()
    """Data that the diagnostic requires.

    - "bonds": the table of bonds in the dataset.
    - "cells": `Moment.cells`. A body without cells, such as a single row, is an error.
    - "cracks": cuts or initial cracks that end inside the body, which `at_cracks` receives.
    - "material": `Moment.forces.stiffness`. A rule that is not calibrated is an error.
    - "forces": all of `Moment.forces`. A rule that is not calibrated is an error.
    - "loads": `Moment.loads`. An experiment without loads is an error. Variables can then have the
      dimension `load`.
    """
    every_step: ClassVar[bool] = False
    """True if the diagnostic is evaluated at every step instead of at recorded steps.

    The first dimension of its variables is then `step`.
    """
    at_end: ClassVar[bool] = False
    """True if the diagnostic is evaluated only once, after the last step.

    Its variables then have neither the dimension `time` nor `step`.
    """
    local: ClassVar[bool] = False
    """True if the value at a particle depends only on the particle and its neighbours.

    Each of several processes then evaluates its part of the lattice; otherwise one process
    evaluates the whole lattice.
    """
    own_dimension: ClassVar[str] = ""
    """Name of a dimension that only this diagnostic has, for variables with `at_end`.

    Its length is that of the values.
    """

    @abstractmethod
    def variables(self) -> tuple[Variable, ...]:
        """Return the variables in the dataset.

        Returns
        -------
        tuple of Variable
            Variables, in the order of the values of `measure`.
        """

    def coordinates(self) -> dict[str, NDArray[Any]]:
        """Return the coordinates of additional dimensions; by default there are none.

        Returns
        -------
        dict of str to array
            Coordinates by the name of the dimension.
        """
        return {}

    def at_cracks(self, ends: tuple[CrackEnd, ...]) -> Self:
        """Return the diagnostic for a scene with cracks; by default it does not depend on them.

        It is called for diagnostics with "cracks" in `needs`, before `coordinates`.

        Parameters
        ----------
        ends : tuple of CrackEnd
            Ends of the cuts and initial cracks inside the body.

        Returns
        -------
        Diagnostic
            Diagnostic that is measured in the scene.

        Raises
        ------
        ExperimentError
            If the diagnostic requires cracks, and the scene has none.
        """
        return self

    def check(self, particles: int, leader_groups: int) -> None:
        """Check that the diagnostic is compatible with the scene.

        Variables can have the dimensions `leader_group`, `obstacle` and `principal`. The last one
        has two entries, for the larger and the smaller principal value in the plane.

        Parameters
        ----------
        particles : int
            Number of particles, including those of the frame.
        leader_groups : int
            Number of leader groups.

        Raises
        ------
        ExperimentError
            If the diagnostic is not compatible.
        """
        return

    @abstractmethod
    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Return one array of values for each variable, in the shape of its `dims`.

        Values must be finite. NaN is allowed only where a variable is not defined: at frame points,
        and at particles for which `Moment.inside` is false.

        Parameters
        ----------
        now : Moment
            State of the run.

        Returns
        -------
        tuple of array
            Values in the order of `variables`.
        """
