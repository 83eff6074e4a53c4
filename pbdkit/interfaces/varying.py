"""Parameters that are not one number but differ from place to place."""

from __future__ import annotations

import base64
import binascii
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
