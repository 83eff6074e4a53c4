"""Colours of the kinds of particles, of roles and of other classes, and the colour scale of a
quantity.

The colours of a quantity with both signs are centred at zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import (
    BoundaryNorm,
    Colormap,
    FuncNorm,
    ListedColormap,
    LogNorm,
    Normalize,
    SymLogNorm,
)
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError, did_you_mean
from pbdkit.lattice.raster import FOLLOWER, FRAME, LEADER
from pbdkit.plotting.data import PlottedQuantity, Snapshot
from pbdkit.plotting.style import PlotOptions

KINDS = {
    int(FRAME): ("frame", "#F0E442"),
    int(FOLLOWER): ("follower", "#0072B2"),
    int(LEADER): ("leader", "#D55E00"),
}
"""Names and colours of the kinds of particles, in drawing order. The colours are those of Okabe and
Ito."""
CLASS_COLOURS = ("#0072B2", "#F0E442", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
"""Colours of other classes. They are also colours of Okabe and Ito."""


@dataclass(frozen=True)
class Palette:
    """Names and colours by class number, in drawing order. If `of_kind` is true, the classes are
    the kinds of particles, otherwise the values of a quantity."""

    colours: dict[int, tuple[str, str]]
    of_kind: bool

    def ranks(self, snapshot: Snapshot) -> NDArray[Any]:
        """Return the index of the colour of each particle. It is NaN for particles that belong to
        no class."""
        classes = snapshot.kind if self.of_kind or snapshot.values is None else snapshot.values
        ranks = np.full(len(snapshot.kind), np.nan)
        for rank, number in enumerate(self.colours):
            ranks[classes == number] = rank
        return ranks


OF_KINDS = Palette(KINDS, True)
"""Palette of the kinds of particles."""


def palette_of(quantity: PlottedQuantity) -> Palette:
    """Return the palette of a quantity with integer codes, which are the classes."""
    if quantity.variable == "kind":
        return OF_KINDS
    words = enumerate(quantity.words.items())
    return Palette(
        {k: (word, CLASS_COLOURS[n % len(CLASS_COLOURS)]) for n, (k, word) in words}, False
    )


DOTS = "viridis"
"""Colour map of dots."""
FIELD = "YlOrRd"
"""Colour map of fields."""
BOTH_SIGNS = "RdBu_r"
"""Colour map of values of both signs."""
NOTHING = "#E0E0E0"
"""Colour of missing values."""
NEARLY = 1e-9
"""Values and differences below this fraction of the largest value count as zero."""
FROM_ZERO = 0.3
"""A scale begins at zero if the ratio of the lowest value to the highest value is smaller than this
number."""
LEVELS = 12
"""Number of levels of contours."""


LOG_RANGE = 1e-4
"""Ratio of the lower to the upper limit of a logarithmic scale, unless `vmin` is given or the
values cover less. Smaller values have the lowest colour."""
SYMLOG_RANGE = 1e-3
"""Ratio of the limit of the linear part of a symlog scale to its largest absolute value."""


@dataclass(frozen=True)
class Scale:
    """Colour scale from `low` to `high`. `extend` has the same meaning as in matplotlib. The tick
    labels have to be multiplied by ten to the power `exponent`. On a `whole` scale all ticks are
    integers. If `shares` is true, the scale runs from the lower limit to the upper limit of each
    panel."""

    low: float
    high: float
    colours: Colormap
    norm: Normalize
    extend: str
    exponent: int
    whole: bool
    shares: bool = False

    @property
    def text(self) -> str:
        """Return the limits as text."""
        return f"{self.low:.3g} to {self.high:.3g}".replace("-", "−")


def scale_of(
    quantity: PlottedQuantity, values: tuple[float, float], look: PlotOptions, filled: bool
) -> Scale:
    """Return the colour scale of a quantity with values in a range.

    If the values have both signs and zero is neutral, the scale is symmetric about zero, unless
    `look` contains limits. In both cases zero has the neutral colour. Raises ExperimentError for a
    colour map that does not exist, and for values that a logarithmic scale cannot represent.
    """
    low, high = _limits(quantity, values, look)
    diverging = is_diverging(quantity, (low, high) if _has_limits(look) else values)
    name = look.cmap or (BOTH_SIGNS if diverging else FIELD if filled else DOTS)
    if quantity.is_signed and low < high <= 0.0 and not look.cmap:
        name += "_r"  # Values near zero then have similar colours on both sides of zero.
    norm = _norm(low, high, look)
    middle = float(norm(0.0)) if diverging else None
    if look.contours:
        levels = _levels(norm, look, symmetric=diverging and not _has_limits(look))
        norm, low, high = BoundaryNorm(levels, 256), float(levels[0]), float(levels[-1])
    extensions = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}
    slack = NEARLY * (high - low)
    extend = extensions[int(values[0] < low - slack), int(values[1] > high + slack)]
    exponent, colours = _exponent(max(abs(low), abs(high))), _map(name, middle)
    if quantity.whole and values[0] == values[1] and not _has_limits(look):
        colours = ListedColormap([colours(0.5)]).with_extremes(bad=NOTHING)
    return Scale(low, high, colours, norm, extend, exponent, quantity.whole)


def scale_within(
    scale: Scale, quantity: PlottedQuantity, values: tuple[float, float], look: PlotOptions
) -> Scale:
    """Return a scale with the colours of a scale, and with limits for other values. If the scale is
    symmetric about zero, the other one is, too. Contours have equidistant levels, so that both
    scales have the same colours between their limits."""
    if not np.isfinite(values).all():
        return scale
    symmetric = scale.low == -scale.high
    largest = max(map(abs, values))
    low, high = _limits(quantity, (-largest, largest) if symmetric else values, look)
    norm = _norm(low, high, look)
    if look.contours:
        norm = BoundaryNorm(norm.inverse(np.linspace(0.0, 1.0, LEVELS + 1)), 256)
    return replace(scale, low=low, high=high, norm=norm)


def in_shares(scale: Scale) -> Scale:
    """Return the scale from 0 to 1 of a colour bar that several scales share."""
    norm = Normalize(0.0, 1.0)
    if isinstance(scale.norm, BoundaryNorm):
        norm = BoundaryNorm(np.linspace(0.0, 1.0, LEVELS + 1), 256)
    return replace(
        scale, low=0.0, high=1.0, norm=norm, extend="neither", exponent=0, whole=False, shares=True
    )


def is_diverging(quantity: PlottedQuantity, values: tuple[float, float]) -> bool:
    """Return whether values have both signs, and zero is neutral."""
    low, high = values
    nothing = NEARLY * max(abs(low), abs(high))
    return quantity.is_signed and low < -nothing and high > nothing


def _has_limits(look: PlotOptions) -> bool:
    return look.vmin is not None or look.vmax is not None


def _limits(
    quantity: PlottedQuantity, values: tuple[float, float], look: PlotOptions
) -> tuple[float, float]:
    """Return the limits of a scale."""
    low, high = values
    largest = max(abs(low), abs(high))
    zero_has_meaning = not quantity.is_place
    if _has_limits(look):
        low = low if look.vmin is None else look.vmin
        high = high if look.vmax is None else look.vmax
    elif is_diverging(quantity, values):
        low, high = -largest, largest
    elif high - low <= NEARLY * largest:
        low, high = _around(low, quantity)
    elif zero_has_meaning and low > 0.0 and (look.norm == "sqrt" or low < FROM_ZERO * high):
        low = 0.0
    elif zero_has_meaning and high < 0.0 and (look.norm == "sqrt" or FROM_ZERO * low < high):
        high = 0.0
    if look.norm == "log" and look.vmin is None:
        low = max(values[0], LOG_RANGE * high)
        low = low if low < high else LOG_RANGE * high
    if not low < high and _has_limits(look):
        raise ExperimentError(
            f"no value lies between the colour limits: values are {values[0]:g} to "
            f"{values[1]:g}; give both vmin and vmax"
        )
    if look.norm == "log" and not (low > 0.0 and values[0] >= -NEARLY * largest):
        raise ExperimentError(
            f"a logarithmic scale requires positive values, but values are {values[0]:g} to "
            f"{values[1]:g}; use the scale symlog or sqrt"
        )
    return low, high


def _around(value: float, quantity: PlottedQuantity) -> tuple[float, float]:
    """Return the limits of a scale with one value. For an integer the value is in the middle of the
    scale, for other quantities it is one end, and zero the other."""
    if quantity.whole:
        return value - 0.5, value + 0.5
    if quantity.is_place:
        return value, value + (abs(value) or 1.0)
    return min(value, 0.0), max(value, 0.0) if value else 1.0


def _norm(low: float, high: float, look: PlotOptions) -> Normalize:
    """Return the norm of the colours. Values outside the limits have the colours of the limits."""
    if look.norm == "log":
        return LogNorm(low, high, clip=True)
    if look.norm == "symlog":
        linear = SYMLOG_RANGE * max(abs(low), abs(high))
        return SymLogNorm(linear, vmin=low, vmax=high, clip=True)
    if look.norm == "sqrt":
        return FuncNorm((_root, _square), low, high)
    return Normalize(low, high)


def _root(values: Any) -> Any:
    """Return the square roots of absolute values, with the signs of the values."""
    return np.sign(values) * np.sqrt(np.abs(values))


def _square(roots: Any) -> Any:
    """Return the values with the given roots."""
    return np.sign(roots) * np.square(roots)


def _levels(norm: Normalize, look: PlotOptions, *, symmetric: bool) -> NDArray[Any]:
    """Return round levels of contours. The lowest and the highest level include the limits."""
    low, high = float(norm.vmin or 0.0), float(norm.vmax or 0.0)
    if look.norm == "log":
        return _decades(low, high)
    if isinstance(norm, SymLogNorm):
        positive = _decades(norm.linthresh, max(abs(low), abs(high)))
        levels = np.concatenate([-positive[::-1], [0.0], positive])
        first, last = np.searchsorted(levels, low, "right") - 1, np.searchsorted(levels, high)
        return levels[max(0, first) : last + 1]
    if look.norm == "sqrt":
        return np.asarray(_square(MaxNLocator(LEVELS).tick_values(_root(low), _root(high))))
    return np.asarray(MaxNLocator(LEVELS, symmetric=symmetric).tick_values(low, high))


def symlog_ticks(scale: Scale) -> list[float] | None:
    """Return ticks of a symlog scale: zero, and powers of ten outside the linear part. Return None
    for other scales."""
    if not isinstance(scale.norm, SymLogNorm):
        return None
    largest = max(abs(scale.low), abs(scale.high))
    powers = 10.0 ** np.arange(-2.0, 1.0) * 10.0 ** math.floor(math.log10(largest))
    return [tick for tick in (*-powers, 0.0, *powers) if scale.low <= tick <= scale.high]


def _decades(low: float, high: float) -> NDArray[Any]:
    """Return levels 1, 2 and 5 times powers of ten, or only the powers if there would be many."""
    powers = np.arange(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    factors = (1.0,) if len(powers) > LEVELS // 3 + 1 else (1.0, 2.0, 5.0)
    levels = np.sort(np.outer(10.0**powers, factors).ravel())
    first, last = np.searchsorted(levels, low, "right") - 1, np.searchsorted(levels, high)
    return np.asarray(levels[max(0, first) : last + 1])


def _map(name: str, middle: float | None) -> Colormap:
    """Return the colour map of a name. If `middle` is the position of zero in the scale, from 0 to
    1, the map is cropped such that zero has the middle colour of the complete map."""
    if name not in colormaps:
        suggestion = did_you_mean(name, colormaps) or "; viridis, YlOrRd and RdBu_r are"
        raise ExperimentError(f"'{name}' is not a colour map of matplotlib{suggestion}")
    cmap = colormaps[name]
    if middle is not None:
        first, last = (0.5 + 0.5 * (end - middle) / max(middle, 1.0 - middle) for end in (0.0, 1.0))
        cmap = ListedColormap(cmap(np.linspace(first, last, 256)))
    return cmap.with_extremes(bad=NOTHING)


def _exponent(largest: float) -> int:
    """Return the power of ten that is written once in the label and not at each tick."""
    if largest == 0.0 or not math.isfinite(largest):
        return 0
    power = math.floor(math.log10(largest) + 1e-9)
    return 0 if -3 <= power <= 3 else power
