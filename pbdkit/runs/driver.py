"""What a solver does to a scene: one interface, with two implementations."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Generator

from pbdkit.equilibrium.watch import Watch
from pbdkit.results.recorder import Outcome
from pbdkit.scene.scene import Scene
from pbdkit.stepping.choice import Choice
from pbdkit.stepping.state import State

States = Generator[State, None, Outcome]


class Driver(ABC):
    """Takes one scene from a state to its end, once.

    `state` is where it stands, `choice` what steps it. `ending` says of a state just given out that
    it is the last of a run that ends before its last step, to be kept whatever the plan.
    """

    choice: Choice

    def __init__(self, scene: Scene, state: State, watch: Watch) -> None:
        self.scene, self.state, self.watch = scene, state, watch
        self.ending = False
        self.rejection: FloatingPointError | None = None
        """Why whoever looked at the last state could not use it; its next move is up to the
        driver."""

    @abstractmethod
    def states(self) -> States:
        """The states on the way, the first included, each valid until the next is asked for; then
        how it ended. Raises ExperimentError where there is no way."""
