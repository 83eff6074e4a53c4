"""The picture of a fit: what was measured, what was fitted, what is left, and where the data tell
each parameter."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.registry.extras import refuse_no_matplotlib

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from pbdkit.fitting.fitted import Fitted

Floats = NDArray[np.floating[Any]]
PANEL_IN, MARGIN_IN = 3.4, 0.9
WITHIN = 3.0
"""Residuals beyond so many times the noise have the last colour."""


def draw_fit(fitted: Fitted) -> Figure:
    """A row for ux and one for uy: measured, fitted, the residual over its noise; and for each
    parameter how much each point tells of it. Raises ExperimentError where matplotlib is missing.
    """
    refuse_no_matplotlib()
    from pbdkit.drawing.figures import new_figure

    field, information = fitted.field(), fitted.information()
    columns = 3 + len(information)
    wide, tall = np.ptp(field.points, axis=0)
    height = min(max(PANEL_IN * tall / wide, 1.2), 5.0)
    figure = new_figure(
        figsize=(columns * PANEL_IN, 2 * height + MARGIN_IN), dpi=150, layout="constrained"
    )
    axes = figure.subplots(2, columns, sharex=True, sharey=True)
    size = max(0.5, 0.55 * 72 * PANEL_IN * np.sqrt(tall / wide / len(field.points)))
    for row, name in enumerate(("ux", "uy")):
        measured, left = field.measured[:, row], field.residual[:, row]
        shown = [
            (f"{name} measured", measured, (measured.min(), measured.max()), "viridis"),
            (f"{name} fitted", measured - left, (measured.min(), measured.max()), "viridis"),
            (f"{name} residual / noise", left / fitted.noise, (-WITHIN, WITHIN), "RdBu_r"),
        ]
        for path, told in information.items():
            share = told.reshape(2, -1)[row] / max(t.max() for t in information.values())
            shown.append((f"{name} tells {path}", share, (0.0, 1.0), "magma_r"))
        for ax, (title, values, limits, colours) in zip(axes[row], shown, strict=True):
            _scatter(ax, field.points, values, limits, colours, size)
            ax.set_title(title, fontsize=9)
    for ax in axes[1]:
        ax.set_xlabel("x (lattice unit)", fontsize=9)
    for ax in axes[:, 0]:
        ax.set_ylabel("y (lattice unit)", fontsize=9)
    return figure


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
