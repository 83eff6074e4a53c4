"""Figures, labels and options that all pictures have in common."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from pbdkit.errors import ExperimentError, one_line
from pbdkit.io.physical import FACTOR, UNITS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.backend_bases import RendererBase
    from matplotlib.figure import Figure


def figure_of(ax: Axes) -> Figure:
    """Return the figure of axes."""
    figure = ax.get_figure(root=True)
    assert figure is not None
    return figure


def renderer_of(figure: Figure) -> RendererBase:
    """Return the renderer of a figure, which measures text. Figures that pbdkit creates use Agg."""
    canvas: Any = figure.canvas
    renderer: RendererBase = canvas.get_renderer()
    return renderer


MAX_TEXT = 200
"""Maximum number of characters of a title or name."""
RAISED = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
"""Translation of digits to superscripts."""
SIGNS = {"^2": "²", "^3": "³", " * ": " × "}
"""Typographic signs in units."""


def plain(text: object) -> str:
    """Return a short text that matplotlib does not interpret as a formula."""
    return one_line(str(text)[:MAX_TEXT]).replace("$", r"\$")


def signed(units: str) -> str:
    """Return units with typographic signs; empty for dimensionless quantities."""
    for typed, sign in SIGNS.items():
        units = units.replace(typed, sign)
    return "" if units == "1" else units


def in_its_units(attributes: Mapping[Any, Any]) -> tuple[float, str]:
    """Return the factor that converts a variable to its physical units, and these units. If the
    attributes of the variable do not define them, return 1 and the units of the variable."""
    if UNITS in attributes and FACTOR in attributes:
        return float(attributes[FACTOR]), str(attributes[UNITS])
    return 1.0, str(attributes.get("units", ""))


def label(
    meaning: object, units: object = "", exponent: int = 0, *, width: int | None = None
) -> str:
    """Return the label of an axis. It contains the quantity, its units, and the power of ten by
    which the tick labels have to be multiplied. With a `width` in characters the label is wrapped;
    if necessary, the units are on a separate line."""
    text, unit_text = plain(meaning), signed(plain(units))
    ten = f"10{str(exponent).translate(RAISED)}" if exponent else ""
    unit_text = " ".join(filter(None, (ten, unit_text)))
    single = f"{text} ({unit_text})" if unit_text else text
    if width is None or len(single) <= width:
        return single
    units_below = f"\n{textwrap.fill(f'({unit_text})', width)}" if unit_text else ""
    return f"{_even(text, width)}{units_below}"


def _even(text: str, width: int) -> str:
    """Wrap a text into as few lines as possible. The lines have about the same length."""
    lines = len(textwrap.wrap(text, width))
    every = (textwrap.wrap(text, length) for length in range(1, width + 1))
    return "\n".join(next((wrapped for wrapped in every if len(wrapped) == lines), []))


MAX_SIZE_IN = 100.0
"""Maximum width and height of a figure in inches."""
MIN_DPI = 10
"""Minimum resolution, in dots per inch."""
MAX_DPI = 2400
"""Maximum resolution, in dots per inch."""


Norm = Literal["linear", "log", "sqrt", "symlog"]
"""Names of scales of colours, as in matplotlib."""
Limits = Literal["all", "each"]
"""Scope of the limits of colours: all drawn steps, or each of them."""


@dataclass(frozen=True)
class PlotOptions:
    """Options of `plot`, `compare` and `animate`. They have the same names as the arguments of
    these functions.

    Raises ExperimentError for values that are not possible.
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
    norm: Norm = "linear"
    limits: Limits = "all"
    figsize: tuple[float, float] | None = None
    dpi: int = 200

    def __post_init__(self) -> None:
        self._check_limits()
        if self.figsize is not None:
            sizes = [s for s in np.atleast_1d(self.figsize) if is_number(s)]
            if len(sizes) != 2 or not all(0.0 < s <= MAX_SIZE_IN for s in sizes):
                raise ExperimentError(
                    "figsize: expected a width and a height in inches, each above 0 and at most "
                    f"{MAX_SIZE_IN:g}; got {self.figsize!r}"
                )
        if not MIN_DPI <= self.dpi <= MAX_DPI:
            raise ExperimentError(f"dpi: {self.dpi} is not between {MIN_DPI} and {MAX_DPI}")
        if self.contours and self.filled is False:
            raise ExperimentError("contours require filled=True, got filled=False")
        for name, value, choices in (("norm", self.norm, Norm), ("limits", self.limits, Limits)):
            if value not in get_args(choices):
                raise ExperimentError(
                    f"{name}: expected {', '.join(get_args(choices))}; got {value!r}"
                )
        if self.limits == "each" and not (self.vmin is None and self.vmax is None):
            raise ExperimentError(
                "limits='each' determines the limits of each step; omit it, or vmin and vmax"
            )

    def _check_limits(self) -> None:
        for name, limit in (("vmin", self.vmin), ("vmax", self.vmax)):
            if limit is not None and not is_number(limit):
                raise ExperimentError(f"{name}: expected a finite number, got {limit!r}")
        if self.vmin is not None and self.vmax is not None and not self.vmin < self.vmax:
            raise ExperimentError(
                f"colour limits: vmin {self.vmin:g} is not below vmax {self.vmax:g}; exchange them"
            )


def is_number(value: Any) -> bool:
    """Return whether the value is a finite number."""
    return isinstance(value, Real) and math.isfinite(value)
