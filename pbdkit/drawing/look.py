"""Options that pictures, comparisons and movies have in common."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np

from pbdkit.errors import ExperimentError

LARGEST_IN, SMALLEST_DPI, LARGEST_DPI = 100.0, 10, 2400


@dataclass(frozen=True)
class Look:
    """Options of `plot`, `compare` and `animate`, under the names that they have there.

    Raises ExperimentError for numbers that make no picture.
    """

    filled: bool | None = None
    contours: bool = False
    bonds: bool | None = None
    broken: bool = False
    outline: bool = False
    numbers: bool = False
    vmin: float | None = None
    vmax: float | None = None
    cmap: str | None = None
    figsize: tuple[float, float] | None = None
    dpi: int = 200

    def __post_init__(self) -> None:
        self._check_limits()
        if self.figsize is not None:
            sizes = [s for s in np.atleast_1d(self.figsize) if is_number(s)]
            if len(sizes) != 2 or not all(0.0 < s <= LARGEST_IN for s in sizes):
                raise ExperimentError(
                    "figsize: expected a width and a height in inches, each above 0 and at most "
                    f"{LARGEST_IN:g}; got {self.figsize!r}"
                )
        if not SMALLEST_DPI <= self.dpi <= LARGEST_DPI:
            raise ExperimentError(
                f"dpi: {self.dpi} is not between {SMALLEST_DPI} and {LARGEST_DPI}"
            )
        if self.contours and self.filled is False:
            raise ExperimentError("contours are of a filled field, and this is to be dots")

    def _check_limits(self) -> None:
        for name, limit in (("vmin", self.vmin), ("vmax", self.vmax)):
            if limit is not None and not is_number(limit):
                raise ExperimentError(f"{name}: expected a finite number, got {limit!r}")
        if self.vmin is not None and self.vmax is not None and not self.vmin < self.vmax:
            raise ExperimentError(
                f"the lower limit of the colours, {self.vmin:g} (vmin), is not below the upper "
                f"one, {self.vmax:g} (vmax); exchange them"
            )


def is_number(value: Any) -> bool:
    """Return whether the value is a finite number."""
    return isinstance(value, Real) and math.isfinite(value)
