"""What a scene's kernel has to hold, and the lines it is written in."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from pbdkit.interfaces import RenewsBonds, RenewsParticles, Softens
from pbdkit.scene.homes import Home, Number, Seen, numbers_of
from pbdkit.scene.scene import Scene

MOST_BITS = 32
"""Neighbours of a sublattice up to which its slots are written out and lost bonds are bits."""

NAMES = (
    "kind", "share", "broken", "lengths", "lost", "counts", "rests", "limits", "signs", "away",
    "bonds_away", "cells_away", "ends", "end_rests", "end_limits", "end_blocks", "runs", "starts",
    "first", "at", "solver", "led", "led_values", "led_kept", "points", "entries", "bodies",
    "mapped", "box", "growth", "step",
)  # fmt: skip
"""What kernels of all scenes know."""


@dataclass(frozen=True)
class Level:
    """A rule whose moves one sweep makes; `scene` has it as its rule. The first works on
    displacements, each other on the moves of the one before; the `last` moves the particles."""

    number: int
    scene: Scene
    parts: tuple[int, ...]
    """Of each contribution, the number of its components."""
    last: bool

    @cached_property
    def seen(self) -> Seen:
        """The numbers that the rule sees."""
        scene = self.scene
        return numbers_of(scene.experiment, scene.constants, weighs_cells=scene.cells is not None)

    @property
    def renews(self) -> bool:
        """Whether the rule remembers what changes."""
        return isinstance(self.scene.experiment.rule, RenewsParticles)


@dataclass(frozen=True)
class Plan:
    """A scene's levels, the (sublattice, kind) of the rows that occur, and whether it is stepped on
    several threads."""

    scene: Scene
    levels: tuple[Level, ...]
    rows: tuple[tuple[int, int], ...]
    parallel: bool

    @cached_property
    def shared(self) -> list[str]:
        """The names of the arrays of a kernel: displacements u, those of the step before, over
        which the new are written, and moves of inner rules first."""
        seen, inner = self.levels[-1].seen, len(self.levels) - 1
        bonds = sum(number.home is Home.BOND for number in seen.bond)
        counted = {
            "bond": bonds,
            "own": len(seen.own),
            "rule": len(self.levels),
            "weights": len(self.levels),
        }
        planes = ["u", "v", *(f"z{n}" for n in range(inner))]
        return [
            *(f"{plane}_{c}" for plane in planes for c in self.axes),
            *(f"{name}{n}" for name, count in counted.items() for n in range(count)),
            *NAMES,
        ]

    @property
    def axes(self) -> str:
        """The names of the axes, a letter each."""
        return "xyz"[: self.scene.axes]

    @property
    def lead(self) -> tuple[str, ...]:
        """The cell indices of a row of particles."""
        return ("i", "l")[: self.scene.axes - 1]

    @property
    def single(self) -> bool:
        """Whether the run is in single precision."""
        return self.scene.experiment.stepping.precision == "float32"

    @property
    def long(self) -> bool:
        """Whether there are too many neighbours to write them out."""
        return max(map(len, self.scene.neighbourhood.slots)) > MOST_BITS

    @property
    def model(self) -> Any:
        """The fracture model, None where nothing breaks."""
        return self.scene.experiment.fracture if self.scene.has_fracture else None

    @property
    def bonds_first(self) -> bool:
        """Whether bonds are judged in a pass of their own, and not by the sweep at both ends."""
        return self.model is not None and (isinstance(self.model, RenewsBonds) or self.long)

    @property
    def home_reach(self) -> tuple[int, int]:
        """How many rows before and after a particle's own its bonds may be kept."""
        around = self.scene.neighbourhood
        steps = [0, *(slot.cell[0] for slot, (_, here) in around.home.items() if not here)]
        return -min(steps), max(steps)

    @property
    def judged(self) -> bool:
        """Whether the sweep judges the bonds."""
        return self.model is not None and not self.bonds_first

    @property
    def softens(self) -> bool:
        """Whether the rule sees something else than d at bonds that last."""
        return isinstance(self.model, Softens)

    def number(self, value: float) -> str:
        """A literal in the scene's precision."""
        return f"real({float(value)!r})" if self.single else repr(float(value))

    def vector(self, parts: Iterable[object]) -> str:
        """A vector of these components."""
        return f"Vector({', '.join(map(str, parts))})"

    def planes(self, name: str, joined: str = ", ") -> str:
        """A name for each axis."""
        return joined.join(f"{name}_{c}" for c in self.axes)

    def row(self, array: str, first: object, step: Sequence[object] | None = None) -> str:
        """The places j0 to j1 of a row, or those a step of cells away."""
        *lead, last = step or [0] * self.scene.axes
        at = [_sum(name, m) for name, m in zip(self.lead, lead, strict=True)]
        return f"{array}[{', '.join([str(first), *at])}, {_sum('j0', last)}:{_sum('j1', last)}]"

    def flat(self, s: str, j: str = "j0") -> str:
        """The place of a particle in flat arrays of all sublattices."""
        found = s
        for axis, name in enumerate((*self.lead, j)):
            found = f"({found}) * kind.shape[{axis + 1}] + {name}"
        return found


def _sum(name: str, step: object) -> str:
    return name if step == 0 else f"{name} + {step}"


def values(numbers: Sequence[Number], where: dict[Home, str], literal: Sequence[str] = ()) -> str:
    """The arguments of a named tuple: by home the pattern of where its n-th number is found, or
    what is written out."""
    counts: dict[Home, int] = {}
    found = []
    for n, number in enumerate(numbers):
        m = counts.get(number.home, 0)
        counts[number.home] = m + 1
        pattern = where.get(number.home)
        found.append(literal[n] if pattern is None else pattern.format(n=m))
    return "".join(f"{value}, " for value in found)


class Function:
    """A function of a kernel: its lines, and the arguments of its own before those that all
    functions share and that its lines turn out to use."""

    def __init__(self, shared: Sequence[str], name: str, *own: str) -> None:
        self.shared, self.name, self.own = shared, name, own
        self.depth = 0
        self.lines: list[str] = []

    def add(self, depth: int, *lines: str) -> None:
        """Adds lines at a depth of indentation, counted from `self.depth`."""
        self.lines += ["    " * (self.depth + depth) + line for line in lines]

    def flatten(self) -> None:
        """Makes flat what its lines name `flat_...` of the shared arrays, once."""
        words = set(re.findall(r"\bflat_(\w+)", "\n".join(self.lines)))
        flat = [f"flat_{n} = {n}.reshape(-1)" for n in self.shared if n in words]
        self.lines[:0] = flat

    @property
    def used(self) -> list[str]:
        """Those of the shared names that its lines use."""
        words = set(re.findall(r"\w+", "\n".join(self.lines)))
        return [name for name in self.shared if name in words]

    @property
    def source(self) -> list[str]:
        """Its lines, with a head."""
        head = f"def {self.name}({', '.join([*self.own, *self.used])}):"
        return ["", "", '@njit(error_model="numpy")', head, *("    " + line for line in self.lines)]

    def call(self, *own: str) -> str:
        """A call with these values of its own arguments."""
        return f"{self.name}({', '.join([*own, *self.used])})"
