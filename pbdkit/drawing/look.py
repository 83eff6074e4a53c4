"""How a picture is to look: what pictures, comparisons and movies have in common."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pbdkit.errors import ExperimentError

LARGEST_IN, SMALLEST_DPI, LARGEST_DPI = 100.0, 10, 2400


@dataclass(frozen=True)
class Look:
    """Options of `plot`, `compare` and `animate`.

    `filled`: the variable as a field over the body (True), as dots (False), or, None, as a field
    where dots would hide one another. `contours`: a field in steps at round levels. `bonds`: lines
    (None: where there is room); `broken`: broken ones too, dashed. `outline`: that of the body at
    rest. `numbers`: those of the particles, as many as there is room for. `range`: the lowest and
    the highest value of the colours; without it, those of all panels, and the same on both sides
    of zero where there are both signs. `map`: a colour map of matplotlib. `size`: of the whole, in
    inches. `dpi`: pixels an inch.

    Raises ExperimentError for numbers that make no picture.
    """

    filled: bool | None = None
    contours: bool = False
    bonds: bool | None = None
    broken: bool = False
    outline: bool = False
    numbers: bool = False
    range: tuple[float, float] | None = None
    map: str | None = None
    size: tuple[float, float] | None = None
    dpi: int = 200

    def __post_init__(self) -> None:
        if self.range is not None:
            low, high = self.range
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise ExperimentError(f"range: from {low:g} to {high:g} is none; give LOW HIGH")
        if self.size is not None and not all(0.0 < s <= LARGEST_IN for s in self.size):
            raise ExperimentError(
                f"size: is in inches, each above 0 and at most {LARGEST_IN:g}; "
                f"{self.size[0]:g} by {self.size[1]:g} is not"
            )
        if not SMALLEST_DPI <= self.dpi <= LARGEST_DPI:
            raise ExperimentError(
                f"dpi: {self.dpi} is not between {SMALLEST_DPI} and {LARGEST_DPI}"
            )
        if self.contours and self.filled is False:
            raise ExperimentError("contours are of a filled field, and this is to be dots")
