"""What can go wrong, named: every error that pbdkit raises on purpose derives from PbdkitError."""

from __future__ import annotations

import difflib
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

LONGEST = 3900
"""So many characters a message has at most."""
MOST_LINES = 20
MOST_NAMES = 8
"""So many names that begin with a word are suggested for it."""


class PbdkitError(Exception):
    """The common ancestor; its text is one message for the user, with place and remedy. Whatever it
    repeats of the input is made fit to be shown.

    `where` is the path of the faulty field in the experiment, for instance
    ``("leaders", 1, "select")``; it is empty when no single field is to blame. `exit_status` is
    that of the program which ends with it.
    """

    exit_status: ClassVar[int] = 1
    told: bool = False
    """Whether the user knows of it already, from another process."""

    def __init__(self, message: str, where: Sequence[str | int] = ()) -> None:
        super().__init__(printable(message))
        self.where = tuple(where)


def printable(text: str) -> str:
    """The text as a terminal may show it: what does not print is escaped, and of long lines the
    beginning, with the place, and the end, with the remedy, are kept."""
    lines = text.split("\n")[:MOST_LINES]
    longest = min(1000, LONGEST // len(lines))
    return "\n".join(_cut(_escaped(_cut(line, longest)), longest) for line in lines)


def _cut(line: str, longest: int) -> str:
    half = longest // 2
    return line if len(line) <= longest else f"{line[:half]} ... {line[6 - half :]}"


def _escaped(line: str) -> str:
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)


class ExperimentError(PbdkitError):
    """The experiment or the call is wrong."""

    exit_status = 2
    located: bool = False
    """Whether the message already begins with the place in the experiment's file."""


class NotSharedError(ExperimentError):
    """Several processes cannot share it: one can run it."""


class PluginError(PbdkitError):
    """A distribution that the experiment names is missing or broken, or a component of it fails;
    `where` is then the path of the field that asks for it, where one does."""

    exit_status = 3


class DivergedError(PbdkitError):
    """A run left all bounds, did not converge to an equilibrium, or came apart on the way to one.

    `dataset` holds what was recorded before, status "diverged", "unconverged" or "separated"; it is
    None where the run was writing to a file, which then holds the same.
    """

    exit_status = 4

    def __init__(self, message: str, dataset: xarray.Dataset | None = None) -> None:
        super().__init__(message)
        self.dataset = dataset


class StorageError(PbdkitError):
    """A result could not be written or read; nothing that existed before was touched."""

    exit_status = 6


class WriteError(StorageError):
    """A file could not be written: the earlier one of its name, and all that was read, are sound.

    The message begins with the place, and nothing that reads another file meanwhile changes it.
    """


class PbdkitWarning(UserWarning):
    """The base class of all warnings; the text names the place and the remedy.

    Each subject has a class of its own, so that it can be silenced alone:
    ``warnings.filterwarnings("ignore", category=pbdkit.errors.StabilityWarning)``.
    """


class SceneWarning(PbdkitWarning):
    """A part of the experiment has no effect, or is probably not what was meant."""


class StabilityWarning(PbdkitWarning):
    """Steps can diverge: the relaxation is too large, or a mass too small."""


class AccuracyWarning(PbdkitWarning):
    """Results may be less accurate than their digits: edges that are not free of stress, cells that
    lock or have turned over."""


class ReproducibilityWarning(PbdkitWarning):
    """A run is repeated by other versions than those that made the dataset."""


class StorageWarning(PbdkitWarning):
    """A file carries no seal, or a part of it was damaged and is computed anew."""


class SweepWarning(PbdkitWarning):
    """Members of a sweep have no values."""


class RetirementWarning(PbdkitWarning):
    """A name of an earlier version is read as its successor until version 1.0."""


class WarningText(str):
    """The text of a warning, and the class with which it is issued in Python."""

    category: type[PbdkitWarning]

    def __new__(cls, text: str, category: type[PbdkitWarning] = SceneWarning) -> WarningText:
        """Return the text with its class."""
        self = super().__new__(cls, text)
        self.category = category
        return self


def of_category(category: type[PbdkitWarning], texts: Iterable[str]) -> list[str]:
    """Return the texts of warnings with the class with which they are issued."""
    return [WarningText(text, category) for text in texts]


def warn_caller(text: str, category: type[PbdkitWarning] | None = None) -> None:
    """Issue a warning at the line outside pbdkit that made the call.

    Parameters
    ----------
    text : str
        What is doubtful, and the remedy.
    category : class, optional
        The class of the warning; by default that of a WarningText, and else SceneWarning.
    """
    level, frame = 1, sys._getframe()
    while frame.f_back and frame.f_globals.get("__name__", "").partition(".")[0] == "pbdkit":
        level, frame = level + 1, frame.f_back
    category = category or getattr(text, "category", SceneWarning)
    warnings.warn(str(text), category, stacklevel=level)


def dotted(where: Sequence[Any]) -> str:
    """The path of a field as users write it: ``leaders.1.select``."""
    return ".".join(str(part) for part in where)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return ``; did you mean 'x'?`` with the known names that begin with the word, or else with
    the nearest one; an empty string where no known name is near."""
    by_lower, lower = {k.lower(): k for k in known}, name[:80].lower()
    near = [k for k in by_lower if k.startswith((f"{lower}_", f"{lower}-"))] if lower else []
    if not 0 < len(near) <= MOST_NAMES or lower in by_lower:
        near = difflib.get_close_matches(lower, by_lower, n=1, cutoff=0.5)
    names = [f"'{by_lower[k]}'" for k in near]
    if not names:
        return ""
    before = f"{', '.join(names[:-1])} or " if len(names) > 1 else ""
    return f"; did you mean {before}{names[-1]}?"


LONGEST_LINE = 400
"""Maximum number of characters of a message that is quoted."""


def one_line(text: str) -> str:
    """Return the printable words of a text in one line, cut where it is long."""
    words = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return words if len(words) <= LONGEST_LINE else words[: LONGEST_LINE - 3] + "..."


def refuse_without(library: str, extra: str, reason: str) -> None:
    """Raise ExperimentError where a library is not installed.

    Parameters
    ----------
    library : str
        Name of the module.
    extra : str
        Extra of pbdkit that installs it.
    reason : str
        What needs the library, in a message: "pictures need matplotlib".
    """
    if find_spec(library) is None:
        raise ExperimentError(f"{reason}: pip install 'pbdkit[{extra}]'")


def refuse_no_matplotlib() -> None:
    """Raise ExperimentError where matplotlib is not installed."""
    refuse_without("matplotlib", "plot", "pictures need matplotlib")
