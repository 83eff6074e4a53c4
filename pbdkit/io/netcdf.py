"""Write a dataset to a netCDF-4 file while it is recorded. Each chunk is written once. The file
appears under its name only when it is complete. After the first second of a run, the part that has
been recorded is preserved for `resume`."""

from __future__ import annotations

import errno
import json
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from pbdkit.array_types import Array
from pbdkit.errors import StorageError, WriteError, reason_of
from pbdkit.io.atomic_file import FULL, Destination, is_full
from pbdkit.io.checkpoint import Checkpoint
from pbdkit.io.layout import Column, Values, When
from pbdkit.io.paged_file import PagedFile, PiecedArray
from pbdkit.io.run_store import UnfinishedRun, damage_error
from pbdkit.io.seal import is_whole
from pbdkit.io.sinks import KeepingSink
from pbdkit.scene.memory_estimate import CHUNK_BYTES, OPEN_CHUNK

LEVEL = 1
"""Compression level of zlib. For positions, higher levels take much more time and reduce the size
little."""
LABELS = "coordinates"
"""Attribute of the CF conventions that lists coordinates with a name other than that of a
dimension. xarray reads it, too."""
FIRST_LENGTH = 1024
"""Initial length of a growing dimension."""

Waiting = dict[str, list[Array]]
"""For each column, the buffered entries, which do not yet fill a chunk."""


class NetcdfFile:
    """File to which the columns of a dataset are written while a run continues. Its state
    consists of the buffered entries (`waiting`) and of the number of entries of each column that
    are in the file (`written`)."""

    def __init__(self, file: PagedFile, columns: list[Column], *, compress: bool = False) -> None:
        self.file, self._compress = file, compress
        self._h5: Any = None
        self._content: Any = None
        self._columns = {column.name: column for column in columns}
        self.waiting: Waiting = {column.name: [] for column in columns if column.grows}
        self.written = dict.fromkeys(self.waiting, 0)

    def make(self, sizes: Mapping[str, int], planned: Mapping[str, int]) -> None:
        """Define the variables in an empty file."""
        self._open("w")
        self._batch: dict[str, int] = {}
        grow = dict.fromkeys(d for column in self._columns.values() for d in column.dims)
        self._content.dimensions = {dim: sizes.get(dim) or None for dim in grow}
        for column in self._columns.values():
            self._define(column, sizes, planned)

    def reopen(self, waiting: Waiting, written: Mapping[str, Any]) -> None:
        """Continue with a file in the state of its last commit. Raises StorageError if the file
        contains fewer entries than `written`."""
        self.waiting |= waiting
        self.written |= written
        self._open("r+")
        for name, rows in written.items():
            if not (isinstance(rows, int) and 0 <= rows <= self._content[name].shape[0]):
                raise StorageError(f"the store does not contain {rows!r} entries of '{name}'")
        self._batch = {name: self._content[name].chunks[0] for name in self.written}

    def put(self, values: Values) -> None:
        """Write values; growing columns are buffered until a chunk is full."""
        for name, value in values.items():
            if self._columns[name].grows:
                is_streamed = isinstance(value, PiecedArray) and self._batch[name] == 1
                self.waiting[name].append(value if is_streamed else np.asarray(value))
                if len(self.waiting[name]) >= self._batch[name]:
                    self._append(name)
            else:
                self._store(self._columns[name], value)

    def flush(self) -> None:
        """Write all data except the buffered entries to the file and its pages."""
        self._h5.flush()

    def finish(self, attributes: Mapping[str, str]) -> None:
        """Write the buffered entries and close the file."""
        for name in self.waiting:
            if self.waiting[name]:
                self._append(name)
        for dim, grown in self._content.dimensions.items():
            along = [n for n in self.written if self._columns[n].dims[0] == dim]
            if along and grown.size:
                self._content.resize_dimension(dim, max(self.written[name] for name in along))
        values = [{*column.dims} for column in self._columns.values() if not column.coordinate]
        named = {name for dims in values for name in self._labels(dims)}
        unnamed = (name for name in self._labels({*self._content.dimensions}) if name not in named)
        self._content.attrs.update({**attributes, LABELS: " ".join(unnamed)})
        self._content.close()
        self._h5.close()

    def add_group(self, name: str, facts: str, arrays: Mapping[str, Any]) -> None:
        """Add a group with arrays and JSON facts, separate from the dataset."""
        group = self._content.create_group(name)
        group.attrs["facts"] = facts
        for key, array in arrays.items():
            dims = {f"{key}_{n}": length for n, length in enumerate(array.shape)}
            group.dimensions.update(dims)
            # Otherwise the library would choose chunks that are larger than the array if the array
            # is empty.
            heuristic = {"chunking_heuristic": "h5py"}
            variable = group.create_variable(key, tuple(dims), array.dtype, **heuristic)
            _fill(variable, array)

    def give_up(self) -> None:
        """Discard the file. No exception is raised."""
        self.file.give_up()
        for file in (self._content, self._h5):
            with suppress(Exception):
                file.close()

    def _open(self, mode: str) -> None:
        hdf5_file, h5netcdf = import_module("pbdkit.io.hdf5_file"), import_module("h5netcdf")
        self._h5 = hdf5_file.Hdf5File(self.file, mode, track_order=True)
        self._content = h5netcdf.File(self._h5, mode)

    def _define(self, column: Column, sizes: Mapping[str, int], planned: Mapping[str, int]) -> None:
        options: dict[str, Any] = {}
        if column.grows:
            options["chunks"] = _chunks(column, sizes, planned)
            self._batch[column.name] = options["chunks"][0]
        elif not all(sizes.get(dim) for dim in column.dims):
            options["chunks"] = tuple(sizes.get(dim) or OPEN_CHUNK for dim in column.dims)
        if self._compress and column.dtype != "str" and column.dims:
            options |= {"compression": "gzip", "compression_opts": LEVEL, "shuffle": True}
        if column.grows:
            dim = column.dims[0]
            self._lengthen(dim, min(FIRST_LENGTH, planned[dim]))
        dtype = import_module("h5py").string_dtype() if column.dtype == "str" else column.dtype
        attributes = column.attributes
        # xarray writes truth values in the same way, because netCDF has no type for them.
        if column.dtype == "bool":
            dtype, attributes = "i1", attributes | {"dtype": "bool"}
        variable = self._content.create_variable(column.name, column.dims, dtype, **options)
        variable.attrs.update(attributes)
        if not column.coordinate and (labels := self._labels({*column.dims})):
            variable.attrs[LABELS] = " ".join(labels)

    def _labels(self, dims: set[str]) -> list[str]:
        """Return those coordinates along the given dimensions of which the name is not that of a
        dimension."""
        of_others = (c for c in self._columns.values() if c.coordinate and c.dims != (c.name,))
        return [column.name for column in of_others if dims.issuperset(column.dims)]

    def _lengthen(self, dim: str, length: int) -> None:
        if self._content.dimensions[dim].size < length:
            self._content.resize_dimension(dim, length)

    def _append(self, name: str) -> None:
        """Write the buffered entries of a column as one chunk along its first dimension."""
        entries, begin = self.waiting[name], self.written[name]
        variable, dim = self._content[name], self._columns[name].dims[0]
        if (end := begin + len(entries)) > self._content.dimensions[dim].size:
            self._lengthen(dim, 2 * end)
        dataset = variable._h5ds
        for first, part in _parts(entries, dataset.chunks):
            place = (begin, first, *(0,) * part.ndim)[: part.ndim]
            part = part.astype(dataset.dtype, copy=False)
            self._write_chunk(dataset, place, _padded(part, dataset.chunks))
        self.written[name], self.waiting[name] = end, []

    def _write_chunk(self, dataset: Any, place: tuple[int, ...], chunk: Array) -> None:
        data: Any = np.ascontiguousarray(chunk)
        # Bytes of equal significance are stored together, in the same way as by HDF5's shuffle
        # filter.
        if dataset.compression:
            planes = data.reshape(-1).view(np.uint8).reshape(-1, data.itemsize).T
            data = np.frombuffer(zlib.compress(planes.tobytes(), LEVEL), np.uint8)
        self.file.values_bytes = data.nbytes
        dataset.id.write_direct_chunk(place, data.reshape(-1))
        self.file.values_bytes = -1

    def _store(self, column: Column, value: Any) -> None:
        """Write a column that does not grow."""
        variable = self._content[column.name]
        if column.dtype == "str":
            variable[...] = np.asarray(value, dtype=object)
            return
        values = value if isinstance(value, PiecedArray) else np.asarray(value, variable.dtype)
        if column.when is When.END and column.dims and variable.shape != values.shape:
            for dim, length in zip(column.dims, values.shape, strict=True):
                self._lengthen(dim, length)
        _fill(variable, values)


def _fill(variable: Any, values: Array | PiecedArray) -> None:
    """Write all values of a variable."""
    if isinstance(values, PiecedArray):
        for place, tile in values.tiles(CHUNK_BYTES):
            variable[place] = tile
    elif values.size:
        variable[...] = values


def _parts(entries: list[Any], chunks: tuple[int, ...]) -> Iterator[tuple[int, Array]]:
    """Generate the chunks of entries of shape (entry, ...) along their first dimension, and the
    position at which each chunk starts."""
    if isinstance(entries[0], PiecedArray):
        for n, rows in enumerate(entries[0].rows(chunks[1])):
            yield n * chunks[1], rows[None]
        return
    # A large array is stored without being copied.
    values = np.stack(entries) if len(entries) > 1 else np.asarray(entries[0])[None]
    if values.ndim == 1:
        yield 0, values
        return
    for first in range(0, max(1, values.shape[1]), chunks[1]):
        yield first, values[:, first : first + chunks[1]]


def _chunks(
    column: Column, sizes: Mapping[str, int], planned: Mapping[str, int]
) -> tuple[int, ...]:
    inner = [max(1, sizes[dim]) for dim in column.dims[1:]]
    entry = int(np.prod(inner)) * np.dtype(column.dtype).itemsize
    # All parts have about the same size, so that little padding is needed for the last one.
    if inner:
        inner[0] = -(-inner[0] // -(-entry // CHUNK_BYTES))
    return max(1, min(CHUNK_BYTES // entry, planned[column.dims[0]])), *inner


def _padded(part: Array, shape: tuple[int, ...]) -> Array:
    """Add zeros to an array so that it has the shape of a chunk."""
    if part.shape == shape:
        return part
    whole = np.zeros(shape, part.dtype)
    whole[tuple(slice(n) for n in part.shape)] = part
    return whole


FIRST_S = 1.0
"""Time in seconds before the first commit. A run that ends earlier creates no store."""
EVERY_S = 1.0
"""Minimum interval between commits in seconds."""
SHARE = 50
"""Minimum interval between commits, divided by the duration of the last commit."""
FINAL_STATE = "final_state"
"""Group of the file that contains the final state, from which a run can be continued with more
steps."""
WAITING = "waiting."
"""Prefix of the names of arrays of buffered entries in a checkpoint."""


class NetcdfSink(KeepingSink):
    """Sink that writes a temporary file in the folder of `path`. After a second, the file is
    committed and becomes the records of an unfinished run. `finish` renames it to `path`. `origin`
    are the arguments of the command.

    Raises StorageError if a write fails; earlier commits are preserved.
    """

    def __init__(
        self,
        path: Path,
        replace: bool = False,
        compression: str = "none",
        *,
        origin: Mapping[str, Any] | None = None,
        first_s: float = FIRST_S,
    ) -> None:
        self._destination = Destination(path, replace=replace)
        self._compress, self._first_s = compression == "zlib", first_s
        self._origin = {"replace": replace, **(origin or {})}
        self._file: NetcdfFile | None = None
        self.unfinished: UnfinishedRun | None = None

    @property
    def written(self) -> Path:
        """Path of the finished result: `path` or, if this name was in use, another name in the same
        folder."""
        return self._destination.written

    @property
    def has_checkpoint(self) -> bool:
        """Return whether there is a checkpoint to resume from."""
        return self.unfinished is not None and self.unfinished.has_checkpoint

    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """Open the file, so that errors occur before the first step."""
        path = self._destination.path
        if not path.absolute().parent.is_dir():
            raise StorageError(f"{path}: there is no folder {path.parent}")
        with self._storing():
            disk = self._destination.temporary()
            self._temporary = Path(disk.name)
            self._file = NetcdfFile(PagedFile(disk), columns, compress=self._compress)
            self._file.make(sizes, planned)
        self._next = time.perf_counter() + self._first_s

    def go_on(
        self,
        unfinished: UnfinishedRun,
        checkpoint: Checkpoint,
        columns: list[Column],
        compression: str,
    ) -> None:
        """Continue an unfinished run instead of beginning one."""
        self.unfinished, self._temporary = unfinished, unfinished.records
        file = unfinished.file(read_only=False)
        file.verify()
        with self._storing():
            file.forget()
            self._file = reopen_dataset(file, columns, checkpoint, compress=compression == "zlib")
        self._next = time.perf_counter() + EVERY_S

    def conclude(self, unfinished: UnfinishedRun) -> None:
        """Complete a finished run that has no result file yet."""
        self.unfinished, self._temporary = unfinished, unfinished.records
        file, status = unfinished.file(read_only=False), unfinished.facts["finished"]
        with self._storing():
            finalized = is_whole(file.disk)
            if finalized and not file.is_finalized():
                raise damage_error(unfinished.records, "its content belongs to another result")
            self._complete(file, status, finalized=finalized)

    def put(self, values: Values) -> None:
        """Write values to the file, chunk by chunk."""
        with self._storing() as file:
            file.put(values)

    def due(self) -> bool:
        """Return whether a commit is due. The first commit is due after a second, and further
        commits about once a second."""
        return time.perf_counter() >= self._next

    def keep(self, checkpoint: Checkpoint) -> None:
        """Commit a checkpoint. It is preserved if the process is killed or the machine stops."""
        start = time.perf_counter()
        with self._storing() as file:
            if self.unfinished is None:
                output, disk = self._destination.path.absolute(), file.file.disk
                self.unfinished = UnfinishedRun.begin(output, self._temporary, disk)
                self._temporary = self.unfinished.records
            file.flush()
            checkpoint = checkpoint.with_origin(self._origin)
            self.unfinished.keep(checkpoint, file.file, file.waiting, file.written)
        end = time.perf_counter()
        self._next = end + max(EVERY_S, SHARE * (end - start))

    def suspend(self, checkpoint: Checkpoint) -> None:
        """Commit a checkpoint and close the file."""
        self.keep(checkpoint)
        self.abandon()

    def keep_final(self, checkpoint: Checkpoint) -> None:
        """Write the final state as a group of the file."""
        with self._storing() as file:
            file.add_group(FINAL_STATE, json.dumps(checkpoint.facts), checkpoint.arrays)

    def finish(self, attributes: dict[str, str]) -> None:
        """Complete the file: seal and sync it, read it back, rename it, and remove the store."""
        with self._storing() as file:
            file.finish(attributes)
            file.file.check()
            if self.unfinished:
                self.unfinished.conclude(file.file, attributes["status"])
            self._complete(file.file, attributes["status"])

    def _complete(self, file: PagedFile, status: str, *, finalized: bool = False) -> None:
        """Verify a complete file, write its pages, and rename it. Raises OSError."""
        if not finalized:
            file.verify()
            file.finalize()
        try:
            self._destination.take(self._temporary, status)
        finally:
            if self.unfinished and self._destination.is_synced:
                self.unfinished.remove()
            file.disk.close()

    def abandon(self) -> None:
        """Remove the file. If it belongs to an unfinished run, remove only the part that was
        written after the last commit."""
        if self._file is None:
            return
        self._file.give_up()
        if self.unfinished:
            self.unfinished.close()
        else:
            self._file.file.disk.close()
            with suppress(OSError):
                self._temporary.unlink(missing_ok=True)

    @contextmanager
    def _storing(self) -> Iterator[Any]:
        path = self._destination.path
        try:
            yield self._file
            if self._file:
                self._file.file.check()
        except StorageError:
            self.abandon()
            raise
        except (OSError, RuntimeError, ValueError) as error:
            reason = self._reason(error)
            self.abandon()
            raise WriteError(f"{path}: cannot be written: {reason}") from None

    def _reason(self, error: Exception) -> str:
        """Return the error of the disk if there is one, because the messages of the library are not
        informative."""
        try:
            if self._file:
                self._file.file.check()
        except OSError as first:
            error = first
        full = is_full(self._destination.path.absolute().parent)
        if full or getattr(error, "errno", None) == errno.ENOSPC:
            return FULL
        return reason_of(error) if isinstance(error, OSError) else str(error)


def reopen_dataset(
    file: PagedFile, columns: list[Column], checkpoint: Checkpoint, *, compress: bool
) -> NetcdfFile:
    """Return the dataset in the file of an unfinished run, with its buffered entries."""
    dataset = NetcdfFile(file, columns, compress=compress)
    waiting = {
        name.removeprefix(WAITING): list(array)
        for name, array in checkpoint.arrays.items()
        if name.startswith(WAITING)
    }
    written = checkpoint.facts.get("written")
    if not isinstance(written, dict) or not {*waiting} <= {*written} == {*dataset.waiting}:
        raise StorageError("the dataset in the store is not that of the experiment")
    try:
        dataset.reopen({n: [np.asarray(v) for v in batch] for n, batch in waiting.items()}, written)
    except (StorageError, MemoryError):
        raise
    except Exception as error:  # The libraries raise various errors for damaged files.
        raise StorageError(f"the file in the store is damaged: {error}") from None
    return dataset
