"""Browser pages: reports of a dataset, and live bodies moved by the mouse.

Python selects and packs the data, JavaScript draws them.
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
    steps = "Steps an experiment in the browser, led by the mouse."
    page = "Makes one page to share: its motion, curves, all else."
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
    """Return a widget for a notebook, in which the body of an experiment follows the mouse.

    Parameters
    ----------
    experiment : Experiment, mapping, str or path
        As `pbdkit.run` takes it.
    components : iterable of classes
        As in `pbdkit.load`.
    output : str or path, optional
        Where what is done to the body can be saved as an experiment that repeats it bit for bit; by
        default NAME-live.yaml.

    Returns
    -------
    LiveWidget
        Shown by the notebook; ``close()`` ends it.

    Raises
    ------
    ExperimentError, PluginError
        Where anywidget is missing, or the experiment is wrong.
    """
    refuse_without("anywidget", "live", "live needs anywidget")
    from pbdkit.model.loading import as_experiment
    from pbdkit.web.session import Session
    from pbdkit.web.widget import LiveWidget

    loaded = as_experiment(experiment, components)
    return LiveWidget(Session(loaded, Path(output) if output else None))
