"""What a part's functions return, told apart from what authors return by mistake."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from pbdkit.interfaces.arithmetic import Vector


class AnswerError(TypeError):
    """A function returned something of another kind; the text says what to return."""


def as_vector(answer: Any, what: str) -> Vector:
    """The answer of the function `what`; AnswerError where it is no vector."""
    if not isinstance(answer, Vector):
        raise AnswerError(f"`{what}` returned {_kind(answer)}: return `pbdkit.Vector(x, y)`")
    return answer


def as_move(answer: Any) -> Any:
    """The answer of a rule's `apply`; AnswerError where it is not two components."""
    if not isinstance(answer, Iterable):
        raise AnswerError(f"`apply` returned {_kind(answer)}, not the move (x, y)")
    if len(components := tuple(answer)) != 2:
        raise AnswerError(
            f"`apply` returned {len(components)} values, not the move (x, y)"
            if isinstance(answer, (tuple, list))
            else f"`apply` returned {_kind(answer)}, not the move (x, y)"
        )
    return answer


def as_verdict(answer: Any) -> Any:
    """The answer of `breaks`; AnswerError where it is neither yes nor no."""
    if (dtype := np.asarray(answer).dtype).kind != "b":
        what = "None" if answer is None else dtype
        raise AnswerError(f"`breaks` returned {what}: compare, as in `... > c[0]`")
    return answer


def as_values(answer: Any, what: str) -> tuple[Any, ...]:
    """The answer of a function that gives any number of values; AnswerError where it is one, as
    where the comma of ``(value,)`` is forgotten."""
    if not isinstance(answer, (tuple, list)):
        raise AnswerError(f"`{what}` returned {_kind(answer)}, not a tuple: write `(value,)`")
    return tuple(answer)


def _kind(answer: Any) -> str:
    return "None" if answer is None else type(answer).__name__
