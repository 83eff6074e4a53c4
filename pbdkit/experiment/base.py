"""The experiment that another file is about: a sweep, a fit."""

from __future__ import annotations

from itertools import chain
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from pbdkit.errors import ExperimentError, did_you_mean
from pbdkit.experiment.beside import ALLOW, Beside
from pbdkit.experiment.kinds import EXPERIMENT, of_kind
from pbdkit.experiment.parts import brief, fault
from pbdkit.experiment.shipped import shipped_names, shipped_text
from pbdkit.experiment.source import Source, read_file, read_text


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
        return Source(str(path), given, inner, source.beside)
    try:
        return _read(path, given, source.beside)
    except _NoSuchExperimentError as error:
        text = source.message(("experiment",), str(error))
        raise ExperimentError(text, ("experiment",)) from None


class _NoSuchExperimentError(ExperimentError):
    """The field `experiment` leads nowhere."""


def _read(path: Path, name: str, beside: Beside) -> Source:
    """The source of a file beside that file, or of a shipped experiment."""
    accepted = "give a shipped name, or a file in the folder of that file or below it"
    file = (beside.folder or path.parent) / name
    try:
        found = beside.folder is not None and file.is_file()
        allowed = beside.folder is None or beside.holds(file)
    except (OSError, ValueError):
        raise _NoSuchExperimentError(f"{brief(name)} is no name of a file") from None
    if not allowed:
        raise _NoSuchExperimentError(f"{brief(name)} leads elsewhere; {accepted}, or {ALLOW}")
    if found:
        return of_kind(EXPERIMENT, read_file(file))
    if name in (names := shipped_names()):
        return read_text(shipped_text(name), name)
    near = chain(path.parent.glob("*.yaml"), path.parent.glob("*.yml"))
    hint = did_you_mean(name, [*(file.name for file in near), *names])
    raise _NoSuchExperimentError(f"{brief(name)} is neither{hint} ({accepted})")
