"""File object for the HDF5 library. Committed bytes are never overwritten, and large arrays are
appended part by part."""

from __future__ import annotations

import io
import math
import os
import struct
import time
from bisect import bisect_right
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xxhash

from pbdkit.array_types import Array, Bytes
from pbdkit.errors import StorageError
from pbdkit.io.atomic_file import NewFile, write_all
from pbdkit.io.seal import BLOCK, BrokenSealError, ByteRange, digest, is_whole, put_seal

MAGIC = b"pbdkit-r"
"""First bytes of the records of an unfinished run."""
HDF5 = b"\x89HDF\r\n\x1a\n"
"""First bytes of an HDF5 file."""
LAYOUT = struct.Struct("<8s16sQ")
"""Layout of the header: the first bytes, the identity, and the number of commits."""
HEADER_BYTES = LAYOUT.size + 8
"""Length of the header with its digest. In the finished file, the header is replaced by the
superblock of HDF5, which is longer. Until then the superblock is stored in a page."""
MAX_ATTEMPTS = 3
"""Number of attempts to read a header that is being written."""
PAUSE_S = 0.02
"""Pause between two attempts, in seconds."""


class Header(NamedTuple):
    """The identity of a store, and the number of completed commits."""

    identity: bytes
    commits: int


FINALIZED = Header(b"", 1)
"""Header that is returned for a file in which the superblock of HDF5 has already replaced the
header. At least one commit precedes the replacement."""


def write_header(file: io.FileIO, header: Header) -> None:
    """Write the header into the records, given as an open file. The header fits into one sector of
    the disk. Raises OSError."""
    fields = LAYOUT.pack(MAGIC, *header)
    file.seek(0)
    write_all(file, fields + xxhash.xxh3_64_digest(fields))


def read_header(file: io.FileIO) -> Header | None:
    """Read the header of open records. Returns None if no header was written yet.

    Raises StorageError if the file begins with other bytes, and OSError if it cannot be read.
    """
    for _ in range(MAX_ATTEMPTS):
        file.seek(0)
        data = file.read(HEADER_BYTES)
        if not data.strip(b"\0"):
            return None
        if data.startswith(HDF5):
            return FINALIZED
        fields = data[: LAYOUT.size]
        if data.startswith(MAGIC) and data[LAYOUT.size :] == xxhash.xxh3_64_digest(fields):
            return Header(*LAYOUT.unpack(fields)[1:])
        time.sleep(PAUSE_S)
    raise StorageError(
        f"{file.name}: is damaged: its first bytes have changed since they were written"
    )


PAGE = 4096
"""Size of a page in bytes."""
LARGE_BYTES = 2**16
"""Number of bytes above which a single write goes to the disk immediately."""


class PagedFile(NewFile):
    """A file on the disk that is overlaid by pages in memory.

    Large writes are appended to the file on the disk, after all bytes that existed at the last
    `commit`. Such a range of bytes is called an extent and is written once. All other data, such as
    the metadata that HDF5 rewrites, remain in memory until `finalize`. The bytes on the disk and
    the pages, extents and size that were stored at a commit therefore define the file at that
    commit, independent of later writes. With `read_only` all writes remain in memory.

    An extent that is passed to the constructor is verified before any of its bytes is returned.
    BrokenSealError is raised if it is damaged.
    """

    def __init__(
        self,
        disk: io.FileIO,
        size: int = 0,
        pages: Mapping[int, bytes] | None = None,
        extents: Sequence[ByteRange] = (),
        *,
        read_only: bool = False,
    ) -> None:
        super().__init__(disk)
        self.size = size
        self.pages = {number: bytearray(page) for number, page in (pages or {}).items()}
        """Pages in memory, by number."""
        self.extents = list(extents)
        """Extents on the disk, sorted by position."""
        self.changed: set[int] = set()
        """Numbers of the pages written since the last commit."""
        self.values_bytes = -1
        """A write of this number of bytes is appended to the disk even if it is small; -1 if there
        is no such write."""
        self.noted = len(self.extents)
        """Number of extents at the last commit."""
        self._unchecked = {extent.start for extent in extents}
        self._append_from, self._place = (2**63 if read_only else size), 0

    @property
    def added(self) -> list[ByteRange]:
        """Extents written since the last commit."""
        return self.extents[self.noted :]

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Set the position, as in any file."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self.size}[whence]
        self._place = max(0, start + offset)
        return self._place

    def truncate(self, size: int | None = None) -> int:
        """Set the size. On the disk it is set by `finalize`."""
        self.size = self._place if size is None else size
        return self.size

    def readinto(self, buffer: Any) -> int:
        """Read from the pages, and from the disk where there is no page."""
        view = memoryview(buffer).cast("B")
        view = view[: max(0, self.size - self._place)]
        self.verify(self._place, self._place + len(view))
        view[:] = self._on_disk(self._place, len(view))
        for page, inside, outside in _overlaps(self._place, len(view), self.pages):
            view[outside] = self.pages[page][inside]
        self._place += len(view)
        return len(view)

    def write(self, data: Any) -> int:
        """Append large writes of new bytes to the disk, and store all other writes in pages."""
        view = memoryview(data).cast("B")
        values = len(view) >= LARGE_BYTES or len(view) == self.values_bytes
        to_disk = values and self._place >= self._append_from
        if to_disk:
            self._append(view)
        pages = self.pages if to_disk else None
        for page, inside, outside in _overlaps(self._place, len(view), pages):
            if page not in self.pages:
                self.pages[page] = bytearray(self._on_disk(page * PAGE, PAGE))
            self.pages[page][inside] = view[outside]
            self.changed.add(page)
        self._place += len(view)
        self.size = max(self.size, self._place)
        return len(view)

    def verify(self, start: int = 0, stop: int = 2**63) -> None:
        """Verify those extents passed to the constructor that overlap a range and have not been
        verified yet. Raises BrokenSealError."""
        if not self._unchecked:
            return
        first = bisect_right(self.extents, start, key=lambda extent: extent.stop)
        for extent in self.extents[first:]:
            if extent.start >= stop:
                return
            if extent.start in self._unchecked:
                if digest(self._on_disk(extent.start, extent.stop - extent.start)) != extent.digest:
                    where = f"bytes {extent.start} to {extent.stop}"
                    raise BrokenSealError(
                        f"{self.disk.name}: {where} have changed since they were written"
                    )
                self._unchecked.discard(extent.start)

    def give_up(self) -> None:
        """Stop writing to the disk."""
        self.fail(OSError("writing was abandoned"))

    def forget(self) -> None:
        """Remove the bytes that a killed process wrote after the last commit. Raises OSError."""
        self.disk.truncate(max((extent.stop for extent in self.extents), default=HEADER_BYTES))

    def commit(self) -> None:
        """Mark the present content as committed. The caller has stored its pages, extents and size
        before."""
        self._append_from = max(self._append_from, self.size)
        self.noted, self.changed = len(self.extents), set()

    def finalize(self) -> None:
        """Write the pages to their positions, seal and sync the file, and read all of it back.
        Raises OSError if it cannot be written, or differs from what was written."""
        self.check()
        for number, page in sorted(self.pages.items()):
            self.disk.seek(number * PAGE)
            write_all(self.disk, page)
        self.disk.truncate(self.size)
        put_seal(
            self.disk, [self._with_present_digest(e) for e in self.extents if e.stop <= self.size]
        )
        self.sync()
        if not is_whole(self.disk):
            raise OSError(
                f"{self.disk.name}: the bytes that the disk returns differ from those written"
            )

    def is_finalized(self) -> bool:
        """Return whether the pages are at their positions on the disk. This is so if the file has a
        seal, because the seal is written after the last page."""
        for number, page in self.pages.items():
            length = min(PAGE, max(0, self.size - number * PAGE))
            if self._on_disk(number * PAGE, length) != page[:length]:
                return False
        return True

    def _with_present_digest(self, extent: ByteRange) -> ByteRange:
        """Return an extent with its present digest, which has changed if a page overlaps the
        extent."""
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
            self.extents.append(ByteRange(place, place + len(piece), digest(piece)))
        self._append_from = self.extents[-1].stop

    def _on_disk(self, start: int, length: int) -> bytes:
        """Read from the disk. Bytes beyond the end of the file are zero."""
        self.disk.seek(start)
        return self.disk.read(length).ljust(length, b"\0")


def _overlaps(
    begin: int, length: int, among: Container[int] | None = None
) -> Iterator[tuple[int, slice, slice]]:
    """Generate the pages that overlap a byte range, optionally only the pages in `among`. A page is
    given by its number, the overlap as a slice of the page, and the overlap as a slice of the
    range."""
    end = begin + length
    touched = range(begin // PAGE, -(-end // PAGE))
    for page in touched if among is None else [page for page in touched if page in among]:
        first, last = max(begin, page * PAGE), min(end, (page + 1) * PAGE)
        inside = slice(first - page * PAGE, last - page * PAGE)
        yield page, inside, slice(first - begin, last - begin)


class PiecedArray:
    """An array of given shape and dtype that is generated in parts, `pieces`, in the order of
    memory. It can be read only once."""

    def __init__(self, shape: tuple[int, ...], dtype: np.dtype[Any], pieces: Iterable[Array]):
        self.shape, self.dtype, self.ndim = shape, dtype, len(shape)
        self.nbytes = math.prod(shape) * dtype.itemsize
        self._pieces = map(as_bytes, pieces)
        self._left: Bytes = np.empty(0, np.uint8)

    @classmethod
    def of(cls, array: Array) -> PiecedArray:
        """Return an existing array as a PiecedArray with a single part."""
        return cls(array.shape, array.dtype, [array])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        """Return the whole array."""
        whole = self._read(self.nbytes).view(self.dtype).reshape(self.shape)
        return whole if dtype is None else whole.astype(dtype, copy=False)

    def blocks(self, nbytes: int) -> Iterator[Bytes]:
        """Generate blocks of `nbytes` bytes. The last block may be shorter."""
        for at in range(0, self.nbytes, nbytes):
            yield self._read(min(nbytes, self.nbytes - at))

    def rows(self, count: int) -> Iterator[Array]:
        """Generate parts with `count` entries of the first axis. The last part may be shorter."""
        each = math.prod(self.shape[1:]) * self.dtype.itemsize
        for block in self.blocks(max(1, count * each)):
            yield block.view(self.dtype).reshape(-1, *self.shape[1:])

    def tiles(self, nbytes: int) -> Iterator[tuple[tuple[Any, ...], Array]]:
        """Generate the index and the values of tiles of about `nbytes` bytes. If the array has one
        or two axes, a tile consists of entries along the first axis; otherwise it consists of
        entries along the last but one axis."""
        *lead, count = self.shape[: max(1, self.ndim - 1)]
        inner = self.shape[len(lead) + 1 :]
        each = math.prod(inner) * self.dtype.itemsize
        step = max(1, nbytes // max(1, each))
        for at in np.ndindex(*lead):
            for first in range(0, count, step):
                last = min(first + step, count)
                values = self._read((last - first) * each).view(self.dtype)
                yield (*at, slice(first, last)), values.reshape(last - first, *inner)

    def drain(self) -> None:
        """Generate and discard the remaining parts."""
        for _ in self._pieces:
            pass

    def _read(self, nbytes: int) -> Bytes:
        """Return the next `nbytes` bytes."""
        blocks, size = [self._left], self._left.size
        while size < nbytes:
            blocks.append(next(self._pieces))
            size += blocks[-1].size
        whole = np.concatenate(blocks) if len(blocks) > 2 or blocks[0].size else blocks[-1]
        self._left = whole[nbytes:]
        return whole[:nbytes]


def as_bytes(array: Array) -> Bytes:
    """Return the bytes of an array, in memory order."""
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8)
