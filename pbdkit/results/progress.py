"""A progress bar on a terminal, for what takes over a second."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

PATIENCE_S = 1.0
REFRESH_S = 0.1


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
