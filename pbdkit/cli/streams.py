"""Standard output, standard error and the current folder while the program runs."""

from __future__ import annotations

import errno
import io
import os
import sys
from collections.abc import Iterator
from contextlib import chdir, contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

from pbdkit.errors import PbdkitError, StorageError, WriteError, reason_of


class NoReaderError(PbdkitError):
    """The reader of standard output has closed it, as the command `head` does. This is not an error
    of the program."""

    exit_status, is_reported = 0, True


@contextmanager
def standard_streams() -> Iterator[None]:
    """Handle failures to write to standard output and standard error within the block, so that the
    exit status remains meaningful.

    A failed write to standard output raises WriteError, or NoReaderError if the reader has closed
    it. A failed write to standard error is ignored. A standard descriptor that is closed is opened
    on the null device. Otherwise the next file would get its number, and other programs and
    libraries would write to this file. Streams that replace those of Python are kept.
    """
    if os.name != "posix":
        yield
        return
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDONLY), True)
    previous = sys.stdout, sys.stderr
    if sys.stdout is sys.__stdout__:
        sys.stdout = _stream(sys.stdout, _Output)
    if sys.stderr is sys.__stderr__:
        sys.stderr = _stream(sys.stderr, _Errors)
    try:
        yield
    finally:
        with suppress(Exception):
            sys.stdout.flush()
        sys.stdout, sys.stderr = previous


@contextmanager
def restoring_folder() -> Iterator[None]:
    """Return to the current folder after the block, because plugins may change the folder when they
    are imported.

    Raises
    ------
    StorageError
        If there is no current folder.
    """
    try:
        folder = Path.cwd()
    except OSError as error:
        raise StorageError(f"the current folder: {error.strerror}") from None
    with chdir(folder):
        yield


def _stream(standard: TextIO | None, kind: type[io.FileIO]) -> TextIO:
    """Return a stream that behaves like a standard stream of Python. If the standard stream is
    closed, each write fails."""
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
    """Stream that raises the first failure of a write, and ignores further writes."""

    _failed = False

    def write(self, data: Any) -> int:
        """Write data. At the first failure, raise NoReaderError or WriteError."""
        if self._failed:
            return len(data)
        try:
            return super().write(data)
        except OSError as error:
            self._failed = True
            if isinstance(error, BrokenPipeError):
                raise NoReaderError("standard output has no reader") from None
            reason = "is closed" if error.errno == errno.EBADF else reason_of(error)
            raise WriteError(f"standard output: {reason}") from None


class _Errors(io.FileIO):
    """Stream that ignores failures of writes."""

    def write(self, data: Any) -> int:
        """Write data. A failure is ignored."""
        try:
            return super().write(data)
        except OSError:
            return len(data)
