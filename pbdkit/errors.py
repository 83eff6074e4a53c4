"""What can go wrong, named: every error that pbdkit raises on purpose derives from PbdkitError."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import xarray


class PbdkitError(Exception):
    """The common ancestor; its text is one message for the user, with place and remedy."""


class ExperimentError(PbdkitError):
    """The experiment or the call is wrong.

    `where` is the path of the faulty field in the experiment, for instance
    ``("leaders", 1, "select")``; it is empty when no single field is to blame.
    """

    def __init__(self, message: str, where: Sequence[str | int] = ()) -> None:
        super().__init__(message)
        self.where = tuple(where)


class PluginError(PbdkitError):
    """A distribution that the experiment names is missing or broken, or a component of it fails.

    `where` is the path of the field that asks for it, where one does.
    """

    def __init__(self, message: str, where: Sequence[str | int] = ()) -> None:
        super().__init__(message)
        self.where = tuple(where)


class DivergedError(PbdkitError):
    """A run left all bounds.

    `dataset` holds what was recorded before, status "diverged"; it is None where the run was
    writing to a file, which then holds the same.
    """

    def __init__(self, message: str, dataset: xarray.Dataset | None = None) -> None:
        super().__init__(message)
        self.dataset = dataset


class StorageError(PbdkitError):
    """A result could not be written or read; nothing that existed before was touched."""


class PbdkitWarning(UserWarning):
    """A run, or its result, deserves a doubt; the text says which, and the remedy."""


def dotted(where: Sequence[Any]) -> str:
    """The path of a field as users write it: ``leaders.1.select``."""
    return ".".join(str(part) for part in where)
