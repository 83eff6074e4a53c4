"""The signals that end a run between two steps."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1")
"""Ctrl-C, what ends a process, a terminal that closes, and the warning that batch systems send; a
system may lack some."""


class Stop:
    """Whether, and by which signal, the process was asked to stop."""

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None

    def __call__(self) -> bool:
        """Whether it was."""
        return self.signal is not None

    @property
    def exit_status(self) -> int:
        """130 for Ctrl-C, else 128 and the number of the signal."""
        return 128 + (self.signal or signal.SIGINT)


@contextmanager
def asked_to_stop() -> Iterator[Stop]:
    """Yields what tells whether the process has been asked to stop.

    A second Ctrl-C stops at once. Outside the main thread signals are not ours to handle.
    """
    stop = Stop()

    def note(number: int, frame: Any) -> None:
        if stop():
            raise KeyboardInterrupt
        stop.signal = signal.Signals(number)

    ours = threading.current_thread() is threading.main_thread()
    found = [getattr(signal, name) for name in NAMES if hasattr(signal, name)] if ours else []
    # Who starts it with `nohup` wants it to survive the terminal.
    hears = {n: n.name != "SIGHUP" or signal.getsignal(n) is not signal.SIG_IGN for n in found}
    numbers = [number for number in found if hears[number]]
    before = {number: signal.signal(number, note) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
