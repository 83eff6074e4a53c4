"""The program `pbdkit`, which ``python -m pbdkit`` is too."""

from __future__ import annotations

import gc
import os
import signal
from contextlib import suppress

COLLECT_AFTER = 300_000
"""Number of new objects after which the garbage collector looks for cycles. Python's own 700 make
it look hundreds of times while a command is loaded, when nothing can be freed."""


def main() -> None:
    """Run `pbdkit.cli.main`, without a traceback where it is interrupted while it is loaded."""
    # An exception can be lost in what libraries do as they are imported; nothing is to be undone.
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
