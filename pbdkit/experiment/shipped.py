"""The experiments that come with pbdkit, by name."""

from __future__ import annotations

from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path

from pbdkit.errors import ExperimentError
from pbdkit.experiment.source import Source, read_file, read_text
from pbdkit.interfaces.component import did_you_mean

SUFFIX = ".yaml"


def shipped_names() -> list[str]:
    """The names of all shipped experiments, sorted."""
    return sorted(_found(_root(), ""))


def shipped_text(name: str) -> str:
    """The file of a shipped experiment."""
    return _root().joinpath(*f"{name}{SUFFIX}".split("/")).read_text("utf-8")


def read_experiment(name: str) -> Source:
    """The source of the experiment in a file, or of the shipped experiment of that name."""
    path = Path(name)
    try:
        is_file, is_folder = path.is_file(), path.is_dir()
    except OSError as error:
        raise ExperimentError(f"{name[:80]}...: {error.strerror}") from None
    if is_file:
        return read_file(path)
    names = shipped_names()
    if name in names:
        return read_text(shipped_text(name), name)
    what = "is a folder" if is_folder else "is no file and no shipped experiment"
    near = [str(p) for p in path.parent.glob("*.yaml")] if path.parent.is_dir() else []
    hint = did_you_mean(name, [*near, *names])
    raise ExperimentError(f"{name}: {what}{hint} (`pbdkit experiments` lists them)")


def _root() -> Traversable:
    return files("pbdkit") / "experiments"


def _found(folder: Traversable, prefix: str) -> list[str]:
    names = []
    for entry in folder.iterdir():
        if entry.is_dir():
            names += _found(entry, f"{prefix}{entry.name}/")
        elif entry.name.endswith(SUFFIX):
            names.append(prefix + entry.name.removesuffix(SUFFIX))
    return names
