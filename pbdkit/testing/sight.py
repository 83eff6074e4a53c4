"""Frames and moments shown to a component in another way: its tables as given, its rows in another
order, some of its points only."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import (
    Cell,
    FollowerRule,
    FrameSites,
    LeaderRows,
    Moment,
    Pair,
    Stiffness,
)
from pbdkit.interfaces.diagnostic import BondHistory, CellValues, ForceValues
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
    shows what stands in row order[n]. What is in no order of particles is that of the moment."""

    def __init__(
        self,
        moment: Moment,
        *,
        order: Indices | None = None,
        tables: Mapping[str, NDArray[Any]] | None = None,
    ) -> None:
        self.step = moment.step
        self._moment = moment
        self._order = np.arange(len(moment.body)) if order is None else order
        self._place = np.argsort(self._order)
        self._tables = tables or {
            "displacement": moment.displacement()[self._order],
            "previous_displacement": moment.previous_displacement()[self._order],
            "reference": moment.reference()[self._order],
        }

    @property
    def body(self) -> NDArray[np.bool_]:
        """In this order."""
        return self._moment.body[self._order]

    @property
    def cells(self) -> CellValues:
        """In this order."""
        return SeenCells(self._moment.cells, self._order)

    @property
    def forces(self) -> ForceValues:
        """In this order."""
        return SeenForces(self._moment.forces, self._order)

    def rows(self, numbers: tuple[int, ...]) -> Indices:
        """Where the particles with these numbers now stand."""
        return self._place[self._moment.rows(numbers)]

    def nearest(self, points: tuple[Pair, ...]) -> Indices:
        """Where the nearest particles now stand."""
        return self._place[self._moment.nearest(points)]

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
        self, function: Callable[[Any, Any], Any], *, intact_only: bool = False
    ) -> NDArray[Any]:
        """In this order."""
        return self._moment.sum_over_neighbours(function, intact_only=intact_only)[self._order]

    def leader_groups(self) -> tuple[LeaderRows, ...]:
        """Where their particles now stand."""
        groups = self._moment.leader_groups()
        return tuple(LeaderRows(self._place[g.rows], g.leads) for g in groups)

    def broken_bonds(self) -> int:
        """The same."""
        return self._moment.broken_bonds()

    def bonds(self) -> BondHistory:
        """The same: bonds name their ends by number."""
        return self._moment.bonds()

    def remembered(self, name: str) -> NDArray[Any]:
        """In this order where it is of particles."""
        values = self._moment.remembered(name)
        return values[self._order] if len(values) == len(self._order) else values

    def _of(self, name: str, rows: Indices | None) -> NDArray[Any]:
        table = self._tables[name]
        return table if rows is None else table[rows]


@dataclass(frozen=True)
class SeenCells(CellValues):
    """The cells of a moment whose particles are shown in another order."""

    inner: CellValues
    order: Indices

    def over(
        self,
        function: Callable[[tuple[Any, ...], tuple[Any, ...]], Any],
        *,
        intact_only: bool = False,
    ) -> NDArray[Any]:
        """The same: cells are in no order of particles."""
        return self.inner.over(function, intact_only=intact_only)

    def gradient(self) -> NDArray[Any]:
        """In this order."""
        return self.inner.gradient()[self.order]


@dataclass(frozen=True)
class SeenForces(ForceValues):
    """The forces of a moment whose particles are shown in another order."""

    inner: ForceValues
    order: Indices

    @property
    def stiffness(self) -> Stiffness:
        """The same."""
        return self.inner.stiffness

    def on_particles(self) -> NDArray[Any]:
        """In this order."""
        return self.inner.on_particles()[self.order]

    def energy(self) -> float:
        """The same."""
        return self.inner.energy()
