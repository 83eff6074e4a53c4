"""The program `pbdkit`, also started by ``python -m pbdkit``."""

from __future__ import annotations

import gc
import os
import signal
from contextlib import suppress

COLLECT_AFTER = 300_000
"""Number of new objects after which the garbage collector searches for cycles. With Python's
default of 700 it runs hundreds of times while a command is imported, when nothing can be freed."""


def main() -> None:
    """Run `pbdkit.cli.main`, without a traceback if it is interrupted during imports."""
    # A KeyboardInterrupt can be lost in libraries during their import, and there is nothing
    # to undo, so that the handler ends the process.
    previous = signal.signal(signal.SIGINT, _end)
    gc.set_threshold(COLLECT_AFTER)
    try:
        from pbdkit.cli import main as program

        signal.signal(signal.SIGINT, previous)
        program()
    except KeyboardInterrupt:
        _end()


def _end(*_: object) -> None:
    with suppress(OSError):
        os.write(2, b"pbdkit: interrupted\n")
    os._exit(130)


if __name__ == "__main__":
    main()
