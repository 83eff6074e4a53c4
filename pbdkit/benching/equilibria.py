"""Measures ways to equilibrium at sizes and tolerances: its methods, and the steps themselves."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pbdkit.api import load
from pbdkit.benching.measuring import Tell, worked
from pbdkit.benching.method import processors
from pbdkit.benching.resizing import resized
from pbdkit.errors import ExperimentError, PluginError

TOLERANCES = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10)
METHODS = ("lu", "multigrid", "conjugate-gradients")
DIRECT = ("lu",)
"""Methods that do not get faster with a looser tolerance: only the tightest is measured."""
LARGEST_DIRECT = 2_000_000
"""Particles above which LU is left out: its factors take 1.4 GiB at a million, and grow faster."""
STEPPING = "stepping"
PATIENCE_S = 60.0
"""Steps that would take longer are not made: they are measured by the step and counted ahead."""
IN_MOTION = ("initial={type: noise, amplitude: 1e-3}", "steps=10000000")
"""So that every particle moves in the steps that are timed, and the engine for long runs is taken;
so many are not made."""


@dataclass(frozen=True)
class Solved:
    """A way to equilibrium, measured at a size and a tolerance.

    `iterations` are those of the linear solver, or steps. `seconds` are from the experiment to the
    equilibrium, imports done and kernels compiled; `cpu_s` of all processors together. `certified`
    is what the certificate says, `error` what is true, both shares of the largest prescribed
    displacement. `is_predicted`: times are those of a measured step times the steps that the
    slowest mode needs, and the error is what it leaves.
    """

    method: str
    size: int | None
    particles: int
    tolerance: float
    iterations: int
    seconds: float
    cpu_s: float
    certified: float | None
    error: float | None
    peak_memory_mib: float | None
    is_predicted: bool = False


@dataclass(frozen=True)
class Unsolved:
    """A method that cannot be had at a size and tolerance (None: at none), and why in one line."""

    method: str
    size: int | None
    tolerance: float | None
    reason: str


@dataclass(frozen=True)
class Truth:
    """What the errors at a size are measured against: how it is known, and within what share; and
    the largest eigenvalue of a step, by which the steps are counted ahead."""

    size: int | None
    particles: int
    how: str
    within: float
    rate: float


Row = Solved | Unsolved


@dataclass(frozen=True)
class EquilibriumBench:
    """An experiment with `solver: equilibrium` to be measured: its name, settings and steps.

    Every method has a process of its own; nothing is recorded and no diagnostic taken. Raises
    ExperimentError and PluginError where there is no equilibrium to measure against.
    """

    experiment: str
    settings: tuple[str, ...]
    steps: int
    tolerances: tuple[float, ...] = TOLERANCES

    def measure(self, size: int | None, tell: Tell) -> tuple[Truth, list[Row]]:
        """What is true at a size, None as it is, and a row a method and tolerance."""
        settings = self._resized(size)
        scene = load(self.experiment, settings=settings)
        if scene.fracture.type != "none":
            raise scene.located(
                ExperimentError(
                    "speed against error is measured where no bond can break; set "
                    "fracture={type: none}",
                    ("fracture",),
                )
            )
        with tempfile.TemporaryDirectory(prefix="pbdkit-bench-") as name:
            reference = Path(name)
            tell(f"the exact answer, size {size or 'as it is'}")
            tight = (*settings, f"solver.tolerance={min(self.tolerances) / 100:g}")
            found = self._work(tight, reference, reference, "exact")
            truth = Truth(size, *(found[key] for key in ("particles", "how", "within", "rate")))
            rows: list[Row] = []
            for method in METHODS:
                tell(f"{method}, size {size or 'as it is'}")
                rows += self._settled(method, truth, settings, reference)
            tell(f"{STEPPING}, size {size or 'as it is'}")
            rows += self._stepped(truth, found["steps"], settings, reference)
        return truth, rows

    def _settled(
        self, method: str, truth: Truth, settings: tuple[str, ...], reference: Path
    ) -> Iterator[Row]:
        size, tolerances = truth.size, sorted(self.tolerances, reverse=True)
        if method in DIRECT:
            if truth.particles > LARGEST_DIRECT:
                reason = f"left out above {LARGEST_DIRECT} particles: its factors take gibibytes"
                yield Unsolved(method, size, None, reason)
                return
            tolerances = tolerances[-1:]
        asked = (*settings, f"solver.method={method}")
        try:
            found = self._work(asked, reference / method, reference, "settle", tolerances)
        except (ExperimentError, PluginError) as error:
            yield Unsolved(method, size, None, " ".join(str(error).split()))
            return
        for tolerance, row in zip(tolerances, found["rows"], strict=False):
            kept = {
                key: row[key] for key in ("iterations", "seconds", "cpu_s", "certified", "error")
            }
            memory = found["peak_memory_mib"]
            yield Solved(method, size, truth.particles, tolerance, peak_memory_mib=memory, **kept)
        for tolerance in tolerances[len(found["rows"]) :]:
            reason = f"{found['rows'][-1]['seconds']:.0f} s for the tolerance before"
            yield Unsolved(method, size, tolerance, reason)

    def _stepped(
        self, truth: Truth, steps: list[int | None], settings: tuple[str, ...], reference: Path
    ) -> Iterator[Row]:
        size = truth.size
        stepping = (*settings, "solver={type: stepping}")
        a_step, cpu_a_step, threads = min(
            (*self._seconds_a_step(stepping, threads, reference), threads)
            for threads in dict.fromkeys((1, processors()))
        )
        stepping = (*stepping, f"solver.threads={threads}")
        known = {t: n for t, n in zip(self.tolerances, steps, strict=True) if n is not None}
        for tolerance in set(self.tolerances) - set(known):
            reason = f"steps do not settle: the largest eigenvalue is {truth.rate:.6g}"
            yield Unsolved(STEPPING, size, tolerance, reason)
        made = {t: n for t, n in known.items() if n * a_step <= PATIENCE_S}
        if made:
            there = tuple(sorted(made.values()))
            asked = (*stepping, f"steps={there[-1]}")
            rows = self._work(asked, reference / STEPPING, reference, "step", at=there)["rows"]
            by_steps = {row["iterations"]: row for row in rows}
            for tolerance in sorted(made, reverse=True):
                row = by_steps[made[tolerance]]
                yield Solved(
                    STEPPING, size, truth.particles, tolerance, row["iterations"], row["seconds"],
                    row["cpu_s"], None, row["error"], None,
                )  # fmt: skip
        for tolerance in sorted(set(known) - set(made), reverse=True):
            n = known[tolerance]
            yield Solved(
                STEPPING, size, truth.particles, tolerance, n, n * a_step, n * cpu_a_step, None,
                tolerance, None, is_predicted=True,
            )  # fmt: skip

    def _seconds_a_step(
        self, stepping: tuple[str, ...], threads: int, folder: Path
    ) -> tuple[float, float]:
        """(wall, processors together)."""
        asked = (*stepping, f"solver.threads={threads}", *IN_MOTION)
        found = self._work(asked, folder / f"rate-{threads}", folder, "rate")
        return found["seconds"], found["cpu_s"]

    def _resized(self, size: int | None) -> tuple[str, ...]:
        settings = (*self.settings, f"record={{every: {self.steps}}}", "diagnostics=[]")
        if size is not None:
            settings += resized(load(self.experiment, settings=settings), size)
        return settings

    def _work(
        self,
        settings: tuple[str, ...],
        folder: Path,
        reference: Path,
        what: str,
        tolerances: list[float] | None = None,
        at: tuple[int, ...] = (),
    ) -> dict[str, Any]:
        job = {
            "what": what,
            "experiment": self.experiment,
            "settings": settings,
            "tolerances": tolerances or self.tolerances,
            "at": at,
            "reference": str(reference),
        }
        return worked(job, folder, folder / "cache")
