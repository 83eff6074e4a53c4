"""What was measured of one experiment, and what the experiment has to say of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from pbdkit.experiment.model import Experiment
from pbdkit.fitting.parameter import Parameter
from pbdkit.stepping.state import Floats


@dataclass(frozen=True)
class Seen:
    """At some parameters: the residuals (measured - predicted) / weighted noise, (number,), and how
    the predictions over it change with each parameter, (number, parameter), with each unknown
    of the observation's own, (number, own), and with Young's modulus, (number,)."""

    residuals: Floats
    by_parameter: Floats
    by_own: Floats
    by_modulus: Floats


@dataclass(frozen=True)
class Near:
    """What was seen before, and by what share of the way between its bounds a parameter is away
    from there at most."""

    seen: Seen
    away: float


@dataclass(frozen=True, kw_only=True)
class Observation(ABC):
    """Numbers that were measured of an experiment. `noise` is their standard deviation; both come
    in `unit`s of what was given. `rows` are the numbers of the rows
    that count among those that were given; `left_out` are of no use, for that reason."""

    kind: ClassVar[str]
    experiment: Experiment
    measured: Floats
    noise: float
    rows: NDArray[np.intp]
    left_out: int = 0
    left_out_because: str = ""
    unit: float = 1.0
    weight: float = 1.0

    @property
    def weighted_noise(self) -> float:
        """The noise over the root of the weight: what residuals are counted in."""
        return float(self.noise / np.sqrt(self.weight))

    @property
    def needs_modulus(self) -> bool:
        """Whether it tells Young's modulus."""
        return False

    @property
    def own(self) -> int:
        """How many unknowns it has beside the parameters."""
        return 0

    def start(self) -> Floats:
        """Where the search for these begins, (own,)."""
        return np.zeros(self.own)

    @abstractmethod
    def at(
        self,
        experiment: Experiment,
        parameters: Sequence[Parameter],
        own: Floats,
        modulus: float,
        near: Near | None = None,
    ) -> Seen:
        """What there is at an experiment like its own; what was seen `near` there is where
        the search for it may begin. Raises ExperimentError, and
        UnconvergedError where nothing can be predicted."""

    def modulus_terms(self, experiment: Experiment) -> tuple[float, float]:
        """Σ measured · p and Σ p² over the square of the weighted noise, with the predictions p for
        a modulus of 1: their ratio is where the search for it begins."""
        return 0.0, 0.0

    @abstractmethod
    def places(self) -> Floats:
        """Where it was measured, (row, coordinate): what lies near another row tells the same."""

    def part(self, chosen: NDArray[np.bool_]) -> Self:
        """The same of some of its rows, True for each."""
        columns = len(self.measured) // len(self.rows)
        measured = self.measured.reshape(columns, -1)[:, chosen].ravel()
        return replace(self, measured=measured, rows=self.rows[chosen])

    def with_noise(self, noise: float) -> Self:
        """The same with another noise."""
        return replace(self, noise=noise)
