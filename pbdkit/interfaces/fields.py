"""Components whose numbers may be fields, a value for each place, or courses in time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import (
    ConfigDict,
    PrivateAttr,
    RootModel,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import PydanticCustomError, core_schema

from pbdkit.errors import did_you_mean
from pbdkit.interfaces.component import Component
from pbdkit.interfaces.course import Course, as_course
from pbdkit.interfaces.random_field import random_fields
from pbdkit.interfaces.units import PATTERN, Quantity, or_text
from pbdkit.interfaces.varying import ByRegion, Varying, as_varying

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
