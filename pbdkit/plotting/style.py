"""Figures, words and options that all pictures have in common."""

from __future__ import annotations

import math
import sys
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.errors import ExperimentError, one_line
from pbdkit.io.physical import FACTOR, UNITS
from pbdkit.progress import in_notebook

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.backend_bases import RendererBase
    from matplotlib.figure import Figure

PYPLOT = "matplotlib.pyplot"


def figure_of(ax: Axes) -> Figure:
    """The whole that axes are in."""
    found = ax.get_figure(root=True)
    assert found is not None
    return found


def renderer_of(figure: Figure) -> RendererBase:
    """What measures text: figures made here have Agg's."""
    canvas: Any = figure.canvas
    found: RendererBase = canvas.get_renderer()
    return found


def new_figure(*, alone: bool = False, **how: Any) -> Figure:
    """A figure made by matplotlib with these arguments. Where pyplot is in use, or in a notebook,
    it is pyplot's, unless it is to be `alone`: then whoever made it shows or saves it."""
    if not alone and (PYPLOT in sys.modules or in_notebook()):
        pyplot = import_module(PYPLOT)
        found: Figure = pyplot.figure(**how)
        if hasattr(found.canvas, "get_renderer"):
            return found
        pyplot.close(found)  # of a backend that cannot measure text
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    found = Figure(**how)
    FigureCanvasAgg(found)
    return found


LONGEST = 200
"""So many characters of a title or name are shown."""
RAISED = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
SIGNS = {"^2": "²", "^3": "³", " * ": " × "}


def plain(text: object) -> str:
    """A text for a picture: short, and never taken for a formula."""
    return one_line(str(text)[:LONGEST]).replace("$", r"\$")


def signed(units: str) -> str:
    """Units with the signs of print; nothing of plain numbers."""
    for typed, sign in SIGNS.items():
        units = units.replace(typed, sign)
    return "" if units == "1" else units


def in_its_units(attributes: Mapping[Any, Any]) -> tuple[float, str]:
    """By what the values of a variable are multiplied to be in mm and so on, and those units, as
    far as it says them; else 1 and its own."""
    if UNITS in attributes and FACTOR in attributes:
        return float(attributes[FACTOR]), str(attributes[UNITS])
    return 1.0, str(attributes.get("units", ""))


def label(
    meaning: object, units: object = "", exponent: int = 0, *, broad: int | None = None
) -> str:
    """A quantity and its units, as they stand at an axis whose numbers are to be multiplied by ten
    to the `exponent`; in lines of so many characters if it is said how `broad`, the units on one of
    their own where both are too long for one."""
    said, counted = plain(meaning), signed(plain(units))
    ten = f"10{str(exponent).translate(RAISED)}" if exponent else ""
    counted = " ".join(filter(None, (ten, counted)))
    whole = f"{said} ({counted})" if counted else said
    if broad is None or len(whole) <= broad:
        return whole
    units_below = f"\n{textwrap.fill(f'({counted})', broad)}" if counted else ""
    return f"{_even(said, broad)}{units_below}"


def _even(text: str, broad: int) -> str:
    """The text on as few lines as it takes, and these as equal as can be."""
    lines = len(textwrap.wrap(text, broad))
    every = (textwrap.wrap(text, width) for width in range(1, broad + 1))
    return "\n".join(next((wrapped for wrapped in every if len(wrapped) == lines), []))


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
