"""The crack of a run: which bonds broke, when, and how long it became."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pbdkit.array_types import Array
from pbdkit.errors import ExperimentError, refuse_no_matplotlib
from pbdkit.io.layout import OF_BODY, rows_of
from pbdkit.plotting.curves import BROAD, TALL, Line, draw_lines, member_dims, new_axes
from pbdkit.plotting.style import in_its_units, label

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes


Kind = Literal["map", "length", "bonds"]
KINDS: tuple[Kind, ...] = ("map", "length", "bonds")
COLOURS, BODY, OLD, NEW = "viridis", "#B0B0B0", "#000000", "#D55E00"
WIDE_IN, LEAST_IN, TALLEST_IN, BESIDE_IN = 5.0, 1.8, 6.0, 1.3
"""The greatest width of the panel of a map, its least width and height, its greatest height, and
what the text around it takes."""
LONG, SCALE_IN, THIN = 2.5, 0.7, 0.08
"""Bodies so many times as wide as tall have their scale below them; what it takes there; there is
room for one tick at a side that is so short."""
POINTS, DENSE = 30_000, 100.0
"""Of more particles than that some are left out; the size of a dot, points, for one particle."""
APART, CRACKS = 1.5, 50
"""Bonds so many lengths apart are of one crack; so many cracks, the largest, are measured."""
DIRECTIONS = 180
"""In so many directions a crack is measured; the length is right within 4e-5 of it."""


def crack(dataset: xarray.Dataset, kind: Kind = "map", *, ax: Axes | None = None) -> Axes:
    """Draws what broke and returns the axes: the broken bonds on the body at rest, coloured by the
    step in which they broke (`map`); or over the steps the `length` of the longest crack, the
    largest distance between the middles of its bonds, or the number of broken `bonds`. What was
    cut, or broken from the start, counts too; bonds to the frame do not.

    Raises ExperimentError where bonds could not break, for several runs, and where matplotlib is
    missing.
    """
    if kind not in KINDS:
        raise ExperimentError(f"there is no picture '{kind}' of a crack; take {', '.join(KINDS)}")
    refuse_no_matplotlib()
    broken, values = _broken(dataset), np.empty(0)
    title = str(dataset.attrs.get("title", ""))
    if kind == "map":
        return _map(dataset, broken, title, ax)
    steps, counts = np.unique(broken.step, return_counts=True)
    if kind == "bonds":
        values, said, units = np.cumsum(counts), "number of broken bonds", ""
    else:
        reached = np.searchsorted(broken.step, steps, side="right") - 1
        factor, units = in_its_units(dataset["reference"].attrs)
        values, said = factor * _lengths(broken)[reached], "length of the longest crack"
    last = math.ceil(dataset["time"].values[-1])
    x = np.concatenate([[0], np.repeat(steps, 2), [last]])
    y = np.repeat([0.0, *values], 2)
    ax = ax or new_axes()
    ax.set_xlabel(label("time", "step", broad=BROAD))
    ax.set_ylabel(label(said, units, broad=TALL))
    draw_lines(ax, [Line(x, y)], title, "")
    for line in ax.lines:
        line.set_marker("")
    return ax


@dataclass(frozen=True)
class CrackBonds:
    """Broken bonds in the order of breaking: `step`, the `ends` (bond, end, axis) and the `middle`
    at rest, without those to the frame."""

    step: Array
    ends: Array
    middle: Array


def _broken(dataset: xarray.Dataset) -> CrackBonds:
    if "broken_step" not in dataset.variables:
        raise ExperimentError(
            "no bond could break: give the experiment `fracture` or `cuts`, and run again"
        )
    if more := member_dims(dataset["broken_step"]):
        raise ExperimentError(f"these are several runs, along {', '.join(more)}: take one by isel")
    steps = dataset["broken_step"].values
    rows = np.flatnonzero(steps >= 0)
    rows = rows[np.argsort(steps[rows], kind="stable")]
    if not len(rows):
        raise ExperimentError("no bond broke, nothing is to be drawn")
    particles = rows_of(dataset["number"].values, dataset["bond_ends"].values[rows])
    there = (particles >= 0).all(axis=1)
    if not there.any():
        raise ExperimentError("of the bonds that broke none is between particles that are here")
    rows, particles = rows[there], particles[there]
    of_body = (dataset["role"].values[particles] == OF_BODY).all(axis=1)
    of_body = of_body if of_body.any() else np.ones_like(of_body)
    ends = dataset["reference"].values[particles[of_body]]
    return CrackBonds(steps[rows[of_body]], ends, ends.mean(axis=1))


def _lengths(broken: CrackBonds) -> Array:
    """(bond,): how long the longest crack is once each bond is broken. Bonds that lie nearer to
    each other than APART lengths are of one crack."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    count = len(broken.middle)
    longest = np.linalg.norm(broken.ends[:, 1] - broken.ends[:, 0], axis=1).max()
    pairs = KDTree(broken.middle).query_pairs(APART * longest, output_type="ndarray")
    near = coo_array((np.ones(len(pairs)), tuple(pairs.T)), (count, count))
    which = connected_components(near, directed=False)[1]
    found = np.zeros(count)
    for one in np.argsort(-np.bincount(which))[:CRACKS]:
        rows = np.flatnonzero(which == one)
        until = np.searchsorted(rows, np.arange(count), side="right") - 1
        grown = _extents(broken.middle[rows])[np.maximum(until, 0)]
        found = np.maximum(found, np.where(until >= 0, grown, 0.0))
    return found


def _extents(middle: Array) -> Array:
    """(bond,): the largest distance between the middles of the bonds up to each."""
    found = np.zeros(len(middle))
    for angle in np.arange(DIRECTIONS) * (np.pi / DIRECTIONS):
        along = middle @ (np.cos(angle), np.sin(angle))
        found = np.maximum(found, np.maximum.accumulate(along) - np.minimum.accumulate(along))
    return found


def _map(dataset: xarray.Dataset, broken: CrackBonds, title: str, ax: Axes | None) -> Axes:
    from matplotlib.collections import LineCollection

    body = dataset["reference"].values[dataset["role"].values == OF_BODY]
    own, ax = ax is None, ax or _axes_around(body)
    dots = body[:: 1 + len(body) // POINTS]
    size = min(max(DENSE / np.sqrt(len(body)), 1.2), 6.0)
    ax.plot(*dots.T, ".", color=BODY, ms=size, mew=0.0, rasterized=len(dots) > 5000, zorder=0)
    later = np.unique(broken.step[broken.step > 0])
    groups = {"broken from the start": (broken.step == 0, OLD)}
    if len(later) == 1:
        groups[f"broken in step {later[0]}"] = (broken.step > 0, NEW)
    for said, (which, colour) in groups.items():
        if which.any():
            lines = LineCollection([*broken.ends[which]], colors=colour, linewidths=1.6)
            lines.set_label(said)
            ax.add_collection(lines, autolim=False)
    if len(later) > 1:
        _coloured(ax, broken, below=_is_long(body))
    units = dataset["reference"].attrs.get("units", "")
    x, y = (label(axis, units, broad=BROAD) for axis in "xy")
    ax.set(aspect="equal", title=label(title, broad=BROAD), xlabel=x, ylabel=y)
    ax.margins(0.04)
    low, sides = body.min(axis=0), np.ptp(body, axis=0)
    for axis, first, side in zip((ax.xaxis, ax.yaxis), low, sides, strict=True):
        if side < THIN * sides.max():
            axis.set_ticks([round(float(first), 6)])
    if ax.get_legend_handles_labels()[1]:
        style: dict[str, Any] = {"frameon": False, "fontsize": "small"}
        if whole := ax.get_figure(root=True) if own else None:
            whole.legend(loc="outside lower center", ncols=2, **style)
        else:
            ax.legend(**style)
    return ax


def _is_long(body: Array) -> bool:
    wide, tall = np.ptp(body, axis=0)
    return bool(wide > LONG * tall)


def _axes_around(body: Array) -> Axes:
    """Those of a figure of the body's shape, as far as there is room for text around it."""
    wide, tall = np.maximum(np.ptp(body, axis=0), 1e-9)
    height = min(max(WIDE_IN * tall / wide, LEAST_IN), TALLEST_IN)
    width = min(max(height * wide / tall, LEAST_IN), WIDE_IN)
    below = SCALE_IN if _is_long(body) else 0.0
    return new_axes(width + BESIDE_IN, height + BESIDE_IN + below)


def _coloured(ax: Axes, broken: CrackBonds, *, below: bool) -> None:
    """Bonds that broke on the way, by their steps, with the scale, beside the body or below."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.collections import LineCollection
    from matplotlib.colors import Normalize
    from matplotlib.ticker import MaxNLocator

    later = broken.step > 0
    scale = Normalize(broken.step[later].min(), broken.step[later].max())
    lines = LineCollection([*broken.ends[later]], cmap=COLOURS, norm=scale, linewidths=1.8)
    lines.set_array(broken.step[later])
    ax.add_collection(lines, autolim=False)
    ticks = MaxNLocator(6, integer=True)
    where: Any = {"location": "bottom" if below else "right", "aspect": 40 if below else 25}
    bar = ax.figure.colorbar(ScalarMappable(scale, COLOURS), ax=ax, ticks=ticks, **where)
    bar.set_label(label("time of breaking", "step", broad=TALL))
