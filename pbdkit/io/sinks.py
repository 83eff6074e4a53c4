"""Sinks, to which the recorder passes a dataset under construction: the interface, a sink in
memory, and a sink that writes in a second thread while the run continues.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.io.checkpoint import Checkpoint
from pbdkit.io.layout import Column, Values

if TYPE_CHECKING:
    import xarray


class Sink(ABC):
    """Destination of a dataset under construction. A sink may keep values without copying them,
    because they are not changed afterwards."""

    @abstractmethod
    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """Receive the columns, the sizes of the fixed dimensions, and the planned lengths of the
        growing dimensions."""

    @abstractmethod
    def put(self, values: Values) -> None:
        """Receive one entry of each growing column, or all values of columns that do not grow."""

    @abstractmethod
    def finish(self, attributes: dict[str, str]) -> None:
        """Receive the attributes and complete the dataset."""

    @abstractmethod
    def abandon(self) -> None:
        """Discard the dataset, because the run failed."""


class KeepingSink(Sink):
    """A sink that stores checkpoints, from which the run can be resumed."""

    @abstractmethod
    def due(self) -> bool:
        """Return whether a checkpoint is due."""

    @abstractmethod
    def keep(self, checkpoint: Checkpoint) -> None:
        """Store a checkpoint with the values received so far. It is preserved if `abandon` is
        called."""

    @abstractmethod
    def suspend(self, checkpoint: Checkpoint) -> None:
        """Store a checkpoint and stop. The run can be resumed later."""

    @abstractmethod
    def keep_final(self, checkpoint: Checkpoint) -> None:
        """Store the final state before `finish`, so that the run can be continued to more steps."""


class MemorySink(Sink):
    """A dataset in memory, with the `columns` and `sizes` received by `begin`."""

    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """Begin the dataset. Nothing is allocated in advance."""
        self.columns, self.sizes = columns, sizes
        self._entries: dict[str, list[Any]] = {c.name: [] for c in columns}

    def put(self, values: Values) -> None:
        """Keep the values received."""
        for name, value in values.items():
            self._entries[name].append(value)

    def finish(self, attributes: dict[str, str]) -> None:
        """Keep the attributes received."""
        self._attributes = attributes

    def abandon(self) -> None:
        """Discard all values received."""
        self._entries = {}

    def dataset(self) -> xarray.Dataset:
        """Return the dataset as it would be read from a file."""
        import xarray

        variables = {c.name: (c.dims, self.values(c), c.attributes) for c in self.columns}
        coordinates = [c.name for c in self.columns if c.coordinate]
        return xarray.Dataset(variables, attrs=self._attributes).set_coords(coordinates)

    def values(self, column: Column, rows: Iterable[int] | None = None) -> Any:
        """Return the values of a column. If the column grows, only the entries `rows` are returned,
        by default all."""
        entries = self._entries[column.name]
        if column.grows:
            entries = entries if rows is None else [entries[row] for row in rows]
            shape = (len(entries), *(self.sizes[d] for d in column.dims[1:]))
            return np.array(entries, column.dtype).reshape(shape)
        dtype = None if column.dtype == "str" else column.dtype
        return np.asarray(entries[0] if entries else [], dtype)


LARGE_BYTES = 2**20
"""Values with fewer bytes are written directly, because a second thread would not save time."""
MAX_WAITING = 2
"""Maximum number of pending large values. If there are more, the run waits."""
MAX_CALLS = 100
"""Maximum number of pending calls. If there are more, the run waits."""


class OverlappingSink(KeepingSink):
    """Sink that passes all calls to another sink, in their order. Large values, and calls that
    follow while large values are written, are passed in a second thread.

    Errors in that thread are raised at the next call.
    """

    def __init__(self, inner: KeepingSink) -> None:
        self._inner = inner
        self._thread = ThreadPoolExecutor(1, "pbdkit-writer")
        self._waiting: deque[tuple[bool, Future[None]]] = deque()
        self._keeping: Future[None] | None = None

    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """Begin immediately, so that errors occur before the first step."""
        self._inner.begin(columns, sizes, planned)

    def put(self, values: Values) -> None:
        """Store the values, which must not be changed afterwards."""
        large = sum(np.asarray(v).nbytes for v in values.values()) >= LARGE_BYTES
        while self._waiting and self._waiting[0][1].done():
            self._waiting.popleft()[1].result()
        if self._waiting or large:
            self._submit(large, self._inner.put, values)
        else:
            self._inner.put(values)

    def due(self) -> bool:
        """Return whether a checkpoint is due and none is being stored."""
        return (self._keeping is None or self._keeping.done()) and self._inner.due()

    def keep(self, checkpoint: Checkpoint) -> None:
        """Store a copy of the checkpoint while the run continues."""
        self._keeping = self._submit(True, self._inner.keep, checkpoint.copied())

    def suspend(self, checkpoint: Checkpoint) -> None:
        """Store a checkpoint after all values are written."""
        self._end()
        self._inner.suspend(checkpoint)

    def keep_final(self, checkpoint: Checkpoint) -> None:
        """Store the final state after all values are written. After this call, only final values
        are written."""
        self._wait()
        self._inner.keep_final(checkpoint)

    def finish(self, attributes: dict[str, str]) -> None:
        """Complete the dataset after all values are written."""
        self._end()
        self._inner.finish(attributes)

    def abandon(self) -> None:
        """Discard the dataset with all pending values."""
        self._thread.shutdown(cancel_futures=True)
        self._waiting.clear()
        self._inner.abandon()

    def _submit(self, large: bool, call: Callable[[Any], None], what: Any) -> Future[None]:
        while len(self._waiting) >= MAX_CALLS or (large and self._large_ones() >= MAX_WAITING):
            self._waiting.popleft()[1].result()
        future = self._thread.submit(call, what)
        self._waiting.append((large, future))
        return future

    def _large_ones(self) -> int:
        return sum(large for large, _ in self._waiting)

    def _wait(self) -> None:
        while self._waiting:
            self._waiting.popleft()[1].result()

    def _end(self) -> None:
        self._wait()
        self._thread.shutdown()
