"""What a scene's kernel has to hold, and the lines it is written in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pbdkit.interfaces import Slot
from pbdkit.interfaces.polygons import Tiling

INDENT = "    "


@dataclass(frozen=True)
class Wanted:
    """What of the general step a scene uses; the kernel holds that and nothing else."""

    contributions: tuple[int, ...]
    """The number of components of each."""
    fracture: bool
    some_bonds_last: bool
    some_missing: bool
    reference: tuple[tuple[float, ...], tuple[float, ...]] | None
    """Where the lattice's site (0, 0) lies, and the middle of the body from there."""
    relaxed: bool
    memory: bool
    frame: bool
    frame_matrices: bool
    lag: bool
    limits: tuple[str, ...]
    parallel: bool
    single: bool
    rule_parameters: tuple[str, ...]
    fracture_parameters: dict[str, float]
    weights: dict[Slot, Any]
    tiling: Tiling | None


class Writer:
    """Collects lines at a depth of indentation."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def add(self, depth: int, *lines: str) -> None:
        """Adds lines at that depth."""
        self.lines += [INDENT * depth + line for line in lines]


def number(value: float, wanted: Wanted) -> str:
    """A literal in the scene's precision."""
    return f"float32({float(value)!r})" if wanted.single else repr(float(value))
