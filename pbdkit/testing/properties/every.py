"""What is asked of every component before any of its functions is called."""

from __future__ import annotations

import inspect
import json
import pickle
import re
from contextlib import suppress

from pydantic import ValidationError

from pbdkit.testing.subject import PropertyError, Subject, asked_of

WORD = r"[a-z][a-z0-9]*(-[a-z0-9]+)*"


@asked_of()
def names_itself(subject: Subject) -> None:
    """Its `type` is one literal in lower case, words joined by hyphens, so that experiments name
    it, schemas tell it apart and `distribution:type` can be read."""
    component = type(subject.component)
    field, name = component.model_fields["type"], component.type_name()
    if not re.fullmatch(WORD, name):
        raise PropertyError(f"the type '{name}' is not in lower case with hyphens, as 'my-rule' is")
    if getattr(field.annotation, "__args__", None) != (name,):
        remedy = f'declare it as `type: Literal["{name}"] = "{name}"`'
        raise PropertyError(f"any other word passes as its type too: {remedy}")


@asked_of()
def is_documented(subject: Subject) -> None:
    """The class has a docstring and every parameter a description: the schema shows them, and with
    it every editor."""
    component = type(subject.component)
    if not (component.__dict__.get("__doc__") or "").strip():
        raise PropertyError(f"{component.__name__} has no docstring: say what it computes")
    for name, field in component.model_fields.items():
        if name != "type" and not (field.description or "").strip():
            remedy = f'`{name}: ... = Field(..., description="what it is, with units")`'
            raise PropertyError(f"the parameter `{name}` has no description: write {remedy}")


@asked_of()
def is_frozen(subject: Subject) -> None:
    """Its parameters cannot be set after it is made, and it can be hashed: the same component is
    shared by scenes and engines, and told from others by value."""
    component = subject.component
    for name in type(component).model_fields:
        with suppress(ValidationError):
            setattr(component, name, getattr(component, name))
            raise PropertyError(f"`{name}` can be set: leave `frozen` in `model_config` as it is")
    try:
        same = hash(component) == hash(component.model_copy())
    except TypeError as error:
        raise PropertyError(f"{error}: take tuples for lists and named fields for dicts") from None
    if not same or component != component.model_copy():
        raise PropertyError("a copy of it is not equal to it, or has another hash")


@asked_of()
def refuses_unknown_keys(subject: Subject) -> None:
    """A parameter that it does not have is refused, so that a misspelt one is never ignored."""
    given = subject.component.model_dump(by_alias=True) | {"no_such_parameter": 1}
    with suppress(ValidationError):
        type(subject.component).model_validate(given)
        raise PropertyError('it takes any key: leave `extra` in `model_config` at "forbid"')


@asked_of()
def survives_json(subject: Subject) -> None:
    """Written as JSON and read again it is equal: every dataset carries its experiment as JSON, and
    is run again from that."""
    component = subject.component
    text, kind = component.model_dump_json(by_alias=True), type(component)
    for again in (kind.model_validate_json(text), kind.model_validate(json.loads(text))):
        for name in kind.model_fields:
            before, after = getattr(component, name), getattr(again, name)
            if before != after:
                raise PropertyError(f"`{name}` is {before!r}, and {after!r} after JSON")


@asked_of()
def survives_pickling(subject: Subject) -> None:
    """Pickled and unpickled it is equal, so that worker processes can be given it."""
    try:
        again = pickle.loads(pickle.dumps(subject.component))
    except Exception as error:
        kind = type(subject.component)
        importable = inspect.getmodule(kind) is not None and "<locals>" not in kind.__qualname__
        remedy = "" if importable else "; define the class at the top of a module"
        raise PropertyError(f"{type(error).__name__}: {error}{remedy}") from None
    if again != subject.component:
        raise PropertyError("it is another one after pickling")
