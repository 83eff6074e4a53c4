"""The commands `pbdkit live` and `pbdkit report`."""

from __future__ import annotations

import asyncio
import signal
from contextlib import suppress
from pathlib import Path

import click

from pbdkit.cli.options import (
    PATH,
    at_option,
    experiment_argument,
    load_experiment,
    result_argument,
    set_option,
)
from pbdkit.cli.output import refuse_output, refuse_unwritable
from pbdkit.errors import refuse_without


@click.command()
@experiment_argument
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=0,
    help="Port of the page; 0 selects a free one.",
)
@click.option("--no-browser", is_flag=True, help="Print the address without opening a browser.")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help="File of 'Save as experiment'; default NAME-live.yaml.",
)
@set_option
def live(
    experiment: str, port: int, no_browser: bool, output: Path | None, settings: tuple[str, ...]
) -> None:
    """Step an experiment in the browser: move it with the mouse, change its parameters, cut it, and
    save the session as an experiment.

    The page is served to this machine only, under a secret address. Ctrl-C ends it.
    """
    refuse_without("websockets", "live", "live requires websockets")
    from pbdkit.web.server import Conductor, SessionServer
    from pbdkit.web.session import Session

    loaded = load_experiment(experiment, settings)
    conductor = Conductor(Session(loaded, output))
    server = SessionServer(conductor, loaded.name, port)

    def ready(address: str) -> None:
        click.echo(f"{loaded.name} is served at {address}")
        click.echo("Ctrl-C ends it.")
        if not no_browser:
            click.launch(address)

    async def serve() -> None:
        end = asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            # Windows does not support this; Ctrl-C interrupts there.
            with suppress(NotImplementedError):
                asyncio.get_running_loop().add_signal_handler(number, end.set)
        await server.run(ready, end)

    conductor.start()
    try:
        asyncio.run(serve())
    finally:
        conductor.close()


@click.command()
@result_argument("file")
@click.option("-o", "--output", type=PATH, help="The page; default OUT.html.")
@click.option(
    "--bench", type=PATH, help="Figures written by `pbdkit bench --json`, to be shown in the page."
)
@at_option
@click.option("--force", is_flag=True, help="Replace an existing page.")
def report(
    file: Path, output: Path | None, bench: Path | None, at: dict[str, str], force: bool
) -> None:
    """Write a result as one HTML page: the moving lattice, histories, curves, predictions, broken
    bonds, and the experiment to run it again; for a sweep its map and its members."""
    from pbdkit.io.open import reading
    from pbdkit.io.other_files import refuse_other_file
    from pbdkit.web.report import BUDGET, report as write

    refuse_other_file(file)
    path = output or file.with_suffix(".html")
    refuse_output(path, force=force)
    refuse_unwritable(None, path)
    with reading(file, sweeps=True, at=at) as dataset:
        write(dataset, path, bench=bench, replace=force)
    size = path.stat().st_size
    click.echo(f"{path} written, {size / 1e6:.2g} MB; open it in a browser")
    if size > BUDGET:
        click.echo(
            f"the page is larger than {BUDGET / 1e6:.2g} MB: its content cannot be thinned further"
        )
