"""A component under examination, with the scenes it takes part in."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import Component
from pbdkit.registry.blame import interface_of
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.testing.examples import name_of
from pbdkit.testing.property import PropertyError
from pbdkit.testing.question import Question
from pbdkit.testing.questions import questions_of
from pbdkit.testing.scenes import experiments_with


class Subject:
    """One component; what is asked of it is made once and shared by the properties."""

    def __init__(self, component: Component, parts: Mapping[str, Any] | None = None) -> None:
        self.component = component
        self.parts = dict(parts or {})

    @property
    def name(self) -> str:
        """Interface, type and parameters."""
        return f"{interface_of(type(self.component)).__name__} {name_of(self.component)}"

    @cached_property
    def scenes(self) -> list[Scene]:
        """The scenes that it takes part in; ExperimentErrors are its right to refuse.

        Raises PropertyError where it refuses all of them.
        """
        return scenes_with(self.component, self.parts)

    def scene(self, n: int = 0) -> Scene:
        """One of the scenes, from the last on for negative n."""
        return self.scenes[n % len(self.scenes)]

    def questions(self, n: int = 0) -> list[Question]:
        """What can be asked of the component directly, on its n-th scene and with seed n."""
        return questions_of(self.component, self.scene(n), seed=n % 1000)


def scenes_with(component: Component, parts: Mapping[str, Any]) -> list[Scene]:
    """The scenes that a component takes part in, PropertyError if there is none."""
    scenes: list[Scene] = []
    refusals: list[ExperimentError] = []
    experiment: Experiment | None = None
    for experiment in experiments_with(component, parts):
        try:
            scenes.append(build_scene(experiment))
        except ExperimentError as error:
            refusals.append(error)
    if not scenes:
        raise PropertyError(
            f"no scene that was tried takes it; the first: {refusals[0]}; name the parts that go "
            "with it, `conformance(..., lattice=..., neighbours=...)`"
        )
    return scenes
