"""From a name to the experiment: what reads a file imports little, what validates it much."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from pbdkit.model.shipped import read_experiment

if TYPE_CHECKING:
    from pbdkit.model.experiment import Experiment
    from pbdkit.model.reading import Settings
    from pbdkit.plugin import Component


def load_experiment(
    name: str,
    settings: Settings = (),
    components: Iterable[type[Component]] = (),
    *,
    allow_outside: bool = False,
) -> Experiment:
    """Return the experiment in a file, or the shipped one of that name, with settings applied.

    Raises ExperimentError and PluginError.
    """
    source = read_experiment(name, allow_outside=allow_outside)
    # Imported here: a wrong name is answered without.
    from pbdkit.model.experiment import Experiment
    from pbdkit.model.reading import with_settings

    return Experiment.build(with_settings(source, settings, Experiment.defaults()), components)
