"""What a body is: a signed distance to an outline, and the sites that lie inside.

A site belongs to the body where the signed distance is at most 1e-9 of a lattice constant, so that
sites on the outline belong whatever the rounding (model.md, section 3).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pbdkit.interfaces import Component

Floats = NDArray[np.float64]
Count = Annotated[int, Field(ge=1, le=2**31)]


@dataclass(frozen=True)
class Box:
    """The rectangle around a body: in coordinates, or in site indices for a grid."""

    low: tuple[float, ...]
    high: tuple[float, ...]
    in_sites: bool = False


@dataclass(frozen=True)
class Sites:
    """Sites by `index` (i, j) and by the place where they lie, `at`; arrays of one shape."""

    index: Sequence[NDArray[np.signedinteger[Any]]]
    at: Any

    @property
    def i(self) -> NDArray[np.signedinteger[Any]]:
        """The index along the first axis."""
        return self.index[0]

    @property
    def j(self) -> NDArray[np.signedinteger[Any]]:
        """The index along the second axis."""
        return self.index[1]

    @property
    def x(self) -> Floats:
        """The coordinate along the first axis."""
        return np.asarray(self.at.x)

    @property
    def y(self) -> Floats:
        """The coordinate along the second axis."""
        return np.asarray(self.at.y)


class Body(Component):
    """An outline that is filled with the sites of a lattice."""

    @abstractmethod
    def boxes(self) -> list[Box]:
        """Rectangles that hold the body together."""

    @abstractmethod
    def distance(self, at: Sites) -> Floats:
        """The signed distance to the outline, negative inside; only its sign and its value near
        zero need be right."""

    def exaggerates(self) -> bool:
        """Whether `distance` can be more than the way to the outline."""
        return False


class Grid(Body):
    """`columns` × `rows` sites from (0, 0)."""

    type: Literal["grid"] = "grid"
    columns: Count
    rows: Count

    def boxes(self) -> list[Box]:
        """Site (0, 0) to (columns - 1, rows - 1)."""
        return [Box((0, 0), (self.columns - 1, self.rows - 1), in_sites=True)]

    def distance(self, at: Sites) -> Floats:
        """-1 for its sites, 1 for others."""
        inside = (at.i >= 0) & (at.i < self.columns) & (at.j >= 0) & (at.j < self.rows)
        return np.where(inside, -1.0, 1.0)
