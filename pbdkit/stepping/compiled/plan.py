"""What a scene's kernel has to hold, and the lines it is written in."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count, permutations
from typing import Any

from pbdkit.interfaces import RenewsBonds, SoftensCells
from pbdkit.interfaces.rule import shares_particles
from pbdkit.scene.guides import has_guides
from pbdkit.scene.homes import Home, Number
from pbdkit.scene.scene import Scene
from pbdkit.stepping.clamps import Clamps
from pbdkit.stepping.compiled.level import Level
from pbdkit.stepping.guidance import Guidance

MOST_BITS = 32
"""Neighbours of a sublattice up to which its slots are written out and lost bonds are bits."""


@dataclass(frozen=True)
class Plan:
    """A scene's levels, the last of which moves the particles, whether it is stepped on several
    threads, the names of what all functions of its kernel may use: mostly arrays; whether
    bonds are judged apart from moves, whatever the model; and whether the kernel is for a GPU,
    whose threads take one place after the other from flat arrays."""

    scene: Scene
    levels: tuple[Level, ...]
    parallel: bool
    shared: tuple[str, ...] = ("step",)
    apart: bool = False
    gpu: bool = False

    @property
    def axes(self) -> str:
        """The names of the axes, a letter each."""
        return "xyz"[: self.scene.axes]

    @cached_property
    def leads(self) -> dict[str, str]:
        """The lists of leaders by the ending of their names, with the axes along which they lead:
        one for all, or where some are guided one for each axis."""
        return (
            {f"_{c}": c for c in self.axes} if has_guides(self.scene.leading) else {"": self.axes}
        )

    @cached_property
    def slanted(self) -> list[tuple[str, str]]:
        """The axes along which moves may add to moves along others, with those others."""
        return list(permutations(self.axes, 2)) if Guidance(self.scene).slanted else []

    @property
    def lead(self) -> tuple[str, ...]:
        """The cell indices of a row of particles."""
        return ("i", "l")[: self.scene.axes - 1]

    @property
    def long(self) -> bool:
        """Whether there are too many neighbours to write them out."""
        return max(map(len, self.scene.neighbourhood.slots)) > MOST_BITS

    def is_loaded(self, level: Level) -> bool:
        """Whether loads act on what moves by the rule of that level: the last alone."""
        return self.scene.loads is not None and level is self.levels[-1]

    @property
    def model(self) -> Any:
        """The fracture model, None where nothing breaks."""
        return self.scene.experiment.fracture if self.scene.has_fracture else None

    @property
    def bonds(self) -> int:
        """How many numbers are remembered of each bond."""
        return sum(number.home is Home.BOND for number in self.levels[-1].seen.bond)

    @cached_property
    def rotations(self) -> tuple[int, ...]:
        """The numbers of each particle that clamped leaders prescribe."""
        return Clamps(self.scene).numbers

    @cached_property
    def kept(self) -> tuple[int, ...]:
        """The numbers of each particle that are kept as they were before the step: all that change
        where neighbours see them, else those that clamped leaders prescribe."""
        if not self.shares:
            return self.rotations
        own = self.levels[-1].seen.own
        return tuple(m for m, number in enumerate(own) if number.changes)

    @property
    def shares(self) -> bool:
        """Whether neighbours see what is remembered of each other."""
        return shares_particles(self.scene.experiment.rule)

    @property
    def read(self) -> tuple[str, ...]:
        """The arrays of what is remembered of particles, as it was before the step where neighbours
        see it."""
        kept, count = self.kept if self.shares else (), len(self.levels[-1].seen.own)
        return tuple(f"was{m}" if m in kept else f"own{m}" for m in range(count))

    @property
    def shown(self) -> tuple[str, ...]:
        """The arrays of what neighbours see of each other."""
        return self.read if self.shares else ()

    @property
    def limits(self) -> int:
        """How many limits differ from bond to bond."""
        return len(self.scene.constants.by_bond)

    @property
    def mixed(self) -> int:
        """Of how many stiffnesses there are cells besides that of the rule."""
        return len(self.scene.cells.mixed) if self.scene.cells else 0

    @property
    def tears(self) -> bool:
        """Whether the rule computes what torn cells exert."""
        return self.scene.tears

    @property
    def softens_cells(self) -> bool:
        """Whether the fracture model softens bonds by the stress of the cells beside them."""
        return isinstance(self.model, SoftensCells)

    @property
    def bonds_first(self) -> bool:
        """Whether bonds are judged in a pass of their own, and not by the sweep at both ends."""
        if self.model is None:
            return False
        renews = isinstance(self.model, RenewsBonds)
        return self.apart or renews or self.long or (self.tears and self.model.can_break)

    @property
    def judged(self) -> bool:
        """Whether the sweep judges the bonds."""
        return self.model is not None and not (self.bonds_first or self.tears)

    @property
    def real(self) -> str:
        """The kind of the scene's numbers."""
        return "real" if self.scene.experiment.stepping.precision == "float32" else "double"

    def over(self, count: str) -> str:
        """The numbers below a count; in a kernel for a GPU those of one of its threads."""
        return f"range(me, {count}, threads)" if self.gpu else f"range({count})"

    def renumbered(self, scene: Scene) -> Plan:
        """The same with other numbers."""
        levels, below = list[Level](), scene
        for level in reversed(self.levels):
            levels.insert(0, replace(level, scene=below))
            below = below.inner or below
        return replace(self, scene=scene, levels=tuple(levels))

    def number(self, value: float) -> str:
        """A literal in the scene's precision."""
        return f"real({float(value)!r})" if self.real == "real" else repr(float(value))

    def rounded(self, value: str) -> str:
        """A word for a value in the scene's precision: numbers of Python's count as such."""
        return f"real({value})" if self.real == "real" else value

    def each(self, pattern: str, axes: str = "") -> list[str]:
        """The pattern for each axis, or some, with its name for `@` and its number for `#`."""
        named = enumerate(axes or self.axes)
        return [pattern.replace("@", c).replace("#", str(a)) for a, c in named]

    def vector(self, pattern: str) -> str:
        """A vector whose components have this pattern."""
        return f"Vector({', '.join(self.each(pattern))})"

    def literal(self, values: Iterable[float]) -> str:
        """A vector of these numbers."""
        return f"Vector({', '.join(map(self.number, values))})"

    def row(self, array: str, first: object, step: Sequence[object] | None = None) -> str:
        """The places j0 to j1 of a row, or those a step of cells away."""
        *lead, last = step or [0] * self.scene.axes
        at = [_sum(name, m) for name, m in zip(self.lead, lead, strict=True)]
        return f"{array}[{', '.join([str(first), *at])}, {_sum('j0', last)}:{_sum('j1', last)}]"

    def flat(self, s: str) -> str:
        """The place at which a row begins in flat arrays of all sublattices."""
        found = s
        for axis, name in enumerate((*self.lead, "j0")):
            found = f"({found}) * kind.shape[{axis + 1}] + {name}"
        return found


def _sum(name: str, step: object) -> str:
    return name if step == 0 else f"{name} + {step}"


def listed(texts: Iterable[str]) -> str:
    """Arguments of a named tuple, of which there may be none."""
    return "".join(f"{text}, " for text in texts)


def values(numbers: Sequence[Number], where: dict[Home, str]) -> str:
    """The arguments of a named tuple: by home the pattern of where its n-th number is found."""
    counts = defaultdict[Home, Iterator[int]](count)
    return listed(where[number.home].format(n=next(counts[number.home])) for number in numbers)


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

    @property
    def used(self) -> list[str]:
        """Those of the shared names that its lines use, as they are or flat."""
        words = self._words() - set(self.own)
        return [name for name in self.shared if {name, f"flat_{name}"} & words]

    @property
    def source(self) -> list[str]:
        """Its lines, with a head."""
        head = f"def {self.name}({', '.join([*self.own, *self.used])}):"
        words = self._words()
        flat = [f"flat_{n} = {n}.reshape(-1)" for n in self.used if f"flat_{n}" in words]
        lines = ("    " + line for line in [*flat, *self.lines])
        return ["", "", "@part", head, *lines]

    def call(self, *own: str) -> str:
        """A call with these values of its own arguments."""
        return f"{self.name}({', '.join([*own, *self.used])})"

    def _words(self) -> set[str]:
        return set(re.findall(r"\w+", "\n".join(self.lines)))
