"""Tabulated laws: functions of one number, given by points, with linear interpolation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    ConfigDict,
    Field,
    RootModel,
    ValidationInfo,
    model_validator,
)
from pydantic_core import core_schema

from pbdkit.errors import AnswerError
from pbdkit.plugin.component import Component, Pair
from pbdkit.plugin.units import Quantity, number_or_text
from pbdkit.plugin.vector import Number

MAX_POINTS = 10_000
"""Maximum number of points of a table."""


class Table(RootModel[Annotated[tuple[Pair, ...], Field(strict=False, max_length=MAX_POINTS)]]):
    """Function of one number, given by points (x, y) with increasing x.

    It is the type of a parameter of a rule. In an experiment file it is a list of pairs, or a map
    ``{x: [...], y: [...]}``, or ``{file: NAME.csv, columns: [x, y], units: [mm, MPa]}``. Rules
    receive it as ``p.name`` and evaluate it by `interpolate`. Results contain the points.

    Parameters
    ----------
    root : sequence of (float, float)
        Points (x, y).

    Examples
    --------
    >>> law = Table([(0.0, 0.0), (1.0, 2.0), (3.0, 2.0)])
    >>> float(interpolate(0.5, law.array))
    1.0
    """

    model_config = ConfigDict(frozen=True, strict=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _from_columns(cls, data: Any) -> Any:
        if isinstance(data, (list, tuple)):
            return data
        if not isinstance(data, dict):
            raise ValueError(f"should be points [[x, y], ...], got {data!r:.40}")
        if data.keys() != {"x", "y"}:
            got = f"a map of {', '.join(map(str, data))}" if data else "an empty map"
            raise ValueError(
                "should be points [[x, y], ...], {x: [...], y: [...]} or "
                f"{{file: NAME.csv, columns: [x, y]}}, got {got}"
            )
        x, y = data["x"], data["y"]
        for name, column in data.items():
            if not isinstance(column, (list, tuple)):
                raise ValueError(f"{name} should be a list of numbers, got {column!r:.40}")
        if len(x) != len(y):
            raise ValueError(f"x and y should have one length, got {len(x)} and {len(y)} numbers")
        return list(zip(x, y, strict=True))

    @model_validator(mode="after")
    def _increasing(self) -> Table:
        if len(self.root) < 2:
            raise ValueError(
                f"a table should have at least two points, got {len(self.root)}; for a constant "
                "give two points with the same y"
            )
        for n, ((x, _), (following, _)) in enumerate(zip(self.root, self.root[1:], strict=False)):
            if following <= x:
                raise ValueError(
                    f"x should increase, but point {n + 2} has x = {following:g} after {x:g}; sort "
                    "the points by x, one for each x"
                )
        return self

    @classmethod
    def __get_pydantic_json_schema__(cls, core: Any, handler: Any) -> dict[str, Any]:
        """Return the JSON Schema with all forms of a table."""
        schema: dict[str, Any] = handler(core)
        number = number_or_text({"type": "number"})
        point = {"type": "array", "items": number, "minItems": 2, "maxItems": 2}
        column = {"type": "array", "items": number, "minItems": 2}
        words = {"type": "array", "items": {"type": "string"}, "minItems": 2, "maxItems": 2}
        file = {"file": {"type": "string"}, "columns": words, "units": words}
        forms = (({"x": column, "y": column}, ["x", "y"]), (file, ["file"]))
        maps = [
            {"type": "object", "properties": form, "required": names, "additionalProperties": False}
            for form, names in forms
        ]
        own = handler.resolve_ref_schema(schema)
        for name in ("items", "type", "maxItems"):
            own.pop(name, None)
        own["anyOf"] = [{"type": "array", "items": point, "minItems": 2}, *maps]
        return schema

    @property
    def array(self) -> NDArray[np.float64]:
        """Return x, y and the slope after each point, (3, point)."""
        x, y = np.array(self.root).T
        array = np.stack([x, y, np.append(np.diff(y) / np.diff(x), 0.0)])
        array.flags.writeable = False
        return array


@dataclass(frozen=True)
class Axes:
    """Quantities of the two axes of a table, which can then have units.

    It annotates a parameter: ``law: Annotated[Table, Axes(LENGTH, FORCE)]``.

    Parameters
    ----------
    x, y : Quantity, optional
        Quantities; None for a plain number.
    """

    x: Quantity | None = None
    y: Quantity | None = None

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return core_schema.with_info_before_validator_function(self._numbers, handler(source))

    def _numbers(self, data: Any, info: ValidationInfo) -> Any:
        """Convert the texts with units in points or columns to numbers in lattice units."""
        quantities = self.x, self.y

        def number(axis: int, value: Any) -> Any:
            quantity = quantities[axis]
            return value if quantity is None else quantity.number(value, info)

        if isinstance(data, dict) and data.keys() == {"x", "y"}:
            return {
                name: [number(axis, value) for value in data[name]]
                if isinstance(data[name], (list, tuple))
                else data[name]
                for axis, name in enumerate(("x", "y"))
            }
        if not isinstance(data, (list, tuple)):
            return data
        return [
            [number(axis, value) for axis, value in enumerate(point)]
            if isinstance(point, (list, tuple)) and len(point) == 2
            else point
            for point in data
        ]


def tables_of(component: type[Component]) -> set[str]:
    """Return the names of the parameters that are tables."""
    return {name for name, field in component.model_fields.items() if field.annotation is Table}


def interpolate(x: Number, table: Any) -> Any:
    """Return the value of a table at x by linear interpolation, elementwise.

    Outside the table, the value is that of the first or the last point, as in `numpy.interp`.

    Parameters
    ----------
    x : Number
        Argument.
    table : array of float, shape (3, point)
        Table as functions receive it, ``p.name``; for a `Table` it is its `array`.

    Returns
    -------
    Number
        Value, in the precision of x.

    Raises
    ------
    AnswerError
        If the arguments are in the reverse order.

    Examples
    --------
    >>> float(interpolate(2.0, Table([(0.0, 1.0), (4.0, 3.0)]).array))
    2.0
    """
    if np.ndim(table) != 2:
        raise AnswerError("`interpolate` takes the argument and then the table, as in (x, p.name)")
    argument = np.asarray(x)
    if argument.dtype == np.float32:
        table = table.astype(np.float32)
    x_of, y_of, slope = table
    place = argument.real
    n = np.clip(np.searchsorted(x_of, place, side="right") - 1, 0, len(x_of) - 2)
    value = slope[n] * (argument - x_of[n]) + y_of[n]
    value = np.where(place <= x_of[0], y_of[0], value)
    return np.where(place >= x_of[-1], y_of[-1], value)[()]
