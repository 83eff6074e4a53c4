"""What is asked of the answers of every component: that they follow from the question alone."""

from __future__ import annotations

import inspect
import pickle
import random
import types
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np

from pbdkit.interfaces import (
    Component,
    Diagnostic,
    FollowerRule,
    FractureModel,
    FramePolicy,
)
from pbdkit.testing.question import Arrays, each, flat
from pbdkit.testing.subject import PropertyError, Subject, asked_of

UNUSUAL = 918273645
"""A seed that nobody else takes."""


def differing(one: Arrays, other: Arrays) -> list[str]:
    """The names of the answers that are not the same to the last bit."""
    shared = one.keys() & other.keys()
    return [n for n in one | other if n not in shared or not _same(one[n], other[n])]


def _same(one: Any, other: Any) -> bool:
    a, b = np.asarray(one), np.asarray(other)
    return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind in "fc")


@asked_of(FollowerRule, FractureModel, FramePolicy, Diagnostic, is_needed=True)
def changes_no_input(subject: Subject) -> None:
    """What it is given it leaves as it is: the arrays belong to the state of the run."""
    for question in subject.questions():
        given = each(np.array, question.inputs)
        try:
            with np.errstate(all="ignore"):
                question.ask(**given)
        except ValueError as error:
            if "read-only" not in str(error):
                raise
            raise PropertyError(_written(question.what, "what it is given")) from error
        if names := differing(flat(question.inputs), flat(given)):
            raise PropertyError(_written(question.what, _listed(names)))


def _written(function: str, where: str) -> str:
    return f"`{function}` writes into {where}: make new arrays, `x = x + 1` and not `x += 1`"


@asked_of(is_needed=True)
def remembers_nothing(subject: Subject) -> None:
    """What it was asked before does not matter: whatever must be remembered belongs to the state of
    the run, or a run that is continued would differ from one that was never interrupted."""
    for question, other in zip(subject.questions(0), subject.questions(-1), strict=False):
        before = reached_by(subject.component)
        _, one, again = (question.answer() for _ in range(3))
        other.answer()
        question.answer(lambda v: 10.0 * v if v.dtype.kind == "f" else v.copy())
        later, after = question.answer(), reached_by(subject.component)
        kept = sorted(n for n in before | after if before.get(n) != after.get(n))
        if differing(again, later) and (kept or not differing(one, again)):
            what = f", and keeps {_listed(kept)} from call to call" if kept else ""
            told = f"`{question.what}` answers the same question otherwise after another one"
            raise PropertyError(told + what)


@asked_of(is_needed=True)
def answers_the_same(subject: Subject) -> None:
    """The same question gets the same answer to the last bit, and the generators of random numbers
    that all share stay as they are, so that every run can be repeated."""
    for question in subject.questions():
        kept = random.getstate(), np.random.get_state()
        random.seed(UNUSUAL)
        np.random.seed(UNUSUAL)
        before = _shared_generators()
        names = differing(question.answer(), question.answer())
        after = _shared_generators()
        random.setstate(kept[0])
        np.random.set_state(kept[1])
        if names:
            fault = f"answers the same question otherwise the second time ({_listed(names)})"
            cause = "it draws numbers at random that nobody gave it, or looks at a clock"
            raise PropertyError(f"`{question.what}` {fault}: {cause}")
        if after != before:
            fault = "seeds or uses the generator of random numbers that all share"
            raise PropertyError(f"`{question.what}` {fault}")


def _shared_generators() -> bytes:
    return pickle.dumps((random.getstate(), np.random.get_state()))


def _listed(names: list[str]) -> str:
    shown = ", ".join(f"`{name}`" for name in names[:3])
    return shown + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def reached_by(component: Component) -> dict[str, bytes]:
    """Every value that the component's functions can reach and change, by name, as bytes."""
    return {name: _content(value) for name, value in _reached(component)}


def _reached(component: Component) -> Iterator[tuple[str, Any]]:
    yield "private attributes", dict(component.__pydantic_private__ or {})
    cached = {n for k in type(component).__mro__ for n, v in vars(k).items()
              if isinstance(v, cached_property)}  # fmt: skip
    yield from ((name, value) for name, value in vars(component).items() if name not in cached)
    for owner in type(component).__mro__:
        if owner.__module__.startswith(("pbdkit.interfaces", "pydantic", "builtins", "abc")):
            continue
        for name, value in list(vars(owner).items()):
            if name.startswith(("__", "_abc_", "model_")):
                continue
            function = inspect.unwrap(getattr(value, "__func__", value))
            if isinstance(function, types.FunctionType):
                yield from _of_function(function)
            else:
                yield f"{owner.__name__}.{name}", value


def _of_function(function: types.FunctionType, helpers: bool = True) -> Iterator[tuple[str, Any]]:
    """Globals, closures, defaults and attributes of a function; helpers one call away."""
    yield f"defaults of {function.__name__}", (function.__defaults__, function.__kwdefaults__)
    yield f"attributes of {function.__name__}", vars(function)
    reached = inspect.getclosurevars(function)
    for name, value in {**reached.globals, **reached.nonlocals}.items():
        if not isinstance(value, types.FunctionType):
            yield name, value
        elif helpers and not value.__module__.startswith(("pbdkit.", "numpy")):
            yield from _of_function(value, helpers=False)


def _content(value: Any) -> bytes:
    if isinstance(value, (types.FunctionType, type, types.ModuleType)):
        return b""
    try:
        return pickle.dumps(value)
    except Exception:
        return repr(value).encode()
