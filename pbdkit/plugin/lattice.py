"""The interfaces Lattice (a repeat cell with a basis) and NeighbourMetric (neighbours in shells).

The module also computes the cells of a lattice, which are polygons of neighbouring sites that tile
the plane.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, lru_cache, reduce
from operator import add, mul, sub
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pbdkit.plugin.component import Component
from pbdkit.plugin.units import Place
from pbdkit.plugin.vector import Vector, vector

Index = tuple[int, ...]
"""Integers, one for each axis."""


PLANE_ORIGIN = Vector(0.0, 0.0)
NEARLY = 1e-9
"""Relative tolerance within which lengths are equal except for rounding errors."""


@dataclass(frozen=True)
class BasisSite:
    """A site of the repeat cell.

    Parameters
    ----------
    at : Vector of float
        Position in the cell, in lattice units.
    index : tuple of int
        Site index within the period of the cell.
    primitive : tuple of int
        Index in the primitive basis, in which Chebyshev distances are counted.
    """

    at: Vector[float] = PLANE_ORIGIN
    index: Index = (0, 0)
    primitive: Index = (0, 0)


@dataclass(frozen=True)
class Offset:
    """Vector and indices of the step from one site to another.

    Parameters
    ----------
    target : int
        Sublattice of the other site.
    cell : tuple of int
        Number of repeat cells along each axis.
    site, primitive : tuple of int
        Difference between the site indices of the two sites, and between their primitive indices.
    rest : Vector of float
        Vector in lattice units.
    """

    target: int
    cell: Index
    site: Index
    primitive: Index
    rest: Vector[float]

    @property
    def length(self) -> float:
        """|rest|, in lattice units."""
        return math.hypot(*self.rest)


@cache
def _of_one_site(axes: int) -> tuple[tuple[BasisSite], Index, tuple[Index, ...]]:
    """Return sites, period and primitive steps of a cell with one site at its corner."""
    nowhere, every = (0,) * axes, range(axes)
    corner = BasisSite(vector(map(float, nowhere)), nowhere, nowhere)
    return (corner,), (1,) * axes, tuple(tuple(int(a == b) for b in every) for a in every)


@dataclass(frozen=True)
class Cell:
    """The repeat cell of a lattice.

    Sites have integer indices (i, j). The sites repeat along `vectors[0]` when i increases by
    `period[0]`, along `vectors[1]` when j increases by `period[1]`, and so on. The site with index
    (i, j) is a copy of the basis site with the `index` (i mod period[0], j mod period[1]); if there
    is none, the lattice has a hole.

    Parameters
    ----------
    vectors : tuple of Vector
        Cell vectors in lattice units, as many as space has axes.
    sites : tuple of BasisSite
        Basis; by default one site at the corner.
    period : tuple of int
        Period of the site index along each vector; by default 1.
    primitive : tuple of tuple of int
        Cell vectors in the primitive basis; by default unit vectors.
    """

    vectors: tuple[Vector[float], ...]
    sites: tuple[BasisSite, ...] = ()
    period: Index = ()
    primitive: tuple[Index, ...] = ()

    def __post_init__(self) -> None:
        sites, period, steps = _of_one_site(len(self.vectors))
        object.__setattr__(self, "sites", self.sites or sites)
        object.__setattr__(self, "period", self.period or period)
        object.__setattr__(self, "primitive", self.primitive or steps)

    @property
    def axes(self) -> int:
        """Number of axes of space."""
        return len(self.vectors)

    @cached_property
    def basis(self) -> NDArray[np.float64]:
        """Positions of the sites of the basis in the repeat cell, (sublattice, axis)."""
        return np.array([site.at for site in self.sites])

    @cached_property
    def sublattices(self) -> NDArray[np.intp]:
        """Sublattice of each site index within the period, -1 at a hole."""
        result = np.full(self.period, -1, np.intp)
        for sublattice, site in enumerate(self.sites):
            result[site.index] = sublattice
        return result

    def shift(self, cell: Iterable[Any]) -> Any:
        """Return m·a + n·b, the vector from a repeat cell to the cell that is (m, n) cells away.

        Parameters
        ----------
        cell : iterable of int or array
            m and n, the numbers of cells along the vectors, as numbers or arrays.

        Returns
        -------
        Vector
            Vector in lattice units.
        """
        steps = [n * v for n, v in zip(cell, self.vectors, strict=True)]
        return sum(steps[1:], steps[0])

    def offset(self, source: int, target: int, cell: Index) -> Offset:
        """Return the offset between two sublattices.

        The reverse offset has exactly the negated `rest`.

        Parameters
        ----------
        source, target : int
            Sublattices.
        cell : tuple of int
            Number of repeat cells between them.

        Returns
        -------
        Offset
            Offset from a site of `source` to one of `target`.
        """
        start, end = self.sites[source], self.sites[target]
        periods = map(mul, cell, self.period)
        return Offset(
            target,
            cell,
            tuple(map(add, map(sub, end.index, start.index), periods)),
            self.primitive_step(source, target, cell),
            (end.at - start.at) + self.shift(cell),
        )

    def primitive_step(self, source: int, target: int, cell: Index) -> Index:
        """Return the offset between two sublattices in the primitive basis.

        Parameters
        ----------
        source, target : int
            Sublattices.
        cell : tuple of int
            Number of repeat cells between them.

        Returns
        -------
        tuple of int
            Steps along the primitive vectors.
        """
        start, end = self.sites[source].primitive, self.sites[target].primitive
        along = (sum(map(mul, cell, step)) for step in zip(*self.primitive, strict=True))
        return tuple(map(add, map(sub, end, start), along))

    def offsets(self, source: int, radius: float) -> list[Offset]:
        """Return the offsets from a site of `source` with 0 < |rest| ≤ radius, sorted by length.

        Parameters
        ----------
        source : int
            Sublattice.
        radius : float
            Radius in lattice units.

        Returns
        -------
        list of Offset
            Offsets, the shortest first.
        """
        return list(_offsets_within(_CellAsWritten(repr(self), self), source, radius))

    def _offsets(self, source: int, radius: float) -> list[Offset]:
        sites = self.basis
        cells = np.array(list(self._cells_within(radius + 2 * np.linalg.norm(sites, axis=1).max())))
        rests = (cells @ np.array(self.vectors))[:, None] + (sites - sites[source])
        near = np.argwhere(np.linalg.norm(rests, axis=2) <= radius * (1 + NEARLY))
        candidates = [self.offset(source, t, tuple(cells[n].tolist())) for n, t in near.tolist()]
        offsets = [offset for offset in candidates if any(offset.site) and offset.length <= radius]
        return sorted(offsets, key=lambda o: (o.length, o.site))

    def _cells_within(self, radius: float) -> Iterator[Index]:
        """Yield all repeat cells within a radius, and a few cells beyond it.

        The indices along the previous axes limit the range of indices along the next axis (Fincke
        and Pohst). The reason is that the number of all combinations of indices is too large for
        nearly collinear vectors.
        """
        # Columns in reverse, so that the first axis is the outermost.
        R = np.linalg.qr(np.array(self.vectors[::-1]).T, mode="r")

        def inside(fixed: Index) -> Iterator[Index]:
            unfixed = len(R) - len(fixed)
            if not unfixed:
                yield fixed
                return
            row = R[unfixed - 1]
            centre = -sum(row[len(R) - 1 - n] * m for n, m in enumerate(fixed)) / row[unfixed - 1]
            half = radius / abs(row[unfixed - 1])
            for n in range(math.floor(centre - half), math.ceil(centre + half) + 1):
                yield from inside((*fixed, n))

        yield from inside(())


@dataclass(frozen=True)
class _CellAsWritten:
    """Key of a cache: a cell that equals only cells with the same digits and types.

    In contrast to numbers, zeros of different sign are different here.
    """

    text: str
    cell: Cell = field(compare=False)


@lru_cache(maxsize=64)
def _offsets_within(written: _CellAsWritten, source: int, radius: float) -> tuple[Offset, ...]:
    """Return the offsets of a cell from a cache, which scenes on the same lattice share."""
    return tuple(written.cell._offsets(source, radius))


class Lattice(Component):
    """Positions of sites, given by a repeat cell with one or more sites and by `origin`.

    To add a lattice, write `cell`. A site has an integer index (i, j). The site (0, 0) lies at
    `origin`; lengths are in lattice units.

    Examples
    --------
    A lattice with one site in each cell:

    >>> class Sheared(Lattice):
    ...     type: Literal["sheared"] = "sheared"
    ...
    ...     def cell(self):
    ...         return Cell((Vector(1.0, 0.0), Vector(0.25, 1.0)))
    >>> [offset.cell for offset in Sheared().cell().offsets(0, 1.0)]
    [(-1, 0), (1, 0)]
    """

    origin: Place = Field((0.0, 0.0), description="Position of site (0, 0) (lattice units).")

    @abstractmethod
    def cell(self) -> Cell:
        """Return the repeat cell, which does not depend on `origin`.

        Returns
        -------
        Cell
            Repeat cell, with lengths in lattice units.
        """


@dataclass(frozen=True)
class Slot:
    """A neighbour that every particle of a sublattice has, at a constant offset.

    Parameters
    ----------
    source, target : int
        Sublattices.
    cell, site : tuple of int
        Difference between the repeat cells of the two particles, and between their site indices.
    rest : Vector of float
        Rest offset X_k - X_j, in lattice units.
    shell : int
        Number of the shell, from 1.
    """

    source: int
    target: int
    cell: Index
    site: Index
    rest: Vector[float]
    shell: int


@dataclass(frozen=True)
class Nearness:
    """Neighbourhood in the current configuration: √(w_x Δx² + w_y Δy²) ≤ radius (1 + 1e-9).

    Parameters
    ----------
    radius : float
        Radius in lattice units.
    weights : tuple of float
        Weight w of each axis.
    """

    radius: float
    weights: tuple[float, ...]


class NeighbourMetric(Component):
    """Selects the neighbours of a site on the infinite lattice, by shells.

    To add a metric, write `shells_around`. Being neighbours must be mutual: if the offset from j to
    k is selected, the offset from k to j must be selected too, in the same shell. Otherwise the
    metric is rejected.

    Examples
    --------
    All neighbours within a radius, in one shell:

    >>> class Within(NeighbourMetric):
    ...     type: Literal["within"] = "within"
    ...     radius: float
    ...
    ...     def shells_around(self, cell, sublattice):
    ...         return [cell.offsets(sublattice, self.radius)]
    >>> square = Cell((Vector(1.0, 0.0), Vector(0.0, 1.0)))
    >>> [len(shell) for shell in Within(radius=1.5).shells_around(square, 0)]
    [8]
    """

    @abstractmethod
    def shells_around(self, cell: Cell, sublattice: int) -> Sequence[Sequence[Offset]]:
        """Return the neighbours of a site, the first shell first.

        Parameters
        ----------
        cell : Cell
            Repeat cell; `cell.offsets(sublattice, radius)` lists all offsets within a radius.
        sublattice : int
            Sublattice of the site.

        Returns
        -------
        sequence of sequence of Offset
            Offsets of `cell` in each shell.
        """

    def nearness(self) -> Nearness | None:
        """Return the neighbourhood in which neighbours are searched in every step, or None.

        By default it is None: particles have the same neighbours in all steps, as in a solid.

        Returns
        -------
        Nearness or None
            Neighbourhood in the current configuration.
        """
        return None


@dataclass(frozen=True)
class CellPolygon:
    """A cell: a polygon of sites. The sites lie on a circle, and the circle contains no other site
    (Delaunay).

    Cells are squares on the square lattice and triangles on the hexagonal one.

    Parameters
    ----------
    source : int
        Sublattice of the first corner.
    kind : int
        Number of the cell among those of this sublattice.
    corners : tuple of Offset
        Offsets from the first corner to all corners including itself, counterclockwise. The first
        corner is the lowest one or, if several are equally low, the leftmost of them.
    """

    source: int
    kind: int
    corners: tuple[Offset, ...]

    @cached_property
    def rest(self) -> tuple[Vector[float], ...]:
        """Vectors X_k - X_0 from the first corner to all corners, in lattice units."""
        return tuple(corner.rest for corner in self.corners)

    @cached_property
    def rectangle(self) -> tuple[float, float] | None:
        """Sides (a, b) if the cell is a rectangle along the axes, else None."""
        if len(self.rest) != 4:
            return None
        _, right, opposite, up = self.rest
        a, b = right.x, up.y
        off = math.hypot(right.y, up.x, opposite.x - a, opposite.y - b)
        return (a, b) if off <= 1e-9 * math.hypot(a, b) else None

    @cached_property
    def is_regular(self) -> bool:
        """True if all sides are equal. All angles are then equal, too, since the corners lie on a
        circle."""
        sides = [math.dist(self.rest[k - 1], self.rest[k]) for k in range(len(self.rest))]
        return max(sides) - min(sides) <= 1e-9 * max(sides)


@dataclass(frozen=True)
class Side:
    """A cell beside a bond.

    Parameters
    ----------
    kind : int
        Number of the polygon among those with the sublattice of its first corner.
    first : Slot or None
        Slot from the start of the bond to the first corner of the cell; None if both are the same
        site.
    start, end : int
        Corners between which the bond lies.
    """

    kind: int
    first: Slot | None
    start: int
    end: int


@dataclass(frozen=True)
class Tiling:
    """The cells of a lattice, and those beside each bond.

    Parameters
    ----------
    polygons : tuple of CellPolygon
        Cells.
    beside : dict of Slot to (Side, Side)
        Cells to the left and right of a slot. For a diagonal, both are the same cell. The map is
        empty unless two conditions hold: all cells are triangles or parallelograms, and the
        neighbours of every site are the corners of the cells around it. These are 8 neighbours on
        the square and rectangular lattices and 6 on the hexagonal one.
    """

    polygons: tuple[CellPolygon, ...] = ()
    beside: dict[Slot, tuple[Side, Side]] = field(default_factory=dict)

    @cached_property
    def rectangle(self) -> tuple[float, float] | None:
        """Sides (a, b) of the cells if all are the same rectangle along the axes, else None."""
        sides = {polygon.rectangle for polygon in self.polygons}
        return sides.pop() if self.beside and len(sides) == 1 else None

    @cached_property
    def regular(self) -> int | None:
        """3 if the cells are equilateral triangles, 4 if they are squares, in any orientation; else
        None."""
        kinds = {len(cell.corners) if cell.is_regular else None for cell in self.polygons}
        return kinds.pop() if self.beside and len(kinds) == 1 else None

    def is_diagonal(self, slot: Slot) -> bool:
        """Return whether a slot is a diagonal of a cell. If so, the cell is on both sides of the
        bond.

        Parameters
        ----------
        slot : Slot
            Slot that is in `beside`.

        Returns
        -------
        bool
            True if it crosses a cell.
        """
        left, right = self.beside[slot]
        return left == right


def signed_area(corners: Sequence[Any]) -> Any:
    """Return the area of a polygon, elementwise. It is negative if the corners are clockwise."""
    pairs = [(corners[k - 1], corners[k]) for k in range(len(corners))]
    return sum(a.x * b.y - b.x * a.y for a, b in pairs) / 2


def area_share(d: Sequence[Any], r: Sequence[Any]) -> Any:
    """Return the signed area of a polygon with corners r + d divided by that with corners r."""
    current = [a + b for a, b in zip(r, d, strict=True)]
    return signed_area(current) / signed_area(r)


def corner_share(d: Sequence[Any], r: Sequence[Any]) -> Any:
    """Return the smallest signed area of the triangles at the corners of a polygon, as a ratio.

    The triangle at a corner is spanned by the two sides that meet there. Its area in the polygon
    with corners r + d is divided by its area in the polygon with corners r. All ratios are positive
    if and only if the polygon with corners r + d is convex and not inverted.
    """
    triples = [(k - 1, k, (k + 1) % len(r)) for k in range(len(r))]
    shares = (area_share([d[k] for k in three], [r[k] for k in three]) for three in triples)
    return reduce(np.minimum, shares)
