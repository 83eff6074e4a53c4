"""What a part remembers: numbers of its own for each bond or each particle."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

DTYPES = ("f8", "i1", "i2", "i4", "i8")


@dataclass(frozen=True)
class Remembered:
    """A number that a fracture model keeps for each bond, or a rule for each particle.

    It starts at `initial`, or as the part's `draw` says, is carried from step to step and recorded
    as the variable `name`: at every recorded step where it `changes`, otherwise once, and not at
    all unless `recorded`. `dtype` is "f8", kept in the precision of the run, or an integer's.

    Raises ValueError for a name that is no word or another dtype.
    """

    name: str
    long_name: str
    units: str
    initial: float = 0.0
    dtype: str = "f8"
    changes: bool = True
    recorded: bool = True

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise ValueError(f"'{self.name}' is no name for a variable: letters, digits and _ only")
        if self.dtype not in DTYPES:
            raise ValueError(f"'{self.name}' has the dtype '{self.dtype}', not {', '.join(DTYPES)}")
        if np.ndim(self.initial):
            raise ValueError(
                f"'{self.name}' starts at {self.initial!r}, and is one number: declare one for "
                f"each component, as {self.name}_x and {self.name}_y"
            )


@dataclass(frozen=True)
class Bonds:
    """The bonds of a scene in the order of the dataset, a row a bond, for those who draw.

    `ends` (bond, 2) are the numbers of its particles, lower first; `rest` (bond, axis) is the rest
    offset from that one to the other and `midpoint` (bond, axis) lies between their reference
    positions, both in lattice units; `shell` (bond,) counts from 1.
    """

    ends: NDArray[np.int64]
    shell: NDArray[np.int8]
    rest: NDArray[np.float64]
    midpoint: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.ends)


@dataclass(frozen=True)
class Particles:
    """The particles of the body in the order of their numbers, a row each, for those who draw:
    `number` (particle,) and reference position `X` (particle, axis), lattice units."""

    number: NDArray[np.int64]
    X: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.number)


Drawn = dict[str, NDArray[Any]]
"""Initial values by the name of the number; what is left out starts at its `initial`."""


class Remembers(ABC):
    """A part with numbers of its own: a fracture model's of each bond, seen by name in ``c``, a
    rule's of each particle of the body, seen by name in ``here.own``."""

    @abstractmethod
    def remembered(self) -> tuple[Remembered, ...]:
        """What it remembers."""


class Draws(Remembers):
    """A part whose numbers do not all start at their `initial`."""

    @abstractmethod
    def draw(self, owners: Any, generator: np.random.Generator) -> Drawn:
        """Where they start, (owner,) by name, for `owners`: Bonds of a fracture model, Particles of
        a rule.

        The generator depends on the experiment's `seed` and on nothing else: neither on other
        random parts, nor on engine or threads.
        """
