"""What whoever waits for a run is told, and whether they want it to stop; on a terminal, a bar."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

PATIENCE_S = 1.0
"""What is over by then shows no bar."""
REFRESH_S = 0.1


class StoppedError(Exception):
    """The run, or the search for an equilibrium, was asked to stop."""


class Watch:
    """Tells `show` what is being done and which share of it is, and asks `stopping` whether to go
    on. `load` names the increment of load, where there are several."""

    def __init__(
        self,
        stopping: Callable[[], bool] = lambda: False,
        show: Callable[[str, float], None] = lambda what, share: None,
    ) -> None:
        self.load, self._what = "", ""
        self.stopping, self._show = stopping, show

    def begin(self, what: str) -> None:
        """Something else is done from now on. Raises StoppedError."""
        self.look(0.0, what)

    def look(self, share: float, what: str = "") -> None:
        """So much is done, of `what` or of what was begun last. Raises StoppedError."""
        self._what = what or self._what
        if self.stopping():
            raise StoppedError
        self._show(self.load + self._what, min(1.0, max(0.0, share)))


@contextmanager
def progress_bar(wanted: bool) -> Iterator[Callable[[str, float], None]]:
    """Yields a function to be told what is done, and which share of it; it draws on stderr once a
    second has passed."""
    bar: Any = None
    due = time.perf_counter() + PATIENCE_S

    def show(what: str, done: float) -> None:
        nonlocal bar, due
        if not wanted or time.perf_counter() < due:
            return
        if bar is None:
            from rich.console import Console
            from rich.progress import Progress

            bar = Progress(console=Console(file=sys.stderr), transient=True)
            bar.start()
            bar.add_task("", total=1)
        due = time.perf_counter() + REFRESH_S
        bar.update(bar.task_ids[0], description=what, completed=done)

    try:
        yield show
    finally:
        if bar is not None:
            bar.stop()
