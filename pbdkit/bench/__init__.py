"""Work–precision measurements: the cost of each solver against its error (`pbdkit bench`)."""

from __future__ import annotations

from pbdkit.hooks import Command, hookimpl


@hookimpl
def pbdkit_commands() -> list[Command]:
    """Return the command `bench`."""
    does = "Measures speed against error, to choose a solver."
    return [Command("bench", "pbdkit.bench.command:bench", does, "Understand")]
