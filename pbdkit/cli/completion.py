"""Completion of command lines with the Tab key: names of experiments and results, and contents of
results.

Click completes files and choices. `setting_completion` completes the settings of experiments.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from glob import escape
from itertools import pairwise
from pathlib import Path
from typing import Any

import click
from click.shell_completion import (
    BashComplete,
    CompletionItem,
    add_completion_class,
    split_arg_string,
)

SUFFIXES = (".yaml", ".yml", ".json")
"""Endings of the names of experiment files."""
RESULT = ".nc"
"""Ending of the names of results."""
MAX_TIMES = 200
"""Maximum number of steps that are offered: the first step, the last step, and some steps between
them."""
Completer = Callable[[click.Context, click.Parameter, str], list[CompletionItem]]
Candidates = Callable[[click.Context, str], Iterable[str | CompletionItem]]


def completer(candidates: Candidates) -> Completer:
    """Return a completer. It offers those candidates that begin with the word to be completed.

    If the candidates cannot be computed, none are offered, because a shell shows no messages.
    """

    def complete(context: click.Context, _: click.Parameter, prefix: str) -> list[CompletionItem]:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                offers = [*candidates(context, prefix)]
        except (Exception, SystemExit):
            return []
        items = [
            offer if isinstance(offer, CompletionItem) else CompletionItem(offer)
            for offer in offers
        ]
        return [item for item in items if item.value.startswith(prefix)]

    return complete


@completer
def experiments(context: click.Context, prefix: str) -> Iterator[str | CompletionItem]:
    """Complete shipped experiments, and experiment files in this folder.

    The shell completes files if no shipped experiment begins with the word.
    """
    names = [name for name in _shipped_names() if name.startswith(prefix)]
    if not names:
        yield CompletionItem(prefix, type="file")
        return
    yield from names
    yield from sorted(p.name for p in Path().glob(f"{escape(prefix)}*") if p.suffix in SUFFIXES)


@completer
def shipped(context: click.Context, prefix: str) -> Iterable[str]:
    """Complete the names of shipped experiments."""
    return _shipped_names()


def _shipped_names() -> list[str]:
    from pbdkit.model.shipped import shipped_names

    return shipped_names()


@completer
def results(context: click.Context, prefix: str) -> Iterator[str | CompletionItem]:
    """Complete the names of results, including unfinished results, and folders."""
    from pbdkit.io.run_store import STORE

    folder = prefix[: prefix.rfind("/") + 1]
    start, has_results = prefix[len(folder) :], False
    for path in sorted(Path(folder).glob(f"{escape(start)}*")):
        if path.name.startswith(".") and not start:
            continue
        name = path.name.removesuffix(STORE)
        if path.is_dir() or name.endswith(RESULT):
            has_results = True
            yield f"{folder}{name}{'/' * path.is_dir()}"
    if not has_results:
        yield CompletionItem(prefix, type="file")


@completer
def variables(context: click.Context, prefix: str) -> Iterator[str]:
    """Complete the name of a variable of particles or bonds, or of its component. The variables are
    those of the result in the command line."""
    with _content(context) as content:
        variables = dict(content.variables)
        objects = (content, *variables.values())
        coordinates = {*" ".join(o.attrs.get("coordinates", "") for o in objects).split()}
        for name, variable in variables.items():
            dims = {*variable.dimensions} - {"time"}
            if name in coordinates | dims or dims - {"axis"} not in ({"particle"}, {"bond"}):
                continue
            yield name
            axes = variables["axis"][...] if "axis" in dims else ()
            yield from (f"{name}_{axis}" for axis in axes)


@completer
def times(context: click.Context, prefix: str) -> Iterator[str]:
    """Complete a step. The candidates are the recorded steps of the result in the command line."""
    with _content(context) as content:
        times = [f"{time}" for time in content.variables["time"][...].tolist()]
    times = [time for time in times if time.startswith(prefix)]
    stride = -(-len(times) // MAX_TIMES)
    yield from dict.fromkeys([*times[:: stride or 1], *times[-1:]])


@contextmanager
def _content(context: click.Context) -> Iterator[Any]:
    """Open the first result in the command line, without using xarray."""
    from pbdkit.io.seal import open_sealed

    paths = [value for value in context.params.values() if isinstance(value, Path)]
    paths += [Path(word) for word in context.args]
    file = open_sealed(next(path for path in paths if path.is_file()))
    try:
        yield file
    finally:
        file.close()


class _Bash(BashComplete):
    """Completion in bash, which splits words at `=` and appends a space to completions.

    With this class `--set rule.K=1` counts as a single word, and no space is added after `=`.
    """

    source_template = BashComplete.source_template.replace(
        "COMPREPLY+=($value)",
        "COMPREPLY+=($value); [[ $value == *[=/] ]] && compopt -o nospace",
    )
    _prefix_length = 0
    """Length of the first part of the word, which bash does not replace."""

    def get_completion_args(self) -> tuple[list[str], str]:
        """Return the words before the one to be completed, and the word to be completed."""
        parts, index = split_arg_string(os.environ["COMP_WORDS"]), int(os.environ["COMP_CWORD"])
        parts = [*parts, ""][: index + 1]
        words = parts[:1]
        for previous, part in pairwise(parts):
            if "=" in (previous, part) and len(words) > 1:
                words[-1] += part
            else:
                words.append(part)
        _, equals, value = words[-1].partition("=")
        value = value if equals and words[-1].startswith("-") else words[-1]
        self._prefix_length = max(0, len(value) - len(parts[-1].removeprefix("=")))
        return words[1:-1], words[-1]

    def format_completion(self, item: CompletionItem) -> str:
        """Return the text of an item without the first part of the word, which bash does not
        replace."""
        return f"{item.type},{item.value[self._prefix_length :]}"


def register_bash() -> None:
    """Register the completion in bash with click."""
    add_completion_class(_Bash)
