"""Pages for a browser: reports of a dataset, and live views of bodies that are moved by the mouse.

Python selects and packs the data, and JavaScript draws them.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pbdkit.errors import refuse_without
from pbdkit.hooks import Command, hookimpl

if TYPE_CHECKING:
    from pbdkit.model.loading import ComponentClasses, ExperimentLike
    from pbdkit.web.widget import LiveWidget


@hookimpl
def pbdkit_commands() -> list[Command]:
    """Return the commands `live` and `report`."""
    module = "pbdkit.web.command_line"
    steps = "Step an experiment in the browser and move it by the mouse."
    page = "Write a result as one HTML page: motion, curves, fracture."
    return [
        Command("live", f"{module}:live", steps, "Run"),
        Command("report", f"{module}:report", page, "Look"),
    ]


def live(
    experiment: ExperimentLike,
    *,
    components: ComponentClasses = (),
    output: str | Path | None = None,
) -> LiveWidget:
    """Return a notebook widget in which the particles of an experiment are moved by the mouse.

    Parameters
    ----------
    experiment : Experiment, mapping, str or path
        Experiment, as for `run`.
    components : iterable of classes
        Component classes that the experiment uses in addition to the installed ones.
    output : str or path, optional
        File in which the widget saves the session as an experiment that repeats it, bit for bit; by
        default NAME-live.yaml.

    Returns
    -------
    LiveWidget
        Widget that the notebook displays; ``close()`` ends the session.

    Raises
    ------
    ExperimentError, PluginError
        If the experiment is invalid, or anywidget is missing.
    """
    refuse_without("anywidget", "live", "live requires anywidget")
    from pbdkit.model.loading import as_experiment
    from pbdkit.web.session import Session
    from pbdkit.web.widget import LiveWidget

    loaded = as_experiment(experiment, components)
    return LiveWidget(Session(loaded, Path(output) if output else None))
