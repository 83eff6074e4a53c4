"""The base experiment of a sweep or a fit: its field in the file, and its source."""

from __future__ import annotations

from itertools import chain
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from pbdkit.errors import ExperimentError, did_you_mean
from pbdkit.model.reading import (
    ALLOW,
    EXPERIMENT,
    FileResolver,
    Source,
    of_kind,
    read_file,
    read_text,
)
from pbdkit.model.shipped import shipped_names, shipped_text
from pbdkit.model.validation import brief, fault


def _an_experiment(value: Any) -> Any:
    if not isinstance(value, (str, dict)):
        raise fault(
            "expected the name of a shipped experiment, a file in the folder of this one, or the "
            "experiment itself, got "
            f"{brief(value)}"
        )
    return value


Base = Annotated[
    Any, AfterValidator(_an_experiment), Field(json_schema_extra={"type": ["string", "object"]})
]
"""Type of a base experiment: a shipped name, a file, or the experiment itself.
"""


def base_source(path: Path, base: Any, source: Source) -> Source:
    """Return the source of the base experiment of a sweep or fit.

    Parameters
    ----------
    path
        File of the sweep or fit.
    base
        Value of the field `experiment`.
    source
        Source of the sweep or fit.

    Raises
    ------
    ExperimentError
        If there is no such experiment, or the file cannot be read.
    """
    if isinstance(base, dict):
        inner = {w[1:]: p for w, p in source.places.items() if w[:1] == ("experiment",)}
        return Source(str(path), base, inner, source.files)
    try:
        return _read(path, base, source.files)
    except _NoSuchExperimentError as error:
        text = source.message(("experiment",), str(error))
        raise ExperimentError(text, ("experiment",)) from None


class _NoSuchExperimentError(ExperimentError):
    """The field `experiment` does not refer to an experiment."""


def _read(path: Path, name: str, files: FileResolver) -> Source:
    """Read a file in the folder of another file, or a shipped experiment."""
    accepted = "give a shipped name, or a file in the folder of that file or below it"
    file = (files.folder or path.parent) / name
    try:
        is_file = files.folder is not None and file.is_file()
        is_allowed = files.folder is None or files.holds(file)
    except (OSError, ValueError):
        raise _NoSuchExperimentError(f"{brief(name)} is not the name of a file") from None
    if not is_allowed:
        text = f"{brief(name)} lies outside the folder; {accepted}, or {ALLOW}"
        raise _NoSuchExperimentError(text)
    if is_file:
        return of_kind(EXPERIMENT, read_file(file))
    if name in (names := shipped_names()):
        return read_text(shipped_text(name), name)
    near = chain(path.parent.glob("*.yaml"), path.parent.glob("*.yml"))
    hint = did_you_mean(name, [*(file.name for file in near), *names])
    raise _NoSuchExperimentError(f"{brief(name)} is neither{hint} ({accepted})")
