"""Where a result gets its name: whole or not at all, and in nobody's place who did not ask."""

from __future__ import annotations

import io
import os
import secrets
from collections.abc import Iterator
from contextlib import suppress
from glob import escape
from itertools import chain, count
from pathlib import Path

from pbdkit.errors import StorageError
from pbdkit.storage.file_system import lock, sync_folder

WHOLE = ("complete", "settled")
"""The status of results that may replace others."""
PARTIAL = "-partial"
"""Added to the name of a result that may not, where its name is taken."""
TEMPORARY = ".partial"
"""How the names of files end that are no results yet."""
RANDOM_BYTES = 8
"""In such a name, as hexadecimal digits, between that of the result and the end."""


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
        begin = f".{self.path.name[:100]}."
        random = "[0-9a-f]" * 2 * RANDOM_BYTES
        for left in self._folder.glob(f"{escape(begin)}{random}{TEMPORARY}"):
            with suppress(OSError), io.FileIO(left, "r+b") as file:
                if lock(file):
                    left.unlink()
        while True:
            name = f"{begin}{secrets.token_hex(RANDOM_BYTES)}{TEMPORARY}"
            file = io.FileIO(self._folder / name, "x+b")
            if lock(file) and os.fstat(file.fileno()).st_nlink:
                return file
            file.close()  # another run took it for one that was left behind

    def take(self, temporary: Path, status: str) -> None:
        """Gives a file its name. Raises OSError, and StorageError where the name was taken
        meanwhile: then the result is beside it."""
        whole = status in WHOLE
        if whole and self.replace:
            temporary.replace(self._folder / self.path.name)
            temporary.unlink(missing_ok=True)  # two names of one file are left as they are
        else:
            names = (p for p in self._free(whole) if _rename(temporary, self._folder / p.name))
            self.written = next(names)
        sync_folder(self._folder)
        if self.written != self.path and not self.replace:
            raise StorageError(
                f"{self.path}: appeared while this run was going on and is left as it is; "
                f"this result is in {self.written}"
            )

    def _free(self, whole: bool) -> Iterator[Path]:
        """Names to try, one after the other."""
        stem, suffix = self.path.stem[:100], self.path.suffix
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
        file.unlink()
    except OSError:  # no hard links on this file system
        if os.path.lexists(name):
            return False
        file.rename(name)
    else:
        file.unlink()
    return True
