"""Parameters that vary in space or time: functions of place, values over a grid, random fields, and
time-dependent parameters.
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
    PrivateAttr,
    RootModel,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic import Field as ModelField
from pydantic_core import PydanticCustomError, core_schema

from pbdkit.errors import did_you_mean
from pbdkit.plugin.component import Component, Strict
from pbdkit.plugin.schedule import Course, as_course
from pbdkit.plugin.units import LENGTH, PATTERN, Quantity, or_text

Floats = NDArray[np.float64]
Held = Mapping[str, NDArray[np.bool_]]
"""Which places a region holds, by its name, in the order in which the experiment names them."""
MOST_IN_WORDS = 1000
"""So many values are written as numbers, more as bytes in base 64."""
MOST_VALUES = 2**24


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
            np.array_equal(getattr(self, name), getattr(other, name))
            for name in ("x", "y", "values")
        )

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
    by_chance = given.keys() & {"mean", "scatter", "correlation_length"}
    if given and not by_chance and all(isinstance(v, (int, float)) for v in given.values()):
        raise ValueError("otherwise is missing: the number where none of these regions is")
    if given.keys() == {"x", "y", "values"}:
        return Gridded(given["x"], given["y"], _unpacked(given))
    raise ValueError(
        "should be a number, {otherwise: number, REGION: number}, {file: NAME.nc, variable: NAME}, "
        "{steps: [...], values: [...]}, "
        "{mean: number, scatter: number, correlation_length: number}, "
        f"or {{x: [...], y: [...], values: [[...]]}}; got a map of {', '.join(map(str, given))}"
    )


def _by_region(given: dict[str, Any]) -> ByRegion:
    for name, value in given.items():
        if isinstance(value, dict):
            raise ValueError(
                f"'{name}' should be a number: there is no field in a field, and none that changes "
                "in time"
            )
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


MOST_DRAWN = 2**22
"""So many values are drawn, which takes minutes."""
NEAR = 1e-9
"""Of the distance between places: so far they differ by rounding."""


class Drawn(Strict):
    """Values over a grid, and the numbers and the seed from which they were drawn."""

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
        """The values."""
        return self._grid

    def answers(self, asked: Mapping[str, float], x: Floats, y: Floats) -> bool:
        """Whether they were drawn from these numbers, for these places."""
        if any(getattr(self, name) != number for name, number in asked.items()):
            return False
        pairs = (self._grid.x, x), (self._grid.y, y)
        return all(
            len(known) == len(wanted) and np.allclose(known, wanted, NEAR, NEAR * np.ptp(wanted))
            for known, wanted in pairs
        )


class RandomField(Strict, Varying):
    """A field with a mean and a standard deviation of `scatter` times the mean, drawn from the
    experiment's seed: lognormal, so that all values are positive and both are exact.

    Z = mean · exp(σ g - σ²/2) with σ² = ln(1 + scatter²), where g is a standard Gaussian field with
    the covariance exp(-(r/correlation_length)²) over the distance r. g is a sum of waves with
    random wave vectors, by the randomisation method (Heße et al., Environ. Model. Softw. 55 (2014)
    32-48) of GSTools: a function of the place alone, whatever the spacing and the body.
    """

    mean: Annotated[float, ModelField(gt=0.0, le=1e100)]
    scatter: Annotated[float, ModelField(gt=0.0, lt=1.0)]
    correlation_length: Annotated[float, ModelField(gt=1e-100, le=1e100), LENGTH]
    drawn: Drawn | None = None
    """What came of it; drawn anew where it is no answer to what is asked now."""

    @property
    def samples(self) -> dict[str, float]:
        """Those of the values; the mean as long as there are none."""
        return self.drawn.grid.samples if self.drawn else {"the mean": self.mean}

    def at(self, x: Floats, y: Floats, held: Held, reach: float = 0.0) -> Floats:
        """The values; the mean as long as there are none."""
        if self.drawn is None:
            return np.full(np.shape(x), self.mean)
        return self.drawn.grid.at(x, y, held, reach)

    def written(self) -> dict[str, Any]:
        """What was asked, and what came of it."""
        return self.model_dump(mode="json", exclude_none=True)

    def drawn_at(self, x: Floats, y: Floats, seed: int, stream: str) -> RandomField:
        """With its values over a grid of places. All fields of one stream come of the same g, each
        with its own length.

        Raises ValueError for too many places, and without GSTools.
        """
        asked = self.model_dump(exclude={"drawn"}) | {"seed": seed}
        if self.drawn and self.drawn.answers(asked, x, y):
            return self
        sigma = np.sqrt(np.log1p(self.scatter**2))
        g = _standard(x, y, self.correlation_length, seed, stream)
        found = Gridded(x, y, self.mean * np.exp(sigma * g - sigma**2 / 2))
        drawn = Drawn.model_validate(asked | found.written())
        return self.model_copy(update={"drawn": drawn})


def _standard(x: Floats, y: Floats, length: float, seed: int, stream: str) -> Floats:
    """g at (x, y)."""
    if len(x) * len(y) > MOST_DRAWN:
        raise ValueError(
            f"{len(x) * len(y)} values are more than the {MOST_DRAWN} that are drawn; draw it at "
            "fewer places, and give it as {file: NAME.nc, variable: NAME}"
        )
    try:
        import gstools
    except ImportError:
        raise ValueError(
            "random fields are drawn with GSTools: pip install 'pbdkit[random]'"
        ) from None
    model = gstools.Gaussian(dim=2, len_scale=length, rescale=1.0)
    own = np.random.SeedSequence(seed, spawn_key=tuple(f"{stream} field".encode()))
    waves = gstools.SRF(model, seed=int(own.generate_state(1)[0]))
    return np.asarray(waves.structured((x, y), store=False))


class _RandomFields(RootModel[dict[str, RandomField]]):
    """By name, so that what is wrong has its place."""

    model_config = ConfigDict(defer_build=True)


def random_fields(data: Mapping[str, Any], names: Set[str], context: Any) -> dict[str, RandomField]:
    """The parameters of these names that are maps of a random field. Raises ValidationError."""
    asked = {name: data[name] for name in names & data.keys() if _asks(data[name])}
    return _RandomFields.model_validate(asked, context=context).root if asked else {}


def _asks(given: Any) -> bool:
    keys = given.keys() if isinstance(given, dict) else set[str]()
    return "otherwise" not in keys and not keys.isdisjoint(RandomField.model_fields)


RESERVED = ("otherwise", "file", "steps")
"""What no region is called, so that a map tells what it is."""
ABOUT = ("title", "description", "examples", "default")
"""What a schema says of a parameter whatever stands in it."""
ALTERNATIVES: dict[str, Any] = {
    "oneOf": [
        {
            "type": "object",
            "required": ["otherwise"],
            "additionalProperties": or_text({"type": "number"}),
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
                "values": {"type": "array", "items": or_text({"type": "number"})},
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
"""The JSON Schema of what a file writes in place of a number."""


class Field(RootModel[Any]):
    """A value for each place: by region, from a netCDF file, over a grid, or by chance; or for each
    step."""

    model_config = ConfigDict(json_schema_extra=ALTERNATIVES)


class TakesFields(Component):
    """A component whose numbers may differ from place to place, or change in time.

    Each stands in its field with the value that serves where one number is asked for: of a course
    the last. What it is elsewhere and before, `varying` and `courses` tell.
    """

    _varying: dict[str, Varying] = PrivateAttr(default_factory=dict)
    _courses: dict[str, Course[float]] = PrivateAttr(default_factory=dict)

    @property
    def varying(self) -> Mapping[str, Varying]:
        """The parameters that differ from place to place."""
        return self._varying

    @property
    def courses(self) -> Mapping[str, Course[float]]:
        """The parameters that change in time."""
        return self._courses

    def at(self, moment: float) -> Any:
        """The component with the numbers that its parameters are at a moment."""
        return self.with_more(**{name: c.at(moment) for name, c in self._courses.items()})

    def with_more(self, **values: Any) -> Any:
        """The component with other numbers, fields or courses besides those that it has. Raises
        ValidationError where they do not go together."""
        return self.with_values(**{**self._varying, **self._courses, **values})

    def in_place_of_numbers(self) -> dict[str, Any]:
        """What stands there, as an experiment file writes it."""
        fields = {name: field.written() for name, field in self._varying.items()}
        courses = {name: course.model_dump(mode="json") for name, course in self._courses.items()}
        return fields | courses

    def with_values(self, **values: Any) -> Any:
        """The component with other numbers, fields or courses in place of its own; what is not
        given is the same everywhere and always. Raises ValidationError where they do not go
        together."""
        fields = type(self).model_fields.items()
        given = {field.alias or name: getattr(self, name) for name, field in fields}
        return type(self).model_validate(given | values)

    @model_validator(mode="wrap")
    @classmethod
    def _with_fields(cls, data: Any, handler: Any, info: ValidationInfo) -> Any:
        if not isinstance(data, dict):
            return handler(data)
        data = data | {name: cls._number_of(name, data[name], info) for name in data}
        varying: dict[str, Varying] = {**random_fields(data, cls.numbers(), info.context)}
        courses = dict[str, Course[float]]()
        for name in (cls.numbers() & data.keys()) - varying.keys():
            try:
                if course := as_course(data[name]):
                    courses[name] = course
                elif field := as_varying(data[name]):
                    varying[name] = field
            except ValueError as error:
                raise _fault(name, str(error)) from None
        no_numbers: dict[str, Varying | Course[float]] = {**varying, **courses}
        if no_numbers:
            cls._refuse_wrong(data, no_numbers, info.context)
        part = handler(data | {name: _first(each) for name, each in no_numbers.items()})
        part._varying, part._courses = varying, courses
        return part

    @classmethod
    def __get_pydantic_json_schema__(cls, own: Any, handler: Any) -> dict[str, Any]:
        """Numbers, or what may stand in their place."""
        schema: dict[str, Any] = handler(own)
        field = handler(core_schema.union_schema([Field.__pydantic_core_schema__]))
        known = handler.resolve_ref_schema(schema).get("properties", {})
        for name in cls.numbers() & known.keys():
            about = {k: v for k, v in known[name].items() if k in ABOUT}
            number = {k: v for k, v in known[name].items() if k not in ABOUT}
            known[name] = about | {"anyOf": [number, field]}
        return schema

    @classmethod
    def numbers(cls) -> set[str]:
        """The parameters that can differ from place to place, and change."""
        return {name for name, field in cls.model_fields.items() if field.annotation is float}

    @classmethod
    def _number_of(cls, name: str, given: Any, info: ValidationInfo) -> Any:
        """What is given in place of a number, with numbers of lattice units for texts with a
        unit."""
        field = cls.model_fields.get(name)
        quantity = (
            next((m for m in field.metadata if isinstance(m, Quantity)), None) if field else None
        )
        if quantity is None or not isinstance(given, dict):
            return given

        def number(value: Any, key: str) -> Any:
            if isinstance(value, list | tuple):
                return [number(each, key) for each in value]
            try:
                return quantity.number(value, info)
            except PydanticCustomError as error:
                told = {"text": error.message(), "key": (name, key)}
                raise PydanticCustomError("fault", "{text}", told) from None

        if "otherwise" in given:
            return {key: number(value, key) for key, value in given.items()}
        if "steps" in given and isinstance(given.get("values"), list | tuple):
            return given | {"values": number(given["values"], "values")}
        return given | {"mean": number(given["mean"], "mean")} if "mean" in given else given

    @classmethod
    def _refuse_wrong(cls, data: dict[str, Any], varying: dict[str, Any], context: Any) -> None:
        """Validates with the values of each place, or time, that is told apart."""
        for label in dict.fromkeys(label for field in varying.values() for label in field.samples):
            here = {n: field.samples.get(label, _first(field)) for n, field in varying.items()}
            try:
                cls.model_validate(data | here, context=context)
            except ValidationError as error:
                for fault in error.errors(include_url=False):
                    name = next((w for w in fault["loc"] if w in here), None)
                    if fault["type"] == "key" or (fault["loc"] and not name):
                        continue  # it is about another parameter
                    text = fault["msg"].removeprefix("Value error, ")
                    text = text.replace("Input should", "should")
                    got = f", got {here[name]:g}" if name else ""
                    known = varying[name].samples if name else [label]
                    where = label if label in known else next(iter(known))
                    raise _fault(str(name or min(here)), f"{where}: {text}{got}") from None


def _first(field: Varying | Course[float]) -> float:
    return next(iter(field.samples.values()))


def _fault(name: str, text: str) -> PydanticCustomError:
    return PydanticCustomError("fault", "{text}", {"text": text, "key": name})


def unknown_regions(
    part: TakesFields, regions: Mapping[str, Any]
) -> Iterator[tuple[str, str, str]]:
    """The parameters whose fields name regions that there are not, these, and a message each."""
    for name, field in part.varying.items():
        for region, _ in field.values if isinstance(field, ByRegion) else ():
            if region not in regions:
                known = (
                    f"known: {', '.join(regions)}" if regions else "there is none: add `regions`"
                )
                hint = did_you_mean(region, regions)
                yield name, region, f"there is no region '{region}'{hint} ({known})"
