"""The seal of a result: digests of its bytes, extent by extent, appended behind the last extent
that HDF5 uses.

Bytes read through the seal were checked immediately before, so that a flipped bit reaches neither
the HDF5 library nor a figure, and of a file larger than memory only the extents that are read are
checked. Other programs read the file as if the seal were absent.
"""

from __future__ import annotations

import io
import os
import struct
import weakref
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xxhash
from numpy.typing import NDArray

from pbdkit.errors import StorageError
from pbdkit.io.atomic_file import write_all
from pbdkit.untrusted_files import check_declared

BLOCK = 2**20
"""Bytes a digest, at most: to read anything, so many are read at most besides."""
MARK = b"pbdkit seal 2\n\0\0"
FOOT = struct.Struct("<QQ16s16s")
"""The end of the file: bytes of content, number of digests, digest of both and of the table before
them, mark."""
ROW = np.dtype([("stop", "<u8"), ("digest", "<u8"), ("values", "<u8")])
"""A row of the table: where an extent ends, which begins where the one before ends, its digest, and
whether it holds values alone, and nothing that HDF5 says of them."""


class BrokenSealError(StorageError):
    """A result is not what was written; the text says which and where."""


class ByteRange(NamedTuple):
    """Bytes of a file, from `start` to before `stop`, with their digest."""

    start: int
    stop: int
    digest: int


class Seal(NamedTuple):
    """The digests of all the extents of some content."""

    size: int
    table: NDArray[Any]

    def foot(self) -> bytes:
        """What stands behind the table."""
        counts = struct.pack("<QQ", self.size, len(self.table))
        own = xxhash.xxh3_128_digest(counts + self.table.tobytes())
        return FOOT.pack(self.size, len(self.table), own, MARK)


def digest(data: Any) -> int:
    """Of bytes: xxh3, 64 bits."""
    return int(xxhash.xxh3_64_intdigest(data))


class SealedFile(io.RawIOBase):
    """The content of a sealed file, each extent checked before the first byte of it is given out.

    Raises OSError, and BrokenSealError as soon as bytes are asked for that have changed.
    """

    def __init__(self, path: Path, file: io.FileIO | None = None) -> None:
        self.path, self._file = path, file or path.open("rb", buffering=0)
        self.seal = seal_of(self._file)
        """None where the file has none: then all of it is content, and nothing is checked."""
        self._size = self.seal.size if self.seal else os.fstat(self._file.fileno()).st_size
        self._place = 0
        self._unchecked = np.ones(len(self.seal.table) if self.seal else 0, bool)

    def readable(self) -> bool:
        """It is."""
        return True

    def seekable(self) -> bool:
        """It is."""
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """As in any file; the end is that of the content."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self._size}[whence]
        self._place = max(0, start + offset)
        return self._place

    def readinto(self, buffer: Any) -> int:
        """Checks the extents that were not, and reads."""
        view = memoryview(buffer).cast("B")
        view = view[: max(0, self._size - self._place)]
        self.check(self._place, self._place + len(view))
        self._file.seek(self._place)
        count = self._file.readinto(view)
        self._place += count
        return count

    def check_structure(self) -> None:
        """Checks all extents that are not of values alone: what the HDF5 library believes."""
        table = self.seal.table if self.seal else np.empty(0, ROW)
        for n in np.flatnonzero(table["values"] == 0).tolist():
            self.check(int(table["stop"][n]) - 1, int(table["stop"][n]))

    def check(self, start: int = 0, stop: int | None = None) -> None:
        """Checks the extents of which bytes lie between two places, once each. Raises
        BrokenSealError."""
        if self.seal is None:
            return
        stops = self.seal.table["stop"]
        last = len(stops) if stop is None else int(np.searchsorted(stops, stop, "left")) + 1
        first = int(np.searchsorted(stops, start, "right"))
        for n in (first + np.flatnonzero(self._unchecked[first:last])).tolist():
            begin, end = int(stops[n - 1]) if n else 0, int(stops[n])
            self._file.seek(begin)
            if digest(self._file.read(end - begin)) != self.seal.table["digest"][n]:
                where = f"bytes {begin} to {end} of {self.seal.size}"
                raise BrokenSealError(f"{self.path}: {where} are not what was written")
            self._unchecked[n] = False

    def close(self) -> None:
        """Closes the file on the disk, too."""
        self._file.close()
        super().close()


def put_seal(file: io.FileIO, known: Iterable[ByteRange] = ()) -> None:
    """Seals a finished file, open for reading and writing. Extents of values whose digests are
    `known`, in their order, are not read. Raises OSError."""
    size, known = file.seek(0, os.SEEK_END), tuple(known)
    values = {extent.start for extent in known}
    rows = [(e.stop, e.digest, e.start in values) for e in _gapless(file, size, known)]
    seal = Seal(size, np.array(rows, ROW))
    file.seek(size)
    write_all(file, seal.table.tobytes() + seal.foot())


def _gapless(file: io.FileIO, size: int, known: tuple[ByteRange, ...]) -> Iterator[ByteRange]:
    """The known extents, and between them those that fill the file."""
    place = 0
    for extent in (*known, ByteRange(size, size, 0)):
        while place < extent.start:
            stop = min(place + BLOCK, extent.start)
            file.seek(place)
            yield ByteRange(place, stop, digest(file.read(stop - place)))
            place = stop
        if extent.stop > extent.start:
            yield extent
        place = extent.stop


def seal_of(file: io.FileIO) -> Seal | None:
    """The seal of an open file; None where it has none. Raises BrokenSealError."""
    whole = file.seek(0, os.SEEK_END)
    if whole < FOOT.size:
        return None
    file.seek(whole - FOOT.size)
    foot = file.read(FOOT.size)
    size, count, _, mark = FOOT.unpack(foot)
    if mark != MARK:
        return None
    if size + count * ROW.itemsize + FOOT.size == whole:
        file.seek(size)
        found = Seal(size, np.frombuffer(file.read(count * ROW.itemsize), ROW))
        stops = found.table["stop"]
        whole_table = (stops[-1] if count else 0) == size and bool((stops[1:] > stops[:-1]).all())
        if found.foot() == foot and whole_table:
            return found
    raise BrokenSealError(f"{file.name}: its seal is not what was written")


def is_whole(file: io.FileIO) -> bool:
    """Whether an open file is sealed, and all in it is as it was written. Raises OSError."""
    try:
        with SealedFile(Path(file.name), io.FileIO(os.dup(file.fileno()))) as content:
            content.check()
            return content.seal is not None
    except BrokenSealError:
        return False


def opened(path: Path, mode: str = "r") -> Any:
    """The content of a sealed file as an h5netcdf.File. Raises StorageError where it declares or
    refers to what it should not: anybody can make a seal."""
    file = SealedFile(path)
    file.check_structure()
    try:
        return opened_in(file)
    except StorageError as error:
        file.close()
        raise type(error)(f"{path}: {error}") from None


def opened_in(file: io.RawIOBase) -> Any:
    """The netCDF-4 content of a file that is read through Python, as an h5netcdf.File. Raises
    StorageError where it declares or refers to what it should not."""
    import h5netcdf
    import h5py

    content = h5py.File(file, "r")
    try:
        check_declared(content, file.seek(0, os.SEEK_END))
    except BaseException:
        content.close()
        raise
    found = h5netcdf.File(content, "r", decode_vlen_strings=True)
    # HDF5 reads from Python here, and no more once Python has ended: by then it must be closed.
    weakref.finalize(found, content.close)
    return found
