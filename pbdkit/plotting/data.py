"""Datasets as pictures read them: the body with its cells and outline, recorded steps of it, the
quantity that is drawn in colour, and variables by name as curves need them.

Fields fill the cells of the body at rest, quadrilaterals or triangles, up to its outline.
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
    json_attribute,
    makers_of,
    rows_of,
)
from pbdkit.lattice.raster import FRAME
from pbdkit.model.bodies import AnyBody, Body as Shape, Sites
from pbdkit.plotting.style import Look, in_its_units, is_number, label, plain
from pbdkit.plugin import Vector

if TYPE_CHECKING:
    import xarray


BRIDGE = 1.35
"""A reference triangle longer than so many usual ones bridges a hole or a notch."""


def cells_of(site: Array, reference: Array) -> Array:
    """The rows of the corners of each cell, (cell, 4), in turn; of triangles the last one twice.

    `site` (particle, 2) are whole numbers. Where the places of sites (i, j) repeat along i, as on
    Bravais lattices, cells are Delaunay's of the lattice: squares and rectangles, else triangles.
    Elsewhere they are Delaunay's triangles without those that bridge gaps. None where all particles
    are in line.
    """
    found = _of_sites(site, reference) if len(site) else None
    if found is None:
        triangles = triangles_of(reference)
        found = triangles[:, [0, 1, 2, 2]]
    return found


def triangles_of(reference: Array) -> Array:
    """Delaunay's triangles, (triangle, 3), without those that bridge gaps; none where all places
    are in line."""
    from scipy.spatial import Delaunay, QhullError

    try:
        triangles = Delaunay(reference).simplices
    except (QhullError, ValueError):
        return np.empty((0, 3), np.intp)
    corners = reference[triangles]
    sides = corners - np.roll(corners, 1, axis=1)
    longest = np.hypot(sides[..., 0], sides[..., 1]).max(axis=1)
    return np.asarray(triangles[longest <= BRIDGE * np.median(longest)])


def _of_sites(site: Array, reference: Array) -> Array | None:
    """The cells between sites (i, j), (i+1, j), (i+1, j+1), (i, j+1), whole or halved along the
    shorter diagonal; None where the places of sites do not repeat."""
    low = site.min(axis=0)
    shape = site.max(axis=0) - low + 1
    if shape.min() < 2 or shape.prod() > 20 * len(site):
        return None
    rows = np.full(shape, -1, np.int32)
    rows[tuple((site - low).T)] = np.arange(len(site))
    along, up = _steps(rows, reference, 0), _steps(rows, reference, 1)
    if (rows >= 0).sum() < len(site) or not len(along) or not len(up):
        return None
    # How far row j + 1 is shifted against row j is the same all along them, on a Bravais lattice.
    j = np.nonzero((rows[:, :-1] >= 0) & (rows[:, 1:] >= 0))[1]
    of_row = np.full((shape[1] - 1, 2), np.nan)
    of_row[j] = up
    slack = 1e-6 * np.abs(along[0]).max()
    if max(np.abs(along - along[0]).max(), np.abs(up - of_row[j]).max()) > slack:
        return None
    a, b = rows[:-1, :-1].ravel(), rows[1:, :-1].ravel()
    c, d = rows[1:, 1:].ravel(), rows[:-1, 1:].ravel()
    rise = np.broadcast_to(of_row, (shape[0] - 1, *of_row.shape)).reshape(-1, 2)
    rising = np.hypot(*(along[0] + rise).T)  # a to c
    falling = np.hypot(*(along[0] - rise).T)  # b to d
    equal = np.abs(rising - falling) <= 1e-6 * rising
    quads = np.stack([a, b, c, d], axis=1)[equal]
    shorter = ~equal & (rising < falling)
    longer = ~equal & (rising > falling)
    triangles = [np.stack([a, b, c, c], 1)[shorter], np.stack([a, c, d, d], 1)[shorter],
                 np.stack([a, b, d, d], 1)[longer], np.stack([b, c, d, d], 1)[longer]]  # fmt: skip
    found = np.concatenate([quads, *triangles])
    there = np.bitwise_or.reduce([found[:, k] for k in range(4)]) >= 0  # -1 has the sign bit
    return found if there.all() else found[there]


def _steps(rows: Array, reference: Array, axis: int) -> Array:
    """From each site to the next along an index, (pair, 2), where both are."""
    count = rows.shape[axis]
    here, there = rows.take(range(count - 1), axis), rows.take(range(1, count), axis)
    both = (here >= 0) & (there >= 0)
    return np.asarray(reference[there[both]] - reference[here[both]])


def whole(cells: Array, pairs: Array, particles: int) -> Array:
    """Which cells, (cell,), have none of these pairs of rows, (pair, 2), as a side or diagonal."""
    kept = np.ones(len(cells), np.bool_)
    if not len(pairs):
        return kept
    touched = np.zeros(particles, np.bool_)
    touched[pairs] = True
    near = np.flatnonzero(touched[cells].sum(axis=1) >= 2)
    gone = np.unique(_codes(pairs, particles))
    ends = [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3)]
    sides = np.stack([_codes(cells[near][:, end], particles) for end in ends], axis=1)
    kept[near[np.isin(sides, gone).any(axis=1)]] = False
    return kept


def outline(cells: Array, particles: int) -> Array:
    """The sides of one cell only, as pairs of rows, (side, 2)."""
    sides = np.concatenate([cells[:, [k, (k + 1) % 4]] for k in range(4)])
    sides = sides[sides[:, 0] != sides[:, 1]]
    codes, counts = np.unique(_codes(sides, particles), return_counts=True)
    return np.stack(np.divmod(codes[counts == 1], particles), axis=1)


def _codes(pairs: Array, particles: int) -> Array:
    """One number for each pair, whichever comes first."""
    low, high = np.sort(pairs.astype(np.int64), axis=1).T
    return np.asarray(low * particles + high)


PARTS = 8
"""Parts along each side of a cut cell, in each of which the outline is straight."""
MOST_POINTS = 400_000
"""Points at which the distance to the outline is computed at most: where more cells are cut, these
are small on the page, and have fewer parts."""
ON_IT = 1e-6
"""Of a cell's size: a point that lies no farther beyond the outline counts as on it."""


def shape_of(dataset: xarray.Dataset) -> Shape | None:
    """Return the outline of the body that a dataset carries; None where it carries none, and of a
    body of given sites, which has none."""
    try:
        shape: Shape = TypeAdapter(AnyBody).validate_python(
            json_attribute(dataset, "experiment")["body"]
        )
    except (KeyError, ValidationError):
        return None
    return None if any(box.in_sites for box in shape.boxes()) else shape


def lattice_unit(dataset: xarray.Dataset) -> float:
    """Return what a lattice unit is in the units in which lengths of a dataset are drawn."""
    lengths = dataset["position"].attrs
    return float(in_its_units(lengths)[0] / lengths.get("lattice_factor", 1.0))


@dataclass(frozen=True)
class CutCells:
    """The cells that an outline cuts.

    `row` (cell,) is the row of each cell in `distance`, -1 where it is not cut; `distance` (cut
    cell, point, point) is the signed distance, positive beyond the outline, at points along both
    sides of the cell: [v, u] lies between the corners as (1 - u)(1 - v), u(1 - v), uv, (1 - u)v
    weigh them.
    """

    row: Array
    distance: Array

    @classmethod
    def of(cls, shape: Shape, cells: Array, reference: Array, beyond: Array) -> CutCells:
        """Of cells by the rows of their corners, (cell, 4), at their places at rest, some of which
        lie `beyond` the outline."""
        near = np.zeros(len(reference), bool)
        near[cells[beyond[cells].any(axis=1)]] = True
        candidates = np.flatnonzero(near[cells].any(axis=1))
        parts = int(min(PARTS, max(1.0, math.sqrt(MOST_POINTS / max(1, len(candidates))) - 1.0)))
        at = between(reference[cells[candidates]], np.linspace(0.0, 1.0, parts + 1))
        size = np.ptp(reference[cells[candidates]], axis=1).max(initial=0.0)
        distance = distance_from(shape, at) - ON_IT * size
        is_cut = (distance > 0.0).any(axis=(1, 2))
        row = np.full(len(cells), -1, np.int32)
        row[candidates[is_cut]] = np.arange(np.count_nonzero(is_cut))
        return cls(row, distance[is_cut].astype(np.float32))

    def beyond(self, rows: Array, middles: Array) -> Array:
        """Return which samples of some cut cells lie beyond the outline, (cell, v, u): those at
        `middles` along both sides."""
        points = np.linspace(0.0, 1.0, self.distance.shape[1])
        hats = np.maximum(0.0, 1.0 - np.abs(middles[:, None] - points) * (len(points) - 1))
        hats = hats.astype(np.float32)
        return np.asarray(hats @ self.distance[rows] @ hats.T > 0.0)


def outline_at_rest(shape: Shape, cut: CutCells, cells: Array, reference: Array) -> Array:
    """Return the sides (side, end, axis) of the outline of a body, where cells are cut within
    them."""
    corners = reference[cells[cut.row >= 0]]
    return np.concatenate(
        [
            _through_cells(cut, corners),
            _along_cells(shape, reference[outline(cells, len(reference))]),
        ]
    )


def _through_cells(cut: CutCells, corners: Array) -> Array:
    """Where the distance changes its sign, in triangles, each half of a part of a cut cell."""
    at = between(corners, np.linspace(0.0, 1.0, cut.distance.shape[1]))
    low, high, found = slice(None, -1), slice(1, None), []
    first, last = (low, low), (high, high)
    for triangle in ((first, (low, high), last), (first, last, (high, low))):
        place = np.stack([at[:, v, u].reshape(-1, 2) for v, u in triangle], axis=1)
        away = np.stack([cut.distance[:, v, u].ravel() for v, u in triangle], axis=1)
        mixed = (away > 0.0).any(axis=1) & (away <= 0.0).any(axis=1)
        place, away = place[mixed], away[mixed]
        after, away_after = np.roll(place, -1, axis=1), np.roll(away, -1, axis=1)
        crossed = (away > 0.0) != (away_after > 0.0)
        share = np.where(crossed, away / np.where(crossed, away - away_after, 1.0), 0.0)
        found.append((place + share[..., None] * (after - place))[crossed].reshape(-1, 2, 2))
    return np.concatenate(found)


def _along_cells(shape: Shape, sides: Array) -> Array:
    """Sides (side, end, axis) of one cell only, as far as they lie inside."""
    share = np.linspace(0.0, 1.0, PARTS + 1)[:, None]
    points = sides[:, :1] * (1.0 - share) + sides[:, 1:] * share
    size = np.ptp(sides, axis=1).max(initial=0.0)
    inside = distance_from(shape, points) <= ON_IT * size
    whole = inside.all(axis=1)
    pieces = np.stack([points[~whole, :-1], points[~whole, 1:]], axis=2)
    return np.concatenate([sides[whole], pieces[inside[~whole, :-1] & inside[~whole, 1:]]])


def between(corners: Array, along: Array) -> Array:
    """Return the places (cell, v, u, axis) between the corners (cell, 4, axis) of cells."""
    u, v = np.meshgrid(along, along)
    weights = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=-1)
    return np.asarray(np.einsum("vuk,cka->cvua", weights, corners))


def distance_from(shape: Shape, at: Array) -> Array:
    """Return the signed distance of places (..., axis) to an outline."""
    nowhere = np.zeros(at.shape[:-1], int)
    distance: Array = shape.distance(Sites((nowhere, nowhere), Vector(at[..., 0], at[..., 1])))
    return distance


PLACES = ("position", "reference", "number", "particle", "site", *INDICES)
"""Variables of where things are, or what they are called."""


@dataclass(frozen=True)
class PlottedQuantity:
    """Values of each `owner`, particle or bond, out of the variable `variable`: its component
    number `component`, or the length where it is a vector and that is None, times `factor` in its
    `units`. `words` has the meanings of whole numbers that stand for words.
    """

    variable: str
    owner: str
    meaning: str
    factor: float
    units: str
    vector: bool
    component: int | None
    words: dict[int, str]

    @property
    def is_place(self) -> bool:
        """Whether it is where things are, or a number: zero is one of many."""
        return self.variable.split("_")[0] in PLACES

    @property
    def is_signed(self) -> bool:
        """Whether zero is neutral, between values of both signs."""
        return not self.is_place and (self.component is not None or not self.vector)

    def values(self, part: xarray.Dataset) -> Array:
        """(time, owner), of a dataset in memory that has a time; NaN where there is none."""
        variable = part[self.variable]
        found = np.asarray(variable.transpose("time", self.owner, "axis", missing_dims="ignore"))
        found = found.astype(float) if found.dtype.kind in "biu" else found
        if self.vector:
            along = self.component
            found = np.linalg.norm(found, axis=-1) if along is None else found[..., along]
        if "time" not in variable.dims:
            found = np.repeat(found[None], part.sizes["time"], axis=0)
        if self.variable == "broken_step":  # -1 where it is whole, as it was at earlier steps
            found = np.where(broken_by(found, part["time"].values[:, None]), found, np.nan)
        return found if self.factor == 1.0 else self.factor * found


def axes_of(dataset: xarray.Dataset) -> list[str]:
    """The names of the axes along which vectors have components."""
    return [str(axis) for axis in dataset["axis"].values] if "axis" in dataset.coords else []


def component_of(dataset: xarray.Dataset, name: str) -> tuple[str, int | None]:
    """Of `u_x` the vector `u` and the place of x along its axis; of all else the name itself and
    None."""
    stem, _, axis = name.rpartition("_")
    axes, there = axes_of(dataset), dataset.variables
    if name not in there and stem in there and axis in axes and "axis" in there[stem].dims:
        return stem, axes.index(axis)
    return name, None


def quantity_of(dataset: xarray.Dataset, name: str) -> PlottedQuantity:
    """The quantity of that name: a variable, its length where it is a vector, or `u_x`, the
    component along x of a vector `u`. Raises ExperimentError for what cannot be drawn."""
    if not isinstance(name, str):
        raise ExperimentError(
            f"color: expected the name of a variable, such as 'pe1' or 'u_x', got {name!r}; a "
            "recorded step is given as time=400"
        )
    found = {str(n): v for n, v in dataset.variables.items() if _is_drawable(v)}
    axes = axes_of(dataset)
    variable, component = component_of(dataset, name)
    if variable not in found:
        refuse_color(name, dataset, found, axes)
    chosen = found[variable]
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
    )


def refuse_color(
    name: str, dataset: xarray.Dataset, found: Iterable[str], axes: Iterable[str]
) -> None:
    """Raise ExperimentError that names the diagnostic which makes the variable, or what can be
    drawn instead."""
    known = [n for n in found if n in dataset.data_vars]
    if makers := makers_of_missing(dataset, name):
        raise ExperimentError(
            f"'{name}' was not recorded, and cannot be drawn: add {' or '.join(makers)} to "
            f"`diagnostics`, and run again; what can be drawn now: {', '.join(known)}"
        )
    vectors = [n for n in (*known, *found) if "axis" in dataset[n].dims]
    parts = [f"{n}_{axis}" for n in vectors for axis in axes]
    near = did_you_mean(name, [*found, *parts]) or ";"
    raise ExperimentError(
        f"'{name}' cannot be drawn{near} what can be drawn: {', '.join(known)}; of vectors, the "
        f"length and components, as {parts[0]}"
    )


def makers_of_missing(dataset: xarray.Dataset, name: str) -> list[str]:
    """Return the diagnostics that make the variable, or the vector of which it is a component, as
    an experiment names them; none where it was recorded, or no diagnostic makes it."""
    vector, _, axis = name.rpartition("_")
    names = {name, vector} if axis in axes_of(dataset) else {name}
    recorded = [*map(str, dataset.variables)]
    if names & {*recorded} or any(other.startswith(f"{name}_") for other in recorded):
        return []
    return makers_of(names)


def _is_drawable(variable: xarray.Variable) -> bool:
    """Whether it has a number or a vector for each particle, or a number for each bond."""
    shapes = ({"particle"}, {"particle", "axis"}, {"bond"})
    return {*variable.dims} - {"time"} in shapes and variable.dtype.kind in "biuf"


def _words(attributes: dict[Any, Any]) -> dict[int, str]:
    if "flag_values" not in attributes or "flag_meanings" not in attributes:
        return {}
    values = np.atleast_1d(attributes["flag_values"])
    return dict(zip(map(int, values), str(attributes["flag_meanings"]).split(), strict=False))


BLOCK_BYTES = 2**26
"""So much is read of a file at a time."""
UNKNOWN = FRAME + 1
"""The kind of a particle of the body where kinds were not kept: it has no colour."""
MEASURED = 50_000
"""The distance of particles is measured in bodies of up to so many, and else from their area."""


@dataclass(frozen=True)
class ReferenceBody:
    """What does not change: `reference` (particle, axis), `site` (particle, index), `number`
    (particle,), which are of the body and not of the frame (particle,), the rows of both ends of
    each bond (bond, 2), and when each broke (bond,), -1 where it did not. Of the body `beyond` are
    corners of cut cells that lie beyond its outline, `shape`, which is None where there are none or
    it is not known. A lattice unit is `unit` in the units of lengths; those of the
    shape are lattice units."""

    reference: Array
    site: Array
    number: Array
    inside: Array
    ends: Array
    broken_step: Array
    beyond: Array
    shape: Shape | None
    unit: float

    @cached_property
    def cells(self) -> Array:
        """The rows of the corners of the body's cells, (cell, 4)."""
        rows = np.flatnonzero(self.inside)
        return np.asarray(rows[cells_of(self.site[rows], self.reference[rows])])

    @cached_property
    def cells_with_frame(self) -> Array:
        """The same with those between body and frame."""
        return cells_of(self.site, self.reference)

    @cached_property
    def spacing(self) -> float:
        """How far apart particles are at rest: the median of a few, to the nearest."""
        x = self.reference
        if 1 < len(x) <= MEASURED:
            few = np.linspace(0, len(x) - 1, 50).astype(int)
            squares = np.array([np.sort(((x - x[k]) ** 2).sum(axis=1))[1] for k in few])
            return float(np.sqrt(np.median(squares))) or 1.0
        width, height = np.ptp(x, axis=0) if len(x) else (0.0, 0.0)
        return float(np.sqrt(width * height / max(1, len(x)))) or 1.0

    @cached_property
    def cut(self) -> CutCells | None:
        """Those of `cells` that the outline cuts; None where there are none."""
        if self.shape is None:
            return None
        return CutCells.of(self.shape, self.cells, self.reference / self.unit, self.beyond)

    @cached_property
    def outline(self) -> Array:
        """The outline at rest, as sides (side, end, axis)."""
        if self.shape is None or self.cut is None:
            return np.asarray(self.reference[outline(self.cells, len(self.reference))])
        at_rest = self.reference / self.unit
        return self.unit * outline_at_rest(self.shape, self.cut, self.cells, at_rest)

    def whole_cells(self, cells: Array, broken: Array) -> Array:
        """The numbers of those without a broken bond along a side."""
        if not broken.any():
            return np.arange(len(cells))
        return np.flatnonzero(whole(cells, self.ends[broken], len(self.reference)))


@dataclass(frozen=True)
class Snapshot:
    """One step: `position` (particle, axis), `kind` (particle,), `values` of the quantity, if any,
    and which bonds are `broken` (bond,)."""

    step: float
    position: Array
    kind: Array
    values: Array | None
    broken: Array


class Trajectory:
    """The recorded steps of a dataset, with the quantity of that name, if any; in mm and so on
    where the dataset says its scale.

    Raises ExperimentError for a dataset of several runs, for space that is no plane, and for a
    quantity that cannot be drawn. Only what is asked for is read.
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
        """What stands at both axes."""
        return label("x", self._length_units), label("y", self._length_units)

    @cached_property
    def _rows(self) -> Array:
        """The particles that are there: of several runs joined, some are not in each."""
        reference = self._dataset["reference"].transpose("particle", "axis").values
        return np.flatnonzero(np.isfinite(reference).all(axis=1))

    @cached_property
    def body(self) -> ReferenceBody:
        """What does not change."""
        dataset, rows = self._dataset, self._rows
        numbers = dataset["number"].values[rows]
        ends, broken = np.empty((0, 2), np.intp), np.empty(0)
        if "bond_ends" in dataset:
            given = dataset["bond_ends"].transpose("bond", "end").values
            ends = rows_of(numbers, given)
            self._bonds = np.flatnonzero((ends >= 0).all(axis=1))
            ends, broken = ends[self._bonds], np.full(len(self._bonds), -1.0)
        if "broken_step" in dataset and len(ends):
            broken = np.nan_to_num(dataset["broken_step"].values[self._bonds], nan=-1.0)
        reference = self._factor * dataset["reference"].transpose("particle", "axis").values[rows]
        site = np.stack([dataset[name].values[rows] for name in "ij"], axis=1).astype(np.int64)
        inside = dataset["role"].values[rows] == OF_BODY
        beyond = np.zeros(len(rows), bool)
        if "inside" in dataset.variables:
            beyond = inside & ~dataset["inside"].values[rows].astype(bool)
        shape = shape_of(dataset) if beyond.any() else None
        return ReferenceBody(
            reference, site, numbers, inside, ends, broken, beyond, shape, lattice_unit(dataset)
        )

    def row(self, time: float | None) -> int:
        """Where a step lies; None is the last. Raises ExperimentError where it was not recorded."""
        if time is None:
            return len(self.steps) - 1
        if not is_number(time):
            raise ExperimentError(
                f"time: expected a recorded step, such as {as_step(self.steps[-1])}, got {time!r}; "
                "a variable is given as color='pe1'"
            )
        exactly = self.steps.dtype.kind == "i"
        known = self.steps if exactly else np.array([as_step(step) for step in self.steps])
        rows = np.flatnonzero(known == (time if exactly else as_step(time)))
        if not len(rows):
            near = [*self.steps[self.steps < time][-1:], *self.steps[self.steps > time][:1]]
            raise ExperimentError(
                f"step {as_step(time)} was not recorded; the nearest recorded: "
                f"{' and '.join(str(as_step(step)) for step in near)}"
            )
        return int(rows[-1])

    def snapshots(self, rows: Sequence[int]) -> Iterator[Snapshot]:
        """Those steps, in order, of which some at a time are in memory."""
        body, quantity = self.body, self.quantity
        names = {"position", "kind", *([quantity.variable] if quantity else [])}
        names &= {*map(str, self._dataset.variables)}
        many = max(1, BLOCK_BYTES // (40 * max(1, len(body.reference))))
        for start in range(0, len(rows), many):
            chosen = list(rows[start : start + many])
            part = self._dataset.isel(time=chosen).reset_coords()[[*names]].load()
            part = part.assign_coords(time=self.steps[chosen])
            position = part["position"].transpose("time", "particle", "axis").values
            kind = part["kind"].transpose("time", "particle").values
            values = quantity.values(part) if quantity else None
            for n, row in enumerate(chosen):
                step = float(self.steps[row])
                # In which fraction of a step a bond broke is not known but for the last one.
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
    """The dataset, with a time even where it was one of several. Raises ExperimentError where its
    positions are not those of one run in the plane."""
    dataset = _with_positions(dataset)
    position = dataset["position"]
    others = [str(d) for d in position.dims if d not in ("time", "particle", "axis")]
    if others:
        sizes = ", ".join(f"{d}: {position.sizes[d]}" for d in others)
        first = ", ".join(f"{d}=0" for d in others)
        raise ExperimentError(
            f"a picture is of one run, and this holds several ({sizes}); pick one with isel or "
            f"sel: ds.isel({first}).pbd.plot(...)"
        )
    if dataset.sizes["axis"] != 2:
        raise ExperimentError(
            f"pictures are of the plane, and positions here have {dataset.sizes['axis']} axes"
        )
    if "particle" not in dataset.dims or not dataset.sizes["particle"]:
        raise ExperimentError("there are no particles to draw: keep the dimension `particle`")
    if "time" in position.dims:
        there = dataset
    else:
        again = {name: dataset[name].expand_dims("time") for name in ("position", "kind")}
        there = dataset.assign(again)
    if not there.sizes["time"]:
        raise ExperimentError("no step was recorded")
    return there


def _with_positions(dataset: xarray.Dataset) -> xarray.Dataset:
    """The dataset itself, or where positions were not kept, at rest. Raises ExperimentError where
    the places at rest are not there either."""
    if "position" in dataset.variables:
        return dataset
    if "reference" not in dataset.variables or "role" not in dataset.variables:
        raise ExperimentError("there are no positions to draw: keep the variable `position`")
    unknown = np.where(dataset["role"] == OF_BODY, UNKNOWN, FRAME)
    added = {"position": dataset["reference"]}
    if "kind" not in dataset.variables:
        added["kind"] = dataset["role"].copy(data=unknown)
    if "time" in dataset.dims:
        added = {name: one.expand_dims(time=dataset["time"]) for name, one in added.items()}
    title = f"{dataset.attrs.get('title', '')}, drawn at rest"
    return dataset.assign(added).assign_attrs(title=title)


Box = tuple[float, float, float, float]
MARGIN = 0.015
"""So much of the longer side is left free around a body, and the distance of particles at least."""
THINNEST = 40.0
"""A body so many times as long as broad is not drawn thinner."""


@dataclass(frozen=True)
class Extent:
    """What several steps cover: the `box` (left, right, bottom, top) that holds them, the lowest
    and the highest value of the body and of all, frame and all, and the kinds, and classes of the
    quantity, that are there."""

    box: Box
    of_body: tuple[float, float]
    of_all: tuple[float, float]
    kinds: frozenset[int]
    classes: frozenset[int]


def extent_of(recording: Trajectory, shown: Iterable[Snapshot], look: Look) -> Extent:
    """What steps of a recording cover, looked at one after another. Raises
    ExperimentError where no particle has a place in them."""
    body, quantity = recording.body, recording.quantity
    reference = body.reference if look.outline else np.empty((0, 2))
    low, high = [reference.min(axis=0, initial=np.inf)], [reference.max(axis=0, initial=-np.inf)]
    inner, outer, kinds, classes = [], [], set[int](), set[int]()
    inside = body.inside if quantity is None or quantity.owner == "particle" else slice(None)
    for now in shown:
        place = now.position[np.isfinite(now.position).all(axis=1)]
        low.append(place.min(axis=0, initial=np.inf))
        high.append(place.max(axis=0, initial=-np.inf))
        kinds |= _numbers(now.kind)
        if now.values is not None:
            inner.append(_range(now.values[inside]))
            outer.append(_range(now.values))
            if quantity and quantity.words:
                classes |= _numbers(now.values)
    lowest, highest = np.min(low, axis=0), np.max(high, axis=0)
    if not (lowest <= highest).all():
        raise ExperimentError("no particle has a place in what is to be drawn: positions are NaN")
    margin = max(body.spacing, MARGIN * float(np.max(highest - lowest)))
    (left, bottom), (right, top) = lowest - margin, highest + margin
    box = _no_thinner(left, right, bottom, top)
    return Extent(box, _joined(inner), _joined(outer), frozenset(kinds), frozenset(classes))


def joined(extents: Sequence[Extent]) -> Extent:
    """What several cover together."""
    boxes = np.array([e.box for e in extents])
    (left, _, bottom, _), (_, right, _, top) = boxes.min(axis=0), boxes.max(axis=0)
    return Extent(
        _no_thinner(left, right, bottom, top),
        _joined([e.of_body for e in extents]),
        _joined([e.of_all for e in extents]),
        frozenset().union(*(e.kinds for e in extents)),
        frozenset().union(*(e.classes for e in extents)),
    )


def _no_thinner(left: float, right: float, bottom: float, top: float) -> Box:
    least = max(right - left, top - bottom) / THINNEST
    across, up = (max(0.0, least - side) / 2 for side in (right - left, top - bottom))
    return (float(left - across), float(right + across), float(bottom - up), float(top + up))


def _numbers(of: Array) -> set[int]:
    """Which small whole numbers there are."""
    found = of[np.isfinite(of)].astype(int)
    return {int(low) for low in np.flatnonzero(np.bincount(found))}


def _range(values: Array) -> tuple[float, float]:
    """The lowest and the highest; NaN twice where there is none."""
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if len(finite) else (np.nan, np.nan)


def _joined(ranges: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """That of all of them; 0 to 1 where there are none."""
    found = [r for r in ranges if np.isfinite(r[0])]
    return (min(r[0] for r in found), max(r[1] for r in found)) if found else (0.0, 1.0)


SUM_BLOCK_BYTES = 2**25
"""About so much is in memory at a time of what is summed."""
SUMMED = ("pe1", "pe1_intact", "contact")
"""What adds up over particles; of all else the mean is taken."""
CHOSEN_BY = {"leader_group": "group", "load": "load", "obstacle": "obstacle"}
"""The dimensions of which one place is taken, and the arguments that say which."""
OF_A_RUN = {"time", "step", "crack", "particle", "bond", "axis", "tracked", "end", *CHOSEN_BY}
"""The dimensions of one run; others are those of a sweep."""


def variable(dataset: xarray.Dataset, name: str) -> xarray.DataArray:
    """A variable, or of `u_x` the component of `u`; nothing is read yet.

    Raises ExperimentError where there is none of that name.
    """
    if not isinstance(name, str):
        raise ExperimentError(f"expected the name of a variable, such as 'pe1', got {name!r}")
    (whole, component), axes = component_of(dataset, name), axes_of(dataset)
    if whole not in dataset.variables:
        raise ExperimentError(_unknown(dataset, name, axes))
    if component is None:
        return dataset[whole]
    found = dataset[whole].isel(axis=component)
    meaning = f"{found.attrs.get('long_name', whole)}, {axes[component]} component"
    return found.assign_attrs(long_name=meaning)


def _unknown(dataset: xarray.Dataset, name: str, axes: list[str]) -> str:
    known: list[str] = []
    for each, values in dataset.data_vars.items():
        if values.dtype.kind in "biuf":
            parts = [f"{each}_{axis}" for axis in axes] if "axis" in values.dims else [str(each)]
            known += parts
    if makers := makers_of_missing(dataset, name):
        return (
            f"'{name}' was not recorded: add {' or '.join(makers)} to `diagnostics`, and run again"
        )
    near = did_you_mean(name, known) or ";"
    return f"there is no variable '{name}'{near} what there is: {', '.join(known)}"


def scalar(dataset: xarray.Dataset, name: str, chosen: Mapping[str, int | None]) -> Any:
    """A DataArray along time, and along the dimensions of a sweep: of particles and bonds their sum
    or mean, of leader groups, loads and obstacles the `chosen` one, in the units that the variable
    says.

    Raises ExperimentError for what is no number a step.
    """
    found = variable(dataset, name)
    if "axis" in found.dims:
        some = ", ".join(f"'{name}_{axis}'" for axis in dataset["axis"].values)
        raise ExperimentError(f"'{name}' is a vector; take one of {some}")
    if found.dtype.kind not in "biuf":
        raise ExperimentError(f"'{name}' holds no numbers")
    for dim, argument in CHOSEN_BY.items():
        if dim in found.dims:
            found = _one_of(found, dim, argument, chosen.get(argument))
    for dim in ("particle", "bond"):
        if dim in found.dims:
            found = _over(found, dataset, dim)
    more = [str(d) for d in found.dims if d in OF_A_RUN]
    if len(more) > 1:
        raise ExperimentError(f"'{name}' is no single number a step: it has {' and '.join(more)}")
    return in_units(found)


def in_units(found: xarray.DataArray) -> xarray.DataArray:
    """The values, now read, in mm and so on where the variable says its scale."""
    factor, units = in_its_units(found.attrs)
    said = {"long_name": found.attrs.get("long_name", str(found.name)), "units": units}
    read = found.astype(float) * factor
    read.attrs = said
    return read


def _one_of(found: xarray.DataArray, dim: str, argument: str, place: int | None) -> Any:
    known = found[dim].values.tolist()
    if place is None and len(known) == 1:
        (place,) = known
    if place not in known:
        text = "which is meant" if place is None else f"there is no {place}"
        said = f"'{found.name}' has {dim.replace('_', ' ')}s {', '.join(map(str, known))}"
        raise ExperimentError(f"{said}: {text}; say {argument}={known[-1]}")
    meaning = f"{found.attrs.get('long_name', found.name)} {place}"
    return found.sel({dim: place}).assign_attrs(long_name=meaning)


def _over(found: xarray.DataArray, dataset: xarray.Dataset, dim: str) -> Any:
    """The sum or mean over body particles or bonds, so many steps at a time."""
    import xarray

    summed = found.name in SUMMED
    what = (
        "sum over the body" if summed else f"mean over {'bonds' if dim == 'bond' else 'the body'}"
    )
    said = found.attrs | {"long_name": f"{found.attrs.get('long_name', found.name)}, {what}"}
    role = dataset.get("role") if dim == "particle" else None
    body = slice(None) if role is None or role.dims != (dim,) else role.values == OF_BODY

    def reduced(part: xarray.DataArray) -> xarray.DataArray:
        whole = part.transpose(..., dim)
        values = np.asarray(whole.values, float)[..., body]
        some = np.isfinite(values).any(axis=-1)
        total = np.nansum(values, axis=-1)
        if not summed:
            total = total / np.maximum(np.isfinite(values).sum(axis=-1), 1)
        return whole.isel({dim: 0}, drop=True).copy(data=np.where(some, total, np.nan))

    if "time" not in found.dims:
        return reduced(found).assign_attrs(said)
    each = max(1, found.nbytes // max(1, found.sizes["time"]))
    block = max(1, SUM_BLOCK_BYTES // each)
    starts = range(0, found.sizes["time"], block)
    parts = [reduced(found.isel(time=slice(n, n + block))) for n in starts]
    return xarray.concat(parts, "time").assign_attrs(said)
