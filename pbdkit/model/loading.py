"""Load experiments from a file, a shipped name, a dict of parts, or an object.

The file of a sweep or a fit has a field with its base experiment, which is loaded here too.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from pbdkit.errors import ExperimentError, did_you_mean
from pbdkit.model.experiment import Experiment
from pbdkit.model.reading import (
    ALLOW,
    EXPERIMENT,
    OF_PROGRAM,
    FileResolver,
    Settings,
    Source,
    of_kind,
    read_file,
    read_text,
    with_settings,
)
from pbdkit.model.shipped import read_experiment, shipped_names, shipped_text
from pbdkit.model.validation import brief, fault
from pbdkit.plugin import Component
from pbdkit.plugin.registry import Registry

ComponentClasses = Iterable[type[Component]]
ExperimentLike = Experiment | Mapping[str, Any] | str | Path
"""Type of an experiment, or of the dict, the file or the shipped name from which it is made."""


def load_experiment(
    name: str,
    settings: Settings = (),
    components: ComponentClasses = (),
    *,
    allow_outside: bool = False,
) -> Experiment:
    """Return the experiment in a file, or a shipped experiment, and apply settings.

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
    return experiment_of_source(source, settings, components)


def experiment_of_source(
    source: Source, settings: Settings = (), components: ComponentClasses = ()
) -> Experiment:
    """Apply settings to a source that has been read, and return the validated experiment."""
    return Experiment.build(with_settings(source, settings, Experiment.defaults()), components)


def as_experiment(
    experiment: ExperimentLike, components: ComponentClasses = (), settings: Settings = ()
) -> Experiment:
    """Return an experiment from an object, a mapping of its parts, a file or a shipped name.

    Parameters
    ----------
    experiment
        Experiment in one of these forms.
    components
        Component classes in addition to the installed ones.
    settings
        Values to change.

    Raises
    ------
    ExperimentError, PluginError
        If the experiment is invalid, or a component is missing or fails.
    """
    if isinstance(experiment, Experiment):
        # Component classes are checked even if the experiment does not use them.
        Registry(components)
        experiment.refuse_unvalidated()
        return experiment.with_settings(settings) if settings else experiment
    if isinstance(experiment, str | Path):
        return load_experiment(str(experiment), settings, components)
    if _is_dataset(experiment) or not isinstance(experiment, Mapping):
        raise ExperimentError(f"expected an experiment, {but_got(experiment)}")
    source = Source(data=dict(experiment), files=OF_PROGRAM)
    return experiment_of_source(source, settings, components)


def but_got(value: Any) -> str:
    """Return the end of a message, with the value in place of an experiment and the remedy."""
    if _is_dataset(value):
        return (
            "got a dataset, which is a result: `pbdkit.rerun(ds)` runs its experiment again, and "
            "`ds.pbd.experiment()` returns it"
        )
    kind = "a class" if isinstance(value, type) else f"an object of type {type(value).__name__}"
    if isinstance(value, Mapping) or hasattr(value, "refuse_unvalidated"):
        return f"got {kind}; pass it to `pbdkit.run` directly"
    return (
        f"got {kind}; give a file, the name of a shipped experiment as 'paper/a', a dict "
        "of its parts, or a pbdkit.Experiment"
    )


def _is_dataset(value: Any) -> bool:
    return hasattr(value, "data_vars")


def _an_experiment(value: Any) -> Any:
    if not isinstance(value, (str, dict)):
        raise fault(
            "expected the name of a shipped experiment, a file in the folder of this one, or the "
            f"experiment itself, got {brief(value)}"
        )
    return value


Base = Annotated[
    Any, AfterValidator(_an_experiment), Field(json_schema_extra={"type": ["string", "object"]})
]
"""Type of a base experiment: a shipped name, a file, or the experiment itself.
"""


def base_source(path: Path, base: Any, source: Source) -> Source:
    """Return the source of the base experiment of a sweep or fit.

    Parameters
    ----------
    path
        File of the sweep or fit.
    base
        Value of the field `experiment`.
    source
        Source of the sweep or fit.

    Raises
    ------
    ExperimentError
        If the experiment does not exist, or the file cannot be read.
    """
    if isinstance(base, dict):
        inner = {w[1:]: p for w, p in source.places.items() if w[:1] == ("experiment",)}
        return Source(str(path), base, inner, source.files)
    try:
        return _read(path, base, source.files)
    except _NoSuchExperimentError as error:
        text = source.message(("experiment",), str(error))
        raise ExperimentError(text, ("experiment",)) from None


class _NoSuchExperimentError(ExperimentError):
    """The field `experiment` does not refer to an experiment."""


def _read(path: Path, name: str, files: FileResolver) -> Source:
    """Read a file in the folder of another file, or a shipped experiment."""
    accepted = "give a shipped name, or a file in the folder of that file or below it"
    file = (files.folder or path.parent) / name
    try:
        is_file = files.folder is not None and file.is_file()
        is_allowed = files.folder is None or files.holds(file)
    except (OSError, ValueError):
        raise _NoSuchExperimentError(f"{brief(name)} is not the name of a file") from None
    if not is_allowed:
        text = f"{brief(name)} lies outside the folder; {accepted}, or {ALLOW}"
        raise _NoSuchExperimentError(text)
    if is_file:
        return of_kind(EXPERIMENT, read_file(file))
    if name in (names := shipped_names()):
        return read_text(shipped_text(name), name)
    near = chain(path.parent.glob("*.yaml"), path.parent.glob("*.yml"))
    hint = did_you_mean(name, [*(file.name for file in near), *names])
    raise _NoSuchExperimentError(f"{brief(name)} is neither{hint} ({accepted})")
