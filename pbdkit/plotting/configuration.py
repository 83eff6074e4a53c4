"""Pictures of configurations: one or several steps of a run, or of two runs.

Particles are drawn as dots, bonds as lines, and a variable as a field of pixels. Which of these are
drawn depends on the distance of particles on the page: only what is legible is drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.transforms import ScaledTranslation

from pbdkit.errors import ExperimentError, SceneWarning, warn_caller
from pbdkit.io.layout import in_this_layout, indices_of, refuse_unknown_matching, site_keys
from pbdkit.plotting.colours import (
    OF_KINDS,
    Palette,
    Scale,
    in_shares,
    palette_of,
    scale_of,
    scale_within,
)
from pbdkit.plotting.data import (
    Extent,
    PlottedQuantity,
    ReferenceBody,
    Snapshot,
    Trajectory,
    coloured_values,
    combine,
    extent_of,
    of_one_run,
    quantity_of,
    value_range,
)
from pbdkit.plotting.figure_layout import Page, Panels, legend_handles, style_bar
from pbdkit.plotting.layers import (
    BondField,
    BondLines,
    BondValues,
    Classes,
    Dots,
    Layer,
    PixelField,
    PixelGrid,
    draw_numbers,
    draw_outline,
)
from pbdkit.plotting.style import PlotOptions, figure_of, label

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw(
    dataset: xarray.Dataset,
    color: str | None,
    time: float | Iterable[float | None] | None,
    look: PlotOptions,
    ax: Axes | Sequence[Axes] | None = None,
) -> Axes | list[Axes]:
    """Draw recorded steps in the same way as `plot`, with the options in `look`."""
    recording = Trajectory(dataset, color or "kind")
    is_list = isinstance(time, Iterable)
    rows = [recording.row(step) for step in _listed(time)]
    if not rows:
        raise ExperimentError("a figure requires at least one time")
    snapshots = list(recording.snapshots(rows))
    titles = [f"step {snapshot.step}" for snapshot in snapshots]
    if not is_list or len(snapshots) == 1:
        titles = [f"{recording.title}, {titles[0]}".lstrip(", ")]
    extent = extent_of(recording, snapshots, look)
    targets = None if ax is None else [*ax] if isinstance(ax, Iterable) else [ax]
    if targets is not None and len(targets) != len(snapshots):
        raise ExperimentError(
            f"expected one axes for each of {len(snapshots)} steps, got {len(targets)}"
        )
    recordings = [recording] * len(snapshots)
    sheet = PanelFigure(recordings, titles, recording.title, extent, look, targets)
    for panel, snapshot in zip(sheet.panels, snapshots, strict=True):
        panel.show(snapshot)
        if look.numbers:
            sheet.number(panel.ax, snapshot)
    return sheet.axes if is_list else sheet.axes[0]


def _listed(time: Any) -> list[Any]:
    return [*time] if isinstance(time, Iterable) and not isinstance(time, str) else [time]


def draw_comparison(
    first: xarray.Dataset,
    second: xarray.Dataset,
    color: str | None,
    time: float | None,
    look: PlotOptions,
    *,
    difference: bool,
    by: str,
) -> Axes | list[Axes]:
    """Draw one step of two datasets, or their difference, in the same way as
    `pbdkit.plotting.compare`."""
    first, second = in_this_layout(first), in_this_layout(second)
    refuse_unknown_matching(by)
    if difference:
        changed, name = difference_of(first, second, color or "position", time, by)
        return draw(changed, name, None, look)
    return _side_by_side([first, second], color, time, look)


def _side_by_side(
    datasets: list[xarray.Dataset], color: str | None, time: float | None, look: PlotOptions
) -> list[Axes]:
    recordings = [Trajectory(dataset, color or "kind") for dataset in datasets]
    snapshots = [next(r.snapshots([r.row(time)])) for r in recordings]
    extent = combine(
        [extent_of(r, [snapshot], look) for r, snapshot in zip(recordings, snapshots, strict=True)]
    )
    titles = [
        f"{r.title}, step {snapshot.step}".lstrip(", ")
        for r, snapshot in zip(recordings, snapshots, strict=True)
    ]
    sheet = PanelFigure(recordings, titles, "", extent, look)
    for panel, snapshot in zip(sheet.panels, snapshots, strict=True):
        panel.show(snapshot)
    return sheet.axes


def difference_of(
    first: xarray.Dataset,
    second: xarray.Dataset,
    color: str,
    time: float | None,
    by: str = "number",
) -> tuple[xarray.Dataset, str]:
    """Return a dataset for drawing a difference, and the name of the variable to draw. The dataset
    is the second one at one step, in the reference configuration. It is restricted to particles
    that both datasets contain, matched `by` "number" or "site", and the difference in `color` is an
    additional variable."""
    runs = [of_one_run(dataset) for dataset in (first, second)]
    quantity, _ = (quantity_of(dataset, color) for dataset in reversed(runs))
    if quantity.owner != "particle":
        raise ExperimentError(
            f"difference: expected a variable of particles, but '{color}' is one of bonds"
        )
    states = [d.isel(time=Trajectory(d).row(time)) for d in runs]
    a, b = matched(states[0], states[1], by)
    minuend, subtrahend = (d[quantity.variable].transpose("particle", "axis", missing_dims="ignore")
                     for d in (a, b))  # fmt: skip
    difference = subtrahend.variable.copy(data=subtrahend.values.astype(float) - minuend.values)
    difference.attrs["long_name"] = (
        f"difference in {difference.attrs.get('long_name', quantity.variable)}"
    )
    rest = b["reference"].transpose(*b["position"].dims).values
    title = f"{b.attrs.get('title', '')} less {a.attrs.get('title', '')}"
    dataset = b.assign(difference=difference, position=b["position"].copy(data=rest))
    name = f"difference{color.removeprefix(quantity.variable)}"
    return dataset.assign_attrs(title=title), name


def matched(
    first: xarray.Dataset, second: xarray.Dataset, by: str
) -> tuple[xarray.Dataset, xarray.Dataset]:
    """Return the particles that both datasets contain, matched `by` "number" or "site", in the same
    order. A warning is issued if equal numbers denote different sites. Raises ExperimentError if
    there is no such particle."""
    keys, others = (d["number"].values if by == "number" else site_keys(d) for d in (first, second))
    _, in_first, in_second = np.intersect1d(keys, others, assume_unique=True, return_indices=True)
    if not len(in_first):
        raise ExperimentError("the two datasets have no particle in common")
    a, b = first.isel(particle=in_first), second.isel(particle=in_second)
    if by == "number" and indices_of(first) and indices_of(second):
        _warn_of_other_sites(a, b)
    return a, b


def _warn_of_other_sites(first: xarray.Dataset, second: xarray.Dataset) -> None:
    differ = np.flatnonzero(site_keys(first) != site_keys(second))
    if len(differ):
        row = differ[0]
        places = [tuple(int(d[n][row]) for n in indices_of(d)) for d in (first, second)]
        warn_caller(
            f"difference: {len(differ)} of {len(first.number)} particles have another site under "
            f"the same number: particle {int(first.number[row])} is at {places[0]} in the first "
            f'run and at {places[1]} in the second; match by sites with by="site"',
            SceneWarning,
        )


MIN_DOT_SPACING_PT = 8.0
"""Distance of particles on the page, in points, above which dots are drawn on a field."""
MIN_LINE_SPACING_PT = 5.0
"""Distance of particles above which bonds are single lines."""
MAX_PIXEL_SPACING_PT = 2.4
"""Distance of particles below which particles are pixels."""
MAX_DOTS = 50_000
"""Maximum number of particles that are drawn as dots."""
MAX_BOND_LINES = 200_000
"""Maximum number of bonds that are drawn as lines."""


@dataclass(frozen=True)
class RenderStyle:
    """Rendering style. With `filled`, a field is drawn. If particles are `crowded`, they are not
    drawn as dots by default. With `lined`, a bond is drawn as a single line. `dots` is "values" if
    dots show the quantity, and "classes" if they show its classes. It is "kinds" if they show the
    kinds of particles while colours show another quantity, and "" if there are no dots. `distance`
    is the distance of particles on the page, in points."""

    filled: bool
    crowded: bool
    lined: bool
    dots: str
    distance: float

    @property
    def dot(self) -> float:
        """Return the diameter of a dot in points."""
        share, largest = {"values": (0.62, 9.0), "classes": (0.45, 7.0)}.get(self.dots, (0.3, 5.0))
        return min(share * self.distance, largest)

    @property
    def alone(self) -> float:
        """Return the diameter of a particle outside a field. It is 0 if the particle would be
        invisible."""
        size = min(0.62 * self.distance, 9.0)
        return size if size > 1.0 else 0.0

    @property
    def line(self) -> float:
        """Return the line width of a bond in points."""
        return min(max(0.05 * self.distance, 0.25), 0.8)


def choose_style(
    body: ReferenceBody, quantity: PlottedQuantity, look: PlotOptions, distance: float
) -> RenderStyle:
    """Choose the rendering style. Given options are followed; all other choices depend on
    legibility. Raises ExperimentError for an option that is impossible or takes too long."""
    crowded = len(body.reference) > MAX_DOTS or distance < MAX_PIXEL_SPACING_PT
    of_bonds, filled = quantity.owner == "bond", _is_filled(body, quantity, look, distance)
    if quantity.words:
        dots = "" if crowded else "classes"
    elif filled or of_bonds:
        dots = "kinds" if distance >= MIN_DOT_SPACING_PT and not crowded else ""
    else:
        dots = "values"
    return RenderStyle(
        filled, crowded, _is_lined(body, of_bonds, filled, look, distance), dots, distance
    )


def _is_filled(
    body: ReferenceBody, quantity: PlottedQuantity, look: PlotOptions, distance: float
) -> bool:
    is_large = len(body.reference) > MAX_DOTS
    possible, requested = (
        quantity.owner == "particle" and not quantity.words,
        look.contours or look.filled,
    )
    if requested and not possible:
        raise ExperimentError(
            f"contours require values at particles, but '{quantity.variable}' has none; omit "
            "contours, or use another variable"
        )
    if look.filled is False and is_large:
        raise ExperimentError(
            f"{len(body.reference)} particles are too many for dots; at most {MAX_DOTS} are drawn"
        )
    wanted = requested or (
        look.filled is None and possible and (is_large or distance < MIN_DOT_SPACING_PT)
    )
    if wanted and not len(body.cells):
        if requested or is_large:
            raise ExperimentError("contours require particles that do not lie on one line")
        return False
    return bool(wanted)


def _is_lined(
    body: ReferenceBody, of_bonds: bool, filled: bool, look: PlotOptions, distance: float
) -> bool:
    requested, is_large = look.bonds or look.broken, len(body.ends) > MAX_BOND_LINES
    if requested and not len(body.ends):
        raise ExperimentError(
            "the dataset has no bonds to draw; run the experiment with fracture, a cut, or a "
            "diagnostic that uses bonds"
        )
    if requested and is_large:
        raise ExperimentError(
            f"{len(body.ends)} bonds are too many to draw; at most {MAX_BOND_LINES} are drawn"
        )
    if look.bonds is not None:
        return look.bonds
    return not is_large and (of_bonds or (not filled and distance >= MIN_LINE_SPACING_PT))


MIN_NUMBER_SPACING_PT = 20.0
"""Distance of particles on the page, in points, above which numbers are legible."""
MAX_ENLARGEMENT = 2.5
"""Maximum factor by which the page is enlarged to make numbers legible."""


LONGEST_LIMITS = ": −0.000123 to 0.000123"
"""Text for which titles have room if they state the limits of colours."""


class Panel:
    """Axes with layers. Each layer shows one step at a time. If `scale_of` is given, it returns the
    scale of a step, and the limits of this scale follow the title.

    `is_shortened` is true if there was no room for the whole title.
    """

    def __init__(
        self,
        ax: Axes,
        drawn: list[Layer],
        title: str,
        scale_of: Callable[[Snapshot], Scale] | None,
    ) -> None:
        self.ax, self._layers, self._scale_of = ax, drawn, scale_of
        self.artists = [artist for layer in drawn for artist in layer.artists]
        shown = ax.get_title()
        self.is_shortened = shown != _with_room(title, stating_limits=scale_of is not None)
        self._title = shown[: -len(LONGEST_LIMITS)] + "…" if self.is_shortened else title

    def show(self, snapshot: Snapshot, title: str | None = None) -> None:
        """Show a step in place of the previous one. If a title is given, it replaces that of the
        previous step."""
        scale = self._scale_of(snapshot) if self._scale_of else None
        if title is not None or scale is not None:
            limits = f": {scale.text}" if scale else ""
            self.ax.title.set_text(f"{self._title if title is None else title}{limits}")
        for layer in self._layers:
            if scale is not None:
                layer.rescale(scale)
            layer.show(snapshot)


def _with_room(title: str, *, stating_limits: bool) -> str:
    """Return a title with the longest text of limits."""
    return title + LONGEST_LIMITS if stating_limits else title


class PanelFigure:
    """Axes and panels, each of which shows steps of a recording.

    All panels have the limits and the colour scale of an extent. Along each axis, fields have
    `finer` times as many pixels as the picture. If `axes` are given, they are used unchanged;
    otherwise a figure is created, which is `standalone` or managed by pyplot.

    Raises ExperimentError if there is not enough room or no data.
    """

    def __init__(
        self,
        recordings: Sequence[Trajectory],
        titles: list[str],
        heading: str,
        extent: Extent,
        look: PlotOptions,
        axes: list[Axes] | None = None,
        finer: float = 2.0,
        *,
        standalone: bool = False,
    ) -> None:
        self._extent, self._look, self._finer = extent, look, finer
        first = recordings[0]
        assert first.quantity is not None
        self._quantity, self._body = first.quantity, first.body
        self._palette = palette_of(self._quantity) if self._quantity.words else None
        is_each = look.limits == "each" and self._palette is None
        with_room = [_with_room(title, stating_limits=is_each) for title in titles]
        panels = Panels(extent.box, with_room, heading, first.axis_labels)
        self._page = (
            Page(panels, look.dpi, look.figsize, standalone=standalone) if axes is None else None
        )
        self.axes = self._page.axes if self._page else list(axes or [])
        self._larger = 1.0
        if self._page:
            self._page.arrange()
            if look.numbers:
                self._larger = min(
                    max(1.0, MIN_NUMBER_SPACING_PT / self._spacing()), MAX_ENLARGEMENT
                )
                self._page.arrange(larger=self._larger)
        else:
            self._label_axes(panels)
        self._style = choose_style(self._body, self._quantity, look, self._spacing())
        self._scale = self._scale_of_all()
        self._key()
        self._style = replace(
            self._style, distance=self._spacing()
        )  # The legend occupies a part of the page.
        self.panels = [
            Panel(
                ax,
                list(self._layers(ax, recording)),
                title,
                partial(self._scale_within, recording.body) if is_each else None,
            )
            for ax, recording, title in zip(self.axes, recordings, titles, strict=True)
        ]

    @property
    def figure(self) -> Figure:
        """Return the figure of the axes."""
        return figure_of(self.axes[0])

    def number(self, ax: Axes, snapshot: Snapshot) -> None:
        """Write the numbers of the particles beside their dots."""
        style = self._style
        draw_numbers(ax, self._body.number, snapshot, style.dot if style.dots else 0.0)

    def _spacing(self) -> float:
        """Return the distance of particles at rest on the page, in points."""
        ax, (xmin, xmax, ymin, ymax) = self.axes[0], self._extent.box
        inches = ax.get_window_extent().transformed(self.figure.dpi_scale_trans.inverted())
        scale = min(inches.width / (xmax - xmin), inches.height / (ymax - ymin))
        return float(72 * scale * self._body.spacing)

    def _scale_within(self, body: ReferenceBody, snapshot: Snapshot) -> Scale:
        """Return the scale of one step."""
        assert self._scale is not None
        values = coloured_values(
            body, self._quantity, snapshot, self._look, in_body=self._style.filled
        )
        return scale_within(self._scale, self._quantity, value_range(values), self._look)

    def _scale_of_all(self) -> Scale | None:
        if self._palette is not None:
            return None
        filled = self._style.filled
        values = self._extent.of_body if filled else self._extent.of_all
        return scale_of(self._quantity, values, self._look, filled)

    def _layers(self, ax: Axes, recording: Trajectory) -> Iterator[Layer]:
        """Generate the layers, beginning with the lowest."""
        body, scale, style, grid = recording.body, self._scale, self._style, self._grid(ax)
        if style.filled and scale:
            yield PixelField(ax, body, grid, scale, style.alone)
        elif self._palette and style.crowded:
            yield Classes(ax, body, grid, self._palette)
        if style.lined:
            yield BondLines(ax, body, style.line)
        if self._look.broken:
            yield BondLines(ax, body, style.line, broken=True)
        if self._quantity.owner == "bond" and scale:
            is_large = len(body.ends) > MAX_BOND_LINES
            width = 2.0 * style.line
            yield (
                BondField(ax, body, grid, scale) if is_large else BondValues(ax, body, width, scale)
            )
        if self._look.outline:
            draw_outline(ax, body.outline)
        if style.dots:
            colours = {"values": scale, "classes": self._palette}.get(style.dots)
            yield Dots(ax, style.dot, colours or OF_KINDS, body.outside & style.filled)

    def _grid(self, ax: Axes) -> PixelGrid:
        """Return the pixels of a field. They are smaller than the pixels of the picture, unless
        there are many cells."""
        extent = ax.get_window_extent()
        finer = 1 if len(self._body.reference) > MAX_DOTS else self._finer
        across, up = (max(2, round(finer * side)) for side in (extent.width, extent.height))
        return PixelGrid(self._extent.box, across, up)

    def _key(self) -> None:
        """Add the colour bar, and a legend of the kinds that are visible."""
        quantity, scale, page = self._quantity, self._scale, self._page
        is_each = self._look.limits == "each"
        text = label(quantity.meaning, quantity.units, scale.exponent if scale else 0)
        if scale and is_each:
            text = label(quantity.meaning, quantity.units)
            scale = in_shares(scale)
        if self._extent.is_zero:
            text += ": zero within rounding"
        of_kinds = self._style.dots == "kinds"
        palette = OF_KINDS if of_kinds else self._palette
        if page:
            present = set(self._extent.kinds if of_kinds else self._extent.classes)
            handles = legend_handles(palette, present) if palette else None
            page.arrange(scale, text, handles, self._larger)
            return
        if scale:
            bar_of = self.figure.colorbar(
                ScalarMappable(scale.norm, scale.colours), ax=self.axes, extend=scale.extend
            )
            style_bar(bar_of, scale)
            bar_of.set_label(text)
        if palette:
            self._add_legend(palette)

    def _label_axes(self, panels: Panels) -> None:
        """Set limits, titles and labels of axes passed by the caller."""
        xmin, xmax, ymin, ymax = panels.box
        for ax, title in zip(self.axes, panels.titles, strict=True):
            ax.set(xlim=(xmin, xmax), ylim=(ymin, ymax), aspect="equal", title=title)
            ax.set(xlabel=panels.labels[0], ylabel=panels.labels[1])

    def _add_legend(self, palette: Palette) -> None:
        """Add a legend below axes passed by the caller."""
        below = self.axes[0].transAxes + ScaledTranslation(0, -0.45, self.figure.dpi_scale_trans)
        handles = legend_handles(palette, set(self._extent.kinds | self._extent.classes))
        self.axes[0].legend(
            handles=handles, loc="upper center", bbox_to_anchor=(0.5, 0), bbox_transform=below,
            ncols=3, frameon=False, handletextpad=0.1,
        )  # fmt: skip
