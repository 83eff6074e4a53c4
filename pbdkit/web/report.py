"""What variables are called in pages, and in which units they are.

What changes in time and belongs to no particle, as curves.

What of a dataset a page holds: which recorded steps and which particles, within a budget.

The bonds of a run as a page holds them, with what is known of how they broke.

The moving lattice of a run as a page holds it: displacements, kinds, values, triangles.

What was run, and how it is run again.

How a run came to rest after its last event, beside what was known before its first step.

All that the page of one run holds.

Numbers that stand for whole members of a sweep: what its map can show.

All that the page of a sweep holds: a map over its parameters, and the members below.

What `pbdkit bench --json` measured, as a table in a page.

A dataset as one page of HTML that needs no network: ``pbdkit.report`` and `pbdkit report`.
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
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Array
from pbdkit.bench.work_precision import COLUMNS
from pbdkit.errors import ExperimentError, PbdkitError, StorageError
from pbdkit.io.atomic_file import write
from pbdkit.io.explain import BondStatus, BondTable
from pbdkit.io.layout import OF_BODY, in_this_layout, json_attribute, scene_of
from pbdkit.io.members import STATUS, SWEEP, TEXT, type_alone
from pbdkit.io.open import reading
from pbdkit.io.physical import TWIN_OF
from pbdkit.lattice.raster import FOLLOWER, FRAME, LEADER
from pbdkit.model.experiment import Experiment
from pbdkit.model.reading import Source, yaml_text
from pbdkit.plotting.data import cells_of, distance_from, lattice_unit, shape_of, triangles_of
from pbdkit.plotting.style import LONGEST, in_its_units, signed
from pbdkit.plugin.discovery import retired_parts
from pbdkit.plugin.fracture_model import breaking_order
from pbdkit.scene.scene import Scene
from pbdkit.stability.analysis import Analysis
from pbdkit.stability.relaxation import tuned
from pbdkit.stepping.state import describe_bonds
from pbdkit.sweeps.combine import FILL
from pbdkit.sweeps.specification import CASE, MESSAGE
from pbdkit.sweeps.worker import KEPT
from pbdkit.web.page import packed, page

if TYPE_CHECKING:
    import xarray


def meaning_of(variable: xarray.DataArray) -> str:
    """Its long name, or else its name."""
    return str(variable.attrs.get("long_name") or variable.name)


def units_of(variable: xarray.DataArray) -> str:
    """Its units in a page, mm and so on where it says its scale; nothing of plain numbers."""
    return signed(in_its_units(variable.attrs)[1])


def factor_of(variable: xarray.DataArray) -> float:
    """By what its values are multiplied to be in these."""
    return in_its_units(variable.attrs)[0]


MOST_POINTS, MOST_SERIES = 1200, 12
AGAINST = {"nominal_stress": "nominal_strain", "load_resultant": "load_displacement"}
"""What is drawn over something else than time as well."""


@dataclass(frozen=True)
class Curve:
    """Lines over one axis: `x`, the `steps` of its points and the values of each series are
    packed."""

    title: str
    steps: dict[str, Any]
    x: dict[str, Any]
    x_label: str
    y_label: str
    series: list[dict[str, Any]]


def curves(dataset: xarray.Dataset, points: int = MOST_POINTS) -> list[dict[str, Any]]:
    """Of every variable over time, or over every step, and a few small dimensions; and of the
    pairs AGAINST; with so many points at most."""
    names = _names(dataset)
    found = [_over_time(dataset, name, points) for name in names]
    found += [_against(dataset, y, x, points) for y, x in AGAINST.items() if {x, y} <= {*names}]
    return [asdict(curve) for curve in found]


def fewer_points(dataset: xarray.Dataset) -> list[str]:
    """A sentence where curves show fewer points than were recorded."""
    longest = max((dataset.sizes.get(dim, 0) for dim in ("time", "step")), default=0)
    every = _every(longest, MOST_POINTS)
    return [] if every == 1 else [f"Curves show one point in {every} of up to {longest}."]


def _names(dataset: xarray.Dataset) -> list[str]:
    return [
        str(name)
        for name, variable in dataset.data_vars.items()
        if len({"time", "step"} & {*variable.dims}) == 1
        and not {"particle", "bond"} & {*variable.dims}
        and variable.dtype.kind in "biuf"
        and TWIN_OF not in variable.attrs
        and math.prod(n for d, n in variable.sizes.items() if d not in ("time", "step"))
        <= MOST_SERIES
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
    """The values of each place along the other dimensions, with what it is called."""
    variable = dataset[name].transpose(..., along)
    others = [str(dim) for dim in variable.dims[:-1]]
    values = factor_of(variable) * np.asarray(variable.values, float)
    for place in product(*(range(variable.sizes[dim]) for dim in others)):
        words = [_word(dataset, dim, n) for dim, n in zip(others, place, strict=True)]
        yield ", ".join(words), values[place]


def _word(dataset: xarray.Dataset, dim: str, n: int) -> str:
    label = dataset[dim].values[n] if dim in dataset.variables else n
    return str(label) if dim == "axis" else f"{dim.replace('_', ' ')} {label}"


def _against(dataset: xarray.Dataset, y: str, x: str, points: int) -> Curve:
    """One over the other: of several pairs the one that goes farthest, as a chart has one axis."""
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
FEWEST_STEPS = 60
"""Of a run, as far as they are recorded."""
MOST_PARTICLES = 50_000
"""A browser moves so many well, with their bonds."""
FEW_LEADERS = 200
"""So many stay whatever else is left out: the motion is theirs."""


@dataclass(frozen=True)
class Thinning:
    """The rows of the steps and of the particles that are shown; every `stride`-th particle along
    each axis of the lattice, and all leaders if they are `led`; of `recorded` steps and `count`
    particles."""

    steps: Rows
    particles: Rows
    stride: int
    led: bool
    recorded: int
    count: int

    @property
    def is_thinner(self) -> bool:
        """Whether a larger budget would show more."""
        return len(self.steps) < self.recorded or len(self.particles) < self.count

    def left_out(self) -> list[str]:
        """What is not shown, a sentence each."""
        said = []
        if len(self.steps) < self.recorded:
            every = int(self.steps[1] - self.steps[0]) if len(self.steps) > 1 else self.recorded
            said.append(
                f"{len(self.steps)} of the {self.recorded} recorded steps are shown: one in "
                f"{every}, and the last one."
            )
        if len(self.particles) < self.count:
            said.append(
                f"{len(self.particles)} of the {self.count} particles are shown: one in "
                f"{self.stride} along i and along j{', and all that lead' if self.led else ''}. "
                "BondArrays are shown where both of their particles are."
            )
        return said


def thinned(
    dataset: xarray.Dataset,
    leaders: NDArray[np.bool_],
    size: int,
    budget: int,
    fewest: int = FEWEST_STEPS,
) -> Thinning:
    """As many steps and particles as fit into `budget` bytes, where each particle takes `size`
    bytes a step; steps are left out down to the `fewest`, then particles. `leaders` (particle,) are
    kept where they are few."""
    recorded, count = dataset.sizes.get("time", 1), dataset.sizes["particle"]
    fitting = max(1, budget // (size * count))
    every = math.ceil(recorded / max(fitting, min(recorded, fewest)))
    steps = np.unique(np.append(np.arange(0, recorded, every), recorded - 1))
    stride = 1
    kept = np.ones(count, np.bool_)
    most = min(budget // (size * len(steps)), MOST_PARTICLES)
    while kept.sum() > most and stride < 1000:
        stride += 1
        kept = _on_sublattice(dataset, stride)
    led = bool(0 < leaders.sum() <= FEW_LEADERS)
    rows = np.flatnonzero(kept | leaders if led else kept)
    return Thinning(steps, rows, stride, led, recorded, count)


def _on_sublattice(dataset: xarray.Dataset, stride: int) -> NDArray[np.bool_]:
    """Which particles lie on every so-many-th line of the lattice, along i and along j."""
    indices: list[NDArray[Any]] = [dataset[n].values for n in ("i", "j") if n in dataset.variables]
    if len(indices) < 2 or any(index.ndim != 1 for index in indices):
        return np.asarray(np.arange(dataset.sizes["particle"]) % stride**2 == 0)
    return np.asarray((indices[0] % stride == 0) & (indices[1] % stride == 0))


LISTED = 300
"""So many broken bonds stand in the ledger of a page."""
STATES = ("intact", "broken", "cut", "broken from the start", "cannot break")


@dataclass(frozen=True)
class BondArrays:
    """Arrays along the bonds: `ends` the numbers of their particles, `rest` the rest offset, `step`
    of breaking or -1, `strain` at breaking and `limit`, NaN where not known, `state` of STATES; and
    what a model remembers of each at the end. `order` has the rows of the broken ones; `nearest` is
    the one that is nearest to breaking."""

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
        """The shortest rest length."""
        return float(np.linalg.norm(self.rest, axis=1).min())

    @property
    def can_break(self) -> bool:
        """Whether any has broken, or could have."""
        return self.model not in ("none", "not known") or len(self.order) > 0

    def shown(self, particles: Rows) -> dict[str, Any]:
        """Those between the particles shown, as rows of these."""
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
        """Of these, how they broke."""
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
        shown = np.isin(self.ends - 1, particles, kind="table").all(axis=1)
        return np.flatnonzero(shown)

    def ledger(self) -> dict[str, Any]:
        """The bonds that broke, in their order; long ones are cut."""
        listed = self.order[:LISTED]
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
    """All that the dataset has; of one that has no table of bonds those of its scene, unless
    neighbours are found anew. None where neither knows any. Lengths are in the units of the page.

    Raises ExperimentError where dataset and scene do not go together.
    """
    found = _in_lattice_units(dataset, scene)
    return found and replace(found, rest=lattice_unit(dataset) * found.rest)


def _in_lattice_units(dataset: xarray.Dataset, scene: Scene | None) -> BondArrays | None:
    if dataset.sizes.get("bond") == 0:  # of a body whose particles have no neighbours
        return None
    if scene is not None and "bond_ends" in dataset.variables:
        return _explained(BondTable(dataset, scene), dataset)
    if "bond_ends" in dataset.variables and dataset["bond_ends"].ndim == 2:
        return _told(dataset)
    if scene is None or scene.experiment.neighbours.nearness():
        return None
    found = describe_bonds(scene)
    if not len(found):
        return None
    if scene.raster.count != dataset.sizes["particle"]:
        raise ExperimentError("its particles are not those of the experiment that it carries")
    return _whole(found.ends, found.rest, found.shell)


def _whole(ends: Array, rest: Array, shell: Array) -> BondArrays:
    """Bonds of which nobody knows whether they break."""
    count = len(ends)
    unknown, never = np.full(count, np.nan), np.full(count, -1)
    state, order = np.zeros(count, np.int64), np.empty(0, np.intp)
    return BondArrays(ends, rest, shell, never, unknown, unknown, state, order)


def _explained(known: BondTable, dataset: xarray.Dataset) -> BondArrays:
    bonds = known.bonds
    names = known.remembered(0) if len(bonds) else ()
    last = {n: dataset[n].isel(time=-1, missing_dims="ignore").values for n in names}
    return BondArrays(
        bonds.ends, bonds.rest, bonds.shell, known.steps, known.strains_at_break,
        np.where(known.spared, np.nan, known.limits), _states(known.steps, known.cut, known.spared),
        known.order, known.model.type, last, known.nearest(),
    )  # fmt: skip


def _told(dataset: xarray.Dataset) -> BondArrays | None:
    """By the dataset alone."""
    there = (dataset["bond_ends"].values > 0).all(axis=1)
    if not there.all():  # of a sweep, in which other members have more
        dataset = dataset.isel(bond=there)
    ends = dataset["bond_ends"].values
    if not len(ends) or "reference" not in dataset.variables:
        return None
    reference = factor_of(dataset["reference"]) * dataset["reference"].values
    reference /= lattice_unit(dataset)
    shell = dataset["shell"].values if "shell" in dataset.variables else np.ones(len(ends))
    whole = _whole(ends, reference[ends[:, 1] - 1] - reference[ends[:, 0] - 1], shell)
    return replace(broken_as(whole, dataset), model="not known")


def broken_as(bonds: BondArrays, dataset: xarray.Dataset) -> BondArrays:
    """The same bonds, broken as in a dataset that knows them all."""
    known = dataset.variables.get("broken_step")
    if known is None or known.shape != bonds.step.shape:
        return bonds
    step, beside = np.asarray(known.values), "broken_strain" in dataset
    strain = dataset["broken_strain"].values if beside else np.full(len(step), np.nan)
    spared = bonds.state == STATES.index("cannot break")
    state = _states(step, (step > 0) & np.isnan(strain) & beside, spared)
    order = breaking_order(step, strain)
    return replace(bonds, step=step, strain=strain, state=state, order=order)


def _states(steps: Array, cut: Array, spared: Array) -> Array:
    """Of STATES."""
    whole = np.where(spared, STATES.index("cannot break"), STATES.index("intact"))
    gone = np.where(cut, STATES.index("cut"), STATES.index("broken"))
    gone = np.where(steps == 0, STATES.index("broken from the start"), gone)
    return np.where(steps < 0, whole, gone)


AT_ONCE = 2**28
"""So many bytes of a variable are read at once; of larger ones a step at a time."""
FAR = 20.0
"""A body that leaves a box so many times its own is no longer followed: it has diverged."""


def shown_variables(dataset: xarray.Dataset) -> list[str]:
    """The names of what colours can show: a number, or a vector, of each particle."""
    return [
        str(name)
        for name, variable in dataset.data_vars.items()
        if name not in ("position", "kind", "u")
        and variable.dtype.kind in "biuf"
        and TWIN_OF not in variable.attrs
        and {*variable.dims} - {"time"} in ({"particle"}, {"particle", "axis"})
    ]


def bytes_a_particle(dataset: xarray.Dataset) -> int:
    """What each particle takes a step, before it is packed: displacement, kind and values."""
    values = (2 if "axis" in dataset[n].dims else 1 for n in shown_variables(dataset))
    return 9 + 4 * sum(values)


def read(variable: xarray.DataArray, steps: Rows) -> Iterator[Array]:
    """The values at each of the steps, (particle, ...), in the units of the page."""
    factor = factor_of(variable)
    if "time" not in variable.dims:
        yield in_units(variable.values, factor)
        return
    variable = variable.transpose("time", "particle", ...)
    if variable.nbytes <= AT_ONCE:
        each = iter(variable.values[steps])
    else:
        each = (variable.isel(time=row).values for row in steps.tolist())
    yield from (in_units(values, factor) for values in each)


def in_units(values: Any, factor: float) -> Array:
    """Return the values times a factor; as they are where that is 1."""
    return np.asarray(values) if factor == 1.0 else factor * np.asarray(values)


def resting(
    dataset: xarray.Dataset, reference: Array, shown: Thinning, spacing: float
) -> dict[str, Any]:
    """What does not move: names, reference, triangles.

    `reference` (particle, axis) is where displacements are counted from, `spacing` the distance of
    neighbours there, both in the units of the page.
    """
    rows, role = shown.particles, role_of(dataset)
    labels = {n: dataset[n].values for n in ("number", "i", "j") if n in dataset.variables}
    labels = {"number": np.arange(1, shown.count + 1)} | labels
    labels = {name: values[rows] for name, values in labels.items() if values.ndim == 1}
    sites = [labels[n] // shown.stride for n in ("i", "j")] if {"i", "j"} <= {*labels} else []
    return {
        "spacing": spacing * shown.stride,
        "length": units_of(dataset["position"]),
        "reference": packed(reference[rows], "f8"),
        "labels": {name: packed(values, "i4") for name, values in labels.items()},
        "triangles": packed(_triangles(reference[rows], sites, role[rows] == OF_BODY), "i4"),
    } | _outline(dataset, reference, rows)


def _outline(dataset: xarray.Dataset, reference: Array, rows: Rows) -> dict[str, Any]:
    """How far particles lie beyond the outline of the body, negative inside, where it cuts cells:
    there fields end. In lattice units."""
    if "inside" not in dataset.variables or dataset["inside"].ndim != 1:
        return {}
    if dataset["inside"].values.all() or (shape := shape_of(dataset)) is None:
        return {}
    return {"beyond": packed(distance_from(shape, reference[rows] / lattice_unit(dataset)), "f4")}


def moving(dataset: xarray.Dataset, reference: Array, shown: Thinning) -> dict[str, Any]:
    """What moves: arrays of the particles shown, with time as their last dimension; and of each
    variable what all particles come to."""
    u, summary = _particles_over_time(
        _displacements(dataset, reference, shown.steps), shown.particles
    )
    return {
        "times": dataset["time"].values[shown.steps].tolist(),
        "box": _box(reference, reference[shown.particles, :, None] + u),
        "u": packed(u, "f4"),
        "summary": summary,
        "kind": packed(_kinds(dataset, shown), "u1"),
        "variables": [_variable(dataset, name, shown) for name in shown_variables(dataset)],
    }


def role_of(dataset: xarray.Dataset) -> Array:
    """Body or frame, (particle,); all body where nobody says."""
    if "role" in dataset.variables:
        return np.asarray(dataset["role"].values)
    return np.full(dataset.sizes["particle"], OF_BODY)


def _particles_over_time(each: Iterator[Array], rows: Rows) -> tuple[Array, dict[str, Any]]:
    """The values of some rows, (particle, ..., time), and over time the mean, the largest and the
    least of all; of vectors, of their lengths."""
    shown, whole = [], []
    for values in each:
        shown.append(values[rows])
        sizes = np.linalg.norm(values, axis=1) if values.ndim > 1 else values
        known = sizes[np.isfinite(sizes)]
        whole.append([known.mean(), known.max(), known.min()] if len(known) else [np.nan] * 3)
    names = "mean", "largest", "least"
    summary = {n: packed(v, "f8") for n, v in zip(names, np.transpose(whole), strict=True)}
    return np.stack(shown, axis=-1), summary


def _displacements(dataset: xarray.Dataset, reference: Array, steps: Rows) -> Iterator[Array]:
    if "u" in dataset:
        return read(dataset["u"], steps)
    return (position - reference for position in read(dataset["position"], steps))


def _variable(dataset: xarray.Dataset, name: str, shown: Thinning) -> dict[str, Any]:
    variable = dataset[name]
    values, summary = _particles_over_time(read(variable, shown.steps), shown.particles)
    return {
        "name": name,
        "meaning": meaning_of(variable),
        "units": units_of(variable),
        "vector": "axis" in variable.dims,
        "values": packed(values, "f4"),
        "summary": summary,
    }


def _kinds(dataset: xarray.Dataset, shown: Thinning) -> Array:
    if "kind" in dataset:
        each = read(dataset["kind"], shown.steps)
        return np.stack([kinds[shown.particles] for kinds in each], axis=-1)
    kinds = np.where(role_of(dataset) == OF_BODY, FOLLOWER, FRAME)[shown.particles]
    return np.repeat(kinds[:, None], len(shown.steps), axis=1)


def _box(reference: Array, places: Array) -> list[float]:
    """Left, bottom, right, top of all that is shown at any step; of the body at rest where it
    goes far beyond."""
    low, high = np.nanmin(places, axis=(0, 2)), np.nanmax(places, axis=(0, 2))
    rest = np.nanmin(reference, axis=0), np.nanmax(reference, axis=0)
    if not (np.ptp([low, high], axis=0) < FAR * np.ptp(rest, axis=0).max()).all():
        low, high = rest
    return [*low.tolist(), *high.tolist()]


def spacing_of(reference: Array) -> float:
    """How far neighbours are apart at rest, about, where no bonds say it."""
    sides = np.ptp(reference, axis=0)
    count = len(reference)
    return float(max(math.sqrt(sides.prod() / count), sides.max() / count)) or 1.0


def _triangles(reference: Array, sites: list[Array], body: NDArray[np.bool_]) -> Array:
    """Rows of the triangles that fill the body at rest, (triangle, 3), by its `sites` if they are
    known."""
    rows = np.flatnonzero(body & np.isfinite(reference).all(axis=1))
    if not sites:
        return np.asarray(rows[triangles_of(reference[rows])])
    cells = cells_of(np.stack(sites, axis=1)[rows], reference[rows])
    halves = cells[cells[:, 2] != cells[:, 3]][:, [0, 2, 3]]
    return np.asarray(rows[np.concatenate([cells[:, :3], halves])])


KeyPath = tuple[str | int, ...]
MOST_TRIED = 150
"""Of so many keys it is tried whether they can be left out."""
PARTS = ("lattice", "body", "neighbours", "rule", "frame", "fracture", "solver")


def facts(dataset: xarray.Dataset) -> list[list[str]]:
    """A name and a value each."""
    said, parts = dataset.attrs, json_attribute(dataset, "experiment")
    times = dataset["time"].values
    sizes = {str(name): size for name, size in dataset.sizes.items()}
    ended = ": ".join(filter(None, (str(said.get(n, "")) for n in ("status", "stop_reason"))))
    kinds = {name: _type(parts.get(name)) for name in PARTS}
    found = {
        "ended": ended,
        "created": str(said.get("created", "")),
        "by": made_by(dataset),
        **{name: kind for name, kind in kinds.items() if kind not in ("", "none")},
        "particles": f"{sizes.get('particle', 0)}",
        "bonds": f"{sizes['bond']}" if sizes.get("bond") else "",
        "steps": str(parts.get("steps", "")),
        "recorded": f"{len(times)} steps, {times[0]} to {times[-1]}",
    }
    return [[name, value] for name, value in found.items() if value]


def made_by(dataset: xarray.Dataset) -> str:
    """pbdkit and the plugins, with their versions."""
    given = {"pbdkit": dataset.attrs.get("pbdkit_version", "")} | json_attribute(dataset, "plugins")
    return ", ".join(f"{name} {version}".strip() for name, version in given.items())


def _type(part: Any) -> str:
    return str(part.get("type", "")) if isinstance(part, dict) else ""


def experiment_text(parts: dict[str, Any]) -> str:
    """The experiment, or the sweep, as YAML; of an experiment without what is default, as far as
    that can be told."""
    can_be_brief = "lattice" in parts and not retired_parts(parts)
    return yaml_text(_brief(parts) if can_be_brief else parts)


def _brief(parts: dict[str, Any]) -> dict[str, Any]:
    """Without every key that can be left out, so that the same experiment is built."""
    left: list[KeyPath] = []
    for path in list(_paths(parts))[:MOST_TRIED]:
        inside = any(path[: len(gone)] == gone for gone in left)
        if not inside and _same(_without(parts, [*left, path]), parts):
            left.append(path)
    return dict(_without(parts, left))


def _paths(part: Any, path: KeyPath = ()) -> Iterator[KeyPath]:
    """Of every key but types, those of the whole before those in it."""
    if isinstance(part, dict):
        yield from ((*path, key) for key in part if key not in ("version", "name", "type"))
    inner = part.items() if isinstance(part, dict) else enumerate(part)
    for key, value in inner:
        if isinstance(value, dict | list):
            yield from _paths(value, (*path, key))


def _without(part: Any, left: list[KeyPath], path: KeyPath = ()) -> Any:
    if isinstance(part, dict):
        kept = {k: v for k, v in part.items() if (*path, k) not in left}
        return {key: _without(value, left, (*path, key)) for key, value in kept.items()}
    if isinstance(part, list):
        return [_without(value, left, (*path, n)) for n, value in enumerate(part)]
    return part


def _same(brief: dict[str, Any], parts: dict[str, Any]) -> bool:
    try:
        found: dict[str, Any] = Experiment.build(Source("page", brief)).model_dump(
            mode="json", by_alias=True
        )
    except PbdkitError:  # what is needed, or a part that is not installed here
        return False
    return found == parts


def title_of(dataset: xarray.Dataset) -> str:
    """What the page is called."""
    return str(dataset.attrs.get("title", ""))[:LONGEST] or "a result without a title"


def file_name(title: str) -> str:
    """A plain name for the files of an experiment."""
    return re.sub(r"[^A-Za-z0-9_-]+", "-", title).strip("-")[:60] or "experiment"


LARGEST = 20_000
"""Particles above which nothing is predicted for a page: it would take longer than the page."""
FEWEST, MOST = 8, 800
"""Moves that a decay is measured of, at least and at most."""
FADED = 1e-11
"""Moves smaller than this share of the largest one are of rounding."""


@dataclass(frozen=True)
class SettlingMoves:
    """The largest move a step of any follower, `move`, up to each of the `steps`; `free` is the
    first of these rows after the last event: a leader that moves, begins or ends, a bond that
    breaks."""

    steps: Array
    move: Array
    free: int

    @property
    def fitted(self) -> Rows:
        """The rows that the decay is measured of: the second half of those after the last event
        that are no rounding."""
        rows = np.arange(self.free, len(self.move))
        rows = rows[self.move[rows] > FADED * self.move.max(initial=0.0)]
        return np.asarray(rows[len(rows) // 2 :])

    @property
    def decay(self) -> float | None:
        """By what the moves shrink a step, in the end."""
        rows = self.fitted
        if len(rows) < FEWEST:
            return None
        return float(np.exp(np.polyfit(self.steps[rows], np.log(self.move[rows]), 1)[0]))

    def steps_to(self, share: float) -> int | None:
        """The steps from the last event until moves were smaller than a share of the first one."""
        free = self.move[self.free :]
        below = np.flatnonzero(free <= share * free[:1].max(initial=0.0))
        return int(self.steps[self.free + below[0]] - self.steps[self.free]) if len(below) else None


def moves_of(dataset: xarray.Dataset) -> SettlingMoves | None:
    """Between recorded steps that lie equally far apart, MOST at most; None where there are too
    few of them, or no kinds."""
    recorded = dataset.sizes["time"]
    steps = np.arange(0, recorded, -(-recorded // MOST))
    times = dataset["time"].values[steps]
    apart = np.diff(times)
    if len(apart) and apart[-1] != apart[0]:
        steps, times, apart = steps[:-1], times[:-1], apart[:-1]
    if len(times) < FEWEST or "kind" not in dataset or (apart != apart[0]).any():
        return None
    name = "u" if "u" in dataset else "position"
    move, event = [], 0
    both = zip(read(dataset[name], steps), read(dataset["kind"], steps), strict=True)
    for n, ((before, kinds_before), (now, kinds)) in enumerate(pairwise(both), 1):
        lengths, leads = np.linalg.norm(now - before, axis=1), kinds == LEADER
        move.append(float(lengths[~leads].max(initial=0.0)) / apart[0])
        led = lengths[leads].max(initial=0.0) > FADED * max(move)
        if led or not np.array_equal(kinds, kinds_before):
            event = n
    if "broken_step" in dataset and dataset["broken_step"].size:
        last = int(dataset["broken_step"].max())
        event = max(event, int(np.searchsorted(times, last)))
    return SettlingMoves(times[1:], np.array(move), min(event, len(move) - 1))


def settling(dataset: xarray.Dataset, scene: Scene | None) -> dict[str, Any]:
    """Rows of what was predicted and what happened, sentences beside them, and the curve of the
    moves; why there is none where it cannot be had cheaply."""
    if scene is None:
        return {"notes": ["Nothing is predicted: the experiment cannot be built here."]}
    if not scene.experiment.solver.makes_steps:
        return _found(dataset)
    if scene.raster.count > LARGEST:
        return {
            "notes": [
                f"Nothing is predicted here of more than {LARGEST} particles; `pbdkit check` does, "
                "and takes longer."
            ]
        }
    analysis, moves = Analysis(tuned(scene)), moves_of(dataset)
    rest = moves if moves and len(moves.move) - moves.free >= FEWEST else None
    found: dict[str, Any] = {"rows": _rows(dataset, analysis, rest), "notes": _notes(analysis)}
    if rest is None:
        why = (
            "too few steps are recorded, or they are not equally far apart"
            if moves is None
            else "leaders move or bonds break until the end, or nearly"
        )
        found["notes"].append(f"How the body came to rest is not measured: {why}.")
    return found | ({"moves": _curve(analysis, moves)} if moves else {})


def _found(dataset: xarray.Dataset) -> dict[str, Any]:
    """Of an equilibrium: what its certificate says."""
    certificate = json_attribute(dataset, "certificate")
    told = [[name.replace("_", " "), value] for name, value in certificate.items()]
    note = "The solver makes no steps: it finds the equilibrium, and says how far from it the "
    return {"certificate": told, "notes": [f"{note}last state can be at most."]}


def _rows(
    dataset: xarray.Dataset, analysis: Analysis, moves: SettlingMoves | None
) -> list[list[Any]]:
    to = analysis.steps_to["1e-3"]
    measured: Any = moves.steps_to(1e-3) if moves else None
    if moves and measured is None:
        measured = "not by the end"
    decay = moves.decay if moves else None
    rows: list[list[Any]] = [
        ["stable", _yes(analysis.stable), _ended(dataset, moves)],
        ["factor a step: spectral radius; of moves, in the end", analysis.spectral_radius, decay],
        ["steps until it has shrunk to 1/1000; moves, since the last event", to, measured],
        ["smallest eigenvalue of the rule", analysis.smallest_eigenvalue, None],
        ["largest stable relaxation", analysis.largest_stable_relaxation, None],
    ]  # fmt: skip
    return rows


def _yes(stable: bool | None) -> str:
    return "not known" if stable is None else "yes" if stable else "no"


def _ended(dataset: xarray.Dataset, moves: SettlingMoves | None) -> str:
    status = str(dataset.attrs.get("status", ""))
    if status not in ("complete", "settled") or moves is None:
        return status
    last = moves.move[-1] / (moves.move.max() or 1.0)
    return f"{status}, the last move was {last:.2g} of the largest"


def _notes(analysis: Analysis) -> list[str]:
    notes = []
    if not analysis.exact:
        notes.append(
            "The prediction is of the start, made linear: the rule is not linear, or bonds, "
            "neighbours, contacts or numbers change on the way."
        )
    if analysis.estimated:
        notes.append("The spectrum is estimated: 1 - radius is within 1 %.")
    return [*notes, *analysis.warnings()]


def _curve(analysis: Analysis, moves: SettlingMoves) -> dict[str, Any]:
    """The logarithm of the moves, and the slope that was predicted through the middle of those
    that the decay is measured of."""
    with np.errstate(divide="ignore"):
        logs = np.log10(moves.move)
    logs[~np.isfinite(logs)] = np.nan
    series = [{"name": "what happened", "values": packed(logs, "f8")}]
    radius, rows = analysis.spectral_radius, moves.fitted
    if radius and len(rows) >= FEWEST:
        middle = rows[len(rows) // 2]
        line = logs[middle] + (moves.steps - moves.steps[middle]) * np.log10(radius)
        line[: moves.free] = np.nan
        line[(line < np.nanmin(logs) - 1) | (line > np.nanmax(logs) + 0.5)] = np.nan
        series.append({"name": "predicted slope", "values": packed(line, "f8")})
    return {
        "title": "largest move of a follower, a step",
        "x": packed(moves.steps, "f8"),
        "x_label": "step",
        "y_label": "log10 of the move",
        "series": series,
    }


@dataclass(frozen=True)
class Origin:
    """The scene of the experiment that a dataset carries, None where it cannot be built here, and
    why it cannot."""

    scene: Scene | None
    fault: str = ""


def origin_of(dataset: xarray.Dataset) -> Origin:
    """Of a dataset: a page can be made without it, and then says what is missing."""
    try:
        return Origin(scene_of(dataset, "the lattice of a page"))
    except PbdkitError as error:
        return Origin(None, str(error))


class RunContent:
    """What `report.js` shows of a run. Raises ExperimentError for a dataset without positions."""

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
            "settling": settling(dataset, origin.scene),
            "ledger": self._bonds.ledger() if self._bonds and self._bonds.can_break else None,
        }

    def within(self, budget: int) -> dict[str, Any]:
        """All of it, where the moving lattice takes about `budget` bytes before it is packed."""
        dataset, reference, bonds = self._dataset, self._reference, self._bonds
        shown = thinned(dataset, leaders_of(dataset), bytes_a_particle(dataset), budget)
        spacing = bonds.spacing if bonds else spacing_of(reference)
        run = {
            "lattice": resting(dataset, reference, shown, spacing)
            | moving(dataset, reference, shown),
            "bonds": bonds.shown(shown.particles) if bonds else None,
            "curves": curves(dataset),
        }
        left_out = [*shown.left_out(), *fewer_points(dataset), *self._notes]
        return self._whole | {"run": run, "left_out": left_out, "thinned": shown.is_thinner}


def _refuse_no_motion(dataset: xarray.Dataset) -> None:
    """Raises ExperimentError unless there are positions of one run in the plane."""
    if "position" not in dataset:
        raise ExperimentError("has no positions: keep `position` to have them in a page")
    position = dataset["position"]
    if {*position.dims} != {"time", "particle", "axis"} or position.sizes["axis"] != 2:
        raise ExperimentError(
            f"position has the dimensions {dict(position.sizes)}: a page needs time, particle and "
            "two axes; isel picks one of several runs"
        )
    if not position.size:
        raise ExperimentError("has no step or no particle: a page needs one of each")


def _bonds(dataset: xarray.Dataset, origin: Origin) -> tuple[BondArrays | None, list[str]]:
    """Those that are known, and sentences about what is not."""
    notes = []
    if origin.fault:
        notes.append(f"The experiment cannot be built here: {origin.fault}")
    count = dataset.sizes["particle"]
    if "number" in dataset and not np.array_equal(dataset["number"], np.arange(1, count + 1)):
        return None, [*notes, "Bonds are not shown: some particles of the run are missing."]
    try:
        return bonds_of(dataset, origin.scene), notes
    except PbdkitError as error:
        return bonds_of(dataset, None), [*notes, f"Of its bonds less is known: the file {error}"]


def leaders_of(dataset: xarray.Dataset) -> NDArray[np.bool_]:
    """Who leads at the first or at the last recorded step, (particle,)."""
    if "kind" not in dataset or "time" not in dataset["kind"].dims:
        return np.zeros(dataset.sizes["particle"], np.bool_)
    ends = dataset["kind"].isel(time=[0, -1]).values
    return np.asarray((ends == LEADER).any(axis=0))


def reference_of(dataset: xarray.Dataset, scene: Scene | None) -> NDArray[np.float64]:
    """Where displacements are counted from, (particle, axis), in the units of the page: the
    reference, or the first recorded step where nobody knows it."""
    if "reference" in dataset.variables and dataset["reference"].ndim == 2:
        return in_units(dataset["reference"].values, factor_of(dataset["reference"]))
    if scene is not None and scene.raster.count == dataset.sizes["particle"]:
        return in_units(scene.raster.reference(), lattice_unit(dataset))
    first = dataset["position"].isel(time=0, missing_dims="ignore")
    return in_units(first.transpose("particle", "axis").values, factor_of(first))


def _known(variable: xarray.DataArray) -> Array:
    """With NaN where a member has nothing."""
    values = np.asarray(variable.values, float)
    known = np.where(values == variable.attrs.get(FILL, np.nan), np.nan, values)
    return factor_of(variable) * known


def numbers(dataset: xarray.Dataset, grid: list[str]) -> Iterator[dict[str, Any]]:
    """One number a member each: of every variable that all members have, its last and its largest
    value, over particles the mean and the largest."""
    for name, variable in dataset.data_vars.items():
        if name in (STATUS, MESSAGE, "kind", "position") or not {*grid} <= {*variable.dims}:
            continue
        if variable.dtype.kind not in "biuf" or not variable.size:
            continue
        rest = [str(d) for d in variable.dims if d not in grid]
        values = _known(variable.transpose(*grid, *rest))
        values = values.reshape(-1, *values.shape[len(grid) :])
        words = f"{meaning_of(variable)}{f' ({u})' if (u := units_of(variable)) else ''}"
        if name == "broken_step":
            told = np.where(np.isnan(values).all(axis=1), np.nan, (values >= 0).sum(axis=1))
            yield {"name": "broken bonds", "values": packed(told, "f8")}
            continue
        for how, told in _described(values, rest):
            yield {"name": f"{words}: {how}" if how else words, "values": packed(told, "f8")}


def _described(values: Array, rest: list[str]) -> Iterator[tuple[str, Array]]:
    """Numbers of (member, *rest) that stand for all, and what they are."""
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
    several = values.shape[2] > 1
    with np.errstate(all="ignore"):
        largest = _reduced(np.fmax, values)
        mean = np.nansum(values, axis=2) / np.isfinite(values).sum(axis=2)
    yield ("largest at the end" if several else "at the end"), _last(largest)
    if several:
        yield "mean at the end", _last(mean)
    if values.shape[1] > 1:
        yield "largest of all steps", _reduced(np.fmax, largest)


def _reduced(how: np.ufunc, values: Array) -> Array:
    return np.asarray(how.reduce(values, axis=values.ndim - 1))


def _last(values: Array) -> Array:
    """The last number of each row, NaN where there is none."""
    known = np.isfinite(values)
    last = values.shape[1] - 1 - np.argmax(known[:, ::-1], axis=1)
    return np.asarray(values[np.arange(len(values)), last])


FEWEST_STEPS_OF_MEMBER, FEWEST_POINTS = 6, 50
"""Of each member at least, as far as they are recorded."""
POINTS = 100_000
"""Of the curves of all members together."""


class SweepContent:
    """What `report.js` shows of a sweep."""

    def __init__(self, dataset: xarray.Dataset) -> None:
        grid = [str(dim) for dim in dataset[STATUS].dims]
        asked = json_attribute(dataset, "sweep")
        title = title_of(dataset)
        places = product(*(range(dataset.sizes[dim]) for dim in grid))
        self._members = [dataset.isel(dict(zip(grid, place, strict=True))) for place in places]
        self._scene = _scene(asked)
        self._whole = {
            "what": "sweep",
            "title": title,
            "file": file_name(title),
            "facts": _facts(dataset),
            "experiment": experiment_text(asked),
            "grid": [{"name": dim, "labels": _labels(dataset, dim)} for dim in grid],
            "status": dataset[STATUS].values.ravel().tolist(),
            "message": dataset[MESSAGE].values.ravel().tolist(),
            "scalars": list(numbers(dataset, grid)),
        }

    def within(self, budget: int) -> dict[str, Any]:
        """All of it, where the moving lattices of all members together take about `budget` bytes
        before they are packed."""
        each = self._members
        points = max(FEWEST_POINTS, POINTS // len(each))
        good = [str(member[STATUS].item()) in KEPT for member in each]
        if "position" not in each[0] or not any(good):
            note = "No lattices are shown: no member ended well, or `position` was not kept."
            plain = [{"curves": curves(member, points)} for member in each]
            return self._whole | {
                "shared": {}, "members": plain, "left_out": [note], "thinned": False,
            }  # fmt: skip
        first = each[good.index(True)]
        size = bytes_a_particle(first) * len(each)
        shown = thinned(first, leaders_of(first), size, budget, FEWEST_STEPS_OF_MEMBER)
        bodies = [
            _Body.of(member, self._scene) if g else None
            for member, g in zip(each, good, strict=True)
        ]
        one = next(filter(None, bodies))
        alike = all(body is None or one.is_like(body) for body in bodies)
        members = [
            body and body.moving(member, shown, points, whole=not alike)
            for body, member in zip(bodies, each, strict=True)
        ]
        return self._whole | {
            "shared": one.resting(first, shown) if alike else {},
            "members": members,
            "left_out": shown.left_out(),
            "thinned": shown.is_thinner,
        }


@dataclass(frozen=True)
class _Body:
    """Of one member: where it is at rest, (particle, axis), and its bonds."""

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
        """Whether they are the same at rest."""
        if self.bonds and other.bonds:
            same_bonds = np.array_equal(self.bonds.ends, other.bonds.ends)
        else:
            same_bonds = self.bonds is other.bonds
        return same_bonds and np.array_equal(self.reference, other.reference, equal_nan=True)

    def resting(self, member: xarray.Dataset, shown: Thinning) -> dict[str, Any]:
        """What does not move of it."""
        here = self.reference[np.isfinite(self.reference).all(axis=1)]
        spacing = self.bonds.spacing if self.bonds else spacing_of(here)
        return {
            "lattice": resting(member, self.reference, shown, spacing),
            "bonds": self.bonds.shown(shown.particles) if self.bonds else None,
        }

    def moving(
        self, member: xarray.Dataset, shown: Thinning, points: int, *, whole: bool
    ) -> dict[str, Any]:
        """What moves of it, or the `whole`."""
        still = self.resting(member, shown) if whole else {"lattice": {}}
        broken = self.bonds.broken(shown.particles) if self.bonds else None
        last = member["position"].isel(time=shown.steps)
        there = last.notnull().any(["particle", "axis"]).values  # others may have made more steps
        moved = moving(member, self.reference, replace(shown, steps=shown.steps[there]))
        return {"bonds": broken} | still | {
            "lattice": still["lattice"] | moved,
            "curves": curves(member, points),
        }  # fmt: skip


def _facts(dataset: xarray.Dataset) -> list[list[str]]:
    status = dataset[STATUS].values.ravel()
    names, counts = np.unique(status, return_counts=True)
    ended = ", ".join(f"{n} {name}" for name, n in zip(names, counts, strict=True))
    sizes = " × ".join(f"{size} {name}" for name, size in dataset[STATUS].sizes.items())
    made = str(dataset.attrs.get("created", ""))
    members = f"{status.size}: {sizes}"
    return [["members", members], ["ended", ended], ["created", made], ["by", made_by(dataset)]]


def _labels(dataset: xarray.Dataset, dim: str) -> list[str]:
    """What stands along a dimension of the grid; of cases, what is set in each."""
    beside = [str(n) for n, c in dataset.coords.items() if c.dims == (dim,) and n != dim]
    if dim == CASE and beside:
        rows = zip(*(dataset[n].values.tolist() for n in beside), strict=True)
        return [", ".join(f"{n} {_label(v)}" for n, v in zip(beside, r, strict=True)) for r in rows]
    name = dim + TEXT if dim + TEXT in dataset.variables else dim
    if name not in dataset.variables:
        return [str(n) for n in range(dataset.sizes[dim])]
    values = dataset[name].values
    if values.dtype.kind == "f":  # what is 0 but for rounding is 0
        values = np.where(np.abs(values) < 1e-12 * np.abs(values).max(), 0.0, values)
    return [_label(value) for value in values.tolist()]


def _label(value: Any) -> str:
    """A value in few words."""
    return f"{value:.6g}" if isinstance(value, float) else type_alone(str(value))


def _scene(asked: dict[str, Any]) -> Scene | None:
    """That of the experiment that is varied, None where the body is."""
    import xarray

    experiment = asked.get("experiment", {})
    varied = {path.split(".")[0] for key in ("vary", "together") for path in asked.get(key, {})}
    if varied & {"lattice", "body", "neighbours", "frame"}:
        return None
    carrier = xarray.Dataset(attrs={"experiment": json.dumps(experiment)})
    try:
        return scene_of(carrier, "the lattice of a page")
    except PbdkitError:
        return None


def speed(path: Path) -> dict[str, Any]:
    """Headings with what they mean, and a row a method. Raises StorageError where the file cannot
    be read, and ExperimentError where it holds something else."""
    try:
        told = json.loads(path.read_text("utf-8"))
        rows: list[dict[str, Any]] = [dict(row) for row in told["rows"]]
        machine, experiment = dict(told["machine"]), f"{told['experiment']}, {told['steps']} steps"
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror}") from None
    except (ValueError, TypeError, KeyError, RecursionError):
        raise ExperimentError(
            f"{path}: holds no measurement; `pbdkit bench EXPERIMENT --json {path}` writes one"
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
"""Bytes of a page, at most."""
FIRST, MOST_BYTES = 20_000_000, 80_000_000
"""Bytes of the lattice before it is packed: in the first attempt, and what a browser still moves
well. How much smaller they become depends on the motion, and is known only then."""
ATTEMPTS, SMALL = 4, 0.6
"""A page that is thinned and smaller than that share of the budget is made again with more."""


def report(
    dataset: xarray.Dataset | str | Path,
    path: str | Path,
    *,
    bench: str | Path | None = None,
    replace: bool = True,
) -> Path:
    """Writes the page of a run or of a sweep, and returns its path. The page appears whole or not
    at all, with `replace` in the place of an earlier one.

    The page has the moving lattice, the histories of particles and bonds, curves, what was
    predicted, what broke, and how to run it again. It takes 5 MB at most: of more steps or
    particles some are left out, and the page says which. `bench` is a file that
    ``pbdkit bench --json`` wrote.

    Raises ExperimentError for a dataset without positions, and StorageError for files that cannot
    be read or written.
    """
    measured = speed(Path(bench)) if bench is not None else None
    with _reading(dataset) as read:
        text = report_text(read, measured)
    write(Path(path), text, replace=replace)
    return Path(path)


def report_text(dataset: xarray.Dataset, measured: dict[str, Any] | None = None) -> str:
    """The page, with the figures of `speed` where there are any."""
    content = (SweepContent if SWEEP in dataset.attrs else RunContent)(dataset)
    budget, best = FIRST, ""
    for _ in range(ATTEMPTS):
        held = content.within(budget)
        text = page(held | {"speed": measured})
        fits = len(text) <= BUDGET
        if not best or (fits and len(text) > len(best)) or len(best) > BUDGET:
            best = text
        enough = not held["thinned"] or len(text) > SMALL * BUDGET or budget == MOST_BYTES
        if fits and enough:
            break
        budget = min(int(0.9 * budget * BUDGET / len(text)), MOST_BYTES)
    return best


def _reading(dataset: xarray.Dataset | str | Path) -> AbstractContextManager[xarray.Dataset]:
    if isinstance(dataset, str | Path):
        return reading(dataset, sweeps=True)
    return nullcontext(in_this_layout(dataset))
