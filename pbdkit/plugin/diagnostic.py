"""Interface of diagnostics: quantities computed from a run, with their units."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats
from pbdkit.plugin.component import Bonds, Component, Pair
from pbdkit.plugin.rule import Stiffness

Need = Literal["bonds", "cells", "material", "forces", "loads"]
"""Type of a requirement of a diagnostic."""


@dataclass(frozen=True)
class Variable:
    """Variable of the dataset.

    Parameters
    ----------
    name : str
        Name of the variable.
    dims : tuple of str
        Dimensions, without the leading `time` or `step`, which is added unless the diagnostic is
        evaluated at the end.
    long_name, units : str
        Attributes of the variable.
    dtype : str
        Data type.
    attributes : dict
        Further attributes.
    """

    name: str
    dims: tuple[str, ...]
    long_name: str
    units: str
    dtype: str = "f8"
    attributes: dict[str, Any] = field(default_factory=dict)

    def is_recordable(self, values: Any, inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return which values are allowed in the dataset.

        Values are finite, or NaN at particles outside the outline, such as frame points.

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
        if "particle" in self.dims:
            shape = [-1 if dim == "particle" else 1 for dim in self.dims]
            allowed |= np.isnan(values) & ~inside.reshape(shape)
        return allowed


class LeaderRows(NamedTuple):
    """Leader group at a step.

    Parameters
    ----------
    rows : array of int
        Rows of its particles.
    leads : bool
        Whether the group is active at this step.
    axes : tuple of int
        Axes along which it prescribes displacements.
    """

    rows: NDArray[np.intp]
    leads: bool
    axes: tuple[int, ...] = (0, 1)


class LoadRows(NamedTuple):
    """Load at a step.

    Parameters
    ----------
    rows : array of int
        Rows of its particles.
    share : array of float
        Share of each particle in the force, or its area for a body force.
    force : array of float, shape (axis,)
        Total force, or force per area, over Young's modulus and thickness.
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


@dataclass(frozen=True)
class BondHistory(Bonds):
    """Bonds with the time and strain of their breaking.

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
        Strain at breaking, in the intermediate configuration. NaN if the bond is intact, was cut,
        or was broken from the start.
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
        """Evaluate a function on every cell with all corners in the body.

        Parameters
        ----------
        function : callable
            Elementwise function of (d, r), which hold one vector for each corner, counterclockwise:
            d[k] = u_k - u_0 and the constant r[k] = X_k - X_0. It is called once for each shape and
            part of the body.
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
            Gradient; NaN at frame points, 0 at particles without cells, extrapolated outside the
            outline.

        Notes
        -----
        It is the mean over the cells at the particle, weighted by their shares inside the outline,
        and extrapolated from the centre of these cells to the particle. Cells with a broken bond
        between corners are excluded.
        """

    def lost_stress(self) -> Floats | None:
        """Return the stress that softened bonds have lost.

        Returns
        -------
        array of float, shape (particle, component, axis), or None
            First Piola–Kirchhoff stress over Young's modulus, as the mean over the cells of
            `gradient`; None if no bond softens.
        """
        return None


class ForceValues(ABC):
    """Forces and energy of the material, over Young's modulus and thickness, in lattice units."""

    @property
    @abstractmethod
    def stiffness(self) -> Stiffness:
        """Stiffness of the material."""

    @property
    @abstractmethod
    def through_thickness(self) -> Any:
        """Ratio of σ_zz to σ_xx + σ_yy: 0 in plane stress, Poisson's ratio in plane strain.

        One number, or one for each particle.
        """

    @abstractmethod
    def on_particles(self) -> Floats:
        """Return the forces of the neighbours on every particle, including leaders.

        The forces of broken bonds are those of the rule.

        Returns
        -------
        array of float, shape (particle, axis)
            Forces over Young's modulus and thickness, in lattice units; NaN at frame points.
        """

    @abstractmethod
    def energy(self) -> float:
        """Return the strain energy.

        Returns
        -------
        float
            Energy over Young's modulus and thickness: ½ uᵀK u = -½ Σ u·f for a linear rule, the sum
            over bonds for a nonlinear one.
        """


class Moment(ABC):
    """State of the run at the end of a step, as input of diagnostics.

    Tables have one row for each particle and are read-only.
    """

    step: int

    @property
    @abstractmethod
    def body(self) -> NDArray[np.bool_]:
        """Mask of leaders and followers, (particle,); the other rows are frame points."""

    @property
    @abstractmethod
    def inside(self) -> NDArray[np.bool_]:
        """Mask of the particles inside or on the outline, (particle,).

        Corners of cut cells can lie outside.
        """

    @property
    @abstractmethod
    def cells(self) -> CellValues:
        """Quantities of the cells of the body."""

    @property
    @abstractmethod
    def forces(self) -> ForceValues:
        """Forces and energy of the material, for diagnostics that require these."""

    @abstractmethod
    def rows(self, numbers: tuple[int, ...]) -> NDArray[np.intp]:
        """Return the rows of the particles with these numbers.

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
        """Return the row of the body particle nearest to each point at rest.

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
            Displacements in lattice units; at time 0 those of time 0.
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
        """Return Σ_k function(d, r) over the reference neighbours k of each body particle.

        Parameters
        ----------
        function : callable
            Function of d = u_k - u_j and r = X_k - X_j, evaluated elementwise like the method
            `gather` of a rule.
        intact_only : bool
            Whether to exclude broken bonds; otherwise they are included with the displacement of
            the real neighbour, not of the fictitious point.

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
        """Return the loads in the order of the experiment; no load acts at time 0.

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
            One entry for each obstacle; empty for an obstacle that does not exist at this step.
        """

    @abstractmethod
    def broken_bonds(self) -> int:
        """Return the number of bonds that have broken.

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
            Bonds with the time and strain of their breaking.
        """

    @abstractmethod
    def remembered(self, name: str) -> NDArray[Any]:
        """Return a state variable of the fracture model or of the rule.

        Parameters
        ----------
        name : str
            Name of the number.

        Returns
        -------
        array, shape (bond,) or (particle,)
            Values: for each bond in the order of the dataset, or for each particle. Frame points
            have the initial value.
        """


class Diagnostic(Component):
    """Quantity of the run that is stored in the dataset.

    To implement a diagnostic, define `variables` and `measure`. It is evaluated at recorded steps,
    at every step if it declares `every_step`, or once after the last step if it declares `at_end`.
    """

    needs: ClassVar[frozenset[Need]] = frozenset()
    """Requirements of the diagnostic.

    "bonds": the table of bonds in the dataset. "cells": `Moment.cells`; a body without cells, such
    as a single row, is an error. "material": `Moment.forces.stiffness`, and "forces": all of
    `Moment.forces`; rules that are not calibrated are an error. "loads": `Moment.loads`;
    experiments without loads are an error. Variables can then have the dimension `load`.
    """
    every_step: ClassVar[bool] = False
    """True to evaluate at every step (dimension `step`) instead of at recorded steps."""
    at_end: ClassVar[bool] = False
    """True to evaluate once, after the last step; variables then have no leading dimension."""
    local: ClassVar[bool] = False
    """True if the value at a particle depends only on the particle and its neighbours.

    Each of several processes then evaluates its part of the lattice; otherwise one process
    evaluates the whole lattice.
    """
    own_dimension: ClassVar[str] = ""
    """Name of a dimension of variables with `at_end`, of the length that the values have."""

    @abstractmethod
    def variables(self) -> tuple[Variable, ...]:
        """Return the variables in the dataset.

        Returns
        -------
        tuple of Variable
            Variables, in the order of the values of `measure`.
        """

    def coordinates(self) -> dict[str, NDArray[Any]]:
        """Return additional dimensions with their coordinates; by default there are none.

        Returns
        -------
        dict of str to array
            Coordinates by the name of the dimension.
        """
        return {}

    def check(self, particles: int, leader_groups: int) -> None:
        """Check that the diagnostic is compatible with the scene.

        Variables can have the dimensions `leader_group`, `obstacle`, and `principal`, the larger
        and the smaller principal value in the plane.

        Parameters
        ----------
        particles : int
            Number of particles, including those of the frame.
        leader_groups : int
            Number of leader groups.

        Raises
        ------
        ExperimentError
            If it is not compatible.
        """
        return

    @abstractmethod
    def measure(self, now: Moment) -> tuple[Any, ...]:
        """Return the values of the variables, one array for each, in the shapes of their `dims`.

        Values must be finite, except NaN at frame points in variables of the body, and at particles
        that are not `inside` in variables that are not defined outside the outline.

        Parameters
        ----------
        now : Moment
            State of the run.

        Returns
        -------
        tuple of array
            Values in the order of `variables`.
        """
