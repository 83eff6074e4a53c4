"""Neighbours of every sublattice as constant slots in exactly opposite pairs, and the bonds between
them, those that cross a crack or a cut included.
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

from pbdkit.errors import ExperimentError
from pbdkit.lattice.cells import CellsAround, cells_around, tiling_of
from pbdkit.lattice.raster import (
    EMPTY,
    FOLLOWER,
    Block,
    Floats,
    Mask,
    Raster,
    common,
    hull,
    positions,
)
from pbdkit.plugin import Cell, Lattice, NeighbourMetric, Offset, Setting, Slot, Vector
from pbdkit.plugin.fracture import Segment
from pbdkit.plugin.frame import Indices
from pbdkit.plugin.lattice import Index, Tiling
from pbdkit.plugin.vector import vector

FLATTEST = 1e-3
"""Cells flatter than this are refused: within a cell vector of a site lie π/flatness others."""
SAME_PLACE = 1e-9
"""Sites nearer than this share of a cell vector lie at one place."""

BALANCED = 1e-9
"""How far a site may lie from the barycentre of its neighbours, as a share of their distance."""


@dataclass(frozen=True)
class BondPlane:
    """The bonds along one slot and its opposite: they live on the slot's source sublattice."""

    slot: Slot
    opposite: Slot


@dataclass(frozen=True)
class Neighbourhood:
    """`slots[s]` are the neighbours of sublattice s of `cell`, the nearest shells first and
    inversion partners side by side; `planes` holds each pair of opposite slots once."""

    cell: Cell
    slots: tuple[tuple[Slot, ...], ...]
    planes: tuple[BondPlane, ...]

    @cached_property
    def tiling(self) -> Tiling:
        """The cells of the lattice, and which of them lie beside the slots."""
        return tiling_of(self.cell, self.slots)

    @cached_property
    def cells_around(self) -> tuple[CellsAround, ...]:
        """By sublattice the cells around a particle with their bonds; none where neighbours are not
        the corners of cells."""
        return cells_around(self.tiling, self.slots, [plane.slot for plane in self.planes])

    @cached_property
    def every(self) -> tuple[Slot, ...]:
        """The slots of all sublattices, one after the other."""
        return tuple(slot for own in self.slots for slot in own)

    @property
    def reach(self) -> int:
        """The largest difference of site index, max(|Δi|, |Δj|)."""
        return max(abs(n) for slot in self.every for n in slot.site)

    @property
    def reach_in_cells(self) -> Index:
        """The largest difference of repeat cell along each axis."""
        return tuple(np.abs([slot.cell for slot in self.every]).max(axis=0).tolist())

    @cached_property
    def home(self) -> dict[Slot, tuple[int, bool]]:
        """By slot the plane on which its bonds live, and whether they do at this end: it is the end
        of the plane's own slot."""
        ends = enumerate(self.planes)
        return {slot: (n, slot is p.slot) for n, p in ends for slot in (p.slot, p.opposite)}

    @property
    def home_reach(self) -> tuple[Index, Index]:
        """How many cells before and after a particle's own, along each axis, its bonds may live."""
        steps = [slot.cell for slot, (_, here) in self.home.items() if not here]
        cells = np.array([(0,) * self.cell.axes, *steps])
        return tuple((-cells.min(axis=0)).tolist()), tuple(cells.max(axis=0).tolist())

    def shells(self) -> list[list[float]]:
        """The rest lengths of each shell, the first shell first."""
        found: list[list[float]] = [[] for _ in range(max(slot.shell for slot in self.every))]
        for slot in self.every:
            found[slot.shell - 1].append(math.hypot(*slot.rest))
        return found

    @cached_property
    def nudge_unit(self) -> float:
        """A power of two near the shortest rest length: what is moved by a share of it moves as far
        in all units, and scaling back rounds nothing."""
        return float(2.0 ** round(math.log2(min(map(min, self.shells())))))

    def spans_space(self) -> bool:
        """Whether steps between neighbours reach in all directions; else rows do not feel each
        other."""
        rests = np.array([slot.rest for slot in self.every])
        directions = rests / np.linalg.norm(rests, axis=1)[:, None]
        return bool(np.linalg.matrix_rank(directions, tol=1e-9) == self.cell.axes)


def checked_cell(lattice: Lattice) -> Cell:
    """The lattice's cell; ExperimentError where it is degenerate, its sites share an index or a
    place, or lie so far off that positions would."""
    cell = lattice.cell()
    named = " and ".join(str(tuple(v)) for v in cell.vectors)
    indices = [site.index for site in cell.sites]
    inside = all(0 <= n < p for index in indices for n, p in zip(index, cell.period, strict=True))
    if not np.isfinite(cell.vectors).all() or flatness(cell) == 0.0:
        raise ExperimentError(f"the cell vectors {named} span no area")
    if flatness(cell) < FLATTEST:
        raise ExperimentError(
            f"the cell vectors {named} are nearly degenerate: sites lie {1 / flatness(cell):.3g} "
            f"times closer along one line than the longer is long, and {1 / FLATTEST:g} times is "
            "the most; open their angle, or make their lengths more alike"
        )
    far = max(map(abs, lattice.origin))
    apart = min(math.hypot(*v) for v in cell.vectors)
    if 4 * math.ulp(far) > apart:
        raise ExperimentError(
            f"at {far:g} double precision does not tell sites apart that lie {apart:g} from each "
            "other; move the origin nearer to zero",
            ("origin",),
        )
    if len(set(indices)) < len(indices) or not inside:
        raise ExperimentError(
            f"the basis sites have the indices {indices}: they must differ and lie within the "
            f"period {cell.period}"
        )
    for s, site in enumerate(cell.sites):
        for near in cell.offsets(s, SAME_PLACE * math.hypot(*cell.vectors[0])):
            raise ExperimentError(
                f"the sites with the indices {site.index} and {cell.sites[near.target].index} lie "
                f"at one place, {tuple(site.at)}; give each its own"
            )
    return cell


def flatness(cell: Cell) -> float:
    """How much less room than a square or cube a cell has: sites · area / (longest vector)², the
    sine of the angle for one site and vectors of one length in the plane."""
    scaled = np.array(cell.vectors) / max(math.hypot(*v) for v in cell.vectors)
    return len(cell.sites) * abs(float(np.linalg.det(scaled)))


def build_neighbourhood(cell: Cell, metric: NeighbourMetric) -> Neighbourhood:
    """The slots that the metric chooses; ExperimentError unless neighbourhood is mutual and
    balanced."""
    exact = _ExactVectors()
    sublattices = range(len(cell.sites))
    slots = tuple(_slots_of(s, metric.shells_around(cell, s), exact) for s in sublattices)
    by_key = {(s.source, s.target, s.cell): s for own in slots for s in own}
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
    for own in slots:
        _refuse_lopsided(own, metric)
    return Neighbourhood(cell, slots, tuple(planes))


def _refuse_lopsided(own: tuple[Slot, ...], metric: NeighbourMetric) -> None:
    """On lattices whose sites are no centres of inversion, mutual is not enough."""
    sums = [math.fsum(along) for along in zip(*(slot.rest for slot in own), strict=True)]
    if math.hypot(*sums) > BALANCED * math.fsum(math.hypot(*slot.rest) for slot in own):
        raise ExperimentError(
            f"'{metric.type}' is lopsided on this lattice: the {len(own)} neighbours of a site "
            f"have their barycentre ({', '.join(f'{s / len(own):.3g}' for s in sums)}) away from "
            "it, and a body at rest would drift; choose whole shells of equal distance, "
            "{type: coordination}"
        )


def _refuse_gaps(slots: tuple[tuple[Slot, ...], ...], different: int) -> None:
    if not all(slots):
        raise ExperimentError("some sites have no neighbour at all: more shells, a larger radius")
    if sum(map(len, slots)) > different:
        raise ExperimentError("a neighbour is listed in two shells, or twice in one")
    shells = {slot.shell for own in slots for slot in own}
    if shells != set(range(1, max(shells) + 1)):
        raise ExperimentError(f"a shell is empty: only shells {sorted(shells)} have neighbours")


def _slots_of(
    source: int, shells: Sequence[Sequence[Offset]], exact: _ExactVectors
) -> tuple[Slot, ...]:
    offsets = [(shell, offset) for shell, near in enumerate(shells, 1) for offset in near]
    found = [(shell, *exact.of(offset.rest), offset) for shell, offset in offsets]
    found.sort(key=lambda entry: entry[:3])
    return tuple(
        Slot(source, to.target, to.cell, to.site, rest, shell) for shell, _, _, rest, to in found
    )


class _ExactVectors:
    """Gives vectors that are equal or opposite up to rounding one value and its exact negative.

    Sums over a body at rest then cancel exactly, whatever the order of magnitude.
    """

    def __init__(self) -> None:
        self._known: list[Vector[float]] = []
        self._near: dict[Index, int] = {}

    def of(self, v: Vector[float]) -> tuple[int, bool, Vector[float]]:
        """(which known vector, whether negated, the value to use)."""
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
        """The place on a grid much finer than any lattice and much coarser than rounding."""
        unit = 1e-6 * math.hypot(*(self._known[0] if self._known else v))
        return tuple(math.floor(component / unit) for component in v)


def crosses(start: Vector, end: Vector, a: Vector, b: Vector) -> Mask:
    """Whether each bond from `start` to `end` crosses the crack from a to b.

    A particle exactly on the crack's line counts to its left side, so that a crack along a row of
    particles parts the row from those on its right; a bond that a tip touches is crossed.
    """
    parted = (_side(a, b, start) >= 0) ^ (_side(a, b, end) >= 0)
    return parted & (_side(start, end, a) * _side(start, end, b) <= 0)


def crossed_bonds(
    raster: Raster, neighbourhood: Neighbourhood, segments: Iterable[Segment]
) -> Iterator[tuple[int, Block, Mask]]:
    """Plane by plane its number, the block of its bonds, and which of them, those to the frame too,
    cross one of the segments."""
    # As the rasters count: from the lattice's site (0, 0).
    origin = Vector(*raster.lattice.origin[:2])
    local = [(Vector(*a) - origin, Vector(*b) - origin) for a, b in segments]
    for n, plane in enumerate(neighbourhood.planes if local else ()):
        if block := plane_block(raster, plane):
            start = raster.reference_planes(block)
            end, bonds = start + plane.slot.rest, bonds_in(raster, block, plane, frame_too=True)
            crossed = np.any([crosses(start, end, *ends) for ends in local], axis=0)
            yield n, block, bonds & crossed


def _side(a: Vector, b: Vector, c: Vector) -> Floats:
    """Twice the signed area of a, b, c: positive where c lies left of the line from a to b."""
    return np.asarray((b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x))


@dataclass(frozen=True)
class BondTable:
    """A row a bond, sorted: `ends` (bond, 2) are rows of the particle table, lower first, `shell`
    counts from 1. `plane` and `place` tell where its state lives: plane[bond] of the
    neighbourhood's planes, at the flat place of the plane's source within its sublattice."""

    ends: NDArray[np.int64]
    shell: NDArray[np.int8]
    plane: Indices
    place: Indices


def plane_block(raster: Raster, plane: BondPlane, *, inside: bool = False) -> Block | None:
    """The block of source places of every bond of a plane with an end in the body, or of those with
    both."""
    forward = raster.body_block(plane.slot.source)
    landed = raster.body_block(plane.slot.target)
    backward = landed.seen_through(plane.opposite) if landed else None
    if inside:
        return common(forward, backward) if forward and backward else None
    corners = [(block.start, block.stop) for block in (forward, backward) if block]
    return Block(plane.slot.source, *hull(corners)) if corners else None


def bonds_in(raster: Raster, block: Block, plane: BondPlane, frame_too: bool) -> Mask:
    """Where in the block of a plane a bond starts: both ends are particles, at least one of the
    body, or both where bonds to the frame are left out."""
    here = raster.kind[block.slices()]
    there = raster.kind[block.seen_through(plane.slot).slices()]
    found: Mask = (here == FOLLOWER) & (there == FOLLOWER)
    if frame_too:
        found = (here == FOLLOWER) & (there != EMPTY) | (here != EMPTY) & (there == FOLLOWER)
    return found


def count_bonds(raster: Raster, neighbourhood: Neighbourhood) -> int:
    """The number of bonds with at least one end in the body."""
    blocks = ((plane, plane_block(raster, plane)) for plane in neighbourhood.planes)
    return sum(int(bonds_in(raster, b, plane, True).sum()) for plane, b in blocks if b)


def build_bond_table(raster: Raster, neighbourhood: Neighbourhood) -> BondTable:
    """The table of all bonds."""
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
    """(rows of both ends, shell, number of the plane, place in it) of its bonds."""
    found = np.nonzero(bonds_in(raster, block, plane, frame_too=True))
    cells, slot = list(map(add, found, block.start)), plane.slot
    a = raster.rows_at(slot.source, *cells)
    b = raster.rows_at(slot.target, *map(add, cells, slot.cell))
    within = np.ravel_multi_index(tuple(cells), raster.shape[1:])
    shell, of_plane = np.full(len(a), slot.shell, np.int8), np.full(len(a), number)
    ends = np.stack([np.minimum(a, b), np.maximum(a, b)], axis=1)
    return ends, shell, of_plane, within


def missing_segments(
    raster: Raster, neighbourhood: Neighbourhood, segments: Mapping[str, Segment]
) -> list[str]:
    """A warning for each segment, by its field, that crosses nothing."""
    return [
        f"{field}: it crosses no bond of the body; look where it goes from and to"
        for field, segment in segments.items()
        if not raster.communicator.any(
            any(found.any() for *_, found in crossed_bonds(raster, neighbourhood, [segment]))
        )
    ]


def setting_of(raster: Raster, neighbourhood: Neighbourhood) -> Setting:
    """What a rule may derive its constants from."""
    lower, upper = (end.each(add, raster.lattice.origin) for end in body_box(raster))
    cell, slots = raster.lattice.cell(), neighbourhood.slots
    return Setting(cell, slots, lower, upper, neighbourhood.tiling)


def body_box(raster: Raster) -> tuple[Vector[float], Vector[float]]:
    """(lower, upper) of the body's reference configuration, from the lattice's site (0, 0)."""
    ends = (raster.ends_of_rows(s) for s in range(raster.shape[0]))
    at = [positions(raster.lattice.cell(), s, *cells) for s, cells in enumerate(ends)]
    lower, upper = raster.hull_of_all(
        (tuple(x.min() for x in here), tuple(x.max() for x in here)) for here in at if here[0].size
    )
    return vector(map(float, lower)), vector(map(float, upper))
