"""Writing beside stepping: large values are written by a thread of their own, in order."""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress

import numpy as np

from pbdkit.results.layout import Column, Values
from pbdkit.results.recorder import Sink

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
        self._thread: ThreadPoolExecutor | None = None
        self._waiting: deque[Future[None]] = deque()

    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """At once, so that what cannot be written is known before the first step."""
        self._inner.begin(columns, sizes, planned)

    def put(self, values: Values) -> None:
        """Takes the values over: they must not be changed afterwards."""
        if self._thread is None:
            if sum(np.asarray(v).nbytes for v in values.values()) < LARGE_BYTES:
                self._inner.put(values)
                return
            self._thread = ThreadPoolExecutor(1, "pbdkit-writer")
        while len(self._waiting) >= MOST_WAITING:
            self._waiting.popleft().result()
        self._waiting.append(self._thread.submit(self._inner.put, values))

    def finish(self, attributes: dict[str, str]) -> None:
        """When all is written."""
        while self._waiting:
            self._waiting.popleft().result()
        self._end_thread()
        self._inner.finish(attributes)

    def abandon(self) -> None:
        """What waits is not written."""
        for future in self._waiting:
            future.cancel()
        while self._waiting:
            with suppress(BaseException):
                self._waiting.popleft().result()
        self._end_thread()
        self._inner.abandon()

    def _end_thread(self) -> None:
        if self._thread:
            self._thread.shutdown()
