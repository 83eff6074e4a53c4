"""Neighbours of every sublattice, and the bonds between particles. Neighbours are given by constant
slots, which occur in exactly opposite pairs.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from operator import add

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats, Indices, Mask
from pbdkit.errors import ExperimentError
from pbdkit.lattice.cells import CellsAround, cells_around, tiling_of
from pbdkit.lattice.raster import EMPTY, FOLLOWER, Block, Raster, common, hull
from pbdkit.plugin import Cell, Lattice, NeighbourMetric, Offset, Setting, Slot, Vector
from pbdkit.plugin.fracture_model import Segment
from pbdkit.plugin.lattice import Index, Tiling

MIN_FLATNESS = 1e-3
"""Smallest accepted flatness of a cell, as defined by `flatness`. If a cell has one site, about
π/flatness sites lie within the length of the longest cell vector of a site."""
COINCIDENCE_RTOL = 1e-9
"""Distance, relative to the length of the first cell vector, up to which two sites are regarded as
coincident."""
BARYCENTRE_RTOL = 1e-9
"""A site is regarded as the barycentre of its neighbours if its distance from the barycentre,
relative to the distance of the neighbours, is at most this number."""


@dataclass(frozen=True)
class BondPlane:
    """Bonds along one slot and the opposite slot. They are stored at the source sublattice of the
    slot."""

    slot: Slot
    opposite: Slot


@dataclass(frozen=True)
class Neighbourhood:
    """Neighbours on a lattice.

    Parameters
    ----------
    cell
        Repeat cell of the lattice.
    slots
        Slots of the neighbours of each sublattice, sorted by shell. Opposite slots are adjacent.
    planes
        Pairs of opposite slots; no pair occurs twice.
    """

    cell: Cell
    slots: tuple[tuple[Slot, ...], ...]
    planes: tuple[BondPlane, ...]

    @cached_property
    def tiling(self) -> Tiling:
        """Cells of the lattice, with the cells on both sides of each slot."""
        return tiling_of(self.cell, self.slots)

    @cached_property
    def cells_around(self) -> tuple[CellsAround, ...]:
        """Cells around the particles of each sublattice. Empty unless all neighbours of a particle
        are corners of its cells.
        """
        return cells_around(self.tiling, self.slots, [plane.slot for plane in self.planes])

    @cached_property
    def every(self) -> tuple[Slot, ...]:
        """Slots of all sublattices, in order."""
        return tuple(slot for slots in self.slots for slot in slots)

    @property
    def reach(self) -> int:
        """Largest difference, max(|Δi|, |Δj|), between the site indices of two neighbours."""
        return max(abs(n) for slot in self.every for n in slot.site)

    @property
    def reach_in_cells(self) -> Index:
        """Largest difference, along each axis, between the repeat cells of two neighbours."""
        return tuple(np.abs([slot.cell for slot in self.every]).max(axis=0).tolist())

    @cached_property
    def owner(self) -> dict[Slot, tuple[int, bool]]:
        """Plane in which the bonds along each slot are stored, and whether a bond is stored at the
        particle at which the slot starts."""
        ends = enumerate(self.planes)
        return {slot: (n, slot is p.slot) for n, p in ends for slot in (p.slot, p.opposite)}

    @property
    def owner_reach(self) -> tuple[Index, Index]:
        """Largest differences of repeat cell, backward and forward, between a particle and the
        places that store its bonds."""
        steps = [slot.cell for slot, (_, at_start) in self.owner.items() if not at_start]
        cells = np.array([(0,) * self.cell.axes, *steps])
        return tuple((-cells.min(axis=0)).tolist()), tuple(cells.max(axis=0).tolist())

    def shells(self) -> list[list[float]]:
        """Return the rest lengths of the slots of each shell, beginning with the first shell."""
        lengths: list[list[float]] = [[] for _ in range(max(slot.shell for slot in self.every))]
        for slot in self.every:
            lengths[slot.shell - 1].append(math.hypot(*slot.rest))
        return lengths

    @cached_property
    def nudge_unit(self) -> float:
        """Power of two near the shortest rest length.

        Perturbations are proportional to it, so that they scale with the unit of length;
        multiplication by a power of two is exact.
        """
        return float(2.0 ** round(math.log2(min(map(min, self.shells())))))

    def spans_space(self) -> bool:
        """Return whether the directions of the bonds span the space. Otherwise the lattice has rows
        that are not coupled to each other."""
        rests = np.array([slot.rest for slot in self.every])
        directions = rests / np.linalg.norm(rests, axis=1)[:, None]
        return bool(np.linalg.matrix_rank(directions, tol=1e-9) == self.cell.axes)


def checked_cell(lattice: Lattice) -> Cell:
    """Return the repeat cell of a lattice after validation.

    Raises
    ------
    ExperimentError
        If the cell is degenerate, two of its sites share an index or a position, or the origin is
        so far away that positions would coincide.
    """
    cell = lattice.cell()
    vectors = " and ".join(str(tuple(v)) for v in cell.vectors)
    indices = [site.index for site in cell.sites]
    inside = all(0 <= n < p for index in indices for n, p in zip(index, cell.period, strict=True))
    if not np.isfinite(cell.vectors).all() or flatness(cell) == 0.0:
        raise ExperimentError(f"the cell vectors {vectors} span no area; choose independent ones")
    if flatness(cell) < MIN_FLATNESS:
        raise ExperimentError(
            f"the cell vectors {vectors} are nearly degenerate: the longer vector is "
            f"{1 / flatness(cell):.3g} times the smallest distance of sites, and the maximum is "
            f"{1 / MIN_FLATNESS:g}; increase their angle, or choose more similar lengths"
        )
    far = max(map(abs, lattice.origin))
    spacing = min(math.hypot(*v) for v in cell.vectors)
    if 4 * math.ulp(far) > spacing:
        raise ExperimentError(
            f"at {far:g} double precision cannot resolve the distance {spacing:g} between sites; "
            "move the origin nearer to zero",
            ("origin",),
        )
    if len(set(indices)) < len(indices) or not inside:
        raise ExperimentError(
            f"the basis sites have the indices {indices}: these must differ and lie within the "
            f"period {cell.period}"
        )
    for s, site in enumerate(cell.sites) if len(cell.sites) > 1 else ():
        for near in cell.offsets(s, COINCIDENCE_RTOL * math.hypot(*cell.vectors[0])):
            raise ExperimentError(
                f"the sites with the indices {site.index} and {cell.sites[near.target].index} lie "
                f"at one place, {tuple(site.at)}; choose different positions"
            )
    return cell


def flatness(cell: Cell) -> float:
    """Return the area of a cell, multiplied by the number of its sites and divided by the area of a
    square with the length of the longest cell vector as its side.

    For one site and vectors of equal length the result is the sine of their angle. In space the
    volume of the cell is divided by the volume of a cube.
    """
    scaled = np.array(cell.vectors) / max(math.hypot(*v) for v in cell.vectors)
    return len(cell.sites) * abs(float(np.linalg.det(scaled)))


def build_neighbourhood(cell: Cell, metric: NeighbourMetric) -> Neighbourhood:
    """Build the slots that a metric selects.

    Raises
    ------
    ExperimentError
        If neighbourhood is not mutual, or a site is not the barycentre of its neighbours.
    """
    exact = _ExactVectors()
    sublattices = range(len(cell.sites))
    slots = tuple(_slots_of(s, metric.shells_around(cell, s), exact) for s in sublattices)
    by_key = {(s.source, s.target, s.cell): s for ends in slots for s in ends}
    _refuse_gaps(slots, len(by_key))
    planes = []
    for slot in by_key.values():
        opposite = by_key.get((slot.target, slot.source, tuple(-n for n in slot.cell)))
        if opposite is None or opposite.shell != slot.shell:
            raise ExperimentError(
                f"'{metric.type}' is not mutual: the neighbour at site index offset {slot.site} "
                "does not have this one in the same shell; a body at rest would drift"
            )
        if slot.site > (0,) * cell.axes:
            planes.append(BondPlane(slot, opposite))
    for ends in slots:
        _refuse_unbalanced(ends, metric)
    return Neighbourhood(cell, slots, tuple(planes))


def _refuse_unbalanced(slots: tuple[Slot, ...], metric: NeighbourMetric) -> None:
    """Raise ExperimentError if a site is not the barycentre of its neighbours.

    If sites are not centres of inversion, neighbourhood can be mutual although a site is not the
    barycentre of its neighbours.
    """
    sums = [math.fsum(along) for along in zip(*(slot.rest for slot in slots), strict=True)]
    if math.hypot(*sums) > BARYCENTRE_RTOL * math.fsum(math.hypot(*slot.rest) for slot in slots):
        distance = ", ".join(f"{s / len(slots):.3g}" for s in sums)
        raise ExperimentError(
            f"'{metric.type}' is unbalanced on this lattice: the barycentre of the {len(slots)} "
            f"neighbours of a site differs from the site by ({distance}), and a body at rest would "
            "drift; choose whole shells of equal distance, {type: coordination}"
        )


def _refuse_gaps(slots: tuple[tuple[Slot, ...], ...], count: int) -> None:
    if not all(slots):
        raise ExperimentError("some sites have no neighbour; increase the shells or the radius")
    if sum(map(len, slots)) > count:
        raise ExperimentError("a neighbour is listed in two shells, or twice in one")
    shells = {slot.shell for ends in slots for slot in ends}
    if shells != set(range(1, max(shells) + 1)):
        raise ExperimentError(f"a shell is empty: only shells {sorted(shells)} have neighbours")


def _slots_of(
    source: int, shells: Sequence[Sequence[Offset]], exact: _ExactVectors
) -> tuple[Slot, ...]:
    offsets = [(shell, offset) for shell, near in enumerate(shells, 1) for offset in near]
    entries = [(shell, *exact.of(offset.rest), offset) for shell, offset in offsets]
    entries.sort(key=lambda entry: entry[:3])
    return tuple(
        Slot(source, to.target, to.cell, to.site, rest, shell) for shell, _, _, rest, to in entries
    )


class _ExactVectors:
    """Replace vectors that are equal or opposite within rounding by one value and its exact
    negative.

    Sums over the neighbours in a body at rest then cancel exactly, independent of the magnitude of
    the vectors.
    """

    def __init__(self) -> None:
        self._known: list[Vector[float]] = []
        self._near: dict[Index, int] = {}

    def of(self, v: Vector[float]) -> tuple[int, bool, Vector[float]]:
        """Return the index of the stored vector that v is equal or opposite to, whether v is
        opposite to it, and the exact value of v."""
        if (number := self._near.get(self._key(v))) is not None:
            return number, False, self._known[number]
        if (number := self._near.get(self._key(-v))) is not None:
            return number, True, -self._known[number]
        number = len(self._known)
        self._known.append(v.each(lambda component: component + 0.0))
        for near in product(*((n - 1, n, n + 1) for n in self._key(v))):
            self._near.setdefault(near, number)
        return number, False, self._known[number]

    def _key(self, v: Vector[float]) -> Index:
        """Round v to the points of a grid. The spacing of the grid is much larger than rounding
        errors."""
        unit = 1e-6 * math.hypot(*(self._known[0] if self._known else v))
        return tuple(math.floor(component / unit) for component in v)


def crosses(start: Vector, end: Vector, a: Vector, b: Vector) -> Mask:
    """Return whether each bond from `start` to `end` crosses the crack from a to b.

    A particle exactly on the line of the crack is treated as lying to the left of it. A crack along
    a row of particles therefore separates this row from the particles on the right of the crack. A
    bond that touches a tip of the crack counts as crossed.
    """
    is_separated = (_side(a, b, start) >= 0) ^ (_side(a, b, end) >= 0)
    return is_separated & (_side(start, end, a) * _side(start, end, b) <= 0)


def crossed_bonds(
    raster: Raster, neighbourhood: Neighbourhood, segments: Iterable[Segment]
) -> Iterator[tuple[int, Block, Mask]]:
    """Generate the bonds that cross one of several segments, plane by plane.

    Parameters
    ----------
    raster
        Particles of the scene.
    neighbourhood
        Neighbours on the lattice.
    segments
        Pairs of end points.

    Yields
    ------
    tuple
        Index of the plane, block of the bonds of the plane, and mask of the bonds that cross a
        segment. Bonds to frame points are included.
    """
    # Positions on rasters are relative to site (0, 0) of the lattice.
    origin = Vector(*raster.lattice.origin[:2])
    local = [(Vector(*a) - origin, Vector(*b) - origin) for a, b in segments]
    for n, plane in enumerate(neighbourhood.planes if local else ()):
        if block := plane_block(raster, plane):
            start = raster.reference_planes(block)
            end, bonds = start + plane.slot.rest, bonds_in(raster, block, plane, frame_too=True)
            crossed = np.any([crosses(start, end, *ends) for ends in local], axis=0)
            yield n, block, bonds & crossed


def _side(a: Vector, b: Vector, c: Vector) -> Floats:
    """Return twice the signed area of a, b, c: positive if c lies left of the line from a to b."""
    return np.asarray((b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x))


@dataclass(frozen=True)
class BondTable:
    """Bonds of the body, sorted.

    Parameters
    ----------
    ends
        Rows of both particles in the particle table, lower first, (bond, 2).
    shell
        Shell of each bond, from 1.
    plane, place
        Position of the state of each bond: the index of its plane in the neighbourhood, and the
        flat place of its source within the sublattice.
    """

    ends: NDArray[np.int64]
    shell: NDArray[np.int8]
    plane: Indices
    place: Indices


def plane_block(raster: Raster, plane: BondPlane, *, inside: bool = False) -> Block | None:
    """Return the block of places at which bonds of a plane start. Bonds without an end in the body
    are excluded.

    With `inside`, only bonds with both ends in the body are included.
    """
    forward = raster.body_block(plane.slot.source)
    target = raster.body_block(plane.slot.target)
    backward = target.seen_through(plane.opposite) if target else None
    if inside:
        return common(forward, backward) if forward and backward else None
    corners = [(block.start, block.stop) for block in (forward, backward) if block]
    return Block(plane.slot.source, *hull(corners)) if corners else None


def bonds_in(raster: Raster, block: Block, plane: BondPlane, frame_too: bool) -> Mask:
    """Return a mask of the places of a block where a bond starts.

    Both ends of a bond are particles, and at least one of them belongs to the body. Without
    `frame_too`, both ends have to belong to the body.
    """
    start = raster.kind[block.slices()]
    end = raster.kind[block.seen_through(plane.slot).slices()]
    mask: Mask = (start == FOLLOWER) & (end == FOLLOWER)
    if frame_too:
        mask = (start == FOLLOWER) & (end != EMPTY) | (start != EMPTY) & (end == FOLLOWER)
    return mask


def count_bonds(raster: Raster, neighbourhood: Neighbourhood) -> int:
    """Return the number of bonds with at least one end in the body."""
    blocks = ((plane, plane_block(raster, plane)) for plane in neighbourhood.planes)
    return sum(int(bonds_in(raster, b, plane, True).sum()) for plane, b in blocks if b)


def build_bond_table(raster: Raster, neighbourhood: Neighbourhood) -> BondTable:
    """Build the table of all bonds."""
    parts = [
        _bonds_of_plane(raster, n, plane, block)
        for n, plane in enumerate(neighbourhood.planes)
        if (block := plane_block(raster, plane))
    ]
    ends, shell, number, place = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    return BondTable(ends[order], shell[order], number[order], place[order])


def _bonds_of_plane(
    raster: Raster, number: int, plane: BondPlane, block: Block
) -> tuple[Indices, NDArray[np.int8], Indices, Indices]:
    """Return rows of both ends, shell, index of the plane and place of the bonds of a plane."""
    starts = np.nonzero(bonds_in(raster, block, plane, frame_too=True))
    cells, slot = list(map(add, starts, block.start)), plane.slot
    a = raster.rows_at(slot.source, *cells)
    b = raster.rows_at(slot.target, *map(add, cells, slot.cell))
    places = np.ravel_multi_index(tuple(cells), raster.shape[1:])
    shell, of_plane = np.full(len(a), slot.shell, np.int8), np.full(len(a), number)
    ends = np.stack([np.minimum(a, b), np.maximum(a, b)], axis=1)
    return ends, shell, of_plane, places


def missing_segments(
    raster: Raster, neighbourhood: Neighbourhood, segments: Mapping[str, Segment]
) -> list[str]:
    """Return a warning for each segment that crosses no bond. The warning begins with the field of
    the segment in the experiment."""
    return [
        f"{field}: it crosses no bond of the body; check its end points"
        for field, segment in segments.items()
        if not raster.communicator.any(
            any(crossed.any() for *_, crossed in crossed_bonds(raster, neighbourhood, [segment]))
        )
    ]


def setting_of(
    raster: Raster, neighbourhood: Neighbourhood, box: tuple[Vector[float], Vector[float]]
) -> Setting:
    """Return the lattice context from which a rule may derive constants. `box` is the bounding box
    of the body."""
    lower, upper = (end.each(add, raster.lattice.origin) for end in box)
    cell, slots = raster.cell, neighbourhood.slots
    return Setting(cell, slots, lower, upper, neighbourhood.tiling)
