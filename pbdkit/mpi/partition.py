"""Partition of a lattice among ranks. A part consists of rows of repeat cells with a halo. This
module also exchanges halos and joins parts.

A part has its own rows and a halo of rows of the adjacent parts. The outermost rows of the halo are
empty; their number is the number of rows that neighbours reach. In the same number of rows next to
them, all particles except leaders are treated as frame points that follow no particle. In each step
the number of valid rows decreases by the reach of a step. If the halo is wide enough, several steps
can therefore be made before it is exchanged.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Array, Bytes, Indices, Mask
from pbdkit.communicator import SERIAL, Communicator
from pbdkit.errors import ExperimentError
from pbdkit.io.paged_file import PiecedArray, as_bytes
from pbdkit.lattice.fill import Lines, framed, window
from pbdkit.lattice.raster import (
    EMPTY,
    FOLLOWER,
    FRAME,
    OmittedCells,
    Raster,
    Restriction,
    RowLayout,
    Stretch,
    hull,
    row_view,
)
from pbdkit.mpi.communicator import MPICommunicator
from pbdkit.plugin.lattice import Index
from pbdkit.scene.scene import LatticeSetup, Scene
from pbdkit.stepping.program import program_of, reach_of
from pbdkit.stepping.state import State

BLOCK = 2**23
"""Number of bytes that are sent at once."""


class Share:
    """Part of an array along an axis, in a process other than the first. It has the data type of
    the array, and a method that sends the part to the first process."""

    def __init__(self, part: Array, axis: int) -> None:
        self.shape, self.dtype, self.ndim = part.shape, part.dtype, part.ndim
        self.nbytes = part.nbytes
        self._part, self._axis = part, axis

    def send(self, ranks: MPICommunicator) -> None:
        """Send the share to the first process."""
        for block in _blocks(self._part, self._axis):
            ranks.send(block, 0)


def joined(ranks: MPICommunicator, part: Array, axis: int, lengths: Sequence[int]) -> Any:
    """Join an array of which each process has a part. `lengths` are the lengths of the parts along
    an axis, in the order of ranks. The result is a PiecedArray in the first process, and a Share in
    each of the other processes."""
    if not ranks.is_root:
        return Share(part, axis)
    shape = (*part.shape[:axis], sum(lengths), *part.shape[axis + 1 :])
    return PiecedArray(shape, part.dtype, _received(ranks, part, axis, lengths))


def _received(
    ranks: MPICommunicator, part: Array, axis: int, lengths: Sequence[int]
) -> Iterator[Array]:
    for lead in np.ndindex(part.shape[:axis]):
        yield part[lead]
        for rank, length in enumerate(lengths[1:], 1):
            remaining = length * _row_bytes(part, axis)
            while remaining:
                piece = np.empty(min(remaining, BLOCK), np.uint8)
                ranks.receive(piece, rank)
                remaining -= piece.size
                yield piece


def _row_bytes(part: Array, axis: int) -> int:
    return int(np.prod(part.shape[axis + 1 :], dtype=int)) * part.itemsize


def _blocks(part: Array, axis: int) -> Iterator[Bytes]:
    for lead in np.ndindex(part.shape[:axis]):
        whole = as_bytes(part[lead])
        for at in range(0, whole.size, BLOCK):
            yield whole[at : at + BLOCK]


MAX_STEPS_PER_EXCHANGE = 16
"""Maximum number of steps between two exchanges. With this number, the halo of a part with 1500
rows is a hundredth of the part."""
MAX_OVERLAP = 0.05
"""Maximum number of rows that are computed by both of two adjacent parts, relative to the number of
rows of a part."""
MIN_MEASURED_ROWS = 3
"""Minimum number of moving rows on each side of the own rows of a part if diagnostics are evaluated
on the part."""


@dataclass(frozen=True)
class Subdomain:
    """Part of a lattice: its own rows of repeat cells are `begin` to `end`, and with its halo it
    extends from row `low` to row `high`. The outermost `edge` rows are empty, and the same number
    of rows next to them do not move. `steps` steps can be made between two exchanges."""

    begin: int
    end: int
    low: int
    high: int
    edge: int
    steps: int

    @property
    def own(self) -> slice:
        """Range of the rows that the process owns, in arrays of its part."""
        return slice(self.begin - self.low, self.end - self.low)

    def after(self, rows: int) -> Subdomain:
        """Return the subdomain with rows that are counted from the row `rows` instead of row 0."""
        begin, end, low, high = (n - rows for n in (self.begin, self.end, self.low, self.high))
        return replace(self, begin=begin, end=end, low=low, high=high)

    def cut(self, array: Array, axes: int) -> Array:
        """Return a copy of the rows of this subdomain from an array of the whole lattice. The last
        `axes` axes of the array are those of repeat cells."""
        return row_view(array, axes, slice(self.low, self.high)).copy()

    def seen(self, rows: int) -> tuple[int, int]:
        """Return the range of rows that are not empty in this subdomain. `rows` is the number of
        rows of the whole lattice."""
        return self._within(rows, self.edge)

    def inner(self, rows: int) -> tuple[int, int]:
        """Return the range of rows that move in this subdomain."""
        return self._within(rows, 2 * self.edge)

    def _within(self, rows: int, edge: int) -> tuple[int, int]:
        low = self.low + edge if self.low > 0 else 0
        return low, self.high - edge if self.high < rows else rows


def reaches(scene: Scene) -> tuple[int, int]:
    """Return the number of rows that a step reaches, and the number that neighbours reach."""
    sweeps = sum(operation.sweeps() for operation in program_of(scene))
    reach = reach_of(scene, 0).reach
    return sweeps * (reach + farthest_apart(scene)), reach


def farthest_apart(scene: Scene) -> int:
    """Return the largest number of rows between a frame point and a particle that it follows."""
    return int(max(scene.raster.communicator.allgather(reach_of(scene, 0).apart)))


def subdomains(scene: Scene, parts: int) -> list[Subdomain]:
    """Divide a scene into parts that consist of whole rows and have about the same number of
    particles.

    Raises ExperimentError if rows are too few.
    """
    (each, edge), experiment = reaches(scene), scene.experiment
    counts = scene.raster.row_counts
    bounds = bounds_of(counts, parts)
    steps = _steps(each, int(np.diff(bounds).min()))
    # After the last step between two exchanges, the own rows and all particles that their frame
    # points follow must be valid.
    looked_at = edge + MIN_MEASURED_ROWS * any(d.local for d in experiment.diagnostics)
    # The other ends of the bonds of own frame points must be moving particles.
    halo = max(steps * each, looked_at, 2 * edge * experiment.shows_bonds) + edge
    if scene.has_fracture and not experiment.fracture.breaks_frame_bonds():
        # Particles that do not move are treated as frame points, and bonds to frame points do not
        # break. Therefore no own particle may have a bond to such a particle.
        halo += edge
    return [
        Subdomain(b, e, max(0, b - halo), min(len(counts), e + halo), edge, steps)
        for b, e in pairwise(bounds)
    ]


def widest_halo(each: int, edge: int, least: int, parts: int) -> int:
    """Return an upper bound of the number of rows of the halos of `subdomains`. A step reaches at
    most `each` rows, neighbours reach at most `edge` rows, and a part has at least `least` rows."""
    return _steps(each, least) * each + 3 * edge + MIN_MEASURED_ROWS + int(MAX_OVERLAP * least)


def bounds_of(counts: NDArray[Any], parts: int) -> list[int]:
    """Return the rows at which parts begin, and the end of the last part. `counts` are the numbers
    of particles of each row.

    Raises ExperimentError if rows are too few.
    """
    share = np.cumsum(counts) / max(1, counts.sum())
    cuts = np.searchsorted(share, np.arange(1, parts) / parts) + 1
    bounds = [0, *cuts.tolist(), len(counts)]
    if np.diff(bounds).min() < 1:
        raise ExperimentError(
            f"has {np.count_nonzero(counts)} rows of cells, too few for {parts} processes; start "
            "fewer",
            ("body",),
        )
    return bounds


def _steps(each: int, least: int) -> int:
    """Return the number of steps between two exchanges. `each` is the number of rows that a step
    reaches, and `least` the minimum number of rows of a part."""
    return (
        min(MAX_STEPS_PER_EXCHANGE, 1 + int(MAX_OVERLAP * least / each))
        if each
        else MAX_STEPS_PER_EXCHANGE
    )


@dataclass(frozen=True)
class SubdomainScene:
    """Scene of a subdomain and its place in the whole lattice.

    `own_leaders` are the particles of each leader group in the own rows of the subdomain. `early`
    are the numbers of particles of each group in earlier rows. `rows` are the rows of the table
    with the subdomain's own particles.
    """

    subdomain: Subdomain
    scene: Scene
    own_leaders: tuple[Mask, ...]
    early: tuple[int, ...]
    rows: slice


def part_of(scene: Scene, subdomain: Subdomain) -> SubdomainScene:
    """Return the part of a scene with the rows of a subdomain. The raster of the scene must contain
    at least these rows."""
    to, rows = restriction(scene.raster, subdomain)
    places = [each.place[each.is_in(to)] for each in scene.leading]
    begin = to.low + subdomain.own.start
    own_leaders = [to.is_between(place, (begin, to.low + subdomain.own.stop)) for place in places]
    early = [int(to.is_between(place, (0, begin)).sum()) for place in places]
    return SubdomainScene(subdomain, scene.restrict(to), tuple(own_leaders), tuple(early), rows)


def restriction(raster: Raster, subdomain: Subdomain) -> tuple[Restriction, slice]:
    """Return the restriction of a raster to the rows of a subdomain. Also return which rows in the
    table of the part are the subdomain's own particles."""
    offset = raster.extent.row_offset if raster.extent else 0
    subdomain = subdomain.after(offset)
    period = raster.cell.period[0]
    lines = raster.sites.shape[0]

    def line(row: int) -> int:
        """Return the index, in the sites of the raster, of the first line of sites of a row of
        cells."""
        return int(np.clip((raster.first[0] + row) * period - raster.low[0], 0, lines))

    low, high = line(subdomain.low), line(subdomain.high)
    sites, kind = raster.sites[low:high].copy(), subdomain.cut(raster.kind, len(raster.shape) - 1)
    present, moving = (of(raster.shape[1]) for of in (subdomain.seen, subdomain.inner))
    for rows, old, new in ((moving, FOLLOWER, FRAME), (present, FRAME, EMPTY)):
        planes = np.moveaxis(kind, 1, 0)
        for array, (a, b), at in (
            (sites, map(line, rows), low),
            (planes, rows, subdomain.low),
        ):
            for outside in (array[: a - at], array[b - at :]):
                outside[outside == old] = new
    counts = np.cumsum([0, *np.count_nonzero(raster.sites != EMPTY, axis=_others(sites))])
    part = replace(
        raster,
        shape=kind.shape,
        first=(raster.first[0] + subdomain.low, *raster.first[1:]),
        kind=kind,
        low=(raster.low[0] + low, *raster.low[1:]),
        sites=sites,
        particle_offset=raster.particle_offset + int(counts[line(present[0])]),
        extent=RowLayout(raster.row_counts, offset + subdomain.low),
        communicator=SERIAL,
        row_range=None,
    )
    ends = (subdomain.begin, subdomain.end)
    begin, end = (int(counts[line(row)] - counts[line(present[0])]) for row in ends)
    return Restriction(raster, part, subdomain.low, present, moving), slice(begin, end)


def _others(sites: Array) -> Sequence[int]:
    return tuple(range(1, sites.ndim))


class Halo:
    """Halo of a part: copies of rows that other parts own."""

    def __init__(
        self, ranks: MPICommunicator, parts: Sequence[Subdomain], part: SubdomainScene
    ) -> None:
        self._ranks, self._part, self._axes = ranks, part, part.scene.axes
        self._parts = parts
        sizes = ranks.allgather([int(own_leaders.sum()) for own_leaders in part.own_leaders])
        self._counts = list(zip(*sizes, strict=True))
        offsets = [sum(counts[: ranks.rank]) for counts in self._counts]
        self.members = tuple(
            np.arange(len(own_leaders)) + first - early
            for own_leaders, early, first in zip(part.own_leaders, part.early, offsets, strict=True)
        )
        """Indices, within each leader group, of the particles that the part has."""
        own, rank, rows = part.subdomain, ranks.rank, parts[-1].end
        ranks_around = [n for n in range(len(parts)) if n != rank]
        sides = [n for n in ranks_around if _touch(own, parts[n]) or _touch(parts[n], own)]
        self.received = {n: self._rows(_shared(own, parts[n])) for n in sides}
        """Rows that are received from each rank."""
        self._sent = {n: self._rows(_shared(parts[n], own)) for n in sides}
        places = [each.place for each in part.scene.leading]
        self._at = [np.unravel_index(place, part.scene.raster.shape)[1] for place in places]
        moving = {n: self._rows(parts[n].inner(rows)) for n in (*sides, rank)}
        self._outgoing = {n: self._members(self._sent[n], moving[n]) for n in sides}
        self._mine = {n: self._members(self.received[n], moving[rank]) for n in sides}
        solver = part.scene.experiment.stepping
        self._needs_previous = solver.memory != 0.0 or "memory" in solver.time_dependent
        self._pushed = [n for n, each in enumerate(part.scene.leading) if each.share is not None]

    def _rows(self, rows: tuple[int, int]) -> slice:
        """Convert a range of rows of the whole lattice to a slice of rows of the part."""
        low, count = self._part.subdomain.low, self._part.scene.raster.shape[1]
        first, last = (min(max(row - low, 0), count) for row in rows)
        return slice(first, max(first, last))

    def _members(self, *within: slice) -> list[Array]:
        """Return, for each leader group, those members that lie in the given ranges of rows."""
        ins = [[(at >= rows.start) & (at < rows.stop) for rows in within] for at in self._at]
        return [np.flatnonzero(np.logical_and.reduce(masks)) for masks in ins]

    def renew(self, state: State) -> None:
        """Update the halo of a state in place, including the velocities of masses in the halo.
        Displacements of the previous step are omitted if no step reads them."""
        arrays = [
            array for array in state.arrays() if self._needs_previous or array is not state.previous
        ]
        starts = [(n, start) for n in self._pushed if (start := state.starts[n]) is not None]
        outgoing = {r: [s[:, self._outgoing[r][n]] for n, s in starts] for r in self._sent}
        incoming = {
            r: [np.empty((len(s), len(members[n])), s.dtype) for n, s in starts]
            for r, members in self._mine.items()
        }
        self._exchange(arrays, outgoing, incoming)
        for rank, arrays_of in incoming.items():
            for (n, start), values in zip(starts, arrays_of, strict=True):
                start[:, self._mine[rank][n]] = values

    def meet(self, field: Array) -> None:
        """Update the halo of an array with cells along the last axes, in place."""
        self._exchange([field], {}, {})

    def renew_previous(self, state: State) -> None:
        """Update the halo of the displacements of the previous step, in place."""
        if not self._needs_previous:
            self.meet(state.previous)

    def _exchange(
        self,
        arrays: list[Array],
        outgoing: dict[int, list[Array]],
        incoming: dict[int, list[Array]],
    ) -> None:
        """Exchange rows of `arrays`, and the further arrays `outgoing` and `incoming`, with each
        rank."""
        sent, received = (
            {r: [*self._blocks(arrays, rows), *map(as_bytes, extra.get(r, []))] for r, rows in each}
            for each, extra in ((self._sent.items(), outgoing), (self.received.items(), incoming))
        )
        self._ranks.exchange(sent, received)

    def _blocks(self, arrays: list[Array], rows: slice) -> Iterator[Bytes]:
        """Generate the blocks of contiguous memory that contain some rows, plane by plane."""
        for array in arrays:
            for plane in np.ndindex(array.shape[: array.ndim - self._axes]):
                yield as_bytes(array[plane][rows])

    def joined(self, state: State) -> State:
        """Return the state of the whole lattice. In the first process the arrays are joined when
        they are accessed. In every other process the arrays are its parts of them, as `Share`."""
        rows_of_part, rows = (
            self._part.subdomain.own,
            [part.end - part.begin for part in self._parts],
        )

        def whole(array: Array) -> Any:
            axis = array.ndim - self._axes
            return joined(self._ranks, row_view(array, self._axes, rows_of_part), axis, rows)

        starts = tuple(
            None if start is None else joined(self._ranks, start[:, own_leaders], 1, counts)
            for start, own_leaders, counts in zip(
                state.starts, self._part.own_leaders, self._counts, strict=True
            )
        )
        return state.map(whole, starts)

    def gathered(self, state: State) -> State | None:
        """Return the state of the whole lattice in the first process, and None in the other
        processes."""
        shares = self.joined(state)
        if self._ranks.is_root:
            starts = (None if start is None else np.asarray(start) for start in shares.starts)
            # Arrays are received in the order in which the other processes send them.
            whole = shares.map(np.asarray, ())
            return replace(whole, starts=tuple(starts))
        every: list[Any] = [*shares.arrays(), *(s for s in shares.starts if s is not None)]
        for share in every:
            share.send(self._ranks)
        return None


def _shared(part: Subdomain, other: Subdomain) -> tuple[int, int]:
    """Return those rows in the halo of a part that another part owns."""
    return max(part.low, other.begin), min(part.high, other.end)


def _touch(part: Subdomain, other: Subdomain) -> bool:
    low, high = _shared(part, other)
    return low < high


def part_of_state(
    whole: State, axes: int, subdomain: Subdomain, members: Sequence[Indices]
) -> State:
    """Return a copy of that part of a whole state that lies in a subdomain. `members` are the
    members of the leader groups that it contains."""
    starts = zip(whole.starts, members, strict=True)
    starts_of_part = tuple(
        None if start is None else np.asarray(start)[:, rows] for start, rows in starts
    )
    return whole.map(lambda array: subdomain.cut(array, axes), starts_of_part)


SITES_AT_ONCE = 2**22
"""Number of sites that are counted together. It is limited so that the memory does not grow with
the body."""


@dataclass(frozen=True)
class RowCount:
    """Number of particles in the rows of a lattice.

    `low` and `high` are the smallest and the largest site index of the body. `lines` are the
    numbers of particles on each line of sites, including the frame, beginning with the first line
    that is not empty. `period` is the number of site indices in a repeat cell along the first axis,
    and `reach` the number of repeat cells that neighbours reach along it. `left_out` describes the
    cells that are omitted at narrow voids.
    """

    low: Index
    high: Index
    lines: NDArray[np.int64]
    period: int
    reach: int
    layers: int
    left_out: OmittedCells

    @property
    def first(self) -> int:
        """Index, along the first axis, of the repeat cells in the first row of the lattice. This
        row is padding and has no particles."""
        return self._start // self.period - self.reach

    @cached_property
    def rows(self) -> NDArray[np.int64]:
        """Number of particles of each row of repeat cells, including the rows of padding,
        (row,)."""
        row = (self._start + np.arange(len(self.lines))) // self.period - self.first
        rows = np.bincount(row, self.lines, row[-1] + 1 + self.reach)
        return rows.astype(np.int64)

    def stretch(self, begin: int, end: int) -> Stretch:
        """Return the range of the lines of sites in the rows from `begin` to `end`; row `end` is
        excluded."""
        first, last = self._line(begin), self._line(end)
        near, far = first - self.layers, last + self.layers
        return Stretch(
            (first, last),
            (max(self.low[0], near), *self.low[1:]),
            (min(self.high[0], far), *self.high[1:]),
            int(self.lines[: first - self._start].sum()),
            self.rows,
            self.first,
            self.left_out,
        )

    @property
    def _start(self) -> int:
        """Index i of the first line."""
        return self.low[0] - self.layers

    def _line(self, row: int) -> int:
        """Return the index i of the first line of sites of a row, limited to the lines that are
        counted."""
        line = (self.first + row) * self.period
        return min(max(line, self._start), self._start + len(self.lines))


def count_rows(ground: LatticeSetup, communicator: Communicator) -> RowCount | None:
    """Count the particles of a body and its frame in each row; return None if there is no body.
    Each process counts the particles of the same number of lines."""
    rank = communicator.rank
    lattice, layers = ground.experiment.lattice, ground.layers
    (first, *_), (last, *_) = low, high = window(ground.experiment.body, lattice)
    spill = layers + ground.spill
    cuts = np.linspace(first - spill, last + 1 + spill, communicator.size + 1).astype(int).tolist()
    across = math.prod(b - a + 1 for a, b in zip(low[1:], high[1:], strict=True))
    local = [_counted(ground, band) for band in _bands(cuts[rank : rank + 2], across)]
    every = [count for each in communicator.allgather(local) for count in each]
    boxes = [box for box, _, _ in every if box]
    if not boxes:
        return None
    lines = np.concatenate([counts for _, counts, _ in every])
    left_out = sum((cells for *_, cells in every), OmittedCells())
    low, high = hull(boxes)
    begin = low[0] - layers - cuts[0]
    lines = lines[begin : high[0] + layers - cuts[0]]
    period = ground.cell.period[0]
    reach = ground.neighbourhood.reach_in_cells[0]
    return RowCount(low, high, lines, period, reach, layers, left_out)


def _bands(lines: list[int], across: int) -> Iterator[Lines]:
    first, last = lines
    width = max(1, SITES_AT_ONCE // across)
    for begin in range(first, last, width):
        yield begin, min(begin + width, last)


def _counted(
    ground: LatticeSetup, lines: Lines
) -> tuple[tuple[Index, Index] | None, NDArray[np.int64], OmittedCells]:
    """Return (box of the body, particles on each line, omitted cells) of some lines."""
    first, last = lines
    counts, layers = np.zeros(last - first, np.int64), ground.layers
    filling = ground.filled((first - layers, last + layers))
    left_out = filling.left_out_on(lines)
    if not (box := filling.box):
        return None, counts, left_out
    low, kinds = framed(ground.experiment.lattice, filling.within(*box), layers)
    numbers = np.count_nonzero(kinds != EMPTY, axis=tuple(range(1, kinds.ndim)))
    line = np.arange(low[0], low[0] + len(numbers))
    is_own = (line >= first) & (line < last)
    counts[line[is_own] - first] = numbers[is_own]
    inside = [max(first, box[0][0]), min(last, box[1][0])]
    if inside[0] >= inside[1]:
        return None, counts, left_out
    return ((inside[0], *box[0][1:]), (inside[1], *box[1][1:])), counts, left_out
