"""The NeighbourMetric interface: who is whose neighbour, in shells."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

from pbdkit.interfaces.component import Component
from pbdkit.interfaces.lattice import Cell, Index, Offset
from pbdkit.interfaces.vector import Components


@dataclass(frozen=True)
class Slot:
    """One neighbour that every particle of a sublattice has, at a constant offset.

    `source` and `target` are sublattices, `cell` the step between repeat cells, `site` between
    site indices, `rest` the rest offset R = X_k - X_j (lattice units), `shell` counts from 1.
    """

    source: int
    target: int
    cell: Index
    site: Index
    rest: Components
    shell: int


@dataclass(frozen=True)
class Nearness:
    """Who is near in the current configuration: √(w_x Δx² + w_y Δy²) ≤ radius (1 + 1e-9)."""

    radius: float
    weights: tuple[float, ...]


class NeighbourMetric(Component):
    """Chooses the neighbours of a site on the infinite lattice, by shells.

    To add a metric, write `shells_around`. Neighbourhood is mutual: with the offset from j to k
    the offset from k to j must be chosen too, in the same shell, or the metric is refused.
    """

    @abstractmethod
    def shells_around(self, cell: Cell, sublattice: int) -> Sequence[Sequence[Offset]]:
        """The neighbours of a site of `sublattice`, the first shell first.

        Offsets come from `cell.offsets(sublattice, radius)`, which lists all within a radius.
        """

    def nearness(self) -> Nearness | None:
        """How neighbours are found anew at every step; by default they stay as they are at
        step 0, as in a solid."""
        return None
