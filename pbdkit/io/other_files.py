"""Identification of files that are not results. The kind of a file, and the command that reads it,
are determined from its content."""

from __future__ import annotations

from pathlib import Path

from pbdkit.errors import ExperimentError, StorageError
from pbdkit.io.run_store import STORE
from pbdkit.model.reading import EXPERIMENT, command_for, kind_of, read_file
from pbdkit.model.shipped import shipped_names
from pbdkit.untrusted_files import BEGINNINGS

TEXTS = (".yaml", ".yml", ".json")
"""Suffixes of files that may be experiments."""
FAULTY = "faulty"
"""Kind of a file that is not text or is not valid YAML."""


def refuse_other_file(path: Path) -> None:
    """Raise ExperimentError if a path leads to a file that is certainly not a result, and
    StorageError if there is not even its folder."""
    if description := other_file(path):
        raise ExperimentError(f"{path}: {description}")
    if not path.parent.is_dir():
        raise StorageError(f"{path}: there is no such file")


def other_file(path: Path) -> str:
    """Return a description of a file that is not a result, and the command that reads it. The text
    is empty for results, missing files and unknown content."""
    if path.is_dir():
        inner = path / "sweep.nc"
        sweep = f"is the folder of a sweep; its dataset is {inner}"
        return sweep if inner.is_file() else "is a folder, not a result of pbdkit"
    if not path.is_file():
        is_shipped = path.as_posix() in shipped_names()
        return f"is a shipped experiment; `pbdkit run {path}` computes its result" * is_shipped
    kind = _kind_of_text(path)
    if kind is None:
        return ""
    if kind == FAULTY:
        return "is not a result; by its name it is an experiment" if path.suffix in TEXTS else ""
    if kind == EXPERIMENT:
        return f"is an experiment; `pbdkit run {path}` computes its result and prints the path"
    description = f"is {kind}, not a result; {command_for(kind, str(path))}"
    if kind:
        return description
    if path.suffix == ".json":
        return "is not a result; `pbdkit fit FILE --plot OUT.png` draws a fit while it is made"
    return "is not a result; the names of results end in .nc"


def is_experiment(path: Path) -> bool:
    """Return whether a path leads to an experiment, which is a file or is shipped with pbdkit. For
    a file that cannot be read, the suffix decides."""
    if not path.is_file():
        return path.as_posix() in shipped_names()
    kind = _kind_of_text(path)
    return kind == EXPERIMENT or (kind == FAULTY and path.suffix in TEXTS)


def _kind_of_text(path: Path) -> str | None:
    """Return the kind of a YAML file, and FAULTY for invalid text. Return None for results and for
    files that cannot be read."""
    try:
        with path.open("rb") as file:
            if file.read(8).startswith(BEGINNINGS):
                return None
        return kind_of(read_file(path).data)
    except OSError:
        return None
    except ExperimentError:  # The file is not text, or its text is invalid.
        return FAULTY


def refuse_store(path: Path) -> None:
    """Raise ExperimentError if the store of an unfinished run is given in place of the output of
    the run."""
    if path.name.endswith(STORE) and path.is_file():
        output = path.with_name(path.name.removesuffix(STORE))
        raise ExperimentError(
            f"{path}: is the store of an unfinished run; give its output, {output}"
        )
