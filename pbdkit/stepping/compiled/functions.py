"""Elementwise functions made ready for numba, and the key that tells when they have changed."""

from __future__ import annotations

import hashlib
import inspect
import types
from collections.abc import Callable, Iterator
from typing import Any

import numba
from numba.extending import overload, register_jitable

from pbdkit.interfaces import where

Function = Callable[..., Any]
_ready: set[Function] = {where}


@overload(where)
def _where(condition: Any, yes: Any, no: Any) -> Any:
    # numpy's `where` on single numbers inside numba costs hundreds of times as much.
    def choose(condition: Any, yes: Any, no: Any) -> Any:
        return yes if condition else no

    return choose


def compiled(function: Function) -> Any:
    """The function for numba, with every Python function that it reaches made ready.

    `error_model="numpy"` lets divisions and roots vectorise; fastmath stays off, so that every
    operation rounds as numpy's does.
    """
    for helper in _reached(function):
        if helper is not function and helper not in _ready:
            register_jitable(helper)
            _ready.add(helper)
    return numba.njit(error_model="numpy")(function)


def source_key(*functions: Function) -> str:
    """A digest of the source of these functions and of all that they reach, constants included."""
    digest = hashlib.sha256()
    for function in functions:
        for reached in _reached(function):
            digest.update(_source(reached).encode())
            for name, value in sorted(_names(reached).items()):
                if isinstance(value, (bool, int, float, complex, str, tuple)):
                    digest.update(f"{name}={value!r}".encode())
    return digest.hexdigest()


def _source(function: Function) -> str:
    try:
        return inspect.getsource(function)
    except (OSError, TypeError):  # written where no file is, as at a prompt
        code = function.__code__
        return repr((code.co_code, code.co_consts, code.co_names))


def _reached(function: Function) -> Iterator[Function]:
    """The function and, once each, every Python function that it reaches by name."""
    seen: list[Function] = []
    waiting = [function]
    while waiting:
        here = waiting.pop()
        if here not in seen:
            seen.append(here)
            waiting += [v for v in _names(here).values() if isinstance(v, types.FunctionType)]
    yield from seen


def _names(function: Function) -> dict[str, Any]:
    """What the names in a function stand for: globals, closures, and members of modules."""
    known = inspect.getclosurevars(function)
    found = {**known.globals, **known.nonlocals}
    for module in [v for v in found.values() if isinstance(v, types.ModuleType)]:
        if module.__name__.split(".")[0] not in ("numpy", "math"):
            for name in known.unbound & set(vars(module)):
                found[f"{module.__name__}.{name}"] = getattr(module, name)
    return found
