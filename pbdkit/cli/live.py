"""``pbdkit live``: a body that answers to the mouse, in the browser."""

from __future__ import annotations

import asyncio
import signal
from contextlib import suppress
from pathlib import Path

import click

from pbdkit.cli.options import experiment_argument, set_option


@click.command()
@experiment_argument
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="The port; 0: any free one.")
@click.option("--no-browser", is_flag=True, help="Print the address, and open no browser.")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help="Where 'Save as experiment' writes; else NAME-live.yaml.",
)
@set_option
def live(
    experiment: str, port: int, no_browser: bool, output: Path | None, settings: tuple[str, ...]
) -> None:
    """Step an experiment in the browser: lead it with the mouse, turn its numbers, cut it, and save
    what was done as an experiment.

    The page is served to this machine alone, under an address that nobody guesses. Ctrl-C ends it.
    """
    from pbdkit.api import load
    from pbdkit.plugin.discovery import refuse_without
    from pbdkit.web.server import Conductor
    from pbdkit.web.session import Session

    refuse_without("websockets", "live", "live needs websockets")
    from pbdkit.web.server import SessionServer

    loaded = load(experiment, settings=settings)
    conductor = Conductor(Session(loaded, output))
    server = SessionServer(conductor, loaded.name, port)

    def ready(address: str) -> None:
        click.echo(f"{loaded.name} is at {address}")
        click.echo("Ctrl-C ends it.")
        if not no_browser:
            click.launch(address)

    async def serve() -> None:
        end = asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            with suppress(NotImplementedError):  # as on Windows, where Ctrl-C interrupts
                asyncio.get_running_loop().add_signal_handler(number, end.set)
        await server.run(ready, end)

    conductor.start()
    try:
        asyncio.run(serve())
    finally:
        conductor.close()
