"""The seal of a result. It consists of digests of the bytes of the file, extent by extent, and is
appended behind the last extent that HDF5 uses. An extent is a range of bytes.

Each extent is verified immediately before it is read, so that a flipped bit reaches neither the
HDF5 library nor a figure. Extents that are not read are not verified; this saves time for files
that are larger than the memory. Other programs ignore the seal.
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
"""Maximum number of bytes to which one digest applies. At most this number of bytes is read in
addition to the requested ones."""
MARK = b"pbdkit seal 2\n\0\0"
"""Last bytes of a sealed file."""
FOOT = struct.Struct("<QQ16s16s")
"""Layout of the end of the file: the number of bytes of content, the number of digests, the digest
of these two numbers and of the table, and the mark."""
ROW = np.dtype([("stop", "<u8"), ("digest", "<u8"), ("values", "<u8")])
"""Row of the table: the end of an extent, which begins at the end of the previous extent; the
digest of the extent; and whether it contains only values, without structure of HDF5."""


class BrokenSealError(StorageError):
    """A result differs from what was written. The message contains the file and the position."""


class ByteRange(NamedTuple):
    """Bytes of a file from `start` to `stop`, which is excluded, with their digest."""

    start: int
    stop: int
    digest: int


class Seal(NamedTuple):
    """The digests of all extents of a file's content."""

    size: int
    table: NDArray[Any]

    def foot(self) -> bytes:
        """Return the bytes that follow the table."""
        counts = struct.pack("<QQ", self.size, len(self.table))
        checksum = xxhash.xxh3_128_digest(counts + self.table.tobytes())
        return FOOT.pack(self.size, len(self.table), checksum, MARK)


def digest(data: Any) -> int:
    """Return the xxh3 digest of bytes, 64 bits."""
    return int(xxhash.xxh3_64_intdigest(data))


class SealedFile(io.RawIOBase):
    """The content of a sealed file. Each extent is verified before any of its bytes is returned.

    Raises OSError, and BrokenSealError when changed bytes are read.
    """

    def __init__(self, path: Path, file: io.FileIO | None = None) -> None:
        self.path, self._file = path, file or path.open("rb", buffering=0)
        self.seal = seal_of(self._file)
        """Seal of the file; None if the file has no seal. The whole file is then content, and
        nothing is verified."""
        self._size = self.seal.size if self.seal else os.fstat(self._file.fileno()).st_size
        self._place = 0
        self._unchecked = np.ones(len(self.seal.table) if self.seal else 0, bool)

    def readable(self) -> bool:
        """Return True, because the file can be read."""
        return True

    def seekable(self) -> bool:
        """Return True, because the file supports seeking."""
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Set the position. The end of the file is the end of the content."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self._size}[whence]
        self._place = max(0, start + offset)
        return self._place

    def readinto(self, buffer: Any) -> int:
        """Read into a buffer, after verifying those extents that have not been verified yet."""
        view = memoryview(buffer).cast("B")
        view = view[: max(0, self._size - self._place)]
        self.check(self._place, self._place + len(view))
        self._file.seek(self._place)
        count = self._file.readinto(view)
        self._place += count
        return count

    def check_structure(self) -> None:
        """Verify all extents that contain structure of HDF5, because the HDF5 library does not
        check it."""
        table = self.seal.table if self.seal else np.empty(0, ROW)
        for n in np.flatnonzero(table["values"] == 0).tolist():
            self.check(int(table["stop"][n]) - 1, int(table["stop"][n]))

    def check(self, start: int = 0, stop: int | None = None) -> None:
        """Verify those extents that overlap a range and have not been verified yet. Raises
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
                raise BrokenSealError(f"{self.path}: {where} have changed since they were written")
            self._unchecked[n] = False

    def close(self) -> None:
        """Close this object and the file on the disk that it reads."""
        self._file.close()
        super().close()


def put_seal(file: io.FileIO, extents: Iterable[ByteRange] = ()) -> None:
    """Seal a finished file, which is open for reading and writing. The sorted `extents` contain
    values and have known digests, so that they are not read. Raises OSError."""
    size, extents = file.seek(0, os.SEEK_END), tuple(extents)
    values = {extent.start for extent in extents}
    rows = [(e.stop, e.digest, e.start in values) for e in _gapless(file, size, extents)]
    seal = Seal(size, np.array(rows, ROW))
    file.seek(size)
    write_all(file, seal.table.tobytes() + seal.foot())


def _gapless(file: io.FileIO, size: int, extents: tuple[ByteRange, ...]) -> Iterator[ByteRange]:
    """Generate the known extents, and new extents that fill the gaps between them."""
    place = 0
    for extent in (*extents, ByteRange(size, size, 0)):
        while place < extent.start:
            stop = min(place + BLOCK, extent.start)
            file.seek(place)
            yield ByteRange(place, stop, digest(file.read(stop - place)))
            place = stop
        if extent.stop > extent.start:
            yield extent
        place = extent.stop


def seal_of(file: io.FileIO) -> Seal | None:
    """Read the seal of an open file. Return None if the file has no seal. Raises
    BrokenSealError."""
    length = file.seek(0, os.SEEK_END)
    if length < FOOT.size:
        return None
    file.seek(length - FOOT.size)
    foot = file.read(FOOT.size)
    size, count, _, mark = FOOT.unpack(foot)
    if mark != MARK:
        return None
    if size + count * ROW.itemsize + FOOT.size == length:
        file.seek(size)
        seal = Seal(size, np.frombuffer(file.read(count * ROW.itemsize), ROW))
        stops = seal.table["stop"]
        whole_table = (stops[-1] if count else 0) == size and bool((stops[1:] > stops[:-1]).all())
        if seal.foot() == foot and whole_table:
            return seal
    raise BrokenSealError(f"{file.name}: its seal has changed since it was written")


def is_whole(file: io.FileIO) -> bool:
    """Return whether an open file is sealed and unchanged. Raises OSError."""
    try:
        with SealedFile(Path(file.name), io.FileIO(os.dup(file.fileno()))) as content:
            content.check()
            return content.seal is not None
    except BrokenSealError:
        return False


def open_sealed(path: Path, mode: str = "r") -> Any:
    """Open the content of a sealed file as an h5netcdf.File.

    Since a seal is no protection against malicious files, declarations and references are checked,
    too. StorageError is raised if they are not acceptable.
    """
    file = SealedFile(path)
    file.check_structure()
    try:
        return open_content(file)
    except StorageError as error:
        file.close()
        raise type(error)(f"{path}: {error}") from None


def open_content(file: io.RawIOBase) -> Any:
    """Open the netCDF-4 content of a Python file object as an h5netcdf.File. Raises StorageError
    for declarations or references that are not acceptable."""
    import h5netcdf

    from pbdkit.io.hdf5_file import Hdf5File

    content = Hdf5File(file, "r")
    try:
        check_declared(content, file.seek(0, os.SEEK_END))
    except BaseException:
        content.close()
        raise
    dataset = h5netcdf.File(content, "r", decode_vlen_strings=True)
    # HDF5 calls Python to read this file, and must therefore be closed before Python ends.
    weakref.finalize(dataset, content.close)
    return dataset
