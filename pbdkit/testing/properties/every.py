"""What is asked of every component before any of its functions is called."""

from __future__ import annotations

import inspect
import json
import pickle
import re

from pydantic import ValidationError

from pbdkit.interfaces import INTERFACES, Component
from pbdkit.testing.fault import PropertyError
from pbdkit.testing.property import asked_of
from pbdkit.testing.subject import Subject

ALL = tuple(INTERFACES.values())
WORD = r"[a-z][a-z0-9]*(-[a-z0-9]+)*"


@asked_of(*ALL)
def names_itself(subject: Subject) -> None:
    """Its `type` is one literal in lower case, words joined by hyphens, so that experiments name
    it, schemas tell it apart and `distribution:type` can be read."""
    component = type(subject.component)
    field, name = component.model_fields["type"], component.type_name()
    if not re.fullmatch(WORD, name):
        raise PropertyError(f"the type '{name}' is not in lower case with hyphens, as 'my-rule' is")
    if getattr(field.annotation, "__args__", None) != (name,):
        raise PropertyError(
            f"any other word passes as its type too: declare it as "
            f'`type: Literal["{name}"] = "{name}"`'
        )


@asked_of(*ALL)
def is_documented(subject: Subject) -> None:
    """The class has a docstring and every parameter a description: the schema shows them, and with
    it every editor."""
    component = type(subject.component)
    if not (component.__dict__.get("__doc__") or "").strip():
        raise PropertyError(f"{component.__name__} has no docstring: say what it computes")
    fields = component.model_fields.items()
    bare = [n for n, f in fields if n != "type" and not (f.description or "").strip()]
    if bare:
        raise PropertyError(
            f"the parameter `{bare[0]}` has no description: write "
            f'`{bare[0]}: ... = Field(..., description="what it is, with units")`'
        )


@asked_of(*ALL)
def is_frozen(subject: Subject) -> None:
    """Its parameters cannot be set after it is made, and it can be hashed: the same component is
    shared by scenes and engines, and told from others by value."""
    component = subject.component
    for name in type(component).model_fields:
        try:
            setattr(component, name, getattr(component, name))
        except ValidationError:
            continue
        raise PropertyError(f"`{name}` can be set: leave `frozen` in `model_config` as it is")
    try:
        same = hash(component) == hash(component.model_copy())
    except TypeError as error:
        raise PropertyError(f"{error}: take tuples for lists and named fields for dicts") from None
    if not same or component != component.model_copy():
        raise PropertyError("a copy of it is not equal to it, or has another hash")


@asked_of(*ALL)
def refuses_unknown_keys(subject: Subject) -> None:
    """A parameter that it does not have is refused, so that a misspelt one is never ignored."""
    given = subject.component.model_dump(by_alias=True) | {"no_such_parameter": 1}
    try:
        type(subject.component).model_validate(given)
    except ValidationError:
        return
    raise PropertyError('it takes any key: leave `extra` in `model_config` at "forbid"')


@asked_of(*ALL)
def survives_json(subject: Subject) -> None:
    """Written as JSON and read again it is equal: every dataset carries its experiment as JSON, and
    is run again from that."""
    component = subject.component
    text = component.model_dump_json(by_alias=True)
    kind = type(component)
    for again in (kind.model_validate_json(text), kind.model_validate(json.loads(text))):
        for name in kind.model_fields:
            before, after = getattr(component, name), getattr(again, name)
            if before != after:
                raise PropertyError(f"`{name}` is {before!r}, and {after!r} after JSON")


@asked_of(*ALL)
def survives_pickling(subject: Subject) -> None:
    """Pickled and unpickled it is equal, so that worker processes can be given it."""
    try:
        again = pickle.loads(pickle.dumps(subject.component))
    except Exception as error:
        raise PropertyError(f"{type(error).__name__}: {error}{_where_from(subject)}") from None
    if again != subject.component:
        raise PropertyError("it is another one after pickling")


def _where_from(subject: Subject) -> str:
    component: type[Component] = type(subject.component)
    local = "<locals>" in component.__qualname__
    importable = inspect.getmodule(component) is not None
    return "; define the class at the top of a module" if local or not importable else ""
