"""The base class of components, its parameters, and numbers that a component remembers for each
bond or each particle.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from pbdkit.errors import did_you_mean, printable
from pbdkit.plugin.vector import Vector

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
            f"`pbdkit.plugin.{_kind(like)}({names})`"
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
    if isinstance(answer, Vector) or not isinstance(answer, (tuple, list)):
        raise AnswerError(f"`{what}` returned {_kind(answer)}, not a tuple: write `(value,)`")
    return tuple(answer)


def _kind(answer: Any) -> str:
    return "None" if answer is None else type(answer).__name__


DTYPES = ("f8", "i1", "i2", "i4", "i8")


@dataclass(frozen=True)
class Remembered:
    """A number that a fracture model keeps for each bond, or a rule for each particle.

    It starts at `initial`, or as the part's `draw` says, is carried from step to step and recorded
    as the variable `name`: at every recorded step where it `changes`, otherwise once, and not at
    all unless `recorded`. `dtype` is "f8", kept in the precision of the run, or an integer's.

    Raises ValueError for a name that is no word or another dtype.
    """

    name: str
    long_name: str
    units: str
    initial: float = 0.0
    dtype: str = "f8"
    changes: bool = True
    recorded: bool = True

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise ValueError(f"'{self.name}' is no name for a variable: letters, digits and _ only")
        if self.dtype not in DTYPES:
            raise ValueError(f"'{self.name}' has the dtype '{self.dtype}', not {', '.join(DTYPES)}")
        if np.ndim(self.initial):
            raise ValueError(
                f"'{self.name}' starts at {self.initial!r}, and is one number: declare one for "
                f"each component, as {self.name}_x and {self.name}_y"
            )


@dataclass(frozen=True)
class Bonds:
    """The bonds of a scene in the order of the dataset, a row a bond, for those who draw.

    `ends` (bond, 2) are the numbers of its particles, lower first; `rest` (bond, axis) is the rest
    offset from that one to the other and `midpoint` (bond, axis) lies between their reference
    positions, both in lattice units; `shell` (bond,) counts from 1.
    """

    ends: NDArray[np.int64]
    shell: NDArray[np.int8]
    rest: NDArray[np.float64]
    midpoint: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.ends)


@dataclass(frozen=True)
class Particles:
    """The particles of the body in the order of their numbers, a row each, for those who draw:
    `number` (particle,) and reference position `X` (particle, axis), lattice units."""

    number: NDArray[np.int64]
    X: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.number)


Drawn = dict[str, NDArray[Any]]
"""Initial values by the name of the number; what is left out starts at its `initial`."""


class Remembers(ABC):
    """A part with numbers of its own: a fracture model's of each bond, seen by name in ``c``, a
    rule's of each particle of the body, seen by name in ``here.own``."""

    @abstractmethod
    def remembered(self) -> tuple[Remembered, ...]:
        """What it remembers."""


class Draws(Remembers):
    """A part whose numbers do not all start at their `initial`."""

    @abstractmethod
    def draw(self, owners: Any, generator: np.random.Generator) -> Drawn:
        """Where they start, (owner,) by name, for `owners`: Bonds of a fracture model, Particles of
        a rule.

        The generator depends on the experiment's `seed` and on nothing else: neither on other
        random parts, nor on engine or threads.
        """
