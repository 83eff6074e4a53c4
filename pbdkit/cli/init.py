"""Commands ``pbdkit init`` and ``experiments``: experiments to start from."""

from __future__ import annotations

import os
from pathlib import Path

import click

from pbdkit.errors import ExperimentError
from pbdkit.io.atomic_file import remove_leftovers, write_together
from pbdkit.model.shipped import (
    SUFFIX,
    shipped_data,
    shipped_names,
    shipped_text,
    shipped_title,
)

START = "start"
"""The shipped experiment that `init` writes by default."""


def experiments(name: str | None) -> None:
    """List the shipped experiments, or print the file of one, e.g. paper/f1."""
    if name is not None:
        click.echo(shipped_text(name), nl=False)
        return
    width = max(map(len, names := shipped_names()))
    for shipped in names:
        click.echo(f"{shipped:<{width}}  {shipped_title(shipped)}")


def init(file: Path | None, origin: str | None) -> None:
    """Write an experiment to start from: a commented one, or a copy of a shipped one.

    FILE is experiment.yaml by default. With --from, it is the last part of NAME, followed by .yaml.
    """
    path, text = (
        file or Path(Path(origin or "experiment").name + SUFFIX),
        shipped_text(origin or START),
    )
    if origin is None and str(path) in shipped_names():
        copy = f"`pbdkit init {path.name}{SUFFIX} --from {path}` copies it"
        raise ExperimentError(f"{path}: is the name of a shipped experiment, not a file; {copy}")
    data = shipped_data(origin) if origin else []
    tables = {path.with_name(d.name): d.read_bytes() for d in data}
    for table, content in [*tables.items()]:
        if _contains(table, content):  # An earlier call that was killed has written it.
            remove_leftovers(table)
            del tables[table]
    files = tables | {path: text.encode()}
    for target in files:
        if os.path.lexists(target):
            raise ExperimentError(f"{target}: exists and is not replaced; name another file")
    write_together(files)
    remark = f" with {', '.join(d.name for d in data)}" if data else ""
    click.echo(f"{path} written{remark}; next: pbdkit check {path}, then pbdkit run {path}")


def _contains(path: Path, content: bytes) -> bool:
    """Return whether a file exists and has a content."""
    return path.is_file() and path.read_bytes() == content
