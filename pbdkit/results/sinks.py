"""A sink that keeps the dataset in memory, and makes an xarray.Dataset of it."""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.results.layout import Column, Values
from pbdkit.results.recorder import Sink

if TYPE_CHECKING:
    import xarray


class MemorySink(Sink):
    """Grows every column in memory."""

    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """Nothing is allocated before it comes."""
        self._columns, self._sizes = columns, sizes
        self._entries: dict[str, list[Any]] = {c.name: [] for c in columns}

    def put(self, values: Values) -> None:
        """Keeps what it is given."""
        for name, value in values.items():
            self._entries[name].append(value)

    def finish(self, attributes: dict[str, str]) -> None:
        """Keeps the attributes."""
        self._attributes = attributes

    def abandon(self) -> None:
        """Forgets everything."""
        self._entries = {}

    def dataset(self) -> xarray.Dataset:
        """The dataset as in the file."""
        import xarray

        import_module("pbdkit.results.accessor")  # gives every dataset its `pbd`
        variables = {c.name: (c.dims, self._values(c), c.attributes) for c in self._columns}
        coordinates = [c.name for c in self._columns if c.coordinate]
        return xarray.Dataset(variables, attrs=self._attributes).set_coords(coordinates)

    def _values(self, column: Column) -> Any:
        entries = self._entries[column.name]
        if column.grows:
            shape = (len(entries), *(self._sizes[d] for d in column.dims[1:]))
            return np.array(entries, column.dtype).reshape(shape)
        dtype = None if column.dtype == "str" else column.dtype
        return np.asarray(entries[0] if entries else [], dtype)


LARGE_BYTES = 2**20
"""Below this, handing over costs as much as writing."""
MOST_WAITING = 2
"""So many large values may wait to be written; then the run waits for the disk."""


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
