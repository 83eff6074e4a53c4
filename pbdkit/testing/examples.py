"""Components to examine where only a class is given: from defaults, and from fields' examples."""

from __future__ import annotations

from typing import Any

from pydantic import ValidationError

from pbdkit.errors import PluginError
from pbdkit.interfaces import Component


def examples_of(component: type[Component]) -> list[Component]:
    """One with the first example of each parameter that has no default, and one for each further
    example, all else being the same.

    Raises PluginError where a parameter has neither default nor example, or an example is refused.
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
