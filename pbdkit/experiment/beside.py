"""The files that an experiment, a sweep or a fit names: those beside it, and others on request."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pydantic import ValidationInfo

ALLOW_OUTSIDE = "PBDKIT_ALLOW_OUTSIDE"
"""The environment variable that, where it is not empty, allows files outside the folder."""
ALLOW = (
    "allow it with --allow-outside (in Python pbdkit.load(..., allow_outside=True), or "
    f"{ALLOW_OUTSIDE}=1)"
)
"""The remedy in messages."""


@dataclass(frozen=True)
class Beside:
    """Resolve the names of files relative to the folder of the file that names them.

    Attributes
    ----------
    folder : Path or None
        The folder; None for an experiment that names no files, as in a result, where their content
        takes their place.
    outside : bool
        Whether files outside the folder are allowed, as for a dict that a Python program hands
        over. The environment variable `ALLOW_OUTSIDE` allows them, too.
    """

    folder: Path | None = None
    outside: bool = False

    def path(self, name: Any, what: str) -> Path:
        """Return the path of the regular file of that name.

        Raises ValueError for what is no name, for files outside the folder, links followed, where
        these are not allowed, and where there is none; `what` is the kind of file in messages.
        """
        if not isinstance(name, str) or not name or "\0" in name:
            raise ValueError(f"expected the name of a {what} file, got {name!r:.40}")
        if self.folder is None:
            raise ValueError(
                f"{name:.80}: an experiment that lies in a result or in a store names no files; "
                "their content takes their place"
            )
        path = self.folder / name
        try:
            inside, regular = self.holds(path), path.is_file()
        except OSError as error:
            raise ValueError(f"{str(path)[:80]}...: {error.strerror}") from None
        if not inside:
            folder = self.folder.absolute()
            text = f"{name} lies outside the folder of the file that names it, {folder}"
            raise ValueError(f"{text}; copy it there, or {ALLOW}")
        if not regular:
            how = "is no regular file" if path.exists() else "is not there"
            raise ValueError(f"{path}: {how}; its place counts from the experiment's file")
        return path

    def holds(self, path: Path) -> bool:
        """Whether a path, links followed, lies in the folder or is allowed to lie elsewhere. Raises
        OSError."""
        if self.outside or os.environ.get(ALLOW_OUTSIDE):
            return True
        assert self.folder is not None
        try:
            return path.resolve().is_relative_to(self.folder.resolve())
        except RuntimeError as error:  # links in a circle
            raise OSError(0, str(error)) from None


OF_PROGRAM = Beside(Path(), outside=True)
"""The files that a dict names which a Python program hands over."""


def beside(info: ValidationInfo) -> Beside:
    """Return what the validation context says of files."""
    found: Beside = (info.context or {}).get("beside") or Beside()
    return found
