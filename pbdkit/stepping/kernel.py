"""Kernels: the functions that they consist of, and the writer to which operations add their lines.

A writer stands for one way to run a step: over the whole lattice, over a tile in a pass of several
steps, or on the threads of a GPU. The lines are the same for all of them; the loops around the
lines, and what goes between operations, are the writer's.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar

Lines = list[str]


class Function:
    """Function of a kernel: its lines and its own arguments, followed by those of the arguments
    shared by all functions that its lines use."""

    def __init__(self, shared: Sequence[str], name: str, *own: str) -> None:
        self.shared, self.name, self.own = shared, name, own
        self.depth = 0
        self.lines: list[str] = []

    def add(self, depth: int, *lines: str) -> None:
        """Add lines at a depth of indentation, counted from `self.depth`."""
        self.lines += ["    " * (self.depth + depth) + line for line in lines]

    @property
    def used(self) -> list[str]:
        """Shared names that its lines use, as they are or flat."""
        words = self._words() - set(self.own)
        return [name for name in self.shared if {name, f"flat_{name}"} & words]

    @property
    def source(self) -> list[str]:
        """Lines of the function with its head."""
        head = f"def {self.name}({', '.join([*self.own, *self.used])}):"
        words = self._words()
        flat = [f"flat_{n} = {n}.reshape(-1)" for n in self.used if f"flat_{n}" in words]
        lines = ("    " + line for line in [*flat, *self.lines])
        return ["", "", "@part", head, *lines]

    def call(self, *own: str) -> str:
        """Return a call with values of its own arguments."""
        return f"{self.name}({', '.join([*own, *self.used])})"

    def _words(self) -> set[str]:
        return set(re.findall(r"\w+", "\n".join(self.lines)))


class KernelWriter(ABC):
    """Writes a step of a kernel, operation by operation.

    In lines `flat_u_x` are the displacements along x before the step, by flat place, `flat_v_x`
    those after it, `flat_own0` the first number that is remembered of particles and `flat_was0`
    the same as it was before the step. In a pattern `@` stands for the name of an axis, `#` for its
    number.
    """

    keeps_before: ClassVar[bool] = True
    """True if each step leaves the displacements before it unchanged."""

    @abstractmethod
    def each(self, pattern: str, axes: str = "") -> Lines:
        """Return the pattern for each axis, or for some."""

    @abstractmethod
    def vector(self, pattern: str) -> str:
        """Return a vector of components that follow the pattern."""

    @abstractmethod
    def number(self, value: float) -> str:
        """Return a literal in the precision of the scene."""

    @abstractmethod
    def row(self, array: str, first: str) -> str:
        """Return the part of an array that belongs to a row of particles, from column j0 to j1."""

    @abstractmethod
    def places(self, sublattice: str) -> Lines:
        """Return the reference position of particle j of that row, axis by axis."""

    @abstractmethod
    def is_given(self, array: str) -> bool:
        """Return whether kernels are given an array of that name."""

    @abstractmethod
    def listed(self, name: str, *lines: str, ahead: bool = False) -> None:
        """Write a loop over the entries e of a list of flat places, `name[e]`. It goes `ahead` of
        the particles that move where it changes what they see: displacements before the step."""

    @abstractmethod
    def judge_bonds(self) -> None:
        """Write the pass that renews bonds and breaks them, unless the sweep does it as it goes."""

    @abstractmethod
    def sweep(self, level: int) -> None:
        """Write the sweep that makes the moves of a rule: `level` counts rules that work on the
        moves of another, the innermost first."""

    @abstractmethod
    def over_rows(self, name: str, write: Callable[[Function], None]) -> None:
        """Write a function of some rows, and its call for those that motion has reached. Besides
        the rows, `first_row` to `last_row`, it is given the `moment`: the step of a call, from 0
        on."""

    @abstractmethod
    def follow(self, mapped: Callable[[str], Lines], planes: str, lag: int = 0) -> None:
        """Write a loop over the frame points f of some planes: `mapped` are the lines that compute
        their displacements t_@ from planes. With `lag` they come from before the step."""
