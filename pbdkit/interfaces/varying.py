"""Parameters that are not one number but differ from place to place."""

from __future__ import annotations

import base64
import binascii
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import PrivateAttr, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from pbdkit.interfaces.component import Component, did_you_mean

Floats = NDArray[np.float64]
Held = Mapping[str, NDArray[np.bool_]]
"""Which places a region holds, by its name, in the order in which the experiment names them."""
RESERVED = ("otherwise", "file", "steps")
"""What no region is called, so that a map tells what it is."""
MOST_IN_WORDS = 1000
"""So many values are written as numbers, more as bytes in base 64."""
MOST_VALUES = 2**24


DEFINITION = "Field"
ABOUT = ("title", "description", "examples", "default")
"""What a schema says of a parameter whatever stands in it."""
SCHEMA = {
    "title": "Field",
    "description": "A value for each place: by region, from a netCDF file, or over a grid.",
    "oneOf": [
        {
            "type": "object",
            "required": ["otherwise"],
            "additionalProperties": {"type": "number"},
        },
        {
            "type": "object",
            "required": ["file", "variable"],
            "properties": {"file": {"type": "string"}, "variable": {"type": "string"}},
            "additionalProperties": False,
        },
        {
            "type": "object",
            "required": ["x", "y", "values"],
            "properties": {
                "x": {"type": "array", "items": {"type": "number"}},
                "y": {"type": "array", "items": {"type": "number"}},
                "values": {"type": ["array", "string"]},
            },
            "additionalProperties": False,
        },
    ],
}
"""The JSON Schema of what a file writes in place of a number."""


class Varying(ABC):
    """What a parameter is, place by place (lattice units)."""

    @property
    @abstractmethod
    def samples(self) -> dict[str, float]:
        """Values that occur, by where, for those who validate; the first serves where one number is
        asked for."""

    @abstractmethod
    def at(self, x: Floats, y: Floats, held: Held, reach: float = 0.0) -> Floats:
        """The values at places of one shape; NaN where there is none. What lies within `reach` of
        a place that has one may have the same."""

    @abstractmethod
    def written(self) -> dict[str, Any]:
        """As an experiment file writes it."""


@dataclass(frozen=True)
class ByRegion(Varying):
    """One value a region, and `otherwise` where none of them holds the place; of several the last
    that the experiment names."""

    otherwise: float
    values: tuple[tuple[str, float], ...]

    @property
    def samples(self) -> dict[str, float]:
        """All."""
        return {"otherwise": self.otherwise, **dict(self.values)}

    def at(self, x: Floats, y: Floats, held: Held, reach: float = 0.0) -> Floats:
        """Region after region."""
        found, values = np.full(np.shape(x), self.otherwise), dict(self.values)
        for name, inside in held.items():
            if name in values:
                found[inside] = values[name]
        return found

    def written(self) -> dict[str, Any]:
        """A value a name."""
        return self.samples


class Gridded(Varying):
    """Values over a grid of places, (x, y), bilinear between; along an axis with one place it is
    constant."""

    def __init__(self, x: Any, y: Any, values: Any) -> None:
        """Raises ValueError for places that do not increase, and for values of another shape or
        that are not finite."""
        self.x, self.y = (np.atleast_1d(np.array(places, float)) for places in (x, y))
        self.values = np.array(values, float)
        for name, places in (("x", self.x), ("y", self.y)):
            if places.ndim != 1 or not len(places) or not (np.diff(places) > 0.0).all():
                raise ValueError(f"{name} should be numbers that increase")
        if self.values.shape != (shape := (len(self.x), len(self.y))):
            raise ValueError(
                f"values should be {shape[0]} lists of {shape[1]} numbers, a list for each x and "
                f"in it a number for each y; their shape is {self.values.shape}"
            )
        if self.values.size > MOST_VALUES:
            raise ValueError(f"{self.values.size} values are more than {MOST_VALUES}")
        if not all(np.isfinite(numbers).all() for numbers in (self.x, self.y, self.values)):
            raise ValueError("places and values should be finite")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Gridded) and all(
            np.array_equal(getattr(self, name), getattr(other, name)) for name in ("x", "y", "values")
        )

    __hash__ = None  # type: ignore[assignment]  # arrays can be long, and nobody asks

    @property
    def samples(self) -> dict[str, float]:
        """The median, the smallest and the largest."""
        ordered = np.sort(self.values, axis=None)
        middle, least, most = (float(ordered[n]) for n in (len(ordered) // 2, 0, -1))
        return {"the median": middle, "the smallest value": least, "the largest value": most}

    def at(self, x: Floats, y: Floats, held: Held, reach: float = 0.0) -> Floats:
        """Bilinear (scipy)."""
        from scipy.interpolate import RegularGridInterpolator

        grid, values, places = [], self.values, []
        for axis, (known, wanted) in enumerate(((self.x, x), (self.y, y))):
            if len(known) == 1:
                values = np.repeat(values, 2, axis=axis)
                grid.append(np.array([0.0, 1.0]))
                places.append(np.zeros(np.shape(wanted)))
                continue
            slack = reach + 1e-9 * (known[-1] - known[0])
            near = (wanted >= known[0] - slack) & (wanted <= known[-1] + slack)
            grid.append(known)
            places.append(np.where(near, np.clip(wanted, known[0], known[-1]), np.nan))
        look = RegularGridInterpolator(grid, values, bounds_error=False)
        found: Floats = look(np.stack(places, axis=-1))
        return found

    def written(self) -> dict[str, Any]:
        """Numbers, or bytes where they are many."""
        few = self.values.size <= MOST_IN_WORDS
        packed = base64.b64encode(self.values.astype("<f8").tobytes()).decode()
        return {
            "x": self.x.tolist(),
            "y": self.y.tolist(),
            "values": self.values.tolist() if few else packed,
        }


@dataclass(frozen=True)
class OfPlace(Varying):
    """A function of arrays x and y. An experiment keeps its values at the places of a grid, so that
    its dataset says all; see `sampled`."""

    function: Callable[[Floats, Floats], Any]

    @property
    def samples(self) -> dict[str, float]:
        """The value at (0, 0)."""
        return {"(0, 0)": float(self.function(np.zeros(1), np.zeros(1))[0])}

    def at(self, x: Floats, y: Floats, held: Held, reach: float = 0.0) -> Floats:
        """The function's."""
        return np.broadcast_to(np.asarray(self.function(x, y), float), np.shape(x))

    def written(self) -> dict[str, Any]:
        """Nothing that could be read again."""
        return {}

    def sampled(self, x: Floats, y: Floats) -> Gridded:
        """Its values over a grid."""
        return Gridded(x, y, self.at(*np.meshgrid(x, y, indexing="ij"), {}))


def as_varying(given: Any) -> Varying | None:
    """What stands in place of a number, if that is no number.

    Raises ValueError for a map that is none of the forms.
    """
    if isinstance(given, Varying):
        return given
    if hasattr(given, "coords") and hasattr(given, "transpose"):  # xarray's DataArray
        if set(given.dims) != {"x", "y"}:
            raise ValueError(f"an array should have the dimensions x and y, got {given.dims}")
        return Gridded(given["x"], given["y"], given.transpose("x", "y"))
    if callable(given):
        return OfPlace(given)
    if not isinstance(given, dict):
        return None
    if "otherwise" in given:
        return _by_region(given)
    if given.keys() == {"x", "y", "values"}:
        return Gridded(given["x"], given["y"], _unpacked(given))
    raise ValueError(
        "should be a number, {otherwise: number, REGION: number}, {file: NAME.nc, variable: NAME}, "
        f"or {{x: [...], y: [...], values: [[...]]}}; got a map of {', '.join(map(str, given))}"
    )


def _by_region(given: dict[str, Any]) -> ByRegion:
    for name, value in given.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ValueError(f"'{name}' should be a number, got {value!r:.40}")
    values = {name: float(value) for name, value in given.items()}
    return ByRegion(values.pop("otherwise"), tuple(values.items()))


def _unpacked(given: dict[str, Any]) -> Any:
    values = given["values"]
    if not isinstance(values, str):
        return values
    try:
        numbers = np.frombuffer(base64.b64decode(values, validate=True), "<f8")
        return numbers.reshape(len(given["x"]), len(given["y"]))
    except (binascii.Error, TypeError, ValueError):
        raise ValueError("values are no numbers: bytes in base 64 of as many as x and y") from None


class TakesFields(Component):
    """A component whose numbers may differ from place to place.

    Each stands in its field with the value that serves where one number is asked for; what it is
    elsewhere, `varying` tells.
    """

    _varying: dict[str, Varying] = PrivateAttr(default_factory=dict)

    @property
    def varying(self) -> Mapping[str, Varying]:
        """The parameters that differ from place to place."""
        return self._varying

    def with_values(self, **values: Any) -> Any:
        """The component with other numbers, or fields, in place of its own; what is not given is
        the same everywhere. Raises ValidationError where they do not go together."""
        fields = type(self).model_fields.items()
        given = {field.alias or name: getattr(self, name) for name, field in fields}
        return type(self).model_validate(given | values)

    @model_validator(mode="wrap")
    @classmethod
    def _with_fields(cls, data: Any, handler: Any) -> Any:
        if not isinstance(data, dict):
            return handler(data)
        varying = {}
        for name in cls.numbers() & data.keys():
            try:
                found = as_varying(data[name])
            except ValueError as error:
                raise _fault(name, str(error)) from None
            if found:
                varying[name] = found
        if varying:
            cls._refuse_wrong(data, varying)
        part = handler(data | {name: _first(field) for name, field in varying.items()})
        part._varying = varying
        return part

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: Any, handler: Any) -> dict[str, Any]:
        """Numbers, or fields in their place."""
        schema: dict[str, Any] = handler(core_schema)
        known = handler.resolve_ref_schema(schema).get("properties", {})
        for name in cls.numbers() & known.keys():
            about = {k: v for k, v in known[name].items() if k in ABOUT}
            number = {k: v for k, v in known[name].items() if k not in ABOUT}
            known[name] = about | {"anyOf": [number, {"$ref": f"#/$defs/{DEFINITION}"}]}
        return schema

    @classmethod
    def numbers(cls) -> set[str]:
        """The parameters that can differ from place to place."""
        return {name for name, field in cls.model_fields.items() if field.annotation is float}

    @classmethod
    def _refuse_wrong(cls, data: dict[str, Any], varying: dict[str, Varying]) -> None:
        """Validates with the values of each place that is told apart."""
        for label in dict.fromkeys(label for field in varying.values() for label in field.samples):
            here = {n: field.samples.get(label, _first(field)) for n, field in varying.items()}
            try:
                cls.model_validate(data | here)
            except ValidationError as error:
                for fault in error.errors(include_url=False):
                    name = next((w for w in fault["loc"] if w in here), None)
                    if name or not fault["loc"]:  # else it is about another parameter
                        text = fault["msg"].removeprefix("Value error, ")
                        text = text.replace("Input should", "should")
                        got = f", got {here[name]:g}" if name else ""
                        raise _fault(str(name or min(here)), f"{label}: {text}{got}") from None


def _first(field: Varying) -> float:
    return next(iter(field.samples.values()))


def _fault(name: str, text: str) -> PydanticCustomError:
    return PydanticCustomError("fault", "{text}", {"text": text, "key": name})


def unknown_regions(part: TakesFields, regions: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The parameters whose fields name regions that there are not, each with a message."""
    for name, field in part.varying.items():
        for region, _ in field.values if isinstance(field, ByRegion) else ():
            if region not in regions:
                known = f"known: {', '.join(regions)}" if regions else "there is none: add `regions`"
                yield name, f"there is no region '{region}'{did_you_mean(region, regions)} ({known})"
