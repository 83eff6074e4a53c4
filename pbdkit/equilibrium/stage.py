"""What of a linear system is solved at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pbdkit.equilibrium.system_parts import Part
from pbdkit.interfaces.frame import Indices


@dataclass
class Stage:
    """The unknowns of one axis, or of both where they move each other, with their parts: who
    belongs to each. `into` is what the axis solved before adds to the moves."""

    axes: list[int]
    parts: list[tuple[Indices, Part]]
    into: Any = None
