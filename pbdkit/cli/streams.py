"""Standard output and error, for as long as the program runs."""

from __future__ import annotations

import errno
import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

from pbdkit.errors import PbdkitError, WriteError


class NoReaderError(PbdkitError):
    """Standard output goes to a program that has had enough of it, as `head` has: no fault."""

    exit_status, told = 0, True


@contextmanager
def standard_streams() -> Iterator[None]:
    """In the block a write to standard output that fails is a WriteError, or a NoReaderError, and
    one to standard error is dropped, so that the exit status stays what it is.

    Descriptors that are closed are taken, so that no other file gets their numbers, in which other
    programs and libraries would write. Streams that somebody has put in the place of Python's stay.
    """
    if os.name != "posix":
        yield
        return
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDONLY), True)
    before = sys.stdout, sys.stderr
    if sys.stdout is sys.__stdout__:
        sys.stdout = _stream(sys.stdout, _Output)
    if sys.stderr is sys.__stderr__:
        sys.stderr = _stream(sys.stderr, _Errors)
    try:
        yield
    finally:
        with suppress(Exception):
            sys.stdout.flush()
        sys.stdout, sys.stderr = before


def _stream(standard: TextIO | None, kind: type[io.FileIO]) -> TextIO:
    """Like one of Python's streams; where that is closed each write fails."""
    if standard is None:
        raw = kind(os.open(os.devnull, os.O_RDONLY), "w")
        return io.TextIOWrapper(io.BufferedWriter(raw))
    with suppress(OSError):
        standard.flush()
    raw = kind(standard.fileno(), "w", closefd=False)
    return io.TextIOWrapper(
        io.BufferedWriter(raw), standard.encoding, standard.errors, line_buffering=raw.isatty()
    )


class _Output(io.FileIO):
    """Raises its first fault; what comes after it is dropped."""

    _failed = False

    def write(self, data: Any) -> int:
        """As in any file."""
        if self._failed:
            return len(data)
        try:
            return super().write(data)
        except OSError as error:
            self._failed = True
            if isinstance(error, BrokenPipeError):
                raise NoReaderError("nobody reads standard output") from None
            reason = "is closed" if error.errno == errno.EBADF else error.strerror
            raise WriteError(f"standard output: {reason}") from None


class _Errors(io.FileIO):
    """Drops what cannot be written."""

    def write(self, data: Any) -> int:
        """As in any file."""
        try:
            return super().write(data)
        except OSError:
            return len(data)
