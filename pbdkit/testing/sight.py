"""Frames and moments shown to a component in another way: its tables as given, its rows in another
order, some of its points only."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import (
    Bonds,
    Cell,
    FollowerRule,
    FrameSites,
    LeaderRows,
    Moment,
    Pair,
    Stiffness,
    Vector,
)
from pbdkit.interfaces.frame import Indices
from pbdkit.interfaces.lattice import Index


@dataclass(frozen=True)
class SeenFrame(FrameSites):
    """A frame of which `point` and `body` are what `nearest` answers."""

    inner: FrameSites
    cell: Cell
    site: NDArray[np.int32]
    low: Index
    high: Index
    rule: FollowerRule
    point: Indices
    body: Indices

    @classmethod
    def showing(
        cls, frame: FrameSites, site: NDArray[np.int32], point: Indices, body: Indices
    ) -> SeenFrame:
        """A frame with these tables in the place of its own."""
        return cls(frame, frame.cell, site, frame.low, frame.high, frame.rule, point, body)

    def only(self, points: Indices) -> SeenFrame:
        """The frame of some of its points, sorted, counted anew."""
        kept = np.isin(self.point, points)
        anew = np.searchsorted(points, self.point[kept])
        return replace(self, site=self.site[points], point=anew, body=self.body[kept])

    def nearest(self) -> tuple[Indices, Indices]:
        """The pairs given."""
        return self.point, self.body

    def body_at(self, site: NDArray[np.int32]) -> Indices:
        """That of the frame itself."""
        return self.inner.body_at(site)


class SeenMoment(Moment):
    """A moment with other tables in the place of its own, or its particles in another order: row n
    shows what stands in row order[n]."""

    def __init__(
        self,
        moment: Moment,
        *,
        order: Indices | None = None,
        tables: Mapping[str, NDArray[Any]] | None = None,
    ) -> None:
        self.step = moment.step
        self._moment = moment
        count = len(moment.reference())
        self._order = np.arange(count) if order is None else order
        self._tables = tables or {
            "displacement": moment.displacement()[self._order],
            "previous_displacement": moment.previous_displacement()[self._order],
            "reference": moment.reference()[self._order],
        }

    def rows(self, numbers: tuple[int, ...]) -> Indices:
        """Where the particles with these numbers now stand."""
        return np.argsort(self._order)[self._moment.rows(numbers)]

    def displacement(self, rows: Indices | None = None) -> NDArray[Any]:
        """From the tables."""
        return self._of("displacement", rows)

    def previous_displacement(self) -> NDArray[Any]:
        """From the tables."""
        return self._of("previous_displacement", None)

    def reference(self, rows: Indices | None = None) -> NDArray[Any]:
        """From the tables."""
        return self._of("reference", rows)

    def sum_over_neighbours(
        self, function: Callable[[Vector, Vector], Any], *, intact_only: bool = False
    ) -> NDArray[Any]:
        """That of the moment itself, in this order."""
        return self._moment.sum_over_neighbours(function, intact_only=intact_only)[self._order]

    def over_cells(
        self,
        function: Callable[[tuple[Vector, ...], tuple[Vector, ...]], Any],
        *,
        intact_only: bool = False,
    ) -> NDArray[Any]:
        """That of the moment itself: cells are in no order of particles."""
        return self._moment.over_cells(function, intact_only=intact_only)

    def broken_bonds(self) -> int:
        """That of the moment itself."""
        return self._moment.broken_bonds()

    def displacement_gradient(self) -> NDArray[Any]:
        """That of the moment itself, in this order."""
        return self._moment.displacement_gradient()[self._order]

    def stiffness(self) -> Stiffness:
        """That of the moment itself."""
        return self._moment.stiffness()

    def forces(self) -> NDArray[Any]:
        """Those of the moment itself, in this order."""
        return self._moment.forces()[self._order]

    def energy(self) -> float:
        """That of the moment itself."""
        return self._moment.energy()

    def leader_groups(self) -> tuple[LeaderRows, ...]:
        """Where their particles now stand."""
        place = np.argsort(self._order)
        return tuple(LeaderRows(place[g.rows], g.leads) for g in self._moment.leader_groups())

    def nearest(self, points: tuple[Pair, ...]) -> Indices:
        """Where the nearest particles now stand."""
        return np.argsort(self._order)[self._moment.nearest(points)]

    def bonds(self) -> Bonds:
        """That of the moment itself: bonds name their ends by number, and are in no order of
        particles."""
        return self._moment.bonds()

    def broken_step(self) -> NDArray[np.int32]:
        """That of the moment itself."""
        return self._moment.broken_step()

    def broken_strain(self) -> NDArray[np.float64]:
        """That of the moment itself."""
        return self._moment.broken_strain()

    def remembered(self, name: str) -> NDArray[Any]:
        """That of the moment itself, in this order where it is of particles."""
        values = self._moment.remembered(name)
        return values[self._order] if len(values) == len(self._order) else values

    def _of(self, name: str, rows: Indices | None) -> NDArray[Any]:
        table = self._tables[name]
        return table if rows is None else table[rows]
