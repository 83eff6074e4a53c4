"""Colours of the kinds of particles, of roles and of other classes, and the colour scale of a
quantity.

The colours of a quantity with both signs are centred at zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import BoundaryNorm, Colormap, ListedColormap, Normalize
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


@dataclass(frozen=True)
class Scale:
    """Colour scale from `low` to `high`. `extend` has the same meaning as in matplotlib. The tick
    labels have to be multiplied by ten to the power `exponent`."""

    low: float
    high: float
    colours: Colormap
    norm: Normalize
    extend: str
    exponent: int


def scale_of(
    quantity: PlottedQuantity, values: tuple[float, float], look: PlotOptions, filled: bool
) -> Scale:
    """Return the colour scale of a quantity with values in a range.

    If the values have both signs and zero is neutral, the scale is symmetric about zero, unless
    `look` contains limits. In both cases zero has the neutral colour. Raises ExperimentError for a
    colour map that does not exist.
    """
    low, high = values
    largest = max(abs(low), abs(high))
    diverging = quantity.is_signed and low < -NEARLY * largest and high > NEARLY * largest
    has_limits = look.vmin is not None or look.vmax is not None
    if has_limits:
        low = low if look.vmin is None else look.vmin
        high = high if look.vmax is None else look.vmax
        if not low < high:
            raise ExperimentError(
                f"no value lies between the colour limits: values are {values[0]:g} to "
                f"{values[1]:g}; give both vmin and vmax"
            )
        diverging = quantity.is_signed and low < 0.0 < high
    elif diverging:
        low, high = -largest, largest
    elif 0.0 < low < FROM_ZERO * high and not quantity.is_place:
        low = 0.0
    elif FROM_ZERO * low < high < 0.0 and not quantity.is_place:
        high = 0.0
    elif high - low <= NEARLY * largest:
        high = low + (largest or 1.0)
    name = look.cmap or (BOTH_SIGNS if diverging else FIELD if filled else DOTS)
    if quantity.is_signed and low < high <= 0.0 and not look.cmap:
        name += "_r"  # Values near zero then have similar colours on both sides of zero.
    norm: Normalize = Normalize(low, high)
    if look.contours:
        levels = MaxNLocator(LEVELS, symmetric=diverging and not has_limits).tick_values(low, high)
        norm, low, high = BoundaryNorm(levels, 256), float(levels[0]), float(levels[-1])
    extensions = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}
    slack = NEARLY * (high - low)
    extend = extensions[int(values[0] < low - slack), int(values[1] > high + slack)]
    colours = _map(name, (low, high) if diverging else None)
    return Scale(low, high, colours, norm, extend, _exponent(max(abs(low), abs(high))))


def _map(name: str, about_zero: tuple[float, float] | None) -> Colormap:
    """Return the colour map of a name. With a range `about_zero` (low, high), the map is cropped
    such that zero has the middle colour of the complete map."""
    if name not in colormaps:
        suggestion = did_you_mean(name, colormaps) or "; viridis, YlOrRd and RdBu_r are"
        raise ExperimentError(f"'{name}' is not a colour map of matplotlib{suggestion}")
    cmap = colormaps[name]
    if about_zero is not None:
        largest = max(map(abs, about_zero))
        low, high = (0.5 + 0.5 * end / largest for end in about_zero)
        cmap = ListedColormap(cmap(np.linspace(low, high, 256)))
    return cmap.with_extremes(bad=NOTHING)


def _exponent(largest: float) -> int:
    """Return the power of ten that is written once in the label and not at each tick."""
    if largest == 0.0 or not math.isfinite(largest):
        return 0
    power = math.floor(math.log10(largest) + 1e-9)
    return 0 if -3 <= power <= 3 else power
