"""Curves and histories. They show one quantity over another quantity or over the steps, with a line
for each run.

Curves are force over displacement, stress over strain, and energies. Histories are variables of
single particles and bonds over the steps. For the dataset of a sweep, a line is drawn for each
member.
"""

from __future__ import annotations

import csv
import io
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any, Literal

import numpy as np
import xarray
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pbdkit.array_types import Array, Floats
from pbdkit.errors import ExperimentError
from pbdkit.io.layout import INDICES, rows_at, scene_of
from pbdkit.io.members import STATUS, SWEEP, TEXT, type_alone, with_experiment
from pbdkit.plotting.data import (
    CHOSEN_BY,
    OF_A_RUN,
    SUM_BLOCK_BYTES,
    drawn_by_curve,
    in_units,
    scalar,
    variable,
)
from pbdkit.plotting.figure_layout import new_figure
from pbdkit.plotting.style import in_its_units, label, plain, signed
from pbdkit.scene.scene import Scene

FORCE_OF = {"load": "load_resultant", "obstacle": "contact_force", "leader_group": "reaction"}
"""Variables of forces, by the dimension of the groups, loads or obstacles that exert them."""
NEEDED_FORCES = (
    "a force-displacement curve requires a diagnostic of forces: add {type: load-displacement, "
    "youngs_modulus: ...} for loads, {type: contact, ...} for obstacles or {type: reaction, ...} "
    "for leader groups to `diagnostics`, and run the experiment again"
)
"""Message for results without forces."""


@dataclass(frozen=True)
class LoadCurve:
    """Force as a function of displacement: two DataArrays along time. Their names contain the
    axis."""

    displacement: Any
    force: Any


def load_curve(dataset: xarray.Dataset, chosen: Mapping[str, int | None]) -> LoadCurve:
    """Return force and displacement of the chosen group, load or obstacle. If none is chosen, the
    one with the largest displacement is used. Both are components along the axis with the largest
    displacement.

    Raises ExperimentError if the dataset contains no forces, or no force of the chosen group, load
    or obstacle.
    """
    dim, moved = _moving(dataset, chosen)
    force, place = in_units(dataset[FORCE_OF[dim]]), chosen.get(CHOSEN_BY[dim])
    places = force[dim].values.tolist()
    if place is None:
        place = places[int(np.argmax(_greatest(moved, dim)))]
    if place not in places:
        meaning = f"there is no {dim.replace('_', ' ')} {place}"
        raise ExperimentError(f"{meaning}; there are {', '.join(map(str, places))}")
    force, moved = force.sel({dim: place}), moved.sel({dim: place})
    leads = moved if _greatest(moved, "axis").any() else force
    axis = int(np.argmax(_greatest(leads, "axis")))
    force, moved, leads = (values.isel(axis=axis) for values in (force, moved, leads))
    backwards = -float(leads.min()) > float(leads.max())
    along = f"{'−' if backwards else ''}{dataset['axis'].values[axis]}"
    name = f"{dim.replace('_', ' ')} {place} along {along}"
    return LoadCurve(*(
        (-values if backwards else values).assign_attrs(values.attrs | {"long_name": meaning})
        for values, meaning in ((moved, f"displacement of {name}"), (force, f"force of {name}"))
    ))  # fmt: skip


def _moving(dataset: xarray.Dataset, chosen: Mapping[str, int | None]) -> tuple[str, Any]:
    """Return the dimension of the forces, and the displacements along this dimension. It is the
    dimension of the chosen kind (group, load or obstacle) or, if none is chosen, of the first kind
    that moves."""
    requested = [dim for dim, argument in CHOSEN_BY.items() if chosen.get(argument) is not None]
    available = [dim for dim in requested or FORCE_OF if FORCE_OF[dim] in dataset.variables]
    candidates = [(dim, _displacements(dataset, dim)) for dim in available]
    if not candidates:
        raise ExperimentError(NEEDED_FORCES)
    return next((each for each in candidates if np.nan_to_num(each[1].values).any()), candidates[0])


def _greatest(values: Any, dim: str) -> Floats:
    """Return the largest absolute value at each index along `dim`."""
    sizes = np.abs(values.transpose(dim, ...).values).reshape(values.sizes[dim], -1)
    return np.asarray(np.nanmax(sizes, axis=1))


def _displacements(dataset: xarray.Dataset, dim: str) -> Any:
    """Return the mean displacement, as an array of shape (time, group, axis), of the particles or
    obstacles that exert the force. The result has units as an attribute."""
    if dim == "load":
        return in_units(dataset["load_displacement"])
    extra_dims = [str(d) for d in dataset[FORCE_OF[dim]].dims if d not in OF_A_RUN]
    if extra_dims and SWEEP in dataset.attrs and "position" in dataset.variables:
        return _of_members(dataset, dim)
    if extra_dims and SWEEP not in dataset.attrs:
        raise ExperimentError(
            f"the dataset contains several runs, along {', '.join(extra_dims)}; select one with "
            "isel, or give x and y"
        )
    if "position" not in dataset.variables:
        raise ExperimentError(
            "load-displacement requires `position`, which the dataset does not contain; of a "
            "sweep, add it to keep.variables, and run the sweep again"
        )
    scene = scene_of(dataset, "the way of leaders and obstacles")
    if dim == "obstacle":
        steps = dataset["time"].values
        displacement = np.stack([_of_barriers(scene, int(step)) for step in steps])
    else:
        displacement = np.stack(
            [_of_rows(dataset, leading.rows) for leading in scene.leading], axis=1
        )
    factor, units = in_its_units(dataset["position"].attrs)
    along = {"time": dataset["time"], dim: dataset[dim], "axis": dataset["axis"]}
    return xarray.DataArray(
        displacement * factor, along, ("time", dim, "axis"), attrs={"units": units}
    )


def _of_members(dataset: xarray.Dataset, dim: str) -> Any:
    """Return the displacements of all members of a sweep. Members without a result have NaN."""
    dims = [str(name) for name in dataset[STATUS].dims]
    labels = {"time": dataset["time"], dim: dataset[dim]}
    missing = xarray.DataArray(
        np.nan, labels | {"axis": dataset["axis"]}, ("time", dim, "axis"), attrs={"units": ""}
    )
    parts = []
    for place in product(*(range(dataset.sizes[name]) for name in dims)):
        selection = dataset.isel(dict(zip(dims, place, strict=True)))
        has_result = bool(selection["position"].notnull().any())
        part = _displacements(with_experiment(selection), dim) if has_result else missing
        parts.append(part.reindex(labels))
    shape = tuple(dataset.sizes[name] for name in dims)
    units = next((part.attrs["units"] for part in parts if part.attrs["units"]), "")
    stacked = np.stack([part.values for part in parts]).reshape(*shape, *parts[0].shape)
    return (
        missing.expand_dims({name: dataset[name] for name in dims})
        .copy(data=stacked)
        .assign_attrs(units=units)
    )


def _of_barriers(scene: Scene, step: int) -> Floats:
    """Return the offset of each obstacle at a step, (obstacle, axis). After the last step of its
    motion an obstacle keeps its last offset."""
    offsets = []
    for barrier in scene.barriers:
        n = min(step, barrier.group.last(step)) - barrier.group.from_ + 1
        offsets.append(barrier.offset(n).mean(axis=0) if n > 0 else np.zeros(scene.axes))
    return np.array(offsets)


def _of_rows(dataset: xarray.Dataset, rows: NDArray[Any]) -> Floats:
    """Return the mean displacement of some particles, (time, axis). It is computed for some steps
    at a time."""
    low, high = int(rows.min()), int(rows.max()) + 1
    reference = dataset["reference"].isel(particle=slice(low, high)).transpose("particle", "axis")
    position = dataset["position"].isel(particle=slice(low, high))
    block = max(1, SUM_BLOCK_BYTES // max(1, reference.nbytes))
    means = []
    for begin in range(0, dataset.sizes["time"], block):
        part = position.isel(time=slice(begin, begin + block)).transpose("time", "particle", "axis")
        displacement = part.values[:, rows - low] - reference.values[rows - low]
        means.append(displacement.mean(axis=1))
    return np.concatenate(means)


SIZE_IN = (4.8, 3.3)
"""Width and height of a figure in inches."""
DPI = 200
"""Resolution of a figure."""
HUES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
"""Colours of Okabe and Ito, without yellow, which is invisible on white."""
LINE_CMAP = "viridis"
"""Colour map that is used if there are more lines than colours."""
MAX_LEGEND_LINES = 12
"""Maximum number of lines in a legend."""
MAX_INNER_LEGEND_LINES = 4
"""Maximum number of lines for which the legend is inside the panel."""
FEW_POINTS = 40
"""A line is drawn with markers if it has at most this number of points."""
BROAD = 44
"""Characters per line of a label below the panel."""
TALL = 34
"""Characters per line of a label beside the panel."""
NAMED = 34
"""Characters per line of a legend."""
QUICK = 20_000
"""Maximum number of points for which the best place of a legend is searched."""
LEGEND_IN = 1.9
"""Width of a legend beside the panel in inches."""
ROUND = [1, 2, 5, 10]
"""The distance between ticks is a multiple of one of these numbers, times a power of ten."""


@dataclass(frozen=True)
class Line:
    """Values `y` over `x`. `hue` is the index of the particle or of the member of a sweep; lines
    with the same `hue` have the same colour. If `value` is a number, it determines the position of
    the colour in a colour map. The line of a second component is `dashed`. `member` contains the
    values of the parameters of a sweep, and `of` the name without them."""

    x: Array
    y: Array
    name: str = ""
    hue: int = 0
    value: float | None = None
    dashed: bool = False
    member: Mapping[str, Any] = field(default_factory=dict)
    of: str = ""


@dataclass(frozen=True)
class Quantity:
    """Meaning and units of the values along an axis."""

    meaning: str
    units: str

    @classmethod
    def of(cls, values: Any) -> Quantity:
        """Return the quantity of a DataArray from `in_units`."""
        return cls(values.attrs["long_name"], values.attrs["units"])

    @property
    def heading(self) -> str:
        """Heading of a column of a table."""
        return f"{self.meaning} ({self.units})" if self.units not in ("", "1") else self.meaning


STEPS = Quantity("time", "step")
"""Time as the abscissa of histories."""


@dataclass(frozen=True)
class Chart:
    """Lines of one quantity over another, with a title. Colours have the label `hues`."""

    lines: Sequence[Line]
    x: Quantity
    y: Quantity
    title: str
    hues: str = ""

    def draw(self, ax: Axes | None) -> Axes:
        """Draw the lines on axes, by default those of a new figure."""
        ax = ax or new_axes()
        ax.set_xlabel(label(self.x.meaning, self.x.units, width=BROAD))
        ax.set_ylabel(label(self.y.meaning, self.y.units, width=TALL))
        draw_lines(ax, self.lines, self.title, self.hues)
        return ax

    def csv(self) -> str:
        """Return the points as CSV. Each row contains the parameters of the member of a sweep, the
        name of the line if there are several, and the coordinates of a point."""
        parameters = [*dict.fromkeys(name for line in self.lines for name in line.member)]
        named = ["line"] if any(line.of for line in self.lines) else []
        text = io.StringIO()
        rows = csv.writer(text, lineterminator="\n")
        rows.writerow([*parameters, *named, self.x.heading, self.y.heading])
        for line in self.lines:
            first = [*(line.member.get(name, "") for name in parameters), *(line.of for _ in named)]
            for point in zip(line.x.tolist(), line.y.tolist(), strict=True):
                # The addition of 0 turns -0 into 0.
                values = (repr(number + 0.0).removesuffix(".0") for number in point)
                rows.writerow([*first, *values])
        return text.getvalue()


def new_axes(width: float = SIZE_IN[0], height: float = SIZE_IN[1]) -> Axes:
    """Return the axes of a new figure. `width` and `height` are in inches."""
    return new_figure(figsize=(width, height), dpi=DPI, layout="constrained").add_subplot()


def draw_lines(ax: Axes, lines: Sequence[Line], title: str, hues: str) -> None:
    """Draw lines with a legend. If there are too many lines for a legend, draw them with a colour
    bar that has the label `hues`."""
    order = {hue: n for n, hue in enumerate(dict.fromkeys(line.hue for line in lines))}
    shares = _shares(lines, order)
    for line in lines:
        few = len(order) <= len(HUES)
        colour = HUES[order[line.hue]] if few else colormaps[LINE_CMAP](shares[line.hue])
        ax.plot(
            line.x, line.y, color=colour, lw=1.2, ls="--" if line.dashed else "-", ms=3.0,
            marker="o" if len(line.x) <= FEW_POINTS else None, label=_wrapped(line.name),
        )  # fmt: skip
    ax.ticklabel_format(scilimits=(-3, 4), useMathText=True)
    whole = all((np.mod(line.x, 1.0) == 0.0).all() for line in lines)
    ax.xaxis.set_major_locator(MaxNLocator(6, integer=whole, steps=ROUND))
    ax.yaxis.set_major_locator(MaxNLocator(6, steps=ROUND))
    ax.margins(x=0.02)
    ax.grid(color="#E8E8E8", lw=0.6)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
    ax.set_title(label(title, width=BROAD), fontsize="medium", pad=12)
    if len(lines) > MAX_LEGEND_LINES:
        _scale(ax, lines, order, hues)
    elif any(line.name for line in lines):
        _legend(ax, lines, hues)


def _legend(ax: Axes, lines: Sequence[Line], hues: str) -> None:
    style: dict[str, Any] = {"frameon": False, "fontsize": "small", "title_fontsize": "small"}
    style["title"] = label(hues, width=NAMED)
    if len(lines) <= MAX_INNER_LEGEND_LINES and sum(len(line.x) for line in lines) < QUICK:
        ax.legend(loc="best", **style)
        return
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), **style)
    whole = ax.get_figure(root=True)
    if whole and len(whole.axes) == 1:
        whole.set_size_inches(whole.get_figwidth() + LEGEND_IN, whole.get_figheight())


def _wrapped(name: str) -> str:
    return textwrap.fill(plain(name), NAMED, break_on_hyphens=False)


def _shares(lines: Sequence[Line], order: dict[int, int]) -> dict[int, float]:
    """Return the position of each hue in the colour map, from 0 to 0.9."""
    low, high = _range(lines, order)
    at = {line.hue: _value(line, order) for line in lines}
    return {hue: 0.9 * (value - low) / ((high - low) or 1.0) for hue, value in at.items()}


def _value(line: Line, order: dict[int, int]) -> float:
    return order[line.hue] if line.value is None else line.value


def _range(lines: Sequence[Line], order: dict[int, int]) -> tuple[float, float]:
    values = [_value(line, order) for line in lines]
    return min(values), max(values)


def _scale(ax: Axes, lines: Sequence[Line], order: dict[int, int], hues: str) -> None:
    cmap = ListedColormap(colormaps[LINE_CMAP](np.linspace(0.0, 0.9, 256)))
    colours = ScalarMappable(Normalize(*_range(lines, order)), cmap)
    ax.figure.colorbar(colours, ax=ax, aspect=25).set_label(label(hues, width=BROAD))


def member_dims(values: Any) -> list[str]:
    """Return the dimensions of a sweep, or of concatenated runs."""
    return [str(dim) for dim in values.dims if dim not in OF_A_RUN]


def hues_of(values: Any) -> str:
    """Return the label of the colours of members. It is empty for a single run."""
    dims = member_dims(values)
    return dims[0] if len(dims) == 1 else "member of the sweep" if dims else ""


def lines_of(dataset: xarray.Dataset, x: Any, y: Any) -> list[Line]:
    """Return the lines of y over x. x and y are DataArrays that have one dimension of a run in
    common. The name of a line contains the parameters of its member. Lines contain no NaN."""
    across, drawn = xarray.broadcast(x, y)
    dims = member_dims(drawn)
    across, drawn = (values.transpose(*dims, ...) for values in (across, drawn))
    lines = []
    places = product(*(range(drawn.sizes[dim]) for dim in dims))
    for hue, place in enumerate(places):
        at, over = across.values[place], drawn.values[place]
        finite = np.isfinite(at) & np.isfinite(over)
        along = dict(zip(dims, place, strict=True))
        member = {dim: _value_of(dataset, dim, n) for dim, n in along.items()}
        name = ", ".join(
            f"{dim} {value:.4g}{_unit_of(dataset, dim)}"
            if isinstance(value, float)
            else f"{dim} {value}"
            for dim, value in member.items()
        )
        value = _number(dataset, dims[0], place[0]) if len(dims) == 1 else None
        if finite.any():
            headings = {_heading(dataset, dim): each for dim, each in member.items()}
            line = Line(at[finite], over[finite], name, hue, value, member=headings)
            lines.append(line)
    return lines


def _value_of(dataset: xarray.Dataset, dim: str, place: int) -> float | str:
    """Return the value of a parameter, or the index of a member without one."""
    for name in (f"{dim}{TEXT}", dim):
        if name in dataset.coords and dataset[name].dims == (dim,):
            value = dataset[name].values[place]
            return float(value) if isinstance(value, np.floating) else type_alone(str(value))
    return str(place)


def _unit_of(dataset: xarray.Dataset, dim: str) -> str:
    """Return the unit of a parameter after a space; empty for lattice units and steps."""
    units = str(dataset[dim].attrs.get("units", ""))
    is_short = units not in ("", "1") and "unit" not in units and "step" not in units
    return f" {signed(units)}" if is_short else ""


def _heading(dataset: xarray.Dataset, dim: str) -> str:
    """Return the heading of the column of a parameter."""
    return Quantity(dim, str(dataset[dim].attrs.get("units", ""))).heading


def _number(dataset: xarray.Dataset, dim: str, place: int) -> float | None:
    """Return the value of a coordinate at an index. Return None if it is not a number."""
    if f"{dim}{TEXT}" in dataset.coords or dim not in dataset.coords:
        return None
    value = dataset[dim].values[place]
    return float(value) if isinstance(value, (np.number, int, float)) else None


Kind = Literal["load-displacement", "stress-strain", "energies"]
KINDS: tuple[Kind, ...] = ("stress-strain", "load-displacement", "energies")
"""Kinds of curves, in the order in which they are tried."""
ENERGIES = ("strain_energy", "pe1", "pe1_intact", "pe2")
"""Names of the variables of energies."""
NEEDED_DIAGNOSTICS = {
    "stress-strain": "a stress-strain curve requires the diagnostic stress-strain: add "
    "{type: stress-strain, youngs_modulus: ..., width: ...} to `diagnostics`, and run the "
    "experiment again",
    "energies": (
        "energies require a diagnostic: add {type: pe1}, or with a calibrated rule "
        "{type: strain-energy, youngs_modulus: ...}, to `diagnostics`, and run the experiment "
        "again"
    ),
}
"""Messages for results that do not contain the variables of a curve, by kind of curve."""


def curve_chart(
    dataset: xarray.Dataset,
    x: str | None,
    y: str | None,
    kind: Kind | None,
    chosen: dict[str, int | None],
) -> Chart:
    """Return the chart that `pbdkit.plotting.curve` draws. `chosen` is the group, load or
    obstacle."""
    if y is None:
        x, y = None, x
    if y not in dataset and (meant := str(y).replace("_", "-")) in KINDS:
        raise ExperimentError(f"there is no variable '{y}'; a kind is given as kind='{meant}'")
    if y is not None and kind is not None:
        raise ExperimentError(f"give either y or the kind '{kind}', not both")
    if y is not None:
        drawn = [scalar(dataset, y, chosen)]
        across = scalar(dataset, x or _own_axis(drawn[0]), chosen)
        return _chart(dataset, across, drawn)
    return _of_kind(dataset, kind or _first_kind(dataset), chosen)


def _own_axis(values: Any) -> str:
    return next((str(d) for d in values.dims if d in OF_A_RUN), "time")


def _first_kind(dataset: xarray.Dataset) -> Kind:
    has = {
        "stress-strain": "nominal_stress" in dataset,
        "load-displacement": any(name in dataset for name in FORCE_OF.values()),
        "energies": any(name in dataset for name in ENERGIES),
    }
    for kind in KINDS:
        if has[kind]:
            return kind
    raise ExperimentError(
        f"the dataset has no curve: {NEEDED_FORCES}; {NEEDED_DIAGNOSTICS['stress-strain']}"
    )


def _of_kind(dataset: xarray.Dataset, kind: Kind, chosen: dict[str, int | None]) -> Chart:
    if kind == "load-displacement":
        pair = load_curve(dataset, chosen)
        return _chart(dataset, pair.displacement, [pair.force])
    if kind not in NEEDED_DIAGNOSTICS:
        raise ExperimentError(f"there is no curve '{kind}'; use one of {', '.join(KINDS)}")
    names = ["nominal_stress"] if kind == "stress-strain" else _energies(dataset)
    if any(name not in dataset for name in names) or not names:
        raise ExperimentError(NEEDED_DIAGNOSTICS[kind])
    across = "nominal_strain" if kind == "stress-strain" else "time"
    drawn = [scalar(dataset, name, chosen) for name in names]
    return _chart(dataset, scalar(dataset, across, chosen), drawn)


def _energies(dataset: xarray.Dataset) -> list[str]:
    """Return the energies to draw, which all have the same unit. These are the strain energy or, if
    it was not recorded, the pseudo-energies."""
    names = [name for name in ENERGIES if name in dataset]
    units = [dataset[name].attrs.get("units") for name in names]
    return [name for name, unit in zip(names, units, strict=True) if unit == units[0]]


def _chart(dataset: xarray.Dataset, x: Any, drawn: list[Any]) -> Chart:
    has_several = len(drawn) > 1
    lines = []
    for n, y in enumerate(drawn):
        for line in lines_of(dataset, x, y):
            of = y.attrs["long_name"] if has_several else ""
            hue = line.hue if member_dims(y) else n
            name = ", ".join(filter(None, (line.name, of)))
            lines.append(replace(line, name=name, hue=hue, dashed=n > 0, of=of))
    if not lines:
        raise ExperimentError(f"'{drawn[0].name}' has no finite value")
    quantity = Quantity.of(drawn[0])
    common = replace(quantity, meaning="pseudo-energy") if has_several else quantity
    title = str(dataset.attrs.get("title", ""))
    return Chart(lines, Quantity.of(x), common, title, hues_of(drawn[0]))


MAX_LINES = 200
"""Maximum number of lines."""
Numbers = int | Iterable[int]


def history_chart(
    dataset: xarray.Dataset,
    name: str | None,
    particle: Numbers | None,
    site: tuple[int | None, int | None],
    bond: Sequence[int] | None,
) -> Chart:
    """Return the chart of a variable of particles or of a bond over time, which
    `pbdkit.plotting.history` draws."""
    if not isinstance(name, str | None):
        raise ExperimentError(
            f"history: expected the name of a variable first, such as 'u', got {name!r}; a "
            "particle is given as particle=67"
        )
    if bond is not None:
        drawn = [_of_bond(dataset, name or "strain", bond)]
    else:
        numbers = _numbers(dataset, particle, *site)
        drawn = _of_particles(dataset, name or "u", numbers)
    alone = len(drawn) == 1
    lines = [line for n, series in enumerate(drawn) for line in _lines(dataset, series, n, alone)]
    if not 0 < len(lines) <= MAX_LINES:
        what = f"{len(lines)} lines are too many" if lines else "there is no value to draw"
        raise ExperimentError(f"{what}; select other particles, for at most {MAX_LINES} lines")
    values, title = drawn[0].values, str(dataset.attrs.get("title", ""))
    hues = "bond" if bond is not None else "number of the particle"
    if len(drawn) == 1 and (members := hues_of(values)):
        title, hues = f"{title}, {hues} {drawn[0].name}".replace("number of the ", ""), members
    return Chart(lines, STEPS, Quantity.of(values), title, hues)


@dataclass(frozen=True)
class Series:
    """Values of a particle or a bond: its name, its number, and `values`, a DataArray along
    time."""

    name: str
    number: float | None
    values: Any


def _lines(dataset: xarray.Dataset, series: Series, n: int, alone: bool) -> Iterator[Line]:
    """Generate a line for each component and each member of a sweep. Different particles have
    different colours; if there is only one particle, different members have different colours."""
    along = "step" if "step" in series.values.dims else "time"
    vector = "axis" in series.values.dims
    parts = (
        [series.values.isel(axis=k) for k in range(series.values.sizes["axis"])] if vector else []
    )
    for k, part in enumerate(parts or [series.values]):
        axis = str(part["axis"].item()) if vector else ""
        for line in lines_of(dataset, part[along], part):
            by_member = alone and line.name
            words = [line.name, axis] if by_member else [series.name, axis, line.name]
            hue, value = (line.hue, line.value) if by_member else (n, series.number)
            name, of = (", ".join(filter(None, each)) for each in (words, (series.name, axis)))
            yield replace(line, name=name, hue=hue, value=value, dashed=k > 0, of=of)


def _numbers(
    dataset: xarray.Dataset, particle: Numbers | None, i: int | None, j: int | None
) -> list[int] | None:
    """Return the numbers of the requested particles. Return None if no particle was requested,
    which is only possible for `track`."""
    if particle is not None:
        if i is not None or j is not None:
            raise ExperimentError("select particles either by number or by i and j, not by both")
        return [particle] if isinstance(particle, int | np.integer) else [*particle]
    indices = {
        name: value for name, value in zip(INDICES, (i, j), strict=False) if value is not None
    }
    return dataset["number"].values[rows_at(dataset, indices)].tolist() if indices else None


def _of_particles(dataset: xarray.Dataset, name: str, wanted: list[int] | None) -> list[Series]:
    dim = "tracked" if name.partition("_")[0] == "track" else "particle"
    if wanted is None and dim == "particle":
        raise ExperimentError(
            f"history: expected a particle; write history('{name}', particle=67), or i=4, j=5"
        )
    from_positions = name.partition("_")[0] == "u" and "u" not in dataset.variables
    values = variable(dataset, name.replace("u", "position", 1) if from_positions else name)
    if dim not in values.dims:
        raise ExperimentError(f"'{name}' has no values at particles; {drawn_by_curve(name)}")
    numbers, followed = dataset[dim].values, []
    for number in numbers if wanted is None else wanted:
        if number not in numbers:
            remedy = (
                f"tracked particles are {numbers.tolist()}"
                if dim == "tracked"
                else f"the dataset has {len(numbers)} particles"
            )
            raise ExperimentError(f"there is no particle {number}; {remedy}")
        part = values.isel({dim: int(np.flatnonzero(numbers == number)[0])})
        if from_positions:
            part = _displacement(dataset, part, number)
        followed.append(Series(_name(dataset, number), float(number), in_units(part)))
    return followed


def _displacement(dataset: xarray.Dataset, position: Any, number: int) -> Any:
    """Return the positions of a particle, or one component of them, minus the position at rest."""
    reference = dataset["reference"].sel(particle=number)
    if "axis" not in position.dims:
        reference = reference.sel(axis=position["axis"])
    meaning = str(position.attrs["long_name"]).replace("position", "displacement")
    return (position - reference).assign_attrs(position.attrs | {"long_name": meaning})


def _name(dataset: xarray.Dataset, number: int) -> str:
    site = dataset["site"].sel(particle=number).values
    return f"{number} ({', '.join(f'{n} {k}' for n, k in zip(INDICES, site, strict=False))})"


def _of_bond(dataset: xarray.Dataset, name: str, bond: Sequence[int]) -> Series:
    """Return the strain between two particles, or a state variable of a bond."""
    ends = sorted(bond)
    if len(ends) != 2 or not np.isin(ends, dataset["number"].values).all():
        raise ExperimentError(f"a bond is given by two numbers of particles, got {[*bond]}")
    label = f"{ends[0]}-{ends[1]}"
    if name == "strain":
        return Series(label, None, _strain(dataset, ends))
    values = variable(dataset, name)
    if {"bond", "time"} - {*values.dims}:
        names = [n for n, v in dataset.data_vars.items() if {"bond", "time"} <= {*v.dims}]
        raise ExperimentError(f"bonds have no history of '{name}'; available: {['strain', *names]}")
    rows = np.flatnonzero((dataset["bond_ends"].values == ends).all(axis=-1))
    if not len(rows):
        raise ExperimentError(f"there is no bond between {ends[0]} and {ends[1]}")
    return Series(label, None, in_units(values.isel(bond=int(rows[0]))))


def _strain(dataset: xarray.Dataset, ends: list[int]) -> Any:
    """Return the relative change of the distance between two particles."""
    a, b = (dataset["position"].sel(particle=number) for number in ends)
    X, Y = (dataset["reference"].sel(particle=number) for number in ends)
    rest = float(np.hypot(*(Y.values - X.values)))
    distance = ((b - a) ** 2).sum("axis", skipna=False) ** 0.5
    return (distance / rest - 1.0).assign_attrs(long_name="strain of the bond", units="1")
