"""The Diagnostic interface: a quantity measured from the run, with its units."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces.arithmetic import Vector
from pbdkit.interfaces.component import Component

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Variable:
    """One variable of the dataset: its name, dimensions, dtype and attributes.

    `dims` are without the leading time or step, which the framework adds.
    """

    name: str
    dims: tuple[str, ...]
    long_name: str
    units: str
    dtype: str = "f8"
    attributes: dict[str, Any] = field(default_factory=dict)


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
        self, function: Callable[[Vector, Vector], Any], *, intact_only: bool = False
    ) -> Floats:
        """Σ_k function(d, r) over the reference neighbours k of each body particle, (particle,).

        d = u_k - u_j, r = X_k - X_j; elementwise, like a rule's `gather`. Broken bonds count, with
        the real neighbour, unless `intact_only`. Frame points get 0.
        """

    @abstractmethod
    def over_cells(
        self,
        function: Callable[[tuple[Vector, ...], tuple[Vector, ...]], Any],
        *,
        intact_only: bool = False,
    ) -> Floats:
        """function(d, r) of every cell whose corners are all of the body, (cell,).

        A cell is a polygon of neighbouring sites with no other site in its circumcircle: on the
        square and rectangular lattice the rectangles, on the others triangles; together they tile
        the plane, whatever the neighbours are. d and r hold a Vector a corner, counter-clockwise:
        d[k] = u_k - u_0, r[k] = X_k - X_0; r is constant. Elementwise, and called once a shape and
        part of the body. Cells with a broken bond between corners count unless `intact_only`.
        """

    @abstractmethod
    def broken_bonds(self) -> int:
        """How many bonds have broken so far."""


class Diagnostic(Component):
    """A quantity of the run that goes into the dataset.

    To add a diagnostic, write `variables` and `measure`. It is evaluated at recorded steps only,
    or at every step where it declares `every_step`; nothing of it exists where nobody asks.
    """

    uses_bonds: ClassVar[bool] = False
    """Whether readers of the dataset need the table of bonds to make sense of it."""
    uses_cells: ClassVar[bool] = False
    """Whether it makes no sense without cells (`Moment.over_cells`); a body that has none, a single
    row for instance, is then refused."""
    every_step: ClassVar[bool] = False
    """Measure at every step (dimension `step`) instead of at recorded ones (`time`)."""

    @abstractmethod
    def variables(self) -> tuple[Variable, ...]:
        """The variables that it adds to the dataset."""

    def coordinates(self) -> dict[str, NDArray[Any]]:
        """Dimensions of its own with their values; by default none."""
        return {}

    def check(self, particles: int) -> None:
        """Raise ExperimentError where it does not go with a scene of so many particles."""
        return

    @abstractmethod
    def measure(self, now: Moment) -> tuple[Any, ...]:
        """The values of its variables, one array each, shaped as their `dims` say."""
