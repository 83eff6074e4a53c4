"""Sinks of a dataset under construction: the interface, a sink in memory, and one that writes in a
second thread while the run continues.
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
    """Where a dataset goes while it is made. It may keep what it is given: nobody changes that
    afterwards."""

    @abstractmethod
    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """The columns to come, the sizes of the dimensions that do not grow, and how many entries
        are planned along those that do."""

    @abstractmethod
    def put(self, values: Values) -> None:
        """One entry for each column that grows, or the whole of a column that does not."""

    @abstractmethod
    def finish(self, attributes: dict[str, str]) -> None:
        """Nothing more comes."""

    @abstractmethod
    def abandon(self) -> None:
        """The run failed: what was put is not wanted."""


class KeepingSink(Sink):
    """A sink that keeps where the run stands, so that it can be gone on with."""

    @abstractmethod
    def due(self) -> bool:
        """Whether it is time to."""

    @abstractmethod
    def keep(self, checkpoint: Checkpoint) -> None:
        """After what was put; what is kept outlives `abandon`."""

    @abstractmethod
    def suspend(self, checkpoint: Checkpoint) -> None:
        """Keeps it; nothing more comes for now."""

    @abstractmethod
    def note_end(self, checkpoint: Checkpoint) -> None:
        """Before `finish`: from there the run can be continued to more steps."""


class MemorySink(Sink):
    """A dataset in memory; `columns` and `sizes` are those that it has begun with."""

    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """Begin; nothing is allocated before it comes."""
        self.columns, self.sizes = columns, sizes
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

        variables = {c.name: (c.dims, self.values(c), c.attributes) for c in self.columns}
        coordinates = [c.name for c in self.columns if c.coordinate]
        return xarray.Dataset(variables, attrs=self._attributes).set_coords(coordinates)

    def values(self, column: Column, rows: Iterable[int] | None = None) -> Any:
        """Return the values of a column; of one that grows those `rows`, by default all."""
        entries = self._entries[column.name]
        if column.grows:
            entries = entries if rows is None else [entries[row] for row in rows]
            shape = (len(entries), *(self.sizes[d] for d in column.dims[1:]))
            return np.array(entries, column.dtype).reshape(shape)
        dtype = None if column.dtype == "str" else column.dtype
        return np.asarray(entries[0] if entries else [], dtype)


LARGE_BYTES = 2**20
"""Below this, handing over costs as much as writing."""
MOST_WAITING, MOST_CALLS = 2, 100
"""So many large values may wait to be written, and so many calls; then the run waits."""


class OverlappingSink(KeepingSink):
    """Hands everything to another sink, in order, what is large and what comes while that is being
    written in a second thread.

    What goes wrong there is raised at the next call.
    """

    def __init__(self, inner: KeepingSink) -> None:
        self._inner = inner
        self._thread = ThreadPoolExecutor(1, "pbdkit-writer")
        self._waiting: deque[tuple[bool, Future[None]]] = deque()
        self._keeping: Future[None] | None = None

    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """At once, so that what cannot be written is known before the first step."""
        self._inner.begin(columns, sizes, planned)

    def put(self, values: Values) -> None:
        """Takes the values over: they must not be changed afterwards."""
        large = sum(np.asarray(v).nbytes for v in values.values()) >= LARGE_BYTES
        while self._waiting and self._waiting[0][1].done():
            self._waiting.popleft()[1].result()
        if self._waiting or large:
            self._hand_over(large, self._inner.put, values)
        else:
            self._inner.put(values)

    def due(self) -> bool:
        """Not while the last one is being kept."""
        return (self._keeping is None or self._keeping.done()) and self._inner.due()

    def keep(self, checkpoint: Checkpoint) -> None:
        """Beside the run, from a copy."""
        self._keeping = self._hand_over(True, self._inner.keep, checkpoint.copied())

    def suspend(self, checkpoint: Checkpoint) -> None:
        """When all is written."""
        self._end()
        self._inner.suspend(checkpoint)

    def note_end(self, checkpoint: Checkpoint) -> None:
        """When all is written; what is known at the end only comes after it."""
        self._wait()
        self._inner.note_end(checkpoint)

    def finish(self, attributes: dict[str, str]) -> None:
        """When all is written."""
        self._end()
        self._inner.finish(attributes)

    def abandon(self) -> None:
        """What waits is not written."""
        self._thread.shutdown(cancel_futures=True)
        self._waiting.clear()
        self._inner.abandon()

    def _hand_over(self, large: bool, call: Callable[[Any], None], what: Any) -> Future[None]:
        while len(self._waiting) >= MOST_CALLS or (large and self._large_ones() >= MOST_WAITING):
            self._waiting.popleft()[1].result()
        handed = self._thread.submit(call, what)
        self._waiting.append((large, handed))
        return handed

    def _large_ones(self) -> int:
        return sum(large for large, _ in self._waiting)

    def _wait(self) -> None:
        while self._waiting:
            self._waiting.popleft()[1].result()

    def _end(self) -> None:
        self._wait()
        self._thread.shutdown()
