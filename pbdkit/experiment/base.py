"""The experiment that another file is about: a sweep, a fit."""

from __future__ import annotations

from itertools import chain
from pathlib import Path, PurePath
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from pbdkit.errors import ExperimentError
from pbdkit.experiment.kinds import EXPERIMENT, of_kind
from pbdkit.experiment.parts import brief, fault
from pbdkit.experiment.shipped import shipped_names, shipped_text
from pbdkit.experiment.source import Source, read_file, read_text
from pbdkit.interfaces.component import did_you_mean


def _an_experiment(value: Any) -> Any:
    if not isinstance(value, (str, dict)):
        raise fault(
            "expected a shipped name, a file beside this one, or the experiment itself, got "
            f"{brief(value)}"
        )
    return value


Base = Annotated[
    Any, AfterValidator(_an_experiment), Field(json_schema_extra={"type": ["string", "object"]})
]
"""A shipped name, a file beside the one that names it, or the experiment itself."""


def base_source(path: Path, given: Any, source: Source) -> Source:
    """The source of the experiment that is given under `experiment` in a file. Raises
    ExperimentError."""
    if isinstance(given, dict):
        inner = {w[1:]: p for w, p in source.places.items() if w[:1] == ("experiment",)}
        return Source(str(path), given, inner, path.parent)
    try:
        return _beside(path, given)
    except _NoSuchExperimentError as error:
        text = source.message(("experiment",), str(error))
        raise ExperimentError(text, ("experiment",)) from None


class _NoSuchExperimentError(ExperimentError):
    """The field `experiment` leads nowhere."""


def _beside(path: Path, name: str) -> Source:
    """The source of a file in the folder of that file, or below it, or of a shipped experiment."""
    given, folder = PurePath(name), path.absolute().parent
    accepted = "give a shipped name, or a file in the folder of that file or below it"
    if given.is_absolute() or ".." in given.parts:
        raise _NoSuchExperimentError(f"{brief(name)} leads elsewhere; {accepted}")
    try:
        file = (folder / given).resolve()
        found = file.is_file()
    except (OSError, ValueError):
        raise _NoSuchExperimentError(f"{brief(name)} is no name of a file") from None
    if found and not file.is_relative_to(folder.resolve()):
        raise _NoSuchExperimentError(f"{brief(name)} is a link that leads elsewhere; {accepted}")
    if found:
        return of_kind(EXPERIMENT, read_file(path.parent / given))
    if name in (names := shipped_names()):
        return read_text(shipped_text(name), name)
    files = chain(path.parent.glob("*.yaml"), path.parent.glob("*.yml"))
    hint = did_you_mean(name, [*(file.name for file in files), *names])
    raise _NoSuchExperimentError(f"{brief(name)} is neither{hint} ({accepted})")
