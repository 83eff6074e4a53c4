"""Load experiments from a file, a shipped name, a dict of parts, or an object.

Modules for validation are imported only after the file is read.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pbdkit.errors import ExperimentError
from pbdkit.model.shipped import read_experiment

if TYPE_CHECKING:
    from pbdkit.model.experiment import Experiment
    from pbdkit.model.reading import Settings
    from pbdkit.plugin import Component

    ComponentClasses = Iterable[type[Component]]
    ExperimentLike = Experiment | Mapping[str, Any] | str | Path
    """An experiment, or the dict, the file or the name of a shipped one of which it is made."""


def load_experiment(
    name: str,
    settings: Settings = (),
    components: ComponentClasses = (),
    *,
    allow_outside: bool = False,
) -> Experiment:
    """Return the experiment in a file, or the shipped experiment of that name, with settings
    applied.

    Parameters
    ----------
    name
        Path of a file, or name of a shipped experiment.
    settings
        Values to change, as for `Experiment.with_settings`.
    components
        Component classes in addition to the installed ones.
    allow_outside
        Whether the experiment may refer to files outside its folder.

    Raises
    ------
    ExperimentError
        If the experiment is invalid.
    PluginError
        If a component is missing or fails.
    """
    source = read_experiment(name, allow_outside=allow_outside)
    from pbdkit.model.experiment import Experiment
    from pbdkit.model.reading import with_settings

    return Experiment.build(with_settings(source, settings, Experiment.defaults()), components)


def as_experiment(
    given: ExperimentLike, components: ComponentClasses = (), settings: Settings = ()
) -> Experiment:
    """Return the experiment that is given in one of these ways, with the settings.

    Raises ExperimentError and PluginError.
    """
    from pbdkit.model.experiment import Experiment
    from pbdkit.model.reading import OF_PROGRAM, Source, with_settings
    from pbdkit.plugin.registry import Registry

    if isinstance(given, Experiment):
        Registry(components)  # what is handed over is checked, needed or not
        given.refuse_unvalidated()
        return given.with_settings(settings) if settings else given
    if isinstance(given, str | Path):
        return load_experiment(str(given), settings, components)
    if _is_dataset(given) or not isinstance(given, Mapping):
        raise ExperimentError(f"expected an experiment, {but_got(given)}")
    source = Source(data=dict(given), files=OF_PROGRAM)
    source = with_settings(source, settings, Experiment.defaults())
    return Experiment.build(source, components)


def but_got(given: Any) -> str:
    """Return what was given in place of an experiment, and what takes or makes it."""
    if _is_dataset(given):
        return (
            "got a dataset, which is a result: `pbdkit.rerun(ds)` runs its experiment again, and "
            "`ds.pbd.experiment()` returns it"
        )
    kind = "a class" if isinstance(given, type) else f"an object of type {type(given).__name__}"
    if isinstance(given, Mapping) or hasattr(given, "refuse_unvalidated"):
        return f"got {kind}, which needs no loading: `pbdkit.run` takes it as it is"
    return (
        f"got {kind}; give a file, the name of a shipped experiment as 'paper/a', a dict "
        "of its parts, or a pbdkit.Experiment"
    )


def _is_dataset(given: Any) -> bool:
    return hasattr(given, "data_vars")
