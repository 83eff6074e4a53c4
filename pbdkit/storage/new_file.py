"""A file in the making, for libraries that cannot bear a write that fails or is cut short."""

from __future__ import annotations

import io
import os
from typing import Any

from pbdkit.storage.file_system import write_all


class NewFile(io.RawIOBase):
    """A file on the disk that is written whole, or whose first fault is noted.

    HDF5 would try a failed write again when the process ends, and crash it; other libraries drop
    what a short write left. Here every write is complete and none raises: after the first fault
    nothing more is written, and `check` raises it. There is no `fileno`, through which libraries
    would write past this.
    """

    def __init__(self, disk: io.FileIO) -> None:
        self.disk = disk
        self._fault: OSError | None = None

    def readable(self) -> bool:
        """It is."""
        return True

    def writable(self) -> bool:
        """It is."""
        return True

    def seekable(self) -> bool:
        """It is."""
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """As in any file."""
        return self.disk.seek(offset, whence)

    def truncate(self, size: int | None = None) -> int:
        """As in any file."""
        length = self.tell() if size is None else size
        if self._fault is None:
            try:
                self.disk.truncate(length)
            except OSError as error:
                self.fail(error)
        return length

    def readinto(self, buffer: Any) -> int:
        """As in any file; zeros where the disk gives nothing."""
        view = memoryview(buffer).cast("B")
        count = 0
        try:
            count = self.disk.readinto(view) or 0
        except OSError as error:
            self.fail(error)
        if self._fault:
            view[count:] = bytes(len(view) - count)
            return len(view)
        return count

    def write(self, data: Any) -> int:
        """All of it, unless there was a fault."""
        view = memoryview(data).cast("B")
        self._write_all(view)
        return len(view)

    def close(self) -> None:
        """Closes the file on the disk, too."""
        self.disk.close()
        super().close()

    def fail(self, fault: OSError) -> None:
        """Notes a fault, unless there was one before."""
        self._fault = self._fault or fault

    def check(self) -> None:
        """Raises the OSError that was met in writing, if one was."""
        if self._fault:
            raise self._fault

    def sync(self) -> None:
        """Waits until what was written is on the disk. Raises OSError."""
        self.check()
        os.fsync(self.disk.fileno())

    def settle(self) -> None:
        """Ends the writing. Raises OSError where anything of it failed."""
        self.sync()

    def _write_all(self, view: memoryview) -> None:
        if self._fault is None:
            try:
                write_all(self.disk, view)
            except OSError as error:
                self.fail(error)
