"""The seal of a result: digests of its bytes, block by block, behind the last one that HDF5 uses.

Whoever reads the file through `SealedFile` gets no byte that was not checked just before, so that a
flipped bit reaches neither the HDF5 library nor anybody's figures. Other programs read the file as
if the seal were not there.
"""

from __future__ import annotations

import io
import os
import struct
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import xxhash
from numpy.typing import NDArray

from pbdkit.errors import StorageError

BLOCK = 2**18
"""Bytes a digest: what is read at least to read anything."""
MARK = b"pbdkit seal 1\n\0\0"
FOOT = struct.Struct("<QQ16s16s")
"""Bytes of content, bytes a block, digest of all this and of the digests, mark."""


class Seal(NamedTuple):
    """The digest of every block of so many bytes of content."""

    size: int
    block: int
    digests: NDArray[np.uint64]

    def to_bytes(self) -> bytes:
        """As it stands at the end of the file."""
        digests = self.digests.astype("<u8").tobytes()
        own = xxhash.xxh3_128_digest(digests + struct.pack("<QQ", self.size, self.block))
        return digests + FOOT.pack(self.size, self.block, own, MARK)


class BrokenSealError(OSError):
    """A block of a file is not what was written."""


def seal(path: Path) -> None:
    """Puts digests of a finished file behind its content. Raises OSError."""
    with path.open("r+b", buffering=0) as file:
        size = file.seek(0, os.SEEK_END)
        blocks = range(-(-size // BLOCK))
        digests = np.array([_digest(_read(file, k, BLOCK, size)) for k in blocks], np.uint64)
        file.seek(size)
        file.write(Seal(size, BLOCK, digests).to_bytes())


def seal_of(file: BinaryIO) -> Seal | None:
    """The seal of an open file; None where it has none. Raises BrokenSealError."""
    whole = file.seek(0, os.SEEK_END)
    if whole < FOOT.size:
        return None
    file.seek(whole - FOOT.size)
    size, block, own, mark = FOOT.unpack(file.read(FOOT.size))
    if mark != MARK:
        return None
    length = 8 * -(-size // block) if block else 0
    if not block or size + length + FOOT.size != whole:
        raise BrokenSealError("its seal is damaged")
    file.seek(size)
    digests = file.read(length)
    if xxhash.xxh3_128_digest(digests + struct.pack("<QQ", size, block)) != own:
        raise BrokenSealError("its seal is damaged")
    return Seal(size, block, np.frombuffer(digests, "<u8"))


class SealedFile(io.RawIOBase):
    """The content of a sealed file, every block checked before the first byte of it is given out.

    Raises BrokenSealError, with the place, as it is read.
    """

    def __init__(self, file: BinaryIO, seal: Seal) -> None:
        self._file, self._seal = file, seal
        self._place = 0
        self._checked = np.zeros(len(seal.digests), bool)

    def readable(self) -> bool:
        """It is."""
        return True

    def seekable(self) -> bool:
        """It is."""
        return True

    def tell(self) -> int:
        """The byte to be read next."""
        return self._place

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """As of any file; the end is that of the content."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self._seal.size}[whence]
        self._place = max(0, start + offset)
        return self._place

    def readinto(self, buffer: Any) -> int:
        """Reads what is checked, or checks it."""
        view = memoryview(buffer).cast("B")
        view = view[: max(0, min(len(view), self._seal.size - self._place))]
        if not view:
            return 0
        self.check(self._place, self._place + len(view))
        self._file.seek(self._place)
        count = io.BufferedIOBase.readinto(self._file, view)  # type: ignore[arg-type]
        self._place += count
        return count

    def check(self, start: int, stop: int) -> None:
        """Checks all blocks that lie between two bytes, or partly so."""
        size, block, digests = self._seal
        first, end = start // block, -(-stop // block)
        for k in first + np.flatnonzero(~self._checked[first:end]):
            if _digest(_read(self._file, int(k), block, size)) != digests[k]:
                raise BrokenSealError(f"bytes {k * block} to {min(size, (k + 1) * block)} changed")
            self._checked[k] = True

    def close(self) -> None:
        """Closes the file below, too."""
        self._file.close()
        super().close()
