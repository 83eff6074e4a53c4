"""Layers of a panel: fields as pixels, classes, dots and bonds, each of which shows a step."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.array_types import Array
from pbdkit.plotting.colours import OF_KINDS, Palette, Scale
from pbdkit.plotting.data import CutCells, ReferenceBody, Snapshot
from pbdkit.plotting.style import figure_of

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.collections import PathCollection
    from matplotlib.image import AxesImage


SAMPLES = 2_000_000
"""So many are taken at a time."""
MOST = 60_000_000
"""So many in all: where a body folds over itself again and again, fewer than there are pixels."""


@dataclass(frozen=True)
class PixelGrid:
    """The pixels of a picture: `box` (left, right, bottom, top) and how many `across` and `up`."""

    box: tuple[float, float, float, float]
    across: int
    up: int

    def places(self, position: Array) -> Array:
        """Positions, (..., 2), in pixels from the lower left corner."""
        left, right, bottom, top = self.box
        scale = np.array([self.across / (right - left), self.up / (top - bottom)], np.float32)
        return np.asarray((position - np.array([left, bottom])).astype(np.float32) * scale)

    def mean(self, corners: Array, values: Array, cut: OutlineCut | None = None) -> Array:
        """The values of cells, (up, across), between those at their corners, (cell, 4), in pixels
        (cell, 4, 2); NaN where no cell is, or what is `cut` off, and the mean where several are. No
        pixel within a cell is missed: samples lie no further apart than pixels are wide."""
        sums, counts = np.zeros(self.across * self.up), np.zeros(self.across * self.up)
        for cells, middles in _groups(corners):
            weights = _weights(middles)
            pixels, inside = self._pixels(corners[cells], weights, _kept(cut, cells, middles))
            sampled = (values[cells] @ weights.T).ravel()[inside]
            sums += np.bincount(pixels, sampled, len(sums))
            counts += np.bincount(pixels, minlength=len(sums))
        with np.errstate(invalid="ignore"):
            return (sums / counts).reshape(self.up, self.across)

    def latest(self, corners: Array, values: Array, cut: OutlineCut | None = None) -> Array:
        """The same of values that cannot be averaged: that of the nearest corner; of several in a
        pixel the largest."""
        found = np.full(self.across * self.up, -np.inf)
        for cells, middles in _groups(corners):
            weights = _weights(middles)
            pixels, inside = self._pixels(corners[cells], weights, _kept(cut, cells, middles))
            nearest = values[cells][:, weights.argmax(axis=1)].ravel()[inside]
            np.maximum.at(found, pixels, nearest)
        found[np.isinf(found)] = np.nan
        return found.reshape(self.up, self.across)

    def _pixels(self, corners: Array, weights: Array, kept: Array | None) -> tuple[Array, Array]:
        """In which pixel each sample lies, and which samples lie in any; of those `kept`."""
        x, y = ((corners[..., axis] @ weights.T).ravel() for axis in (0, 1))
        there = (x >= 0) & (x < self.across) & (y >= 0) & (y < self.up)
        inside = np.flatnonzero(there if kept is None else there & kept)
        return y[inside].astype(np.int64) * self.across + x[inside].astype(np.int64), inside


@dataclass(frozen=True)
class OutlineCut:
    """What an outline cuts off some cells: `row` (cell,) is the row of each in the cells that are
    cut, -1 where it is not."""

    cells: CutCells
    row: Array


def _kept(cut: OutlineCut | None, cells: Array, middles: Array) -> Array | None:
    """Which samples of some cells are not cut off, (cell and sample,); None where all are."""
    rows = cut.row[cells] if cut else np.empty(0, int)
    some = np.flatnonzero(rows >= 0)
    if cut is None or not len(some):
        return None
    kept = np.ones((len(cells), len(middles) ** 2), bool)
    kept[some] = ~cut.cells.beyond(rows[some], middles).reshape(len(some), -1)
    return kept.ravel()


def _weights(middles: Array) -> Array:
    """What corners weigh in each sample, (sample, 4), at some places along both sides."""
    u, v = (part.ravel() for part in np.meshgrid(middles, middles))
    return np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=1)


def _groups(corners: Array) -> Iterator[tuple[Array, Array]]:
    """Cells, by their rows, that take as many samples, and where these lie along both sides, as
    shares."""
    a, b, c, d = (corners[:, k] for k in range(4))
    along = np.maximum(abs(b - a), abs(c - d)), np.maximum(abs(d - a), abs(c - b))
    # Steps of samples along both sides together reach no further than a pixel: none is missed.
    finest = np.maximum(np.ceil(np.maximum(*(along[0] + along[1]).T)), 1.0)
    finest = np.maximum(finest * min(1.0, math.sqrt(MOST / max(1.0, (finest**2).sum()))), 1.0)
    # Rounded up to a power of the square root of two: few groups, and not many more samples.
    levels = np.ceil(2 * np.log2(finest) - 1e-6).astype(int)
    for level in np.unique(levels):
        count = math.ceil(2 ** (level / 2))
        middles = (np.arange(count, dtype=np.float32) + 0.5) / count
        cells = np.flatnonzero(levels == level)
        many = max(1, SAMPLES // count**2)
        for start in range(0, len(cells), many):
            yield cells[start : start + many], middles


INK, LINE, TORN, REST = "#404040", "#B0B0B0", "#CC3311", "#888888"


class Layer(ABC):
    """Something drawn into axes. `artists` are those that change from step to step."""

    artists: list[Artist]

    @abstractmethod
    def show(self, now: Snapshot) -> None:
        """Shows that step in place of the one before."""


class PixelField(Layer):
    """A quantity of particles over whole cells up to the outline, as pixels; particles in none are
    dots of a size in points, and a pixel where that is next to nothing. A corner beyond the outline
    that has no value takes the mean of the cells that meet there."""

    def __init__(
        self, ax: Axes, body: ReferenceBody, grid: PixelGrid, scale: Scale, size: float
    ) -> None:
        self._body, self._grid = body, grid
        self._image = _image(ax, grid, scale)
        self._alone = ax.scatter([], [], size**2, zorder=2, edgecolors=INK, linewidths=0.08 * size)
        self._alone.set(cmap=scale.colours, norm=scale.norm)
        self.artists = [self._image, self._alone]

    def show(self, now: Snapshot) -> None:
        """The mean of what lies in a pixel."""
        assert now.values is not None
        body, values = self._body, now.values.astype(np.float32)
        chosen = body.whole_cells(body.cells, now.broken)
        if not np.isfinite(values[body.inside]).all():
            values = _filled(values, body.cells[chosen], body.beyond)
            chosen = chosen[np.isfinite(values)[body.cells[chosen]].all(axis=1)]
        alone = _alone(body.cells[chosen], body.inside & ~body.beyond & np.isfinite(values))
        self._alone.set_offsets(now.position[alone])
        self._alone.set_array(now.values[alone])
        cells = _with(body.cells[chosen], alone)
        corners, cut = self._grid.places(now.position)[cells], _cut(body, chosen, len(alone))
        self._image.set_data(self._grid.mean(corners, values[cells], cut))


class BondField(Layer):
    """A quantity of bonds too many for lines, as pixels."""

    def __init__(self, ax: Axes, body: ReferenceBody, grid: PixelGrid, scale: Scale) -> None:
        self._body, self._grid, self._image = body, grid, _image(ax, grid, scale)
        self.artists = [self._image]

    def show(self, now: Snapshot) -> None:
        """The mean of what lies in a pixel."""
        assert now.values is not None
        shown = np.isfinite(now.values)
        corners = self._grid.places(now.position)[self._body.ends[shown][:, [0, 1, 1, 0]]]
        values = np.repeat(now.values[shown, None], 4, axis=1)
        self._image.set_data(self._grid.mean(corners, values))


class Classes(Layer):
    """What has a name, of particles too many for dots, as pixels."""

    def __init__(self, ax: Axes, body: ReferenceBody, grid: PixelGrid, palette: Palette) -> None:
        from matplotlib.colors import ListedColormap, Normalize

        self._body, self._grid, self._palette = body, grid, palette
        colours = ListedColormap([colour for _, colour in palette.colours.values()])
        self._image = ax.imshow(
            np.full((2, 2), np.nan), cmap=colours.with_extremes(bad=(0, 0, 0, 0)),
            norm=Normalize(0, len(palette.colours) - 1), extent=grid.box, origin="lower",
            aspect="equal", zorder=0, interpolation="nearest",
        )  # fmt: skip
        self.artists = [self._image]

    def show(self, now: Snapshot) -> None:
        """That of the nearest particle; of several in a pixel, the one on top."""
        body, ranks = self._body, self._palette.ranks(now)
        chosen, there = body.whole_cells(body.cells_with_frame, now.broken), np.isfinite(ranks)
        chosen = chosen[there[body.cells_with_frame[chosen]].all(axis=1)]
        alone = _alone(body.cells_with_frame[chosen], there & ~body.beyond)
        cells = _with(body.cells_with_frame[chosen], alone)
        # Where cells are cut the body is all there is: both kinds of cells are the same.
        cut = _cut(body, chosen, len(alone)) if body.inside.all() else None
        corners = self._grid.places(now.position)[cells]
        self._image.set_data(self._grid.latest(corners, ranks[cells], cut))


class Dots(Layer):
    """A dot at each particle, in the colour of its value or its class; none at those `hidden`."""

    def __init__(self, ax: Axes, size: float, colours: Scale | Palette, hidden: Array) -> None:
        self._colours, self._hidden = colours, hidden
        edge: dict[str, Any] = {"edgecolors": INK, "linewidths": 0.08 * size}
        self._dots: PathCollection = ax.scatter([], [], size**2, zorder=3, **edge)
        if isinstance(colours, Scale):
            self._dots.set(cmap=colours.colours, norm=colours.norm)
        self.artists = [self._dots]

    def show(self, now: Snapshot) -> None:
        """Leaders over followers over the frame."""
        palette = self._colours if isinstance(self._colours, Palette) else OF_KINDS
        ranks = palette.ranks(now)
        order = np.argsort(ranks, kind="stable")
        order = order[np.isfinite(ranks[order]) & ~self._hidden[order]]
        self._dots.set_offsets(now.position[order])
        if isinstance(self._colours, Scale):
            assert now.values is not None
            self._dots.set_array(np.ma.masked_invalid(now.values[order]))
        else:
            colours = [colour for _, colour in palette.colours.values()]
            self._dots.set_facecolor([colours[int(rank)] for rank in ranks[order]])


class BondLines(Layer):
    """Lines between neighbours: those that are whole, or, `broken`, those that are not."""

    def __init__(
        self, ax: Axes, body: ReferenceBody, width: float, *, broken: bool = False
    ) -> None:
        from matplotlib.collections import LineCollection

        self._body, self._broken = body, broken
        style: dict[str, Any] = {"colors": LINE, "zorder": 1}
        if broken:
            style = {"colors": TORN, "zorder": 2, "linestyles": (0, (2.5, 2.0)), "alpha": 0.7}
        self._lines = LineCollection([], linewidths=width, **style)
        ax.add_collection(self._lines, autolim=False)
        self.artists = [self._lines]

    def show(self, now: Snapshot) -> None:
        """At the places where the particles are."""
        ends = self._body.ends[now.broken == self._broken]
        self._lines.set_segments(list(now.position[ends]))


class BondValues(Layer):
    """A quantity of bonds, as the colours of lines; those without a value are not drawn."""

    def __init__(self, ax: Axes, body: ReferenceBody, width: float, scale: Scale) -> None:
        from matplotlib.collections import LineCollection

        self._body = body
        self._lines = LineCollection(
            [], linewidths=width, cmap=scale.colours, norm=scale.norm, zorder=2, capstyle="round"
        )
        ax.add_collection(self._lines, autolim=False)
        self.artists = [self._lines]

    def show(self, now: Snapshot) -> None:
        """At the places where the particles are."""
        assert now.values is not None
        shown = np.isfinite(now.values)
        self._lines.set_segments(list(now.position[self._body.ends[shown]]))
        self._lines.set_array(now.values[shown])


def draw_outline(ax: Axes, sides: Array) -> None:
    """Lines, (side, end, axis), that stay."""
    from matplotlib.collections import LineCollection

    lines = LineCollection(list(sides), colors=REST, linewidths=0.7, zorder=2.5)
    ax.add_collection(lines, autolim=False)


def draw_numbers(ax: Axes, numbers: Array, now: Snapshot, size: float) -> None:
    """The numbers of particles, to the upper right of dots of that size, in points; as many as do
    not overprint each other."""
    places, font = ax.transData.transform(now.position), 6.0
    point = figure_of(ax).dpi / 72
    taken: set[tuple[int, int]] = set()
    box = ax.bbox
    for number, (x, y), place in zip(numbers, places, now.position, strict=True):
        text = str(int(number))
        left, low = x + 0.5 * size * point, y + 0.5 * size * point
        right, high = left + (0.68 * len(text) * font + 1.5) * point, low + 1.25 * font * point
        columns = range(int(left / point), int(right / point) + 1)
        covered = {(c, r) for c in columns for r in range(int(low / point), int(high / point) + 1)}
        if covered & taken or right > box.x1 or high > box.y1:
            continue
        taken |= covered
        beside = (0.5 * size, 0.5 * size)
        ax.annotate(text, place, beside, textcoords="offset points", fontsize=font, zorder=4)


def _image(ax: Axes, grid: PixelGrid, scale: Scale) -> AxesImage:
    """Of the pixels of a grid; nothing where there is no value."""
    return ax.imshow(
        np.full((2, 2), np.nan), cmap=scale.colours.with_extremes(bad=(0, 0, 0, 0)),
        norm=scale.norm, extent=grid.box, origin="lower", aspect="equal", zorder=0,
        interpolation_stage="data",
    )  # fmt: skip


def _filled(values: Array, cells: Array, beyond: Array) -> Array:
    """The values, with those missing beyond the outline: each the mean of the cells that meet
    there, of which each counts the mean of its known corners."""
    known = np.isfinite(values)
    some = cells[(beyond & ~known)[cells].any(axis=1) & known[cells].any(axis=1)]
    means = np.nanmean(values[some], axis=1)
    corners = some.ravel()
    count = np.bincount(corners, minlength=len(values))
    total = np.bincount(corners, np.repeat(means, some.shape[1]), len(values))
    taken = beyond & ~known & (count > 0)
    return np.where(taken, total / np.maximum(count, 1), values).astype(np.float32)


def _cut(body: ReferenceBody, chosen: Array, alone: int) -> OutlineCut | None:
    """What the outline cuts off the chosen cells, with some after them that are not cut."""
    if body.cut is None:
        return None
    return OutlineCut(body.cut, np.append(body.cut.row[chosen], np.full(alone, -1)))


def _alone(cells: Array, chosen: Array) -> Array:
    """The rows of the chosen particles that are in none of the cells."""
    alone = chosen.copy()
    alone[cells] = False
    return np.flatnonzero(alone)


def _with(cells: Array, alone: Array) -> Array:
    """The cells, and one of no extent for each of those particles."""
    return np.concatenate([cells, np.repeat(alone[:, None], 4, axis=1)])
