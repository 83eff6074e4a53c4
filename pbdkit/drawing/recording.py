"""A dataset as pictures need it: the body, which does not change, and recorded steps of it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.drawing.labels import in_its_units, label, plain
from pbdkit.drawing.look import is_number
from pbdkit.drawing.mesh import cells_of, outline, whole
from pbdkit.drawing.outline import CutCells, lattice_unit, outline_at_rest, shape_of
from pbdkit.drawing.quantity import Quantity, quantity_of
from pbdkit.errors import ExperimentError
from pbdkit.experiment.body import Body as Shape
from pbdkit.results.layout import OF_BODY, as_step, broken_by
from pbdkit.results.sites import rows_of
from pbdkit.scene.raster import FRAME

if TYPE_CHECKING:
    import xarray

Array = NDArray[Any]
BLOCK_BYTES = 2**26
"""So much is read of a file at a time."""
UNKNOWN = FRAME + 1
"""The kind of a particle of the body where kinds were not kept: it has no colour."""
MEASURED = 50_000
"""The distance of particles is measured in bodies of up to so many, and else from their area."""


@dataclass(frozen=True)
class Body:
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


class Recording:
    """The recorded steps of a dataset, with the quantity of that name, if any; in mm and so on
    where the dataset says its scale.

    Raises ExperimentError for a dataset of several runs, for space that is no plane, and for a
    quantity that cannot be drawn. Only what is asked for is read.
    """

    def __init__(self, dataset: xarray.Dataset, color: str | None = None) -> None:
        self._dataset = of_one_run(dataset)
        self.quantity: Quantity | None = None
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
    def body(self) -> Body:
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
        return Body(
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
