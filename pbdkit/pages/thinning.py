"""What of a dataset a page holds: which recorded steps and which particles, within a budget."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import xarray

Rows = NDArray[np.intp]
FEWEST_STEPS = 60
"""Of a run, as far as they are recorded."""
MOST_PARTICLES = 50_000
"""A browser moves so many well, with their bonds."""
FEW_LEADERS = 200
"""So many stay whatever else is left out: the motion is theirs."""


@dataclass(frozen=True)
class Thinning:
    """The rows of the steps and of the particles that are shown; every `stride`-th particle along
    each axis of the lattice, and all leaders if they are `led`; of `recorded` steps and `count`
    particles."""

    steps: Rows
    particles: Rows
    stride: int
    led: bool
    recorded: int
    count: int

    @property
    def is_thinner(self) -> bool:
        """Whether a larger budget would show more."""
        return len(self.steps) < self.recorded or len(self.particles) < self.count

    def left_out(self) -> list[str]:
        """What is not shown, a sentence each."""
        said = []
        if len(self.steps) < self.recorded:
            every = int(self.steps[1] - self.steps[0]) if len(self.steps) > 1 else self.recorded
            said.append(
                f"{len(self.steps)} of the {self.recorded} recorded steps are shown: one in "
                f"{every}, and the last one."
            )
        if len(self.particles) < self.count:
            said.append(
                f"{len(self.particles)} of the {self.count} particles are shown: one in "
                f"{self.stride} along i and along j{', and all that lead' if self.led else ''}. "
                "Bonds are shown where both of their particles are."
            )
        return said


def thinned(
    dataset: xarray.Dataset,
    leaders: NDArray[np.bool_],
    size: int,
    budget: int,
    fewest: int = FEWEST_STEPS,
) -> Thinning:
    """As many steps and particles as fit into `budget` bytes, where each particle takes `size`
    bytes a step; steps are left out down to the `fewest`, then particles. `leaders` (particle,) are
    kept where they are few."""
    recorded, count = dataset.sizes.get("time", 1), dataset.sizes["particle"]
    fitting = max(1, budget // (size * count))
    every = math.ceil(recorded / max(fitting, min(recorded, fewest)))
    steps = np.unique(np.append(np.arange(0, recorded, every), recorded - 1))
    stride = 1
    kept = np.ones(count, np.bool_)
    most = min(budget // (size * len(steps)), MOST_PARTICLES)
    while kept.sum() > most and stride < 1000:
        stride += 1
        kept = _on_sublattice(dataset, stride)
    led = bool(0 < leaders.sum() <= FEW_LEADERS)
    rows = np.flatnonzero(kept | leaders if led else kept)
    return Thinning(steps, rows, stride, led, recorded, count)


def _on_sublattice(dataset: xarray.Dataset, stride: int) -> NDArray[np.bool_]:
    """Which particles lie on every so-many-th line of the lattice, along i and along j."""
    indices: list[NDArray[Any]] = [dataset[n].values for n in ("i", "j") if n in dataset.variables]
    if len(indices) < 2 or any(index.ndim != 1 for index in indices):
        return np.asarray(np.arange(dataset.sizes["particle"]) % stride**2 == 0)
    return np.asarray((indices[0] % stride == 0) & (indices[1] % stride == 0))
