"""The program `pbdkit`, which ``python -m pbdkit`` is too."""

from __future__ import annotations

import os
import signal
from contextlib import suppress


def main() -> None:
    """As `pbdkit.cli.main`; who interrupts it while it is being loaded sees no traceback either."""
    # An exception can be lost in what libraries do as they are imported; nothing is to be undone.
    before = signal.signal(signal.SIGINT, _end)
    try:
        from pbdkit.cli import main as program

        signal.signal(signal.SIGINT, before)
        program()
    except KeyboardInterrupt:
        _end()


def _end(*_: object) -> None:
    with suppress(OSError):
        os.write(2, b"pbdkit: interrupted\n")
    os._exit(130)


if __name__ == "__main__":
    main()
