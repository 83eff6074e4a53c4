"""Write files whole or not at all, beside the earlier file until then; replace only on request."""

from __future__ import annotations

import errno
import io
import os
import secrets
import shutil
import stat
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from glob import escape
from itertools import chain, count
from pathlib import Path
from typing import TypeVar

from pbdkit.errors import WriteError
from pbdkit.storage.file_system import lock, sync_folder, write_all
from pbdkit.storage.new_file import NewFile

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
