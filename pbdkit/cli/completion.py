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
    """The shipped experiments and the experiment files here that begin so; where no shipped one
    does, whatever the shell itself offers as files."""
    from click.shell_completion import CompletionItem

    from pbdkit.experiment.shipped import shipped_names

    names = [name for name in shipped_names() if name.startswith(begun)]
    if not names:
        return [CompletionItem(begun, type="file")]
    return [CompletionItem(name) for name in [*names, *_experiment_files(begun)]]


def _experiment_files(begun: str) -> list[str]:
    files = [path for path in Path().glob("*") if path.suffix in SUFFIXES]
    return sorted(path.name for path in files if path.name.startswith(begun))
