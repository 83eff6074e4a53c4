"""Where to and how far motions and forces go, in one vector each, as arrows show it."""

from __future__ import annotations

from typing import Any

import numpy as np

from pbdkit.drawing.svg import Floats
from pbdkit.experiment.loads import Load
from pbdkit.experiment.motion import Motion
from pbdkit.experiment.motions import Oscillation, Rotation
from pbdkit.experiment.newton import Newton


def extreme(motion: Motion, reference: Floats, steps: int) -> Floats:
    """(particle or 1, axis): the farthest that a motion goes from its start, of those moments at
    which it changes; of a turn the way of its first step."""
    if isinstance(motion, Rotation):
        return np.atleast_2d(motion.offset(1, reference))
    if isinstance(motion, Oscillation):
        return np.atleast_2d(motion.amplitude)
    if isinstance(motion, Newton):
        return np.atleast_2d(motion.velocity)
    moments = [n for n in (1, *motion.knots(), steps) if 1 <= n <= steps]
    ways = [np.atleast_2d(motion.offset(n, reference)) for n in moments]
    return max(ways, key=lambda way: float(np.hypot(*way.T).max()))


def greatest(force: Any) -> float:
    """A component of a force, or the greatest that its course takes."""
    values = getattr(force, "values", None)
    return float(max(values, key=abs)) if values is not None else float(force)


def force_of(load: Load) -> Floats:
    """(axis,): the greatest that a load becomes, in all or of a unit of area."""
    return np.array([greatest(f) for f in load.force or load.body_force or ()])
