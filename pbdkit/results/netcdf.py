"""A sink that streams the dataset into a netCDF-4 file, which appears whole or not at all, and one
that lets the run go on meanwhile."""

from __future__ import annotations

import os
import shutil
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from itertools import chain, count
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np

from pbdkit.errors import StorageError
from pbdkit.results.layout import Column, Values, When
from pbdkit.results.recorder import Sink
from pbdkit.results.seal import put_seal

CHUNK_BYTES = 2**20
"""About a chunk: several entries where they are small, a part of one where they are large. Reading
the history of a particle touches one chunk a batch, reading a snapshot little more than itself."""
OPEN_CHUNK = 1024
"""Entries a chunk along a dimension whose length is known at the end only."""
FULL_BYTES = 2**20
WHOLE = ("complete", "settled")
"""The status of results that may replace others."""
PARTIAL = "-partial"
"""Added to the name of a result that may not, where its name is taken."""
LARGE_BYTES = 2**20
"""Below this, handing over costs as much as writing."""
MOST_WAITING = 2
"""So many large values may wait to be written; then the run waits for the disk."""


class NetcdfSink(Sink):
    """Writes beside `path` under a temporary name; `finish` syncs it and renames it to `path`.

    With `replace` a whole result takes the place of what is there. What is left of a run that
    diverged, did not converge or was interrupted takes nobody's place: beside `path`, as `written`
    says.
    """

    def __init__(self, path: Path, *, replace: bool = False, compression: str = "none") -> None:
        self._path = path
        self.written = path
        """Where the result is, once it is finished: beside `path` where that was taken."""
        self._compression = {"zlib": {"compression": "zlib", "complevel": 1}}.get(compression, {})
        self._replace = replace
        name = f".{path.name[:100]}.{os.getpid()}.{id(self):x}.partial"
        self._temporary = path.with_name(name).absolute()  # whoever changes the folder meanwhile
        self._file: Any = None

    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """Opens the file, so that what cannot be written is known before the first step."""
        self._columns = {c.name: c for c in columns}
        self._waiting: dict[str, list[Any]] = {c.name: [] for c in columns if c.grows}
        self._written = dict.fromkeys(self._waiting, 0)
        self._batch: dict[str, int] = {}
        if not self._temporary.parent.is_dir():
            raise StorageError(f"{self._path}: there is no folder {self._path.parent}")
        with self._storing():
            self._file = netCDF4.Dataset(self._temporary, "w", format="NETCDF4")
            self._file.set_fill_off()
            for dim in dict.fromkeys(d for c in columns for d in c.dims):
                self._file.createDimension(dim, sizes.get(dim))
            for column in columns:
                self._define(column, sizes, planned)

    def put(self, values: Values) -> None:
        """Keeps growing columns until a batch is full."""
        for name, value in values.items():
            if not self._columns[name].grows:
                self._store(name, slice(None), value)
                continue
            self._waiting[name].append(value)
            if len(self._waiting[name]) >= self._batch[name]:
                self._flush(name)

    def finish(self, attributes: dict[str, str]) -> None:
        """Writes what waits, syncs, and gives the file its name."""
        for name in self._waiting:
            self._flush(name)
        with self._storing():
            self._file.setncatts(attributes)
            self._file.close()
            put_seal(self._temporary)
            _sync(self._temporary)
            self._give_name(attributes["status"] in WHOLE)
        with suppress(OSError):  # the result is there; some file systems cannot sync a folder
            _sync(self._temporary.parent)
        if self.written != self._path and not self._replace:
            raise StorageError(
                f"{self._path}: appeared while this run was going on and is left as it is; "
                f"this result is in {self.written}"
            )

    def _give_name(self, whole: bool) -> None:
        """Renames. Where it is asked for, a whole result replaces what is there; all else gets a
        name that is free."""
        folder, stem, suffix = self._temporary.parent, self._path.stem[:100], self._path.suffix
        partial = "" if whole else PARTIAL
        if whole and self._replace:
            self._temporary.replace(folder / self._path.name)
            return
        more = chain([] if whole else [PARTIAL], (f"{partial}-{n}" for n in count(2)))
        names = chain([self._path], (self._path.with_name(f"{stem}{m}{suffix}") for m in more))
        self.written = next(name for name in names if self._take(folder / name.name))

    def _take(self, path: Path) -> bool:
        """Whether the name was free; then it is taken."""
        try:
            os.link(self._temporary, path)
        except FileExistsError:
            return False
        except OSError:  # no hard links on this file system
            if os.path.lexists(path):
                return False
            self._temporary.rename(path)
        else:
            self._temporary.unlink()
        return True

    def abandon(self) -> None:
        """Removes the temporary file."""
        with suppress(Exception):
            self._file.close()
        with suppress(OSError):
            self._temporary.unlink(missing_ok=True)

    def _define(self, column: Column, sizes: dict[str, int], planned: dict[str, int]) -> None:
        dtype: Any = str if column.dtype == "str" else column.dtype
        chunks = None
        if column.grows:
            inner = [max(1, sizes[d]) for d in column.dims[1:]]
            entry = int(np.prod(inner)) * np.dtype(column.dtype).itemsize
            self._batch[column.name] = max(1, min(CHUNK_BYTES // entry, planned[column.dims[0]]))
            if inner:  # parts of equal size, so that the last one wastes nothing
                inner[0] = -(-inner[0] // -(-entry // CHUNK_BYTES))
            chunks = (self._batch[column.name], *inner)
        elif column.when is When.END and column.dims and column.dims[0] not in sizes:
            chunks = (OPEN_CHUNK, *(sizes[d] for d in column.dims[1:]))
        packed = self._compression if column.dtype != "str" else {}
        variable = self._file.createVariable(
            column.name, dtype, column.dims, chunksizes=chunks, fill_value=False, **packed
        )
        if column.grows:  # whole chunks go to the file as they are: a cache would only copy them
            variable.set_var_chunk_cache(size=1024, nelems=1, preemption=0.0)
        variable.setncatts(column.attributes)
        if "particle" in column.dims and not column.coordinate:
            variable.coordinates = "number"

    def _flush(self, name: str) -> None:
        entries, begin = self._waiting[name], self._written[name]
        if entries:
            # A large one is stored as it is, not copied.
            values = np.stack(entries) if len(entries) > 1 else np.asarray(entries[0])[None]
            self._store(name, slice(begin, begin + len(entries)), values)
            self._written[name] += len(entries)
            self._waiting[name] = []

    def _store(self, name: str, where: slice, values: Any) -> None:
        with self._storing():
            self._file.variables[name][where] = values

    @contextmanager
    def _storing(self) -> Iterator[None]:
        try:
            yield
        except (OSError, RuntimeError) as error:
            self.abandon()
            raise StorageError(f"{self._path}: cannot be written: {self._reason(error)}") from None

    def _reason(self, error: Exception) -> str:
        """The library says little of a full disk."""
        with suppress(OSError):
            if shutil.disk_usage(self._path.parent).free < FULL_BYTES:
                return "the disk is full; free some space, or record fewer steps"
        return str(getattr(error, "strerror", None) or error)


class OverlappingSink(Sink):
    """Hands everything to another sink, from the first large value on in a second thread.

    What goes wrong there is raised at the next call.
    """

    def __init__(self, inner: Sink) -> None:
        self._inner = inner
        self._thread = ThreadPoolExecutor(1, "pbdkit-writer")
        self._waiting: deque[Future[None]] = deque()

    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """At once, so that what cannot be written is known before the first step."""
        self._inner.begin(columns, sizes, planned)

    def put(self, values: Values) -> None:
        """Takes the values over: they must not be changed afterwards."""
        if not self._waiting and sum(np.asarray(v).nbytes for v in values.values()) < LARGE_BYTES:
            self._inner.put(values)
            return
        while len(self._waiting) >= MOST_WAITING:
            self._waiting.popleft().result()
        self._waiting.append(self._thread.submit(self._inner.put, values))

    def finish(self, attributes: dict[str, str]) -> None:
        """When all is written."""
        while self._waiting:
            self._waiting.popleft().result()
        self._thread.shutdown()
        self._inner.finish(attributes)

    def abandon(self) -> None:
        """What waits is not written."""
        self._thread.shutdown(cancel_futures=True)
        self._waiting.clear()
        self._inner.abandon()


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
