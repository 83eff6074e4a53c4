"""Base classes of components: validated parameters, and state variables of bonds and particles."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic.errors import PydanticUserError
from pydantic_core import PydanticCustomError

from pbdkit.errors import AnswerError, did_you_mean, printable
from pbdkit.plugin.vector import Vector

Pair = Annotated[tuple[float, float], Field(strict=False)]
"""Type of a pair of numbers (x, y), which is a list of two numbers in an experiment file."""


if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)
UNTYPED = ("model-field-overridden", "model-field-missing-annotation")
"""Codes of the errors of pydantic about attributes without a type."""


class Parameters(ModelMetaclass):
    """Metaclass of models, with messages for attributes without a type."""

    def __new__(
        mcs, name: str, bases: tuple[type, ...], namespace: dict[str, Any], **options: Any
    ) -> Any:
        """Create a class. TypeError is raised if an attribute has no type."""
        try:
            return super().__new__(mcs, name, bases, namespace, **options)
        except PydanticUserError as error:
            attribute = re.search(r"['`](\w+)", error.message)
            if error.code not in UNTYPED or not attribute:
                raise
            word = attribute[1]
        value, kind = repr(namespace.get(word)), type(namespace.get(word)).__name__
        parameter, constant = f"{word}: {kind} = {value}", f"{word}: ClassVar[{kind}] = {value}"
        remedy = f"write `{parameter}` for a parameter, or `{constant}` for a constant of the class"
        if word == "type":
            remedy = f"write `type: Literal[{value}] = {value}`"
        raise TypeError(f"{name}.{word} has no type; {remedy}")


class Strict(BaseModel, metaclass=Parameters):
    """Frozen pydantic model that accepts only finite numbers and known keys.

    Types are not converted: "10", True and 10.0 are not accepted as the integer 10. The message for
    an unknown key contains the most similar known key.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, validate_default=True,
        defer_build=True,  # validators are built on first use
        validate_by_name=False, validate_by_alias=True, serialize_by_alias=True,
    )  # fmt: skip

    _elsewhere: ClassVar[Mapping[str, str]] = {}
    """Hints for keys that belong in another place of the experiment: a map from key to hint."""

    @classmethod
    def key_hint(cls, key: str) -> str:
        """Return a hint for an unknown key, or an empty string."""
        return cls._elsewhere.get(key, "")

    @classmethod
    def known_keys(cls) -> list[str]:
        """Return the keys that an experiment file may contain."""
        return [field.alias or name for name, field in cls.model_fields.items()]

    if not TYPE_CHECKING:  # A type checker reports assignments without it.

        def __setattr__(self, name: str, value: Any) -> None:
            """Set a private attribute. AttributeError is raised for others of a frozen model."""
            is_frozen = self.model_config.get("frozen") and not name.startswith("_")
            if is_frozen and not hasattr(type(self), name) and name not in type(self).model_fields:
                raise AttributeError(
                    f"{type(self).__name__}.{name} cannot be assigned, because components do not "
                    "change; declare a parameter, return constants from a method such as "
                    "`parameters` or `weights`, and declare values that change in a run as state "
                    "variables (`Remembered`)"
                )
            if name in type(self).model_fields and self.model_config.get("frozen"):
                owner = type(self).__name__
                path = name if owner == "Experiment" else f"PART.{name}"
                raise AttributeError(
                    f"{owner}.{name} cannot be assigned, because parameters do not change; "
                    f'experiment.with_settings({{"{path}": {value!r}}}) returns an experiment with '
                    "the new value"
                )
            super().__setattr__(name, value)

    @model_validator(mode="before")
    @classmethod
    def _known_keys_only(cls, data: Any) -> Any:
        unknown = [k for k in data if k not in cls.known_keys()] if isinstance(data, dict) else []
        if unknown:
            keys = [k for k in cls.known_keys() if k != "type"]
            owner = cls.model_fields["type"].default if "type" in cls.model_fields else "here"
            listing = f"known: {', '.join(keys)}" if keys else f"'{owner}' has no parameters"
            hint = did_you_mean(str(unknown[0]), keys)
            if advice := cls.key_hint(str(unknown[0])) or _slip(str(unknown[0])):
                hint = f"; {advice}"
            message = f"unknown key{hint} ({listing})"
            key = printable(str(unknown[0]))
            raise PydanticCustomError("key", "{text}", {"text": message, "key": key})
        return data


def _slip(key: str) -> str:
    """Return a hint for frequent typing errors in keys."""
    name, colon, value = key.partition(":")
    if colon and name and value:
        return f"write a space after the colon: `{name}: {value}`"
    if key.strip().isdecimal():
        return "write decimals with a point instead of a comma, as in 0.3"
    return ""


def _require_type(schema: dict[str, Any]) -> None:
    # `type` has a default in Python, but in a file it selects the component.
    schema["required"] = ["type", *(k for k in schema.get("required", ()) if k != "type")]


class Component(Strict, ABC):
    """Frozen, validated parameters together with the behaviour that depends on them.

    A final class gives `type` a literal default, by which experiments select it::

        class Stiff(pbdkit.FollowerRule):
            type: Literal["stiff"] = "stiff"

    A component does not change during a run; its state variables are part of the state of the run.
    """

    model_config = ConfigDict(json_schema_extra=_require_type)

    type: str = Field(description="Word by which experiments select the component.")

    @classmethod
    def type_name(cls) -> str:
        """Return the `type` by which experiments select this component.

        Returns
        -------
        str
            Default of the field `type`.

        Raises
        ------
        TypeError
            If the class declares none.
        """
        default = cls.model_fields["type"].default
        if not isinstance(default, str):
            raise TypeError(
                f'{cls.__name__} declares no type: add `type: Literal["my-name"] = "my-name"`'
            )
        return default

    def numeric_parameters(self) -> dict[str, float]:
        """Return the numeric and boolean parameters by name, as elementwise functions receive them.

        Returns
        -------
        dict of str to float
            Values by the name of the field.
        """
        values: dict[str, Any] = {name: getattr(self, name) for name in type(self).model_fields}
        return {k: v for k, v in values.items() if isinstance(v, (int, float))}


def as_vector(answer: Any, what: str, like: Any) -> Any:
    """Return the result of the function `what` if it is a vector of the type of `like`.

    Raises
    ------
    AnswerError
        If it is not.
    """
    if type(answer) is not type(like):
        names = ", ".join(type(like)._fields)
        raise AnswerError(
            f"`{what}` returned {_kind(answer)}; return a vector, as "
            f"`pbdkit.plugin.{_kind(like)}({names})`"
        )
    return answer


def as_verdict(answer: Any) -> Any:
    """Return the result of `breaks` if it is boolean.

    Raises
    ------
    AnswerError
        If it is not.
    """
    if (dtype := np.asarray(answer).dtype).kind != "b":
        what = "None" if answer is None else dtype
        raise AnswerError(
            f"`breaks` returned {what}, not booleans; return a comparison, as in `... > c.limit`"
        )
    return answer


def as_values(answer: Any, what: str) -> tuple[Any, ...]:
    """Return the result of a function that returns several values as a tuple.

    Raises
    ------
    AnswerError
        If the result is a single value, for example because the comma of ``(value,)`` is missing.
    """
    if isinstance(answer, Vector) or not isinstance(answer, (tuple, list)):
        raise AnswerError(f"`{what}` returned {_kind(answer)}, not a tuple; write `(value,)`")
    return tuple(answer)


def _kind(answer: Any) -> str:
    return "None" if answer is None else type(answer).__name__


DTYPES = ("f8", "i1", "i2", "i4", "i8")
"""Data types of state variables."""


@dataclass(frozen=True)
class Remembered:
    """State variable: of a fracture model with a value for each bond, or of a rule for each
    particle.

    Parameters
    ----------
    name : str
        Name of the state variable, and of its variable in the dataset.
    long_name, units : str
        Attributes of the variable.
    initial : float
        Initial value, unless the component has random initial values.
    dtype : str
        ``"f8"`` for numbers in the precision of the run, or an integer type.
    changes : bool
        Whether the value can change during the run; a constant value is recorded once.
    recorded : bool
        Whether the state variable is recorded in the dataset.

    Raises
    ------
    ValueError
        If the name is not an identifier, or the type or the initial value is not supported.
    """

    name: str
    long_name: str
    units: str
    initial: float = 0.0
    dtype: str = "f8"
    changes: bool = True
    recorded: bool = True

    def __post_init__(self) -> None:
        name, initial = cast(Any, self.name), cast(Any, self.initial)
        if not isinstance(name, str) or not name.isidentifier():
            raise ValueError(
                f"'{self.name}' is not a valid name of a variable; use letters, digits and _"
            )
        if self.dtype not in DTYPES:
            raise ValueError(
                f"'{self.name}' has the dtype '{self.dtype}'; expected one of {', '.join(DTYPES)}"
            )
        if isinstance(initial, str) or np.ndim(initial):
            raise ValueError(
                f"the initial value of '{self.name}' is {self.initial!r}, not a number; declare "
                f"one number for each component, as {self.name}_x and {self.name}_y"
            )


@dataclass(frozen=True)
class Bonds:
    """Bonds of a scene in the order of the dataset, for random initial values.

    Parameters
    ----------
    ends : array of int, shape (bond, 2)
        Numbers of both particles, lower first.
    shell : array of int, shape (bond,)
        Shell of each bond, from 1.
    rest : array of float, shape (bond, axis)
        Rest offset from the first particle to the second, in lattice units.
    midpoint : array of float, shape (bond, axis)
        Midpoint in the reference configuration, in lattice units.
    """

    ends: NDArray[np.int64]
    shell: NDArray[np.int8]
    rest: NDArray[np.float64]
    midpoint: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.ends)


@dataclass(frozen=True)
class Particles:
    """Particles of the body in the order of their numbers, for random initial values.

    Parameters
    ----------
    number : array of int, shape (particle,)
        Numbers of the particles.
    X : array of float, shape (particle, axis)
        Reference positions, in lattice units.
    """

    number: NDArray[np.int64]
    X: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.number)


Drawn = dict[str, NDArray[Any]]
"""Type of random initial values by the name of the state variable.

State variables that are missing start at their `initial`.
"""


class Remembers(ABC):
    """Component with state variables.

    The state variables of a fracture model have a value for each bond, and its functions receive
    them by name in ``c``. Those of a rule have a value for each particle of the body, and its
    functions receive them in ``here.own``.
    """

    @abstractmethod
    def remembered(self) -> tuple[Remembered, ...]:
        """Return the declarations of the state variables.

        Returns
        -------
        tuple of Remembered
            Declarations. A function that returns new values returns them in this order, without the
            variables that do not change.
        """


class Draws(Remembers):
    """Component with random initial values of state variables."""

    @abstractmethod
    def draw(self, owners: Any, generator: np.random.Generator) -> Drawn:
        """Return random initial values by name.

        Parameters
        ----------
        owners : Bonds or Particles
            `Bonds` for a fracture model, `Particles` for a rule.
        generator : numpy.random.Generator
            Random number generator. Its numbers depend only on the seed of the experiment, and not
            on other random components, the engine or the number of threads.

        Returns
        -------
        dict of str to array, shape (owner,)
            Values by the name of the state variable. State variables that are missing start at
            their `initial`.
        """
