"""Report of a dataset as a single self-contained page of HTML (``pbdkit.report`` and `pbdkit
report`).

The file begins with names and units, curves, and the selection of steps and particles within a
maximum size. Bonds, the moving lattice, the experiment and convergence follow, and then the page of
a run. The last sections are statistics of sweep members, the page of a sweep, and benchmark tables.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import xarray
from numpy.typing import NDArray

from pbdkit.array_types import Array
from pbdkit.bench.work_precision import COLUMNS
from pbdkit.errors import ExperimentError, PbdkitError, StorageError
from pbdkit.io.atomic_file import write
from pbdkit.io.explain import BondRecords, BondStatus
from pbdkit.io.layout import (
    OF_BODY,
    in_this_layout,
    json_attribute,
    scene_of,
    with_principal_values,
)
from pbdkit.io.members import FILL, STATUS, SWEEP, TEXT, type_alone, unit_of
from pbdkit.io.open import reading
from pbdkit.io.physical import TWIN_OF
from pbdkit.lattice.raster import FOLLOWER, FRAME, LEADER
from pbdkit.model.experiment import Experiment
from pbdkit.model.reading import Source, yaml_text
from pbdkit.plotting.data import cell_triangles, distance_from, lattice_unit, shape_of, triangles_of
from pbdkit.plotting.style import MAX_TEXT, in_its_units, signed
from pbdkit.plugin.discovery import retired_parts
from pbdkit.plugin.fracture_model import breaking_order
from pbdkit.scene.scene import Scene
from pbdkit.stability.analysis import Analysis
from pbdkit.stability.relaxation import tuned
from pbdkit.stepping.state import describe_bonds
from pbdkit.sweeps.specification import CASE, MESSAGE
from pbdkit.sweeps.worker import STORED_STATUSES
from pbdkit.web.page import packed, page


def meaning_of(variable: xarray.DataArray) -> str:
    """Return the long name of a variable, or its name if there is none."""
    return str(variable.attrs.get("long_name") or variable.name)


def units_of(variable: xarray.DataArray) -> str:
    """Return the units of a variable in a page. They are physical units if the variable has a
    scale. The text is empty for dimensionless quantities."""
    return signed(in_its_units(variable.attrs)[1])


def factor_of(variable: xarray.DataArray) -> float:
    """Return the factor by which values are multiplied to convert them to the units of the page."""
    return in_its_units(variable.attrs)[0]


MAX_POINTS = 1200
"""Maximum number of points of a curve."""
MAX_SERIES = 12
"""Maximum number of curves of a variable."""
AGAINST = {"nominal_stress": "nominal_strain", "load_resultant": "load_displacement"}
"""Pairs of variables: the first is drawn over the second, in addition to the curve over time."""


@dataclass(frozen=True)
class Curve:
    """Lines over one axis. It contains the values `x` of the axis, the `steps` of the points, and
    the packed values of each line."""

    title: str
    steps: dict[str, Any]
    x: dict[str, Any]
    x_label: str
    y_label: str
    series: list[dict[str, Any]]


def curves(dataset: xarray.Dataset, points: int = MAX_POINTS) -> list[dict[str, Any]]:
    """Return the curves of all variables over time, or over every step, and the curves of the pairs
    AGAINST. Variables of particles or bonds, and variables with more than MAX_SERIES curves, are
    omitted. Each curve has at most `points` points."""
    names = _names(dataset)
    lines = [_over_time(dataset, name, points) for name in names]
    lines += [_against(dataset, y, x, points) for y, x in AGAINST.items() if {x, y} <= {*names}]
    return [asdict(curve) for curve in lines]


def fewer_points(dataset: xarray.Dataset) -> list[str]:
    """Return a note if curves have fewer points than steps were recorded."""
    longest = max((dataset.sizes.get(dim, 0) for dim in ("time", "step")), default=0)
    every = _every(longest, MAX_POINTS)
    return [] if every == 1 else [f"Curves show one of {every} points, of up to {longest}."]


def _names(dataset: xarray.Dataset) -> list[str]:
    return [
        str(name)
        for name, variable in dataset.data_vars.items()
        if len({"time", "step"} & {*variable.dims}) == 1
        and not {"particle", "bond"} & {*variable.dims}
        and variable.dtype.kind in "biuf"
        and TWIN_OF not in variable.attrs
        and math.prod(n for d, n in variable.sizes.items() if d not in ("time", "step"))
        <= MAX_SERIES
        and variable.size
    ]


def _every(count: int, points: int) -> int:
    return max(1, math.ceil(count / points))


def _over_time(dataset: xarray.Dataset, name: str, points: int) -> Curve:
    variable = dataset[name]
    along = "time" if "time" in variable.dims else "step"
    rows = slice(None, None, _every(variable.sizes[along], points))
    steps = dataset[along].values
    series = [
        {"name": label, "values": packed(values[rows], "f8")}
        for label, values in _lines(dataset, name, along)
    ]
    at = packed(steps[rows], "f8")
    return Curve(meaning_of(variable), at, at, "step", units_of(variable), series)


def _lines(dataset: xarray.Dataset, name: str, along: str) -> Iterator[tuple[str, Array]]:
    """Generate label and values for each index along the other dimensions."""
    variable = dataset[name].transpose(..., along)
    dims = [str(dim) for dim in variable.dims[:-1]]
    values = factor_of(variable) * np.asarray(variable.values, float)
    for place in product(*(range(variable.sizes[dim]) for dim in dims)):
        words = [_word(dataset, dim, n) for dim, n in zip(dims, place, strict=True)]
        yield ", ".join(words), values[place]


def _word(dataset: xarray.Dataset, dim: str, n: int) -> str:
    label = dataset[dim].values[n] if dim in dataset.variables else n
    return str(label) if dim == "axis" else f"{dim.replace('_', ' ')} {label}"


def _against(dataset: xarray.Dataset, y: str, x: str, points: int) -> Curve:
    """Return the curve of one variable over another. If there are several pairs of lines, only the
    pair with the largest values is drawn, because a chart has only one horizontal axis."""
    pairs = list(zip(_lines(dataset, x, "time"), _lines(dataset, y, "time"), strict=True))
    (label, across), (_, up) = max(pairs, key=lambda pair: float(np.nanmax(np.abs(pair[1][1]))))
    rows = slice(None, None, _every(len(across), points))
    titles, units = [meaning_of(dataset[n]) for n in (y, x)], [units_of(dataset[n]) for n in (y, x)]
    return Curve(
        title=" over ".join(titles),
        steps=packed(dataset["time"].values[rows], "f8"),
        x=packed(across[rows], "f8"),
        x_label=f"{titles[1]} ({units[1]})" if units[1] else titles[1],
        y_label=units[0],
        series=[{"name": label, "values": packed(up[rows], "f8")}],
    )


Rows = NDArray[np.intp]
MIN_STEPS = 60
"""Minimum number of shown steps of a run, if at least that number is recorded."""
MAX_PARTICLES = 50_000
"""Maximum number of particles that a browser can draw smoothly in motion, with their bonds."""
MAX_SHOWN_LEADERS = 200
"""Number of leaders up to which all leaders are shown, because they cause the motion."""


@dataclass(frozen=True)
class Thinning:
    """Selection of the `steps` and `particles` that are shown, out of `recorded` steps and `count`
    particles. Along each axis of the lattice every `stride`-th particle is shown. If `with_leaders`
    is true, all leaders are shown, too."""

    steps: Rows
    particles: Rows
    stride: int
    with_leaders: bool
    recorded: int
    count: int

    @property
    def is_thinner(self) -> bool:
        """Return whether a larger budget would show more."""
        return len(self.steps) < self.recorded or len(self.particles) < self.count

    def left_out(self) -> list[str]:
        """Return notes on the steps and particles that are not shown."""
        sentences = []
        if len(self.steps) < self.recorded:
            every = int(self.steps[1] - self.steps[0]) if len(self.steps) > 1 else self.recorded
            sentences.append(
                f"{len(self.steps)} of the {self.recorded} recorded steps are shown: one of "
                f"{every}, and the last."
            )
        if len(self.particles) < self.count:
            sentences.append(
                f"{len(self.particles)} of the {self.count} particles are shown: one of "
                f"{self.stride} along i and along j"
                f"{', and all leaders' if self.with_leaders else ''}. "
                "Bonds are shown where both of their particles are."
            )
        return sentences


def thinned(
    dataset: xarray.Dataset,
    leaders: NDArray[np.bool_],
    size: int,
    budget: int,
    fewest: int = MIN_STEPS,
) -> Thinning:
    """Select as many steps and particles as fit into `budget` bytes, with `size` bytes for each
    particle and step. First steps are omitted, until `fewest` steps remain, then particles.
    `leaders` of shape (particle,) is a mask; leaders are included if their number is small."""
    recorded, count = dataset.sizes.get("time", 1), dataset.sizes["particle"]
    affordable = max(1, budget // (size * count))
    every = math.ceil(recorded / max(affordable, min(recorded, fewest)))
    steps = np.unique(np.append(np.arange(0, recorded, every), recorded - 1))
    stride = 1
    selection = np.ones(count, np.bool_)
    limit = min(budget // (size * len(steps)), MAX_PARTICLES)
    while selection.sum() > limit and stride < 1000:
        stride += 1
        selection = _on_sublattice(dataset, stride)
    with_leaders = bool(0 < leaders.sum() <= MAX_SHOWN_LEADERS)
    rows = np.flatnonzero(selection | leaders if with_leaders else selection)
    return Thinning(steps, rows, stride, with_leaders, recorded, count)


def _on_sublattice(dataset: xarray.Dataset, stride: int) -> NDArray[np.bool_]:
    """Return a mask of the particles on every `stride`-th line of the lattice, along i and along
    j."""
    indices: list[NDArray[Any]] = [dataset[n].values for n in ("i", "j") if n in dataset.variables]
    if len(indices) < 2 or any(index.ndim != 1 for index in indices):
        return np.asarray(np.arange(dataset.sizes["particle"]) % stride**2 == 0)
    return np.asarray((indices[0] % stride == 0) & (indices[1] % stride == 0))


MAX_LISTED = 300
"""Maximum number of broken bonds in the table of a page."""
STATES = ("intact", "broken", "cut", "broken from the start", "cannot break")
"""Names of the states of bonds."""


@dataclass(frozen=True)
class BondArrays:
    """Data of the bonds, as arrays with one entry for each bond. `ends` are the numbers of the two
    particles, and `rest` is the rest offset. `step` is the step of breaking, and -1 for bonds that
    are not broken. `strain` is the strain at breaking and `limit` the strain above which the bond
    breaks; they are NaN if unknown. `state` is an index of STATES. `remembered` contains the final
    state variables. `order` contains the rows of the broken bonds in the order of breaking, and
    `nearest` is the bond that is closest to breaking."""

    ends: Array
    rest: Array
    shell: Array
    step: Array
    strain: Array
    limit: Array
    state: Array
    order: Rows
    model: str = "none"
    remembered: dict[str, Array] = field(default_factory=dict)
    nearest: BondStatus | None = None

    @property
    def spacing(self) -> float:
        """Return the shortest rest length."""
        return float(np.linalg.norm(self.rest, axis=1).min())

    @property
    def can_break(self) -> bool:
        """Return whether any bond broke, or could have broken."""
        return self.model not in ("none", "not known") or len(self.order) > 0

    def shown(self, particles: Rows) -> dict[str, Any]:
        """Return the bonds between the particles that are shown. Their ends are indices among these
        particles."""
        rows = self._between(particles)
        return {
            "ends": packed(np.searchsorted(particles, self.ends[rows] - 1), "i4"),
            "rest": packed(self.rest[rows], "f8"),
            "shell": packed(self.shell[rows], "u1"),
            "limit": packed(self.limit[rows], "f8"),
            "states": STATES,
            "model": self.model,
            "remembered": {n: packed(values[rows], "f8") for n, values in self.remembered.items()},
            **self.broken(particles),
        }

    def broken(self, particles: Rows) -> dict[str, Any]:
        """Return the data about breaking of the bonds between the given particles."""
        rows, place = self._between(particles), np.full(len(self.ends), -1)
        place[self.order] = np.arange(1, len(self.order) + 1)
        return {
            "step": packed(self.step[rows], "i4"),
            "strain": packed(self.strain[rows], "f8"),
            "state": packed(self.state[rows], "u1"),
            "order": packed(place[rows], "i4"),
            "broken": len(self.order),
        }

    def _between(self, particles: Rows) -> Rows:
        both_ends = np.isin(self.ends - 1, particles, kind="table").all(axis=1)
        return np.flatnonzero(both_ends)

    def ledger(self) -> dict[str, Any]:
        """Return the table of broken bonds in the order of breaking; long tables are truncated."""
        listed = self.order[:MAX_LISTED]
        counts = np.bincount(self.state, minlength=len(STATES)).tolist()
        return {
            "model": self.model,
            "bonds": len(self.ends),
            "counts": dict(zip(STATES, counts, strict=True)),
            "all": len(self.order),
            "step": self.step[listed].tolist(),
            "ends": self.ends[listed].tolist(),
            "shell": self.shell[listed].tolist(),
            "strain": packed(self.strain[listed], "f8"),
            "limit": packed(self.limit[listed], "f8"),
            "nearest": asdict(self.nearest) if self.nearest else None,
        }


def bonds_of(dataset: xarray.Dataset, scene: Scene | None) -> BondArrays | None:
    """Return the bonds of a dataset. If it has no table of bonds, return the bonds of its scene,
    unless neighbours are re-evaluated. Return None if there are no bonds. Lengths are in the units
    of the page.

    Raises ExperimentError if the scene does not match the dataset.
    """
    bonds = _in_lattice_units(dataset, scene)
    return bonds and replace(bonds, rest=lattice_unit(dataset) * bonds.rest)


def _in_lattice_units(dataset: xarray.Dataset, scene: Scene | None) -> BondArrays | None:
    if dataset.sizes.get("bond") == 0:  # No particle has neighbours.
        return None
    if scene is not None and "bond_ends" in dataset.variables:
        return _from_bond_table(BondRecords(dataset, scene), dataset)
    if "bond_ends" in dataset.variables and dataset["bond_ends"].ndim == 2:
        return _from_table(dataset)
    if scene is None or scene.experiment.neighbours.nearness():
        return None
    table = describe_bonds(scene)
    if not len(table):
        return None
    if scene.raster.count != dataset.sizes["particle"]:
        raise ExperimentError("its particles are not those of its experiment")
    return _whole(table.ends, table.rest, table.shell)


def _whole(ends: Array, rest: Array, shell: Array) -> BondArrays:
    """Return bonds with unknown limits."""
    count = len(ends)
    unknown, never = np.full(count, np.nan), np.full(count, -1)
    state, order = np.zeros(count, np.int64), np.empty(0, np.intp)
    return BondArrays(ends, rest, shell, never, unknown, unknown, state, order)


def _from_bond_table(table: BondRecords, dataset: xarray.Dataset) -> BondArrays:
    bonds = table.bonds
    names = table.remembered(0) if len(bonds) else ()
    last = {n: dataset[n].isel(time=-1, missing_dims="ignore").values for n in names}
    return BondArrays(
        bonds.ends, bonds.rest, bonds.shell, table.steps, table.strains_at_break,
        np.where(table.spared, np.nan, table.limits), _states(table.steps, table.cut, table.spared),
        table.order, table.model.type, last, table.nearest(),
    )  # fmt: skip


def _from_table(dataset: xarray.Dataset) -> BondArrays | None:
    """Return the bonds, without using the scene."""
    complete = (dataset["bond_ends"].values > 0).all(axis=1)
    if not complete.all():  # In the dataset of a sweep, other members may have more bonds.
        dataset = dataset.isel(bond=complete)
    ends = dataset["bond_ends"].values
    if not len(ends) or "reference" not in dataset.variables:
        return None
    reference = factor_of(dataset["reference"]) * dataset["reference"].values
    reference /= lattice_unit(dataset)
    shell = dataset["shell"].values if "shell" in dataset.variables else np.ones(len(ends))
    whole = _whole(ends, reference[ends[:, 1] - 1] - reference[ends[:, 0] - 1], shell)
    return replace(broken_as(whole, dataset), model="not known")


def broken_as(bonds: BondArrays, dataset: xarray.Dataset) -> BondArrays:
    """Return the bonds with the breaking steps and strains of a dataset."""
    broken_step = dataset.variables.get("broken_step")
    if broken_step is None or broken_step.shape != bonds.step.shape:
        return bonds
    step, has_strain = np.asarray(broken_step.values), "broken_strain" in dataset
    strain = dataset["broken_strain"].values if has_strain else np.full(len(step), np.nan)
    spared = bonds.state == STATES.index("cannot break")
    state = _states(step, (step > 0) & np.isnan(strain) & has_strain, spared)
    order = breaking_order(step, strain)
    return replace(bonds, step=step, strain=strain, state=state, order=order)


def _states(steps: Array, cut: Array, spared: Array) -> Array:
    """Return indices of STATES."""
    whole = np.where(spared, STATES.index("cannot break"), STATES.index("intact"))
    broken = np.where(cut, STATES.index("cut"), STATES.index("broken"))
    broken = np.where(steps == 0, STATES.index("broken from the start"), broken)
    return np.where(steps < 0, whole, broken)


MAX_BYTES_AT_ONCE = 2**28
"""A variable with at most this number of bytes is read at once. Larger variables are read step by
step."""
MAX_EXTENT_RATIO = 20.0
"""A run counts as diverged if the ratio of the extent of all positions to the extent of the body at
rest exceeds this number. The view is then not extended to its positions."""


def shown_variables(dataset: xarray.Dataset) -> list[str]:
    """Return the variables that can be shown as colours. They have a number, or a vector, for each
    particle."""
    return [
        str(name)
        for name, variable in dataset.data_vars.items()
        if name not in ("position", "kind", "u")
        and variable.dtype.kind in "biuf"
        and TWIN_OF not in variable.attrs
        and {*variable.dims} - {"time"} in ({"particle"}, {"particle", "axis"})
    ]


def bytes_a_particle(dataset: xarray.Dataset) -> int:
    """Return the number of bytes for one particle and step before packing. They are used for
    displacement, kind and values."""
    values = (2 if "axis" in dataset[n].dims else 1 for n in shown_variables(dataset))
    return 9 + 4 * sum(values)


def read(variable: xarray.DataArray, steps: Rows) -> Iterator[Array]:
    """Generate, for each of the steps, an array of shape (particle, ...) with the values in the
    units of the page."""
    factor = factor_of(variable)
    if "time" not in variable.dims:
        yield in_units(variable.values, factor)
        return
    variable = variable.transpose("time", "particle", ...)
    if variable.nbytes <= MAX_BYTES_AT_ONCE:
        each = iter(variable.values[steps])
    else:
        each = (variable.isel(time=row).values for row in steps.tolist())
    yield from (in_units(values, factor) for values in each)


def in_units(values: Any, factor: float) -> Array:
    """Return the values times a factor, or the same array if the factor is 1."""
    return np.asarray(values) if factor == 1.0 else factor * np.asarray(values)


def resting(
    dataset: xarray.Dataset, reference: Array, thinning: Thinning, spacing: float
) -> dict[str, Any]:
    """Return the content that is constant in time: names of variables, reference positions, and
    triangles.

    `reference` of shape (particle, axis) contains the positions for zero displacement, and
    `spacing` is the distance between neighbours in these positions. Both are in the units of the
    page.
    """
    rows, role = thinning.particles, role_of(dataset)
    labels = {n: dataset[n].values for n in ("number", "i", "j") if n in dataset.variables}
    labels = {"number": np.arange(1, thinning.count + 1)} | labels
    labels = {name: values[rows] for name, values in labels.items() if values.ndim == 1}
    sites = [labels[n] // thinning.stride for n in ("i", "j")] if {"i", "j"} <= {*labels} else []
    return {
        "spacing": spacing * thinning.stride,
        "length": units_of(dataset["position"]),
        "reference": packed(reference[rows], "f8"),
        "labels": {name: packed(values, "i4") for name, values in labels.items()},
        "triangles": packed(_triangles(reference[rows], sites, role[rows] == OF_BODY), "i4"),
    } | _outline(dataset, reference, rows)


def _outline(dataset: xarray.Dataset, reference: Array, rows: Rows) -> dict[str, Any]:
    """Return the signed distance of particles from the outline, negative inside, in lattice units.
    It is returned only if the outline cuts cells; the page needs it in order to end the colours of
    fields at the outline."""
    if "inside" not in dataset.variables or dataset["inside"].ndim != 1:
        return {}
    if dataset["inside"].values.all() or (shape := shape_of(dataset)) is None:
        return {}
    return {"beyond": packed(distance_from(shape, reference[rows] / lattice_unit(dataset)), "f4")}


def moving(dataset: xarray.Dataset, reference: Array, thinning: Thinning) -> dict[str, Any]:
    """Return the content that changes in time: arrays of the particles that are shown, with time as
    the last dimension, and statistics of each variable over all particles."""
    u, summary = _particles_over_time(
        _displacements(dataset, reference, thinning.steps), thinning.particles
    )
    return {
        "times": dataset["time"].values[thinning.steps].tolist(),
        "box": _box(reference, reference[thinning.particles, :, None] + u),
        "u": packed(u, "f4"),
        "summary": summary,
        "kind": packed(_kinds(dataset, thinning), "u1"),
        "variables": [_variable(dataset, name, thinning) for name in shown_variables(dataset)],
    }


def role_of(dataset: xarray.Dataset) -> Array:
    """Return for each particle the role OF_BODY or OF_FRAME, (particle,). If roles were not
    recorded, it is OF_BODY for all particles."""
    if "role" in dataset.variables:
        return np.asarray(dataset["role"].values)
    return np.full(dataset.sizes["particle"], OF_BODY)


def _particles_over_time(each: Iterator[Array], rows: Rows) -> tuple[Array, dict[str, Any]]:
    """Return the values of some rows, (particle, ..., time). Also return, for each time, the mean,
    the maximum and the minimum over all rows. For vectors, these are statistics of the lengths."""
    selection, statistics = [], []
    for values in each:
        selection.append(values[rows])
        sizes = np.linalg.norm(values, axis=1) if values.ndim > 1 else values
        finite = sizes[np.isfinite(sizes)]
        statistics.append(
            [finite.mean(), finite.max(), finite.min()] if len(finite) else [np.nan] * 3
        )
    names = "mean", "largest", "least"
    summary = {n: packed(v, "f8") for n, v in zip(names, np.transpose(statistics), strict=True)}
    return np.stack(selection, axis=-1), summary


def _displacements(dataset: xarray.Dataset, reference: Array, steps: Rows) -> Iterator[Array]:
    if "u" in dataset:
        return read(dataset["u"], steps)
    return (position - reference for position in read(dataset["position"], steps))


def _variable(dataset: xarray.Dataset, name: str, thinning: Thinning) -> dict[str, Any]:
    variable = dataset[name]
    values, summary = _particles_over_time(read(variable, thinning.steps), thinning.particles)
    return {
        "name": name,
        "meaning": meaning_of(variable),
        "units": units_of(variable),
        "vector": "axis" in variable.dims,
        "values": packed(values, "f4"),
        "summary": summary,
    }


def _kinds(dataset: xarray.Dataset, thinning: Thinning) -> Array:
    if "kind" in dataset:
        each = read(dataset["kind"], thinning.steps)
        return np.stack([kinds[thinning.particles] for kinds in each], axis=-1)
    kinds = np.where(role_of(dataset) == OF_BODY, FOLLOWER, FRAME)[thinning.particles]
    return np.repeat(kinds[:, None], len(thinning.steps), axis=1)


def _box(reference: Array, places: Array) -> list[float]:
    """Return the left, bottom, right and top bounds of all positions that are shown. If the
    positions extend far beyond the body at rest, return the bounds of the body at rest."""
    low, high = np.nanmin(places, axis=(0, 2)), np.nanmax(places, axis=(0, 2))
    rest = np.nanmin(reference, axis=0), np.nanmax(reference, axis=0)
    if not (np.ptp([low, high], axis=0) < MAX_EXTENT_RATIO * np.ptp(rest, axis=0).max()).all():
        low, high = rest
    return [*low.tolist(), *high.tolist()]


def spacing_of(reference: Array) -> float:
    """Estimate the distance of neighbours at rest if there are no bonds."""
    sides = np.ptp(reference, axis=0)
    count = len(reference)
    return float(max(math.sqrt(sides.prod() / count), sides.max() / count)) or 1.0


def _triangles(reference: Array, sites: list[Array], body: NDArray[np.bool_]) -> Array:
    """Return the rows of the corners of triangles that fill the body at rest, (triangle, 3). If the
    `sites` of the particles are known, they are used."""
    rows = np.flatnonzero(body & np.isfinite(reference).all(axis=1))
    if not sites:
        return np.asarray(rows[triangles_of(reference[rows])])
    return np.asarray(rows[cell_triangles(np.stack(sites, axis=1)[rows], reference[rows])])


KeyPath = tuple[str | int, ...]
MAX_TRIED = 150
"""Up to this number of keys of an experiment, it is tested which of them can be omitted."""
PARTS = ("lattice", "body", "neighbours", "rule", "frame", "fracture", "solver")
"""Parts of an experiment that the summary describes."""


def facts(dataset: xarray.Dataset) -> list[list[str]]:
    """Return names and values of the summary."""
    attributes, parts = dataset.attrs, json_attribute(dataset, "experiment")
    times = dataset["time"].values
    sizes = {str(name): size for name, size in dataset.sizes.items()}
    outcome = ": ".join(
        filter(None, (str(attributes.get(n, "")) for n in ("status", "stop_reason")))
    )
    kinds = {name: _type(parts.get(name)) for name in PARTS}
    entries = {
        "ended": outcome,
        "created": str(attributes.get("created", "")),
        "by": version_text(dataset),
        **{name: kind for name, kind in kinds.items() if kind not in ("", "none")},
        "particles": f"{sizes.get('particle', 0)}",
        "bonds": f"{sizes['bond']}" if sizes.get("bond") else "",
        "steps": str(parts.get("steps", "")),
        "recorded": f"{len(times)} steps, {times[0]} to {times[-1]}",
    }
    return [[name, value] for name, value in entries.items() if value]


def version_text(dataset: xarray.Dataset) -> str:
    """Return the versions of pbdkit and of plugins."""
    versions = {"pbdkit": dataset.attrs.get("pbdkit_version", "")} | json_attribute(
        dataset, "plugins"
    )
    return ", ".join(f"{name} {version}".strip() for name, version in versions.items())


def _type(part: Any) -> str:
    return str(part.get("type", "")) if isinstance(part, dict) else ""


def experiment_text(parts: dict[str, Any]) -> str:
    """Return the experiment, or the sweep, as YAML. Keys of an experiment that have their default
    values are omitted."""
    can_be_brief = "lattice" in parts and not retired_parts(parts)
    return yaml_text(_brief(parts) if can_be_brief else parts)


def _brief(parts: dict[str, Any]) -> dict[str, Any]:
    """Omit every key without which the same experiment is built."""
    omitted: list[KeyPath] = []
    try:
        whole = Experiment.build(Source("page", parts))
    except PbdkitError:  # A component is not installed.
        return parts
    for path in list(_paths(parts))[:MAX_TRIED]:
        inside = any(path[: len(prefix)] == prefix for prefix in omitted)
        if not inside and _same(whole, _without(parts, [*omitted, path]), parts):
            omitted.append(path)
    return dict(_without(parts, omitted))


def _paths(part: Any, path: KeyPath = ()) -> Iterator[KeyPath]:
    """Generate the paths of all keys except `type`. Outer keys are generated before inner keys."""
    if isinstance(part, dict):
        yield from ((*path, key) for key in part if key not in ("version", "name", "type"))
    inner = part.items() if isinstance(part, dict) else enumerate(part)
    for key, value in inner:
        if isinstance(value, dict | list):
            yield from _paths(value, (*path, key))


def _without(part: Any, omitted: list[KeyPath], path: KeyPath = ()) -> Any:
    if isinstance(part, dict):
        remaining = {k: v for k, v in part.items() if (*path, k) not in omitted}
        return {key: _without(value, omitted, (*path, key)) for key, value in remaining.items()}
    if isinstance(part, list):
        return [_without(value, omitted, (*path, n)) for n, value in enumerate(part)]
    return part


def _same(whole: Experiment, brief: dict[str, Any], parts: dict[str, Any]) -> bool:
    try:
        rebuilt = whole.of_parts(brief)
    except PbdkitError:  # The key is needed.
        return False
    return rebuilt.model_dump(mode="json", by_alias=True) == parts


def title_of(dataset: xarray.Dataset) -> str:
    """Return the title of the page."""
    return str(dataset.attrs.get("title", ""))[:MAX_TEXT] or "a result without a title"


def file_name(title: str) -> str:
    """Return a title as a name for files, without special characters."""
    return re.sub(r"[^A-Za-z0-9_-]+", "-", title).strip("-")[:60] or "experiment"


MAX_PREDICTED_PARTICLES = 20_000
"""Maximum number of particles for which the page contains a prediction of stability. For larger
bodies the prediction would take too long."""
MIN_MOVES = 8
"""Minimum number of moves from which a decay is measured."""
MAX_MOVES = 800
"""Maximum number of moves from which a decay is measured."""
ROUNDING_RTOL = 1e-11
"""Moves with a smaller ratio to the largest move are treated as rounding errors."""


@dataclass(frozen=True)
class MoveHistory:
    """Largest displacement per step of any follower, `move`, in the interval that ends at each of
    the `steps`. `free` is the index of the first of these steps after the last event. Events are a
    leader that moves, begins or ends, and a bond that breaks."""

    steps: Array
    move: Array
    free: int

    @property
    def fitted(self) -> Rows:
        """Return the indices of the moves from which the decay is measured. These are the second
        half of the moves that are after the last event and larger than rounding errors."""
        rows = np.arange(self.free, len(self.move))
        rows = rows[self.move[rows] > ROUNDING_RTOL * self.move.max(initial=0.0)]
        return np.asarray(rows[len(rows) // 2 :])

    @property
    def decay(self) -> float | None:
        """Return the factor by which the moves finally decrease in each step."""
        rows = self.fitted
        if len(rows) < MIN_MOVES:
            return None
        return float(np.exp(np.polyfit(self.steps[rows], np.log(self.move[rows]), 1)[0]))

    def steps_to(self, share: float) -> int | None:
        """Return the number of steps from the last event until the moves are at most a fraction
        `share` of the first move."""
        free = self.move[self.free :]
        below = np.flatnonzero(free <= share * free[:1].max(initial=0.0))
        return int(self.steps[self.free + below[0]] - self.steps[self.free]) if len(below) else None


def moves_of(dataset: xarray.Dataset) -> MoveHistory | None:
    """Return the moves between at most MAX_MOVES equidistant recorded steps. Return None if there
    are too few steps, or if the kinds of particles were not recorded."""
    recorded = dataset.sizes["time"]
    steps = np.arange(0, recorded, -(-recorded // MAX_MOVES))
    times = dataset["time"].values[steps]
    intervals = np.diff(times)
    if len(intervals) and intervals[-1] != intervals[0]:
        steps, times, intervals = steps[:-1], times[:-1], intervals[:-1]
    if len(times) < MIN_MOVES or "kind" not in dataset or (intervals != intervals[0]).any():
        return None
    name = "u" if "u" in dataset else "position"
    move, event = [], 0
    records = zip(read(dataset[name], steps), read(dataset["kind"], steps), strict=True)
    for n, ((previous, previous_kinds), (current, kinds)) in enumerate(pairwise(records), 1):
        lengths, leads = np.linalg.norm(current - previous, axis=1), kinds == LEADER
        move.append(float(lengths[~leads].max(initial=0.0)) / intervals[0])
        leader_move = lengths[leads].max(initial=0.0) > ROUNDING_RTOL * max(move)
        if leader_move or not np.array_equal(kinds, previous_kinds):
            event = n
    if "broken_step" in dataset and dataset["broken_step"].size:
        last = int(dataset["broken_step"].max())
        event = max(event, int(np.searchsorted(times, last)))
    return MoveHistory(times[1:], np.array(move), min(event, len(move) - 1))


def convergence(dataset: xarray.Dataset, scene: Scene | None) -> dict[str, Any]:
    """Return the predicted and the measured values of convergence, notes, and the curve of the
    moves. If there is no curve, return the reason."""
    if scene is None:
        return {
            "notes": [("There is no prediction: the experiment cannot be built on this machine.")]
        }
    if not scene.experiment.solver.makes_steps:
        return _error_bound_table(dataset)
    if scene.raster.count > MAX_PREDICTED_PARTICLES:
        return {
            "notes": [
                (
                    f"There is no prediction for more than {MAX_PREDICTED_PARTICLES} particles on "
                    "this page; `pbdkit check` computes one."
                )
            ]
        }
    analysis, moves = Analysis(tuned(scene)), moves_of(dataset)
    decaying = moves if moves and len(moves.move) - moves.free >= MIN_MOVES else None
    content: dict[str, Any] = {
        "rows": _rows(dataset, analysis, decaying),
        "notes": _notes(analysis),
    }
    if decaying is None:
        reason = (
            "too few steps are recorded, or at unequal distances"
            if moves is None
            else "leaders move or bonds break until the end of the run or shortly before"
        )
        content["notes"].append(f"The rate of convergence is not measured: {reason}.")
    return content | ({"moves": _curve(analysis, moves)} if moves else {})


def _error_bound_table(dataset: xarray.Dataset) -> dict[str, Any]:
    """Return the error bound of an equilibrium."""
    error_bound = json_attribute(dataset, "certificate")
    entries = [[name.replace("_", " "), value] for name, value in error_bound.items()]
    note = "The solver makes no steps: it computes the equilibrium, with a bound on the error."
    return {"certificate": entries, "notes": [note]}


def _rows(
    dataset: xarray.Dataset, analysis: Analysis, moves: MoveHistory | None
) -> list[list[Any]]:
    to = analysis.steps_to["1e-3"]
    measured: Any = moves.steps_to(1e-3) if moves else None
    if moves and measured is None:
        measured = "not within the run"
    decay = moves.decay if moves else None
    rows: list[list[Any]] = [
        ["stable", _yes(analysis.stable), _ended(dataset, moves)],
        [("factor per step: spectral radius; ratio of the last "
         "moves"), analysis.spectral_radius, decay],
        ["steps of decay to 1/1000; of moves, since the last event", to, measured],
        ["smallest eigenvalue of the rule", analysis.smallest_eigenvalue, None],
        ["largest stable relaxation", analysis.largest_stable_relaxation, None],
    ]  # fmt: skip
    return rows


def _yes(stable: bool | None) -> str:
    return "not known" if stable is None else "yes" if stable else "no"


def _ended(dataset: xarray.Dataset, moves: MoveHistory | None) -> str:
    status = str(dataset.attrs.get("status", ""))
    if status not in ("complete", "settled") or moves is None:
        return status
    last = moves.move[-1] / (moves.move.max() or 1.0)
    return f"{status}; the last move is {last:.2g} of the largest"


def _notes(analysis: Analysis) -> list[str]:
    notes = []
    if not analysis.exact:
        notes.append(
            "The prediction is linearised at the start: the rule is not linear, or bonds, "
            "neighbours, contacts or parameters change during the run."
        )
    if analysis.estimated:
        notes.append("The spectrum is estimated: 1 - radius is within 1 %.")
    return [*notes, *analysis.warnings()]


def _curve(analysis: Analysis, moves: MoveHistory) -> dict[str, Any]:
    """Return the logarithm of the moves and a line with the predicted slope. The line passes
    through the move in the middle of those from which the decay is measured."""
    with np.errstate(divide="ignore"):
        logs = np.log10(moves.move)
    logs[~np.isfinite(logs)] = np.nan
    series = [{"name": "observed", "values": packed(logs, "f8")}]
    radius, rows = analysis.spectral_radius, moves.fitted
    if radius and len(rows) >= MIN_MOVES:
        middle = rows[len(rows) // 2]
        line = logs[middle] + (moves.steps - moves.steps[middle]) * np.log10(radius)
        line[: moves.free] = np.nan
        line[(line < np.nanmin(logs) - 1) | (line > np.nanmax(logs) + 0.5)] = np.nan
        series.append({"name": "predicted slope", "values": packed(line, "f8")})
    return {
        "title": "largest move of a follower per step",
        "x": packed(moves.steps, "f8"),
        "x_label": "step",
        "y_label": "log10 of the move",
        "series": series,
    }


@dataclass(frozen=True)
class Origin:
    """The scene of the experiment of a dataset. If it cannot be built, the scene is None, and the
    reason is given."""

    scene: Scene | None
    fault: str = ""


def origin_of(dataset: xarray.Dataset) -> Origin:
    """Build the scene of a dataset if possible. A page can also be made without the scene."""
    try:
        return Origin(scene_of(dataset, "the lattice of a page"))
    except PbdkitError as error:
        return Origin(None, str(error))


class RunContent:
    """Content of the page of a run, for `report.js`. Raises ExperimentError for a dataset without
    positions."""

    def __init__(self, dataset: xarray.Dataset) -> None:
        _refuse_no_motion(dataset)
        origin = origin_of(dataset)
        parts = json_attribute(dataset, "experiment")
        title = title_of(dataset)
        self._dataset = dataset
        self._reference = reference_of(dataset, origin.scene)
        self._bonds, self._notes = _bonds(dataset, origin)
        self._whole = {
            "what": "run",
            "title": title,
            "file": file_name(title),
            "facts": facts(dataset),
            "experiment": experiment_text(parts) if parts else "",
            "convergence": convergence(dataset, origin.scene),
            "ledger": self._bonds.ledger() if self._bonds and self._bonds.can_break else None,
        }

    def within(self, budget: int) -> dict[str, Any]:
        """Return the content. The data of the moving lattice have about `budget` bytes before
        packing."""
        dataset, reference, bonds = self._dataset, self._reference, self._bonds
        thinning = thinned(dataset, leaders_of(dataset), bytes_a_particle(dataset), budget)
        spacing = bonds.spacing if bonds else spacing_of(reference)
        run = {
            "lattice": resting(dataset, reference, thinning, spacing)
            | moving(dataset, reference, thinning),
            "bonds": bonds.shown(thinning.particles) if bonds else None,
            "curves": curves(dataset),
        }
        left_out = [*thinning.left_out(), *fewer_points(dataset), *self._notes]
        return self._whole | {"run": run, "left_out": left_out, "thinned": thinning.is_thinner}


def _refuse_no_motion(dataset: xarray.Dataset) -> None:
    """Raise ExperimentError if the dataset has no positions, has positions of several runs, or is
    not in the plane."""
    if "position" not in dataset:
        raise ExperimentError("has no positions; keep `position`, which a page requires")
    position = dataset["position"]
    if {*position.dims} != {"time", "particle", "axis"} or position.sizes["axis"] != 2:
        raise ExperimentError(
            f"position has the dimensions {dict(position.sizes)}; a page requires time, particle "
            "and two axes; select one of several runs with isel"
        )
    if not position.size:
        raise ExperimentError("has no step or no particle; a page requires at least one of each")


def _bonds(dataset: xarray.Dataset, origin: Origin) -> tuple[BondArrays | None, list[str]]:
    """Return the bonds as far as they are known, and notes about data that are not known."""
    notes = []
    if origin.fault:
        notes.append(f"The experiment cannot be built on this machine: {origin.fault}")
    count = dataset.sizes["particle"]
    if "number" in dataset and not np.array_equal(dataset["number"], np.arange(1, count + 1)):
        return None, [
            *notes,
            ("Bonds are not shown: the dataset does not contain all particles of the run."),
        ]
    try:
        return bonds_of(dataset, origin.scene), notes
    except PbdkitError as error:
        return bonds_of(dataset, None), [*notes, f"Limits of bonds are unknown: the file {error}"]


def leaders_of(dataset: xarray.Dataset) -> NDArray[np.bool_]:
    """Return a mask of the particles that are leaders at the first or at the last recorded step,
    (particle,)."""
    if "kind" not in dataset or "time" not in dataset["kind"].dims:
        return np.zeros(dataset.sizes["particle"], np.bool_)
    ends = dataset["kind"].isel(time=[0, -1]).values
    return np.asarray((ends == LEADER).any(axis=0))


def reference_of(dataset: xarray.Dataset, scene: Scene | None) -> NDArray[np.float64]:
    """Return an array of shape (particle, axis) with the positions of zero displacement, in the
    units of the page. These are the reference positions or, if they were not recorded, the
    positions at the first recorded step."""
    if "reference" in dataset.variables and dataset["reference"].ndim == 2:
        return in_units(dataset["reference"].values, factor_of(dataset["reference"]))
    if scene is not None and scene.raster.count == dataset.sizes["particle"]:
        return in_units(scene.raster.reference(), lattice_unit(dataset))
    first = dataset["position"].isel(time=0, missing_dims="ignore")
    return in_units(first.transpose("particle", "axis").values, factor_of(first))


def _finite_values(variable: xarray.DataArray) -> Array:
    """Return the values of members, with NaN in place of fill values."""
    values = np.asarray(variable.values, float)
    finite = np.where(values == variable.attrs.get(FILL, np.nan), np.nan, values)
    return factor_of(variable) * finite


def numbers(dataset: xarray.Dataset, grid: list[str]) -> Iterator[dict[str, Any]]:
    """Generate statistics of members: the last and the largest value of every variable that all
    members have in common. For variables of particles they are computed from the mean and the
    maximum over the particles."""
    for name, variable in dataset.data_vars.items():
        if name in (STATUS, MESSAGE, "kind", "position") or not {*grid} <= {*variable.dims}:
            continue
        if variable.dtype.kind not in "biuf" or not variable.size:
            continue
        rest = [str(d) for d in variable.dims if d not in grid]
        values = _finite_values(variable.transpose(*grid, *rest))
        values = values.reshape(-1, *values.shape[len(grid) :])
        words = f"{meaning_of(variable)}{f' ({u})' if (u := units_of(variable)) else ''}"
        if name == "broken_step":
            summary = np.where(np.isnan(values).all(axis=1), np.nan, (values >= 0).sum(axis=1))
            yield {"name": "broken bonds", "values": packed(summary, "f8")}
            continue
        for statistic, summary in _statistics(values, rest):
            yield {
                "name": f"{words}: {statistic}" if statistic else words,
                "values": packed(summary, "f8"),
            }


def _statistics(values: Array, rest: list[str]) -> Iterator[tuple[str, Array]]:
    """Generate statistics of values of shape (member, *rest). A statistic is one number for each
    member, with a description."""
    if "axis" in rest:
        values = np.linalg.norm(values, axis=1 + rest.index("axis"))
        rest = [dim for dim in rest if dim != "axis"]
    over = next((dim for dim in ("time", "step") if dim in rest), None)
    if not rest:
        yield "", values
        return
    if over is None:
        over, rest, values = "time", ["time", *rest], values[:, None]
    values = np.moveaxis(values, 1 + rest.index(over), 1)
    values = values.reshape(*values.shape[:2], -1)
    is_multiple = values.shape[2] > 1
    with np.errstate(all="ignore"):
        largest = _reduced(np.fmax, values)
        mean = np.nansum(values, axis=2) / np.isfinite(values).sum(axis=2)
    yield ("largest at the end" if is_multiple else "at the end"), _last(largest)
    if is_multiple:
        yield "mean at the end", _last(mean)
    if values.shape[1] > 1:
        yield "largest of all steps", _reduced(np.fmax, largest)


def _reduced(how: np.ufunc, values: Array) -> Array:
    return np.asarray(how.reduce(values, axis=values.ndim - 1))


def _last(values: Array) -> Array:
    """Return the last finite number of each row, and NaN if a row has no finite number."""
    finite = np.isfinite(values)
    last = values.shape[1] - 1 - np.argmax(finite[:, ::-1], axis=1)
    return np.asarray(values[np.arange(len(values)), last])


MIN_STEPS_OF_MEMBER = 6
"""Minimum number of steps of each member that are shown, if at least that number is recorded."""
MIN_POINTS = 50
"""Minimum number of points in the curves of each member, if at least that number is recorded."""
MAX_CURVE_POINTS = 100_000
"""Maximum number of points in the curves of all members together."""


class SweepContent:
    """Content of the page of a sweep, for `report.js`."""

    def __init__(self, dataset: xarray.Dataset) -> None:
        grid = [str(dim) for dim in dataset[STATUS].dims]
        specification = json_attribute(dataset, "sweep")
        title = title_of(dataset)
        places = product(*(range(dataset.sizes[dim]) for dim in grid))
        self._members = [dataset.isel(dict(zip(grid, place, strict=True))) for place in places]
        self._scene = _scene(specification)
        self._whole = {
            "what": "sweep",
            "title": title,
            "file": file_name(title),
            "facts": _facts(dataset),
            "experiment": experiment_text(specification),
            "grid": [
                {"name": dim, "labels": _labels(dataset, dim), "unit": unit_of(dataset, dim)}
                for dim in grid
            ],
            "status": dataset[STATUS].values.ravel().tolist(),
            "message": dataset[MESSAGE].values.ravel().tolist(),
            "scalars": list(numbers(dataset, grid)),
        }

    def within(self, budget: int) -> dict[str, Any]:
        """Return the content. The data of the moving lattices of all members together have about
        `budget` bytes before packing."""
        each = self._members
        points = max(MIN_POINTS, MAX_CURVE_POINTS // len(each))
        successful = [str(member[STATUS].item()) in STORED_STATUSES for member in each]
        if "position" not in each[0] or not any(successful):
            reason = "no member has a result"
            if any(successful):
                reason = "`position` was not kept; add it to `keep.variables`"
            note = f"No lattices are shown: {reason}."
            plain = [{"curves": curves(member, points)} for member in each]
            return self._whole | {
                "shared": {}, "members": plain, "left_out": [note], "thinned": False,
            }  # fmt: skip
        first = each[successful.index(True)]
        size = bytes_a_particle(first) * len(each)
        thinning = thinned(first, leaders_of(first), size, budget, MIN_STEPS_OF_MEMBER)
        bodies = [
            _Body.of(member, self._scene) if g else None
            for member, g in zip(each, successful, strict=True)
        ]
        first_body = next(filter(None, bodies))
        same = all(body is None or first_body.is_like(body) for body in bodies)
        members = [
            body and body.moving(member, thinning, points, whole=not same)
            for body, member in zip(bodies, each, strict=True)
        ]
        return self._whole | {
            "shared": first_body.resting(first, thinning) if same else {},
            "members": members,
            "left_out": thinning.left_out(),
            "thinned": thinning.is_thinner,
        }


@dataclass(frozen=True)
class _Body:
    """The reference positions of one member, in an array of shape (particle, axis), and its
    bonds."""

    reference: Array
    bonds: BondArrays | None

    @classmethod
    def of(cls, member: xarray.Dataset, scene: Scene | None) -> _Body:
        reference = reference_of(member, scene)
        try:
            bonds = bonds_of(member, None) or bonds_of(member, scene)
        except PbdkitError:
            bonds = None
        return cls(reference, broken_as(bonds, member) if bonds else None)

    def is_like(self, other: _Body) -> bool:
        """Return whether the bodies of two members are the same at rest."""
        if self.bonds and other.bonds:
            same_bonds = np.array_equal(self.bonds.ends, other.bonds.ends)
        else:
            same_bonds = self.bonds is other.bonds
        return same_bonds and np.array_equal(self.reference, other.reference, equal_nan=True)

    def resting(self, member: xarray.Dataset, thinning: Thinning) -> dict[str, Any]:
        """Return the content of the member that is constant in time."""
        finite = self.reference[np.isfinite(self.reference).all(axis=1)]
        spacing = self.bonds.spacing if self.bonds else spacing_of(finite)
        return {
            "lattice": resting(member, self.reference, thinning, spacing),
            "bonds": self.bonds.shown(thinning.particles) if self.bonds else None,
        }

    def moving(
        self, member: xarray.Dataset, thinning: Thinning, points: int, *, whole: bool
    ) -> dict[str, Any]:
        """Return the content of the member that changes in time. With `whole` also return the
        content that is constant."""
        fixed = self.resting(member, thinning) if whole else {"lattice": {}}
        broken = self.bonds.broken(thinning.particles) if self.bonds else None
        last = member["position"].isel(time=thinning.steps)
        recorded = (
            last.notnull().any(["particle", "axis"]).values
        )  # Other members may have made more steps.
        moved = moving(member, self.reference, replace(thinning, steps=thinning.steps[recorded]))
        return {"bonds": broken} | fixed | {
            "lattice": fixed["lattice"] | moved,
            "curves": curves(member, points),
        }  # fmt: skip


def _facts(dataset: xarray.Dataset) -> list[list[str]]:
    status = dataset[STATUS].values.ravel()
    names, counts = np.unique(status, return_counts=True)
    outcome = ", ".join(f"{n} {name}" for name, n in zip(names, counts, strict=True))
    sizes = " × ".join(f"{size} {name}" for name, size in dataset[STATUS].sizes.items())
    created = str(dataset.attrs.get("created", ""))
    members = f"{status.size}: {sizes}"
    return [
        ["members", members],
        ["ended", outcome],
        ["created", created],
        ["by", version_text(dataset)],
    ]


def _labels(dataset: xarray.Dataset, dim: str) -> list[str]:
    """Return the labels along a dimension of the grid. The label of a case contains the values of
    its parameters."""
    coordinates = [str(n) for n, c in dataset.coords.items() if c.dims == (dim,) and n != dim]
    if dim == CASE and coordinates:
        rows = zip(*(dataset[n].values.tolist() for n in coordinates), strict=True)
        return [
            ", ".join(f"{n} {_label(v)}" for n, v in zip(coordinates, r, strict=True)) for r in rows
        ]
    name = dim + TEXT if dim + TEXT in dataset.variables else dim
    if name not in dataset.variables:
        return [str(n) for n in range(dataset.sizes[dim])]
    values = dataset[name].values
    if values.dtype.kind == "f":  # Values that are only rounding errors are set to 0.
        values = np.where(np.abs(values) < 1e-12 * np.abs(values).max(), 0.0, values)
    return [_label(value) for value in values.tolist()]


def _label(value: Any) -> str:
    """Return a short text of a value."""
    return f"{value:.6g}" if isinstance(value, float) else type_alone(str(value))


def _scene(specification: dict[str, Any]) -> Scene | None:
    """Return the scene of the experiment that the sweep varies. Return None if members have
    different bodies."""
    experiment = specification.get("experiment", {})
    varied = {
        path.split(".")[0] for key in ("vary", "together") for path in specification.get(key, {})
    }
    if varied & {"lattice", "body", "neighbours", "frame"}:
        return None
    carrier = xarray.Dataset(attrs={"experiment": json.dumps(experiment)})
    try:
        return scene_of(carrier, "the lattice of a page")
    except PbdkitError:
        return None


def speed(path: Path) -> dict[str, Any]:
    """Return the table of a benchmark: headings with their meanings, and a row for each method.
    Raises StorageError if the file cannot be read, and ExperimentError if it contains something
    else."""
    try:
        content = json.loads(path.read_text("utf-8"))
        rows: list[dict[str, Any]] = [dict(row) for row in content["rows"]]
        machine, experiment = (
            dict(content["machine"]),
            f"{content['experiment']}, {content['steps']} steps",
        )
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror}") from None
    except (ValueError, TypeError, KeyError, RecursionError):
        raise ExperimentError(
            f"{path}: contains no measurement; `pbdkit bench EXPERIMENT --json {path}` writes one"
        ) from None
    names = [name for name in COLUMNS if any(row.get(name) is not None for row in rows)]
    return {
        "of": experiment,
        "on": ", ".join(f"{name} {value}" for name, value in machine.items()),
        "columns": [[COLUMNS[name][0], COLUMNS[name][2]] for name in names],
        "rows": [[_cell(row, name) for name in names] for row in rows],
        "left_out": [f"{row.get('method')}: {row['reason']}" for row in rows if row.get("reason")],
    }


def _cell(row: dict[str, Any], name: str) -> str:
    value = row.get(name)
    if not isinstance(value, int | float):
        return str(value or "")
    return format(value, COLUMNS[name][1])


BUDGET = 4_900_000
"""Maximum size of a page in bytes."""
FIRST = 20_000_000
"""Number of bytes of the lattice's data before compression in the first attempt. The compression
ratio depends on the motion and is not known before."""
MAX_PAGE_BYTES = 80_000_000
"""Maximum number of bytes of the lattice's data, before compression, with which a browser draws
smoothly."""
MAX_ATTEMPTS = 4
"""Maximum number of attempts."""
REBUILD_FRACTION = 0.6
"""If steps or particles were omitted and the page is smaller than this fraction of the maximum
size, the page is built again with more of them."""


def report(
    dataset: xarray.Dataset | str | Path,
    path: str | Path,
    *,
    bench: str | Path | None = None,
    replace: bool = True,
) -> Path:
    """Write a run or a sweep as one self-contained HTML page.

    The page contains the moving lattice, histories of particles and bonds, curves, predictions,
    broken bonds and the experiment. It has at most 5 MB. If necessary, steps or particles are
    omitted, and the page states which.

    Parameters
    ----------
    dataset : xarray.Dataset, str or path
        Dataset or result file.
    path : str or path
        Page to write. An incomplete page never appears.
    bench : str or path, optional
        File written by ``pbdkit bench --json``; the page shows its figures.
    replace : bool
        Replace an existing page.

    Returns
    -------
    Path
        Path of the page.

    Raises
    ------
    ExperimentError
        If the dataset has no positions.
    StorageError
        If a file cannot be read or written.

    Examples
    --------
    >>> ds = pbdkit.run("paper/a", settings={"steps": 20}, progress=False)
    >>> pbdkit.report(ds, "a.html").name
    'a.html'
    """
    measured = speed(Path(bench)) if bench is not None else None
    with _reading(dataset) as read:
        text = report_text(read, measured)
    write(Path(path), text, replace=replace)
    return Path(path)


def report_text(dataset: xarray.Dataset, measured: dict[str, Any] | None = None) -> str:
    """Return the page as text. `measured` is a table of a benchmark, as returned by `speed`."""
    dataset = with_principal_values(dataset)
    content = (SweepContent if SWEEP in dataset.attrs else RunContent)(dataset)
    budget, best = FIRST, ""
    for _ in range(MAX_ATTEMPTS):
        data = content.within(budget)
        text = page(data | {"speed": measured})
        fits = len(text) <= BUDGET
        if not best or (fits and len(text) > len(best)) or len(best) > BUDGET:
            best = text
        enough = (
            not data["thinned"] or len(text) > REBUILD_FRACTION * BUDGET or budget == MAX_PAGE_BYTES
        )
        if fits and enough:
            break
        budget = min(int(0.9 * budget * BUDGET / len(text)), MAX_PAGE_BYTES)
    return best


def _reading(dataset: xarray.Dataset | str | Path) -> AbstractContextManager[xarray.Dataset]:
    if isinstance(dataset, str | Path):
        return reading(dataset, sweeps=True)
    return nullcontext(in_this_layout(dataset))
