"""The rows of a grid that a process has, and those of the next grid that follow from them."""

from __future__ import annotations

from dataclasses import dataclass, replace


def coarser_size(size: int) -> int:
    """How many places a grid has along an axis where one of that size is halved."""
    return (size - 2) // 2 + 3


def outside(rows: slice, count: int) -> tuple[slice, slice]:
    """Those of so many rows that some are not."""
    first, last, _ = rows.indices(count)
    return slice(0, first), slice(last, count)


@dataclass(frozen=True)
class Strip:
    """Rows of a grid of so many, `count`, by their numbers there: an array has those from `low` on,
    a process `begin` to `end` as its own, and knows the stencils of `first` to `last`. Where rows
    are halved `low` is even, so that row n of the next grid lies at 2n - 1 in the arrays too:
    `low` and what follows from it serve for so many coarser grids, `depth`."""

    count: int
    low: int
    begin: int
    end: int
    first: int
    last: int
    depth: int

    @property
    def own(self) -> slice:
        """Its own rows, in arrays."""
        return slice(self.begin - self.low, self.end - self.low)

    @property
    def known(self) -> slice:
        """Those with known stencils, in arrays."""
        return slice(self.first - self.low, max(self.first, self.last) - self.low)

    def coarser(self, half: int) -> Strip:
        """That of the next grid: a stencil there depends on two rows on either side of its place;
        where rows are not halved, on one."""
        if not half:
            first = self.first + 1 if self.first else 0
            last = self.last - 1 if self.last < self.count else self.last
            return replace(self, first=first, last=last, depth=self.depth - 1)
        count = coarser_size(self.count)
        return Strip(
            count,
            self.low // 2,
            (self.begin + 1) // 2,
            (self.end + 1) // 2 if self.end < self.count else count,
            (self.first + 4) // 2 if self.first else 0,
            self.last // 2 if self.last < self.count else count,
            self.depth - 1,
        )
