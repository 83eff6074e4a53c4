"""The verbs of pbdkit for Python users: from a file, a dict or an object to an experiment, its
dataset, and what is known of both."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pbdkit.errors import DivergedError, ExperimentError, ReproducibilityWarning, warn_caller
from pbdkit.io.layout import experiment_of as experiment_of, json_attribute
from pbdkit.io.sinks import MemorySink, Sink
from pbdkit.model.experiment import Experiment
from pbdkit.model.loading import as_experiment, but_got, load_experiment
from pbdkit.plugin.registry import GIVEN
from pbdkit.progress import Watch, progress_bar
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.simulation import FAILED, RunReport, Simulation, record
from pbdkit.stability.forecast import refuse_too_much_output
from pbdkit.stability.relaxation import tuned

if TYPE_CHECKING:
    import xarray
    from distributed import Client

    from pbdkit.fitting.fit_result import Fitted
    from pbdkit.fitting.strength import FittedStrength
    from pbdkit.identification.identity import Identity
    from pbdkit.model.loading import ComponentClasses, ExperimentLike
    from pbdkit.model.reading import Settings, Source
    from pbdkit.stability.analysis import Analysis


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

    Returns
    -------
    Experiment
        Validated as a whole.

    Raises
    ------
    ExperimentError, PluginError
        Where the file or a setting is wrong, or a plugin is missing or broken.

    Examples
    --------
    >>> experiment = pbdkit.load("paper/a", settings={"steps": 20})
    """
    if not isinstance(name, str | Path):
        raise ExperimentError(
            f"load: expected a file or the name of a shipped experiment, {but_got(name)}"
        )
    return load_experiment(str(name), settings, components, allow_outside=allow_outside)


def run(
    experiment: ExperimentLike,
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

    Returns
    -------
    xarray.Dataset
        What the experiment records, with everything that makes it again in its attributes.

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
    SceneWarning, StabilityWarning, AccuracyWarning
        As `pbdkit run` does, of what is doubtful in the scene or can diverge (but for what takes
        an analysis: `analyse(experiment).warnings()`), and of a last state
        that is inside out. They are classes of `pbdkit.errors`, under PbdkitWarning.

    Examples
    --------
    >>> ds = pbdkit.run("paper/a", progress=False)
    >>> ds.position.sel(time=400, particle=67)
    """
    loaded = as_experiment(experiment, components, settings)
    return _run(loaded, progress, None if output is None else Path(output), force)


def _run(
    experiment: Experiment, progress: bool, output: Path | None = None, force: bool = False
) -> xarray.Dataset:
    if output is not None:
        return _run_into(output, experiment, progress, force)
    memory, scene = MemorySink(), build_scene(experiment)
    refuse_too_much_output(scene)
    report = _recorded(scene, lambda simulation: memory, progress)
    return _finished(report, memory.dataset())


def _run_into(output: Path, experiment: Experiment, progress: bool, force: bool) -> xarray.Dataset:
    from pbdkit.io.netcdf import NetcdfSink
    from pbdkit.io.open import open
    from pbdkit.io.save import refuse_existing

    refuse_existing(output, force=force)
    scene = build_scene(experiment)
    file = NetcdfSink(output, force, experiment.record.compression)
    report = _recorded(scene, lambda simulation: simulation.sink(file), progress)
    return _finished(report, open(file.written))


def _recorded(scene: Scene, sink_of: Callable[[Simulation], Sink], progress: bool) -> RunReport:
    with progress_bar(progress) as show:
        simulation = Simulation.of_scene(scene, watch=Watch(show=show))
        _warn(simulation.warnings)
        return record(simulation, sink_of(simulation))


def _finished(report: RunReport, dataset: xarray.Dataset) -> xarray.Dataset:
    if report.outcome.status in FAILED:
        raise DivergedError(report.outcome.stop_reason, dataset)
    _warn(report.warnings)
    return dataset


def _warn(texts: Iterable[str]) -> None:
    for text in texts:
        warn_caller(text)


def analyse(
    experiment: ExperimentLike, *, components: ComponentClasses = (), settings: Settings = ()
) -> Analysis:
    """Return what is known of a run before its first step.

    Parameters
    ----------
    experiment, components, settings
        As in `run`.

    Returns
    -------
    Analysis
        Stability, eigenvalues, steps to a tolerance, and the step operator as a sparse matrix
        (``.operator``); ``print`` shows a summary.

    Raises
    ------
    ExperimentError, PluginError
        Where the experiment is wrong, or a plugin is missing or broken.

    Examples
    --------
    >>> pbdkit.analyse("paper/a").spectral_radius
    """
    from pbdkit.stability.analysis import Analysis

    return Analysis(tuned(build_scene(as_experiment(experiment, components, settings))))


def identify(
    experiment: ExperimentLike, *, components: ComponentClasses = (), settings: Settings = ()
) -> Identity:
    """Return what the experiment's rule is physically, on its lattice and neighbours: diffusion or
    an elastic body, with its constants, from the rule's answer to plane waves.

    Where its numbers differ from place to place it is that of the first of
    ``experiment.materials()``, which are experiments of one material each, by name.

    Parameters
    ----------
    experiment, components, settings
        As in `run`.

    Returns
    -------
    Identity
        The kind of continuum and its constants; ``print`` shows a summary.

    Raises
    ------
    ExperimentError, PluginError
        Where the experiment is wrong, or a plugin is missing or broken.

    Examples
    --------
    >>> print(pbdkit.identify("material/bar"))
    """
    from pbdkit.identification.probe import identified

    first = next(iter(as_experiment(experiment, components, settings).materials().values()))
    return identified(tuned(build_scene(first)))


def rerun(
    dataset: xarray.Dataset, *, components: ComponentClasses = (), progress: bool = True
) -> xarray.Dataset:
    """Run the experiment that a dataset carries again, bit for bit.

    Parameters
    ----------
    dataset : xarray.Dataset
        The result of a run.
    components, progress
        As in `run`.

    Returns
    -------
    xarray.Dataset
        The new result.

    Raises
    ------
    ExperimentError, PluginError, DivergedError
        As `run` does, and for a dataset without an experiment.

    Warns
    -----
    ReproducibilityWarning
        Where other versions made the dataset than are installed.
    """
    experiment = experiment_of(dataset, components)
    _warn_of_versions(dataset, experiment)
    return _run(experiment, progress)


def resume(
    output: str | Path, *, steps: int | None = None, anyway: bool = False, progress: bool = True
) -> xarray.Dataset:
    """Go on with the unfinished run that was to write a file, or continue a finished one.

    Parameters
    ----------
    output : str or path
        The file.
    steps : int, optional
        The number of steps to which a finished run is continued.
    anyway : bool
        Go on also where the experiment, pbdkit or a plugin changed since.
    progress : bool
        Show how far the run is.

    Returns
    -------
    xarray.Dataset
        The dataset in the file: that of the uninterrupted run, bit for bit.

    Raises
    ------
    ExperimentError
        Where there is nothing to go on with, another process writes the file, or something changed
        since.
    StorageError
        For a damaged store or disk.
    DivergedError
        As `run` does, with no dataset: the file holds it.
    """
    from pbdkit.io.open import open
    from pbdkit.restart import resumption

    path = Path(output)
    with progress_bar(progress) as show:
        resumed = resumption(path, Watch(show=show), steps=steps, anyway=anyway)
        if resumed is None:
            return open(path)
        _warn(resumed.run.warnings)
        report = resumed.record()
    if report.outcome.status in FAILED:
        raise DivergedError(report.outcome.stop_reason)
    _warn(report.warnings)
    return open(resumed.sink.written)


def _warn_of_versions(dataset: xarray.Dataset, experiment: Experiment) -> None:
    installed = {"pbdkit": version("pbdkit")} | experiment.distributions()
    made_by = {"pbdkit": dataset.attrs.get("pbdkit_version")} | json_attribute(dataset, "plugins")
    for name, current in installed.items():
        original = made_by.get(name)
        if name != GIVEN and original != current:
            maker = f"{name} {original}" if original else f"an unknown version of {name}"
            text = f"made by {maker}, run again by {current}: the result may differ"
            warn_caller(text, ReproducibilityWarning)


def sweep(
    experiment: ExperimentLike,
    *,
    vary: Mapping[str, Any] | None = None,
    together: Mapping[str, Any] | None = None,
    replicates: int = 1,
    keep: Mapping[str, Any] | None = None,
    names: Mapping[str, str] | None = None,
    folder: str | Path | None = None,
    workers: int | None = None,
    client: Client | None = None,
    progress: bool = True,
) -> xarray.Dataset:
    """Run an experiment over the product of some values, and return one dataset.

    Parameters
    ----------
    experiment : Experiment, mapping, str or path
        As in `run`.
    vary : mapping
        Lists of values by the path of the parameter, of which the product is run.
    together : mapping
        Lists of one length, which are varied at once.
    replicates : int
        Runs of each member, with seeds of their own.
    keep : mapping
        The ``variables`` and ``times`` to keep; by default everything.
    names : mapping
        Names of the new dimensions by path.
    folder : str or path, optional
        Keeps what is finished: the same call again runs the rest.
    workers : int, optional
        Processes of this machine: by default as many as it has processors; 1 is this one alone.
    client : dask.distributed.Client, optional
        A cluster in place of processes of this machine.
    progress : bool
        Show how many members have been run.

    Returns
    -------
    xarray.Dataset
        What `pbdkit sweep` would write, with the parameters as dimensions. A member that failed is
        NaN, and its ``message`` is the reason.

    Raises
    ------
    ExperimentError, PluginError
        Before anything runs.

    Warns
    -----
    SweepWarning
        Of members without values.
    StorageWarning
        Of damaged members in the folder, which run again.

    Examples
    --------
    >>> pbdkit.sweep("paper/d1", vary={"solver.relaxation": [0.5, 1.0]})
    """
    from pbdkit.sweeps.execute import called

    base = as_experiment(experiment)
    parts = {"vary": vary or {}, "together": together or {}, "keep": keep or {}}
    parts["names"] = names or {}
    return called(base, parts | {"replicates": replicates}, folder, workers, client, progress)


def fit(
    description: Mapping[str, Any] | str | Path,
    *,
    experiment: ExperimentLike | None = None,
    measured: xarray.Dataset | None = None,
    components: ComponentClasses = (),
) -> Fitted | FittedStrength:
    """Fit parameters of an experiment to measurements, or strengths to peaks of repeated tests.

    Parameters
    ----------
    description : mapping, str or path
        A fit file, the name of a shipped one, or a dict of the same.
    experiment : Experiment, mapping, str or path, optional
        Takes the place of that in the description.
    measured : xarray.Dataset, optional
        Takes the place of the file of the measurement: a variable for each of its ``columns``, all
        of one size, as x, y, ux and uy of a field.
    components : iterable of classes
        As in `load`.

    Returns
    -------
    Fitted or FittedStrength
        The values with their errors and correlations; ``print`` shows a summary. It is a
        FittedStrength where the description has ``kind: strength``.

    Raises
    ------
    ExperimentError, PluginError
        Where the description, the experiment or the measurement is wrong.
    DivergedError
        Where no fit is found.

    Examples
    --------
    >>> print(pbdkit.fit("plate-with-hole"))
    """
    from pbdkit.equilibrium.error_bound import UnconvergedError
    from pbdkit.fitting.fit import fit_experiment
    from pbdkit.fitting.fit_file import Fit, is_strength_fit, read_fit

    if is_strength_fit(description):
        if measured is not None:
            raise ExperimentError(
                "measured: a fit of strength is to peaks; list them under `measured` of the fit"
            )
        return fit_strength(description, experiment=experiment, components=components)
    problem, source = read_fit(
        Fit, description, has_experiment=experiment is not None, measured=measured
    )
    try:
        return fit_experiment(
            problem, _experiment_of_fit(experiment, source, components), components
        )
    except UnconvergedError as error:
        raise DivergedError(str(error)) from None


def fit_strength(
    description: Mapping[str, Any] | str | Path,
    *,
    experiment: ExperimentLike | None = None,
    components: ComponentClasses = (),
) -> FittedStrength:
    """Fit the strength of bonds and its scatter, as `fit` does for ``kind: strength``.

    Parameters
    ----------
    description, experiment, components
        As in `fit`.

    Returns
    -------
    FittedStrength
        The values with their intervals; ``print`` shows a summary.

    Raises
    ------
    ExperimentError, PluginError
        Where the description, the experiment or the measurement is wrong.
    DivergedError
        Where a specimen has no equilibrium.
    """
    from pbdkit.equilibrium.error_bound import UnconvergedError
    from pbdkit.fitting.fit_file import StrengthFit, read_fit
    from pbdkit.fitting.strength import fit_strength_of

    problem, source = read_fit(StrengthFit, description, has_experiment=experiment is not None)
    fitted = _experiment_of_fit(experiment, source, components)
    try:
        return fit_strength_of(problem, fitted)
    except UnconvergedError as error:
        raise DivergedError(str(error)) from None


def _experiment_of_fit(
    experiment: ExperimentLike | None, source: Source, components: ComponentClasses
) -> Experiment:
    """Return the experiment of a fit, the caller's or that of its source."""
    if experiment is None:
        return Experiment.build(source, components)
    return as_experiment(experiment, components)
