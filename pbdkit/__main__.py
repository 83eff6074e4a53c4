"""The program `pbdkit`, which ``python -m pbdkit`` is too."""

from __future__ import annotations

import sys


def main() -> None:
    """As `pbdkit.cli.main`; who interrupts it while it is being loaded sees no traceback either."""
    try:
        from pbdkit.cli import main as program

        program()
    except KeyboardInterrupt:
        sys.stderr.write("pbdkit: interrupted\n")
        sys.exit(130)


if __name__ == "__main__":
    main()
