"""What a component could keep from one call to the next, as far as it can be seen."""

from __future__ import annotations

import inspect
import pickle
import types
from collections.abc import Iterator
from functools import cached_property
from typing import Any

from pbdkit.interfaces import Component

Kept = dict[str, bytes]


def remembered(component: Component) -> Kept:
    """Every value that the component's functions can reach and change, by name, as bytes."""
    return {name: _content(value) for name, value in _reached(component)}


def changed(before: Kept, after: Kept) -> list[str]:
    """The names of the values that differ."""
    return sorted(n for n in before.keys() | after.keys() if before.get(n) != after.get(n))


def _reached(component: Component) -> Iterator[tuple[str, Any]]:
    yield "private attributes", dict(component.__pydantic_private__ or {})
    cached = {n for k in type(component).__mro__ for n, v in vars(k).items()
              if isinstance(v, cached_property)}  # fmt: skip
    for name, value in vars(component).items():
        if name not in cached:
            yield name, value
    for owner in type(component).__mro__:
        if owner.__module__.startswith(("pbdkit.interfaces", "pydantic", "builtins", "abc")):
            continue
        for name, value in list(vars(owner).items()):
            if name.startswith(("__", "_abc_", "model_")):
                continue
            function = inspect.unwrap(getattr(value, "__func__", value))
            if isinstance(function, types.FunctionType):
                yield from _of_function(function)
            elif not isinstance(value, types.FunctionType):
                yield f"{owner.__name__}.{name}", value


def _of_function(function: types.FunctionType) -> Iterator[tuple[str, Any]]:
    """Globals, closures, defaults and attributes of a function; helpers one call away."""
    yield f"defaults of {function.__name__}", (function.__defaults__, function.__kwdefaults__)
    yield f"attributes of {function.__name__}", vars(function)
    reached = inspect.getclosurevars(function)
    for name, value in {**reached.globals, **reached.nonlocals}.items():
        if isinstance(value, types.FunctionType):
            if not value.__module__.startswith(("pbdkit.", "numpy")):
                yield f"attributes of {value.__name__}", vars(value)
                yield from inspect.getclosurevars(value).globals.items()
        else:
            yield name, value


def _content(value: Any) -> bytes:
    if isinstance(value, (types.FunctionType, type, types.ModuleType)):
        return b""
    try:
        return pickle.dumps(value)
    except Exception:
        return repr(value).encode()
