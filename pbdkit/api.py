"""What Python users call: from a file, a dict or an object to an experiment and its dataset."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pbdkit.errors import DivergedError, ExperimentError, PbdkitWarning, warn_caller
from pbdkit.io.layout import carried
from pbdkit.io.layout import experiment_of as experiment_of
from pbdkit.io.sinks import MemorySink, Sink
from pbdkit.model.experiment import Experiment
from pbdkit.model.loading import load_experiment
from pbdkit.model.reading import OF_PROGRAM, Settings, Source, with_settings
from pbdkit.plugin import Component
from pbdkit.plugin.registry import GIVEN, Registry
from pbdkit.progress import Watch, progress_bar
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.simulation import FAILED, Run, RunReport, record
from pbdkit.stability.forecast import refuse_too_much_output
from pbdkit.stability.relaxation import tuned

if TYPE_CHECKING:
    import xarray

    from pbdkit.fitting.result import Fitted
    from pbdkit.fitting.strength import FittedStrength
    from pbdkit.identification.report import Identity
    from pbdkit.stability.analysis import Analysis

ComponentClasses = Iterable[type[Component]]
Given = Experiment | Mapping[str, Any] | str | Path
"""An experiment, or the dict, the file or the name of a shipped one of which it is made."""


def load(
    name: str | Path,
    *,
    components: ComponentClasses = (),
    settings: Settings = (),
    allow_outside: bool = False,
) -> Experiment:
    """Return the experiment in a YAML file, or the shipped one of that name.

    Parameters
    ----------
    name : str or path
        A file, or the name of a shipped experiment, e.g. "paper/a".
    components : iterable of classes
        Classes from Python that the experiment may name besides the installed ones.
    settings : mapping, or iterable of str
        Values to change: ``{"steps": 20, "rule": {"relaxation": 0.3}}`` or ``["steps=20",
        "rule.relaxation=0.3"]``.
    allow_outside : bool
        Whether files that the experiment names, of fields and motions, may lie outside its folder.

    Raises
    ------
    ExperimentError, PluginError
        Where the file or a setting is wrong, or a plugin is missing or broken.
    """
    if not isinstance(name, str | Path):
        raise ExperimentError(
            f"load: expected a file or the name of a shipped experiment, {_but_got(name)}"
        )
    return load_experiment(str(name), settings, components, allow_outside=allow_outside)


def run(
    experiment: Given,
    *,
    components: ComponentClasses = (),
    settings: Settings = (),
    output: str | Path | None = None,
    force: bool = False,
    progress: bool = True,
) -> xarray.Dataset:
    """Run an experiment and return its dataset.

    Parameters
    ----------
    experiment : Experiment, mapping, str or path
        An experiment, a dict of its parts, a file or the name of a shipped one.
    components, settings
        As in `load`.
    output : str or path, optional
        A file to write as `pbdkit run` does: sealed, and kept while it runs, so that
        `pbdkit.resume` goes on with it where it is interrupted. The dataset is then that of the
        file, whose values are read when they are used. By default nothing is written.
    force : bool
        Replace an existing file.
    progress : bool
        Show how far the run is.

    Raises
    ------
    ExperimentError, PluginError
        Where the experiment is wrong, a plugin is missing or broken, or the output exists.
    StorageError
        Where the output cannot be written.
    DivergedError
        With what was recorded before, where the run leaves the finite numbers, has no equilibrium,
        or comes apart on the way to one (status "separated").

    Warns
    -----
    PbdkitWarning
        As `pbdkit run` does, of what is doubtful in the scene or can diverge (but for what takes
        an analysis: `analyse(experiment).warnings()`), and of a last state
        that is inside out.
    """
    found = as_experiment(experiment, components, settings)
    return _run(found, progress, None if output is None else Path(output), force)


def _run(
    experiment: Experiment, progress: bool, output: Path | None = None, force: bool = False
) -> xarray.Dataset:
    if output is not None:
        return _run_into(output, experiment, progress, force)
    memory, scene = MemorySink(), build_scene(experiment)
    refuse_too_much_output(scene)
    report = _recorded(scene, lambda run: memory, progress)
    return _finished(report, memory.dataset())


def _run_into(output: Path, experiment: Experiment, progress: bool, force: bool) -> xarray.Dataset:
    from pbdkit.io.netcdf import NetcdfSink
    from pbdkit.io.open import open
    from pbdkit.io.save import refuse_taken

    refuse_taken(output, force=force)
    scene = build_scene(experiment)
    file = NetcdfSink(output, force, experiment.record.compression)
    report = _recorded(scene, lambda run: run.sink(file), progress)
    return _finished(report, open(file.written))


def _recorded(scene: Scene, sink_of: Callable[[Run], Sink], progress: bool) -> RunReport:
    with progress_bar(progress) as show:
        run = Run(scene, watch=Watch(show=show))
        _warn(run.warnings)
        return record(run, sink_of(run))


def _finished(report: RunReport, dataset: xarray.Dataset) -> xarray.Dataset:
    if report.outcome.status in FAILED:
        raise DivergedError(report.outcome.stop_reason, dataset)
    _warn(report.warnings)
    return dataset


def _warn(texts: Iterable[str]) -> None:
    for text in texts:
        warn_caller(text)


def analyse(
    experiment: Given, *, components: ComponentClasses = (), settings: Settings = ()
) -> Analysis:
    """What is known of a run before its first step: stability, eigenvalues, steps to a tolerance,
    and the step operator as a sparse matrix (``.operator``)."""
    from pbdkit.stability.analysis import Analysis

    return Analysis(tuned(build_scene(as_experiment(experiment, components, settings))))


def identify(
    experiment: Given, *, components: ComponentClasses = (), settings: Settings = ()
) -> Identity:
    """What the experiment's rule is physically, on its lattice and neighbours: diffusion or an
    elastic body, with its constants, from the rule's answer to plane waves.

    Where its numbers differ from place to place it is that of the first of
    ``experiment.materials()``, which are experiments of one material each, by name.
    """
    from pbdkit.identification.probe import identified

    first = next(iter(as_experiment(experiment, components, settings).materials().values()))
    return identified(tuned(build_scene(first)))


def rerun(
    dataset: xarray.Dataset, *, components: ComponentClasses = (), progress: bool = True
) -> xarray.Dataset:
    """The same run again, bit for bit, from the experiment that the dataset carries.

    Warns, with pbdkit.PbdkitWarning, where other versions made the dataset than are installed.
    """
    experiment = experiment_of(dataset, components)
    _warn_of_versions(dataset, experiment)
    return _run(experiment, progress)


def resume(
    output: str | Path, *, steps: int | None = None, anyway: bool = False, progress: bool = True
) -> xarray.Dataset:
    """Goes on with the unfinished run that was to write `output`, or continues a finished one to
    so many `steps`, and returns the dataset in the file: that of the uninterrupted run, bit for
    bit.

    Raises ExperimentError where there is nothing to go on with, where another process writes it
    and, unless `anyway`, where the experiment, pbdkit or a plugin changed since; StorageError for a
    damaged store or disk; DivergedError, as `run` does, with no dataset: the file holds it.
    """
    from pbdkit.io.open import open
    from pbdkit.restart import resumption

    path = Path(output)
    with progress_bar(progress) as show:
        found = resumption(path, Watch(show=show), steps=steps, anyway=anyway)
        if found is None:
            return open(path)
        _warn(found.run.warnings)
        report = found.record()
    if report.outcome.status in FAILED:
        raise DivergedError(report.outcome.stop_reason)
    _warn(report.warnings)
    return open(found.sink.written)


def _warn_of_versions(dataset: xarray.Dataset, experiment: Experiment) -> None:
    here = {"pbdkit": version("pbdkit")} | experiment.distributions()
    made_by = {"pbdkit": dataset.attrs.get("pbdkit_version")} | carried(dataset, "plugins")
    for name, now in here.items():
        before = made_by.get(name)
        if name != GIVEN and before != now:
            whose = f"{name} {before}" if before else f"an unknown version of {name}"
            text = f"made by {whose}, run again by {now}: the result may differ"
            warnings.warn(text, PbdkitWarning, stacklevel=3)


def sweep(
    experiment: Given,
    vary: Mapping[str, Any] | None = None,
    together: Mapping[str, Any] | None = None,
    replicates: int = 1,
    keep: Mapping[str, Any] | None = None,
    names: Mapping[str, str] | None = None,
    folder: str | Path | None = None,
    workers: int | None = None,
    client: Any = None,
    progress: bool = True,
) -> xarray.Dataset:
    """Runs an experiment over the product of the values in `vary`, the lists in `together`, and
    replicates with seeds of their own; returns one dataset with the parameters as dimensions.

    The arguments are those of a sweep file, and so is what `pbdkit sweep` would write. `folder`
    keeps what is finished: the same call again runs the rest. `workers` are processes of this
    machine, as many as it has processors if None, this process alone if 1; `client` takes a dask
    cluster instead. A member that fails is NaN in the dataset, which says why in `message`; warns
    of it with pbdkit.PbdkitWarning. Raises ExperimentError and PluginError before anything runs.
    """
    from pbdkit.sweeps.execute import called

    given = as_experiment(experiment, ())
    parts = {"vary": vary or {}, "together": together or {}, "keep": keep or {}}
    parts["names"] = names or {}
    return called(given, parts | {"replicates": replicates}, folder, workers, client, progress)


def fit(
    description: Mapping[str, Any] | str | Path,
    *,
    experiment: Given | None = None,
    components: ComponentClasses = (),
) -> Fitted:
    """Parameters of an experiment from what was measured, with their uncertainty.

    `description` is a fit file, the name of a shipped one, or a dict of the same; `experiment`
    takes the place of its own. Raises ExperimentError and PluginError, and DivergedError where no
    fit is found.
    """
    from pbdkit.equilibrium.certificate import UnconvergedError
    from pbdkit.fitting.fit import fit_experiment
    from pbdkit.fitting.specification import described_fit

    asked, source = described_fit(description, given=experiment is not None)
    found = as_experiment(experiment, components) if experiment is not None else None
    try:
        return fit_experiment(asked, found or Experiment.build(source, components), components)
    except UnconvergedError as error:
        raise DivergedError(str(error)) from None


def fit_strength(
    description: Mapping[str, Any] | str | Path,
    *,
    experiment: Given | None = None,
    components: ComponentClasses = (),
) -> FittedStrength:
    """The strength of bonds and its scatter from the peaks of repeated tests, with their
    uncertainty.

    `description` is a strength fit file, the name of a shipped one, or a dict of the same;
    `experiment` takes the place of its own. Raises ExperimentError and PluginError, and
    DivergedError where a specimen finds no equilibrium.
    """
    from pbdkit.equilibrium.certificate import UnconvergedError
    from pbdkit.fitting.strength import described_strength_fit, fit_strength_of

    asked, source = described_strength_fit(description, given=experiment is not None)
    found = as_experiment(experiment, components) if experiment is not None else None
    try:
        return fit_strength_of(asked, found or Experiment.build(source, components))
    except UnconvergedError as error:
        raise DivergedError(str(error)) from None


def as_experiment(
    given: Given, components: ComponentClasses, settings: Settings = ()
) -> Experiment:
    """Return the experiment that is given in one of these ways, with the settings."""
    if isinstance(given, Experiment):
        Registry(components)  # what is handed over is checked, needed or not
        given.refuse_unvalidated()
        return given.with_settings(settings) if settings else given
    if isinstance(given, str | Path):
        return load(given, components=components, settings=settings)
    if _is_dataset(given) or not isinstance(given, Mapping):
        raise ExperimentError(f"expected an experiment, {_but_got(given)}")
    source = Source(data=dict(given), beside=OF_PROGRAM)
    source = with_settings(source, settings, Experiment.defaults())
    return Experiment.build(source, components)


def _is_dataset(given: Any) -> bool:
    return hasattr(given, "data_vars")


def _but_got(given: Any) -> str:
    """Return what was given in place of an experiment, and what takes or makes it."""
    if _is_dataset(given):
        return (
            "got a dataset, which is a result: `pbdkit.rerun(ds)` runs its experiment again, and "
            "`ds.pbd.experiment()` returns it"
        )
    if isinstance(given, Experiment | Mapping):
        return f"got {_kind(given)}, which needs no loading: `pbdkit.run` takes it as it is"
    return (
        f"got {_kind(given)}; give a file, the name of a shipped experiment as 'paper/a', a dict "
        "of its parts, or a pbdkit.Experiment"
    )


def _kind(given: Any) -> str:
    return "a class" if isinstance(given, type) else f"an object of type {type(given).__name__}"
