"""A sink that streams the dataset into a netCDF-4 file, which appears whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np

from pbdkit.errors import StorageError
from pbdkit.results.layout import Column
from pbdkit.results.recorder import Sink, Values

BATCH_BYTES = 2**20
"""Entries are written, and chunked, in batches of about so much: one particle's history and one
snapshot both stay cheap to read."""


class NetcdfSink(Sink):
    """Writes beside `path` under a temporary name; `finish` syncs it and renames it to `path`."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._temporary = path.with_name(f".pbdkit-{os.getpid()}.partial")
        self._file: Any = None

    def begin(self, columns: list[Column], sizes: dict[str, int], records: int) -> None:
        """Opens the file, so that what cannot be written is known before the first step."""
        self._columns = {c.name: c for c in columns}
        self._waiting: dict[str, list[Any]] = {c.name: [] for c in columns if c.grows}
        self._written = dict.fromkeys(self._waiting, 0)
        self._batch: dict[str, int] = {}
        if not self._path.parent.is_dir():
            raise StorageError(f"{self._path}: there is no folder {self._path.parent}")
        with self._storing():
            self._file = netCDF4.Dataset(self._temporary, "w", format="NETCDF4")
            self._file.set_fill_off()
            for dim in dict.fromkeys(d for c in columns for d in c.dims):
                self._file.createDimension(dim, sizes.get(dim))
            for column in columns:
                self._define(column, sizes, records)

    def put(self, values: Values) -> None:
        """Keeps growing columns until a batch is full."""
        for name, value in values.items():
            if not self._columns[name].grows:
                self._store(name, slice(None), value)
                continue
            self._waiting[name].append(np.array(value))
            if len(self._waiting[name]) >= self._batch[name]:
                self._flush(name)

    def finish(self, attributes: dict[str, str]) -> None:
        """Writes what waits, syncs, and gives the file its name."""
        for name in self._waiting:
            self._flush(name)
        with self._storing():
            self._file.setncatts(attributes)
            self._file.close()
            _sync(self._temporary)
            self._temporary.replace(self._path)
            _sync(self._path.parent)

    def abandon(self) -> None:
        """Removes the temporary file."""
        with suppress(Exception):
            self._file.close()
        with suppress(OSError):
            self._temporary.unlink(missing_ok=True)

    def _define(self, column: Column, sizes: dict[str, int], records: int) -> None:
        dtype: Any = str if column.dtype == "str" else column.dtype
        chunks = None
        if column.grows:
            inner = [max(1, sizes[d]) for d in column.dims[1:]]
            entry = int(np.prod(inner)) * np.dtype(column.dtype).itemsize
            self._batch[column.name] = max(1, min(BATCH_BYTES // entry, max(records, 1)))
            chunks = (self._batch[column.name], *inner)
        variable = self._file.createVariable(
            column.name, dtype, column.dims, chunksizes=chunks, fill_value=False
        )
        variable.setncatts(column.attributes)
        if "particle" in column.dims and not column.coordinate:
            variable.coordinates = "number"

    def _flush(self, name: str) -> None:
        entries, begin = self._waiting[name], self._written[name]
        if entries:
            self._store(name, slice(begin, begin + len(entries)), np.stack(entries))
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
            reason = getattr(error, "strerror", None) or error
            raise StorageError(f"{self._path}: cannot be written: {reason}") from None


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
