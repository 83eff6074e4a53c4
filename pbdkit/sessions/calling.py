"""What Python users call."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from pbdkit.api import Given, as_experiment
from pbdkit.interfaces import Component
from pbdkit.registry.extras import refuse_without
from pbdkit.sessions.session import Session

if TYPE_CHECKING:
    from pbdkit.sessions.widget import LiveWidget


def live(
    experiment: Given,
    *,
    components: Iterable[type[Component]] = (),
    output: str | Path | None = None,
) -> LiveWidget:
    """A widget for a notebook: the body of an experiment answers to the mouse.

    What is done to it can be saved as an experiment, at `output` or as NAME-live.yaml, that repeats
    it bit for bit. ``widget.close()`` ends it. Raises ExperimentError where anywidget is missing,
    and for an experiment of which there is no scene; PluginError.
    """
    refuse_without("anywidget", "live", "live needs anywidget")
    from pbdkit.sessions.widget import LiveWidget

    found = as_experiment(experiment, components)
    return LiveWidget(Session(found, Path(output) if output else None))
