"""Colours of kinds, roles and other classes, and the scale of colours of a quantity.

The colours of a quantity with both signs are centred at zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError, did_you_mean
from pbdkit.lattice.raster import FOLLOWER, FRAME, LEADER
from pbdkit.plotting.data import PlottedQuantity
from pbdkit.plotting.style import Look

if TYPE_CHECKING:
    from matplotlib.colors import Colormap, Normalize

    from pbdkit.plotting.data import Snapshot


KINDS = {
    int(FRAME): ("frame", "#F0E442"),
    int(FOLLOWER): ("follower", "#0072B2"),
    int(LEADER): ("leader", "#D55E00"),
}
"""Names and colours (of Okabe and Ito), in the order of drawing."""
OTHERS = ("#0072B2", "#F0E442", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")


@dataclass(frozen=True)
class Palette:
    """Names and colours by the number of a class, those on top last: of the kinds, or, not
    `of_kind`, of the values of a quantity."""

    colours: dict[int, tuple[str, str]]
    of_kind: bool

    def ranks(self, now: Snapshot) -> NDArray[Any]:
        """Which colour, counted from 0, each particle has; NaN where it is of no class."""
        classes = now.kind if self.of_kind or now.values is None else now.values
        found = np.full(len(now.kind), np.nan)
        for rank, number in enumerate(self.colours):
            found[classes == number] = rank
        return found


OF_KINDS = Palette(KINDS, True)


def palette_of(quantity: PlottedQuantity) -> Palette:
    """That of a quantity that has words."""
    if quantity.variable == "kind":
        return OF_KINDS
    words = enumerate(quantity.words.items())
    return Palette({k: (word, OTHERS[n % len(OTHERS)]) for n, (k, word) in words}, False)


DOTS, FIELD, BOTH_SIGNS = "viridis", "YlOrRd", "RdBu_r"
NOTHING = "#E0E0E0"
"""The colour of what has no value."""
NEARLY = 1e-9
"""What is so little of the largest is taken for zero, and for no difference."""
FROM_ZERO = 0.3
"""A scale whose lowest value is no more than that of its highest begins at zero."""
LEVELS = 12


@dataclass(frozen=True)
class Scale:
    """From `low` to `high`; `extend` as matplotlib says it: which values lie beyond. Numbers at the
    scale are to be multiplied by ten to the `exponent`."""

    low: float
    high: float
    colours: Colormap
    norm: Normalize
    extend: str
    exponent: int


def scale_of(
    quantity: PlottedQuantity, values: tuple[float, float], look: Look, filled: bool
) -> Scale:
    """The scale of a quantity whose values lie between these two.

    Where they have both signs, and zero is neutral, it reaches as far on either side, unless `look`
    has limits: neutral is zero even then. Raises ExperimentError for a map that is not there.
    """
    from matplotlib.colors import BoundaryNorm, Normalize
    from matplotlib.ticker import MaxNLocator

    low, high = values
    far = max(abs(low), abs(high))
    both = quantity.is_signed and low < -NEARLY * far and high > NEARLY * far
    limited = look.vmin is not None or look.vmax is not None
    if limited:
        low = low if look.vmin is None else look.vmin
        high = high if look.vmax is None else look.vmax
        if not low < high:
            raise ExperimentError(
                f"no value lies between the limits of the colours: values are {values[0]:g} to "
                f"{values[1]:g}; give both vmin and vmax"
            )
        both = quantity.is_signed and low < 0.0 < high
    elif both:
        low, high = -far, far
    elif 0.0 < low < FROM_ZERO * high and not quantity.is_place:
        low = 0.0
    elif FROM_ZERO * low < high < 0.0 and not quantity.is_place:
        high = 0.0
    elif high - low <= NEARLY * far:
        high = low + (far or 1.0)
    name = look.cmap or (BOTH_SIGNS if both else FIELD if filled else DOTS)
    if quantity.is_signed and low < high <= 0.0 and not look.cmap:
        name += "_r"  # what is next to zero has the same colour on either side
    norm: Normalize = Normalize(low, high)
    if look.contours:
        levels = MaxNLocator(LEVELS, symmetric=both and not limited).tick_values(low, high)
        norm, low, high = BoundaryNorm(levels, 256), float(levels[0]), float(levels[-1])
    beyond = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}
    slack = NEARLY * (high - low)
    extend = beyond[int(values[0] < low - slack), int(values[1] > high + slack)]
    colours = _map(name, (low, high) if both else None)
    return Scale(low, high, colours, norm, extend, _exponent(max(abs(low), abs(high))))


def _map(name: str, about_zero: tuple[float, float] | None) -> Colormap:
    """The map of that name; of one about zero only as far as the scale goes on either side."""
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    if name not in colormaps:
        near = did_you_mean(name, colormaps) or "; viridis, YlOrRd and RdBu_r are"
        raise ExperimentError(f"'{name}' is no map of colours{near}")
    found = colormaps[name]
    if about_zero is not None:
        far = max(map(abs, about_zero))
        low, high = (0.5 + 0.5 * end / far for end in about_zero)
        found = ListedColormap(found(np.linspace(low, high, 256)))
    return found.with_extremes(bad=NOTHING)


def _exponent(largest: float) -> int:
    """Of the power of ten that is told once, in place of zeros at every number."""
    if largest == 0.0 or not math.isfinite(largest):
        return 0
    power = math.floor(math.log10(largest) + 1e-9)
    return 0 if -3 <= power <= 3 else power
