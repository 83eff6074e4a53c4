"""Parameters that vary in space or time.

A parameter is given by values for regions, by a function of position, by values on a grid, as a
random field, or as a function of time.
"""

from __future__ import annotations

import base64
import binascii
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Set
from dataclasses import dataclass
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    ConfigDict,
    Field as ModelField,
    PrivateAttr,
    RootModel,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import PydanticCustomError, core_schema

from pbdkit.array_types import Floats
from pbdkit.errors import did_you_mean
from pbdkit.plugin.component import Component, Strict
from pbdkit.plugin.schedule import TimeDependent, as_time_dependent
from pbdkit.plugin.units import LENGTH, PATTERN, Quantity, number_or_text
from pbdkit.seeds import random_field_seed

Held = Mapping[str, NDArray[np.bool_]]
"""Type of a map from each region to the mask of the places inside it, in the order of the
experiment."""
MAX_TEXT_VALUES = 1000
"""Maximum number of values that are written as numbers.

More values are written as bytes in base 64.
"""
MAX_VALUES = 2**24
"""Maximum number of values on a grid."""


class Varying(ABC):
    """Spatially varying parameter (lattice units)."""

    @property
    @abstractmethod
    def samples(self) -> dict[str, float]:
        """Values for validation, by a description of their place.

        The first value is used where a single number is required.
        """

    @abstractmethod
    def at(self, x: Floats, y: Floats, regions: Held, reach: float = 0.0) -> Floats:
        """Return the values at places.

        Parameters
        ----------
        x, y
            Coordinates of the places, of one shape.
        regions
            Masks of the places inside each region.
        reach
            Maximum distance from the data within which a place outside the data has the nearest
            value.

        Returns
        -------
        NDArray
            Values in the shape of the places; NaN at places without a value.
        """

    @abstractmethod
    def written(self) -> dict[str, Any]:
        """Return the parameter as it is written in an experiment file."""


@dataclass(frozen=True)
class ByRegion(Varying):
    """One value for each region, and `otherwise` outside all regions.

    Where regions overlap, the value of the last one in the experiment is used.
    """

    otherwise: float
    values: tuple[tuple[str, float], ...]

    @property
    def samples(self) -> dict[str, float]:
        """Values by region, with `otherwise`."""
        return {"otherwise": self.otherwise, **dict(self.values)}

    def at(self, x: Floats, y: Floats, regions: Held, reach: float = 0.0) -> Floats:
        """Return the values at places, by region."""
        result, values = np.full(np.shape(x), self.otherwise), dict(self.values)
        for name, inside in regions.items():
            if name in values:
                result[inside] = values[name]
        return result

    def written(self) -> dict[str, Any]:
        """Return the values by region."""
        return self.samples


class Gridded(Varying):
    """Values on a grid (x, y) with bilinear interpolation.

    The parameter is constant along an axis with only one coordinate.

    Parameters
    ----------
    x, y
        Coordinates, in increasing order.
    values
        Values, (x, y).

    Raises
    ------
    ValueError
        If coordinates do not increase, the shapes of coordinates and values differ, or a number is
        not finite.
    """

    def __init__(self, x: Any, y: Any, values: Any) -> None:
        self.x, self.y = (np.atleast_1d(np.array(places, float)) for places in (x, y))
        self.values = np.array(values, float)
        for name, places in (("x", self.x), ("y", self.y)):
            if places.ndim != 1 or not len(places) or not (np.diff(places) > 0.0).all():
                raise ValueError(f"{name} should be increasing numbers")
        if self.values.shape != (shape := (len(self.x), len(self.y))):
            raise ValueError(
                f"values should be {shape[0]} lists of {shape[1]} numbers, a list for each x with "
                f"a number for each y; their shape is {self.values.shape}"
            )
        if self.values.size > MAX_VALUES:
            raise ValueError(f"{self.values.size} values exceed {MAX_VALUES}; use a coarser grid")
        if not all(np.isfinite(numbers).all() for numbers in (self.x, self.y, self.values)):
            raise ValueError("coordinates and values should be finite")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Gridded) and all(
            np.array_equal(getattr(self, name), getattr(other, name))
            for name in ("x", "y", "values")
        )

    @property
    def samples(self) -> dict[str, float]:
        """Median, minimum and maximum of the values."""
        ordered = np.sort(self.values, axis=None)
        middle, smallest, largest = (float(ordered[n]) for n in (len(ordered) // 2, 0, -1))
        return {"the median": middle, "the smallest value": smallest, "the largest value": largest}

    def at(self, x: Floats, y: Floats, regions: Held, reach: float = 0.0) -> Floats:
        """Return the values at places by bilinear interpolation."""
        from scipy.interpolate import RegularGridInterpolator

        grid, values, places = [], self.values, []
        for axis, (nodes, target) in enumerate(((self.x, x), (self.y, y))):
            if len(nodes) == 1:
                values = np.repeat(values, 2, axis=axis)
                grid.append(np.array([0.0, 1.0]))
                places.append(np.zeros(np.shape(target)))
                continue
            slack = reach + 1e-9 * (nodes[-1] - nodes[0])
            near = (target >= nodes[0] - slack) & (target <= nodes[-1] + slack)
            grid.append(nodes)
            places.append(np.where(near, np.clip(target, nodes[0], nodes[-1]), np.nan))
        interpolate = RegularGridInterpolator(grid, values, bounds_error=False)
        result: Floats = interpolate(np.stack(places, axis=-1))
        return result

    def written(self) -> dict[str, Any]:
        """Return coordinates and values; more than `MAX_TEXT_VALUES` values are bytes in base
        64."""
        is_text = self.values.size <= MAX_TEXT_VALUES
        packed = base64.b64encode(self.values.astype("<f8").tobytes()).decode()
        return {
            "x": self.x.tolist(),
            "y": self.y.tolist(),
            "values": self.values.tolist() if is_text else packed,
        }


@dataclass(frozen=True)
class PositionFunction(Varying):
    """Function of arrays x and y.

    An experiment replaces the function by its values on a grid, so that the dataset contains the
    whole experiment; see `sampled`.
    """

    function: Callable[[Floats, Floats], Any]

    @property
    def samples(self) -> dict[str, float]:
        """Value at (0, 0)."""
        return {"(0, 0)": float(self.function(np.zeros(1), np.zeros(1))[0])}

    def at(self, x: Floats, y: Floats, regions: Held, reach: float = 0.0) -> Floats:
        """Return the values of the function at places."""
        return np.broadcast_to(np.asarray(self.function(x, y), float), np.shape(x))

    def written(self) -> dict[str, Any]:
        """Return an empty map: a function cannot be written to a file."""
        return {}

    def sampled(self, x: Floats, y: Floats) -> Gridded:
        """Return the values of the function on a grid."""
        return Gridded(x, y, self.at(*np.meshgrid(x, y, indexing="ij"), {}))


def as_varying(value: Any) -> Varying | None:
    """Return a value as a spatially varying parameter, or None if it is a number.

    Raises
    ------
    ValueError
        If it is a map of an unknown form.
    """
    if isinstance(value, Varying):
        return value
    if hasattr(value, "coords") and hasattr(value, "transpose"):  # xarray's DataArray
        if set(value.dims) != {"x", "y"}:
            raise ValueError(f"an array should have the dimensions x and y, got {value.dims}")
        return Gridded(value["x"], value["y"], value.transpose("x", "y"))
    if callable(value):
        return PositionFunction(value)
    if not isinstance(value, dict):
        return None
    if "otherwise" in value:
        return _by_region(value)
    random_keys = value.keys() & {"mean", "scatter", "correlation_length"}
    if (
        value
        and not random_keys
        and all(isinstance(number, (int, float)) for number in value.values())
    ):
        raise ValueError("`otherwise` is missing; it is the value outside these regions")
    if value.keys() == {"x", "y", "values"}:
        return Gridded(value["x"], value["y"], _unpacked(value))
    raise ValueError(
        "should be a number, {otherwise: number, REGION: number}, {file: NAME.nc, variable: NAME}, "
        "{steps: [...], values: [...]}, "
        "{mean: number, scatter: number, correlation_length: number}, "
        f"or {{x: [...], y: [...], values: [[...]]}}; got a map of {', '.join(map(str, value))}"
    )


def _by_region(data: dict[str, Any]) -> ByRegion:
    for name, value in data.items():
        if isinstance(value, dict):
            raise ValueError(
                f"'{name}' should be a number: values by region cannot vary in space or time"
            )
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ValueError(f"'{name}' should be a number, got {value!r:.40}")
    values = {name: float(value) for name, value in data.items()}
    return ByRegion(values.pop("otherwise"), tuple(values.items()))


def _unpacked(data: dict[str, Any]) -> Any:
    values = data["values"]
    if not isinstance(values, str):
        return values
    try:
        numbers = np.frombuffer(base64.b64decode(values, validate=True), "<f8")
        return numbers.reshape(len(data["x"]), len(data["y"]))
    except (binascii.Error, TypeError, ValueError):
        text = "values should be numbers, or bytes in base 64 of one number for each x and y"
        raise ValueError(text) from None


MAX_RANDOM_VALUES = 2**22
"""Maximum number of values of a random field. This number of values takes minutes to compute."""
COORDINATE_RTOL = 1e-9
"""Relative difference up to which the coordinates of two grids are considered equal."""


class Drawn(Strict):
    """Values of a random field on a grid, with the parameters and the seed that generated them."""

    seed: Annotated[int, ModelField(ge=0)]
    mean: float
    scatter: float
    correlation_length: float
    x: Any
    y: Any
    values: Any

    _grid: Gridded = PrivateAttr()

    @model_validator(mode="after")
    def _gridded(self) -> Self:
        grid = as_varying({"x": self.x, "y": self.y, "values": self.values})
        assert isinstance(grid, Gridded)
        self._grid = grid
        return self

    @property
    def grid(self) -> Gridded:
        """Values on the grid."""
        return self._grid

    def matches(self, parameters: Mapping[str, float], x: Floats, y: Floats) -> bool:
        """Return whether the values were generated with the given parameters on the given
        coordinates."""
        if any(getattr(self, name) != number for name, number in parameters.items()):
            return False
        pairs = (self._grid.x, x), (self._grid.y, y)
        return all(
            len(nodes) == len(target)
            and np.allclose(nodes, target, COORDINATE_RTOL, COORDINATE_RTOL * np.ptp(target))
            for nodes, target in pairs
        )


class RandomField(Strict, Varying):
    """Lognormal random field with a given mean.

    The standard deviation is `scatter` times the mean, and all values are positive. The seed is
    that of the experiment. The field is Z = mean · exp(σ g - σ²/2) with σ² = ln(1 + scatter²). Here
    g is a standard Gaussian field; its covariance at two points with the distance r is
    exp(-(r/correlation_length)²). g is a sum of waves with random wave vectors, computed by the
    randomisation method (Heße et al., Environ. Model. Softw. 55 (2014) 32-48) of GSTools. It
    depends only on the position, and not on the lattice constant or the body.
    """

    mean: Annotated[float, ModelField(gt=0.0, le=1e100)]
    scatter: Annotated[float, ModelField(gt=0.0, lt=1.0)]
    correlation_length: Annotated[float, ModelField(gt=1e-100, le=1e100), LENGTH]
    drawn: Drawn | None = None
    """Values on a grid.

    They are computed again if they do not match the parameters and the grid.
    """

    @property
    def samples(self) -> dict[str, float]:
        """Values for validation: the values on the grid or, before these are generated, the
        mean."""
        return self.drawn.grid.samples if self.drawn else {"the mean": self.mean}

    def at(self, x: Floats, y: Floats, regions: Held, reach: float = 0.0) -> Floats:
        """Return the values at places or, before values are generated, the mean."""
        if self.drawn is None:
            return np.full(np.shape(x), self.mean)
        return self.drawn.grid.at(x, y, regions, reach)

    def written(self) -> dict[str, Any]:
        """Return the parameters and the values."""
        return self.model_dump(mode="json", exclude_none=True)

    def drawn_at(self, x: Floats, y: Floats, seed: int, stream: str) -> RandomField:
        """Return the field with its values on a grid.

        All fields of one stream use the same random waves, with the correlation length of each
        field.

        Parameters
        ----------
        x, y
            Coordinates of the grid.
        seed
            Seed of the experiment.
        stream
            Name of the stream of random numbers.

        Raises
        ------
        ValueError
            If the grid has too many points, or GSTools is not installed.
        """
        parameters = self.model_dump(exclude={"drawn"}) | {"seed": seed}
        if self.drawn and self.drawn.matches(parameters, x, y):
            return self
        sigma = np.sqrt(np.log1p(self.scatter**2))
        g = _standard(x, y, self.correlation_length, seed, stream)
        grid = Gridded(x, y, self.mean * np.exp(sigma * g - sigma**2 / 2))
        drawn = Drawn.model_validate(parameters | grid.written())
        return self.model_copy(update={"drawn": drawn})


def _standard(x: Floats, y: Floats, length: float, seed: int, stream: str) -> Floats:
    """Return the standard Gaussian field g on a grid."""
    if len(x) * len(y) > MAX_RANDOM_VALUES:
        raise ValueError(
            f"{len(x) * len(y)} values exceed {MAX_RANDOM_VALUES}, the maximum for random fields; "
            "generate it on a coarser grid, and read it by {file: NAME.nc, variable: NAME}"
        )
    try:
        import gstools
    except ImportError:
        raise ValueError("random fields require GSTools: pip install 'pbdkit[random]'") from None
    model = gstools.Gaussian(dim=2, len_scale=length, rescale=1.0)
    waves = gstools.SRF(model, seed=random_field_seed(seed, stream))
    return np.asarray(waves.structured((x, y), store=False))


class _RandomFields(RootModel[dict[str, RandomField]]):
    """Random fields by name; the name is part of the path in messages of errors."""

    model_config = ConfigDict(defer_build=True)


def random_fields(data: Mapping[str, Any], names: Set[str], context: Any) -> dict[str, RandomField]:
    """Return the parameters that are random fields.

    Parameters
    ----------
    data
        Raw parameters.
    names
        Names of the parameters that can vary.
    context
        Validation context.

    Raises
    ------
    ValidationError
        If a random field is invalid.
    """
    fields = {name: data[name] for name in names & data.keys() if _is_random(data[name])}
    return _RandomFields.model_validate(fields, context=context).root if fields else {}


def _is_random(value: Any) -> bool:
    keys = value.keys() if isinstance(value, dict) else set[str]()
    return "otherwise" not in keys and not keys.isdisjoint(RandomField.model_fields)


RESERVED = ("otherwise", "file", "steps")
"""Names that regions cannot have, because they are keys by which the form of a map is
recognised."""
ABOUT = ("title", "description", "examples", "default")
"""Keys of a JSON Schema that describe a parameter of any form."""
ALTERNATIVES: dict[str, Any] = {
    "oneOf": [
        {
            "type": "object",
            "required": ["otherwise"],
            "additionalProperties": number_or_text({"type": "number"}),
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
        {
            "type": "object",
            "required": ["steps", "values"],
            "properties": {
                "steps": {"type": "array", "items": {"type": "integer", "minimum": 0}},
                "values": {"type": "array", "items": number_or_text({"type": "number"})},
            },
            "additionalProperties": False,
        },
        {
            "type": "object",
            "required": ["mean", "scatter", "correlation_length"],
            "properties": {
                "mean": {"type": "number", "exclusiveMinimum": 0},
                "scatter": {"type": "number", "exclusiveMinimum": 0, "exclusiveMaximum": 1},
                "correlation_length": {
                    "anyOf": [
                        {"type": "number", "exclusiveMinimum": 0},
                        {"type": "string", "pattern": PATTERN},
                    ]
                },
                "drawn": {"type": "object"},
            },
            "additionalProperties": False,
        },
    ],
}
"""JSON Schema of the values that can replace a number."""


class Field(RootModel[Any]):
    """Value for each place (by region, from a file, on a grid, or random), or for each step."""

    model_config = ConfigDict(json_schema_extra=ALTERNATIVES)


class TakesFields(Component):
    """Component with parameters that can vary in space or time.

    The attribute of such a parameter contains the value that is used where a single number is
    required; for a time-dependent parameter this is the last value. `varying` contains the
    functions of space, and `time_dependent` the functions of time.
    """

    _varying: dict[str, Varying] = PrivateAttr(default_factory=dict)
    _time_dependent: dict[str, TimeDependent[float]] = PrivateAttr(default_factory=dict)

    @property
    def varying(self) -> Mapping[str, Varying]:
        """Spatially varying parameters, by name."""
        return self._varying

    @property
    def time_dependent(self) -> Mapping[str, TimeDependent[float]]:
        """Time-dependent parameters, by name."""
        return self._time_dependent

    def at(self, moment: float) -> Any:
        """Return the component with the values of its parameters at a time, in steps."""
        return self.with_more(**{name: c.at(moment) for name, c in self._time_dependent.items()})

    def with_more(self, **values: Any) -> Any:
        """Return the component with some parameters changed.

        All other parameters vary in space or time as before.

        Raises
        ------
        ValidationError
            If the parameters are incompatible.
        """
        return self.with_values(**{**self._varying, **self._time_dependent, **values})

    def in_place_of_numbers(self) -> dict[str, Any]:
        """Return the varying parameters as they are written in an experiment file."""
        fields = {name: field.written() for name, field in self._varying.items()}
        time_dependent = {
            name: number.model_dump(mode="json") for name, number in self._time_dependent.items()
        }
        return fields | time_dependent

    def with_values(self, **values: Any) -> Any:
        """Return the component with some parameters changed.

        All other parameters are replaced by the single numbers of their attributes.

        Raises
        ------
        ValidationError
            If the parameters are incompatible.
        """
        fields = type(self).model_fields.items()
        parameters = {field.alias or name: getattr(self, name) for name, field in fields}
        return type(self).model_validate(parameters | values)

    @model_validator(mode="wrap")
    @classmethod
    def _with_fields(cls, data: Any, handler: Any, info: ValidationInfo) -> Any:
        if not isinstance(data, dict):
            return handler(data)
        data = data | {name: cls._number_of(name, data[name], info) for name in data}
        varying: dict[str, Varying] = {**random_fields(data, cls.numbers(), info.context)}
        time_dependent = dict[str, TimeDependent[float]]()
        for name in (cls.numbers() & data.keys()) - varying.keys():
            try:
                if number := as_time_dependent(data[name]):
                    time_dependent[name] = number
                elif field := as_varying(data[name]):
                    varying[name] = field
            except ValueError as error:
                raise _fault(name, str(error)) from None
        variations: dict[str, Varying | TimeDependent[float]] = {**varying, **time_dependent}
        if variations:
            cls._refuse_wrong(data, variations, info.context)
        part = handler(data | {name: _first(field) for name, field in variations.items()})
        part._varying, part._time_dependent = varying, time_dependent
        return part

    @classmethod
    def __get_pydantic_json_schema__(cls, core: Any, handler: Any) -> dict[str, Any]:
        """Return the JSON Schema with all forms that can replace a number."""
        schema: dict[str, Any] = handler(core)
        field = handler(core_schema.union_schema([Field.__pydantic_core_schema__]))
        properties = handler.resolve_ref_schema(schema).get("properties", {})
        for name in cls.numbers() & properties.keys():
            about = {k: v for k, v in properties[name].items() if k in ABOUT}
            number = {k: v for k, v in properties[name].items() if k not in ABOUT}
            properties[name] = about | {"anyOf": [number, field]}
        return schema

    @classmethod
    def numbers(cls) -> set[str]:
        """Return the names of the parameters that can vary in space or time."""
        return {name for name, field in cls.model_fields.items() if field.annotation is float}

    @classmethod
    def _number_of(cls, name: str, data: Any, info: ValidationInfo) -> Any:
        """Convert the texts with units in a varying parameter to numbers in lattice units."""
        field = cls.model_fields.get(name)
        quantity = (
            next((m for m in field.metadata if isinstance(m, Quantity)), None) if field else None
        )
        if quantity is None or not isinstance(data, dict):
            return data

        def number(value: Any, key: str) -> Any:
            if isinstance(value, list | tuple):
                return [number(item, key) for item in value]
            try:
                return quantity.number(value, info)
            except PydanticCustomError as error:
                context = {"text": error.message(), "key": (name, key)}
                raise PydanticCustomError("fault", "{text}", context) from None

        if "otherwise" in data:
            return {key: number(value, key) for key, value in data.items()}
        if "steps" in data and isinstance(data.get("values"), list | tuple):
            return data | {"values": number(data["values"], "values")}
        return data | {"mean": number(data["mean"], "mean")} if "mean" in data else data

    @classmethod
    def _refuse_wrong(cls, data: dict[str, Any], varying: dict[str, Any], context: Any) -> None:
        """Validate the component with the values of each place or time."""
        for label in dict.fromkeys(label for field in varying.values() for label in field.samples):
            sample = {n: field.samples.get(label, _first(field)) for n, field in varying.items()}
            try:
                cls.model_validate(data | sample, context=context)
            except ValidationError as error:
                for fault in error.errors(include_url=False):
                    name = next((word for word in fault["loc"] if word in sample), None)
                    if fault["type"] == "key" or (fault["loc"] and not name):
                        continue  # it is about another parameter
                    text = fault["msg"].removeprefix("Value error, ")
                    text = text.replace("Input should", "should")
                    got = f", got {sample[name]:g}" if name else ""
                    labels = varying[name].samples if name else [label]
                    where = label if label in labels else next(iter(labels))
                    raise _fault(str(name or min(sample)), f"{where}: {text}{got}") from None


def _first(field: Varying | TimeDependent[float]) -> float:
    return next(iter(field.samples.values()))


def _fault(name: str, text: str) -> PydanticCustomError:
    return PydanticCustomError("fault", "{text}", {"text": text, "key": name})


def unknown_regions(
    part: TakesFields, regions: Mapping[str, Any]
) -> Iterator[tuple[str, str, str]]:
    """Yield parameter, region and message for each parameter that refers to an unknown region."""
    for name, field in part.varying.items():
        for region, _ in field.values if isinstance(field, ByRegion) else ():
            if region not in regions:
                names = (
                    f"known: {', '.join(regions)}"
                    if regions
                    else "the experiment has no `regions`; add them"
                )
                hint = did_you_mean(region, regions)
                yield name, region, f"there is no region '{region}'{hint} ({names})"
