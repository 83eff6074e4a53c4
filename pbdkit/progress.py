"""Progress reporting and cancellation: a bar on a terminal, or a line in a notebook."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

DELAY_S = 1.0
"""Delay in seconds before the bar appears."""
REFRESH_S = 0.1
"""Interval in seconds between updates of a bar."""

LINE_S = 0.5
"""Interval in seconds between updates of a line in a notebook."""


class StoppedError(Exception):
    """A run, or the search for an equilibrium, was cancelled."""


class Watch:
    """Report the progress of a task, and cancel it on request.

    Parameters
    ----------
    stopping
        Function that returns whether the task is to be cancelled.
    show
        Function that shows the description of a task and the fraction that is done.

    Attributes
    ----------
    load
        Name of the load increment, if there are several; it precedes the description.
    """

    def __init__(
        self,
        stopping: Callable[[], bool] = lambda: False,
        show: Callable[[str, float], None] = lambda task, fraction: None,
    ) -> None:
        self.load, self._task = "", ""
        self.stopping, self.show = stopping, show

    def begin(self, task: str) -> None:
        """Start another task; raise StoppedError if it is cancelled."""
        self.look(0.0, task)

    def look(self, fraction: float, what: str = "") -> None:
        """Report the fraction that is done of a task, by default of the last one.

        Raises
        ------
        StoppedError
            If the task is cancelled.
        """
        self._task = what or self._task
        if self.stopping():
            raise StoppedError
        self.show(self.load + self._task, min(1.0, max(0.0, fraction)))


@contextmanager
def progress_bar(wanted: bool) -> Iterator[Callable[[str, float], None]]:
    """Show progress from the first second on, until the block ends.

    A bar is drawn on stderr. In a notebook, where bars need further packages, a line is updated.

    Parameters
    ----------
    wanted
        Whether anything is shown.

    Yields
    ------
    callable
        Function of the description of a task and the fraction that is done.
    """
    display: _Bar | _Line | None = None
    due = time.perf_counter() + DELAY_S

    def show(task: str, fraction: float) -> None:
        nonlocal display, due
        if not wanted or time.perf_counter() < due:
            return
        if display is None:
            display = _Line() if in_notebook() else _Bar()
        due = time.perf_counter() + (LINE_S if isinstance(display, _Line) else REFRESH_S)
        display.show(task, fraction)

    try:
        yield show
    finally:
        if display is not None:
            display.stop()


class _Bar:
    """A progress bar of rich on a terminal."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import Progress

        self._bar = Progress(console=Console(file=sys.stderr), transient=True)
        self._bar.start()
        self._bar.add_task("", total=1)

    def show(self, task: str, fraction: float) -> None:
        self._bar.update(self._bar.task_ids[0], description=task, completed=fraction)

    def stop(self) -> None:
        self._bar.stop()


class _Line:
    """A line of text on stdout that is overwritten."""

    def __init__(self) -> None:
        self._start, self._length = time.perf_counter() - DELAY_S, 0

    def show(self, task: str, fraction: float) -> None:
        """Write the task, its fraction and the time it has taken."""
        self._write(f"{task} {fraction:.0%} after {time.perf_counter() - self._start:.0f} s")

    def stop(self) -> None:
        """Clear the line."""
        self._write("")

    def _write(self, text: str) -> None:
        sys.stdout.write("\r" + text.ljust(self._length) + ("" if text else "\r"))
        sys.stdout.flush()
        self._length = len(text)


def in_notebook() -> bool:
    """Return whether the code runs in a kernel of a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return hasattr(shell, "kernel")
