"""Leaders that are too light for steps: the symplectic Euler method is stable for ω ≤ 2."""

from __future__ import annotations

from pbdkit.experiment.newton import Newton
from pbdkit.scene.scene import Scene
from pbdkit.stepping.newton_forces import NewtonForces
from pbdkit.stepping.state import initial_state

NUDGE = 1e-3
"""By which they are moved, in lattice units."""


def too_light(scene: Scene) -> list[str]:
    """A warning for each group whose stiffest way, others standing still, is too stiff."""
    forces, found = NewtonForces(scene), []
    state = initial_state(scene) if forces.numbers else None
    for n in forces.numbers:
        motion = scene.leading[n].group.motion
        assert state
        assert isinstance(motion, Newton)
        least = motion.lightest(forces.stiffness(n, state, NUDGE))
        if motion.mass < least:
            found.append(
                f"leaders.{n}.motion.mass: {motion.mass:g} is too light, its swing may grow for "
                f"ever; steps are stable from {least:.4g} on"
            )
    return found
