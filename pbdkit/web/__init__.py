"""Pages of HTML that show a dataset: what Python gathers for them, and what a browser draws.

A body that answers to the mouse: what is done to it is what an experiment file can say.
"""

from __future__ import annotations

from pbdkit.plugin import Command, hookimpl


@hookimpl
def pbdkit_commands() -> list[Command]:
    """Return the commands `live` and `report`."""
    module = "pbdkit.web.command_line"
    steps = "Steps an experiment in the browser, led by the mouse."
    page = "Makes one page to share: its motion, curves, all else."
    return [
        Command("live", f"{module}:live", steps, "Run"),
        Command("report", f"{module}:report", page, "Look"),
    ]
