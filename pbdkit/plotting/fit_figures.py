"""Figure of a fit: measurements, fitted values, residuals, and the sensitivity of the data to each
parameter."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.array_types import Floats
from pbdkit.errors import refuse_no_matplotlib
from pbdkit.fitting.observations import CurveObservation
from pbdkit.plugin.units import LENGTH

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    from pbdkit.fitting.fit_result import Fitted
    from pbdkit.fitting.specimens import FittedSpecimens


PANEL_IN = 3.8
"""Width of a panel in inches."""
MARGIN_IN = 0.75
"""Space above and below a panel in inches."""
CURVE_IN = 2.5
"""Height of the panel of a curve in inches."""
CURVES_PER_ROW = 3
"""Number of panels in a row of curves."""
ROW_IN = 0.3
"""Height of a specimen in inches."""
NORMAL_95 = 1.96
"""Half the width of a 95 % interval of a normal distribution, in standard deviations."""
COLOUR_LIMIT = 3.0
"""Limit of the colour scale of residuals, in multiples of the noise."""


def draw_fit(fitted: Fitted | FittedSpecimens) -> Figure:
    """Draw each measurement of a fit.

    A field has panels with ux and uy, measured and fitted. Further panels contain the residual,
    divided by the noise, and the sensitivity to each parameter. For wide bodies the panels are
    beside each other, otherwise below each other. For tracks and curves, the measured and the
    fitted values, the residual and the sensitivity are drawn over time or displacement.

    For several specimens there is a panel for each parameter, with the estimate and the 95 %
    interval of each specimen, the mean with its 95 % interval, and the mean with the standard
    deviation between specimens. Raises ExperimentError if matplotlib is missing.
    """
    refuse_no_matplotlib()
    from pbdkit.fitting.specimens import FittedSpecimens

    if isinstance(fitted, FittedSpecimens):
        return _draw_specimens(fitted)
    from pbdkit.plotting.figure_layout import new_figure

    count = 3 + len(fitted.values)
    kinds = [observation.kind for observation in fitted.problem.observations]
    sizes = [
        _field_size(fitted, n, count) if kind == "field" else _curve_size(count)
        for n, kind in enumerate(kinds)
    ]
    heights = [height for _, height in sizes]
    size = (max(width for width, _ in sizes), sum(heights))
    figure = new_figure(figsize=size, dpi=150, layout="constrained")
    parts = figure.subfigures(len(kinds), 1, squeeze=False, height_ratios=heights)[:, 0]
    for n, (part, kind) in enumerate(zip(parts, kinds, strict=True)):
        (_draw_field if kind == "field" else _draw_curve)(part, fitted, n)
    return figure


def _draw_specimens(fitted: FittedSpecimens) -> Figure:
    from pbdkit.plotting.figure_layout import new_figure

    means, specimens = fitted.means, [*fitted.fits]
    rows = [*specimens, "mean", "mean ± deviation"]
    size = (PANEL_IN * len(means), MARGIN_IN + ROW_IN * len(rows))
    figure = new_figure(figsize=size, dpi=150, layout="constrained")
    axes = figure.subplots(1, len(means), squeeze=False, sharey=True)[0]
    style: dict[str, Any] = {"fmt": "o", "markersize": 4, "linewidth": 1.2}
    for ax, (name, mean) in zip(axes, means.items(), strict=True):
        for row, specimen in enumerate(specimens):
            estimate = fitted.estimate(specimen, name)
            if estimate.identifiable:
                error = NORMAL_95 * estimate.error
                ax.errorbar(estimate.value, row, xerr=error, color="0.3", **style)
        if mean.identifiable:
            half = mean.interval[1] - mean.value
            ax.axvline(mean.value, color="0.6", linewidth=0.8)
            ax.errorbar(mean.value, len(specimens), xerr=half, color="C0", **style)
            ax.errorbar(mean.value, len(specimens) + 1, xerr=mean.deviation, color="C1", **style)
        ax.set_title(f"{name} ({mean.unit})" if mean.unit else name, fontsize=9)
        ax.tick_params(labelsize=8)
    axes[0].set_yticks(range(len(rows)), rows)
    axes[0].set_ylim(len(rows) - 0.5, -0.5)
    return figure


def _is_wide(fitted: Fitted, n: int) -> bool:
    wide, tall = np.ptp(fitted.field(n).points, axis=0)
    return bool(wide > tall)


def _field_size(fitted: Fitted, n: int, count: int) -> tuple[float, float]:
    wide, tall = np.ptp(fitted.field(n).points, axis=0)
    height = min(max(PANEL_IN * float(tall / wide), 0.8), 5.0) + MARGIN_IN
    components = len(fitted.field(n).components)
    if wide > tall:
        return components * PANEL_IN, count * height
    return count * PANEL_IN, components * height


def _curve_size(count: int) -> tuple[float, float]:
    return 2 * PANEL_IN, CURVE_IN * math.ceil(count / CURVES_PER_ROW)


def _draw_field(figure: SubFigure, fitted: Fitted, n: int) -> None:
    field, information = fitted.field(n), fitted.information(n)
    noise = fitted.misfits[n].noise
    largest = max((t.max() for t in information.values()), default=1.0)
    factor, unit = fitted.misfits[n].factor, fitted.misfits[n].unit
    counted = f" ({unit})" if unit else ""
    wide, count = _is_wide(fitted, n), 3 + len(information)
    components = field.components
    shape = (count, len(components)) if wide else (len(components), count)
    axes = figure.subplots(*shape, sharex=True, sharey=True, squeeze=False)
    area = float(np.prod(np.ptp(field.points, axis=0)) / np.ptp(field.points, axis=0)[0] ** 2)
    size = max(0.5, 0.55 * 72 * PANEL_IN * np.sqrt(area / len(field.points)))
    for column, name in enumerate(components):
        measured, residual = factor * field.measured[:, column], factor * field.residual[:, column]
        panels = [
            (f"{name} measured{counted}", measured, (measured.min(), measured.max()), "viridis"),
            (
                f"{name} fitted{counted}",
                measured - residual,
                (measured.min(), measured.max()),
                "viridis",
            ),
            (
                f"{name} residual / noise",
                residual / (factor * noise),
                (-COLOUR_LIMIT, COLOUR_LIMIT),
                "RdBu_r",
            ),
        ]
        for path, sensitivity in information.items():
            share = sensitivity.reshape(len(components), -1)[column] / largest
            panels.append((f"{name} sensitivity to {path}", share, (0.0, 1.0), "magma_r"))
        column_axes = axes[:, column] if wide else axes[column]
        for ax, (title, values, limits, colours) in zip(column_axes, panels, strict=True):
            _scatter(ax, factor * field.points, values, limits, colours, size)
            ax.set_title(title, fontsize=9)
    for ax in axes[-1]:
        ax.set_xlabel(f"x ({unit or LENGTH.lattice})", fontsize=9)
    for ax in axes[:, 0]:
        ax.set_ylabel(f"y ({unit or LENGTH.lattice})", fontsize=9)


def _draw_curve(figure: SubFigure, fitted: Fitted, n: int) -> None:
    numbers, information = fitted.numbers(n), fitted.information(n)
    count = 3 + len(information)
    grid = figure.subplots(math.ceil(count / CURVES_PER_ROW), CURVES_PER_ROW, squeeze=False)
    axes = grid.ravel()
    for ax in axes[count:]:
        ax.remove()
    factor, along, what, over = _in_units(fitted, n)
    measured, predicted, order = (
        factor * numbers.measured,
        factor * numbers.fitted,
        np.argsort(along),
    )
    axes[0].plot(along, measured, "o", color="0.7", markersize=4, label="measured")
    axes[0].plot(along[order], predicted[order], **_line(numbers.joined), label="fitted")
    axes[0].legend(fontsize=8)
    axes[1].plot(measured, predicted, ".", markersize=3)
    axes[1].axline((float(measured[0]),) * 2, slope=1.0, color="0.6", linewidth=0.8)
    axes[2].plot(along, numbers.residual / fitted.misfits[n].noise, ".", markersize=3)
    axes[2].axhline(0.0, color="0.6", linewidth=0.8)
    titles = [what, "fitted over measured", "residual / noise"]
    largest = max((t.max() for t in information.values()), default=1.0)
    for ax, (path, sensitivity) in zip(axes[3:], information.items(), strict=False):
        ax.plot(along, sensitivity / largest, ".", markersize=3)
        titles.append(f"sensitivity to {path}")
    for k, (ax, title) in enumerate(zip(axes, titles, strict=False)):
        ax.set_title(title, fontsize=9)
        ax.set_xlabel("measured" if k == 1 else over, fontsize=9)
        ax.tick_params(labelsize=8)


def _in_units(fitted: Fitted, n: int) -> tuple[float, Floats, str, str]:
    """Return, for tracks or a curve, the factor by which values are multiplied, the abscissa, and
    the labels of the values and of the abscissa. They are in the units of the experiment if it has
    units."""
    numbers, observed = fitted.numbers(n), fitted.misfits[n]
    observation = fitted.problem.observations[n]
    units, along, over = observation.experiment.units, numbers.along, numbers.over
    if units is None:
        return 1.0, along, numbers.what, over
    if isinstance(observation, CurveObservation) and observation.over.quantity is LENGTH:
        along, over = units.length_mm * along, f"{over} ({LENGTH.unit})"
    what = f"{numbers.what} ({observed.unit})" if observed.unit else numbers.what
    return observed.factor, along, what, over


def _line(joined: bool) -> dict[str, Any]:
    """Return the style of a fitted curve. Tracks of many points at the same time are not joined by
    lines."""
    return (
        {"color": "C0", "linewidth": 1.2}
        if joined
        else {
            "color": "C0",
            "marker": "x",
            "linestyle": "",
            "markersize": 3,
        }
    )


def _scatter(
    ax: Axes, at: Floats, values: Floats, limits: tuple[float, float], colours: str, size: float
) -> None:
    low, high = limits
    style: dict[str, Any] = {"cmap": colours, "vmin": low, "vmax": high, "rasterized": True}
    drawn = ax.scatter(at[:, 0], at[:, 1], s=size**2, c=values, linewidths=0, **style)
    ax.set_aspect("equal")
    ax.tick_params(labelsize=8)
    bar = ax.figure.colorbar(drawn, ax=ax, location="bottom", aspect=30, shrink=0.9)
    bar.ax.tick_params(labelsize=7)
    bar.ax.ticklabel_format(scilimits=(-3, 4))
    bar.ax.xaxis.get_offset_text().set_fontsize(7)
