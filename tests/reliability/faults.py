"""Faults in the calls of a process, and the state of a disk after a power cut.

`load` returns the library of faults.c, which has to be preloaded. `Disk` is a model of a folder,
in which the recorded changes of a process are repeated up to the moment of the power cut.
"""

from __future__ import annotations

import ctypes
import os
import random
import shutil
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

LIBRARY = "PBDKIT_FAULTS"
"""The variable of the environment that names the library, which is preloaded then."""
KINDS = {"eio": 1, "short": 2, "enospc": 3, "kill": 4, "memory": 5, "block": 6, "record": 7}
"""Number of each kind of fault in faults.c."""
SECTOR = 512
"""Number of bytes that a disk writes completely or not at all."""
SKIPPED = 77
"""Exit status if the faults cannot be injected on this machine."""


def load(script: str) -> Any:
    """Return the library in a process that has it; else the script is run once more in a process
    that has it, and this process ends as that does."""
    if LIBRARY in os.environ:
        library = ctypes.CDLL(os.environ[LIBRARY])
        library.faults_calls.restype = ctypes.c_long
        return library
    compiler = shutil.which("cc")
    if compiler is None or not sys.platform.startswith("linux"):
        print("skipped: the faults need Linux and a C compiler named cc")
        raise SystemExit(SKIPPED)
    with tempfile.TemporaryDirectory() as folder:
        library = str(Path(folder, "faults.so"))
        source = str(Path(__file__).with_suffix(".c"))
        options = ["-O2", "-shared", "-fPIC", "-o", library, source, "-ldl", "-lpthread"]
        subprocess.run([compiler, *options], check=True)
        more = {LIBRARY: library, "LD_PRELOAD": library, "SOURCE_DATE_EPOCH": "0"}
        command = [sys.executable, script, *sys.argv[1:]]
        done = subprocess.run(command, env=os.environ | more, check=False)
    raise SystemExit(done.returncode)


def arm(
    library: Any, folder: Path, kind: str, number: int, *, least: int = 0, log: str = ""
) -> None:
    """Inject a fault in the call of a number from now on; see faults.c."""
    library.faults_arm(
        os.fsencode(folder),
        os.fsencode(log),
        ctypes.c_size_t(least),
        ctypes.c_long(number),
        KINDS[kind],
    )


CREATE, MKDIR, WRITE, RESIZE, SYNC, LINK, RENAME, REMOVE = range(1, 9)
HEADER = struct.Struct("<4i4q")


class Change(NamedTuple):
    """One change of the disk, or one call of fsync."""

    number: int
    operation: int
    path: str
    other: str
    inode: int
    offset: int
    data: bytes


def changes(log: Path) -> Iterator[Change]:
    """Generate the changes that a process recorded, in order."""
    with log.open("rb") as file:
        while header := file.read(HEADER.size):
            operation, path, other, _, number, inode, offset, length = HEADER.unpack(header)
            names = [os.fsdecode(file.read(size)) for size in (path, other)]
            yield Change(number, operation, *names, inode, offset, file.read(length))


class File:
    """A file: its present content, what of it is on the disk, and the changes in between."""

    def __init__(self, content: bytes = b"", durable: bytes = b"") -> None:
        self.content, self.durable = bytearray(content), durable
        self.waiting: list[tuple[int, bytes | None]] = []

    def write(self, offset: int, data: bytes) -> None:
        self.waiting.append((offset, data))
        _write(self.content, offset, data)

    def resize(self, size: int) -> None:
        self.waiting.append((size, None))
        _resize(self.content, size)

    def sync(self) -> None:
        self.durable, self.waiting = bytes(self.content), []

    def torn(self, draw: random.Random) -> bytes:
        """Return the content if the disk took some of the waiting changes, and the first half of
        others, in whole sectors."""
        content = bytearray(self.durable)
        for offset, data in self.waiting:
            share = draw.choice([0.0, 0.5, 1.0])
            if data is None and share:
                _resize(content, offset)
            elif data is not None and share:
                end = offset + int(len(data) * share)
                if share < 1.0:
                    end = max(offset, end - end % SECTOR)
                _write(content, offset, data[: end - offset])
        return bytes(content)


def _write(content: bytearray, offset: int, data: bytes) -> None:
    if len(content) < offset:
        _resize(content, offset)
    content[offset : offset + len(data)] = data


def _resize(content: bytearray, size: int) -> None:
    del content[size:]
    content.extend(bytes(size - len(content)))


class Folder:
    """A folder: its present entries, and those that are on the disk."""

    def __init__(self) -> None:
        self.entries: dict[str, File | Folder] = {}
        self.durable: dict[str, File | Folder] = {}

    def sync(self) -> None:
        self.durable = dict(self.entries)


class Disk:
    """A folder on a disk. Contents are durable once the file is synced, and names once the folder
    is synced in which they are. What exists at the beginning is durable."""

    def __init__(self, top: Path) -> None:
        self._top = top
        self._by_inode: dict[int, File | Folder] = {}
        self.root = self._read(top)

    def _read(self, place: Path) -> Folder:
        folder = Folder()
        self._by_inode[place.stat().st_ino] = folder
        for path in place.iterdir():
            if path.is_dir():
                folder.entries[path.name] = self._read(path)
            else:
                data = path.read_bytes()
                folder.entries[path.name] = self._by_inode[path.stat().st_ino] = File(data, data)
        folder.sync()
        return folder

    def _parent(self, path: str) -> tuple[dict[str, File | Folder], str]:
        *folders, name = Path(path).relative_to(self._top).parts
        folder = self.root
        for part in folders:
            entry = folder.entries[part]
            assert isinstance(entry, Folder)
            folder = entry
        return folder.entries, name

    def repeat(self, change: Change) -> None:
        """Apply a recorded change to the model."""
        node = self._by_inode.get(change.inode)
        if change.operation in (CREATE, MKDIR):
            node = self._by_inode[change.inode] = File() if change.operation == CREATE else Folder()
            entries, name = self._parent(change.path)
            entries[name] = node
        elif change.operation in (LINK, RENAME):
            source, old = self._parent(change.other)
            entries, name = self._parent(change.path)
            same = entries.get(name) is source[old]  # then rename changes nothing
            entries[name] = source[old]
            if change.operation == RENAME and not same:
                del source[old]
        elif change.operation == REMOVE:
            entries, name = self._parent(change.path)
            del entries[name]
        elif change.operation == SYNC and node:
            node.sync()
        elif isinstance(node, File) and change.operation == WRITE:
            node.write(change.offset, change.data)
        elif isinstance(node, File) and change.operation == RESIZE:
            node.resize(change.offset)

    def lost(self, folder: Path) -> None:
        """Write what is on the disk if all that was not synced is lost: contents and names."""
        _put(self.root, folder, lambda folder: folder.durable, lambda file: file.durable)

    def torn(self, folder: Path, draw: random.Random) -> None:
        """Write what is on the disk if all names are there and some of the contents."""
        _put(self.root, folder, lambda folder: folder.entries, lambda file: file.torn(draw))

    def content(self, unseen: str) -> dict[str, bytes | None]:
        """Return the present contents by path. Files that are written through memory, with names
        that end in `unseen`, count as empty."""
        return dict(_contents(self.root, "", unseen))


def _contents(folder: Folder, place: str, unseen: str) -> Iterator[tuple[str, bytes | None]]:
    for name, entry in folder.entries.items():
        path = f"{place}/{name}"
        if isinstance(entry, Folder):
            yield path, None
            yield from _contents(entry, path, unseen)
        else:
            yield path, b"" if name.endswith(unseen) else bytes(entry.content)


def _put(node: Folder, place: Path, entries_of: Any, content_of: Any) -> None:
    written: dict[int, Path] = {}

    def put(node: Folder, place: Path) -> None:
        place.mkdir(parents=True, exist_ok=True)
        for name, entry in entries_of(node).items():
            path = place / name
            if isinstance(entry, Folder):
                put(entry, path)
            elif id(entry) in written:  # another name of the same file
                path.hardlink_to(written[id(entry)])
            else:
                path.write_bytes(content_of(entry))
                written[id(entry)] = path

    put(node, place)
