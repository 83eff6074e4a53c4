"""What a file system carries, and who else writes to a file on it."""

from __future__ import annotations

import io
import os
import shutil
import time
from contextlib import suppress
from pathlib import Path

LOCAL = {"apfs", "bcachefs", "btrfs", "ext2", "ext3", "ext4", "f2fs", "hfs", "jfs", "overlay"}
LOCAL |= {"ramfs", "reiserfs", "tmpfs", "xfs", "zfs"}
"""File systems of one machine, where SQLite's write-ahead log can share memory."""
FULL = "the disk is full; free some space, or record fewer steps"
FULL_BYTES = 2**20
TRIES, PAUSE_S = 10, 0.02


def is_local(path: Path, mounts: str = "/proc/self/mountinfo") -> bool:
    """Whether a file lies on a file system that is known to be local; False where nobody tells."""
    kinds: dict[str, str] = {}
    with suppress(OSError):
        for line in Path(mounts).read_text(errors="surrogateescape").splitlines():
            before, _, after = line.partition(" - ")
            place = os.fsencode(before.split()[4]).decode("unicode_escape").encode("latin-1")
            kinds[os.fsdecode(place)] = after.split()[0]
    folders = (str(folder) for folder in (path.resolve(), *path.resolve().parents))
    return next((kinds[folder] in LOCAL for folder in folders if folder in kinds), False)


def lock(file: io.FileIO) -> bool:
    """Locks an open file for as long as it is open. False where somebody else holds it; systems
    and file systems without locks give it to everybody."""
    try:
        import fcntl
    except ImportError:
        return True
    try:
        fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


def opened_alone(path: Path) -> io.FileIO | None:
    """An existing file, open and locked; None where somebody else writes it. Who only asks holds
    the lock for a moment, and is waited for. Raises OSError."""
    for _ in range(TRIES):
        file = io.FileIO(path, "r+b")
        with suppress(FileNotFoundError):  # it may be another one by now, or none
            if lock(file) and os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        file.close()
        time.sleep(PAUSE_S)
    return None


def is_full(folder: Path) -> bool:
    """Whether next to nothing is free where a folder lies."""
    try:
        return shutil.disk_usage(folder).free < FULL_BYTES
    except OSError:
        return False


def write_all(file: io.FileIO, data: bytes | bytearray | memoryview) -> None:
    """Writes all of it: one write may take less than it is given, above all where the disk gets
    full. Raises OSError."""
    view = memoryview(data)
    while view:
        view = view[file.write(view) :]


def sync_folder(folder: Path) -> None:
    """Makes names in a folder last, where the file system can."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
