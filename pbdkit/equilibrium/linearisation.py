"""Which system serves a scene: stencils on its lattice, or a matrix."""

from __future__ import annotations

from importlib.util import find_spec

from pbdkit.equilibrium.matrix_system import MatrixSystem
from pbdkit.equilibrium.system import System
from pbdkit.results.progress import Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

LARGEST_DIRECT = 5_000
"""Particles up to which `auto` takes a direct solver."""


def linearised(scene: Scene, state: State, step: int, method: str, watch: Watch) -> System:
    """The system of a scene at a state with the roles of a step, by one of the solver's methods.

    Raises ExperimentError where there is no unique solution.
    """
    large = scene.raster.count > LARGEST_DIRECT
    if (method == "multigrid" or (method == "auto" and large)) and find_spec("numba"):
        from pbdkit.equilibrium.lattice_system import lattice_system

        if system := lattice_system(scene, state, step, watch):
            return system
    return MatrixSystem(scene, state, method, watch, step)
