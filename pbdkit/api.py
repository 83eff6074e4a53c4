"""Functions of pbdkit for Python users: load, run, repeat, sweep, fit and analyse experiments."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pbdkit.errors import DivergedError, ExperimentError, ReproducibilityWarning, warn_caller
from pbdkit.hooks import pbdkit_version
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
    from pbdkit.fitting.specimens import FittedSpecimens
    from pbdkit.fitting.strength import FittedStrength
    from pbdkit.identification.identity import Identity
    from pbdkit.model.loading import ComponentClasses, ExperimentLike
    from pbdkit.model.reading import Settings
    from pbdkit.stability.analysis import Analysis


def load(
    name: str | Path,
    *,
    components: ComponentClasses = (),
    settings: Settings = (),
    allow_outside: bool = False,
) -> Experiment:
    """Read and validate an experiment.

    Parameters
    ----------
    name : str or path
        YAML file, or name of a shipped experiment such as "paper/a".
    components : iterable of classes
        Component classes that the experiment uses in addition to the installed ones.
    settings : mapping, or iterable of str
        Values that replace those of the file: ``{"steps": 20, "rule": {"relaxation": 0.3}}`` or
        ``["steps=20", "rule.relaxation=0.3"]``.
    allow_outside : bool
        Accept files of fields and motions that are outside the folder of the experiment.

    Returns
    -------
    Experiment
        Validated experiment.

    Raises
    ------
    ExperimentError, PluginError
        If the file or a setting is invalid, or a plugin is missing or broken.

    Examples
    --------
    >>> experiment = pbdkit.load("paper/a", settings={"steps": 20})
    >>> experiment.steps
    20
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
        Experiment, dict of its parts, YAML file, or name of a shipped experiment.
    components : iterable of classes
        Component classes that the experiment uses in addition to the installed ones.
    settings : mapping, or iterable of str
        Values that replace those of the experiment, as for `load`.
    output : str or path, optional
        File to which the result is written, with checksums and checkpoints, so that `resume` can
        continue an interrupted run. The values of the returned dataset are then read from the file
        when they are used. By default no file is written.
    force : bool
        Replace an existing file.
    progress : bool
        Show a progress bar.

    Returns
    -------
    xarray.Dataset
        Recorded variables. The attributes contain the experiment, so that `rerun` can repeat it.

    Raises
    ------
    ExperimentError, PluginError
        If the experiment is invalid, a plugin is missing or broken, or the file exists.
    StorageError
        If the file cannot be written.
    DivergedError
        If displacements are not finite, no equilibrium is found, or the body separates into parts.
        The attribute `dataset` of the error contains the records before the failure.

    Warns
    -----
    SceneWarning, StabilityWarning, AccuracyWarning
        If a part of the experiment is probably a mistake, if steps can diverge, or if cells are
        inverted in the last state.

    See Also
    --------
    Simulation : Run an experiment step by step.

    Examples
    --------
    >>> ds = pbdkit.run("paper/a", settings={"steps": 20}, progress=False)
    >>> ds.attrs["status"]
    'complete'
    >>> x, y = ds.position.sel(time=20, particle=67)
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
    """Predict the stability and the convergence of a run before its first step.

    Parameters
    ----------
    experiment : Experiment, mapping, str or path
        Experiment, as for `run`.
    components : iterable of classes
        Component classes that the experiment uses in addition to the installed ones.
    settings : mapping, or iterable of str
        Values that replace those of the experiment, as for `load`.

    Returns
    -------
    Analysis
        Spectrum, bounds and the number of steps to a tolerance. The attribute ``operator`` is the
        step operator as a sparse matrix. ``print`` shows a summary.

    Raises
    ------
    ExperimentError, PluginError
        If the experiment is invalid, or a plugin is missing or broken.

    Examples
    --------
    >>> analysis = pbdkit.analyse("paper/a")
    >>> analysis.stable
    True
    >>> f"{analysis.spectral_radius:.4f}"
    '0.9932'
    """
    from pbdkit.stability.analysis import Analysis

    return Analysis(tuned(build_scene(as_experiment(experiment, components, settings))))


def identify(
    experiment: ExperimentLike, *, components: ComponentClasses = (), settings: Settings = ()
) -> Identity:
    """Identify the continuum that a rule represents: diffusion, or an elastic body.

    Parameters
    ----------
    experiment : Experiment, mapping, str or path
        Experiment, as for `run`. If parameters of its rule vary in space, the first entry of
        ``experiment.materials()`` is identified.
    components : iterable of classes
        Component classes that the experiment uses in addition to the installed ones.
    settings : mapping, or iterable of str
        Values that replace those of the experiment, as for `load`.

    Returns
    -------
    Identity
        Kind of continuum and its constants. ``print`` shows a summary.

    Raises
    ------
    ExperimentError, PluginError
        If the experiment is invalid, or a plugin is missing or broken.

    Notes
    -----
    The constants are computed from the response of the rule to plane waves, on the lattice and with
    the neighbours of the experiment.

    Examples
    --------
    >>> identity = pbdkit.identify("material/bar")
    >>> identity.kind, round(identity.poisson_ratio, 6)
    ('elasticity', 0.3)
    """
    from pbdkit.identification.probe import identified

    first = next(iter(as_experiment(experiment, components, settings).materials().values()))
    return identified(tuned(build_scene(first)))


def rerun(
    dataset: xarray.Dataset, *, components: ComponentClasses = (), progress: bool = True
) -> xarray.Dataset:
    """Repeat the run of a dataset, bit for bit.

    Parameters
    ----------
    dataset : xarray.Dataset
        Result of a run.
    components : iterable of classes
        Component classes that the experiment uses in addition to the installed ones.
    progress : bool
        Show a progress bar.

    Returns
    -------
    xarray.Dataset
        The new result.

    Raises
    ------
    ExperimentError, PluginError, DivergedError
        As for `run`, and if the dataset has no experiment.

    Warns
    -----
    ReproducibilityWarning
        If the dataset was made by other versions than the installed ones.

    Examples
    --------
    >>> ds = pbdkit.run("paper/a", settings={"steps": 20}, progress=False)
    >>> bool((pbdkit.rerun(ds, progress=False).position == ds.position).all())
    True
    """
    experiment = experiment_of(dataset, components)
    _warn_of_versions(dataset, experiment)
    return _run(experiment, progress)


def resume(
    output: str | Path, *, steps: int | None = None, anyway: bool = False, progress: bool = True
) -> xarray.Dataset:
    """Continue an interrupted run, or extend a finished one.

    Parameters
    ----------
    output : str or path
        File that the run writes.
    steps : int, optional
        Total number of steps to which a finished run is extended.
    anyway : bool
        Continue even if the experiment, pbdkit or a plugin has changed since the run began.
    progress : bool
        Show a progress bar.

    Returns
    -------
    xarray.Dataset
        Dataset of the file, equal to that of an uninterrupted run, bit for bit.

    Raises
    ------
    ExperimentError
        If there is no run to continue, another process writes the file, or something has changed.
    StorageError
        If the checkpoints are damaged, or the file cannot be written.
    DivergedError
        As for `run`, except that the error has no dataset, because the records are in the file.

    Examples
    --------
    >>> settings = {"steps": 20}
    >>> ds = pbdkit.run("paper/a", settings=settings, output="a.nc", progress=False)
    >>> pbdkit.resume("a.nc", steps=40, progress=False).sizes["time"]
    41
    """
    from pbdkit.io.open import open
    from pbdkit.restart import resumption

    if not isinstance(output, (str, Path)):
        raise ExperimentError(
            "resume: expected the name of the result file that a run was writing, got an object of "
            f"type {type(output).__name__}; `pbdkit.rerun(ds)` runs the experiment of a dataset"
        )
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
    installed = {"pbdkit": pbdkit_version()} | experiment.distributions()
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
    """Run an experiment for all combinations of parameter values and return one dataset.

    Parameters
    ----------
    experiment : Experiment, mapping, str or path
        Experiment, as for `run`.
    vary : mapping
        Lists of values by path of the parameter; all combinations are run.
    together : mapping
        Lists of equal length by path of the parameter. These parameters are varied together: each
        run uses one entry of every list.
    replicates : int
        Number of runs of each combination, with different seeds.
    keep : mapping
        ``variables`` and ``times`` that the dataset contains; by default all.
    names : mapping
        Names of the new dimensions by path; by default the last word of the path.
    folder : str or path, optional
        Folder to which finished members are written. A second call with the same folder runs only
        the members that are missing.
    workers : int, optional
        Number of processes; by default one for each processor. With 1, no process is started.
    client : dask.distributed.Client, optional
        Cluster that runs the members instead of local processes.
    progress : bool
        Show a progress bar.

    Returns
    -------
    xarray.Dataset
        Dataset with the parameters as dimensions, as `pbdkit sweep` writes it. The values of a
        member that failed are NaN, and `message` contains the reason.

    Raises
    ------
    ExperimentError, PluginError
        If the sweep or one of its experiments is invalid, before anything runs.

    Warns
    -----
    SweepWarning
        If members have failed.
    StorageWarning
        If members in the folder are damaged; they are run again.

    Examples
    --------
    >>> experiment = pbdkit.load("paper/a", settings={"steps": 20})
    >>> values = {"solver.relaxation": [0.5, 1.0]}
    >>> ds = pbdkit.sweep(experiment, vary=values, workers=1, progress=False)
    >>> ds.status.dims
    ('relaxation',)
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
) -> Fitted | FittedSpecimens | FittedStrength:
    """Fit parameters of an experiment to measurements, or strengths to the peaks of repeated tests.

    Parameters
    ----------
    description : mapping, str or path
        Fit file, name of a shipped fit, or dict with the same keys.
    experiment : Experiment, mapping, str or path, optional
        Experiment that replaces the one in the description.
    measured : xarray.Dataset, optional
        Measurement that replaces the file of the description. It has a variable for each of the
        ``columns`` of the description, for instance x, y, ux and uy of a displacement field. All
        variables have the same shape.
    components : iterable of classes
        Component classes that the experiment uses in addition to the installed ones.

    Returns
    -------
    Fitted, FittedSpecimens or FittedStrength
        Estimates with standard errors and correlations; a FittedSpecimens, with the scatter between
        specimens, if the description has ``specimens: true``, and a FittedStrength if it has
        ``kind: strength``. ``print`` shows a summary.

    Raises
    ------
    ExperimentError, PluginError
        If the description, the experiment or the measurement is invalid.
    DivergedError
        If an equilibrium or the minimum is not found.

    Warns
    -----
    AccuracyWarning
        If the residuals of a measurement are well above its noise.

    Notes
    -----
    Each residual is divided by its noise, and the sum of the squares is minimised by the
    Gauss–Newton method. The derivatives are computed from the linear system of the equilibrium
    (docs/fitting.md).

    Examples
    --------
    >>> print(pbdkit.fit("fibres"))
    fracture.scale: 0.0203 ± 0.0013, 95 % from 0.0184 to 0.0239
    fracture.modulus: 8.3 ± 1.2, 95 % from 6.1 to 10.9
    ...
    """
    from pbdkit.equilibrium.error_bound import UnconvergedError
    from pbdkit.fitting.fit import fit_experiment
    from pbdkit.fitting.fit_file import Fit, is_strength_fit, read_fit

    if is_strength_fit(description):
        if measured is not None:
            raise ExperimentError(
                "measured: a strength fit uses peak loads, not datasets; list them under "
                "`measured` of the fit"
            )
        return fit_strength(description, experiment=experiment, components=components)
    passed = None if experiment is None else as_experiment(experiment, components)
    problem, source = read_fit(
        Fit,
        description,
        has_experiment=passed is not None,
        measured=measured,
        units=passed.units if passed else None,
    )
    try:
        fitted = fit_experiment(problem, passed or Experiment.build(source, components), components)
    except UnconvergedError as error:
        raise DivergedError(str(error)) from None
    _warn(fitted.warnings)
    return fitted


def fit_strength(
    description: Mapping[str, Any] | str | Path,
    *,
    experiment: ExperimentLike | None = None,
    components: ComponentClasses = (),
) -> FittedStrength:
    """Fit the strength of bonds and its scatter to peaks of repeated tests.

    For descriptions with ``kind: strength``, `fit` calls this function.

    Parameters
    ----------
    description : mapping, str or path
        Fit file with ``kind: strength``, name of a shipped one, or dict with the same keys.
    experiment : Experiment, mapping, str or path, optional
        Experiment that replaces the one in the description.
    components : iterable of classes
        Component classes that the experiment uses in addition to the installed ones.

    Returns
    -------
    FittedStrength
        Estimates with confidence intervals. ``print`` shows a summary.

    Raises
    ------
    ExperimentError, PluginError
        If the description or the experiment is invalid.
    DivergedError
        If a specimen has no equilibrium.
    """
    from pbdkit.equilibrium.error_bound import UnconvergedError
    from pbdkit.fitting.fit_file import StrengthFit, read_fit
    from pbdkit.fitting.strength import fit_strength_of

    passed = None if experiment is None else as_experiment(experiment, components)
    problem, source = read_fit(StrengthFit, description, has_experiment=passed is not None)
    try:
        return fit_strength_of(problem, passed or Experiment.build(source, components))
    except UnconvergedError as error:
        raise DivergedError(str(error)) from None
