"""What moves followers: a rule's move, then relaxation and memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from pbdkit.experiment.solvers import Stepping
from pbdkit.stepping.state import Floats, State

REAL = "fiub"
"""The kinds of numpy's types that are numbers a particle can move by."""


class Followers(ABC):
    """The followers of a scene, and how they find their neighbours."""

    @abstractmethod
    def move(self, m: Floats, new: Floats, state: State) -> None:
        """Writes the displacements of all body particles into `new`, from the intermediate
        configuration m; `new` comes holding those of the step before. Particles without any
        neighbour stay. What it writes for leaders is overwritten. Of the state it takes what bonds
        and particles remember, and renews, in place, what particles do."""


def target(here: Any, move: Any, before: Any, solver: Stepping) -> Any:
    """u + relaxation · move + memory · (u - before), elementwise for one component.

    Raises ValueError where the move is not one real number a particle.
    """
    if np.shape(move) not in ((), np.shape(here)):
        raise ValueError(
            f"it returned the shape {np.shape(move)} for particles of shape {np.shape(here)}: "
            "it is not elementwise"
        )
    if not isinstance(move, float) and np.asarray(move).dtype.kind not in REAL:
        raise ValueError(f"it returned values of {np.asarray(move).dtype}, not real numbers")
    there = here + (move if solver.relaxation == 1.0 else solver.relaxation * move)
    return there + solver.memory * (here - before) if solver.memory != 0.0 else there
