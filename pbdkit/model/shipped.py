"""Shipped experiments by name."""

from __future__ import annotations

import re
from copy import deepcopy
from functools import lru_cache
from itertools import takewhile
from pathlib import Path

from pbdkit.errors import ExperimentError, did_you_mean
from pbdkit.model.reading import (
    EXPERIMENT,
    FileResolver,
    Source,
    of_kind,
    read_file,
    read_text,
)

FOLDER = Path(__file__).parent.parent / "experiments"
"""Folder of the shipped experiments."""
SUFFIX = ".yaml"
"""Suffix of experiment files."""
MAX_TITLE = 100
"""Number of characters above which a title is cut off at its colon."""


def shipped_names() -> list[str]:
    """Return the names of all shipped experiments, sorted."""
    names = (path.relative_to(FOLDER).as_posix() for path in FOLDER.rglob(f"*{SUFFIX}"))
    return sorted(name.removesuffix(SUFFIX) for name in names)


def shipped_text(name: str) -> str:
    """Return the text of the file of a shipped experiment.

    Raises
    ------
    ExperimentError
        If there is none of that name.
    """
    if name not in (names := shipped_names()):
        hint = did_you_mean(name, names) or "; `pbdkit experiments` lists them"
        raise ExperimentError(f"{name}: is not a shipped experiment{hint}")
    return (FOLDER / f"{name}{SUFFIX}").read_text("utf-8")


def shipped_data(name: str) -> list[Path]:
    """Return the data files that a shipped experiment refers to, from its folder."""
    text, files = shipped_text(name), (FOLDER / name).parent.iterdir()
    data = (path for path in files if path.suffix != SUFFIX and path.is_file())
    return sorted(path for path in data if path.name in text)


def shipped_title(name: str) -> str:
    """Return the first sentence of the file. A long sentence is cut off at its colon."""
    lines = takewhile(lambda line: line.startswith("#"), shipped_text(name).splitlines())
    text = " ".join(line.removeprefix("#").strip() for line in lines)
    sentence = re.split(r"\.(?=\s|$)", text, maxsplit=1)[0]
    if len(sentence) > MAX_TITLE:
        sentence = re.split(r"[:;]\s", sentence, maxsplit=1)[0]
    return f"{sentence}."


def read_experiment(name: str, *, allow_outside: bool = False) -> Source:
    """Read the experiment in a file, or the shipped experiment of that name.

    Parameters
    ----------
    name
        Path of a file, or name of a shipped experiment.
    allow_outside
        Whether the experiment may refer to files outside its folder.

    Raises
    ------
    ExperimentError
        If there is no such experiment, or the file cannot be read.
    """
    path = Path(name)
    try:
        is_file, is_folder = path.is_file(), path.is_dir()
    except OSError as error:
        raise ExperimentError(f"{name[:80]}...: {error.strerror}") from None
    if is_file:
        source = of_kind(EXPERIMENT, read_file(path))
        source.files = FileResolver(path.parent, allow_outside)
        words = re.findall(r"[A-Za-z0-9_]+", path.stem)
        source.data.setdefault("name", "-".join(words)[:MAX_TITLE] or "experiment")
        return source
    names = shipped_names()
    if name in names:
        source = deepcopy(_parsed(shipped_text(name), name))
        source.files = FileResolver((FOLDER / name).parent)
        return source
    what = "is a folder" if is_folder else "is neither a file nor a shipped experiment"
    near = [str(p) for p in path.parent.glob("*.yaml")] if path.parent.is_dir() else []
    hint = did_you_mean(name, [*near, *names])
    raise ExperimentError(f"{name}: {what}{hint} (`pbdkit experiments` lists them)")


@lru_cache(maxsize=64)
def _parsed(text: str, name: str) -> Source:
    """Return the source of a shipped experiment. Copying it is faster than parsing the text."""
    return read_text(text, name)
