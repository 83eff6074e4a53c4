"""Fields of an experiment that hold a part: {type: ..., its parameters} becomes an object."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from operator import or_
from typing import Any

from pydantic import BeforeValidator, ValidationError, ValidationInfo
from pydantic_core import PydanticCustomError

from pbdkit.errors import ExperimentError, PbdkitError, PluginError
from pbdkit.interfaces import INTERFACES, Component
from pbdkit.interfaces.naming import did_you_mean
from pbdkit.registry.blame import blame
from pbdkit.registry.registry import Registry

LONGEST_TYPE = 200
Finder = Callable[[str], type[Component]]


def open_part(interface: type[Component]) -> BeforeValidator:
    """The part is a component of an open interface, found in the registry.

    The registry comes in the validation context, so that components handed over in Python count.
    """

    def build(value: Any, info: ValidationInfo) -> Any:
        registry: Registry = (info.context or {}).get("registry") or Registry()
        part = _build(value, interface, lambda name: registry.find(interface, name), info)
        try:
            part.model_dump_json()
        except (Exception, SystemExit) as error:
            raise _blame(
                type(part), "when written as JSON, as datasets keep it", error, info
            ) from error
        return part

    return BeforeValidator(build)


def closed_part(base: type[Component], *members: type[Component]) -> BeforeValidator:
    """The part is one of a fixed list of classes, told apart by `type`."""
    by_name = {member.type_name(): member for member in members}

    def find(name: str) -> type[Component]:
        if name not in by_name:
            hint = did_you_mean(name, by_name)
            raise ExperimentError(f"unknown type '{name}'{hint} (known: {', '.join(by_name)})")
        return by_name[name]

    return BeforeValidator(
        lambda value, info: _build(value, base, find, info),
        json_schema_input_type=reduce(or_, members),
    )


def _build(value: Any, base: type[Component], find: Finder, info: ValidationInfo) -> Any:
    if isinstance(value, base):
        return value
    if not isinstance(value, dict):
        raise fault(f"expected {{type: ..., its parameters}}, got {brief(value)}")
    name = value.get("type")
    if name is None:
        raise fault("`type` is missing")
    if not isinstance(name, str):
        raise fault(f"expected a word, got {brief(name)}", key="type")
    if len(name) > LONGEST_TYPE:
        raise fault(f"unknown type {brief(name)}", key="type")
    try:
        part = find(name)
    except ExperimentError as error:
        raise fault(str(error), key="type") from None
    except PluginError as error:
        raise PluginError(str(error), (info.field_name or "", "type")) from None
    parameters = {k: v for k, v in value.items() if k != "type"}
    try:
        return part.model_validate(parameters, context=info.context)
    except (ValidationError, PbdkitError, MemoryError):
        raise
    except (Exception, SystemExit) as error:
        if not issubclass(part, tuple(INTERFACES.values())):
            raise
        raise _blame(part, "when given its parameters", error, info) from error


def _blame(
    part: type[Component], when: str, error: BaseException, info: ValidationInfo
) -> PluginError:
    return PluginError(str(blame(part, when, error)), (info.field_name or "",))


def fault(text: str, **where: Any) -> PydanticCustomError:
    """An error for pydantic to carry: `text` for the user, `key` where a key of it is meant."""
    return PydanticCustomError("fault", "{text}", {"text": text, **where})


def brief(value: Any) -> str:
    """The value as users wrote it, cut where it is long."""
    if isinstance(value, (dict, list, tuple)) and len(value) > 4:
        return f"a {'map' if isinstance(value, dict) else 'list'} of {len(value)}"
    if isinstance(value, int) and abs(value) > 10**20:
        return "a huge integer"
    if isinstance(value, str):
        value = value[:50]
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."
