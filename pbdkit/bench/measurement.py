"""An experiment measured: what each method costs at a size, and how far it is from the truth."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pbdkit.api import load
from pbdkit.bench.size import resized
from pbdkit.errors import ExperimentError, PluginError
from pbdkit.experiment.model import Experiment
from pbdkit.stepping.choice import processors
from pbdkit.stepping.gpu.limits import what_is_missing

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
        """What rows of one colour in a picture have in common."""
        return self.method + (f", {self.threads} threads" if (self.threads or 1) > 1 else "")


def engines() -> list[tuple[str, str, int]]:
    """Engine, precision and threads of all ways to step, the reference first."""
    ways = [("numpy", 1), *(("compiled", n) for n in dict.fromkeys((1, processors())))]
    ways += [] if what_is_missing() else [("gpu", 1)]
    return [(name, kind, threads) for name, threads in ways for kind in ("float64", "float32")]


def ways(asked: Experiment) -> int:
    """So many rows `measure` gives of a size, or a few less."""
    if asked.solver.makes_steps:
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
    call = [sys.executable, "-m", "pbdkit.bench.worker", str(answer)]
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
