"""Atomic writing of files. A file appears under its name complete or not at all. It is locked
against other writers, and replaces an earlier file only on request.

`NewFile` is a file under construction, for libraries that do not handle failed or incomplete
writes.
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

from pbdkit.errors import WriteError, reason_of

LOCAL = {"apfs", "bcachefs", "btrfs", "ext2", "ext3", "ext4", "f2fs", "hfs", "jfs", "overlay"}
LOCAL |= {"ramfs", "reiserfs", "tmpfs", "xfs", "zfs"}
"""File systems that are local to one machine, so that processes can share the memory of SQLite's
write-ahead log."""
FULL = "the disk is full; free some space, or record fewer steps"
"""Message for a full disk."""
FULL_BYTES = 2**20
"""Number of free bytes below which a disk counts as full."""
UNSUPPORTED = {errno.EACCES, errno.EBADF, errno.EINVAL, errno.EISDIR, errno.ENOSYS, errno.ENOTSUP}
UNSUPPORTED |= {errno.EOPNOTSUPP, errno.EPERM, errno.EROFS}
"""Errors of systems and file systems on which a folder cannot be opened or synced."""
MAX_ATTEMPTS = 10
"""Number of attempts to lock a file."""
PAUSE_S = 0.02
"""Pause between two attempts, in seconds."""


def is_local(path: Path, mounts: str = "/proc/self/mountinfo") -> bool:
    """Return whether a file lies on a local file system. Return False if this cannot be
    determined."""
    types: dict[str, str] = {}
    with suppress(OSError):
        for line in Path(mounts).read_text(errors="surrogateescape").splitlines():
            head, _, tail = line.partition(" - ")
            mount = os.fsencode(head.split()[4]).decode("unicode_escape").encode("latin-1")
            types[os.fsdecode(mount)] = tail.split()[0]
    folders = (str(folder) for folder in (path.resolve(), *path.resolve().parents))
    return next((types[folder] in LOCAL for folder in folders if folder in types), False)


def lock(file: io.FileIO) -> bool:
    """Lock an open file until it is closed and return whether that succeeded.

    The result is False if another process holds the lock, and True on systems and file systems
    without locks.
    """
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


def open_locked(path: Path) -> io.FileIO | None:
    """Open an existing file and lock it; return None if another process writes it.

    Several attempts are made, because a process that only tests the lock holds it for a short time.
    Raises OSError.
    """
    for _ in range(MAX_ATTEMPTS):
        file = io.FileIO(path, "r+b")
        # The file may have been replaced or removed in the meantime.
        with suppress(FileNotFoundError):
            if lock(file) and os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        file.close()
        time.sleep(PAUSE_S)
    return None


def is_full(folder: Path) -> bool:
    """Return whether the file system of a folder is (almost) full."""
    try:
        return shutil.disk_usage(folder).free < FULL_BYTES
    except OSError:
        return False


def write_all(file: io.FileIO, data: bytes | bytearray | memoryview) -> None:
    """Write all of the data by repeated writes, because a single write may be incomplete, in
    particular on a disk that is nearly full. Raises OSError."""
    view = memoryview(data)
    while view:
        view = view[file.write(view) :]


def sync_folder(folder: Path) -> None:
    """Sync the entries of a folder to the disk, if the file system supports this. Raises
    OSError."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if error.errno not in UNSUPPORTED:
            raise


def _sync_name(path: Path, folder: Path) -> None:
    """Sync the name of a complete file or folder, in its folder. Raises WriteError."""
    try:
        sync_folder(folder)
    except OSError as error:
        raise WriteError(
            f"{path}: is complete, but its name may be lost in a power cut, because the folder "
            f"cannot be synced: {error.strerror}; check the disk, and copy the file to another one"
        ) from None


def make_folder(folder: Path) -> None:
    """Create a folder and its parents, unless they exist, so that they outlast a power cut. Raises
    OSError."""
    absolute = folder.absolute()
    missing = [path for path in (absolute, *absolute.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for path in missing:
        sync_folder(path.parent)


class NewFile(io.RawIOBase):
    """File on the disk that records the first failed write instead of raising it.

    If a write failed, HDF5 would repeat it when the process ends, and crash. Other libraries lose
    the rest of an incomplete write. In this class every write is complete, and no write raises an
    exception. After the first fault, nothing more is written, and `check` raises the fault. The
    class has no method `fileno`, because libraries could use it to bypass the class.
    """

    def __init__(self, disk: io.FileIO) -> None:
        self.disk = disk
        self._fault: OSError | None = None

    def readable(self) -> bool:
        """Return True, because the file can be read."""
        return True

    def writable(self) -> bool:
        """Return True, because the file can be written."""
        return True

    def seekable(self) -> bool:
        """Return True, because the file supports seeking."""
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Set the position, as in any file."""
        return self.disk.seek(offset, whence)

    def truncate(self, size: int | None = None) -> int:
        """Set the size, as in any file."""
        length = self.tell() if size is None else size
        if self._fault is None:
            try:
                self.disk.truncate(length)
            except OSError as error:
                self.fail(error)
        return length

    def readinto(self, buffer: Any) -> int:
        """Read into a buffer. Bytes that the disk does not return are set to zero."""
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
        """Write all of the data, unless a fault was recorded."""
        view = memoryview(data).cast("B")
        self._write_all(view)
        return len(view)

    def close(self) -> None:
        """Close this object and the file on the disk."""
        self.disk.close()
        super().close()

    def fail(self, fault: OSError) -> None:
        """Record a fault, unless an earlier one is recorded."""
        self._fault = self._fault or fault

    def check(self) -> None:
        """Raise the OSError that a write recorded, if there is one."""
        if self._fault:
            raise self._fault

    def sync(self) -> None:
        """Wait until the file is on the disk. Raises OSError."""
        self.check()
        os.fsync(self.disk.fileno())

    def finalize(self) -> None:
        """Finish the file. Raises OSError if any write failed."""
        self.sync()

    def _write_all(self, view: memoryview) -> None:
        if self._fault is None:
            try:
                write_all(self.disk, view)
            except OSError as error:
                self.fail(error)


WHOLE = ("complete", "settled")
"""Statuses of complete results, which may replace an earlier file."""
PARTIAL = "-partial"
"""Suffix that is added to the name of a result with another status if a file with that name
exists."""
TEMPORARY = ".partial"
"""Suffix of files under construction."""
RANDOM_BYTES = 8
"""Number of random bytes in the name of a file under construction, as hexadecimal digits."""
NAME_BYTES = 100
"""Maximum number of bytes of a name to which a suffix is added. It leaves room for the suffix,
since file systems allow 255 bytes."""
KINDS = {stat.S_IFLNK: "a symbolic link", stat.S_IFIFO: "a pipe", stat.S_IFCHR: "a device"}
"""Descriptions of file types that are not replaced."""

File = TypeVar("File", bound=NewFile)


@contextmanager
def open_atomic(path: Path, kind: type[File], *, replace: bool) -> Iterator[File]:
    """Write a file in the block. At the end of the block it appears under its name, complete and
    synced. Until then, and after a fault, an earlier file of that name is unchanged.

    Parameters
    ----------
    path
        Name of the file. With `replace`, an existing plain file of that name is replaced.
    kind
        Class of the file to which the block writes: `NewFile`, or `PagedFile` for a result, which
        is sealed and read back.

    Raises
    ------
    WriteError
        If the operating system refuses an operation, or the name belongs to a link, a pipe or a
        device.
    """
    with _refusing(path):
        if kind_in_place := kind_of(path):
            raise OSError(0, f"is {kind_in_place}, which is not replaced")
        destination = Destination(path, replace=replace)
        disk = destination.temporary()
    temporary = Path(disk.name)
    try:
        with disk:
            file = kind(disk)
            try:
                yield file
            # If a write failed in a library, this may have caused the exception in the block.
            finally:
                with _refusing(path):
                    file.check()
            with _refusing(path):
                file.finalize()
                destination.take(temporary, "complete")
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write(path: Path, content: str | bytes, *, replace: bool) -> None:
    """Write bytes, or a text as UTF-8, in the same way as `open_atomic`."""
    data = content.encode(errors="replace") if isinstance(content, str) else content
    with open_atomic(path, NewFile, replace=replace) as file:
        file.write(data)


def write_together(contents: Mapping[Path, str | bytes]) -> None:
    """Write new files in the given order, each in the same way as `write`. If one of them fails,
    all of them are removed."""
    with ExitStack() as undo:
        for path, content in contents.items():
            write(path, content, replace=False)
            undo.callback(path.unlink, missing_ok=True)
        undo.pop_all()


def write_folder(folder: Path, texts: Mapping[str, str]) -> None:
    """Write a new folder that contains texts at the given relative paths. The folder appears
    complete or not at all.

    Raises WriteError if the operating system refuses an operation, or if a file or folder of that
    name exists.
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
            _sync_name(folder, folder.absolute().parent)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def kind_of(path: Path) -> str | None:
    """Return a description of the object at a path if it is not a plain file, otherwise None.
    Raises OSError."""
    try:
        mode = path.lstat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None
    if stat.S_ISREG(mode):
        return None
    return "a folder" if stat.S_ISDIR(mode) else KINDS.get(stat.S_IFMT(mode), "not a plain file")


@contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """Convert an OSError in the block to a WriteError with the path."""
    try:
        yield
    except OSError as error:
        raise WriteError(f"{path}: cannot be written: {reason_of(error)}") from None


@contextmanager
def encoding(path: Path) -> Iterator[None]:
    """Convert an OSError of the library that encodes a picture in the block to a WriteError. Pillow
    raises it if memory is exhausted."""
    try:
        yield
    except OSError as error:
        raise WriteError(
            f"{path}: cannot be written: {error.strerror or error}; memory may be exhausted: "
            "reduce --dpi or --size"
        ) from None


def _hidden(name: str, random: str = "") -> str:
    """Return the name of a file under construction in the folder of the result."""
    return f".{_short(name)}.{random or secrets.token_hex(RANDOM_BYTES)}{TEMPORARY}"


def _short(name: str) -> str:
    """Shorten a name so that there is room for a suffix."""
    while len(os.fsencode(name)) > NAME_BYTES:
        name = name[:-1]
    return name


def remove_leftovers(path: Path) -> None:
    """Remove the files under construction that killed processes left for a result."""
    random = "[0-9a-f]" * 2 * RANDOM_BYTES
    prefix, _, end = _hidden(path.name, "*").rpartition("*")
    for leftover in path.parent.glob(f"{escape(prefix)}{random}{end}"):
        with suppress(OSError), io.FileIO(leftover, "r+b") as file:
            if lock(file):
                leftover.unlink()


class Destination:
    """Name of a result.

    With `replace`, a complete result replaces an existing file. The result of a run that diverged
    or did not converge never replaces a file; it gets another name in the same folder.
    """

    def __init__(self, path: Path, *, replace: bool) -> None:
        self.path, self.replace = path, replace
        # The working directory of the process may change later.
        self._folder = path.parent.absolute()
        self.written = path
        """Path of the finished result. It differs from `path` if that name was in use."""
        self.is_synced = False
        """True once the name of the finished result is on the disk."""

    def temporary(self) -> io.FileIO:
        """Create and lock a file with a unique name in the folder of the result. Remove files with
        such names that remain from killed runs. Raises OSError."""
        remove_leftovers(self._folder / self.path.name)
        while True:
            file = io.FileIO(self._folder / _hidden(self.path.name), "x+b")
            if lock(file) and os.fstat(file.fileno()).st_nlink:
                return file
            # Another run has removed the file, because it looked like a file of a killed run.
            file.close()

    def take(self, temporary: Path, status: str) -> None:
        """Give a temporary file the name of the result. Raises OSError. Also raises WriteError if
        the name cannot be synced, or if a file of that name has appeared in the meantime; the
        result then has another name in the same folder."""
        whole = status in WHOLE
        if whole and self.replace:
            name = self._folder / self.path.name
            with suppress(OSError):  # The permissions to read the earlier file are kept.
                shutil.copymode(name, temporary)
            temporary.replace(name)
            with suppress(OSError):  # If both names belong to the same file, nothing is changed.
                temporary.unlink(missing_ok=True)
        else:
            names = (p for p in self._free(whole) if _rename(temporary, self._folder / p.name))
            self.written = next(names)
        _sync_name(self.written, self._folder)
        self.is_synced = True
        if self.written != self.path and not self.replace:
            raise WriteError(
                f"{self.path}: was created by another program meanwhile, and is not replaced; "
                f"this result is in {self.written}"
            )

    def _free(self, whole: bool) -> Iterator[Path]:
        """Generate the candidate names, in order."""
        stem, suffix = _short(self.path.stem), _short(self.path.suffix)
        partial = "" if whole else PARTIAL
        endings = chain([] if whole else [PARTIAL], (f"{partial}-{n}" for n in count(2)))
        return chain(
            [self.path], (self.path.with_name(f"{stem}{ending}{suffix}") for ending in endings)
        )


def _rename(file: Path, name: Path) -> bool:
    """Rename a file unless the name is in use, and return whether it now has that name. If a
    process was killed after it had linked the file to the name, the file counts as renamed."""
    try:
        os.link(file, name)
    except FileExistsError:
        if not name.samefile(file):
            return False
    except OSError:  # The file system has no hard links.
        if os.path.lexists(name):
            return False
        file.rename(name)
    with suppress(OSError):  # The file already has the name.
        file.unlink(missing_ok=True)
    return True
