"""Functions of kernels, and the interface of the writers to which operations add lines.

There is a writer for each way of executing a step: on the whole lattice, on a tile in a pass of
several steps, or on the threads of a GPU. Operations write the same lines in all cases. The writer
adds loops around these lines and, on a GPU, synchronisation between operations.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar

Lines = list[str]


class Function:
    """Function of a kernel with its lines and arguments. The arguments `own` come first. They are
    followed by those names of `shared`, which all functions may use, that occur in a line."""

    def __init__(self, shared: Sequence[str], name: str, *own: str) -> None:
        self.shared, self.name, self.own = shared, name, own
        self.depth = 0
        self.lines: list[str] = []

    def add(self, depth: int, *lines: str) -> None:
        """Add lines at a depth of indentation, counted from `self.depth`."""
        self.lines += ["    " * (self.depth + depth) + line for line in lines]

    @property
    def used(self) -> list[str]:
        """Shared names that the function uses. A name also counts as used if it occurs in a line
        with the prefix of flat arrays."""
        words = self._words() - set(self.own)
        return [name for name in self.shared if {name, f"flat_{name}"} & words]

    @property
    def source(self) -> list[str]:
        """Lines of the function, `def` included."""
        head = f"def {self.name}({', '.join([*self.own, *self.used])}):"
        words = self._words()
        flat = [f"flat_{n} = {n}.reshape(-1)" for n in self.used if f"flat_{n}" in words]
        lines = ("    " + line for line in [*flat, *self.lines])
        return ["", "", "@part", head, *lines]

    def call(self, *own: str) -> str:
        """Return a call of the function in which `values` are passed for the arguments that are not
        shared."""
        return f"{self.name}({', '.join([*own, *self.used])})"

    def _words(self) -> set[str]:
        return set(re.findall(r"\w+", "\n".join(self.lines)))


class KernelWriter(ABC):
    """Writes a step of a kernel, operation by operation.

    The lines of operations use the names of arrays with an entry for each flat place. `flat_u_x`
    are the displacements along x before the step, and `flat_v_x` those after the step. `flat_own0`
    is the first state variable of particles, and `flat_was0` its value before the step. In a
    pattern `@` stands for the name of an axis, and `#` for its number.
    """

    keeps_before: ClassVar[bool] = True
    """True if each step leaves the displacements before it unchanged."""

    @abstractmethod
    def each(self, pattern: str, axes: str = "") -> Lines:
        """Return the lines that the pattern gives for each axis, or only for those in `axes`."""

    @abstractmethod
    def vector(self, pattern: str) -> str:
        """Return a vector expression. Its components are given by the pattern for each axis."""

    @abstractmethod
    def number(self, value: float) -> str:
        """Return a literal in the precision of the scene."""

    @abstractmethod
    def row(self, array: str, first: str) -> str:
        """Return an expression for the part of an array in columns j0 to j1 of a row of
        particles."""

    @abstractmethod
    def places(self, sublattice: str) -> Lines:
        """Return expressions for the reference position of particle j of a row, one for each
        axis."""

    @abstractmethod
    def is_given(self, array: str) -> bool:
        """Return whether an array of that name is an argument of kernels."""

    @abstractmethod
    def listed(self, name: str, *lines: str, ahead: bool = False) -> None:
        """Write a loop over the entries e of a list of flat places, `name[e]`. With `ahead` the
        loop is placed before the moves of particles; this is necessary if it changes the
        displacements before the step, because the moves depend on these displacements."""

    @abstractmethod
    def judge_bonds(self) -> None:
        """Write the pass that updates and breaks bonds, unless the sweep does both."""

    @abstractmethod
    def sweep(self, level: int) -> None:
        """Write the sweep that computes the moves of a rule. Rules that act on the moves of another
        rule have higher levels; the innermost has level 0."""

    @abstractmethod
    def over_rows(self, name: str, write: Callable[[Function], None]) -> None:
        """Write a function of rows, and its call for those rows that motion has reached. The
        arguments of the function are `first_row` and `last_row`, the range of the rows, and
        `moment`, the index of the step in the call."""

    @abstractmethod
    def follow(self, mapped: Callable[[str], Lines], planes: str, delay: int = 0) -> None:
        """Write a loop over the frame points f that writes their values in the arrays `planes`.
        `mapped` gives the lines that compute the values t_@. With `delay` they are computed from
        the displacements before the step."""
