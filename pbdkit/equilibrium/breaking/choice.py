"""Whether a kernel of its own settles a scene whose bonds break."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbdkit.errors import PluginError
from pbdkit.interfaces import RenewsBonds, SoftensCells
from pbdkit.results.progress import Watch
from pbdkit.scene.scene import Scene
from pbdkit.scene.solver_sizes import LARGEST_ANEW
from pbdkit.stepping.choice import PATIENCE_S, obstacle

if TYPE_CHECKING:
    from pbdkit.equilibrium.breaking.settler import Settler

SETTLING_S, PARTICLE_S = 6e-3, 1e-5
"""What a settling takes by numpy, about, and what it takes more a particle."""
LITTLE_BY_LITTLE, AT_ONCE = 20, 2
"""Settlings an increment where bonds change little by little, and where they only break."""


def settler_of(scene: Scene, tolerance: float, watch: Watch) -> Settler | None:
    """For a scene whose rule is linear; None where compiling would take longer than numpy, where
    nothing compiles, or where the solver's method is not direct. Decided by the experiment alone,
    so that what is resumed goes on as it began."""
    solver = scene.experiment.solver.sought
    direct = solver.method == "lu" or (
        solver.method == "auto" and scene.raster.count <= LARGEST_ANEW
    )
    if not (direct and _is_plain(scene)) or _seconds(scene) < PATIENCE_S or obstacle():
        return None
    from pbdkit.equilibrium.breaking.settler import Settler

    try:
        found = Settler(scene, tolerance, watch)
    except PluginError:
        return None
    return found if found.is_small else None


def _is_plain(scene: Scene) -> bool:
    """Whether the kernel knows all that such a scene has: loads, cuts, fields, courses, leaders
    along one axis and cells that begin to soften in turn it does not."""
    asked, constants = scene.experiment, scene.constants
    more = any((asked.cuts, asked.loads, asked.courses, constants.by_bond, constants.by_particle))
    mixed = scene.cells is not None and bool(scene.cells.mixed)
    guided = any(leading.group.axes for leading in scene.leading)
    flat = scene.axes == 2 and scene.inner is None
    in_turn = isinstance(asked.fracture, SoftensCells)
    return scene.has_fracture and flat and not (more or mixed or guided or in_turn)


def _seconds(scene: Scene) -> float:
    """What numpy would take."""
    renews = isinstance(scene.experiment.fracture, RenewsBonds)
    settlings = scene.experiment.solver.sought.increments * (
        LITTLE_BY_LITTLE if renews else AT_ONCE
    )
    return settlings * (SETTLING_S + PARTICLE_S * scene.raster.count)
