"""What a part's functions return, told apart from what authors return by mistake."""

from __future__ import annotations

from typing import Any

import numpy as np

from pbdkit.interfaces.vector import Components


class AnswerError(TypeError):
    """A function returned something of another kind; the text says what to return."""


def as_vector(answer: Any, what: str, like: Any) -> Any:
    """The answer of the function `what`; AnswerError where it is no vector of as many components as
    another."""
    if type(answer) is not type(like):
        names = ", ".join(type(like)._fields)
        raise AnswerError(
            f"`{what}` returned {_kind(answer)}: return a vector, as "
            f"`pbdkit.{_kind(like)}({names})`"
        )
    return answer


def as_verdict(answer: Any) -> Any:
    """The answer of `breaks`; AnswerError where it is neither yes nor no."""
    if (dtype := np.asarray(answer).dtype).kind != "b":
        what = "None" if answer is None else dtype
        raise AnswerError(f"`breaks` returned {what}: compare, as in `... > c.limit`")
    return answer


def as_values(answer: Any, what: str) -> tuple[Any, ...]:
    """The answer of a function that gives any number of values; AnswerError where it is one, as
    where the comma of ``(value,)`` is forgotten."""
    if isinstance(answer, Components) or not isinstance(answer, (tuple, list)):
        raise AnswerError(f"`{what}` returned {_kind(answer)}, not a tuple: write `(value,)`")
    return tuple(answer)


def _kind(answer: Any) -> str:
    return "None" if answer is None else type(answer).__name__
