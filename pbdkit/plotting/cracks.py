"""Pictures of cracks: the broken bonds with their steps of breaking, their number, and the length
of the longest crack."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.ticker import MaxNLocator
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from pbdkit.array_types import Array
from pbdkit.errors import ExperimentError
from pbdkit.io.layout import OF_BODY, rows_of
from pbdkit.plotting.curves import BROAD, STEPS, TALL, Chart, Line, Quantity, member_dims, new_axes
from pbdkit.plotting.style import in_its_units, label

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes

Kind = Literal["map", "length", "bonds"]
KINDS: tuple[Kind, ...] = ("map", "length", "bonds")
"""Kinds of pictures of cracks."""
CMAP = "viridis"
"""Colour map of the steps of breaking."""
BODY_COLOUR = "#B0B0B0"
"""Colour of the body."""
INITIAL_CRACK_COLOUR = "#000000"
"""Colour of bonds that are broken from the start."""
BROKEN_BOND_COLOUR = "#D55E00"
"""Colour of broken bonds if all broke in the same step."""
MAX_WIDTH_IN = 5.0
"""Maximum width of a map in inches."""
MIN_IN = 1.8
"""Minimum width and height of a map in inches."""
MAX_HEIGHT_IN = 6.0
"""Maximum height of a map in inches."""
TEXT_SPACE_IN = 1.3
"""Space for text around a map in inches."""
MAX_ASPECT = 2.5
"""Ratio of width to height above which the colour bar is below the body."""
SCALE_IN = 0.7
"""Height of a colour bar below the body in inches."""
MIN_TICK_ASPECT = 0.08
"""If the ratio of the shorter side to the longer side is smaller than this number, the shorter side
has a single tick."""
MAX_PARTICLES = 30_000
"""Maximum number of particles that are drawn."""
DOT_SIZE_PT = 100.0
"""Size of dots in points, multiplied by the square root of the number of particles."""
MAX_BOND_DISTANCE = 1.5
"""Maximum distance between neighbouring bonds of one crack, as a multiple of the rest length of
bonds."""
MAX_CRACKS = 50
"""Maximum number of cracks that are measured. The cracks with the largest numbers of bonds are
measured."""
DIRECTIONS = 180
"""Number of directions in which a crack is measured. With this number the relative error of its
length is below 4e-5."""


def draw_crack(dataset: xarray.Dataset, kind: Kind, ax: Axes | None) -> Axes:
    """Draw broken bonds in the same way as `pbdkit.plotting.crack`."""
    if kind not in KINDS:
        raise ExperimentError(
            f"'{kind}' is not a picture of a crack; use one of {', '.join(KINDS)}"
        )
    if kind == "map":
        return _map(dataset, _broken(dataset), str(dataset.attrs.get("title", "")), ax)
    ax = crack_chart(dataset, kind).draw(ax)
    for line in ax.lines:
        line.set_marker("")
    return ax


def crack_chart(dataset: xarray.Dataset, kind: Kind) -> Chart:
    """Return the chart of the number of broken bonds, or of the length of the longest crack."""
    broken, values = _broken(dataset), np.empty(0)
    steps, counts = np.unique(broken.step, return_counts=True)
    if kind == "bonds":
        values, meaning, units = np.cumsum(counts), "number of broken bonds", ""
    else:
        reached = np.searchsorted(broken.step, steps, side="right") - 1
        factor, units = in_its_units(dataset["reference"].attrs)
        values, meaning = factor * _lengths(broken)[reached], "length of the longest crack"
    last = math.ceil(dataset["time"].values[-1])
    x = np.concatenate([[0], np.repeat(steps, 2), [last]])
    y = np.repeat([0.0, *values], 2)
    title = str(dataset.attrs.get("title", ""))
    return Chart([Line(x, y)], STEPS, Quantity(meaning, units), title)


@dataclass(frozen=True)
class CrackBonds:
    """Broken bonds of the body in the order of breaking. `step` is the step of breaking; `ends`
    of shape (bond, end, axis) and `middle` are the positions of the ends and of the midpoints at
    rest."""

    step: Array
    ends: Array
    middle: Array


def _broken(dataset: xarray.Dataset) -> CrackBonds:
    if "broken_step" not in dataset.variables:
        raise ExperimentError(
            "no bond can break in this run; add `fracture` or `cuts` to the experiment, and run "
            "it again"
        )
    if extra_dims := member_dims(dataset["broken_step"]):
        raise ExperimentError(
            f"the dataset contains several runs, along {', '.join(extra_dims)}; select one with "
            "--at NAME=VALUE, in Python with ds.pbd.member(NAME=VALUE) or isel"
        )
    steps = dataset["broken_step"].values
    rows = np.flatnonzero(steps >= 0)
    rows = rows[np.argsort(steps[rows], kind="stable")]
    if not len(rows):
        raise ExperimentError("there is no crack to draw: no bond broke")
    particles = rows_of(dataset["number"].values, dataset["bond_ends"].values[rows])
    present = (particles >= 0).all(axis=1)
    if not present.any():
        raise ExperimentError(
            "there is no crack to draw: the dataset does not contain both "
            "particles of any broken bond"
        )
    rows, particles = rows[present], particles[present]
    of_body = (dataset["role"].values[particles] == OF_BODY).all(axis=1)
    of_body = of_body if of_body.any() else np.ones_like(of_body)
    ends = dataset["reference"].values[particles[of_body]]
    return CrackBonds(steps[rows[of_body]], ends, ends.mean(axis=1))


def _lengths(broken: CrackBonds) -> Array:
    """Return the length of the longest crack after each bond has broken, (bond,). Two bonds belong
    to the same crack if the distance between their midpoints is at most APART rest lengths."""
    count = len(broken.middle)
    longest = np.linalg.norm(broken.ends[:, 1] - broken.ends[:, 0], axis=1).max()
    pairs = KDTree(broken.middle).query_pairs(MAX_BOND_DISTANCE * longest, output_type="ndarray")
    near = coo_array((np.ones(len(pairs)), tuple(pairs.T)), (count, count))
    labels = connected_components(near, directed=False)[1]
    lengths = np.zeros(count)
    for number in np.argsort(-np.bincount(labels))[:MAX_CRACKS]:
        rows = np.flatnonzero(labels == number)
        until = np.searchsorted(rows, np.arange(count), side="right") - 1
        grown = _extents(broken.middle[rows])[np.maximum(until, 0)]
        lengths = np.maximum(lengths, np.where(until >= 0, grown, 0.0))
    return lengths


def _extents(middle: Array) -> Array:
    """Return, for each bond, the largest distance between the midpoints of all bonds up to and
    including it, (bond,)."""
    extents = np.zeros(len(middle))
    for angle in np.arange(DIRECTIONS) * (np.pi / DIRECTIONS):
        along = middle @ (np.cos(angle), np.sin(angle))
        extents = np.maximum(extents, np.maximum.accumulate(along) - np.minimum.accumulate(along))
    return extents


def _map(dataset: xarray.Dataset, broken: CrackBonds, title: str, ax: Axes | None) -> Axes:
    factor, units = in_its_units(dataset["reference"].attrs)
    body = factor * dataset["reference"].values[dataset["role"].values == OF_BODY]
    broken = replace(broken, ends=factor * broken.ends)
    is_new, ax = ax is None, ax or _axes_around(body)
    dots = body[:: 1 + len(body) // MAX_PARTICLES]
    size = min(max(DOT_SIZE_PT / np.sqrt(len(body)), 1.2), 6.0)
    ax.plot(
        *dots.T, ".", color=BODY_COLOUR, ms=size, mew=0.0, rasterized=len(dots) > 5000, zorder=0
    )
    later = np.unique(broken.step[broken.step > 0])
    groups = {"broken from the start": (broken.step == 0, INITIAL_CRACK_COLOUR)}
    if len(later) == 1:
        groups[f"broken in step {later[0]}"] = (broken.step > 0, BROKEN_BOND_COLOUR)
    for name, (rows, colour) in groups.items():
        if rows.any():
            lines = LineCollection([*broken.ends[rows]], colors=colour, linewidths=1.6)
            lines.set_label(name)
            ax.add_collection(lines, autolim=False)
    if len(later) > 1:
        _coloured(ax, broken, below=_is_long(body))
    x, y = (label(axis, units, width=BROAD) for axis in "xy")
    ax.set(aspect="equal", title=label(title, width=BROAD), xlabel=x, ylabel=y)
    ax.margins(0.04)
    low, sides = body.min(axis=0), np.ptp(body, axis=0)
    for axis, first, side in zip((ax.xaxis, ax.yaxis), low, sides, strict=True):
        if side < MIN_TICK_ASPECT * sides.max():
            axis.set_ticks([round(float(first), 6)])
    if ax.get_legend_handles_labels()[1]:
        style: dict[str, Any] = {"frameon": False, "fontsize": "small"}
        if whole := ax.get_figure(root=True) if is_new else None:
            whole.legend(loc="outside lower center", ncols=2, **style)
        else:
            ax.legend(**style)
    return ax


def _is_long(body: Array) -> bool:
    wide, tall = np.ptp(body, axis=0)
    return bool(wide > MAX_ASPECT * tall)


def _axes_around(body: Array) -> Axes:
    """Return the axes of a new figure. They have the aspect ratio of the body, unless the text
    would not have enough room."""
    wide, tall = np.maximum(np.ptp(body, axis=0), 1e-9)
    height = min(max(MAX_WIDTH_IN * tall / wide, MIN_IN), MAX_HEIGHT_IN)
    width = min(max(height * wide / tall, MIN_IN), MAX_WIDTH_IN)
    below = SCALE_IN if _is_long(body) else 0.0
    return new_axes(width + TEXT_SPACE_IN, height + TEXT_SPACE_IN + below)


def _coloured(ax: Axes, broken: CrackBonds, *, below: bool) -> None:
    """Add the bonds that broke during the run. They are coloured by step; a colour bar is placed
    beside or below the body."""
    later = broken.step > 0
    scale = Normalize(broken.step[later].min(), broken.step[later].max())
    lines = LineCollection([*broken.ends[later]], cmap=CMAP, norm=scale, linewidths=1.8)
    lines.set_array(broken.step[later])
    ax.add_collection(lines, autolim=False)
    ticks = MaxNLocator(6, integer=True)
    position: Any = {"location": "bottom" if below else "right", "aspect": 40 if below else 25}
    bar = ax.figure.colorbar(ScalarMappable(scale, CMAP), ax=ax, ticks=ticks, **position)
    bar.set_label(label("time of breaking", "step", width=TALL))
