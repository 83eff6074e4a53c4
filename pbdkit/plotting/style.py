"""Figures, labels and options that all pictures have in common."""

from __future__ import annotations

import inspect
import math
import re
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import wraps
from numbers import Real
from typing import TYPE_CHECKING, Any, Literal, TypedDict, TypeVar, cast, get_args

import numpy as np

from pbdkit.errors import ExperimentError, did_you_mean, one_line
from pbdkit.io.physical import FACTOR, UNITS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.backend_bases import RendererBase
    from matplotlib.figure import Figure


F = TypeVar("F", bound=Callable[..., Any])


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
Window = tuple[float, float, float, float]
"""Part of the plane: left, right, bottom and top, in the units of the axes."""


class PlotKeywords(TypedDict, total=False):
    """Types of the options of pictures and movies, as keyword arguments."""

    filled: bool | None
    contours: bool
    bonds: bool | None
    broken: bool
    outline: bool
    numbers: bool
    vmin: float | None
    vmax: float | None
    cmap: str | None
    norm: Norm
    limits: Limits
    window: Window | None
    figsize: tuple[float, float] | None
    dpi: int


OPTIONS = """
    filled : bool, optional
        True draws the variable as a filled field, False as a dot for each particle. By default a
        field is drawn where dots would overlap.
    contours : bool
        Draw the field in filled contours at round levels.
    bonds : bool, optional
        Draw bonds as lines. By default they are drawn where there is room.
    broken : bool
        Draw broken bonds too, dashed.
    outline : bool
        Draw the outline of the body in the reference configuration.
    numbers : bool
        Write the numbers of particles where there is room.
    vmin, vmax : float, optional
        Limits of the colours. By default those of all drawn values, symmetric about zero if values
        of both signs occur.
    cmap : str, optional
        Colour map of matplotlib.
    norm : {"linear", "log", "sqrt", "symlog"}
        Scale of the colours: linear; logarithmic, over at most four decades; square root, with the
        sign of the value; or logarithmic on both sides of a linear range around zero.
    limits : {"all", "each"}
        "all" gives all steps the same limits of colours. "each" gives each step the limits of its
        own values, which its title states.
    window : (float, float, float, float), optional
        Part of the plane that is drawn: left, right, bottom and top, in the units of the axes.
    figsize : (float, float), optional
        Width and height of the figure in inches.
    dpi : int
        Pixels per inch.
"""
"""Description of the options in the docstrings of the functions that take them."""


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
    window: Window | None = None
    figsize: tuple[float, float] | None = None
    dpi: int = 200

    def __post_init__(self) -> None:
        self._check_limits()
        self._check_window()
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

    def _check_window(self) -> None:
        if self.window is None:
            return
        edges = [edge for edge in np.atleast_1d(self.window) if is_number(edge)]
        if len(edges) != 4 or not (edges[0] < edges[1] and edges[2] < edges[3]):
            raise ExperimentError(
                "window: expected left, right, bottom and top, with left below right and bottom "
                f"below top; got {self.window!r}"
            )

    def _check_limits(self) -> None:
        for name, limit in (("vmin", self.vmin), ("vmax", self.vmax)):
            if limit is not None and not is_number(limit):
                raise ExperimentError(f"{name}: expected a finite number, got {limit!r}")
        if self.vmin is not None and self.vmax is not None and not self.vmin < self.vmax:
            raise ExperimentError(
                f"colour limits: vmin {self.vmin:g} is not below vmax {self.vmax:g}; exchange them"
            )


COMMAND_OPTIONS = {
    "filled": "field", "vmin": "range", "vmax": "range", "cmap": "map", "norm": "scale",
    "figsize": "size",
}  # fmt: skip
"""Names on the command line of those arguments that have another name there."""
OTHER_NAMES = {option: name for name, option in COMMAND_OPTIONS.items()} | {"colormap": "cmap"}
"""Arguments by other names for them."""


def takes_options(*without: str, dpi: int = PlotOptions.dpi) -> Callable[[F], F]:
    """Return a decorator for functions with the keyword arguments `PlotKeywords`.

    The signature and the docstring of the function then contain these options, except those in
    `without`. A call with another keyword argument raises TypeError.
    """

    def decorate(function: F) -> F:
        own = inspect.signature(function)
        defaults = {part.name: part.default for part in fields(PlotOptions)} | {"dpi": dpi}
        keywords = [
            inspect.Parameter(
                part.name, inspect.Parameter.KEYWORD_ONLY, default=defaults[part.name],
                annotation=part.type,
            )
            for part in fields(PlotOptions) if part.name not in without
        ]  # fmt: skip
        parameters = [p for p in own.parameters.values() if p.kind is not p.VAR_KEYWORD]
        last = len(parameters) - (parameters[-1].name == "ax")
        parameters[last:last] = keywords

        @wraps(function)
        def call(*args: Any, **options: Any) -> Any:
            names = [p.name for p in parameters]
            for name in options.keys() - {*names}:
                hint = did_you_mean(name, names) or f"; there are {', '.join(names[1:])}"
                if name in OTHER_NAMES:
                    hint = f"; did you mean '{OTHER_NAMES[name]}'?"
                raise TypeError(f"{function.__name__}: there is no argument '{name}'{hint}")
            return function(*args, **{"dpi": dpi} | options)

        entries = re.split(r"\n(?=    \w)", OPTIONS.strip("\n"))
        text = "\n".join(entry for entry in entries if entry.split()[0] not in without)
        signature = own.replace(parameters=parameters)
        call.__signature__ = signature  # type: ignore[attr-defined]  # read by `inspect`
        call.__doc__ = (function.__doc__ or "").replace("    {options}", text)
        return cast(F, call)

    return decorate


def is_number(value: Any) -> bool:
    """Return whether the value is a finite number."""
    return isinstance(value, Real) and math.isfinite(value)
