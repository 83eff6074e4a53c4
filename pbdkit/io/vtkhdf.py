"""Export to ParaView in the format VTKHDF, written without VTK. The body consists of vertices,
lines and polygons.

The format is described at docs.vtk.org, "VTKHDF file format", version 2. The file contains an
UnstructuredGrid. Its points and data are stored one step after the other, and `Steps` contains the
position at which each step begins.
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
from pbdkit.io.atomic_file import NewFile, open_atomic
from pbdkit.io.layout import broken_by
from pbdkit.memory import refuse_no_file_cache

if TYPE_CHECKING:
    import h5py
    import xarray

    from pbdkit.scene.scene import Scene


PARTICLE = 0
"""Value of `part` for vertices."""
BOND = 1
"""Value of `part` for lines."""
CELL = 2
"""Value of `part` for polygons."""
VERTEX = 1
"""VTK's number of this type of cells."""
LINE = 3
"""VTK's number of this type of cells."""
TRIANGLE = 5
"""VTK's number of this type of cells."""
POLYGON = 7
"""VTK's number of this type of cells."""
QUAD = 9
"""VTK's number of this type of cells."""


@dataclass(frozen=True)
class UnstructuredGrid:
    """Grid of VTK cells: a vertex for each particle, then a line for each bond, then the polygons
    between particles. `connectivity` contains rows of the particle table; the entries of cell n are
    those from offsets[n] to offsets[n + 1]. `types` are the numbers of cell types in VTK. `part` is
    PARTICLE, BOND or CELL for each cell. `broken_step` is the step in which a bond broke or, for a
    polygon, the first step in which one of its bonds broke. It is -1 if nothing broke, and None for
    a scene without fracture."""

    connectivity: Array
    offsets: Array
    types: Array
    part: Array
    broken_step: Array | None

    def of_bonds(self, values: Array, elsewhere: Any) -> Array:
        """Return a value for each cell: `values` for the bonds, and `elsewhere` for all other
        cells."""
        cells = np.full(len(self.part), elsewhere, values.dtype)
        cells[self.part == BOND] = values
        return cells


def grid_of(dataset: xarray.Dataset, scene: Scene | None) -> UnstructuredGrid:
    """Return the grid of a dataset. It has no polygons if the scene is not given, or if the lattice
    is in space."""
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
        steps_by_cell = [np.full(count, -1, steps.dtype), steps]
        broken = np.concatenate(
            [*steps_by_cell, *(_first_breaking(rows, bonds, steps, count) for rows in polygons)]
        )
    connectivity = np.concatenate([rows.ravel() for rows in kinds]).astype(np.int64)
    offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    return UnstructuredGrid(connectivity, offsets, types, part, broken)


def polygons_of(scene: Scene) -> list[Array]:
    """Return arrays of shape (cell, corner) with the rows of the corners of the body's cells. There
    is one array for each kind of polygon."""
    corners_by_size: dict[int, list[Array]] = {}
    for patch in scene.patches:
        places = np.argwhere(patch.whole)
        corners = [
            scene.raster.rows_at(block.sublattice, *(places + block.start).T)
            for block in patch.corners
        ]
        corners_by_size.setdefault(len(corners), []).append(np.stack(corners, axis=1))
    return [np.concatenate(rows) for rows in corners_by_size.values()]


def _type(rows: Array) -> int:
    shapes = {1: VERTEX, 2: LINE, 3: TRIANGLE, 4: QUAD}
    return shapes.get(rows.shape[1], POLYGON)


def _first_breaking(rows: Array, bonds: Array, steps: Array, count: int) -> Array:
    """Return for each cell the first step in which a bond between two of its corners broke, and -1
    if none broke, (cell,)."""
    broken = np.flatnonzero(steps >= 0)
    key = bonds[broken] @ (count, 1)
    order = np.argsort(key)
    key, when = np.append(key[order], -1), np.append(steps[broken[order]], 0)
    never = np.iinfo(steps.dtype).max
    first = np.full(len(rows), never, steps.dtype)
    for a, b in combinations(range(rows.shape[1]), 2):
        pair = np.sort(rows[:, [a, b]], axis=1) @ (count, 1)
        at = np.searchsorted(key[:-1], pair)
        matches = key[at] == pair
        first[matches] = np.minimum(first[matches], when[at[matches]])
    return np.where(first == never, -1, first)


VERSION = (2, 2)
"""Version of the format."""
TYPE = b"UnstructuredGrid"
"""Type of the grid."""
BLOCK_BYTES = 2**25
"""Approximate number of bytes that are in memory at the same time, for one variable."""
CHUNK = 2**16
"""Number of values in a chunk of a growing array."""
ELSEWHERE = ("position", "time", "particle", "site", "axis", "bond_ends", "broken_step")
"""Variables that are not written, because the grid itself contains them."""
NOT_HERE = {"i": -1, "u": 0, "f": np.nan}
"""Values for cells that have no value, by kind of data type."""


def export(dataset: xarray.Dataset, path: Path, scene: Scene | None, *, replace: bool) -> None:
    """Write every recorded step with all variables of the dataset. The file contains particles,
    bonds and, if the `scene` is given, the cells between particles.

    Only some steps are in memory at a time. Raises ExperimentError if the dataset contains no
    positions, for instance because a sweep did not keep them. Raises WriteError if the file cannot
    be written; an earlier file of that name then remains.
    """
    import h5py

    if "position" not in dataset.variables:
        raise ExperimentError("there are no positions to write; keep the variable `position`")
    grid = grid_of(dataset, scene)
    refuse_no_file_cache()
    with open_atomic(path, NewFile, replace=replace) as new, h5py.File(new, "w") as file:
        _write(file, dataset, grid)


def _write(file: h5py.File, dataset: xarray.Dataset, grid: UnstructuredGrid) -> None:
    for name, value in dataset.attrs.items():
        file.attrs[name] = value if isinstance(value, str) else json.dumps(value, default=str)
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
    """Destination of a variable in the file."""

    root: h5py.Group
    name: str
    steps: int

    def once(self, where: str, values: Array) -> None:
        """Write values that are valid for every step. Each entry of field data is a tuple of
        VTK."""
        self.root[f"{where}/{self.name}"] = values
        self._from(where, np.zeros(self.steps, int), values)

    def each(self, where: str, rows: Iterator[Array]) -> None:
        """Write values for each step. Values that do not change from one step to the next are
        stored once."""
        last: Array | None = None
        starts, start, length, array = list[int](), 0, 0, None
        for values in rows:
            if last is None or not np.array_equal(values, last, equal_nan=values.dtype.kind == "f"):
                array = array or self._growing(where, values)
                array.resize(length + len(values), axis=0)
                array[length:] = values
                start, length, last = length, length + len(values), values
            starts.append(start)
        if last is not None:
            self._from(where, np.array(starts), last)

    def _growing(self, where: str, values: Array) -> h5py.Dataset:
        trailing = values.shape[1:]
        chunk = (max(1, min(CHUNK, len(values))), *trailing)
        return self.root.create_dataset(
            f"{where}/{self.name}",
            (0, *trailing),
            values.dtype,
            chunks=chunk,
            maxshape=(None, *trailing),
        )

    def _from(self, where: str, starts: Array, values: Array) -> None:
        self.root[f"Steps/{where}Offsets/{self.name}"] = starts
        if where == "FieldData":
            size = (values.shape[1] if values.ndim > 1 else 1, len(values))
            self.root[f"Steps/FieldDataSizes/{self.name}"] = np.tile(size, (self.steps, 1))


def _put(
    parts: Parts, values: xarray.DataArray, dims: tuple[Any, ...], grid: UnstructuredGrid
) -> None:
    """Write a variable. Variables of particles are point data, variables of bonds are cell data,
    and all other variables are field data."""
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
    """Write `part`, the kind of each cell. With fracture, also write which cells are broken at each
    step. A polygon counts as broken as soon as the first bond between its corners has broken."""
    Parts(parts.root, "part", parts.steps).once("CellData", grid.part)
    if grid.broken_step is None:
        return
    broken, steps = grid.broken_step, dataset["time"].values
    Parts(parts.root, "broken_step", parts.steps).once("CellData", broken)
    states = (broken_by(broken, step).astype("u1") for step in steps)
    parts.each("CellData", states)


def _blocks(values: xarray.DataArray) -> Iterator[tuple[int, Array]]:
    """Generate (first step, values) for a few steps at a time."""
    steps = values.sizes["time"]
    block = max(1, BLOCK_BYTES * steps // max(1, values.nbytes))
    for begin in range(0, steps, block):
        yield begin, values.isel(time=slice(begin, begin + block)).values


def _in_space(values: Array) -> Array:
    """Pad vectors to three components."""
    missing = 3 - values.shape[-1]
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, missing)])
