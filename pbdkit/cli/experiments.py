"""``pbdkit experiments`` and ``pbdkit init``: the shipped experiments."""

from __future__ import annotations

from pathlib import Path

import click


@click.command()
def experiments() -> None:
    """List the shipped experiments."""
    from pbdkit.experiment.shipped import shipped_names, shipped_text

    names = shipped_names()
    width = max(map(len, names))
    for name in names:
        title = shipped_text(name).splitlines()[0].removeprefix("# ")
        click.echo(f"{name:<{width}}  {title}")


@click.command()
@click.argument("file", default="experiment.yaml", type=click.Path(path_type=Path))
def init(file: Path) -> None:
    """Write a commented experiment to start from."""
    from pbdkit.errors import ExperimentError, StorageError
    from pbdkit.experiment.shipped import shipped_text

    try:
        with file.open("x", encoding="utf-8") as written:
            written.write(shipped_text("start"))
    except FileExistsError:
        raise ExperimentError(f"{file}: exists and is left as it is; name another file") from None
    except OSError as error:
        raise StorageError(f"{file}: cannot be written: {error.strerror}") from None
    click.echo(f"{file} written; next: pbdkit check {file}, then pbdkit run {file}")
