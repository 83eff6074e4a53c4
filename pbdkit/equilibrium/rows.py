"""The rows of a lattice that a process has in the search for an equilibrium, and what several
processes tell each other of theirs.

Fields are (…, row, place). A process has some rows of its own, and around them a halo of others'.
What is asked of the whole lattice is put together from own rows, in their order, so that the
answer is the same in all processes, and that of one alone.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pbdkit.equilibrium.strip import Strip

Array = NDArray[Any]
Floats = NDArray[np.floating[Any]]


class Rows(ABC):
    """Those of one process among all. Each call is made by all processes, in the same order."""

    strip: Strip | None = None
    """Which rows those are; None of all."""
    rank: int = 0
    """How many processes have rows before them."""

    @property
    def own(self) -> slice:
        """Its own, among the rows of its arrays."""
        return self.strip.own if self.strip else slice(None)

    @property
    def known(self) -> slice:
        """Those of its arrays with known stencils."""
        return self.strip.known if self.strip else slice(None)

    @abstractmethod
    def every(self, value: Any) -> list[Any]:
        """The values of all processes, in the order of their rows."""

    @abstractmethod
    def agreeing(self) -> AbstractContextManager[None]:
        """What is raised in the block, in any process, is raised in all of them at its end."""

    @abstractmethod
    def meet(self, field: Array) -> None:
        """Renews the halo of a field, in place."""

    @abstractmethod
    def random(self, shape: tuple[int, ...]) -> Floats:
        """A field of numbers from [-1, 1), always the same for the same lattice."""

    def whole(self, numbers: Array, axis: int = -1) -> Array:
        """Of all rows, from numbers of the rows that are here, along an axis."""
        own = np.moveaxis(numbers, axis, 0)[self.own]
        return np.concatenate(self.every(np.moveaxis(own, 0, axis)), axis)

    def total(self, numbers: Array) -> float:
        """The sum of one number a row."""
        return float(self.whole(numbers).sum())

    def most(self, value: float) -> float:
        """The largest of all processes; not a number where one is none."""
        return float(np.max(self.every(value)))

    def any(self, value: bool) -> bool:
        """Whether it is so in any process."""
        return any(self.every(bool(value)))

    def size(self, field: Array) -> int:
        """How many numbers a field has."""
        return sum(self.every(field[..., self.own, :].size))

    def largest(self, field: Floats) -> float:
        """Its largest magnitude; 0 of none."""
        return self.most(float(np.abs(field[..., self.own, :]).max(initial=0.0)))

    def norm(self, field: Floats) -> float:
        """The root of the sum of squares."""
        with np.errstate(over="ignore"):
            each = self.every(float(np.linalg.norm(field[..., self.own, :])))
        return math.hypot(*each)


class AllRows(Rows):
    """One process has all."""

    def every(self, value: Any) -> list[Any]:
        """Its own alone."""
        return [value]

    def agreeing(self) -> AbstractContextManager[None]:
        """With itself."""
        return nullcontext()

    def meet(self, field: Array) -> None:
        """There is no halo."""

    def random(self, shape: tuple[int, ...]) -> Floats:
        """From one generator."""
        return np.random.default_rng(0).uniform(-1.0, 1.0, shape)


ALL: Final = AllRows()
