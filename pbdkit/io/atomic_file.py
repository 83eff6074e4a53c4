"""Atomic writing of files: complete or not at all, locked against other writers, replacing an
earlier file only on request.

`NewFile` is a file under construction for libraries that do not handle a write that fails or is cut
short.
"""

from __future__ import annotations

import errno
import io
import os
import secrets
import shutil
import stat
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from glob import escape
from itertools import chain, count
from pathlib import Path
from typing import Any, TypeVar

from pbdkit.errors import WriteError

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


WHOLE = ("complete", "settled")
"""The status of results that may replace others."""
PARTIAL = "-partial"
"""Added to the name of a result that may not, where its name is taken."""
TEMPORARY = ".partial"
"""How the names of files end that are no results yet."""
RANDOM_BYTES = 8
"""In such a name, as hexadecimal digits, between that of the result and the end."""
NAME_BYTES = 100
"""Of a name so much stays at most where something is added to it: names have 255 bytes at most."""
KINDS = {stat.S_IFLNK: "a symbolic link", stat.S_IFIFO: "a pipe", stat.S_IFCHR: "a device"}
"""What may be at a path and no plain file, by the type that the system gives it."""

File = TypeVar("File", bound=NewFile)


@contextmanager
def written(path: Path, kind: type[File], *, replace: bool) -> Iterator[File]:
    """Write a file that appears under its name at the end of the block, whole and on the disk, or
    not at all; until then, and after a fault, the earlier file stands.

    Parameters
    ----------
    path
        The name; with `replace` a plain file that has it is replaced.
    kind
        The class of the file that the block writes into: `NewFile`, or `PagedFile` for a result,
        which is sealed and read back.

    Raises
    ------
    WriteError
        Where the system refuses anything, or the name belongs to a link, a pipe or a device.
    """
    with _refusing(path):
        if kind_there := kind_of(path):
            raise OSError(0, f"is {kind_there}, which is not replaced")
        destination = Destination(path, replace=replace)
        disk = destination.temporary()
    temporary = Path(disk.name)
    try:
        with disk:
            file = kind(disk)
            try:
                yield file
            finally:  # what the block raised may be what a library made of a failing write
                with _refusing(path):
                    file.check()
            with _refusing(path):
                file.settle()
                destination.take(temporary, "complete")
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write(path: Path, content: str | bytes, *, replace: bool) -> None:
    """Write a text, as UTF-8, or bytes, as `written` does."""
    data = content.encode(errors="replace") if isinstance(content, str) else content
    with written(path, NewFile, replace=replace) as file:
        file.write(data)


def write_together(contents: Mapping[Path, str | bytes]) -> None:
    """Write new files in that order, each as `write` does; where one fails none stays."""
    with ExitStack() as undo:
        for path, content in contents.items():
            write(path, content, replace=False)
            undo.callback(path.unlink, missing_ok=True)
        undo.pop_all()


def write_folder(folder: Path, texts: Mapping[str, str]) -> None:
    """Write a new folder of files, by their places in it, which appears whole or not at all.

    Raises WriteError where the system refuses anything, and where something has its name.
    """
    with _refusing(folder):
        temporary = folder.absolute().with_name(_hidden(folder.name))
        try:
            for place, text in texts.items():
                path = temporary / place
                path.parent.mkdir(parents=True, exist_ok=True)
                with io.FileIO(path, "x") as file:
                    write_all(file, text.encode())
                    os.fsync(file.fileno())
            for parent in {temporary, *((temporary / place).parent for place in texts)}:
                sync_folder(parent)
            if os.path.lexists(folder):
                raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST))
            temporary.rename(folder)
            sync_folder(folder.absolute().parent)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def kind_of(path: Path) -> str | None:
    """What else than a plain file is at a path, if anything. Raises OSError."""
    try:
        mode = path.lstat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None
    if stat.S_ISREG(mode):
        return None
    return "a folder" if stat.S_ISDIR(mode) else KINDS.get(stat.S_IFMT(mode), "no plain file")


@contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """What the system refuses in the block is a WriteError of that path."""
    try:
        yield
    except OSError as error:
        raise WriteError(f"{path}: cannot be written: {error.strerror or error}") from None


def _hidden(name: str, random: str = "") -> str:
    """The name of a file that is none yet, beside that of the result."""
    return f".{_short(name)}.{random or secrets.token_hex(RANDOM_BYTES)}{TEMPORARY}"


def _short(name: str) -> str:
    """As much of a name as leaves room for what is added to it."""
    while len(os.fsencode(name)) > NAME_BYTES:
        name = name[:-1]
    return name


class Destination:
    """A name for a result. With `replace` a whole result takes the place of what is there. What is
    left of a run that diverged or did not converge takes nobody's place: beside it."""

    def __init__(self, path: Path, *, replace: bool) -> None:
        self.path, self.replace = path, replace
        self._folder = path.parent.absolute()  # whoever changes the folder meanwhile
        self.written = path
        """Where the result is, once it has its name: beside `path` where that was taken."""

    def temporary(self) -> io.FileIO:
        """A new file beside it, under a name that no other machine takes, locked. What killed runs
        left behind under such names is removed. Raises OSError."""
        random = "[0-9a-f]" * 2 * RANDOM_BYTES
        begin, _, end = _hidden(self.path.name, "*").rpartition("*")
        for left in self._folder.glob(f"{escape(begin)}{random}{end}"):
            with suppress(OSError), io.FileIO(left, "r+b") as file:
                if lock(file):
                    left.unlink()
        while True:
            file = io.FileIO(self._folder / _hidden(self.path.name), "x+b")
            if lock(file) and os.fstat(file.fileno()).st_nlink:
                return file
            file.close()  # another run took it for one that was left behind

    def take(self, temporary: Path, status: str) -> None:
        """Gives a file its name. Raises OSError, and WriteError where the name was taken meanwhile:
        then the result is beside it."""
        whole = status in WHOLE
        if whole and self.replace:
            name = self._folder / self.path.name
            with suppress(OSError):  # whoever may read it stays the same
                shutil.copymode(name, temporary)
            temporary.replace(name)
            with suppress(OSError):  # two names of one file are left as they are
                temporary.unlink(missing_ok=True)
        else:
            names = (p for p in self._free(whole) if _rename(temporary, self._folder / p.name))
            self.written = next(names)
        sync_folder(self._folder)
        if self.written != self.path and not self.replace:
            raise WriteError(
                f"{self.path}: appeared while this was going on and is left as it is; "
                f"this result is in {self.written}"
            )

    def _free(self, whole: bool) -> Iterator[Path]:
        """Names to try, one after the other."""
        stem, suffix = _short(self.path.stem), _short(self.path.suffix)
        partial = "" if whole else PARTIAL
        more = chain([] if whole else [PARTIAL], (f"{partial}-{n}" for n in count(2)))
        return chain([self.path], (self.path.with_name(f"{stem}{m}{suffix}") for m in more))


def _rename(file: Path, name: Path) -> bool:
    """Whether the name was free, or the file's from before it was killed; then it has no other."""
    try:
        os.link(file, name)
    except FileExistsError:
        if not name.samefile(file):
            return False
    except OSError:  # no hard links on this file system
        if os.path.lexists(name):
            return False
        file.rename(name)
    with suppress(OSError):  # it has its name
        file.unlink(missing_ok=True)
    return True
