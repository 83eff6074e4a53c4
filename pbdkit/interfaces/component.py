"""What every component is, and what its functions may return."""

from __future__ import annotations

from abc import ABC
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from pbdkit.errors import did_you_mean, printable
from pbdkit.interfaces.vector import Components

Pair = Annotated[tuple[float, float], Field(strict=False)]
"""Two numbers, (x, y); an experiment file writes them as a list of two."""


class Strict(BaseModel):
    """A frozen model that takes finite numbers, known keys and nothing else.

    "10", True and 10.0 are not the integer 10, and an unknown key is answered with the nearest
    right one.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, validate_default=True,
        defer_build=True,  # of what nobody uses here nothing is built
        validate_by_name=False, validate_by_alias=True, serialize_by_alias=True,
    )  # fmt: skip

    _elsewhere: ClassVar[Mapping[str, str]] = {}
    """Keys that are looked for here, and what says the same."""

    @classmethod
    def found_elsewhere(cls, key: str) -> str:
        """Return what to write in place of a key that is not known here; empty where there is
        nothing."""
        return cls._elsewhere.get(key, "")

    @classmethod
    def known_keys(cls) -> list[str]:
        """The keys that an experiment may write here."""
        return [field.alias or name for name, field in cls.model_fields.items()]

    @model_validator(mode="before")
    @classmethod
    def _known_keys_only(cls, data: Any) -> Any:
        unknown = [k for k in data if k not in cls.known_keys()] if isinstance(data, dict) else []
        if unknown:
            known = [k for k in cls.known_keys() if k != "type"]
            whose = cls.model_fields["type"].default if "type" in cls.model_fields else "here"
            taken = f"known: {', '.join(known)}" if known else f"'{whose}' takes nothing"
            hint = did_you_mean(str(unknown[0]), known)
            if told := cls.found_elsewhere(str(unknown[0])) or _slip(str(unknown[0])):
                hint = f"; {told}"
            message = f"unknown key{hint} ({taken})"
            key = printable(str(unknown[0]))
            raise PydanticCustomError("key", "{text}", {"text": message, "key": key})
        return data


def _slip(key: str) -> str:
    """What is frequently meant by a key that cannot be one."""
    name, colon, value = key.partition(":")
    if colon and name and value:
        return f"write a space after the colon: `{name}: {value}`"
    if key.strip().isdecimal():
        return "decimals have a point and no comma, as in 0.3"
    return ""


def _require_type(schema: dict[str, Any]) -> None:
    # `type` has a default in Python, but a file tells the components apart by it.
    schema["required"] = ["type", *(k for k in schema.get("required", ()) if k != "type")]


class Component(Strict, ABC):
    """A frozen, validated set of parameters together with the behaviour that they drive.

    A final class gives `type` a literal default and is told from its siblings by it::

        class Stiff(pbdkit.FollowerRule):
            type: Literal["stiff"] = "stiff"

    A component holds no run state: what it must remember travels in the state of the stepper.
    """

    model_config = ConfigDict(json_schema_extra=_require_type)

    type: str

    @classmethod
    def type_name(cls) -> str:
        """The `type` by which experiments name this component; TypeError if it declares none."""
        default = cls.model_fields["type"].default
        if not isinstance(default, str):
            raise TypeError(
                f'{cls.__name__} does not name its type: add `type: Literal["my-name"] = "my-name"`'
            )
        return default

    def numeric_parameters(self) -> dict[str, float]:
        """The parameters that are numbers or switches, as they reach elementwise functions."""
        values: dict[str, Any] = {name: getattr(self, name) for name in type(self).model_fields}
        return {k: v for k, v in values.items() if isinstance(v, (int, float))}


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
