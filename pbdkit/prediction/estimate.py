"""What is known of a body whose step operator is too large for a spectrum: by multigrid on the
lattice's stencils, as its equilibrium would be found.

The slowest mode is found by inverse iteration on ever finer grids: 1 - λ comes out within 1 %. The
smallest eigenvalue is that of plane waves; where no frame surrounds the body, edges may have some
beyond it.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np

from pbdkit.analysis.spectrum import NEUTRAL, Spectrum, spectrum_of
from pbdkit.analysis.stencil import wave_bound
from pbdkit.equilibrium.grids.inverse_iteration import SlowMode
from pbdkit.equilibrium.system import StuckError
from pbdkit.resources.memory import machine_memory
from pbdkit.results.progress import Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State, initial_state

if TYPE_CHECKING:
    from pbdkit.equilibrium.grids.lattice_system import LatticeSystem

ACCURACY = 1e-2
"""Of solutions, relative."""
CLOSE, MOST_TURNS = 1e-3, 8
"""Relative change of the slowness at which inverse iteration ends, and its turns at most."""
MANY = 200_000
"""Particles from which on coarser grids are fine enough for the slowest mode."""
BYTES = 500
"""Of memory a particle (measured at 1000 × 1000)."""


class Estimate:
    """Of one scene, linearised at rest."""

    NEEDS = (
        "grids serve only where leaders hold the whole body, bonds lead to the cells beside and "
        "the frame does not lag"
    )

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._systems: dict[tuple[bool, ...], LatticeSystem | None] = {}

    def system(self, step: int) -> LatticeSystem | None:
        """With the roles of a step; None where leaders do not hold the body, or its lattice, bonds
        or rule need a matrix."""
        roles = tuple(leading.group.leads(step) for leading in self._scene.leading)
        if roles not in self._systems:
            self._systems[roles] = self._made(step)
        return self._systems[roles]

    def _made(self, step: int) -> LatticeSystem | None:
        if self.obstacle:
            return None
        from pbdkit.equilibrium.grids.lattice_choice import lattice_system

        return lattice_system(self._scene, self.at_rest, step, Watch())

    @cached_property
    def at_rest(self) -> State:
        """The start with nothing displaced: all that has the same neighbours is alike."""
        state = initial_state(self._scene)
        return replace(state, u=np.zeros_like(state.u))

    @property
    def obstacle(self) -> str:
        """Why nothing is tried; empty where it is."""
        if self._scene.experiment.neighbours.nearness():
            return "neighbours are found anew in every step"
        if not find_spec("numba"):
            return "for a body of this size numba is needed: pip install 'pbdkit[fast]'"
        if self._scene.raster.count * BYTES > machine_memory():
            return "for a body of this size there is too little memory"
        return ""

    def slowest(self) -> SlowMode | None:
        """The slowest mode of the steps, with the roles of the last."""
        system = self.system(self._scene.experiment.steps)
        if system is None:
            return None
        mode = system.slowest()
        if self._scene.raster.count > MANY:
            return mode
        for _ in range(MOST_TURNS):
            before = mode.slowness
            try:
                mode = mode.improved(system, ACCURACY)
            except StuckError:
                return None
            if abs(mode.slowness - before) <= CLOSE * before:
                break
        return mode

    @cached_property
    def spectrum(self) -> Spectrum | None:
        """Both ends of that of the rule's own step, where it is real."""
        if self._scene.lag:
            return None
        waves = wave_bound(self._scene)
        if waves is None or waves.imaginary > 1e-9:
            return None
        mode, system = self.slowest(), self.system(self._scene.experiment.steps)
        if mode is None or system is None:
            return None
        share = self._scene.experiment.stepping.relaxation * mode.slowness
        largest = 1.0 - 1.0 / share
        # Of waves that change their sign in every step a held body has none.
        smallest = (
            max(waves.smallest, -largest) if waves.smallest >= -1.0 - NEUTRAL else waves.smallest
        )
        return spectrum_of(np.array([smallest, largest], complex), system.how == "energy")
