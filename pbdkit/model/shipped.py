"""The experiments that come with pbdkit, by name, and the base experiment of a sweep or a fit."""

from __future__ import annotations

import re
from itertools import chain, takewhile
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from pbdkit.errors import ExperimentError, did_you_mean
from pbdkit.model.reading import ALLOW, EXPERIMENT, Beside, Source, of_kind, read_file, read_text
from pbdkit.model.validation import brief, fault

FOLDER = Path(__file__).parent.parent / "experiments"
SUFFIX = ".yaml"
LONGEST = 100
"""So many characters a title has, or it ends at its colon."""


def shipped_names() -> list[str]:
    """The names of all shipped experiments, sorted."""
    found = (path.relative_to(FOLDER).as_posix() for path in FOLDER.rglob(f"*{SUFFIX}"))
    return sorted(name.removesuffix(SUFFIX) for name in found)


def shipped_text(name: str) -> str:
    """Return the file of a shipped experiment. Raises ExperimentError where there is none of that
    name."""
    if name not in (names := shipped_names()):
        hint = did_you_mean(name, names) or "; `pbdkit experiments` lists them"
        raise ExperimentError(f"{name}: is no shipped experiment{hint}")
    return (FOLDER / f"{name}{SUFFIX}").read_text("utf-8")


def shipped_data(name: str) -> list[Path]:
    """Return the data files that a shipped experiment names; they lie beside it."""
    text, beside = shipped_text(name), (FOLDER / name).parent.iterdir()
    return sorted(path for path in beside if path.suffix != SUFFIX and path.name in text)


def shipped_title(name: str) -> str:
    """The first sentence of its file; of a long one what comes before the colon."""
    lines = takewhile(lambda line: line.startswith("#"), shipped_text(name).splitlines())
    told = " ".join(line.removeprefix("#").strip() for line in lines)
    sentence = re.split(r"\.(?=\s|$)", told, maxsplit=1)[0]
    if len(sentence) > LONGEST:
        sentence = re.split(r"[:;]\s", sentence, maxsplit=1)[0]
    return f"{sentence}."


def read_experiment(name: str, *, allow_outside: bool = False) -> Source:
    """The source of the experiment in a file, or of the shipped experiment of that name. Files that
    it names lie in its folder or below, unless others are allowed."""
    path = Path(name)
    try:
        is_file, is_folder = path.is_file(), path.is_dir()
    except OSError as error:
        raise ExperimentError(f"{name[:80]}...: {error.strerror}") from None
    if is_file:
        source = of_kind(EXPERIMENT, read_file(path))
        source.beside = Beside(path.parent, allow_outside)
        return source
    names = shipped_names()
    if name in names:
        source = read_text(shipped_text(name), name)
        source.beside = Beside((FOLDER / name).parent)
        return source
    what = "is a folder" if is_folder else "is no file and no shipped experiment"
    near = [str(p) for p in path.parent.glob("*.yaml")] if path.parent.is_dir() else []
    hint = did_you_mean(name, [*near, *names])
    raise ExperimentError(f"{name}: {what}{hint} (`pbdkit experiments` lists them)")


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
