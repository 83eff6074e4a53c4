"""The bonds of a scene, and those that cross a crack or a cut."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from operator import add

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Vector
from pbdkit.interfaces.fracture_model import Segment
from pbdkit.interfaces.frame import Indices
from pbdkit.scene.neighbourhood import BondPlane, Neighbourhood
from pbdkit.scene.places import Block, Floats, Mask, common, hull
from pbdkit.scene.raster import EMPTY, FOLLOWER, Raster


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
        if not raster.others.any(
            any(found.any() for *_, found in crossed_bonds(raster, neighbourhood, [segment]))
        )
    ]
