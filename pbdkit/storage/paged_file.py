"""The file that the HDF5 library writes into: nothing that was committed is ever overwritten."""

from __future__ import annotations

import io
import os
from bisect import bisect_right
from collections.abc import Container, Iterator, Mapping, Sequence
from typing import Any

from pbdkit.storage.file_system import write_all
from pbdkit.storage.new_file import NewFile
from pbdkit.storage.records_header import HEADER_BYTES
from pbdkit.storage.seal import BLOCK, BrokenSealError, Extent, digest, is_whole, put_seal

PAGE = 4096
LARGE_BYTES = 2**16
"""What is written in one go and is larger goes to the disk at once."""


class PagedFile(NewFile):
    """A file on the disk, and pages in memory that lie over it.

    What is large goes to the disk as it comes, behind all that was there at the last `commit`, and
    each extent of it once. All else, what the library notes of its variables, stays in memory until
    `settle`. So the bytes on the disk, with the pages, extents and size of a commit, are the file
    as it was then, whatever is written afterwards. With `read_only` everything stays in memory.

    Extents that are handed over are checked before a byte of them is given out: BrokenSealError.
    """

    def __init__(
        self,
        disk: io.FileIO,
        size: int = 0,
        pages: Mapping[int, bytes] | None = None,
        extents: Sequence[Extent] = (),
        *,
        read_only: bool = False,
    ) -> None:
        super().__init__(disk)
        self.size = size
        self.pages = {number: bytearray(page) for number, page in (pages or {}).items()}
        """By number."""
        self.extents = list(extents)
        """What lies on the disk, by place."""
        self.changed: set[int] = set()
        """The pages written since the last commit."""
        self.values_bytes = -1
        """So many bytes in one go are values, too, however few."""
        self.noted = len(self.extents)
        """So many of them were there at the last commit."""
        self._unchecked = {extent.start for extent in extents}
        self._append_from, self._place = (2**63 if read_only else size), 0

    @property
    def added(self) -> list[Extent]:
        """The extents written since the last commit."""
        return self.extents[self.noted :]

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """As in any file."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self.size}[whence]
        self._place = max(0, start + offset)
        return self._place

    def truncate(self, size: int | None = None) -> int:
        """As in any file; the disk hears of it when all is settled."""
        self.size = self._place if size is None else size
        return self.size

    def readinto(self, buffer: Any) -> int:
        """From the pages, and from the disk where there is none."""
        view = memoryview(buffer).cast("B")
        view = view[: max(0, self.size - self._place)]
        self.verify(self._place, self._place + len(view))
        view[:] = self._on_disk(self._place, len(view))
        for page, inside, outside in _overlaps(self._place, len(view), self.pages):
            view[outside] = self.pages[page][inside]
        self._place += len(view)
        return len(view)

    def write(self, data: Any) -> int:
        """To the disk what is large and new, into pages what is not."""
        view = memoryview(data).cast("B")
        values = len(view) >= LARGE_BYTES or len(view) == self.values_bytes
        to_disk = values and self._place >= self._append_from
        if to_disk:
            self._append(view)
        there = self.pages if to_disk else None
        for page, inside, outside in _overlaps(self._place, len(view), there):
            if page not in self.pages:
                self.pages[page] = bytearray(self._on_disk(page * PAGE, PAGE))
            self.pages[page][inside] = view[outside]
            self.changed.add(page)
        self._place += len(view)
        self.size = max(self.size, self._place)
        return len(view)

    def verify(self, start: int = 0, stop: int = 2**63) -> None:
        """Checks the extents that were handed over and of which bytes lie between two places, once
        each. Raises BrokenSealError."""
        if not self._unchecked:
            return
        first = bisect_right(self.extents, start, key=lambda extent: extent.stop)
        for extent in self.extents[first:]:
            if extent.start >= stop:
                return
            if extent.start in self._unchecked:
                if digest(self._on_disk(extent.start, extent.stop - extent.start)) != extent.digest:
                    where = f"bytes {extent.start} to {extent.stop}"
                    raise BrokenSealError(f"{self.disk.name}: {where} are not what was written")
                self._unchecked.discard(extent.start)

    def give_up(self) -> None:
        """Nothing more goes to the disk."""
        self.fail(OSError("given up"))

    def forget(self) -> None:
        """What was written after the last commit, by a process that was killed. Raises OSError."""
        self.disk.truncate(max((extent.stop for extent in self.extents), default=HEADER_BYTES))

    def commit(self) -> None:
        """What is there now stays: pages, extents and size were noted elsewhere."""
        self._append_from = max(self._append_from, self.size)
        self.noted, self.changed = len(self.extents), set()

    def settle(self) -> None:
        """Puts the pages in their places, seals the file, syncs it and reads all of it back. Raises
        OSError where it cannot be written, or is not what was written."""
        self.check()
        for number, page in sorted(self.pages.items()):
            self.disk.seek(number * PAGE)
            write_all(self.disk, page)
        self.disk.truncate(self.size)
        put_seal(self.disk, [self._settled(e) for e in self.extents if e.stop <= self.size])
        self.sync()
        if not is_whole(self.disk):
            raise OSError(f"{self.disk.name}: the disk gives back what was not written")

    def is_settled(self) -> bool:
        """Whether the pages are in their places on the disk, of which the seal follows the last."""
        for number, page in self.pages.items():
            length = min(PAGE, max(0, self.size - number * PAGE))
            if self._on_disk(number * PAGE, length) != page[:length]:
                return False
        return True

    def _settled(self, extent: Extent) -> Extent:
        """With the digest that it has now, should a page lie over it."""
        pages = range(extent.start // PAGE, -(-extent.stop // PAGE))
        if not any(page in self.pages for page in pages):
            return extent
        data = self._on_disk(extent.start, extent.stop - extent.start)
        return extent._replace(digest=digest(data))

    def _append(self, view: memoryview) -> None:
        self.disk.seek(self._place)
        self._write_all(view)
        for start in range(0, len(view), BLOCK):
            piece = view[start : start + BLOCK]
            place = self._place + start
            self.extents.append(Extent(place, place + len(piece), digest(piece)))
        self._append_from = self.extents[-1].stop

    def _on_disk(self, start: int, length: int) -> bytes:
        """So many bytes; zero behind the end."""
        self.disk.seek(start)
        return self.disk.read(length).ljust(length, b"\0")


def _overlaps(
    begin: int, length: int, among: Container[int] | None = None
) -> Iterator[tuple[int, slice, slice]]:
    """The pages that some bytes touch, all or those `among` some: number, part of the page, part of
    the bytes."""
    end = begin + length
    touched = range(begin // PAGE, -(-end // PAGE))
    for page in touched if among is None else [page for page in touched if page in among]:
        first, last = max(begin, page * PAGE), min(end, (page + 1) * PAGE)
        inside = slice(first - page * PAGE, last - page * PAGE)
        yield page, inside, slice(first - begin, last - begin)
