"""``python -m pbdkit`` is the program `pbdkit`."""

from pbdkit.cli import main

main()
