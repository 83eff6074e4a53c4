"""Export to ParaView: VTKHDF, the format of VTK in HDF5, written without VTK; the body as vertices,
lines and polygons.

The format is described at docs.vtk.org, "VTKHDF file format", version 2: an UnstructuredGrid whose
points and data follow each other step by step, with the beginning of each step in `Steps`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.array_types import Array
from pbdkit.errors import ExperimentError
from pbdkit.io.atomic_file import NewFile, written
from pbdkit.io.layout import broken_by

if TYPE_CHECKING:
    import h5py
    import xarray

    from pbdkit.scene.scene import Scene


PARTICLE, BOND, CELL = 0, 1, 2
"""What a cell of the grid stands for."""
VERTEX, LINE, TRIANGLE, POLYGON, QUAD = 1, 3, 5, 7, 9
"""The numbers that VTK gives to shapes."""


@dataclass(frozen=True)
class UnstructuredGrid:
    """First a vertex for each particle, then a line for each bond, then the polygons between
    particles: `connectivity` are rows of the particle table, those of cell n from offsets[n] to
    offsets[n + 1]; `types` are VTK's. `part` says what each is; `broken_step` the step in which a
    bond, or the first of a polygon's, broke, -1 where none did, None where none can."""

    connectivity: Array
    offsets: Array
    types: Array
    part: Array
    broken_step: Array | None

    def of_bonds(self, values: Array, elsewhere: Any) -> Array:
        """(cell,): values of bonds, and in all other cells that."""
        found = np.full(len(self.part), elsewhere, values.dtype)
        found[self.part == BOND] = values
        return found


def grid_of(dataset: xarray.Dataset, scene: Scene | None) -> UnstructuredGrid:
    """The grid of a dataset; without its scene, and on a lattice in space, without polygons."""
    count = dataset.sizes["particle"]
    has_bonds = "bond_ends" in dataset.variables
    bonds = dataset["bond_ends"].values - 1 if has_bonds else np.empty((0, 2), int)
    polygons = [] if scene is None else polygons_of(scene)
    kinds = [np.arange(count)[:, None], bonds, *polygons]
    sizes = np.concatenate([np.full(len(rows), rows.shape[1]) for rows in kinds])
    types = np.concatenate([np.full(len(rows), _type(rows), np.uint8) for rows in kinds])
    parts = [PARTICLE, BOND, *[CELL] * len(polygons)]
    part = np.repeat(np.array(parts, np.uint8), [len(rows) for rows in kinds])
    broken = None
    if "broken_step" in dataset.variables:
        steps = dataset["broken_step"].values
        own = [np.full(count, -1, steps.dtype), steps]
        broken = np.concatenate([*own, *(_torn(rows, bonds, steps, count) for rows in polygons)])
    connectivity = np.concatenate([rows.ravel() for rows in kinds]).astype(np.int64)
    offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    return UnstructuredGrid(connectivity, offsets, types, part, broken)


def polygons_of(scene: Scene) -> list[Array]:
    """The rows of the corners of the body's cells, (cell, corner), those of one shape together."""
    found: dict[int, list[Array]] = {}
    for patch in scene.patches:
        places = np.argwhere(patch.whole)
        corners = [
            scene.raster.rows_at(block.sublattice, *(places + block.start).T)
            for block in patch.corners
        ]
        found.setdefault(len(corners), []).append(np.stack(corners, axis=1))
    return [np.concatenate(rows) for rows in found.values()]


def _type(rows: Array) -> int:
    shapes = {1: VERTEX, 2: LINE, 3: TRIANGLE, 4: QUAD}
    return shapes.get(rows.shape[1], POLYGON)


def _torn(rows: Array, bonds: Array, steps: Array, count: int) -> Array:
    """(cell,): the step in which the first bond between two corners of a cell broke, else -1."""
    broken = np.flatnonzero(steps >= 0)
    key = bonds[broken] @ (count, 1)
    order = np.argsort(key)
    key, when = np.append(key[order], -1), np.append(steps[broken[order]], 0)
    never = np.iinfo(steps.dtype).max
    first = np.full(len(rows), never, steps.dtype)
    for a, b in combinations(range(rows.shape[1]), 2):
        pair = np.sort(rows[:, [a, b]], axis=1) @ (count, 1)
        at = np.searchsorted(key[:-1], pair)
        there = key[at] == pair
        first[there] = np.minimum(first[there], when[at[there]])
    return np.where(first == never, -1, first)


VERSION, TYPE = (2, 2), b"UnstructuredGrid"
BLOCK_BYTES = 2**25
"""About so much of a variable is in memory at a time."""
CHUNK = 2**16
"""Values in a chunk of what grows step by step."""
ELSEWHERE = ("position", "time", "particle", "site", "axis", "bond_ends", "broken_step")
"""What the grid itself says."""
NOT_HERE = {"i": -1, "u": 0, "f": np.nan}
"""What stands, by the kind of number, in the cells that have no value."""


def export(dataset: xarray.Dataset, path: Path, scene: Scene | None, *, replace: bool) -> None:
    """Writes every recorded step: the particles, the bonds, and of a `scene` the cells between
    them, with all that the dataset knows of them. At most some steps are in memory.

    Raises ExperimentError where there are no positions, as in a sweep that kept none, and
    WriteError where it cannot be written; then nothing stands there, or the earlier file.
    """
    import h5py

    if "position" not in dataset.variables:
        raise ExperimentError("there are no positions to write: keep the variable `position`")
    grid = grid_of(dataset, scene)
    with written(path, NewFile, replace=replace) as new, h5py.File(new, "w") as file:
        _write(file, dataset, grid)


def _write(file: h5py.File, dataset: xarray.Dataset, grid: UnstructuredGrid) -> None:
    for name, said in dataset.attrs.items():
        file.attrs[name] = said if isinstance(said, str) else json.dumps(said, default=str)
    root = file.create_group("VTKHDF")
    root.attrs["Version"] = VERSION
    root.attrs.create("Type", np.bytes_(TYPE))
    count, steps = dataset.sizes["particle"], dataset.sizes["time"]
    root["NumberOfPoints"] = np.array([count])
    root["NumberOfCells"] = np.array([len(grid.types)])
    root["NumberOfConnectivityIds"] = np.array([len(grid.connectivity)])
    root["Connectivity"], root["Offsets"] = grid.connectivity, grid.offsets
    root["Types"] = grid.types
    times = root.create_group("Steps")
    times.attrs["NSteps"] = steps
    times["Values"] = dataset["time"].values.astype(float)
    times["NumberOfParts"], times["PartOffsets"] = np.ones(steps, int), np.zeros(steps, int)
    for name in ("CellOffsets", "ConnectivityIdOffsets"):
        times[name] = np.zeros((steps, 1), int)
    times["PointOffsets"] = count * np.arange(steps)
    for where in ("PointData", "CellData", "FieldData"):
        for group in (where, f"Steps/{where}Offsets"):
            root.create_group(group)
    times.create_group("FieldDataSizes")
    points = root.create_dataset("Points", (steps * count, 3), "f8")
    for begin, values in _blocks(dataset["position"].transpose("time", "particle", "axis")):
        points[begin * count : (begin + len(values)) * count] = _in_space(values).reshape(-1, 3)
    for name, variable in dataset.variables.items():
        _put(Parts(root, str(name), steps), dataset[str(name)], variable.dims, grid)
    _put_broken(Parts(root, "broken", steps), dataset, grid)


@dataclass(frozen=True)
class Parts:
    """Where a variable goes."""

    root: h5py.Group
    name: str
    steps: int

    def once(self, where: str, values: Array) -> None:
        """The same at every step; of field data the entries are tuples."""
        self.root[f"{where}/{self.name}"] = values
        self._from(where, np.zeros(self.steps, int), values)

    def each(self, where: str, rows: Iterator[Array]) -> None:
        """Values for each step; those that did not change since the last stand there once."""
        last: Array | None = None
        starts, start, length, kept = list[int](), 0, 0, None
        for values in rows:
            if last is None or not np.array_equal(values, last, equal_nan=values.dtype.kind == "f"):
                kept = kept or self._growing(where, values)
                kept.resize(length + len(values), axis=0)
                kept[length:] = values
                start, length, last = length, length + len(values), values
            starts.append(start)
        if last is not None:
            self._from(where, np.array(starts), last)

    def _growing(self, where: str, values: Array) -> h5py.Dataset:
        more = values.shape[1:]
        chunk = (max(1, min(CHUNK, len(values))), *more)
        return self.root.create_dataset(
            f"{where}/{self.name}", (0, *more), values.dtype, chunks=chunk, maxshape=(None, *more)
        )

    def _from(self, where: str, starts: Array, values: Array) -> None:
        self.root[f"Steps/{where}Offsets/{self.name}"] = starts
        if where == "FieldData":
            size = (values.shape[1] if values.ndim > 1 else 1, len(values))
            self.root[f"Steps/FieldDataSizes/{self.name}"] = np.tile(size, (self.steps, 1))


def _put(
    parts: Parts, values: xarray.DataArray, dims: tuple[Any, ...], grid: UnstructuredGrid
) -> None:
    """A variable where it belongs; what is of neither particles nor bonds is field data."""
    along = {*dims} - {"time", "axis"}
    if parts.name in ELSEWHERE or values.dtype.kind not in "biuf" or "step" in along:
        return
    where = "PointData" if along - {"principal"} == {"particle"} else "FieldData"
    where = "CellData" if along == {"bond"} else where
    order = [d for d in ("time", *sorted(along), "axis") if d in dims]
    whole = values.transpose(*order)
    vector = "axis" in dims

    def shown(entries: Array) -> Array:
        entries = _in_space(entries) if vector else entries
        entries = entries.astype("u1") if entries.dtype.kind == "b" else entries
        if where == "CellData":
            entries = grid.of_bonds(entries, NOT_HERE[entries.dtype.kind])
        return entries if along else entries.reshape(1, *entries.shape)

    if "time" not in dims:
        parts.once(where, shown(whole.values))
        return
    parts.each(where, (shown(row) for _, block in _blocks(whole) for row in block))


def _put_broken(parts: Parts, dataset: xarray.Dataset, grid: UnstructuredGrid) -> None:
    """Which part every cell of the grid is, and where bonds break, which are broken at each step: a
    cell between particles is where a bond of its corners is."""
    Parts(parts.root, "part", parts.steps).once("CellData", grid.part)
    if grid.broken_step is None:
        return
    broken, steps = grid.broken_step, dataset["time"].values
    Parts(parts.root, "broken_step", parts.steps).once("CellData", broken)
    now = (broken_by(broken, step).astype("u1") for step in steps)
    parts.each("CellData", now)


def _blocks(values: xarray.DataArray) -> Iterator[tuple[int, Array]]:
    """(first step, values) of some steps at a time."""
    steps = values.sizes["time"]
    block = max(1, BLOCK_BYTES * steps // max(1, values.nbytes))
    for begin in range(0, steps, block):
        yield begin, values.isel(time=slice(begin, begin + block)).values


def _in_space(values: Array) -> Array:
    """Vectors with three components."""
    missing = 3 - values.shape[-1]
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, missing)])
