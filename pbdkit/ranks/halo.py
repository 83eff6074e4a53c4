"""States in parts: the halo renewed from neighbours, parts joined, and a whole cut up."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces.frame import Indices
from pbdkit.ranks.communicator import Ranks
from pbdkit.ranks.joining import joined
from pbdkit.ranks.part import Part
from pbdkit.ranks.subdomain import Subdomain, rows_of
from pbdkit.stepping.state import State
from pbdkit.storage.pieced_array import Bytes, as_bytes

Array = NDArray[Any]


class Halo:
    """The halo of a part: what other parts have of their own rows."""

    def __init__(self, ranks: Ranks, parts: Sequence[Subdomain], part: Part) -> None:
        self._ranks, self._part, self._axes = ranks, part, part.scene.axes
        self._parts = parts
        sizes = ranks.every([int(ours.sum()) for ours in part.ours])
        self._counts = list(zip(*sizes, strict=True))
        before = [sum(counts[: ranks.rank]) for counts in self._counts]
        self.members = tuple(
            np.arange(len(ours)) + first - early
            for ours, early, first in zip(part.ours, part.early, before, strict=True)
        )
        """The particles of each leader group that the part has, by their number in the group."""
        own, rank, rows = part.subdomain, ranks.rank, parts[-1].end
        others = [n for n in range(len(parts)) if n != rank]
        sides = [n for n in others if _touch(own, parts[n]) or _touch(parts[n], own)]
        self.received = {n: self._rows(_shared(own, parts[n])) for n in sides}
        """By rank the rows that come from there."""
        self._sent = {n: self._rows(_shared(parts[n], own)) for n in sides}
        places = [each.place for each in part.scene.leading]
        self._at = [np.unravel_index(place, part.scene.raster.shape)[1] for place in places]
        moving = {n: self._rows(parts[n].inner(rows)) for n in (*sides, rank)}
        self._theirs = {n: self._members(self._sent[n], moving[n]) for n in sides}
        self._mine = {n: self._members(self.received[n], moving[rank]) for n in sides}
        solver = part.scene.experiment.stepping
        self._looks_back = solver.memory != 0.0 or "memory" in solver.courses
        self._pushed = [n for n, each in enumerate(part.scene.leading) if each.share is not None]

    def _rows(self, rows: tuple[int, int]) -> slice:
        """Rows of the whole as they are counted in the part."""
        low, count = self._part.subdomain.low, self._part.scene.raster.shape[1]
        first, last = (min(max(row - low, 0), count) for row in rows)
        return slice(first, max(first, last))

    def _members(self, *within: slice) -> list[Array]:
        """Of each leader group those in some rows."""
        ins = [[(at >= rows.start) & (at < rows.stop) for rows in within] for at in self._at]
        return [np.flatnonzero(np.logical_and.reduce(one)) for one in ins]

    def renew(self, state: State) -> None:
        """Writes the halo of a state, in place; and the velocities of masses that lie there. The
        displacements of the step before are left out where no step reads them."""
        arrays = [
            array for array in state.arrays() if self._looks_back or array is not state.previous
        ]
        starts = [(n, start) for n in self._pushed if (start := state.starts[n]) is not None]
        theirs = {r: [s[:, self._theirs[r][n]] for n, s in starts] for r in self._sent}
        mine = {
            r: [np.empty((len(s), len(those[n])), s.dtype) for n, s in starts]
            for r, those in self._mine.items()
        }
        self._exchange(arrays, theirs, mine)
        for rank, found in mine.items():
            for (n, start), values in zip(starts, found, strict=True):
                start[:, self._mine[rank][n]] = values

    def meet(self, field: Array) -> None:
        """Writes the halo of an array whose last axes are those of cells, in place."""
        self._exchange([field], {}, {})

    def look_back(self, state: State) -> None:
        """Writes the halo of the displacements of the step before, in place."""
        if not self._looks_back:
            self.meet(state.previous)

    def _exchange(
        self, arrays: list[Array], theirs: dict[int, list[Array]], mine: dict[int, list[Array]]
    ) -> None:
        """Sends own rows of arrays, and others from there into these; and further ones."""
        sent, received = (
            {r: [*self._blocks(arrays, rows), *map(as_bytes, more.get(r, []))] for r, rows in each}
            for each, more in ((self._sent.items(), theirs), (self.received.items(), mine))
        )
        self._ranks.exchange(sent, received)

    def _blocks(self, arrays: list[Array], rows: slice) -> Iterator[Bytes]:
        """Some rows as they lie in memory, plane by plane."""
        for array in arrays:
            for plane in np.ndindex(array.shape[: array.ndim - self._axes]):
                yield as_bytes(array[plane][rows])

    def joined(self, state: State) -> State:
        """The state of the whole, of arrays that are joined when somebody asks for them; in other
        processes than the first, of their shares."""
        own, rows = self._part.subdomain.own, [part.end - part.begin for part in self._parts]

        def whole(array: Array) -> Any:
            axis = array.ndim - self._axes
            return joined(self._ranks, rows_of(array, self._axes, own), axis, rows)

        starts = tuple(
            None if start is None else joined(self._ranks, start[:, ours], 1, counts)
            for start, ours, counts in zip(state.starts, self._part.ours, self._counts, strict=True)
        )
        return _each(state, whole, starts)

    def gathered(self, state: State) -> State | None:
        """The state of the whole, in the first process; None in the others."""
        shares = self.joined(state)
        if self._ranks.first:
            starts = (None if start is None else np.asarray(start) for start in shares.starts)
            # In the order in which the others send.
            found = _each(shares, np.asarray, ())
            return replace(found, starts=tuple(starts))
        every: list[Any] = [*shares.arrays(), *(s for s in shares.starts if s is not None)]
        for share in every:
            share.send(self._ranks)
        return None


def _shared(part: Subdomain, other: Subdomain) -> tuple[int, int]:
    """The rows of a part's halo that are another's own."""
    return max(part.low, other.begin), min(part.high, other.end)


def _touch(part: Subdomain, other: Subdomain) -> bool:
    low, high = _shared(part, other)
    return low < high


def _each(state: State, function: Callable[[Array], Any], starts: tuple[Any, ...]) -> State:
    """A state with what a function makes of each array."""

    def of(array: Array | None) -> Any:
        return None if array is None else function(array)

    return replace(
        state,
        u=function(state.u),
        previous=function(state.previous),
        broken_step=of(state.broken_step),
        broken_length=of(state.broken_length),
        starts=starts,
        bond_values=tuple(map(function, state.bond_values)),
        particle_values=tuple(map(function, state.particle_values)),
    )


def part_of_state(
    whole: State, axes: int, subdomain: Subdomain, members: Sequence[Indices]
) -> State:
    """A part of a whole state, in memory of its own, with some members of the leader groups."""
    starts = zip(whole.starts, members, strict=True)
    found = tuple(None if start is None else np.asarray(start)[:, some] for start, some in starts)
    return _each(whole, lambda array: subdomain.cut(array, axes), found)
