"""The engine of one part: steps it by any other engine, and renews its halo in time."""

from __future__ import annotations

from pbdkit.ranks.communicator import Ranks
from pbdkit.ranks.halo import Halo
from pbdkit.scene.scene import Scene
from pbdkit.stepping.numpy_engine import Engine
from pbdkit.stepping.prescription import steady_steps
from pbdkit.stepping.state import State


class DividedStepper(Engine):
    """Makes as many steps at once as the halo serves for, and as no leaders begin to lead in: where
    they begin is taken from a state that is whole."""

    def __init__(self, ranks: Ranks, scene: Scene, engine: Engine, halo: Halo, steps: int) -> None:
        self.name, self.threads = engine.name, engine.threads
        self._ranks, self._scene, self._engine = ranks, scene, engine
        self._halo, self._steps = halo, steps

    def advance(self, state: State, steps: int = 1) -> State:
        """Every process its own part. What one raises all of them do."""
        end = state.step + steps
        while state.step < end:
            most = min(self._steps, end - state.step)
            count = steady_steps(self._scene, state.step + 1, most, moving=True)
            error: Exception | None = None
            try:
                state = self._engine.advance(state, count)
            except Exception as raised:
                error = raised
            self._ranks.raise_first(error)
            self._halo.renew(state)
            for rows in self._halo.received.values():
                self._engine.renewed(state, rows)
        return state
