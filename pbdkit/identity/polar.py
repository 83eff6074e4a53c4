"""The polar picture of an identity: what waves and bars do by direction."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.identity.dispersion import LongWaves
from pbdkit.identity.elastic_constants import DIFFUSION, ELASTICITY, Elasticity
from pbdkit.identity.identity import Identity
from pbdkit.identity.verdict import verdict

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
DIRECTIONS = np.radians(np.arange(0.0, 361.0))
LENGTHS = (
    (1e4, "long waves", "#0072B2"),
    (6.0, "6 h long", "#009E73"),
    (4.0, "4 h long", "#E69F00"),
)
"""Wavelengths in units of the spacing (the first stands for long waves to some 1e-7), their names,
and colours of Okabe and Ito."""
POISSON = ((1, "#CC79A7", "Poisson's ratio"), (-1, "#D55E00", "Poisson's ratio, negative"))
MODULUS, INK = "#0072B2", "#404040"
FAST: Final = "-"
SLOW: Final = "--"


def by_direction(found: Identity) -> Figure:
    """The diffusivity of waves of three lengths by direction; of elasticity also Young's modulus
    and Poisson's ratio of bars cut along it.

    ExperimentError where there are no long waves that decay.
    """
    from matplotlib.figure import Figure

    if found.long is None or found.long.slow.smallest < 0.0:
        why = "; ".join(found.reasons)
        raise ExperimentError(f"'{found.rule}' has no waves to draw: {why}", ("rule",))
    elastic = found.body if found.kind == ELASTICITY else None
    panels = 2 if elastic else 1
    drawn = Figure(figsize=(0.6 + 3.8 * panels, 4.7), dpi=200)
    drawn.subplots_adjust(0.06 / panels, 0.17, 1 - 0.06 / panels, 0.79, wspace=0.2)
    _draw_waves(_panel(drawn, 1, panels), found, found.long)
    if elastic:
        _draw_bars(_panel(drawn, 2, panels), elastic)
    what = f"{found.rule}, {found.lattice} lattice, {found.neighbours}"
    drawn.suptitle(f"{found.name}: {verdict(found)}\n{what}", fontsize=9, y=0.98)
    return drawn


def _panel(drawn: Figure, number: int, panels: int) -> Any:
    panel: Any = drawn.add_subplot(1, panels, number, projection="polar")
    panel.tick_params(labelsize=7, labelcolor=INK)
    panel.tick_params(axis="x", pad=0)
    panel.grid(linewidth=0.4)
    return panel


def _draw_waves(panel: Any, found: Identity, long: LongWaves) -> None:
    from matplotlib.lines import Line2D

    one = found.kind == DIFFUSION
    normal = np.stack([np.cos(DIRECTIONS), np.sin(DIRECTIONS)], axis=-1)
    for length, _, colour in LENGTHS:
        k = 2 * np.pi / length
        rates = long.waves.rates(k * normal) / k**2
        for wave, style in ((0, FAST),) if one else ((0, FAST), (1, SLOW)):
            panel.plot(DIRECTIONS, rates[:, wave], style, color=colour, linewidth=1.4)
    entries = [(Line2D([], [], color=colour), name) for _, name, colour in LENGTHS]
    if not one:
        entries += [(Line2D([], [], color=INK, linestyle=FAST), "the faster wave")]
        entries += [(Line2D([], [], color=INK, linestyle=SLOW), "the slower wave")]
    _finish(panel, "rate over k² of waves, by direction (h²/step)", entries)


def _draw_bars(panel: Any, body: Elasticity) -> None:
    degrees = np.degrees(DIRECTIONS)
    modulus = np.array([body.youngs_modulus(angle) for angle in degrees])
    ratio = np.array([body.poisson_ratio(angle) for angle in degrees], float)
    (line,) = panel.plot(DIRECTIONS, modulus / modulus.max(), color=MODULUS, linewidth=1.4)
    entries = [(line, "Young's modulus, largest 1")]
    for sign, colour, label in POISSON:
        if (sign * ratio > 0.0).any():
            shown = np.where(sign * ratio >= 0.0, sign * ratio, np.nan)
            (line,) = panel.plot(DIRECTIONS, shown, color=colour, linewidth=1.4)
            entries.append((line, label))
    _finish(panel, "bars in plane stress, by direction of pull", entries)


def _finish(panel: Any, title: str, entries: list[tuple[Any, str]]) -> None:
    panel.set_rlim(0.0, 1.06 * max(np.nanmax(line.get_ydata()) for line in panel.lines))
    panel.yaxis.get_major_locator().base.set_params(nbins=4)
    panel.set_rlabel_position(22.5)
    panel.set_title(title, fontsize=8)
    handles, labels = zip(*entries, strict=True)
    panel.legend(
        handles,
        labels,
        loc="upper center",
        bbox_to_anchor=(0.5, -0.09),
        ncols=min(3, len(entries)),
        fontsize=7,
        frameon=False,
    )
