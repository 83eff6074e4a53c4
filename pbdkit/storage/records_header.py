"""The first bytes of the records of an unfinished run: which store they belong to, and how many
commits it holds."""

from __future__ import annotations

import io
import struct
import time
from typing import NamedTuple

import xxhash

from pbdkit.errors import StorageError
from pbdkit.storage.file_system import write_all

MAGIC = b"pbdkit-r"
HDF5 = b"\x89HDF\r\n\x1a\n"
LAYOUT = struct.Struct("<8s16sQ")
HEADER_BYTES = LAYOUT.size + 8
"""They end with a digest. HDF5's superblock, which lies here in the finished file, is longer; until
then it is in a page of the store."""
TRIES, PAUSE_S = 3, 0.02
"""A reader may meet a header that is just being written."""


class Header(NamedTuple):
    """The identity of a store, and the number of commits that returned."""

    identity: bytes
    commits: int


SETTLED = Header(b"", 1)
"""Stands for the beginning of a file that is settled for its end, which follows a commit."""


def write_header(file: io.FileIO, header: Header) -> None:
    """Write the header into open records, in one sector of the disk. Raises OSError."""
    fields = LAYOUT.pack(MAGIC, *header)
    file.seek(0)
    write_all(file, fields + xxhash.xxh3_64_digest(fields))


def read_header(file: io.FileIO) -> Header | None:
    """Read the header of open records; None where none was written yet.

    Raises StorageError where other bytes stand there, and OSError.
    """
    for _ in range(TRIES):
        file.seek(0)
        data = file.read(HEADER_BYTES)
        if not data.strip(b"\0"):
            return None
        if data.startswith(HDF5):
            return SETTLED
        fields = data[: LAYOUT.size]
        if data.startswith(MAGIC) and data[LAYOUT.size :] == xxhash.xxh3_64_digest(fields):
            return Header(*LAYOUT.unpack(fields)[1:])
        time.sleep(PAUSE_S)
    raise StorageError(f"{file.name}: is damaged: its first bytes are not what was written")
