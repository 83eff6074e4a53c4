"""What whoever waits for a run is told, and whether they want it to stop: a bar, or a line."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

PATIENCE_S = 1.0
"""What is over by then shows no bar."""
REFRESH_S, LINE_S = 0.1, 0.5
"""So often a bar, and a line in a notebook, is drawn anew."""


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
        self.stopping, self.show = stopping, show

    def begin(self, what: str) -> None:
        """Something else is done from now on. Raises StoppedError."""
        self.look(0.0, what)

    def look(self, share: float, what: str = "") -> None:
        """So much is done, of `what` or of what was begun last. Raises StoppedError."""
        self._what = what or self._what
        if self.stopping():
            raise StoppedError
        self.show(self.load + self._what, min(1.0, max(0.0, share)))


@contextmanager
def progress_bar(wanted: bool) -> Iterator[Callable[[str, float], None]]:
    """Yields a function to be told what is done, and which share of it. Once a second has passed it
    draws a bar on stderr; in a notebook, where bars need more than is installed, it writes a line
    that changes. Both are gone at the end."""
    drawn: _Bar | _Line | None = None
    due = time.perf_counter() + PATIENCE_S

    def show(what: str, done: float) -> None:
        nonlocal drawn, due
        if not wanted or time.perf_counter() < due:
            return
        if drawn is None:
            drawn = _Line() if in_notebook() else _Bar()
        due = time.perf_counter() + (LINE_S if isinstance(drawn, _Line) else REFRESH_S)
        drawn.show(what, done)

    try:
        yield show
    finally:
        if drawn is not None:
            drawn.stop()


class _Bar:
    """A bar of rich on a terminal."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import Progress

        self._bar = Progress(console=Console(file=sys.stderr), transient=True)
        self._bar.start()
        self._bar.add_task("", total=1)

    def show(self, what: str, done: float) -> None:
        """Draws it anew."""
        self._bar.update(self._bar.task_ids[0], description=what, completed=done)

    def stop(self) -> None:
        """Takes it away."""
        self._bar.stop()


class _Line:
    """One line of text on stdout, which each writing replaces."""

    def __init__(self) -> None:
        self._begun, self._length = time.perf_counter() - PATIENCE_S, 0

    def show(self, what: str, done: float) -> None:
        """Writes what is done, its share, and how long it has taken."""
        self._write(f"{what} {done:.0%} after {time.perf_counter() - self._begun:.0f} s")

    def stop(self) -> None:
        """Leaves an empty line."""
        self._write("")

    def _write(self, text: str) -> None:
        sys.stdout.write("\r" + text.ljust(self._length) + ("" if text else "\r"))
        sys.stdout.flush()
        self._length = len(text)


def in_notebook() -> bool:
    """Whether a kernel runs this, whose output goes to a page."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return hasattr(shell, "kernel")
