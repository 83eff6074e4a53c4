"""What a run remembers from one step to the next. This, and nothing else, is a checkpoint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.scene.scene import Scene

Floats = NDArray[np.floating[Any]]


@dataclass
class State:
    """The run at the end of a step.

    `u` is the displacement, (axis, sublattice, cell, cell), zero where no particle is, and
    `previous` the same at the end of the step before: memory needs it, PE2 shows it, and the next
    step is written into it. `broken_step` holds, for each plane of bonds (plane, cell, cell), the
    step at which each broke and -1 where none did; None where nothing can break. `starts` has for
    each leader group that has begun the displacements from which its motion counts, (axis,
    particle).
    """

    step: int
    u: Floats
    previous: Floats
    broken_step: NDArray[np.int32] | None
    starts: tuple[Floats | None, ...]


def initial_state(scene: Scene) -> State:
    """The reference configuration, with no bond broken."""
    shape = (2, *scene.raster.shape)
    planes = (len(scene.neighbourhood.planes), *scene.raster.shape[1:])
    broken = np.full(planes, -1, np.int32) if scene.has_fracture else None
    return State(0, np.zeros(shape), np.zeros(shape), broken, (None,) * len(scene.leading))
