"""Layers of a panel: fields and classes as pixels, dots, and bonds. Each layer shows one step."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.path import Path

from pbdkit.array_types import Array
from pbdkit.plotting.colours import OF_KINDS, Palette, Scale
from pbdkit.plotting.data import CutCells, ReferenceBody, Snapshot
from pbdkit.plotting.outline_path import OutlinePath
from pbdkit.plotting.style import figure_of

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage


MAX_SAMPLES_AT_ONCE = 2_000_000
"""Maximum number of samples that are evaluated at a time."""
MAX_PIXELS = 60_000_000
"""Maximum total number of samples. Because of it, a body that is folded over itself many times may
have fewer samples than pixels."""


@dataclass(frozen=True)
class PixelGrid:
    """Pixels of a picture. `box` is the part of the plane that it shows (left, right, bottom, top);
    `across` and `up` are the numbers of pixels."""

    box: tuple[float, float, float, float]
    across: int
    up: int

    def places(self, position: Array) -> Array:
        """Convert positions, (..., 2), to pixels, counted from the lower left corner."""
        xmin, xmax, ymin, ymax = self.box
        scale = np.array([self.across / (xmax - xmin), self.up / (ymax - ymin)], np.float32)
        return np.asarray((position - np.array([xmin, ymin])).astype(np.float32) * scale)

    def pixel(self, place: Array) -> Array:
        """Return the corners of the pixel that contains a place."""
        xmin, xmax, ymin, ymax = self.box
        size = np.array([(xmax - xmin) / self.across, (ymax - ymin) / self.up])
        low = np.floor((place - np.array([xmin, ymin])) / size)
        square = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
        return np.asarray([xmin, ymin] + size * (low + square))

    def mean(self, corners: Array, values: Array, cut: OutlineCut | None = None) -> Array:
        """Return an array of shape (up, across) with the values at the pixels. They are
        interpolated from `values` at the corners of cells, of shape (cell, 4). `corners` are the
        positions of the corners in pixels, (cell, 4, 2). The result is NaN at pixels outside all
        cells and in parts of cells that are `cut` off. If cells overlap, it is the mean. The
        distance of samples is at most the width of a pixel, so that no pixel within a cell is
        missed."""
        sums, counts = np.zeros(self.across * self.up), np.zeros(self.across * self.up)
        for cells, middles in _groups(corners):
            weights = _weights(middles)
            pixels, inside = self._pixels(
                corners[cells], weights, _within_outline(cut, cells, middles)
            )
            sampled = (values[cells] @ weights.T).ravel()[inside]
            sums += np.bincount(pixels, sampled, len(sums))
            counts += np.bincount(pixels, minlength=len(sums))
        with np.errstate(invalid="ignore"):
            return (sums / counts).reshape(self.up, self.across)

    def latest(self, corners: Array, values: Array, cut: OutlineCut | None = None) -> Array:
        """Return the values at the pixels. The arguments are the same as those of `mean`, but the
        values cannot be averaged. Each sample has the value of the nearest corner, and each pixel
        the largest value of its samples."""
        largest = np.full(self.across * self.up, -np.inf)
        for cells, middles in _groups(corners):
            weights = _weights(middles)
            pixels, inside = self._pixels(
                corners[cells], weights, _within_outline(cut, cells, middles)
            )
            nearest = values[cells][:, weights.argmax(axis=1)].ravel()[inside]
            np.maximum.at(largest, pixels, nearest)
        largest[np.isinf(largest)] = np.nan
        return largest.reshape(self.up, self.across)

    def _pixels(self, corners: Array, weights: Array, mask: Array | None) -> tuple[Array, Array]:
        """Return the indices of the samples that lie within the picture and for which `mask` is
        true, and the pixels of these samples."""
        x, y = ((corners[..., axis] @ weights.T).ravel() for axis in (0, 1))
        within_box = (x >= 0) & (x < self.across) & (y >= 0) & (y < self.up)
        inside = np.flatnonzero(within_box if mask is None else within_box & mask)
        return y[inside].astype(np.int64) * self.across + x[inside].astype(np.int64), inside


@dataclass(frozen=True)
class OutlineCut:
    """The parts of cells that an outline cuts off. `row` of shape (cell,) is the row of each cell
    in the table of cut `cells`, and -1 if the cell is not cut."""

    cells: CutCells
    row: Array


def _within_outline(cut: OutlineCut | None, cells: Array, middles: Array) -> Array | None:
    """Return a mask of shape (cell and sample,) over the samples of some cells. It is false for
    samples that the outline cuts off. Return None if no sample is cut off."""
    rows = cut.row[cells] if cut else np.empty(0, int)
    cut_cells = np.flatnonzero(rows >= 0)
    if cut is None or not len(cut_cells):
        return None
    mask = np.ones((len(cells), len(middles) ** 2), bool)
    mask[cut_cells] = ~cut.cells.outside(rows[cut_cells], middles).reshape(len(cut_cells), -1)
    return mask.ravel()


def _weights(middles: Array) -> Array:
    """Return the weights of the four corners of a cell for each sample, (sample, 4). `middles` are
    the relative positions of the samples along both sides of the cell."""
    u, v = (part.ravel() for part in np.meshgrid(middles, middles))
    return np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=1)


def _groups(corners: Array) -> Iterator[tuple[Array, Array]]:
    """Generate groups of cells with the same number of samples. A group consists of the rows of the
    cells, and of the relative positions of the samples, from 0 to 1, along both sides of a cell."""
    a, b, c, d = (corners[:, k] for k in range(4))
    along = np.maximum(abs(b - a), abs(c - d)), np.maximum(abs(d - a), abs(c - b))
    # The distance between samples along one side plus that along the other side is at most a pixel,
    # so that no pixel is missed.
    finest = np.maximum(np.ceil(np.maximum(*(along[0] + along[1]).T)), 1.0)
    finest = np.maximum(finest * min(1.0, math.sqrt(MAX_PIXELS / max(1.0, (finest**2).sum()))), 1.0)
    # The numbers are rounded up to powers of √2. There are then few groups, and not many more
    # samples.
    levels = np.ceil(2 * np.log2(finest) - 1e-6).astype(int)
    for level in np.unique(levels):
        count = math.ceil(2 ** (level / 2))
        middles = (np.arange(count, dtype=np.float32) + 0.5) / count
        cells = np.flatnonzero(levels == level)
        block = max(1, MAX_SAMPLES_AT_ONCE // count**2)
        for start in range(0, len(cells), block):
            yield cells[start : start + block], middles


DOT_COLOUR = "#404040"
"""Colour of dots without values."""
BOND_COLOUR = "#B0B0B0"
"""Colour of intact bonds."""
BROKEN_BOND_COLOUR = "#CC3311"
"""Colour of broken bonds."""
OUTLINE_COLOUR = "#888888"
"""Colour of the outline."""


class Layer(ABC):
    """Part of a picture that is drawn into axes. `artists` are the artists that change from step to
    step."""

    artists: list[Artist]

    @abstractmethod
    def show(self, snapshot: Snapshot) -> None:
        """Show a step in place of the previous one."""

    def rescale(self, scale: Scale) -> None:
        """Set the limits of the colours of values."""
        for artist in self.artists:
            if isinstance(artist, ScalarMappable):
                artist.set_norm(scale.norm)


class PixelField(Layer):
    """A quantity of particles. It is drawn as pixels on the cells that have no broken bond, and
    clipped to the outline of these cells.

    Particles outside these cells are drawn as dots with a size in points, or as single pixels if
    dots would be invisible. A corner outside the outline may have no value; it receives the mean
    over the cells that meet at it.
    """

    def __init__(
        self, ax: Axes, body: ReferenceBody, grid: PixelGrid, scale: Scale, size: float
    ) -> None:
        self._body, self._grid, self._size = body, grid, size
        self._image = _image(ax, grid, scale)
        self._outline: tuple[Array, OutlinePath] | None = None
        self._alone = ax.scatter(
            [], [], size**2, zorder=2, edgecolors=DOT_COLOUR, linewidths=0.08 * size
        )
        self._alone.set(cmap=scale.colours, norm=scale.norm)
        self.artists = [self._image, self._alone]

    def show(self, snapshot: Snapshot) -> None:
        """Show the mean in each pixel."""
        assert snapshot.values is not None
        body, values = self._body, snapshot.values.astype(np.float32)
        chosen = body.whole_cells(body.cells, snapshot.broken)
        if not np.isfinite(values[body.inside]).all():
            values = _filled(values, body.cells[chosen], body.outside)
            chosen = chosen[np.isfinite(values)[body.cells[chosen]].all(axis=1)]
        alone = _alone(body.cells[chosen], body.inside & ~body.outside & np.isfinite(values))
        self._alone.set_offsets(snapshot.position[alone])
        self._alone.set_array(snapshot.values[alone])
        cells = _with(body.cells[chosen], alone)
        corners, cut = self._grid.places(snapshot.position)[cells], _cut(body, chosen, len(alone))
        pixels = self._grid.mean(corners, values[cells], cut)
        path = self._clip_path(chosen, snapshot.position, corners[: len(chosen)], alone)
        if path is not None:
            pixels = _beyond_edges(pixels)
            self._image.set_clip_path(path, self._image.axes.transData)
        else:
            self._image.set_clip_path(self._image.axes.patch)
        self._image.set_data(pixels)

    def _clip_path(
        self, chosen: Array, position: Array, corners: Array, alone: Array
    ) -> Path | None:
        """Return the outline of the chosen cells and of the pixels of particles outside cells.
        Return None if cells are inverted, because then the outline may cancel."""
        if not len(chosen) or not np.isfinite(corners).all() or _are_inverted(corners):
            return None
        if self._outline is None or not np.array_equal(self._outline[0], chosen):
            body = self._body
            rows = body.cut.row[chosen] if body.cut else np.full(len(chosen), -1)
            self._outline = (
                chosen,
                OutlinePath.of(body.cells[chosen], body.cut, rows, body.reference),
            )
        path = self._outline[1].path(position)
        if not len(alone) or self._size:
            return path
        squares = [self._grid.pixel(place) for place in position[alone]]
        return Path.make_compound_path(path, *map(Path, squares))


class BondField(Layer):
    """A quantity of bonds. It is drawn as pixels if there are too many bonds for lines."""

    def __init__(self, ax: Axes, body: ReferenceBody, grid: PixelGrid, scale: Scale) -> None:
        self._body, self._grid, self._image = body, grid, _image(ax, grid, scale)
        self.artists = [self._image]

    def show(self, snapshot: Snapshot) -> None:
        """Show the mean in each pixel."""
        assert snapshot.values is not None
        finite = np.isfinite(snapshot.values)
        corners = self._grid.places(snapshot.position)[self._body.ends[finite][:, [0, 1, 1, 0]]]
        values = np.repeat(snapshot.values[finite, None], 4, axis=1)
        self._image.set_data(self._grid.mean(corners, values))


class Classes(Layer):
    """Classes of particles. They are drawn as pixels if there are too many particles for dots."""

    def __init__(self, ax: Axes, body: ReferenceBody, grid: PixelGrid, palette: Palette) -> None:
        self._body, self._grid, self._palette = body, grid, palette
        colours = ListedColormap([colour for _, colour in palette.colours.values()])
        self._image = ax.imshow(
            np.full((2, 2), np.nan), cmap=colours.with_extremes(bad=(0, 0, 0, 0)),
            norm=Normalize(0, len(palette.colours) - 1), extent=grid.box, origin="lower",
            aspect="equal", zorder=0, interpolation="nearest",
        )  # fmt: skip
        self.artists = [self._image]

    def show(self, snapshot: Snapshot) -> None:
        """Show in each pixel the class of the nearest particle or, if there are several classes,
        the topmost one."""
        body, ranks = self._body, self._palette.ranks(snapshot)
        chosen, has_class = (
            body.whole_cells(body.cells_with_frame, snapshot.broken),
            np.isfinite(ranks),
        )
        chosen = chosen[has_class[body.cells_with_frame[chosen]].all(axis=1)]
        alone = _alone(body.cells_with_frame[chosen], has_class & ~body.outside)
        cells = _with(body.cells_with_frame[chosen], alone)
        # If cells are cut, the picture contains only the body. Then there are no cells with frame
        # points.
        cut = _cut(body, chosen, len(alone)) if body.inside.all() else None
        corners = self._grid.places(snapshot.position)[cells]
        self._image.set_data(self._grid.latest(corners, ranks[cells], cut))


class Dots(Layer):
    """A dot for each particle, with the colour of its value or class. Particles that are `hidden`
    have no dot."""

    def __init__(self, ax: Axes, size: float, colours: Scale | Palette, hidden: Array) -> None:
        self._colours, self._hidden = colours, hidden
        edge: dict[str, Any] = {"edgecolors": DOT_COLOUR, "linewidths": 0.08 * size}
        self._dots: PathCollection = ax.scatter([], [], size**2, zorder=3, **edge)
        if isinstance(colours, Scale):
            self._dots.set(cmap=colours.colours, norm=colours.norm)
        self.artists = [self._dots]

    def show(self, snapshot: Snapshot) -> None:
        """Draw the dots in the order of their classes, so that leaders cover followers, and
        followers cover the frame."""
        palette = self._colours if isinstance(self._colours, Palette) else OF_KINDS
        ranks = palette.ranks(snapshot)
        order = np.argsort(ranks, kind="stable")
        has_colour = np.isfinite(ranks) | (palette is not self._colours)
        order = order[has_colour[order] & ~self._hidden[order]]
        self._dots.set_offsets(snapshot.position[order])
        if isinstance(self._colours, Scale):
            assert snapshot.values is not None
            self._dots.set_array(np.ma.masked_invalid(snapshot.values[order]))
        else:
            colours = [colour for _, colour in palette.colours.values()]
            self._dots.set_facecolor([colours[int(rank)] for rank in ranks[order]])


class BondLines(Layer):
    """Lines of intact bonds or, with `broken`, of broken bonds."""

    def __init__(
        self, ax: Axes, body: ReferenceBody, width: float, *, broken: bool = False
    ) -> None:
        self._body, self._broken = body, broken
        style: dict[str, Any] = {"colors": BOND_COLOUR, "zorder": 1}
        if broken:
            style = {
                "colors": BROKEN_BOND_COLOUR,
                "zorder": 2,
                "linestyles": (0, (2.5, 2.0)),
                "alpha": 0.7,
            }
        self._lines = LineCollection([], linewidths=width, **style)
        ax.add_collection(self._lines, autolim=False)
        self.artists = [self._lines]

    def show(self, snapshot: Snapshot) -> None:
        """Show the bonds at the current positions."""
        ends = self._body.ends[snapshot.broken == self._broken]
        self._lines.set_segments(list(snapshot.position[ends]))


class BondValues(Layer):
    """A quantity of bonds, shown by the colours of lines. Bonds without a value are not drawn."""

    def __init__(self, ax: Axes, body: ReferenceBody, width: float, scale: Scale) -> None:
        self._body = body
        self._lines = LineCollection(
            [], linewidths=width, cmap=scale.colours, norm=scale.norm, zorder=2, capstyle="round"
        )
        ax.add_collection(self._lines, autolim=False)
        self.artists = [self._lines]

    def show(self, snapshot: Snapshot) -> None:
        """Show the bonds at the current positions."""
        assert snapshot.values is not None
        finite = np.isfinite(snapshot.values)
        self._lines.set_segments(list(snapshot.position[self._body.ends[finite]]))
        self._lines.set_array(snapshot.values[finite])


def draw_outline(ax: Axes, sides: Array) -> None:
    """Draw segments of shape (side, end, axis) that do not change from step to step."""
    lines = LineCollection(list(sides), colors=OUTLINE_COLOUR, linewidths=0.7, zorder=2.5)
    ax.add_collection(lines, autolim=False)


def draw_numbers(ax: Axes, numbers: Array, snapshot: Snapshot, size: float) -> None:
    """Write the number of each particle to the upper right of its dot. `size` is the size of the
    dots in points. Numbers that would overlap are omitted."""
    places, font = ax.transData.transform(snapshot.position), 6.0
    point = figure_of(ax).dpi / 72
    occupied: set[tuple[int, int]] = set()
    box = ax.bbox
    for number, (x, y), place in zip(numbers, places, snapshot.position, strict=True):
        text = str(int(number))
        xmin, ymin = x + 0.5 * size * point, y + 0.5 * size * point
        xmax, ymax = xmin + (0.68 * len(text) * font + 1.5) * point, ymin + 1.25 * font * point
        columns = range(int(xmin / point), int(xmax / point) + 1)
        covered = {(c, r) for c in columns for r in range(int(ymin / point), int(ymax / point) + 1)}
        is_within = box.x0 <= x and box.y0 <= y and xmax <= box.x1 and ymax <= box.y1
        if covered & occupied or not is_within:
            continue
        occupied |= covered
        offset = (0.5 * size, 0.5 * size)
        ax.annotate(text, place, offset, textcoords="offset points", fontsize=font, zorder=4)


def _image(ax: Axes, grid: PixelGrid, scale: Scale) -> AxesImage:
    """Return an empty image on the pixels of a grid."""
    return ax.imshow(
        np.full((2, 2), np.nan), cmap=scale.colours.with_extremes(bad=(0, 0, 0, 0)),
        norm=scale.norm, extent=grid.box, origin="lower", aspect="equal", zorder=0,
        interpolation_stage="data",
    )  # fmt: skip


BEYOND = 3
"""Number of pixels by which a field is continued beyond its outline before it is clipped."""


def _beyond_edges(pixels: Array) -> Array:
    """Return pixels, (up, across), in which empty pixels near others have the mean of their
    neighbours."""
    for _ in range(BEYOND):
        padded = np.pad(pixels, 1, constant_values=np.nan)
        finite = np.isfinite(padded)
        near = finite[:, :-2] | finite[:, 1:-1] | finite[:, 2:]
        near = near[:-2] | near[1:-1] | near[2:]
        up, across = np.nonzero(near & ~finite[1:-1, 1:-1])
        around = np.stack([padded[up + v, across + u] for v in range(3) for u in range(3)])
        pixels[up, across] = np.nanmean(around, axis=0)
    return pixels


def _are_inverted(corners: Array) -> bool:
    """Return whether cells, (cell, 4, axis), have areas of both signs."""
    first, second = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    triangles = (corners[:, 2] == corners[:, 3]).all(axis=1)
    second = np.where(triangles[:, None], corners[:, 2] - corners[:, 1], second)
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return bool(area.min() < 0.0 < area.max())


def _filled(values: Array, cells: Array, outside: Array) -> Array:
    """Return the values, in which missing values at particles `outside` the outline are replaced.
    Such a particle receives the mean over the cells that meet at it; the value of a cell is the
    mean over its corners with finite values."""
    finite = np.isfinite(values)
    mixed = cells[(outside & ~finite)[cells].any(axis=1) & finite[cells].any(axis=1)]
    means = np.nanmean(values[mixed], axis=1)
    corners = mixed.ravel()
    count = np.bincount(corners, minlength=len(values))
    total = np.bincount(corners, np.repeat(means, mixed.shape[1]), len(values))
    fillable = outside & ~finite & (count > 0)
    return np.where(fillable, total / np.maximum(count, 1), values).astype(np.float32)


def _cut(body: ReferenceBody, chosen: Array, alone: int) -> OutlineCut | None:
    """Return the parts that the outline cuts off from a list of cells. The list contains the
    `chosen` cells, followed by `alone` cells that are not cut."""
    if body.cut is None:
        return None
    return OutlineCut(body.cut, np.append(body.cut.row[chosen], np.full(alone, -1)))


def _alone(cells: Array, chosen: Array) -> Array:
    """Return the rows of those chosen particles that belong to none of the cells."""
    alone = chosen.copy()
    alone[cells] = False
    return np.flatnonzero(alone)


def _with(cells: Array, alone: Array) -> Array:
    """Append a cell of zero extent for each particle in `alone`."""
    return np.concatenate([cells, np.repeat(alone[:, None], 4, axis=1)])
