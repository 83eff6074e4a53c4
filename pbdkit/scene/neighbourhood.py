"""The neighbours of every sublattice as constant slots, in exactly opposite pairs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pbdkit.errors import ExperimentError
from pbdkit.interfaces import Cell, NeighbourMetric, Offset, Slot, Vector


@dataclass(frozen=True)
class BondPlane:
    """The bonds along one slot and its opposite: they live on the slot's source sublattice."""

    slot: Slot
    opposite: Slot


@dataclass(frozen=True)
class Neighbourhood:
    """`slots[s]` are the neighbours of sublattice s, the nearest shells first and inversion
    partners side by side; `planes` holds each pair of opposite slots once."""

    slots: tuple[tuple[Slot, ...], ...]
    planes: tuple[BondPlane, ...]

    @property
    def reach(self) -> int:
        """The largest difference of site index, max(|Δi|, |Δj|)."""
        return max(max(abs(n) for n in slot.site) for slots in self.slots for slot in slots)

    @property
    def reach_in_cells(self) -> tuple[int, int]:
        """The largest difference of repeat cell along each axis."""
        steps = [slot.cell for slots in self.slots for slot in slots]
        return max(abs(m) for m, _ in steps), max(abs(n) for _, n in steps)

    def shells(self) -> list[list[float]]:
        """The rest lengths of each shell, the first shell first."""
        found: dict[int, list[float]] = {}
        for slots in self.slots:
            for slot in slots:
                found.setdefault(slot.shell, []).append(math.hypot(*slot.rest))
        return [found[shell] for shell in sorted(found)]

    def spans_plane(self) -> bool:
        """Whether steps between neighbours reach in two directions; else rows do not feel each
        other."""
        first = self.slots[0][0].rest
        return any(
            abs(first.x * r.y - first.y * r.x) > 1e-9 * math.hypot(*first) * math.hypot(*r)
            for slots in self.slots
            for r in (slot.rest for slot in slots)
        )


def build_neighbourhood(cell: Cell, metric: NeighbourMetric) -> Neighbourhood:
    """The slots that the metric chooses; ExperimentError unless neighbourhood is mutual."""
    exact = _ExactVectors()
    chosen = [metric.shells_around(cell, s) for s in range(len(cell.sites))]
    slots = tuple(_slots_of(s, shells, exact) for s, shells in enumerate(chosen))
    by_key = {(s.source, s.target, s.cell): s for own in slots for s in own}
    planes = []
    for slot in by_key.values():
        opposite = by_key.get((slot.target, slot.source, (-slot.cell[0], -slot.cell[1])))
        if opposite is None or opposite.shell != slot.shell:
            raise ExperimentError(
                f"'{metric.type}' is not mutual: the neighbour at site index offset {slot.site} "
                "does not have this one in the same shell; a body at rest would drift",
                ("neighbours",),
            )
        if slot.site > (0, 0):
            planes.append(BondPlane(slot, opposite))
    return Neighbourhood(slots, tuple(planes))


def _slots_of(
    source: int, shells: Sequence[Sequence[Offset]], exact: _ExactVectors
) -> tuple[Slot, ...]:
    slots = [
        (
            shell,
            *exact.of(o.rest),
            Slot(source, o.target, o.cell, o.site, exact.value(o.rest), shell),
        )
        for shell, offsets in enumerate(shells, 1)
        for o in offsets
    ]
    if not slots:
        raise ExperimentError("no site has any neighbour", ("neighbours",))
    return tuple(slot for *_, slot in sorted(slots, key=lambda s: s[:3]))


class _ExactVectors:
    """Gives vectors that are equal or opposite up to rounding one value and its exact negative.

    Sums over a body at rest then cancel exactly, whatever the order of magnitude.
    """

    def __init__(self) -> None:
        self._known: list[Vector] = []

    def of(self, v: Vector) -> tuple[int, int]:
        """(which known vector, sign: 0 for itself and 1 for its negative)."""
        for n, known in enumerate(self._known):
            tolerance = 1e-9 * (abs(known.x) + abs(known.y))
            if abs(v.x - known.x) + abs(v.y - known.y) <= tolerance:
                return n, 0
            if abs(v.x + known.x) + abs(v.y + known.y) <= tolerance:
                return n, 1
        self._known.append(Vector(v.x + 0.0, v.y + 0.0))
        return len(self._known) - 1, 0

    def value(self, v: Vector) -> Vector:
        """The value to use for v."""
        n, negative = self.of(v)
        known = self._known[n]
        return Vector(-known.x, -known.y) if negative else known
