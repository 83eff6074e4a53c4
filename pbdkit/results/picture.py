"""Pictures of a dataset's configurations: kinds, numbers, a variable as colours or contours."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.results.snapshot import (
    Snapshot,
    counted_in,
    label,
    plain,
    take_snapshots,
    variable_label,
)
from pbdkit.scene.raster import FOLLOWER, FRAME, LEADER

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes
    from matplotlib.colors import Normalize

KINDS = {
    FRAME: ("frame", "#F0E442"),
    FOLLOWER: ("follower", "#0072B2"),
    LEADER: ("leader", "#D55E00"),
}
"""Names and colours (of Okabe and Ito), in the order of drawing."""
INK, LINE = "#404040", "#B0B0B0"
DOT_COLOURS, CONTOUR_COLOURS = "viridis", "YlOrRd"
DETAILED = 20_000
"""Up to so many particles each is a dot; bonds are drawn, and numbers may be."""
PAGE_IN, PANEL_IN, DPI, NUMBERED_PT = 7.2, 4.6, 200, 24.0
"""The widths of the panels of a page and of one alone, and how far apart numbers lie at rest."""


@dataclass(frozen=True)
class Look:
    """What the panels of a picture share: limits, the distance of particles at rest, the scale of
    the values (None where there are none), whether numbers are written, and whether particles are
    too many for dots."""

    box: tuple[float, float, float, float]
    spacing: float
    norm: Normalize | None
    numbers: bool
    crowded: bool


def draw(
    dataset: xarray.Dataset,
    times: Iterable[int | None],
    *,
    color: str | None = None,
    contours: bool = False,
    numbers: bool = False,
    ax: Axes | None = None,
) -> list[Axes]:
    """Draws recorded steps (None: the last), a panel each, with the same limits and one scale of
    colours, and returns their axes.

    Particles have the colours of their kinds, or of the variable `color` (the length of a vector);
    with `contours` its filled contours over the body lie below the particles' kinds. `numbers`
    writes the number at each particle. Without `ax`, for one step, a new figure is made.

    Raises ExperimentError for a step that was not recorded, for no step at all, for a variable that
    cannot be drawn, and where matplotlib is missing.
    """
    if find_spec("matplotlib") is None:
        raise ExperimentError("pictures need matplotlib: pip install 'pbdkit[plot]'")
    snapshots = take_snapshots(dataset, times, color, contours)
    if not snapshots:
        raise ExperimentError("a figure needs at least one time")
    look, title = _look(dataset, snapshots, numbers), plain(dataset.attrs.get("title", ""))
    axes = _canvas(len(snapshots), look) if ax is None else [ax]
    for panel, snapshot in zip(axes, snapshots, strict=True):
        _paint(panel, dataset, snapshot, look)
        panel.set_title(f"step {snapshot.step}")
    if len(axes) == 1:
        axes[0].set_title(f"{title}, step {snapshots[0].step}".lstrip(", "))
    else:
        axes[0].figure.suptitle(title)
    _explain(axes, dataset, look, color, contours)
    return axes


def _look(dataset: xarray.Dataset, snapshots: list[Snapshot], numbers: bool) -> Look:
    count = dataset.sizes["particle"]
    if numbers and count > DETAILED:
        raise ExperimentError(f"{count} particles are too many to number; at most {DETAILED}")
    width, height = np.ptp(dataset["reference"].values, axis=0)
    spacing = float(max(math.sqrt(width * height / count), max(width, height) / count)) or 1.0
    low = np.min([s.position.min(axis=0) for s in snapshots], axis=0) - spacing
    high = np.max([s.position.max(axis=0) for s in snapshots], axis=0) + spacing
    norm = None if snapshots[0].values is None else _norm(snapshots)
    box = (low[0], high[0], low[1], high[1])
    return Look(box, spacing, norm, numbers, count > DETAILED)


def _norm(snapshots: list[Snapshot]) -> Normalize:
    """The scale of all values shown, with steps at round levels where there are contours."""
    from matplotlib import colors, ticker

    values = np.concatenate([s.shown_values() for s in snapshots])
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)
    high = high if high > low else low + 1.0
    if snapshots[0].triangles is None:
        return colors.Normalize(low, high)
    return colors.BoundaryNorm(ticker.MaxNLocator(12).tick_values(low, high), 256)


def _columns(panels: int, look: Look) -> int:
    """How many panels stand side by side, so that the whole is a little wider than tall."""
    left, right, bottom, top = look.box
    shape = (right - left) / (top - bottom) / 1.3

    def unevenness(columns: int) -> float:
        rows = math.ceil(panels / columns)
        return abs(math.log(shape * columns / rows)) + 0.4 * (rows * columns - panels)

    return min(range(1, panels + 1), key=unevenness)


def _canvas(panels: int, look: Look) -> list[Axes]:
    """The axes of a new figure, which is about as wide as a page."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    left, right, bottom, top = look.box
    columns = _columns(panels, look)
    rows = math.ceil(panels / columns)
    wide = PANEL_IN if panels == 1 else PAGE_IN / columns
    if look.numbers:
        wide = max(wide, NUMBERED_PT / 72 * (right - left) / look.spacing)
    tall = min(max(wide * (top - bottom) / (right - left), 0.4 * wide), 3 * wide)
    beside = 0.6 if look.norm is None else 1.6
    size = (columns * wide + beside, rows * (tall + 0.3) + 0.9)
    layout = ConstrainedLayoutEngine(compress=True, w_pad=0.06, h_pad=0.06)
    whole = Figure(size, DPI, layout=layout)
    axes = [whole.add_subplot(rows, columns, n + 1) for n in range(panels)]
    for n, ax in enumerate(axes):  # labels where no panel is below, or to the left
        lowest, leftmost = n >= panels - columns, n % columns == 0
        ax.tick_params(labelbottom=lowest, labelleft=leftmost)
        ax.xaxis.label.set_visible(lowest)
        ax.yaxis.label.set_visible(leftmost)
    return axes


def _paint(ax: Axes, dataset: xarray.Dataset, now: Snapshot, look: Look) -> None:
    """One configuration in one pair of axes, without title and legend."""
    from matplotlib.collections import LineCollection

    (left, right, bottom, top), units = look.box, counted_in(dataset["position"].attrs)
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal",
           xlabel=label("x", units), ylabel=label("y", units))  # fmt: skip
    inches = ax.bbox.transformed(ax.figure.dpi_scale_trans.inverted())
    apart = 72 * look.spacing * min(inches.width / (right - left), inches.height / (top - bottom))
    size = 1.3 * apart if look.crowded else min(0.4 * apart, 7.0)
    if not look.crowded:
        ends = list(now.position[now.bonds])
        ax.add_collection(LineCollection(ends, colors=LINE, linewidths=0.08 * size, zorder=0))
    _dots(ax, now, look, size)
    if look.numbers:
        for number, place in zip(dataset["number"].values, now.position, strict=True):
            beside = (0.5 * size, 0.5 * size)
            ax.annotate(str(number), place, beside, textcoords="offset points", fontsize=6)


def _dots(ax: Axes, now: Snapshot, look: Look, size: float) -> None:
    """Contours, and the particles on them: dots, or squares, unless those hid the contours."""
    from matplotlib.colors import BoundaryNorm
    from matplotlib.tri import Triangulation

    (x, y), values, mesh, norm = now.position.T, now.values, now.triangles, look.norm
    dense = {"marker": "s", "edgecolors": "none", "rasterized": True}
    style: dict[str, Any] = dense if look.crowded else {"edgecolors": INK, "lw": 0.08 * size}
    if values is not None and mesh is None:
        style |= {"cmap": DOT_COLOURS, "norm": norm, "plotnonfinite": True}
        ax.scatter(x, y, (1.2 * size) ** 2, values, **style)
        return
    if values is not None and mesh is not None and len(mesh) and isinstance(norm, BoundaryNorm):
        fill, levels = Triangulation(x, y, mesh), norm.boundaries
        ax.tricontourf(fill, np.nan_to_num(values), levels, cmap=CONTOUR_COLOURS, norm=norm)
    if mesh is None or not look.crowded:
        for kind, (_, colour) in KINDS.items():
            ax.scatter(x[now.kind == kind], y[now.kind == kind], size**2, colour, **style)


def _explain(
    axes: list[Axes], dataset: xarray.Dataset, look: Look, color: str | None, contours: bool
) -> None:
    """The colour bar and the legend of the kinds, as far as they are used."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.lines import Line2D
    from matplotlib.transforms import ScaledTranslation

    ax, whole = axes[0], axes[0].figure
    if color is not None:
        colours = ScalarMappable(look.norm, CONTOUR_COLOURS if contours else DOT_COLOURS)
        bar = whole.colorbar(colours, ax=axes, aspect=25)
        bar.set_label(variable_label(dataset, color))
        bar.ax.ticklabel_format(axis="y", scilimits=(-3, 4))
    if color is not None and (look.crowded or not contours):
        return
    present = np.unique(dataset["kind"].values)
    handles = [
        Line2D([], [], ls="", marker="o", ms=5, mfc=colour, mec=INK, mew=0.5, label=name)
        for kind, (name, colour) in reversed(KINDS.items())
        if kind in present
    ]
    style = {"handles": handles, "ncols": 3, "frameon": False, "handletextpad": 0.1}
    if len(axes) > 1:
        whole.legend(loc="outside lower center", **style)
        return
    below = ax.transAxes + ScaledTranslation(0, -0.45, whole.dpi_scale_trans)
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, 0), bbox_transform=below, **style)
