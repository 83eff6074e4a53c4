"""Work–precision measurements: solvers at several sizes, each in a process of its own.

The rows are shown as a table, a JSON object and a picture. A measurement is one call of
``python -m pbdkit.bench.work_precision ANSWER``, with the job as JSON on its input.
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
from pbdkit.equilibrium.certificate import Certificate, UnconvergedError, scale_of
from pbdkit.equilibrium.lattice_system import SlowMode
from pbdkit.equilibrium.linearise import linearised
from pbdkit.equilibrium.solve import settle
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
from pbdkit.stepping.engine_choice import choose, make_engine, obstacle, processors, what_is_missing
from pbdkit.stepping.state import State, initial_state

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def resized(experiment: Experiment, size: int) -> tuple[str, ...]:
    """The settings that make about `size` sites lie along the body's longer side.

    A grid gets `size` columns and rows in proportion; what is placed by coordinates keeps its
    place relative to the body. Of any other body the lattice becomes finer, and with it the lengths
    that count in lattice constants: thresholds and the radius of the neighbours.

    Raises ExperimentError where leaders are chosen by number, for numbers change with the size.
    """
    for n, group in enumerate(experiment.leaders):
        if group.select.numbers is not None:
            raise _refusal(
                experiment,
                "leaders chosen by number cannot be resized: numbers change with the size; choose "
                "them by edge, box or nearest, or leave --sizes out to run it as it is",
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
            "a grid within another body cannot be resized: its outline moves with the lattice; "
            "write a rectangle, or leave --sizes out to run it as it is",
            "body",
        )
    sides = [max(box.high[n] for box in boxes) - min(box.low[n] for box in boxes) for n in (0, 1)]
    constants = {name: getattr(experiment.lattice, name, None) for name in ("a", "b")}
    along = constants["b"] if sides[1] > sides[0] and constants["b"] else constants["a"]
    if along is None:
        what = f"the lattice '{experiment.lattice.type}' has no constant `a` to divide"
        raise _refusal(experiment, f"{what}; leave --sizes out", "lattice")
    factor = max(sides) / max(1, size - 1) / along
    for name, value in constants.items():
        if value is not None:
            yield f"lattice.{name}", value * factor
    if radius := getattr(experiment.neighbours, "radius", None):
        yield "neighbours.radius", radius * factor
    if thresholds := getattr(experiment.fracture, "thresholds", None):
        yield "fracture.thresholds", [threshold * factor for threshold in thresholds]


TOLERANCES = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10)
METHODS = ("lu", "multigrid", "conjugate-gradients")
LARGEST_DIRECT = 2_000_000
"""Particles above which LU is left out: its factors take 1.4 GiB at a million, and grow faster."""
PATIENCE_S = 60.0
"""Steps that would take longer are not made: they are measured by the step and counted ahead."""
LOOKS = 4
"""At so many steps, evenly spread and the last among them, displacements are compared."""
IN_MOTION = ("initial={type: noise, amplitude: 1e-3}", "steps=10000000")
"""So that every particle moves in the steps that are timed, and the engine for long runs is taken;
so many are not made."""
RATE_AT = (2, 42)
Job = Callable[..., dict[str, Any]]


@dataclass(frozen=True)
class Row:
    """A method measured at a size, None as it is; with a `reason` one that could not be had.

    `steps` made, or iterations of the linear solver. `setup_s` until an engine is ready,
    `setup_first_s` when nothing had been compiled. `seconds` from the experiment to the
    equilibrium, imports and compiling done; `cpu_s` of all processors together. Memory is above
    that of the imports. `error` is, at most, the largest distance from the truth: a share of the
    largest displacement, at equilibrium of the largest prescribed one, as `certified` and
    `tolerance` are; infinite where a run left the finite numbers. `is_predicted`: of a step,
    times their number.
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
        """Return the fields that rows of one colour in a picture share."""
        return self.method + (f", {self.threads} threads" if (self.threads or 1) > 1 else "")


def engines() -> list[tuple[str, str, int]]:
    """Engine, precision and threads of all ways to step, the reference first."""
    ways = [("numpy", 1), *(("compiled", n) for n in dict.fromkeys((1, processors())))]
    ways += [] if what_is_missing() else [("gpu", 1)]
    return [(name, kind, threads) for name, threads in ways for kind in ("float64", "float32")]


def methods_count(experiment: Experiment) -> int:
    """Return the maximum number of rows that `measure` returns for a size."""
    if experiment.solver.makes_steps:
        return len(engines())
    return 2 + len(TOLERANCES) * len(METHODS)


def measure(
    experiment: str, settings: tuple[str, ...], size: int | None, tell: Callable[[str], None]
) -> Iterator[Row]:
    """The truth first, then a row a method: engines, precisions and threads against numpy's
    float64; where the solver is `equilibrium` its methods, and the steps, over tolerances.

    Every measurement has a process of its own; nothing is recorded and no diagnostic taken. Raises
    ExperimentError and PluginError where there is nothing to measure against.
    """
    asked = load(experiment, settings=settings)
    settings = (*settings, f"record={{every: {asked.steps}}}", "diagnostics=[]")
    if size is not None:
        settings += resized(load(experiment, settings=settings), size)
    rows = _step_by_step if asked.solver.makes_steps else _to_equilibrium
    with tempfile.TemporaryDirectory(prefix="pbdkit-bench-") as name:

        def work(what: str, *more: str, cache: str = "shared", **job: Any) -> dict[str, Any]:
            job |= {"what": what, "experiment": experiment, "settings": [*settings, *more]}
            return _worked(job | {"truth": name}, Path(name), Path(name) / f"cache-{cache}")

        for row in rows(work, Row(size, ""), asked.steps):
            tell(f"{row.line}, size {size or 'as it is'}")
            yield row


def _worked(job: dict[str, Any], folder: Path, cache: Path) -> dict[str, Any]:
    """The result of a job (worker.py) in a fresh process, with a cache folder of its own."""
    (answer := folder / "answer.json").unlink(missing_ok=True)
    call = [sys.executable, "-m", "pbdkit.bench.work_precision", str(answer)]
    env = os.environ | {"PBDKIT_CACHE_DIR": str(cache)}
    done = subprocess.run(call, env=env, input=json.dumps(job), capture_output=True, text=True)
    if done.returncode:
        ended = f"it ended with status {done.returncode} (out of memory?)"
        why = (done.stderr.strip() or ended).splitlines()[-1]
        raise ExperimentError(f"the measurement failed: {why}")
    return _without_fault(json.loads(answer.read_text("utf-8")))


def _without_fault(result: dict[str, Any]) -> dict[str, Any]:
    """The result of a job. Raises what went wrong with it."""
    if "fault" in result:
        kind = PluginError if result["fault"] == "PluginError" else ExperimentError
        raise kind(result["message"])
    return result


def _step_by_step(work: Job, base: Row, steps: int) -> Iterator[Row]:
    looks = sorted({max(1, steps * n // LOOKS) for n in range(1, LOOKS + 1)})
    for n, (engine, precision, threads) in enumerate(engines()):
        row = replace(base, method=engine, precision=precision, threads=threads)
        chosen = {"engine": engine, "precision": precision, "threads": threads}
        settings = [f"solver.{key}={value}" for key, value in chosen.items()]
        try:
            cache = row.line + precision
            first, found = (work("step", *settings, at=at, cache=cache) for at in ([], looks))
        except (ExperimentError, PluginError) as error:
            if n == 0:
                raise
            yield replace(row, reason=" ".join(str(error).split()))
            continue
        same = {key: found[key] for key in ("particles", "setup_s", "peak_memory_mib")}
        ns = 1e9 * (found["seconds"][-1] / steps / found["particles"])
        share = _error(np.max(found["distances"]), np.max(found["sizes"]))
        row = replace(row, **same, setup_first_s=first["setup_s"])
        yield replace(row, ns_per_particle_step=ns, error=share)


def _error(distance: float, size: float, within: float = 0.0) -> float:
    """At most, as a share: what it is measured against is known `within` a share itself."""
    if not np.isfinite(distance) or not np.isfinite(size):
        return np.inf
    return (float(distance / size) if distance else 0.0) + within


def _to_equilibrium(work: Job, base: Row, steps: int) -> Iterator[Row]:
    tolerances = sorted(TOLERANCES, reverse=True)
    exact = work("exact", f"solver.tolerance={tolerances[-1] / 100:g}", tolerances=tolerances)
    base = replace(base, particles=exact["particles"])
    yield replace(base, method=f"exact, by {exact['how']}", certified=exact["within"])
    for method in METHODS:
        yield from _settled(work, replace(base, method=method), tolerances, exact)
    yield from _stepped(work, replace(base, method="stepping"), exact, tolerances)


def _settled(work: Job, base: Row, tolerances: list[float], exact: dict[str, Any]) -> Iterator[Row]:
    if base.method == "lu":  # it does not get faster with a looser tolerance
        if (base.particles or 0) > LARGEST_DIRECT:
            reason = f"left out above {LARGEST_DIRECT} particles: its factors take gibibytes"
            yield replace(base, reason=reason)
            return
        tolerances = tolerances[-1:]
    try:
        found = work("settle", f"solver.method={base.method}", tolerances=tolerances)
    except (ExperimentError, PluginError) as error:
        yield replace(base, reason=" ".join(str(error).split()))
        return
    made = found["rows"]
    for tolerance, row in zip(tolerances, made, strict=False):
        share = _error(row.pop("distance"), exact["scale"], exact["within"])
        memory = found["peak_memory_mib"]
        yield replace(base, tolerance=tolerance, peak_memory_mib=memory, error=share, **row)
    for tolerance in tolerances[len(made) :]:
        reason = f"{made[-1]['seconds']:.0f} s for the tolerance before"
        yield replace(base, tolerance=tolerance, reason=reason)


def _stepped(work: Job, base: Row, exact: dict[str, Any], tolerances: list[float]) -> Iterator[Row]:
    """Steps that are made, then those that are predicted."""

    def a_step(threads: int) -> tuple[float, float, int]:
        found = work("step", *stepping, *IN_MOTION, f"solver.threads={threads}", at=RATE_AT)
        made = RATE_AT[1] - RATE_AT[0]
        return *((found[k][1] - found[k][0]) / made for k in ("seconds", "cpu_s")), threads

    stepping = ("solver={type: stepping}",)
    wall, cpu, threads = min(a_step(n) for n in dict.fromkeys((1, processors())))
    needed = dict(zip(tolerances, exact["steps"], strict=True))
    at = sorted({n for n in needed.values() if n and n * wall <= PATIENCE_S})
    if at:
        found = work("step", *stepping, f"solver.threads={threads}", f"steps={at[-1]}", at=at)
    for tolerance, n in needed.items():
        row = replace(base, tolerance=tolerance, steps=n)
        if n is None:
            rate = f"the largest eigenvalue is {exact['rate']:.6g}"
            yield replace(row, reason=f"steps do not settle: {rate}")
        elif n in at:
            i, (built, built_cpu) = at.index(n), found["built"]
            error = _error(found["distances"][i], exact["scale"], exact["within"])
            seconds, cpu_s = built + found["seconds"][i], built_cpu + found["cpu_s"][i]
            yield replace(row, seconds=seconds, cpu_s=cpu_s, error=error)
        else:
            predicted = replace(row, error=tolerance, is_predicted=True)
            yield replace(predicted, seconds=n * wall, cpu_s=n * cpu)


COLUMNS = {n: (n, "", "") for n in ("size", "particles", "method", "precision", "threads")} | {
    "tolerance": ("tolerance", ".0e", "a share of the largest prescribed displacement"),
    "steps": ("steps", "", "made, or iterations of the linear solver"),
    "setup_first_s": ("set-up", ".2f", "seconds until the first step, with compiling"),
    "setup_s": ("cached", ".2f", "the same with what was compiled before"),
    "ns_per_particle_step": ("ns", ".3g", "a particle and step"),
    "seconds": ("seconds", ".3g", "from the experiment on, imports and compiling done"),
    "cpu_s": ("CPU s", ".3g", "of all processors together"),
    "peak_memory_mib": ("MiB", ".1f", "peak memory above that of the imports"),
    "certified": ("certified", ".1e", "what the certificate says; *: it misses the tolerance"),
    "error": ("error", ".1e", "at most, as a share: the largest distance from the first row"),
}
"""Heading, format and meaning of each field of a row."""
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Colours of lines, after Okabe and Ito."""
MARKERS = ("o", "s", "^", "D", "v", "P")
FLOOR = 1e-18
"""Position on the axis of errors at which errors of exactly zero are drawn."""


def table(rows: Sequence[Row]) -> Table:
    """Return a table of the columns that have values, with a line between sizes."""
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
        missing = {"size": "as it is", "error": "left out" if row.reason else ""}
        return missing.get(name, "")
    if name == "error":
        return "0" if value == 0 else f"{value:.1e}" if isfinite(value) else "not finite"
    missed = name == "certified" and row.tolerance is not None and value > row.tolerance
    told = " (predicted)" * (name == "method" and row.is_predicted)
    return format(value, COLUMNS[name][1]) + "*" * missed + told


def lines(rows: Sequence[Row]) -> list[str]:
    """Return the meaning of the columns, and the reason for each missing row."""
    columns = (COLUMNS[name] for name in _columns_with_values(rows))
    texts = [f"{heading}: {meaning}" for heading, _, meaning in columns if meaning]
    for row in (row for row in rows if row.reason):
        place = f"size {_cell(row, 'size')}" + (f", {row.tolerance:.0e}" if row.tolerance else "")
        texts.append(f"left out: {row.line} at {place}: {row.reason}")
    return list(dict.fromkeys(texts))


def as_dict(name: str, settings: Sequence[str], steps: int, rows: Sequence[Row]) -> dict[str, Any]:
    """Return the content of the ``--json`` file (docs/performance.md lists the keys)."""
    machine = {"processor": platform.processor() or platform.machine(), "processors": processors()}
    machine |= {"system": platform.system(), "python": sys.version.split()[0]}
    figures = [{k: v if v != inf else None for k, v in asdict(row).items()} for row in rows]
    asked = {"experiment": name, "settings": list(settings), "steps": steps}
    return asked | {"machine": machine, "rows": figures}


def work_precision_figure(rows: Sequence[Row], title: str) -> Figure:
    """Error against cost, both logarithmic: a panel a size, a colour a method (and its threads), a
    marker each row. What was predicted is hollow, errors of exactly zero lie on a line of their own
    at the bottom; runs that left the finite numbers are not drawn."""
    from matplotlib.figure import Figure

    measured = [row for row in rows if row.error is not None and isfinite(row.error) and _x(row)]
    sizes = list(dict.fromkeys(row.particles for row in measured)) or [0]
    kinds = list(dict.fromkeys(row.line for row in measured))
    across = min(2, len(sizes))
    down = -(-len(sizes) // across)
    drawn = Figure(figsize=(1.6 + 3.6 * across, 1.0 + 2.9 * down), dpi=150, layout="constrained")
    panels = drawn.subplots(down, across, sharex=True, sharey=True, squeeze=False).ravel()
    for ax, particles in zip(panels, sizes, strict=False):
        for kind, colour, marker in zip(kinds, cycle(COLOURS), cycle(MARKERS)):
            some = [row for row in measured if row.line == kind and row.particles == particles]
            x, y = [_x(row) for row in some], [max(row.error or 0.0, FLOOR) for row in some]
            face = ["white" if row.is_predicted else colour for row in some]
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
        ax.set_xlabel("ns a particle and step" if by_step else "seconds of processor time")
    drawn.supylabel("largest error, as a share", fontsize=8)
    drawn.suptitle(title, fontsize=9)
    named, ncols = panels[0].get_legend_handles_labels(), min(4, len(kinds) or 1)
    drawn.legend(*named, loc="outside lower center", ncols=ncols, fontsize=7, frameon=False)
    return drawn


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
        Name and settings by which it is described in the JSON file.
    changes
        All settings with which it is loaded by `name`.
    sizes
        Numbers of sites along the longer side; empty for its own size.
    json_file, picture
        Files to write.
    """
    for path in filter(None, (picture, json_file)):
        refuse_output(path, force=True, experiment=Path(name))
    refuse_unwritable(picture, json_file)
    total, measured = methods_count(experiment) * max(1, len(sizes)), count(1)
    with waiting(f"measuring {total} methods, each in a process of its own") as show:

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
REPEATS, TASK_PATIENCE_S = 7, 2.0
"""A way is gone so often, unless that takes longer; the best counts."""
LONGEST_S = 60.0
"""After a tolerance that took longer, tighter ones are left out."""
COMPILED = "pbdkit.stepping.numba_engine.engine"
SOLVERS = ("scipy.sparse.linalg", "scipy.sparse.csgraph", "numba")
TURNS, ROUGH = 12, 1e-3
"""Of the inverse iteration for the slowest mode, and the accuracy of each."""


def main(answer: Path) -> None:
    """Does the job on the input; the result goes into the file `answer`."""
    answer.write_text(json.dumps(result_of(json.load(sys.stdin))), encoding="utf-8")


def result_of(job: Task) -> Task:
    """Does the job; what is wrong with it goes into the result."""
    try:
        return {"step": _step, "settle": _settle, "exact": _find_exact}[job["what"]](job)
    except PbdkitError as error:
        return {"fault": type(error).__name__, "message": str(error)}


def _import(*modules: str) -> int:
    """Imports are no part of what is measured; peak memory after them."""
    for module in modules:
        if find_spec(module.split(".")[0]):
            import_module(module)
    return peak_memory()


def _clock() -> Floats:
    return np.array([time.perf_counter(), time.process_time()])


def _turns(spent: list[Floats]) -> Iterator[int]:
    """Turns to go a way, until they are enough; each adds what it `spent`, (..., clock)."""
    for turn in range(REPEATS):
        yield turn
        took = [float(one[..., 0].max(initial=0.0)) for one in spent]
        if sum(took) + took[-1] > TASK_PATIENCE_S:
            break


def _step(job: Task) -> Task:
    """Set-up, and for each number of steps `at`: the seconds to there, the best of several runs;
    the largest distance from the truth in `sizes`, the largest displacements."""
    experiment, at = load(job["experiment"], settings=job["settings"]), job["at"]
    compiles = experiment.stepping.engine == "compiled" and not obstacle()
    imports = _import(*[COMPILED] * compiles)
    begun = _clock()
    scene = tuned(build_scene(experiment))
    built = _clock() - begun
    engine, _ = make_engine(scene, choose(scene))
    setup_s, _ = _clock() - begun
    runs: list[Floats] = []
    there, memory = [], imports
    for turn in _turns(runs):
        state, spent = initial_state(scene), np.zeros((len(at), 2))
        for n, step in enumerate(at):
            begun = _clock()
            state = engine.advance(state, step - state.step)
            spent[n:] += _clock() - begun
            if turn == 0:
                there.append(_compared(scene, state, Path(job["truth"])))
                memory = peak_memory()
        runs.append(spent)
    seconds, cpu = np.min(runs, axis=0).T.tolist()
    distances, sizes = np.reshape(there, (-1, 2)).T.tolist()
    found = {"particles": scene.raster.count, "built": built.tolist(), "setup_s": setup_s}
    found |= {"seconds": seconds, "cpu_s": cpu, "distances": distances, "sizes": sizes}
    return found | {"peak_memory_mib": (memory - imports) / 2**20}


def _compared(scene: Scene, state: State, truth: Path) -> tuple[float, float]:
    """(largest distance, largest displacement of the truth): of followers where the exact answer is
    known; else of what the first who comes to a step leaves for the others."""
    exact, u = truth / "exact.npy", state.u.reshape(len(state.u), -1).astype(float)
    file = exact if exact.exists() else truth / f"{state.step}.npy"
    u = _of_followers(scene, state) if file == exact else u
    if not file.exists():
        np.save(file, u)
    known = np.load(file)
    with np.errstate(all="ignore"):
        return _longest(u - known), _longest(known)


def _longest(u: Floats) -> float:
    return float(np.sqrt((u * u).sum(axis=0)).max(initial=0.0))


def _settle(job: Task) -> Task:
    """A row for each tolerance, the loosest first, until one takes too long."""
    imports, rows = _import(*SOLVERS), []
    for tolerance in job["tolerances"]:
        settings = [*job["settings"], f"solver.tolerance={tolerance:g}"]
        experiment = load(job["experiment"], settings=settings)
        runs: list[Floats] = []
        for _ in _turns(runs):
            begun = _clock()
            scene, state, certificate = _equilibrium(experiment)
            runs.append(_clock() - begun)
        seconds, cpu_s = np.min(runs, axis=0)
        distance, _ = _compared(scene, state, Path(job["truth"]))
        told = {"steps": certificate.inner_iterations, "certified": certificate.share}
        rows.append(told | {"seconds": seconds, "cpu_s": cpu_s, "distance": distance})
        if seconds > LONGEST_S:
            break
    return {"rows": rows, "peak_memory_mib": (peak_memory() - imports) / 2**20}


def _equilibrium(experiment: Experiment) -> tuple[Scene, State, Certificate]:
    scene = build_scene(experiment)
    state = initial_state(scene)
    try:
        return scene, state, settle(scene, state)
    except UnconvergedError as error:
        return scene, state, error.certificate


def _find_exact(job: Task) -> Task:
    """The solver's own answer, as good as it gets, for the others to be compared with, and how many
    steps lead to the tolerances."""
    _import(*SOLVERS)
    experiment = load(job["experiment"], settings=job["settings"])
    if experiment.fracture.type != "none":
        why = "speed against error is measured where no bond can break; set fracture={type: none}"
        raise experiment.located(ExperimentError(why, ("fracture",)))
    scene, state, certificate = _equilibrium(experiment)
    exact = _of_followers(scene, state)
    np.save(Path(job["truth"]) / "exact.npy", exact)
    decay = decay_of(scene, exact)
    known = {"how": certificate.method, "within": certificate.share, "rate": decay.rate}
    steps = [decay.steps_to(tolerance) for tolerance in job["tolerances"]]
    scale = scale_of(scene, initial_state(scene))
    return known | {"particles": scene.raster.count, "scale": scale, "steps": steps}


@dataclass(frozen=True)
class Decay:
    """What is left of the way to equilibrium after n steps, as a share of the largest prescribed
    displacement: `share` · `rate`ⁿ, in the end."""

    share: float
    rate: float

    def steps_to(self, tolerance: float) -> int | None:
        """Steps until less than `tolerance` is left; None where it never is."""
        if not 0.0 < self.rate < 1.0:
            return None
        return max(1, math.ceil(math.log(max(1.0, self.share / tolerance)) / -math.log(self.rate)))


def followers_of(scene: Scene) -> NDArray[np.intp]:
    """The flat places of those who follow in the last step."""
    kinds = kinds_at(scene.raster, scene.leading, scene.experiment.steps)
    return scene.raster.place_of(np.flatnonzero(kinds == FOLLOWER))


def _of_followers(scene: Scene, state: State) -> Floats:
    """Their displacements, (axis, follower)."""
    return state.u.reshape(len(state.u), -1)[:, followers_of(scene)].astype(float)


def decay_of(scene: Scene, exact: Floats) -> Decay:
    """Of the slowest mode that the start excites, by inverse iteration from the way that is to go
    to `exact`, (axis, follower): v ← A⁻¹ v, A = 1 - (step operator). Its share is the projection of
    that way onto it."""
    start = initial_state(scene)
    steps, resting = scene.experiment.steps, initial_state(scene)
    resting.u[...] = 0.0
    way = np.zeros_like(resting.u)
    way.reshape(len(way), -1)[:, followers_of(scene)] = exact - _of_followers(scene, start)
    if not way.any():
        return Decay(0.0, 0.0)
    system, slowest = linearised(scene, resting, steps, "auto", Watch()), SlowMode(way, 1.0)
    for _ in range(TURNS):
        slowest = slowest.improved(system, ROUGH)
    mode = slowest.planes
    along = float((way * mode).sum() / (mode * mode).sum())
    share = abs(along) * _longest(mode) / scale_of(scene, start)
    return Decay(share, 1.0 - 1.0 / slowest.slowness)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
