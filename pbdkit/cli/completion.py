"""What a shell offers at the tabulator key where an experiment is expected."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import click
    from click.shell_completion import CompletionItem

SUFFIXES = (".yaml", ".yml", ".json")


def complete_experiments(
    context: click.Context, parameter: click.Parameter, begun: str
) -> list[CompletionItem]:
    """The shipped experiments and the experiment files that begin so."""
    from click.shell_completion import CompletionItem

    from pbdkit.experiment.shipped import shipped_names

    names = [name for name in shipped_names() if name.startswith(begun)]
    return [CompletionItem(name) for name in [*names, *_files(begun)]]


def _files(begun: str) -> list[str]:
    """Files that may be experiments, and folders, which end in a slash."""
    folder, _, word = begun.rpartition("/")
    prefix = begun[: len(begun) - len(word)]
    try:
        entries = sorted(Path(folder or prefix or ".").iterdir())
    except OSError:
        return []
    shown = [e for e in entries if e.name.startswith(word) and (word or e.name[0] != ".")]
    return [
        f"{prefix}{entry.name}{'/' if entry.is_dir() else ''}"
        for entry in shown
        if entry.is_dir() or entry.suffix in SUFFIXES
    ]
