"""Exceptions and warnings. Every error that pbdkit raises on purpose derives from PbdkitError."""

from __future__ import annotations

import difflib
import errno
import sys
import warnings
from collections.abc import Iterable, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    import xarray

__all__ = [
    "AccuracyWarning", "DivergedError", "ExperimentError", "PbdkitError", "PbdkitWarning",
    "PluginError", "ReproducibilityWarning", "RetirementWarning", "SceneWarning",
    "StabilityWarning", "StorageError", "StorageWarning", "SweepWarning",
]  # fmt: skip

MAX_CHARACTERS = 3900
"""Largest number of characters of a message."""
MAX_LINES = 20
"""Largest number of lines of a message."""
MAX_SUGGESTIONS = 8
"""Largest number of names that are suggested if several begin with the same word."""


class PbdkitError(Exception):
    """Base class of all errors of pbdkit.

    Parameters
    ----------
    message : str
        Text for the user: place, fault, expectation and remedy. Unprintable characters are escaped.
    where : sequence of str or int
        Path of the faulty field in the experiment, for instance ``("leaders", 1, "select")``; empty
        if there is no single field.

    Attributes
    ----------
    exit_status
        Exit status of the program.
    is_reported
        Whether another process has already reported the error.
    """

    exit_status: ClassVar[int] = 1
    is_reported: bool = False

    def __init__(self, message: str, where: Sequence[str | int] = ()) -> None:
        super().__init__(printable(message))
        self.where = tuple(where)


def printable(text: str) -> str:
    """Return the text in a form that a terminal can show.

    Unprintable characters are escaped. A long line is shortened in the middle, because its
    beginning contains the place and its end the remedy.
    """
    lines = text.split("\n")[:MAX_LINES]
    limit = min(1000, MAX_CHARACTERS // len(lines))
    return "\n".join(_cut(_escaped(_cut(line, limit)), limit) for line in lines)


def _cut(line: str, limit: int) -> str:
    half = limit // 2
    return line if len(line) <= limit else f"{line[:half]} ... {line[6 - half :]}"


def _escaped(line: str) -> str:
    return "".join(
        character if character.isprintable() else ascii(character)[1:-1] for character in line
    )


class ExperimentError(PbdkitError):
    """An experiment or a call is invalid.

    Attributes
    ----------
    located
        Whether the message begins with the place in the experiment's file.
    """

    exit_status = 2
    located: bool = False


class NotSharedError(ExperimentError):
    """Several processes cannot share the run; one process can run it."""


class PluginError(PbdkitError):
    """A distribution that the experiment needs is missing or broken, or a component fails.

    `where` is the path of the field that refers to it, if there is one.
    """

    exit_status = 3


class DivergedError(PbdkitError):
    """A run diverged or found no equilibrium.

    It found none if the iteration did not converge, or if the body separated into parts under the
    load.

    Parameters
    ----------
    message : str
        Text for the user.
    dataset : xarray.Dataset, optional
        The records before the failure, with the status "diverged", "unconverged" or "separated".
        It is None if the run writes to a file, because the file contains these records.
    """

    exit_status = 4

    def __init__(self, message: str, dataset: xarray.Dataset | None = None) -> None:
        super().__init__(message)
        self.dataset = dataset


class StorageError(PbdkitError):
    """A result could not be written or read. Existing files are unchanged."""

    exit_status = 6


class WriteError(StorageError):
    """A file could not be written. An earlier file of this name is unchanged, unless the message
    states that the new one is complete.

    The message begins with the name of this file. If the error occurs while another file is read,
    the name of that file is not added to the message.
    """


REMEDIES = {
    errno.EIO: "; the disk failed: repeat the command, and check the disk if it fails again",
    errno.ENOSPC: "; free some space, and repeat the command",
    errno.EDQUOT: "; free some space, and repeat the command",
    errno.EMFILE: "; raise the limit (`ulimit -n`), or use fewer processes",
    errno.ENFILE: "; raise the limit (`ulimit -n`), or use fewer processes",
}
"""Remedies for failures of the disk and for limits of the system, by the number of the error."""


def reason_of(error: OSError) -> str:
    """Return the reason for which the operating system refused an operation, with the remedy if
    there is one."""
    return f"{error.strerror or error}{REMEDIES.get(error.errno or 0, '')}"


def unreadable(path: Any, error: OSError) -> PbdkitError:
    """Return the error for an input file that cannot be read: a StorageError if the disk or the
    system fails, and an ExperimentError otherwise, for instance if there is no such file."""
    kind = StorageError if error.errno in REMEDIES else ExperimentError
    return kind(f"{path}: cannot be read: {reason_of(error)}")


class PbdkitWarning(UserWarning):
    """A run or its result may not be what was intended; the text gives the reason and the
    remedy."""


class SceneWarning(PbdkitWarning):
    """A part of the experiment has no effect, or is probably a mistake."""


class StabilityWarning(PbdkitWarning):
    """Steps can diverge: the relaxation is too large, or a mass too small."""


class AccuracyWarning(PbdkitWarning):
    """Results may have large errors.

    Causes are edges that are not free of stress, cells that lock, and cells that are inverted.
    """


class ReproducibilityWarning(PbdkitWarning):
    """A run is repeated with other versions of pbdkit or plugins than those that made the
    dataset."""


class StorageWarning(PbdkitWarning):
    """A file has no checksums, or a part of it was damaged and is computed again."""


class SweepWarning(PbdkitWarning):
    """Members of a sweep have no values."""


class RetirementWarning(PbdkitWarning):
    """A name of an earlier version is read as its successor until version 1.0."""


class WarningText(str):
    """The text of a warning. It also stores the class with which the warning is issued in
    Python."""

    category: type[PbdkitWarning]

    def __new__(cls, text: str, category: type[PbdkitWarning] = SceneWarning) -> WarningText:
        """Return the text with its class."""
        self = super().__new__(cls, text)
        self.category = category
        return self


def of_category(category: type[PbdkitWarning], texts: Iterable[str]) -> list[str]:
    """Return the texts as `WarningText` objects of one class of warnings."""
    return [WarningText(text, category) for text in texts]


def warn_caller(text: str, category: type[PbdkitWarning] | None = None) -> None:
    """Issue a warning at the line outside pbdkit that made the call.

    Parameters
    ----------
    text : str
        Description of the probable mistake, and the remedy.
    category : class, optional
        The class of the warning. By default it is the class that a WarningText contains, and
        SceneWarning for any other text.
    """
    level, frame = 1, sys._getframe()
    while frame.f_back and frame.f_globals.get("__name__", "").partition(".")[0] == "pbdkit":
        level, frame = level + 1, frame.f_back
    category = category or getattr(text, "category", SceneWarning)
    warnings.warn(str(text), category, stacklevel=level)


def dotted(where: Sequence[Any]) -> str:
    """Return the path of a field as users write it: ``leaders.1.select``."""
    return ".".join(str(part) for part in where)


def did_you_mean(name: str, candidates: Iterable[str]) -> str:
    """Return ``; did you mean 'x'?`` with similar names, or an empty string.

    All names that begin with `name` are suggested or, if there are none, the most similar one.
    """
    by_lower, lower = {key.lower(): key for key in candidates}, name[:80].lower()
    similar = (
        [key for key in by_lower if key.startswith((f"{lower}_", f"{lower}-"))] if lower else []
    )
    if not 0 < len(similar) <= MAX_SUGGESTIONS or lower in by_lower:
        similar = difflib.get_close_matches(lower, by_lower, n=1, cutoff=0.5)
    names = [f"'{by_lower[key]}'" for key in similar]
    if not names:
        return ""
    first = f"{', '.join(names[:-1])} or " if len(names) > 1 else ""
    return f"; did you mean {first}{names[-1]}?"


def no_such(what: str, number: int, count: int) -> str:
    """Return the message for a number of which there is none, with the numbers that exist."""
    numbers = {0: f"the experiment has no {what}s", 1: f"the only one has the number {count - 1}"}
    return f"there is no {what} {number}; " + numbers.get(
        count, f"{what}s have the numbers 0 to {count - 1}"
    )


class AnswerError(TypeError):
    """A function returned an object of the wrong kind. The message contains the correct kind."""


MAX_QUOTED_CHARACTERS = 400
"""Maximum number of characters that are quoted from a message."""


def one_line(text: str) -> str:
    """Return the printable words of a text in one line, shortened if it is long."""
    words = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return (
        words if len(words) <= MAX_QUOTED_CHARACTERS else words[: MAX_QUOTED_CHARACTERS - 3] + "..."
    )


def refuse_without(library: str, extra: str, reason: str) -> None:
    """Raise ExperimentError if a library is not installed.

    Parameters
    ----------
    library : str
        Name of the module.
    extra : str
        Extra of pbdkit that installs it.
    reason : str
        What needs the library, in a message: "pictures require matplotlib".
    """
    if find_spec(library) is None:
        raise ExperimentError(f"{reason}: pip install 'pbdkit[{extra}]'")


def refuse_no_matplotlib() -> None:
    """Raise ExperimentError if matplotlib is not installed."""
    refuse_without("matplotlib", "plot", "pictures require matplotlib")
