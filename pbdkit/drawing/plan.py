"""How many panels stand beside one another, and how large they are: numbers alone."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Panels:
    """What the panels show: `box` (left, right, bottom, top) of each, the longest title of each,
    the heading of all, and what both axes are."""

    box: tuple[float, float, float, float]
    titles: list[str]
    heading: str
    labels: tuple[str, str]

    @property
    def shape(self) -> float:
        """How often as wide as tall."""
        left, right, bottom, top = self.box
        return (right - left) / (top - bottom)


@dataclass(frozen=True)
class Plan:
    """How panels stand: `columns` and `rows`, the size of each and from each to the next, inches,
    and the size of all with what stands around them."""

    columns: int
    rows: int
    width: float
    height: float
    pitch: tuple[float, float]

    def goodness(self, panels: int) -> float:
        """Large panels, and few places without one."""
        filled = panels / (self.columns * self.rows)
        return math.copysign(abs(self.width) * filled**0.7, self.width)

    @property
    def block(self) -> tuple[float, float]:
        """The size of all panels together."""
        across = (self.columns - 1) * self.pitch[0] + self.width
        return across, (self.rows - 1) * self.pitch[1] + self.height


@dataclass(frozen=True)
class Room:
    """What there is for panels, inches: `free` across and up, the `gap` between two either way, the
    least from one to the next, and the largest `area` of one."""

    free: tuple[float, float]
    gap: tuple[float, float]
    least: float
    area: float


def best_plan(panels: int, shape: float, room: Room) -> Plan:
    """Of so many panels, each so many times as wide as tall."""
    found = [_plan(panels, columns, shape, room) for columns in range(1, panels + 1)]
    fitting = [plan for plan in found if plan.block[0] <= room.free[0] + 1e-6]
    return max(fitting or found[:1], key=lambda plan: plan.goodness(panels))


def _plan(panels: int, columns: int, shape: float, room: Room) -> Plan:
    rows = math.ceil(panels / columns)
    width = (room.free[0] - (columns - 1) * room.gap[0]) / columns
    height = (room.free[1] - (rows - 1) * room.gap[1]) / rows
    width = min(width, height * shape, math.sqrt(room.area * shape))
    pitch = (max(width + room.gap[0], room.least), width / shape + room.gap[1])
    return Plan(columns, rows, width, width / shape, pitch)
