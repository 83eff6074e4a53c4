"""What somebody at a terminal is told while a command works."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from pbdkit.results.progress import PATIENCE_S


@contextmanager
def waiting(what: str, *, silent: bool = False) -> Iterator[Callable[[str], None]]:
    """Says on stderr what is being done, and for how long already, once a second has passed; at its
    end the line goes. Nothing where nobody looks: `silent`, or stderr is no terminal.

    Yields a function to be told what is done from then on.
    """
    if silent or not sys.stderr.isatty():
        yield lambda what: None
        return
    line = _line(what)
    timer = threading.Timer(PATIENCE_S, line.start)
    timer.daemon = True
    timer.start()
    try:
        yield lambda what: line.update(line.task_ids[0], description=what)
    finally:
        timer.cancel()
        timer.join()
        if line.live.is_started:
            line.stop()


def _line(what: str) -> Any:
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn()
    line = Progress(*columns, console=Console(file=sys.stderr), transient=True)
    line.add_task(what, total=None)
    return line
