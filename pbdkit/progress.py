"""Display of progress by a bar or a line of text, and cancellation by signals."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

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
        Name of the load increment, which precedes the description. Empty if there is only one.
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
        """Report the completed fraction of a task; by default the task is that of the last report.

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
    """Show progress after a delay of `DELAY_S` seconds, until the block ends.

    A bar is drawn on stderr. In a notebook a bar would need further packages, so that a line of
    text is updated instead.

    Parameters
    ----------
    wanted
        Whether anything is shown.

    Yields
    ------
    callable
        Function that receives the description of a task and the fraction that is done.
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
        from rich import console, progress

        self._bar = progress.Progress(console=console.Console(file=sys.stderr), transient=True)
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
        """Clear the line of text."""
        self._write("")

    def _write(self, text: str) -> None:
        sys.stdout.write("\r" + text.ljust(self._length) + ("" if text else "\r"))
        sys.stdout.flush()
        self._length = len(text)


def in_notebook() -> bool:
    """Return whether the code runs in a kernel of a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return hasattr(shell, "kernel")


@contextmanager
def waiting(task: str, *, silent: bool = False) -> Iterator[Callable[[str], None]]:
    """Show a task and its duration on stderr from one second after the start to the end of the
    block.

    Nothing is shown if `silent`, or if stderr is no terminal.

    Yields
    ------
    callable
        Function that replaces the description of the task.
    """
    if silent or not sys.stderr.isatty():
        yield lambda task: None
        return
    line = _line(task)
    timer = threading.Timer(DELAY_S, line.start)
    timer.daemon = True
    timer.start()
    try:
        yield lambda task: line.update(line.task_ids[0], description=task)
    finally:
        timer.cancel()
        timer.join()
        if line.live.is_started:
            line.stop()


def _line(task: str) -> Any:
    from rich import console, progress

    columns = (
        progress.SpinnerColumn(),
        progress.TextColumn("{task.description}", markup=False),
        progress.TimeElapsedColumn(),
    )
    line = progress.Progress(*columns, console=console.Console(file=sys.stderr), transient=True)
    line.add_task(task, total=None)
    return line


SIGNAL_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1")
"""Signals that end a run. Some of them do not exist on every system.

They are sent by Ctrl-C, by a request for termination, when a terminal is closed, and by batch
systems before the time limit.
"""


class Stop:
    """Request to stop the process by a signal. A call returns whether there was a request."""

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None

    def __call__(self) -> bool:
        """Return whether there was a request to stop."""
        return self.signal is not None

    @property
    def exit_status(self) -> int:
        """Return 128 plus the number of the signal. The result is 130 for Ctrl-C."""
        return 128 + (self.signal or signal.SIGINT)


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """In the block, record signals instead of ending the process. A second Ctrl-C ends it at once.

    Outside the main thread signals cannot be handled.
    """
    stop = Stop()

    def note(number: int, frame: Any) -> None:
        if stop():
            raise KeyboardInterrupt
        stop.signal = signal.Signals(number)

    is_main_thread = threading.current_thread() is threading.main_thread()
    signals = (
        [getattr(signal, name) for name in SIGNAL_NAMES if hasattr(signal, name)]
        if is_main_thread
        else []
    )
    # A process started with `nohup` must survive the terminal.
    is_handled = {
        number: number.name != "SIGHUP" or signal.getsignal(number) is not signal.SIG_IGN
        for number in signals
    }
    numbers = [number for number in signals if is_handled[number]]
    previous = {number: signal.signal(number, note) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
