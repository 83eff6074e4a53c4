"""Data of pictures. These are the body with its cells and its outline, the recorded steps, the
quantity that is drawn and, for curves, variables by name.

A field is drawn on the cells of the body at rest. They are quadrilaterals or triangles, and are cut
at the outline.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from pbdkit.array_types import Array
from pbdkit.errors import ExperimentError, did_you_mean
from pbdkit.io.layout import (
    INDICES,
    OF_BODY,
    as_step,
    broken_by,
    diagnostics_that_provide,
    json_attribute,
    rows_of,
    with_principal_values,
)
from pbdkit.lattice.raster import FRAME
from pbdkit.model.bodies import AnyBody, Body as Shape, Sites
from pbdkit.plotting.style import PlotOptions, in_its_units, is_number, label, plain
from pbdkit.plugin import Vector
from pbdkit.plugin.units import Scales

if TYPE_CHECKING:
    import xarray


MAX_SIDE_RATIO = 1.35
"""The side of a triangle bridges a hole or a notch if the ratio of its length to the median length
exceeds this number."""


def cells_of(site: Array, reference: Array) -> Array:
    """Return an array of shape (cell, 4) with the rows of the corners of each cell, in their order
    around the cell. In triangles the last corner occurs twice.

    `site` (particle, 2) are whole numbers. If the positions of the sites (i, j) repeat along i, as
    on Bravais lattices, the cells are the cells of the Delaunay tessellation of the lattice:
    squares, rectangles or triangles. Otherwise they are the Delaunay triangles of the particles,
    except triangles that bridge gaps. Returns None if all particles are collinear.
    """
    cells = _of_sites(site, reference) if len(site) else None
    if cells is None:
        triangles = triangles_of(reference)
        cells = triangles[:, [0, 1, 2, 2]]
    return cells


def cell_triangles(site: Array, reference: Array) -> Array:
    """Return the cells as triangles, (triangle, 3): quadrilaterals are divided into two."""
    cells = cells_of(site, reference)
    halves = cells[cells[:, 2] != cells[:, 3]][:, [0, 2, 3]]
    return np.concatenate([cells[:, :3], halves])


def triangles_of(reference: Array) -> Array:
    """Return the Delaunay triangles, as an array of shape (triangle, 3). Triangles that bridge gaps
    are omitted. There are none if all places are collinear."""
    from scipy.spatial import Delaunay, QhullError

    try:
        triangles = Delaunay(reference).simplices
    except (QhullError, ValueError):
        return np.empty((0, 3), np.intp)
    corners = reference[triangles]
    sides = corners - np.roll(corners, 1, axis=1)
    longest = np.hypot(sides[..., 0], sides[..., 1]).max(axis=1)
    return np.asarray(triangles[longest <= MAX_SIDE_RATIO * np.median(longest)])


def _of_sites(site: Array, reference: Array) -> Array | None:
    """Return the cells between the sites (i, j), (i+1, j), (i+1, j+1) and (i, j+1). They are
    quadrilaterals, or are divided along the shorter diagonal. Return None if the positions of sites
    do not repeat."""
    low = site.min(axis=0)
    shape = site.max(axis=0) - low + 1
    if shape.min() < 2 or shape.prod() > 20 * len(site):
        return None
    rows = np.full(shape, -1, np.int32)
    rows[tuple((site - low).T)] = np.arange(len(site))
    along, up = _steps(rows, reference, 0), _steps(rows, reference, 1)
    if (rows >= 0).sum() < len(site) or not len(along) or not len(up):
        return None
    # On a Bravais lattice the shift of row j + 1 relative to row j is the same for all j.
    j = np.nonzero((rows[:, :-1] >= 0) & (rows[:, 1:] >= 0))[1]
    of_row = np.full((shape[1] - 1, 2), np.nan)
    of_row[j] = up
    slack = 1e-6 * np.abs(along[0]).max()
    if max(np.abs(along - along[0]).max(), np.abs(up - of_row[j]).max()) > slack:
        return None
    a, b = rows[:-1, :-1].ravel(), rows[1:, :-1].ravel()
    c, d = rows[1:, 1:].ravel(), rows[:-1, 1:].ravel()
    rise = np.broadcast_to(of_row, (shape[0] - 1, *of_row.shape)).reshape(-1, 2)
    rising = np.hypot(*(along[0] + rise).T)  # Diagonal from a to c.
    falling = np.hypot(*(along[0] - rise).T)  # Diagonal from b to d.
    equal = np.abs(rising - falling) <= 1e-6 * rising
    quads = np.stack([a, b, c, d], axis=1)[equal]
    shorter = ~equal & (rising < falling)
    longer = ~equal & (rising > falling)
    triangles = [np.stack([a, b, c, c], 1)[shorter], np.stack([a, c, d, d], 1)[shorter],
                 np.stack([a, b, d, d], 1)[longer], np.stack([b, c, d, d], 1)[longer]]  # fmt: skip
    cells = np.concatenate([quads, *triangles])
    # A missing corner is -1, which has the sign bit set.
    complete = np.bitwise_or.reduce([cells[:, k] for k in range(4)]) >= 0
    return cells if complete.all() else cells[complete]


def _steps(rows: Array, reference: Array, axis: int) -> Array:
    """Return the differences between the positions of consecutive sites along an index, (pair, 2).
    Pairs in which a site does not exist are omitted."""
    count = rows.shape[axis]
    rows_from, rows_to = rows.take(range(count - 1), axis), rows.take(range(1, count), axis)
    both = (rows_from >= 0) & (rows_to >= 0)
    return np.asarray(reference[rows_to[both]] - reference[rows_from[both]])


def whole(cells: Array, pairs: Array, particles: int) -> Array:
    """Return a mask of shape (cell,) of the cells in which none of the pairs is a side or a
    diagonal. The pairs are rows in an array of shape (pair, 2)."""
    intact = np.ones(len(cells), np.bool_)
    if not len(pairs):
        return intact
    touched = np.zeros(particles, np.bool_)
    touched[pairs] = True
    near = np.flatnonzero(touched[cells].sum(axis=1) >= 2)
    broken = np.unique(pair_codes(pairs, particles))
    ends = [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3)]
    sides = np.stack([pair_codes(cells[near][:, end], particles) for end in ends], axis=1)
    intact[near[np.isin(sides, broken).any(axis=1)]] = False
    return intact


def outline(cells: Array, particles: int) -> Array:
    """Return the sides that belong to only one cell, as pairs of rows, (side, 2)."""
    sides = np.concatenate([cells[:, [k, (k + 1) % 4]] for k in range(4)])
    sides = sides[sides[:, 0] != sides[:, 1]]
    codes, counts = np.unique(pair_codes(sides, particles), return_counts=True)
    return np.stack(np.divmod(codes[counts == 1], particles), axis=1)


def pair_codes(pairs: Array, particles: int) -> Array:
    """Return a number for each pair. It does not depend on the order of the pair."""
    first, second = pairs.astype(np.int64).T
    return np.asarray(np.minimum(first, second) * particles + np.maximum(first, second))


PARTS = 8
"""Number of parts into which each side of a cut cell is divided. The outline is straight in each
part of the cell."""
MAX_POINTS = 400_000
"""Maximum number of points at which the distance from the outline is evaluated. If many cells are
cut, the cells are small on the page and are divided into fewer parts."""
OUTLINE_RTOL = 1e-6
"""Tolerance, relative to the size of a cell, within which a point counts as lying on the
outline."""


def shape_of(dataset: xarray.Dataset) -> Shape | None:
    """Return the outline of the body in a dataset. Return None if the dataset contains no outline,
    or if the body is given by its sites."""
    experiment = json_attribute(dataset, "experiment")
    try:
        # Values with units occur in the experiment of a member of a sweep.
        units = Scales.model_validate({"units": experiment.get("units")}).units
        shape: Shape = TypeAdapter(AnyBody).validate_python(
            experiment["body"], context={"units": units}
        )
    except (KeyError, ValidationError):
        return None
    return None if any(box.in_sites for box in shape.boxes()) else shape


def lattice_unit(dataset: xarray.Dataset) -> float:
    """Return the length of a lattice unit in the units of drawing."""
    lengths = dataset["position"].attrs
    return float(in_its_units(lengths)[0] / lengths.get("lattice_factor", 1.0))


@dataclass(frozen=True)
class CutCells:
    """The cells that are cut by an outline.

    `distance` of shape (cut cell, point, point) is the signed distance, positive outside the
    outline, at points [v, u] of the cell. The coordinates u and v run from 0 to 1 along the sides
    of the cell; a point is the mean of the four corners with the weights (1 - u)(1 - v), u(1 - v),
    uv and (1 - u)v. `row` of shape (cell,) is the row of each cell in `distance`, and -1 if the
    cell is not cut.
    """

    row: Array
    distance: Array

    @property
    def parts(self) -> int:
        """Return the number of parts of each side of a cell."""
        return int(self.distance.shape[1]) - 1

    @classmethod
    def of(cls, shape: Shape, cells: Array, reference: Array, outside: Array) -> CutCells:
        """Compute which cells are cut at rest. The shape of `cells` is (cell, 4). `outside` marks
        the particles that lie outside the outline."""
        near = np.zeros(len(reference), bool)
        near[cells[outside[cells].any(axis=1)]] = True
        candidates = np.flatnonzero(near[cells].any(axis=1))
        parts = int(min(PARTS, max(1.0, math.sqrt(MAX_POINTS / max(1, len(candidates))) - 1.0)))
        at = between(reference[cells[candidates]], np.linspace(0.0, 1.0, parts + 1))
        size = np.ptp(reference[cells[candidates]], axis=1).max(initial=0.0)
        distance = distance_from(shape, at) - OUTLINE_RTOL * size
        is_cut = (distance > 0.0).any(axis=(1, 2))
        row = np.full(len(cells), -1, np.int32)
        row[candidates[is_cut]] = np.arange(np.count_nonzero(is_cut))
        return cls(row, distance[is_cut].astype(np.float32))

    def outside(self, rows: Array, middles: Array) -> Array:
        """Return a mask of shape (cell, v, u) of those samples of some cut cells that lie outside
        the outline. The samples lie at `middles` along both sides of a cell."""
        points = np.linspace(0.0, 1.0, self.distance.shape[1])
        hats = np.maximum(0.0, 1.0 - np.abs(middles[:, None] - points) * (len(points) - 1))
        hats = hats.astype(np.float32)
        return np.asarray(hats @ self.distance[rows] @ hats.T > 0.0)


def outline_at_rest(shape: Shape, cut: CutCells, cells: Array, reference: Array) -> Array:
    """Return the outline of a body with cut cells, as segments (side, end, axis)."""
    corners = reference[cells[cut.row >= 0]]
    return np.concatenate(
        [
            _through_cells(cut, corners),
            _along_cells(shape, reference[outline(cells, len(reference))]),
        ]
    )


def _through_cells(cut: CutCells, corners: Array) -> Array:
    """Return the zero line of the distance as segments. There is one segment in each triangle that
    the line crosses; each part of a cut cell is divided into two triangles."""
    at = between(corners, np.linspace(0.0, 1.0, cut.distance.shape[1]))
    low, high, segments = slice(None, -1), slice(1, None), []
    first, last = (low, low), (high, high)
    for triangle in ((first, (low, high), last), (first, last, (high, low))):
        place = np.stack([at[:, v, u].reshape(-1, 2) for v, u in triangle], axis=1)
        distance = np.stack([cut.distance[:, v, u].ravel() for v, u in triangle], axis=1)
        mixed = (distance > 0.0).any(axis=1) & (distance <= 0.0).any(axis=1)
        place, distance = place[mixed], distance[mixed]
        place_next, distance_next = np.roll(place, -1, axis=1), np.roll(distance, -1, axis=1)
        crossed = (distance > 0.0) != (distance_next > 0.0)
        share = np.where(crossed, distance / np.where(crossed, distance - distance_next, 1.0), 0.0)
        segments.append(
            (place + share[..., None] * (place_next - place))[crossed].reshape(-1, 2, 2)
        )
    return np.concatenate(segments)


def _along_cells(shape: Shape, sides: Array) -> Array:
    """Return those parts of the sides of the mesh boundary that are inside the outline, as an array
    of shape (side, end, axis)."""
    share = np.linspace(0.0, 1.0, PARTS + 1)[:, None]
    points = sides[:, :1] * (1.0 - share) + sides[:, 1:] * share
    size = np.ptp(sides, axis=1).max(initial=0.0)
    inside = distance_from(shape, points) <= OUTLINE_RTOL * size
    whole = inside.all(axis=1)
    pieces = np.stack([points[~whole, :-1], points[~whole, 1:]], axis=2)
    return np.concatenate([sides[whole], pieces[inside[~whole, :-1] & inside[~whole, 1:]]])


def between(corners: Array, along: Array) -> Array:
    """Return the places (cell, v, u, axis) between the corners (cell, 4, axis) of cells."""
    return np.asarray(np.einsum("vuk,cka->cvua", corner_weights(along), corners))


def corner_weights(along: Array) -> Array:
    """Return the weights (v, u, corner) of the four corners of a cell at places along its sides."""
    u, v = np.meshgrid(along, along)
    return np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=-1)


def distance_from(shape: Shape, at: Array) -> Array:
    """Return the signed distance of places, (..., axis), from an outline."""
    nowhere = np.zeros(at.shape[:-1], int)
    distance: Array = shape.distance(Sites((nowhere, nowhere), Vector(at[..., 0], at[..., 1])))
    return distance


PLACES = ("position", "reference", "number", "particle", "site", *INDICES)
"""Variables that contain positions or numbers of particles."""


@dataclass(frozen=True)
class PlottedQuantity:
    """A quantity with a value for each `owner`, which is particle or bond. The value is taken from
    the variable `variable`. If this is a vector, the value is the component with the index
    `component`, or the length of the vector if `component` is None. Values have to be multiplied by
    `factor` to be in `units`. `words` contains the meanings of values that are integer codes, and
    `whole` is true for other integers."""

    variable: str
    owner: str
    meaning: str
    factor: float
    units: str
    vector: bool
    component: int | None
    words: dict[int, str]
    whole: bool

    @property
    def is_place(self) -> bool:
        """Return whether the quantity is a position or a particle number. For these, zero has no
        special meaning."""
        return self.variable.split("_")[0] in PLACES

    @property
    def is_signed(self) -> bool:
        """Return whether the quantity can have both signs, so that zero is neutral."""
        return not self.is_place and (self.component is not None or not self.vector)

    def values(self, part: xarray.Dataset) -> Array:
        """Return the values of shape (time, owner) of a dataset that is loaded and has a time
        dimension. Particles or bonds without a value have NaN."""
        variable = part[self.variable]
        values = np.asarray(variable.transpose("time", self.owner, "axis", missing_dims="ignore"))
        values = values.astype(float) if values.dtype.kind in "biu" else values
        if self.vector:
            along = self.component
            values = np.linalg.norm(values, axis=-1) if along is None else values[..., along]
        if "time" not in variable.dims:
            values = np.repeat(values[None], part.sizes["time"], axis=0)
        # Bonds that are intact at a time have no value, including bonds that break in a later step.
        if self.variable == "broken_step":
            values = np.where(broken_by(values, part["time"].values[:, None]), values, np.nan)
        return values if self.factor == 1.0 else self.factor * values


def axes_of(dataset: xarray.Dataset) -> list[str]:
    """Return the names of the axes of vectors."""
    return [str(axis) for axis in dataset["axis"].values] if "axis" in dataset.coords else []


def component_of(dataset: xarray.Dataset, name: str) -> tuple[str, int | None]:
    """Split `u_x` into the vector `u` and the index of x along its axis; other names are returned
    with None."""
    stem, _, axis = name.rpartition("_")
    axes, variables = axes_of(dataset), dataset.variables
    if (
        name not in variables
        and stem in variables
        and axis in axes
        and "axis" in variables[stem].dims
    ):
        return stem, axes.index(axis)
    return name, None


def quantity_of(dataset: xarray.Dataset, name: str) -> PlottedQuantity:
    """Return the quantity with a name. The name is that of a variable; for a vector `u` it means
    the length, and `u_x` means the component along x. Raises ExperimentError if the variable cannot
    be drawn."""
    if not isinstance(name, str):
        raise ExperimentError(
            f"color: expected the name of a variable, such as 'pe1' or 'u_x', got {name!r}; a "
            "recorded step is given as time=400"
        )
    drawable = {str(n): v for n, v in dataset.variables.items() if _is_drawable(v)}
    axes = axes_of(dataset)
    variable, component = component_of(dataset, name)
    if variable not in drawable:
        refuse_color(name, dataset, drawable, axes)
    chosen = drawable[variable]
    vector, words = "axis" in chosen.dims, _words(chosen.attrs)
    meaning = str(chosen.attrs.get("long_name") or variable)
    if vector:
        meaning = (
            f"length of {meaning}" if component is None else f"{meaning}, along {axes[component]}"
        )
    return PlottedQuantity(
        variable,
        "bond" if "bond" in chosen.dims else "particle",
        meaning,
        *in_its_units(chosen.attrs),
        vector,
        component,
        words,
        chosen.dtype.kind in "iu" and not words,
    )


def refuse_color(
    name: str, dataset: xarray.Dataset, drawable: Iterable[str], axes: Iterable[str]
) -> None:
    """Raise ExperimentError. The message contains the diagnostic that records the variable or, if
    there is none, the variables that can be drawn."""
    names = [n for n in drawable if n in dataset.data_vars]
    if makers := makers_of_missing(dataset, name):
        raise ExperimentError(
            f"'{name}' was not recorded; add {' or '.join(makers)} to `diagnostics`, and run the "
            f"experiment again; drawable: {', '.join(names)}"
        )
    if name == "kind":
        raise ExperimentError(
            "the kinds of particles, which are drawn by default, were not recorded; select a "
            f"variable with --color, in Python with color=: {', '.join(names)}"
        )
    if name in dataset.data_vars:
        raise ExperimentError(
            f"'{name}' cannot be drawn over the body, because it has no values at particles or "
            f"bonds; {drawn_by_curve(name)}"
        )
    vectors = [n for n in (*names, *drawable) if "axis" in dataset[n].dims]
    parts = [f"{n}_{axis}" for n in vectors for axis in axes]
    suggestion = did_you_mean(name, [*drawable, *parts]) or ";"
    raise ExperimentError(
        f"'{name}' cannot be drawn{suggestion} drawable: {', '.join(names)}; of vectors also the "
        f"components, as {parts[0]}"
    )


def drawn_by_curve(name: str) -> str:
    """Return the remedy for a variable that is drawn over the steps."""
    return f"`pbdkit curve OUT.nc --y {name}`, in Python ds.pbd.curve('{name}'), draws it"


OF_CONTROL = ("opening", "load_factor", "dissipated_energy")
"""Variables of runs with a control of the load."""


def makers_of_missing(dataset: xarray.Dataset, name: str) -> list[str]:
    """Return the diagnostics that compute a variable, or the vector of which it is a component, as
    they are written in experiments. Return none if the variable was recorded, or if no diagnostic
    computes it."""
    vector, _, axis = name.rpartition("_")
    names = {name, vector} if axis in axes_of(dataset) else {name}
    recorded = [*map(str, dataset.variables)]
    if names & {*recorded} or any(other.startswith(f"{name}_") for other in recorded):
        return []
    return diagnostics_that_provide(names)


def _is_drawable(variable: xarray.Variable) -> bool:
    """Return whether a variable has a number or a vector for each particle, or a number for each
    bond."""
    shapes = ({"particle"}, {"particle", "axis"}, {"bond"})
    return {*variable.dims} - {"time"} in shapes and variable.dtype.kind in "biuf"


def _words(attributes: dict[Any, Any]) -> dict[int, str]:
    if "flag_values" not in attributes or "flag_meanings" not in attributes:
        return {}
    values = np.atleast_1d(attributes["flag_values"])
    return dict(zip(map(int, values), str(attributes["flag_meanings"]).split(), strict=False))


ROUNDING = 1e-12
"""Fraction of the largest value of a run up to which values count as rounding errors. For energies,
which are squares, it is the square of this number."""
ROUNDING_STEPS = 8
"""Number of recorded steps at which the largest value of a run is determined."""
BLOCK_BYTES = 2**26
"""Approximate number of bytes that are read from a file at once."""
UNKNOWN = FRAME + 1
"""Kind of particles of the body if kinds were not recorded. It has no colour."""
MAX_MEASURED_PARTICLES = 50_000
"""Maximum number of particles for which the spacing is measured. For more particles it is estimated
from the area of the body."""


@dataclass(frozen=True)
class ReferenceBody:
    """The data of a body that do not change in time. For each particle, `reference` (particle,
    axis) is the reference position, `site` (particle, index) are the site indices, and `number`
    (particle,) is the particle number. `inside` of shape (particle,) is true for particles of the
    body and false for frame points. `ends` of shape (bond, 2) are the rows of both ends of each
    bond. `broken_step` of shape (bond,) is the step in which the bond broke, and -1 if it is
    intact. `outside` marks the corners of cut cells that lie outside the outline. `shape` is the
    outline in lattice units, and None if it is unknown or there are no such corners. `unit` is the
    length of a lattice unit in the units of lengths."""

    reference: Array
    site: Array
    number: Array
    inside: Array
    ends: Array
    broken_step: Array
    outside: Array
    shape: Shape | None
    unit: float

    @cached_property
    def cells(self) -> Array:
        """Rows of the corners of the body's cells, (cell, 4)."""
        rows = np.flatnonzero(self.inside)
        return np.asarray(rows[cells_of(self.site[rows], self.reference[rows])])

    @cached_property
    def cells_with_frame(self) -> Array:
        """Rows of the corners of all cells, including those between body and frame."""
        return cells_of(self.site, self.reference)

    @cached_property
    def spacing(self) -> float:
        """Approximate distance between neighbouring particles at rest. For small bodies it is the
        median of the distances of some particles from their nearest neighbours."""
        x = self.reference
        if 1 < len(x) <= MAX_MEASURED_PARTICLES:
            few = np.linspace(0, len(x) - 1, 50).astype(int)
            squares = np.array([np.sort(((x - x[k]) ** 2).sum(axis=1))[1] for k in few])
            return float(np.sqrt(np.median(squares))) or 1.0
        width, height = np.ptp(x, axis=0) if len(x) else (0.0, 0.0)
        return float(np.sqrt(width * height / max(1, len(x)))) or 1.0

    @cached_property
    def cut(self) -> CutCells | None:
        """Data of those `cells` that are cut by the outline; None if there is no outline."""
        if self.shape is None:
            return None
        return CutCells.of(self.shape, self.cells, self.reference / self.unit, self.outside)

    @cached_property
    def outline(self) -> Array:
        """Outline at rest, as segments (side, end, axis)."""
        if self.shape is None or self.cut is None:
            return np.asarray(self.reference[outline(self.cells, len(self.reference))])
        at_rest = self.reference / self.unit
        return self.unit * outline_at_rest(self.shape, self.cut, self.cells, at_rest)

    def whole_cells(self, cells: Array, broken: Array) -> Array:
        """Return the indices of the cells that have no broken bond along a side."""
        if not broken.any():
            return np.arange(len(cells))
        return np.flatnonzero(whole(cells, self.ends[broken], len(self.reference)))


@dataclass(frozen=True)
class Snapshot:
    """Data of one step. `position` (particle, axis) and `kind` (particle,) belong to particles.
    `broken` (bond,) is true for broken bonds. `values` are those of the quantity, if there is
    one."""

    step: float
    position: Array
    kind: Array
    values: Array | None
    broken: Array


class Trajectory:
    """Recorded steps of a dataset with the quantity `color`, if one is given. Values are in
    physical units if the dataset defines their scale.

    Raises ExperimentError for a dataset of several runs, for a lattice in space, and for a quantity
    that cannot be drawn. Only the necessary data are read.
    """

    def __init__(self, dataset: xarray.Dataset, color: str | None = None) -> None:
        self._dataset = of_one_run(dataset)
        self.quantity: PlottedQuantity | None = None
        if color is not None:
            has_kinds = "kind" in dataset.variables
            drawable = self._dataset if has_kinds else self._dataset.drop_vars("kind")
            self.quantity = quantity_of(drawable, color)
        self.title = plain(self._dataset.attrs.get("title", ""))
        self._factor, self._length_units = in_its_units(self._dataset["position"].attrs)
        self.steps = self._dataset["time"].values

    @property
    def axis_labels(self) -> tuple[str, str]:
        """Labels of both axes."""
        return label("x", self._length_units), label("y", self._length_units)

    @cached_property
    def _rows(self) -> Array:
        """Rows of the particles that exist. In concatenated runs, some particles may be missing."""
        reference = self._dataset["reference"].transpose("particle", "axis").values
        return np.flatnonzero(np.isfinite(reference).all(axis=1))

    @cached_property
    def body(self) -> ReferenceBody:
        """Data that do not change between steps."""
        dataset, rows = self._dataset, self._rows
        numbers = dataset["number"].values[rows]
        ends, broken = np.empty((0, 2), np.intp), np.empty(0)
        if "bond_ends" in dataset:
            bond_ends = dataset["bond_ends"].transpose("bond", "end").values
            ends = rows_of(numbers, bond_ends)
            self._bonds = np.flatnonzero((ends >= 0).all(axis=1))
            ends, broken = ends[self._bonds], np.full(len(self._bonds), -1.0)
        if "broken_step" in dataset and len(ends):
            broken = np.nan_to_num(dataset["broken_step"].values[self._bonds], nan=-1.0)
        reference = self._factor * dataset["reference"].transpose("particle", "axis").values[rows]
        site = np.stack([dataset[name].values[rows] for name in "ij"], axis=1).astype(np.int64)
        inside = dataset["role"].values[rows] == OF_BODY
        outside = np.zeros(len(rows), bool)
        if "inside" in dataset.variables:
            outside = inside & ~dataset["inside"].values[rows].astype(bool)
        shape = shape_of(dataset) if outside.any() else None
        return ReferenceBody(
            reference, site, numbers, inside, ends, broken, outside, shape, lattice_unit(dataset)
        )

    @cached_property
    def rounding(self) -> float:
        """Magnitude up to which values are rounding errors. It is a fraction of the largest value
        at some recorded steps, and 0 for positions, classes and integers."""
        quantity = self.quantity
        if quantity is None or quantity.is_place or quantity.words or quantity.whole:
            return 0.0
        last = len(self.steps) - 1
        rows = np.unique(np.linspace(0, last, ROUNDING_STEPS).round().astype(int)).tolist()
        ranges = [value_range(snapshot.values) for snapshot in self.snapshots(rows)]
        squared = quantity.variable.startswith("pe") or "energy" in quantity.variable
        share = ROUNDING**2 if squared else ROUNDING
        return share * max(map(abs, _joined(ranges, (0.0, 0.0))))

    def row(self, time: float | None) -> int:
        """Return the index of a step; None means the last step. Raises ExperimentError if the step
        was not recorded."""
        if time is None:
            return len(self.steps) - 1
        if not is_number(time):
            raise ExperimentError(
                f"time: expected a recorded step, such as {as_step(self.steps[-1])}, got {time!r}; "
                "a variable is given as color='pe1'"
            )
        exactly = self.steps.dtype.kind == "i"
        steps = self.steps if exactly else np.array([as_step(step) for step in self.steps])
        rows = np.flatnonzero(steps == (time if exactly else as_step(time)))
        if not len(rows):
            near = [*self.steps[self.steps < time][-1:], *self.steps[self.steps > time][:1]]
            raise ExperimentError(
                f"step {as_step(time)} was not recorded; the nearest recorded: "
                f"{' and '.join(str(as_step(step)) for step in near)}"
            )
        return int(rows[-1])

    def snapshots(self, rows: Sequence[int]) -> Iterator[Snapshot]:
        """Generate steps in order, loading several at a time."""
        body, quantity = self.body, self.quantity
        names = {"position", "kind", *([quantity.variable] if quantity else [])}
        names &= {*map(str, self._dataset.variables)}
        block = max(1, BLOCK_BYTES // (40 * max(1, len(body.reference))))
        for start in range(0, len(rows), block):
            chosen = list(rows[start : start + block])
            part = self._dataset.isel(time=chosen).reset_coords()[[*names]].load()
            part = part.assign_coords(time=self.steps[chosen])
            position = part["position"].transpose("time", "particle", "axis").values
            kind = part["kind"].transpose("time", "particle").values
            values = quantity.values(part) if quantity else None
            for n, row in enumerate(chosen):
                step = float(self.steps[row])
                # The fraction of a step at which a bond broke is only known for the last step.
                is_last = row == len(self.steps) - 1
                broken = broken_by(body.broken_step, math.ceil(step) if is_last else step)
                yield Snapshot(
                    as_step(step),
                    self._factor * position[n][self._rows],
                    np.nan_to_num(kind[n][self._rows]).astype(np.int8),
                    None if values is None else values[n][self._owners],
                    broken,
                )

    @property
    def _owners(self) -> Array:
        of_bond = self.quantity is not None and self.quantity.owner == "bond"
        return self._bonds if of_bond else self._rows


def of_one_run(dataset: xarray.Dataset) -> xarray.Dataset:
    """Return the dataset with a time dimension. Raises ExperimentError if its positions are not
    those of one run in the plane."""
    dataset = with_principal_values(_with_positions(dataset))
    position = dataset["position"]
    extra_dims = [str(d) for d in position.dims if d not in ("time", "particle", "axis")]
    if extra_dims:
        sizes = ", ".join(f"{d}: {position.sizes[d]}" for d in extra_dims)
        first = ", ".join(f"{d}=0" for d in extra_dims)
        raise ExperimentError(
            f"a picture shows one run, but the dataset contains several ({sizes}); select one "
            f"with --at NAME=VALUE, in Python with isel or sel: ds.isel({first}).pbd.plot(...)"
        )
    if dataset.sizes["axis"] != 2:
        raise ExperimentError(
            f"pictures are two-dimensional, but positions have {dataset.sizes['axis']} axes"
        )
    if "particle" not in dataset.dims or not dataset.sizes["particle"]:
        raise ExperimentError("there are no particles to draw; keep the dimension `particle`")
    if "time" in position.dims:
        run = dataset
    else:
        expanded = {name: dataset[name].expand_dims("time") for name in ("position", "kind")}
        run = dataset.assign(expanded)
    if not run.sizes["time"]:
        raise ExperimentError("no step was recorded")
    return run


def _with_positions(dataset: xarray.Dataset) -> xarray.Dataset:
    """Return the dataset with positions and kinds. If positions were not recorded, the positions at
    rest are used. Raises ExperimentError if these are missing, too."""
    added = {}
    if "kind" not in dataset.variables and "role" in dataset.variables:
        unknown = np.where(dataset["role"] == OF_BODY, UNKNOWN, FRAME)
        added["kind"] = dataset["role"].copy(data=unknown)
    if "position" not in dataset.variables:
        if "reference" not in dataset.variables or "role" not in dataset.variables:
            raise ExperimentError("there are no positions to draw; keep the variable `position`")
        added["position"] = dataset["reference"]
        title = f"{dataset.attrs.get('title', '')}, drawn at rest"
        dataset = dataset.assign_attrs(title=title)
    if "time" in dataset.dims:
        added = {name: values.expand_dims(time=dataset["time"]) for name, values in added.items()}
    return dataset.assign(added)


Box = tuple[float, float, float, float]
MARGIN = 0.015
"""Margin around a body, relative to the longer side of the body. The margin is at least the
distance between particles."""
THINNEST = 40.0
"""Maximum aspect ratio of a panel."""


@dataclass(frozen=True)
class Extent:
    """Extent of several steps. `box` is the bounding box (left, right, bottom, top). `of_body`
    contains the lowest and the highest value in the body, and `of_all` contains those in the body
    and the frame. `kinds` are the kinds of particles that occur, and `classes` the classes of the
    quantity that occur. `is_zero` is true if all values are rounding errors, in comparison with
    other recorded steps; both ranges are then zero."""

    box: Box
    of_body: tuple[float, float]
    of_all: tuple[float, float]
    kinds: frozenset[int]
    classes: frozenset[int]
    is_zero: bool = False


def extent_of(recording: Trajectory, snapshots: Iterable[Snapshot], look: PlotOptions) -> Extent:
    """Compute the extent of steps of a recording. The steps are processed one after the other.
    Raises ExperimentError if no particle has a position."""
    body, quantity = recording.body, recording.quantity
    reference = body.reference if look.outline else np.empty((0, 2))
    low, high = [reference.min(axis=0, initial=np.inf)], [reference.max(axis=0, initial=-np.inf)]
    inner, outer, kinds, classes = [], [], set[int](), set[int]()
    for snapshot in snapshots:
        place = snapshot.position[np.isfinite(snapshot.position).all(axis=1)]
        low.append(place.min(axis=0, initial=np.inf))
        high.append(place.max(axis=0, initial=-np.inf))
        kinds |= _numbers(snapshot.kind[within(look.window, snapshot.position)])
        if snapshot.values is not None:
            shown = coloured_values(body, quantity, snapshot, look, in_body=False)
            inner.append(value_range(coloured_values(body, quantity, snapshot, look, in_body=True)))
            outer.append(value_range(shown))
            if quantity and quantity.words:
                classes |= _numbers(shown)
    lowest, highest = np.min(low, axis=0), np.max(high, axis=0)
    if not (lowest <= highest).all():
        raise ExperimentError("there are no positions to draw: all are NaN")
    if look.window and not kinds:
        edges = ", ".join(f"{edge:g}" for edge in look.window)
        raise ExperimentError(
            f"window: no particle lies within {edges}; the body extends from {lowest[0]:g} to "
            f"{highest[0]:g} along x and from {lowest[1]:g} to {highest[1]:g} along y"
        )
    margin = max(body.spacing, MARGIN * float(np.max(highest - lowest)))
    (xmin, ymin), (xmax, ymax) = lowest - margin, highest + margin
    box = _no_thinner(*(look.window or (xmin, xmax, ymin, ymax)))
    of_body, of_all = _joined(inner), _joined(outer)
    is_zero = False
    if look.limits == "all" and look.norm in ("linear", "sqrt") and any(of_all):
        is_zero = max(map(abs, of_all)) <= recording.rounding
    if is_zero:
        of_body = of_all = (0.0, 0.0)
    return Extent(box, of_body, of_all, frozenset(kinds), frozenset(classes), is_zero)


def combine(extents: Sequence[Extent]) -> Extent:
    """Combine the extents of several recordings."""
    boxes = np.array([e.box for e in extents])
    (xmin, _, ymin, _), (_, xmax, _, ymax) = boxes.min(axis=0), boxes.max(axis=0)
    return Extent(
        _no_thinner(xmin, xmax, ymin, ymax),
        _joined([e.of_body for e in extents]),
        _joined([e.of_all for e in extents]),
        frozenset().union(*(e.kinds for e in extents)),
        frozenset().union(*(e.classes for e in extents)),
        all(e.is_zero for e in extents),
    )


def _no_thinner(xmin: float, xmax: float, ymin: float, ymax: float) -> Box:
    thinnest = max(xmax - xmin, ymax - ymin) / THINNEST
    across, up = (max(0.0, thinnest - side) / 2 for side in (xmax - xmin, ymax - ymin))
    return (float(xmin - across), float(xmax + across), float(ymin - up), float(ymax + up))


def _numbers(values: Array) -> set[int]:
    """Return the whole numbers that occur in an array of small whole numbers."""
    integers = values[np.isfinite(values)].astype(int)
    return {int(low) for low in np.flatnonzero(np.bincount(integers))}


def within(window: Box | None, place: Array) -> Array:
    """Return a mask of the places, (..., axis), that lie in a window. Without a window all do."""
    if window is None:
        return np.ones(place.shape[:-1], bool)
    (left, right, bottom, top), (x, y) = window, np.moveaxis(place, -1, 0)
    return np.asarray((left <= x) & (x <= right) & (bottom <= y) & (y <= top))


def coloured_values(
    body: ReferenceBody,
    quantity: PlottedQuantity | None,
    snapshot: Snapshot,
    look: PlotOptions,
    *,
    in_body: bool,
) -> Array:
    """Return the values that determine the limits of colours: those in the window. A bond is in the
    window if its midpoint is. With `in_body`, frame points are excluded."""
    assert snapshot.values is not None
    if quantity is not None and quantity.owner == "bond":
        rows = within(look.window, snapshot.position[body.ends].mean(axis=1))
    else:
        rows = within(look.window, snapshot.position) & (body.inside | (not in_body))
    return np.asarray(snapshot.values[rows])


def value_range(values: Array | None) -> tuple[float, float]:
    """Return the lowest and the highest value. Both are NaN if there are no values."""
    finite = np.empty(0) if values is None else values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if len(finite) else (np.nan, np.nan)


def _joined(
    ranges: Sequence[tuple[float, float]], otherwise: tuple[float, float] = (0.0, 1.0)
) -> tuple[float, float]:
    """Return the smallest range that contains several ranges. It is `otherwise` if none of them is
    finite."""
    finite = [r for r in ranges if np.isfinite(r[0])]
    return (min(r[0] for r in finite), max(r[1] for r in finite)) if finite else otherwise


SUM_BLOCK_BYTES = 2**25
"""Approximate number of bytes that are summed at once."""
SUMMED = ("pe1", "pe1_intact", "contact")
"""Variables that are summed over particles. For all other variables the mean is drawn."""
CHOSEN_BY = {"leader_group": "group", "load": "load", "obstacle": "obstacle"}
"""Dimensions from which one index is selected, and the names of the arguments that select it."""
OF_A_RUN = {"time", "step", "crack", "particle", "bond", "axis", "tracked", "end", *CHOSEN_BY}
"""Dimensions of one run; all others belong to a sweep."""


def variable(dataset: xarray.Dataset, name: str) -> xarray.DataArray:
    """Return a variable without reading its values. For a name such as `u_x` return the component
    of `u`.

    Raises ExperimentError if there is no variable of that name.
    """
    if not isinstance(name, str):
        raise ExperimentError(f"expected the name of a variable, such as 'pe1', got {name!r}")
    dataset = with_principal_values(dataset)
    (whole, component), axes = component_of(dataset, name), axes_of(dataset)
    if whole not in dataset.variables:
        raise ExperimentError(_unknown(dataset, name, axes))
    if component is None:
        return dataset[whole]
    component_values = dataset[whole].isel(axis=component)
    meaning = f"{component_values.attrs.get('long_name', whole)}, {axes[component]} component"
    return component_values.assign_attrs(long_name=meaning)


def _unknown(dataset: xarray.Dataset, name: str, axes: list[str]) -> str:
    names: list[str] = []
    for each, values in dataset.data_vars.items():
        if values.dtype.kind in "biuf":
            parts = [f"{each}_{axis}" for axis in axes] if "axis" in values.dims else [str(each)]
            names += parts
    if makers := makers_of_missing(dataset, name):
        return (
            f"'{name}' was not recorded; add {' or '.join(makers)} to `diagnostics`, and run the "
            "experiment again"
        )
    if name in OF_CONTROL:
        return (
            f"'{name}' was not recorded; it is recorded with solver: {{type: equilibrium, control: "
            "...}"
        )
    suggestion = did_you_mean(name, names) or ";"
    return f"there is no variable '{name}'{suggestion} available: {', '.join(names)}"


def scalar(dataset: xarray.Dataset, name: str, chosen: Mapping[str, int | None]) -> Any:
    """Return a DataArray along time and the dimensions of a sweep, in the units of the variable. It
    is the sum or the mean over particles or bonds, or the values of the `chosen` leader group, load
    or obstacle.

    Raises ExperimentError if there is not exactly one number for each step.
    """
    values = variable(dataset, name)
    if "axis" in values.dims:
        components = ", ".join(f"'{name}_{axis}'" for axis in dataset["axis"].values)
        raise ExperimentError(f"'{name}' is a vector; use one of {components}")
    if values.dtype.kind not in "biuf":
        raise ExperimentError(f"'{name}' contains no numbers")
    for dim, argument in CHOSEN_BY.items():
        if dim in values.dims:
            values = _one_of(values, dim, argument, chosen.get(argument))
    for dim in ("particle", "bond"):
        if dim in values.dims:
            values = _over(values, dataset, dim)
    run_dims = [str(d) for d in values.dims if d in OF_A_RUN]
    if len(run_dims) > 1:
        raise ExperimentError(
            f"'{name}' has more than one value per step: it has the dimensions "
            f"{' and '.join(run_dims)}"
        )
    return in_units(values)


def in_units(values: xarray.DataArray) -> xarray.DataArray:
    """Read the values and return them. They are in physical units if the variable defines the
    scale."""
    factor, units = in_its_units(values.attrs)
    attributes = {"long_name": values.attrs.get("long_name", str(values.name)), "units": units}
    converted = values.astype(float) * factor
    converted.attrs = attributes
    return converted


def _one_of(values: xarray.DataArray, dim: str, argument: str, place: int | None) -> Any:
    places = values[dim].values.tolist()
    if place is None and len(places) == 1:
        (place,) = places
    if place not in places:
        text = "several are recorded" if place is None else f"there is no {place}"
        description = f"'{values.name}' has {dim.replace('_', ' ')}s {', '.join(map(str, places))}"
        raise ExperimentError(
            f"{description}: {text}; select one by "
            f"--{argument} {places[-1]}, in Python by {argument}={places[-1]}"
        )
    meaning = f"{values.attrs.get('long_name', values.name)} {place}"
    return values.sel({dim: place}).assign_attrs(long_name=meaning)


def _over(values: xarray.DataArray, dataset: xarray.Dataset, dim: str) -> Any:
    """Return the sum or the mean over the particles of the body or over bonds. It is computed for
    some steps at a time."""
    import xarray

    summed = values.name in SUMMED
    what = (
        "sum over the body" if summed else f"mean over {'bonds' if dim == 'bond' else 'the body'}"
    )
    attributes = values.attrs | {
        "long_name": f"{values.attrs.get('long_name', values.name)}, {what}"
    }
    role = dataset.get("role") if dim == "particle" else None
    body = slice(None) if role is None or role.dims != (dim,) else role.values == OF_BODY

    def reduced(part: xarray.DataArray) -> xarray.DataArray:
        whole = part.transpose(..., dim)
        numbers = np.asarray(whole.values, float)[..., body]
        finite = np.isfinite(numbers).any(axis=-1)
        total = np.nansum(numbers, axis=-1)
        if not summed:
            total = total / np.maximum(np.isfinite(numbers).sum(axis=-1), 1)
        return whole.isel({dim: 0}, drop=True).copy(data=np.where(finite, total, np.nan))

    if "time" not in values.dims:
        return reduced(values).assign_attrs(attributes)
    each = max(1, values.nbytes // max(1, values.sizes["time"]))
    block = max(1, SUM_BLOCK_BYTES // each)
    starts = range(0, values.sizes["time"], block)
    parts = [reduced(values.isel(time=slice(n, n + block))) for n in starts]
    return xarray.concat(parts, "time").assign_attrs(attributes)
