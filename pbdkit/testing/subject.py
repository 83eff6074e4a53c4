"""A component under examination, with the scenes it takes part in, and examples of a class."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

from pydantic import ValidationError

from pbdkit.errors import ExperimentError, PluginError
from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import Component
from pbdkit.registry.blame import interface_of
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.testing.property import PropertyError, Question
from pbdkit.testing.questions import questions_of
from pbdkit.testing.scenes import experiments_with


class Subject:
    """One component; what is asked of it is made once and shared by the properties."""

    def __init__(self, component: Component, parts: Mapping[str, Any] | None = None) -> None:
        self.component: Any = component
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


def examples_of(component: type[Component]) -> list[Component]:
    """One with the first example of each parameter that has no default, and one for each further
    example, all else being the same.

    Raises PluginError where a parameter has neither default nor example, an example is refused, or
    the class lacks a method of its interface.
    """
    base: dict[str, Any] = {}
    others: list[tuple[str, Any]] = []
    for name, field in component.model_fields.items():
        key, examples = field.alias or name, list(field.examples or [])
        if field.is_required():
            if not examples:
                raise PluginError(
                    f"{component.__name__}.{name} has neither default nor example: write "
                    f"`{name}: ... = Field(description=..., examples=[...])`"
                )
            base[key] = examples.pop(0)
        others += [(key, value) for value in examples]
    return [_made(component, base), *(_made(component, base | {k: v}) for k, v in others)]


def _made(component: type[Component], given: dict[str, Any]) -> Component:
    try:
        return component.model_validate(given)
    except TypeError as error:  # an abstract method is missing
        raise PluginError(f"{component.__name__} cannot be made: {error}") from None
    except ValidationError as error:
        fault = error.errors()[0]
        where = ".".join(map(str, fault["loc"])) or "the whole"
        raise PluginError(
            f"{component.__name__} refuses its examples {given}: {where}: {fault['msg']}"
        ) from None


def name_of(component: Component) -> str:
    """Its type with the parameters that are not at their defaults."""
    dumped = component.model_dump(exclude_defaults=True, exclude={"type"}, mode="json")
    given = ", ".join(f"{k}={v}" for k, v in dumped.items())
    return f"{component.type} ({given})" if given else component.type
