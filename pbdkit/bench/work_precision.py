"""Work–precision measurements of solvers at several sizes. Each measurement is made in a separate
process.

The rows are shown as a table, a JSON object and a picture. A measurement is made by a process
``python -m pbdkit.bench.work_precision ANSWER``, which reads the job as JSON from its standard
input and writes its result to the file ANSWER.
"""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from itertools import count, cycle, groupby
from math import inf, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from numpy.typing import NDArray

from pbdkit.api import load
from pbdkit.array_types import Floats
from pbdkit.cli.output import refuse_output, refuse_unwritable, save
from pbdkit.cli.tables import SIMPLE_HEAD, Table, add_rows, show_table
from pbdkit.equilibrium.error_bound import ErrorBound, UnconvergedError, scale_of
from pbdkit.equilibrium.lattice_system import SlowMode
from pbdkit.equilibrium.linearise import linearised
from pbdkit.equilibrium.load_stepping import equilibrate
from pbdkit.errors import ExperimentError, PbdkitError, PluginError
from pbdkit.io.atomic_file import write
from pbdkit.lattice.raster import FOLLOWER
from pbdkit.model.bodies import Grid
from pbdkit.model.experiment import Experiment
from pbdkit.progress import Watch, waiting
from pbdkit.scene.leader_groups import kinds_at
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.simulation import peak_memory
from pbdkit.stability.relaxation import tuned
from pbdkit.stepping.engine_choice import choose, make_engine, missing_for_gpu, obstacle, processors
from pbdkit.stepping.state import State, initial_state

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def resized(experiment: Experiment, size: int) -> tuple[str, ...]:
    """Return the settings with which about `size` sites lie along the longer side of the body.

    If the body is a grid, it gets `size` columns, and its number of rows is changed in proportion;
    positions are scaled with the body. For any other body the lattice constant is changed. Lengths
    that are given in lattice constants, such as thresholds and the radius of neighbours, are
    changed accordingly.

    Raises
    ------
    ExperimentError
        If leaders are selected by number, since numbers change with the size.
    """
    for n, group in enumerate(experiment.leaders):
        if group.select.numbers is not None:
            raise _refusal(
                experiment,
                (
                    "leaders selected by number cannot be resized, since numbers change with the "
                    "size; select them by edge, box or nearest, or omit --sizes"
                ),
                *("leaders", n, "select", "numbers"),
            )
    change = _larger_grid if isinstance(experiment.body, Grid) else _finer_lattice
    return tuple(f"{path}={json.dumps(value)}" for path, value in change(experiment, size))


def _refusal(experiment: Experiment, why: str, *where: str | int) -> ExperimentError:
    return experiment.located(ExperimentError(why, where))


def _larger_grid(experiment: Experiment, size: int) -> Iterator[tuple[str, Any]]:
    grid = experiment.body
    assert isinstance(grid, Grid)
    yield "body.columns", size
    yield "body.rows", max(1, round(grid.rows * size / grid.columns))
    factor = (size - 1) / max(1, grid.columns - 1)
    (x, y) = experiment.lattice.origin

    def placed(point: Any) -> list[float]:
        return [x + factor * (point[0] - x), y + factor * (point[1] - y)]

    for n, group in enumerate(experiment.leaders):
        if box := group.select.box:
            yield f"leaders.{n}.select.box", [*placed(box[:2]), *placed(box[2:])]
        if nearest := group.select.nearest:
            yield f"leaders.{n}.select.nearest", [placed(point) for point in nearest]
        if centre := getattr(group.motion, "centre", None):
            yield f"leaders.{n}.motion.centre", placed(centre)
    if cracks := getattr(experiment.fracture, "cracks", None):
        yield "fracture.cracks", [[placed(a), placed(b)] for a, b in cracks]


def _finer_lattice(experiment: Experiment, size: int) -> Iterator[tuple[str, Any]]:
    boxes = experiment.body.boxes()
    if any(box.in_sites for box in boxes):
        raise _refusal(
            experiment,
            (
                "a grid within another body cannot be resized, since its outline moves with the "
                "lattice; write a rectangle, or omit --sizes"
            ),
            "body",
        )
    sides = [max(box.high[n] for box in boxes) - min(box.low[n] for box in boxes) for n in (0, 1)]
    constants = {name: getattr(experiment.lattice, name, None) for name in ("a", "b")}
    along = constants["b"] if sides[1] > sides[0] and constants["b"] else constants["a"]
    if along is None:
        what = f"the lattice '{experiment.lattice.type}' has no lattice constant `a`"
        raise _refusal(experiment, f"{what}; omit --sizes", "lattice")
    factor = max(sides) / max(1, size - 1) / along
    for name, value in constants.items():
        if value is not None:
            yield f"lattice.{name}", value * factor
    if radius := getattr(experiment.neighbours, "radius", None):
        yield "neighbours.radius", radius * factor
    if thresholds := getattr(experiment.fracture, "thresholds", None):
        yield "fracture.thresholds", [threshold * factor for threshold in thresholds]


TOLERANCES = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10)
"""Tolerances for which each method is measured."""
METHODS = ("lu", "multigrid", "conjugate-gradients")
"""Methods of the solver `equilibrium`."""
MAX_PARTICLES_LU = 2_000_000
"""Number of particles above which LU is omitted. For a million particles the factors take 1.4 GiB,
and their size grows faster than the number of particles."""
MAX_STEPPING_S = 60.0
"""If all steps would take longer than this, in seconds, their duration is extrapolated from the
rate of some steps instead of measured."""
COMPARISONS = 4
"""Number of steps at which displacements are compared. They are evenly distributed, and the last
one is the last step of the run."""
NOISY_START = ("initial={type: noise, amplitude: 1e-3}", "steps=10000000")
"""Settings for timed steps. With them every particle moves, and the engine is the one for long
runs."""
TIMED_STEPS = (2, 42)
"""Steps between which the rate is measured, in steps per second."""
Job = Callable[..., dict[str, Any]]


@dataclass(frozen=True)
class Row:
    """Measurement of a method at a size.

    Parameters
    ----------
    size
        Number of sites along the longer side; None for the size in the experiment.
    method, precision, threads
        Method of the solver or engine, its precision and its number of threads.
    particles
        Number of particles.
    tolerance, certified, error
        Tolerance, certified bound of the error, and measured upper bound of the error. The error is
        the largest distance from the reference, divided by the largest displacement or, for
        equilibria, by the largest prescribed displacement. It is infinite if a run diverged.
    steps
        Number of steps, or of iterations of the linear solver.
    setup_first_s, setup_s
        Seconds until an engine is ready: without compiled kernels in the cache (`setup_first_s`),
        and with them (`setup_s`).
    ns_per_particle_step
        Nanoseconds for each particle and step.
    seconds, cpu_s
        Duration from the experiment to the equilibrium, without imports and compilation; and the
        processor time of all threads in this duration.
    peak_memory_mib
        Peak memory minus the memory after the imports, in MiB.
    is_predicted
        True if the duration was not measured, but is the time of one step multiplied by the number
        of steps.
    reason
        Reason why there is no measurement.
    """

    size: int | None
    method: str
    precision: str | None = None
    threads: int | None = None
    particles: int | None = None
    tolerance: float | None = None
    steps: int | None = None
    setup_first_s: float | None = None
    setup_s: float | None = None
    ns_per_particle_step: float | None = None
    seconds: float | None = None
    cpu_s: float | None = None
    peak_memory_mib: float | None = None
    certified: float | None = None
    error: float | None = None
    is_predicted: bool = False
    reason: str = ""

    @property
    def line(self) -> str:
        """Method and threads. Rows with the same method and number of threads have the same colour
        in a picture."""
        return self.method + (f", {self.threads} threads" if (self.threads or 1) > 1 else "")


def engines() -> list[tuple[str, str, int]]:
    """Return the combinations of engine, precision and number of threads with which steps are
    measured. The first one is the reference."""
    combinations = [("numpy", 1), *(("compiled", n) for n in dict.fromkeys((1, processors())))]
    combinations += [] if missing_for_gpu() else [("gpu", 1)]
    return [
        (name, kind, threads) for name, threads in combinations for kind in ("float64", "float32")
    ]


def methods_count(experiment: Experiment) -> int:
    """Return the maximum number of rows that `measure` returns for a size."""
    if experiment.solver.makes_steps:
        return len(engines())
    return 2 + len(TOLERANCES) * len(METHODS)


def measure(
    experiment: str, settings: tuple[str, ...], size: int | None, report: Callable[[str], None]
) -> Iterator[Row]:
    """Yield the row of the reference, then a row for each method.

    If the experiment is solved by steps, the methods are combinations of engine, precision and
    number of threads, and the reference is numpy in float64. If the solver is `equilibrium`, the
    methods are the methods of this solver and, for comparison, steps; each of them is measured at
    several tolerances. Every measurement is made in a separate process, without records and
    diagnostics.

    Parameters
    ----------
    experiment
        File or shipped name.
    settings
        Settings with which the experiment is loaded.
    size
        Sites along the longer side; None for the size in the experiment.
    report
        Function that is called with a description after each measurement.

    Raises
    ------
    ExperimentError, PluginError
        If there is no reference.
    """
    loaded = load(experiment, settings=settings)
    settings = (*settings, f"record={{every: {loaded.steps}}}", "diagnostics=[]")
    if size is not None:
        settings += resized(load(experiment, settings=settings), size)
    rows = _rows_of_engines if loaded.solver.makes_steps else _rows_to_equilibrium
    with tempfile.TemporaryDirectory(prefix="pbdkit-bench-") as name:

        def run_job(
            task: str, *further: str, cache: str = "shared", **arguments: Any
        ) -> dict[str, Any]:
            arguments |= {"what": task, "experiment": experiment, "settings": [*settings, *further]}
            return _run_in_process(
                arguments | {"truth": name}, Path(name), Path(name) / f"cache-{cache}"
            )

        for row in rows(run_job, Row(size, ""), loaded.steps):
            report(f"{row.line}, size {size or 'unchanged'}")
            yield row


def _run_in_process(job: dict[str, Any], folder: Path, cache: Path) -> dict[str, Any]:
    """Run a job in a new process and return its result. `cache` is the cache folder that the
    process uses."""
    (answer := folder / "answer.json").unlink(missing_ok=True)
    command = [sys.executable, "-m", "pbdkit.bench.work_precision", str(answer)]
    env = os.environ | {"PBDKIT_CACHE_DIR": str(cache)}
    process = subprocess.run(
        command, env=env, input=json.dumps(job), capture_output=True, text=True
    )
    if process.returncode:
        ending = f"it ended with status {process.returncode} (out of memory?)"
        reason = (process.stderr.strip() or ending).splitlines()[-1]
        raise ExperimentError(f"the measurement failed: {reason}")
    return _without_fault(json.loads(answer.read_text("utf-8")))


def _without_fault(result: dict[str, Any]) -> dict[str, Any]:
    """Return the result of a job. If it contains an error, raise the error."""
    if "fault" in result:
        kind = PluginError if result["fault"] == "PluginError" else ExperimentError
        raise kind(result["message"])
    return result


def _rows_of_engines(run_job: Job, base: Row, steps: int) -> Iterator[Row]:
    steps_compared = sorted({max(1, steps * n // COMPARISONS) for n in range(1, COMPARISONS + 1)})
    for n, (engine, precision, threads) in enumerate(engines()):
        row = replace(base, method=engine, precision=precision, threads=threads)
        choice = {"engine": engine, "precision": precision, "threads": threads}
        settings = [f"solver.{key}={value}" for key, value in choice.items()]
        try:
            cache = row.line + precision
            first, measured = (
                run_job("step", *settings, at=at, cache=cache) for at in ([], steps_compared)
            )
        except (ExperimentError, PluginError) as error:
            if n == 0:
                raise
            yield replace(row, reason=" ".join(str(error).split()))
            continue
        figures = {key: measured[key] for key in ("particles", "setup_s", "peak_memory_mib")}
        ns = 1e9 * (measured["seconds"][-1] / steps / measured["particles"])
        share = _error(np.max(measured["distances"]), np.max(measured["sizes"]))
        row = replace(row, **figures, setup_first_s=first["setup_s"])
        yield replace(row, ns_per_particle_step=ns, error=share)


def _error(distance: float, size: float, uncertainty: float = 0.0) -> float:
    """Return an upper bound of the relative error. The relative uncertainty of the reference is
    included."""
    if not np.isfinite(distance) or not np.isfinite(size):
        return np.inf
    return (float(distance / size) if distance else 0.0) + uncertainty


def _rows_to_equilibrium(run_job: Job, base: Row, steps: int) -> Iterator[Row]:
    tolerances = sorted(TOLERANCES, reverse=True)
    exact = run_job("exact", f"solver.tolerance={tolerances[-1] / 100:g}", tolerances=tolerances)
    base = replace(base, particles=exact["particles"])
    yield replace(base, method=f"exact, by {exact['how']}", certified=exact["within"])
    for method in METHODS:
        yield from _rows_of_method(run_job, replace(base, method=method), tolerances, exact)
    yield from _rows_of_steps(run_job, replace(base, method="stepping"), exact, tolerances)


def _rows_of_method(
    run_job: Job, base: Row, tolerances: list[float], exact: dict[str, Any]
) -> Iterator[Row]:
    if base.method == "lu":  # LU does not become faster with a larger tolerance.
        if (base.particles or 0) > MAX_PARTICLES_LU:
            reason = f"omitted above {MAX_PARTICLES_LU} particles: its factors take gibibytes"
            yield replace(base, reason=reason)
            return
        tolerances = tolerances[-1:]
    try:
        measured = run_job("equilibrate", f"solver.method={base.method}", tolerances=tolerances)
    except (ExperimentError, PluginError) as error:
        yield replace(base, reason=" ".join(str(error).split()))
        return
    figures = measured["rows"]
    for tolerance, row in zip(tolerances, figures, strict=False):
        share = _error(row.pop("distance"), exact["scale"], exact["within"])
        memory = measured["peak_memory_mib"]
        yield replace(base, tolerance=tolerance, peak_memory_mib=memory, error=share, **row)
    for tolerance in tolerances[len(figures) :]:
        reason = f"{figures[-1]['seconds']:.0f} s for the previous tolerance"
        yield replace(base, tolerance=tolerance, reason=reason)


def _rows_of_steps(
    run_job: Job, base: Row, exact: dict[str, Any], tolerances: list[float]
) -> Iterator[Row]:
    """Yield the rows for steps: first the rows with measured durations, then those with
    extrapolated durations."""

    def time_of_step(threads: int) -> tuple[float, float, int]:
        measured = run_job(
            "step", *stepping, *NOISY_START, f"solver.threads={threads}", at=TIMED_STEPS
        )
        count = TIMED_STEPS[1] - TIMED_STEPS[0]
        return *((measured[k][1] - measured[k][0]) / count for k in ("seconds", "cpu_s")), threads

    stepping = ("solver={type: stepping}",)
    wall, cpu, threads = min(time_of_step(n) for n in dict.fromkeys((1, processors())))
    needed = dict(zip(tolerances, exact["steps"], strict=True))
    stops = sorted({n for n in needed.values() if n and n * wall <= MAX_STEPPING_S})
    if stops:
        measured = run_job(
            "step", *stepping, f"solver.threads={threads}", f"steps={stops[-1]}", at=stops
        )
    for tolerance, n in needed.items():
        row = replace(base, tolerance=tolerance, steps=n)
        if n is None:
            eigenvalue = f"the largest eigenvalue is {exact['rate']:.6g}"
            yield replace(row, reason=f"steps do not converge: {eigenvalue}")
        elif n in stops:
            i, (built, built_cpu) = stops.index(n), measured["built"]
            error = _error(measured["distances"][i], exact["scale"], exact["within"])
            seconds, cpu_s = built + measured["seconds"][i], built_cpu + measured["cpu_s"][i]
            yield replace(row, seconds=seconds, cpu_s=cpu_s, error=error)
        else:
            predicted = replace(row, error=tolerance, is_predicted=True)
            yield replace(predicted, seconds=n * wall, cpu_s=n * cpu)


COLUMNS = {n: (n, "", "") for n in ("size", "particles", "method", "precision", "threads")} | {
    "tolerance": ("tolerance", ".0e", "relative to the largest prescribed displacement"),
    "steps": ("steps", "", "number of steps, or of iterations of the linear solver"),
    "setup_first_s": ("set-up", ".2f", "seconds until the first step, including compilation"),
    "setup_s": ("cached", ".2f", "set-up with kernels from the cache"),
    "ns_per_particle_step": ("ns", ".3g", "per particle and step"),
    "seconds": (
        "seconds",
        ".3g",
        ("from the experiment to the result, without imports and compilation"),
    ),
    "cpu_s": ("CPU s", ".3g", "sum over all processors"),
    "peak_memory_mib": ("MiB", ".1f", "peak memory above that of the imports"),
    "certified": ("certified", ".1e", "error bound; *: it exceeds the tolerance"),
    "error": ("error", ".1e", "largest relative distance from the first row"),
}
"""Heading, format and meaning of each field of a row."""
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Colours of lines, after Okabe and Ito."""
MARKERS = ("o", "s", "^", "D", "v", "P")
"""Markers of the methods in the picture."""
FLOOR = 1e-18
"""Value on the logarithmic axis of errors at which errors of exactly zero are drawn."""


def table(rows: Sequence[Row]) -> Table:
    """Return a table of the columns that contain values. Sizes are separated by lines."""
    table, columns = Table(box=SIMPLE_HEAD, pad_edge=False), _columns_with_values(rows)
    for name in columns:
        is_word = name in ("method", "precision")
        table.add_column(COLUMNS[name][0], justify="left" if is_word else "right", no_wrap=is_word)
    for _, block in groupby(rows, key=lambda row: row.size):
        add_rows(table, ([_cell(row, name) for name in columns] for row in block))
        table.add_section()
    return table


def _columns_with_values(rows: Sequence[Row]) -> list[str]:
    return [n for n in COLUMNS if n == "size" or any(getattr(r, n) is not None for r in rows)]


def _cell(row: Row, name: str) -> str:
    value = getattr(row, name)
    if value is None:
        missing = {"size": "unchanged", "error": "omitted" if row.reason else ""}
        return missing.get(name, "")
    if name == "error":
        return "0" if value == 0 else f"{value:.1e}" if isfinite(value) else "not finite"
    missed = name == "certified" and row.tolerance is not None and value > row.tolerance
    remark = " (predicted)" * (name == "method" and row.is_predicted)
    return format(value, COLUMNS[name][1]) + "*" * missed + remark


def lines(rows: Sequence[Row]) -> list[str]:
    """Return the meaning of the columns, and the reason for each missing row."""
    columns = (COLUMNS[name] for name in _columns_with_values(rows))
    texts = [f"{heading}: {meaning}" for heading, _, meaning in columns if meaning]
    for row in (row for row in rows if row.reason):
        place = f"size {_cell(row, 'size')}" + (f", {row.tolerance:.0e}" if row.tolerance else "")
        texts.append(f"omitted: {row.line} at {place}: {row.reason}")
    return list(dict.fromkeys(texts))


def as_dict(name: str, settings: Sequence[str], steps: int, rows: Sequence[Row]) -> dict[str, Any]:
    """Return the content of the ``--json`` file (docs/validation/performance.md lists the keys)."""
    machine = {"processor": platform.processor() or platform.machine(), "processors": processors()}
    machine |= {"system": platform.system(), "python": sys.version.split()[0]}
    figures = [{k: v if v != inf else None for k, v in asdict(row).items()} for row in rows]
    description = {"experiment": name, "settings": list(settings), "steps": steps}
    return description | {"machine": machine, "rows": figures}


def work_precision_figure(rows: Sequence[Row], title: str) -> Figure:
    """Return a figure of error against cost, on logarithmic axes.

    The figure has a panel for each size. Each row is a marker, with a colour for each method and
    number of threads. Markers of extrapolated durations are hollow, errors of exactly zero are
    drawn at the bottom, and runs that diverged are omitted.
    """
    from matplotlib.figure import Figure

    measured = [row for row in rows if row.error is not None and isfinite(row.error) and _x(row)]
    sizes = list(dict.fromkeys(row.particles for row in measured)) or [0]
    kinds = list(dict.fromkeys(row.line for row in measured))
    across = min(2, len(sizes))
    down = -(-len(sizes) // across)
    figure = Figure(figsize=(1.6 + 3.6 * across, 1.0 + 2.9 * down), dpi=150, layout="constrained")
    panels = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False).ravel()
    for ax, particles in zip(panels, sizes, strict=False):
        for kind, colour, marker in zip(kinds, cycle(COLOURS), cycle(MARKERS)):
            series = [row for row in measured if row.line == kind and row.particles == particles]
            x, y = [_x(row) for row in series], [max(row.error or 0.0, FLOOR) for row in series]
            face = ["white" if row.is_predicted else colour for row in series]
            ax.plot(x, y, color=colour, linewidth=0.9, linestyle=":")
            ax.scatter(x, y, s=22, marker=marker, facecolor=face, edgecolor=colour, zorder=2)
            ax.scatter([], [], color=colour, marker=marker, label=kind)
        ax.set_title(f"{particles:,} particles".replace(",", " "), fontsize=8)
        ax.set(xscale="log", yscale="log")
        ax.grid(visible=True, linewidth=0.3, alpha=0.6)
        ax.tick_params(labelsize=7)
    for ax in panels[len(sizes) :]:
        ax.set_visible(False)
    if any(row.error == 0 for row in measured):
        ticks = [10.0**n for n in range(-16, 1, 4)]
        panels[0].set_yticks([FLOOR, *ticks], ["0", *(f"{tick:.0e}" for tick in ticks)])
    by_step = any(row.ns_per_particle_step for row in measured)
    for ax in panels[-across:]:
        ax.set_xlabel("ns per particle and step" if by_step else "seconds of processor time")
    figure.supylabel("largest relative error", fontsize=8)
    figure.suptitle(title, fontsize=9)
    legend, ncols = panels[0].get_legend_handles_labels(), min(4, len(kinds) or 1)
    figure.legend(*legend, loc="outside lower center", ncols=ncols, fontsize=7, frameon=False)
    return figure


def _x(row: Row) -> float:
    return row.ns_per_particle_step or row.cpu_s or 0.0


def show_work_precision(
    experiment: Experiment,
    name: str,
    settings: tuple[str, ...],
    changes: tuple[str, ...],
    *,
    sizes: tuple[int, ...],
    json_file: Path | None,
    picture: Path | None,
) -> None:
    """Measure an experiment, print the rows, and write them to files.

    Parameters
    ----------
    experiment
        Experiment.
    name, settings
        Name and settings that describe the experiment in the JSON file.
    changes
        All settings with which the experiment is loaded by its `name`.
    sizes
        Numbers of sites along the longer side; empty for the size in the experiment.
    json_file, picture
        Files to write.
    """
    for path in filter(None, (picture, json_file)):
        refuse_output(path, force=True, experiment=Path(name))
    refuse_unwritable(picture, json_file)
    total, measured = methods_count(experiment) * max(1, len(sizes)), count(1)
    with waiting(f"measuring {total} methods, each in a separate process") as show:

        def report(text: str) -> None:
            show(f"measured {text}; {next(measured)} of {total}")

        rows = [row for n in sizes or (None,) for row in measure(name, changes, n, report)]
    title = f"{experiment.name}, {experiment.solver.type}, {experiment.steps} steps"
    click.echo(title)
    show_table(table(rows))
    click.echo("\n".join(lines(rows)))
    if json_file:
        figures = as_dict(name, settings, experiment.steps, rows)
        write(json_file, json.dumps(figures, indent=1) + "\n", replace=True)
        click.echo(f"{json_file} written")
    if picture:
        save(picture, work_precision_figure(rows, title), replace=True)


Task = dict[str, Any]
REPEATS = 7
"""Maximum number of repetitions of a measurement. The fastest repetition is used."""
MAX_REPEATING_S = 2.0
"""Maximum duration of all repetitions in seconds."""
MAX_SOLVING_S = 60.0
"""If a measurement takes longer than this, in seconds, smaller tolerances are omitted."""
COMPILED = "pbdkit.stepping.numba_engine.engine"
"""Module of the compiled engine."""
SOLVERS = ("scipy.sparse.linalg", "scipy.sparse.csgraph", "numba")
"""Modules that are imported before the measurement of an equilibrium."""
INVERSE_ITERATIONS = 12
"""Number of inverse iterations for the slowest mode."""
INVERSE_ACCURACY = 1e-3
"""Relative accuracy of each inverse iteration."""


def main(answer: Path) -> None:
    """Run the job on standard input, and write its result to a file."""
    answer.write_text(json.dumps(result_of(json.load(sys.stdin))), encoding="utf-8")


def result_of(job: Task) -> Task:
    """Run a job and return its result. If an error occurs, the result contains the error."""
    try:
        return {"step": _step, "equilibrate": _equilibrate, "exact": _compute_exact}[job["what"]](
            job
        )
    except PbdkitError as error:
        return {"fault": type(error).__name__, "message": str(error)}


def _import(*modules: str) -> int:
    """Import the modules that a measurement needs, so that their import is not measured. Return the
    peak memory after that."""
    for module in modules:
        if find_spec(module.split(".")[0]):
            import_module(module)
    return peak_memory()


def _times() -> Floats:
    return np.array([time.perf_counter(), time.process_time()])


def _repetitions(spent: list[Floats]) -> Iterator[int]:
    """Yield the numbers of repetitions until there are enough of them. The caller appends the
    duration of each repetition to `spent`."""
    for turn in range(REPEATS):
        yield turn
        took = [float(times[..., 0].max(initial=0.0)) for times in spent]
        if sum(took) + took[-1] > MAX_REPEATING_S:
            break


def _step(job: Task) -> Task:
    """Measure set-up and steps.

    For each step in `at`, the result contains the seconds up to that step in the fastest of several
    runs, the largest distance from the reference, and the largest displacement.
    """
    experiment, at = load(job["experiment"], settings=job["settings"]), job["at"]
    compiles = experiment.stepping.engine == "compiled" and not obstacle()
    imports = _import(*[COMPILED] * compiles)
    start = _times()
    scene = tuned(build_scene(experiment))
    built = _times() - start
    engine, _ = make_engine(scene, choose(scene))
    setup_s, _ = _times() - start
    runs: list[Floats] = []
    comparisons, memory = [], imports
    for turn in _repetitions(runs):
        state, spent = initial_state(scene), np.zeros((len(at), 2))
        for n, step in enumerate(at):
            start = _times()
            state = engine.advance(state, step - state.step)
            spent[n:] += _times() - start
            if turn == 0:
                comparisons.append(_compared(scene, state, Path(job["truth"])))
                memory = peak_memory()
        runs.append(spent)
    seconds, cpu = np.min(runs, axis=0).T.tolist()
    distances, sizes = np.reshape(comparisons, (-1, 2)).T.tolist()
    result = {"particles": scene.raster.count, "built": built.tolist(), "setup_s": setup_s}
    result |= {"seconds": seconds, "cpu_s": cpu, "distances": distances, "sizes": sizes}
    return result | {"peak_memory_mib": (memory - imports) / 2**20}


def _compared(scene: Scene, state: State, folder: Path) -> tuple[float, float]:
    """Return the largest distance of a state from the reference, and the largest displacement of
    the reference.

    If the folder contains the equilibrium of the followers, it is the reference. Otherwise the
    reference is the state that the first process saved at this step.
    """
    exact, u = folder / "exact.npy", state.u.reshape(len(state.u), -1).astype(float)
    file = exact if exact.exists() else folder / f"{state.step}.npy"
    u = _of_followers(scene, state) if file == exact else u
    if not file.exists():
        np.save(file, u)
    reference = np.load(file)
    with np.errstate(all="ignore"):
        return _largest_norm(u - reference), _largest_norm(reference)


def _largest_norm(u: Floats) -> float:
    return float(np.sqrt((u * u).sum(axis=0)).max(initial=0.0))


def _equilibrate(job: Task) -> Task:
    """Measure the solver for each tolerance, beginning with the largest, until a measurement takes
    too long."""
    imports, rows = _import(*SOLVERS), []
    for tolerance in job["tolerances"]:
        settings = [*job["settings"], f"solver.tolerance={tolerance:g}"]
        experiment = load(job["experiment"], settings=settings)
        runs: list[Floats] = []
        for _ in _repetitions(runs):
            start = _times()
            scene, state, error_bound = _equilibrium(experiment)
            runs.append(_times() - start)
        seconds, cpu_s = np.min(runs, axis=0)
        distance, _ = _compared(scene, state, Path(job["truth"]))
        figures = {"steps": error_bound.inner_iterations, "certified": error_bound.share}
        rows.append(figures | {"seconds": seconds, "cpu_s": cpu_s, "distance": distance})
        if seconds > MAX_SOLVING_S:
            break
    return {"rows": rows, "peak_memory_mib": (peak_memory() - imports) / 2**20}


def _equilibrium(experiment: Experiment) -> tuple[Scene, State, ErrorBound]:
    scene = build_scene(experiment)
    state = initial_state(scene)
    try:
        return scene, state, equilibrate(scene, state)
    except UnconvergedError as error:
        return scene, state, error.error_bound


def _compute_exact(job: Task) -> Task:
    """Compute an accurate equilibrium, and the number of steps that are needed for each
    tolerance."""
    _import(*SOLVERS)
    experiment = load(job["experiment"], settings=job["settings"])
    if experiment.fracture.type != "none":
        reason = "speed against error is measured without fracture; set fracture={type: none}"
        raise experiment.located(ExperimentError(reason, ("fracture",)))
    scene, state, error_bound = _equilibrium(experiment)
    exact = _of_followers(scene, state)
    np.save(Path(job["truth"]) / "exact.npy", exact)
    decay = decay_of(scene, exact)
    result = {"how": error_bound.method, "within": error_bound.share, "rate": decay.rate}
    steps = [decay.steps_to(tolerance) for tolerance in job["tolerances"]]
    scale = scale_of(scene, initial_state(scene))
    return result | {"particles": scene.raster.count, "scale": scale, "steps": steps}


@dataclass(frozen=True)
class Decay:
    """Decay of the distance to equilibrium when steps are made.

    After n steps the distance is `share` · `rate`ⁿ times the largest prescribed displacement.
    """

    share: float
    rate: float

    def steps_to(self, tolerance: float) -> int | None:
        """Return the number of steps after which the distance is within a tolerance, or None if
        this never happens."""
        if not 0.0 < self.rate < 1.0:
            return None
        return max(1, math.ceil(math.log(max(1.0, self.share / tolerance)) / -math.log(self.rate)))


def followers_of(scene: Scene) -> NDArray[np.intp]:
    """Return the flat places of the followers of the last step."""
    kinds = kinds_at(scene.raster, scene.leading, scene.experiment.steps)
    return scene.raster.place_of(np.flatnonzero(kinds == FOLLOWER))


def _of_followers(scene: Scene, state: State) -> Floats:
    """Return the displacements of followers, (axis, follower)."""
    return state.u.reshape(len(state.u), -1)[:, followers_of(scene)].astype(float)


def decay_of(scene: Scene, exact: Floats) -> Decay:
    """Return the decay of the slowest mode that the start excites.

    The mode is computed by inverse iteration, v ← A⁻¹ v with A = 1 - (step operator). The iteration
    begins with the difference between the start and `exact`, (axis, follower). The share of the
    mode is the projection of this difference onto the mode.
    """
    start = initial_state(scene)
    steps, resting = scene.experiment.steps, initial_state(scene)
    resting.u[...] = 0.0
    distance = np.zeros_like(resting.u)
    distance.reshape(len(distance), -1)[:, followers_of(scene)] = exact - _of_followers(
        scene, start
    )
    if not distance.any():
        return Decay(0.0, 0.0)
    system, slowest = linearised(scene, resting, steps, "auto", Watch()), SlowMode(distance, 1.0)
    for _ in range(INVERSE_ITERATIONS):
        slowest = slowest.improved(system, INVERSE_ACCURACY)
    mode = slowest.planes
    projection = float((distance * mode).sum() / (mode * mode).sum())
    share = abs(projection) * _largest_norm(mode) / scale_of(scene, start)
    return Decay(share, 1.0 - 1.0 / slowest.slowness)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
