"""The seal of a result: digests of its bytes, block by block, behind the last one that HDF5 uses.

Whoever reads a file through its seal gets no byte that was not checked just before, so that a
flipped bit reaches neither the HDF5 library nor anybody's figures, and of a file larger than memory
only what is read is checked. Other programs read the file as if the seal were not there.
"""

from __future__ import annotations

import io
import os
import struct
import weakref
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xxhash
from numpy.typing import NDArray

from pbdkit.errors import StorageError

BLOCK = 2**18
"""Bytes a digest: to read anything, so many are read at least."""
MARK = b"pbdkit seal 1\n\0\0"
FOOT = struct.Struct("<QQ16s16s")
"""The end of the file: bytes of content, bytes a block, digest of both and of all digests, mark."""


class BrokenSealError(StorageError):
    """A result is not what was written; the text says which and where."""


class Seal(NamedTuple):
    """The digest of every block of some content."""

    size: int
    block: int
    digests: NDArray[np.uint64]

    def foot(self) -> bytes:
        """What stands behind the digests."""
        counts = struct.pack("<QQ", self.size, self.block)
        own = xxhash.xxh3_128_digest(counts + self.digests.tobytes())
        return FOOT.pack(self.size, self.block, own, MARK)


class SealedFile(io.RawIOBase):
    """The content of a sealed file, each block checked before the first byte of it is given out.

    Raises OSError, and BrokenSealError as soon as bytes are asked for that have changed.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._file = path, path.open("rb", buffering=0)
        self.seal = seal_of(self._file)
        """None where the file has none: then all of it is content, and nothing is checked."""
        self._size = self.seal.size if self.seal else os.fstat(self._file.fileno()).st_size
        self._place = 0
        self._unchecked = np.ones(len(self.seal.digests) if self.seal else 0, bool)

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
        """Checks the blocks that were not, and reads."""
        view = memoryview(buffer).cast("B")
        view = view[: max(0, self._size - self._place)]
        self.check(self._place, self._place + len(view))
        self._file.seek(self._place)
        count = self._file.readinto(view)
        self._place += count
        return count

    def check(self, start: int = 0, stop: int | None = None) -> None:
        """Checks the blocks of which bytes lie between two places, once each. Raises
        BrokenSealError."""
        if self.seal is None:
            return
        size, block, digests = self.seal
        first, end = start // block, -(-(size if stop is None else stop) // block)
        for n in (first + np.flatnonzero(self._unchecked[first:end])).tolist():
            if _digest(self._file, n, self.seal) != digests[n]:
                last = min(size, (n + 1) * block)
                where = f"bytes {n * block} to {last} of {size}"
                raise BrokenSealError(f"{self.path}: {where} are not what was written")
            self._unchecked[n] = False

    def close(self) -> None:
        """Closes the file on the disk, too."""
        self._file.close()
        super().close()


def put_seal(path: Path) -> None:
    """Seals a finished file. Raises OSError."""
    with path.open("r+b", buffering=0) as file:
        size = file.seek(0, os.SEEK_END)
        bare = Seal(size, BLOCK, np.zeros(-(-size // BLOCK), "<u8"))
        for n in range(len(bare.digests)):
            bare.digests[n] = _digest(file, n, bare)
        file.seek(size)
        file.write(bare.digests.tobytes() + bare.foot())


def seal_of(file: io.FileIO) -> Seal | None:
    """The seal of an open file; None where it has none. Raises BrokenSealError."""
    whole = file.seek(0, os.SEEK_END)
    if whole < FOOT.size:
        return None
    file.seek(whole - FOOT.size)
    foot = file.read(FOOT.size)
    size, block, _, mark = FOOT.unpack(foot)
    if mark != MARK:
        return None
    length = 8 * -(-size // block) if block else 0
    if block and size + length + FOOT.size == whole:
        file.seek(size)
        found = Seal(size, block, np.frombuffer(file.read(length), "<u8"))
        if found.foot() == foot:
            return found
    raise BrokenSealError(f"{file.name}: its seal is not what was written")


def _digest(file: io.FileIO, n: int, seal: Seal) -> int:
    """Of the n-th block, as it is on the disk."""
    file.seek(n * seal.block)
    return int(xxhash.xxh3_64_intdigest(file.read(min(seal.block, seal.size - n * seal.block))))


def opened(path: Path, mode: str = "r") -> Any:
    """The content of a sealed file as an h5netcdf.File."""
    import h5netcdf
    import h5py

    file = h5py.File(SealedFile(path), mode)
    found = h5netcdf.File(file, mode, decode_vlen_strings=True)
    # HDF5 reads from Python here, and no more once Python has ended: by then it must be closed.
    weakref.finalize(found, file.close)
    return found
