"""Elementwise functions made ready for numba, and the key that tells when they have changed."""

from __future__ import annotations

import hashlib
import inspect
import operator
import types
import uuid
from collections.abc import Callable
from functools import cache
from itertools import chain
from typing import Any

import numba
import numpy as np
from numba.extending import overload, register_jitable

from pbdkit.interfaces import dot, where
from pbdkit.interfaces.vector import Components

Function = Callable[..., Any]
_ready: set[Function] = {where, dot}


def _is_vector(kind: Any) -> bool:
    return issubclass(getattr(kind, "instance_class", object), Components)


def _written(kind: Any, arguments: str, component: str, whole: str = "Vector({})") -> Any:
    """A function of vectors, written out for their components: `component` with `@` for each."""
    names = kind.instance_class._fields
    parts = [component.replace("@", name) for name in names]
    scope: dict[str, Any] = {"Vector": kind.instance_class}
    function = eval(f"lambda {arguments}: {whole.format(', '.join(parts))}", scope)
    # numba wants the signature of the function that is overloaded, annotations included.
    function.__annotations__ = dict.fromkeys([*arguments.split(", "), "return"], "Any")
    return function


@overload(where)
def _where(condition: Any, yes: Any, no: Any) -> Any:
    # numpy's `where` on single numbers inside numba costs hundreds of times as much.
    if _is_vector(yes):
        return _written(yes, "condition, yes, no", "yes.@ if condition else no.@")

    def choose(condition: Any, yes: Any, no: Any) -> Any:
        return yes if condition else no

    return choose


@overload(dot)
def _dot(a: Any, b: Any) -> Any:
    products = " + ".join(f"a.{name} * b.{name}" for name in a.instance_class._fields)
    return _written(a, "a, b", "", products)


@overload(operator.neg)
def _neg(a: Any) -> Any:
    return _written(a, "a", "-a.@") if _is_vector(a) else None


def _arithmetic(sign: str) -> Function:
    """An operation on two vectors, or on a vector and a number."""

    def overloaded(a: Any, b: Any) -> Any:
        one, other = _is_vector(a), _is_vector(b)
        term = f"a{'.@' * one} {sign} b{'.@' * other}"
        return _written(a if one else b, "a, b", term) if one or other else None

    return overloaded


for _operation, _sign in (("add", "+"), ("sub", "-"), ("mul", "*"), ("truediv", "/")):
    overload(getattr(operator, _operation))(_arithmetic(_sign))


def compiled(function: Function) -> Any:
    """The function for numba, with every Python function that it reaches made ready.

    `error_model="numpy"` lets divisions and roots vectorise; fastmath stays off, so that every
    operation rounds as numpy's does.
    """
    return numba.njit(error_model="numpy")(with_helpers_ready(function))


def with_helpers_ready(function: Function) -> Function:
    """The same, of which numba can compile every Python function that it reaches."""
    for helper in _reached(function):
        if helper is not function and helper not in _ready:
            register_jitable(helper)
            _ready.add(helper)
    return function


def source_key(*functions: Function) -> str:
    """A digest of the source of these functions and of all that they reach, constants included.

    Where they stand counts too: a kernel that is kept finds its functions by their modules.
    What a function reads and cannot be told apart by its value gets a key of its own every time,
    so that a kernel is rather made anew than out of date.
    """
    digest = hashlib.sha256()
    for reached in chain.from_iterable(map(_reached, functions)):
        found = sorted(_names(reached).items())
        parts = [reached.__module__, reached.__qualname__, _source(reached.__code__)]
        parts.append(repr((reached.__defaults__, reached.__kwdefaults__)))
        parts += [f"{name}={_content(value)}" for name, value in found]
        digest.update("\n".join(parts).encode())
    return digest.hexdigest()


def _content(value: Any) -> str:
    if isinstance(value, (bool, int, float, complex, str, tuple, type(None))):
        return repr(value)
    if isinstance(value, (np.ndarray, np.generic)):
        return f"{value.dtype} {value.shape} {value.tobytes().hex()}"
    if isinstance(value, (types.FunctionType, types.BuiltinFunctionType, type, np.ufunc)):
        return getattr(value, "__qualname__", repr(value))
    if isinstance(value, types.ModuleType) or hasattr(value, "py_func"):
        return type(value).__name__
    return uuid.uuid4().hex


@cache
def _source(code: types.CodeType) -> str:
    try:
        return inspect.getsource(code)
    except (OSError, TypeError):  # written where no file is, as at a prompt
        return repr((code.co_code, code.co_consts, code.co_names))


def _reached(function: Function) -> list[Function]:
    """The function and, once each, every Python function that it reaches by name."""
    found = [function]
    for here in found:
        for value in _names(here).values():
            reached = getattr(value, "py_func", value)
            if isinstance(reached, types.FunctionType) and reached not in found:
                found.append(reached)
    return found


def _names(function: Function) -> dict[str, Any]:
    """What the names in a function, and in functions inside it, stand for: globals, closures, and
    members of modules."""
    codes = [function.__code__]
    for code in codes:
        codes += [c for c in code.co_consts if isinstance(c, types.CodeType)]
    # Sorted, since the order of a set differs from process to process.
    names = sorted({name for code in codes for name in code.co_names})
    found = {n: function.__globals__[n] for n in names if n in function.__globals__}
    found |= inspect.getclosurevars(function).nonlocals
    modules = [v for v in found.values() if isinstance(v, types.ModuleType)]
    for module in modules:
        if module.__name__.split(".")[0] not in ("numpy", "math", "numba"):
            # pbdkit's own are loaded when first used.
            members = {name: getattr(module, name) for name in names if hasattr(module, name)}
            found |= {f"{module.__name__}.{name}": value for name, value in members.items()}
            modules += [v for v in members.values() if isinstance(v, types.ModuleType)]
    return found
