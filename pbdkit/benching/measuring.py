"""Measures methods at sizes: what each costs, and how far it is from the reference."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.api import load
from pbdkit.benching.method import REFERENCE, Measured, Method, NotMeasured
from pbdkit.benching.resizing import resized
from pbdkit.benching.worker import looks
from pbdkit.errors import ExperimentError, PluginError

Row = Measured | NotMeasured
Tell = Callable[[str], None]
FAULTS = {"PluginError": PluginError}


@dataclass(frozen=True)
class Bench:
    """An experiment to be measured: its name, settings and number of steps.

    Every measurement is made in a process of its own. Nothing is recorded and no diagnostic taken:
    stepping alone is measured.
    """

    experiment: str
    settings: tuple[str, ...]
    steps: int
    _imports: dict[str, int] = field(default_factory=dict)

    def measure(self, chosen: Iterable[Method], size: int | None, tell: Tell) -> Iterator[Row]:
        """The reference first, then the methods, at a size; None is the size as it is.

        Raises ExperimentError and PluginError where not even the reference can be run.
        """
        load(self.experiment, settings=self._all_settings(REFERENCE, size))
        with tempfile.TemporaryDirectory(prefix="pbdkit-bench-") as name:
            reference = Path(name) / "reference"
            for method in [REFERENCE, *(m for m in chosen if m != REFERENCE)]:
                tell(f"{method}, size {size or 'as it is'}")
                is_reference = method == REFERENCE
                try:
                    with tempfile.TemporaryDirectory(dir=name) as own:
                        folder = reference if is_reference else Path(own)
                        yield self._measured(method, size, folder, reference)
                except (ExperimentError, PluginError) as error:
                    if is_reference:
                        raise
                    yield NotMeasured(method, size, " ".join(str(error).split()))

    def _measured(
        self, method: Method, size: int | None, folder: Path, reference: Path
    ) -> Measured:
        settings = self._all_settings(method, size)
        imports = self._imports_of(method, settings, folder / "imports")
        cache = folder / "cache"
        first = self._work("set-up", settings, folder / "first", cache)["setup_s"]
        found = self._work("run", settings, folder, cache)
        steps_made = self.steps * found["particles"]
        return Measured(
            method=method,
            size=size,
            particles=found["particles"],
            steps=self.steps,
            setup_first_s=first,
            setup_s=found["setup_s"],
            ns_per_particle_step=found["best_s"] * 1e9 / steps_made,
            peak_memory_mib=max(0, found["peak_memory"] - imports) / 2**20,
            error=_error(folder, reference, looks(self.steps)),
        )

    def _all_settings(self, method: Method, size: int | None) -> tuple[str, ...]:
        bare = (f"steps={self.steps}", f"record={{every: {self.steps}}}", "diagnostics=[]")
        settings = (*self.settings, *bare)
        if size is not None:
            settings += resized(load(self.experiment, settings=settings), size)
        return (*settings, *method.settings)

    def _imports_of(self, method: Method, settings: tuple[str, ...], folder: Path) -> int:
        if method.name not in self._imports:
            found = self._work("imports", settings, folder, folder)
            self._imports[method.name] = found["peak_memory"]
        return self._imports[method.name]

    def _work(
        self, what: str, settings: tuple[str, ...], folder: Path, cache: Path
    ) -> dict[str, Any]:
        """The result of a job in a fresh process, with a cache folder of its own."""
        folder.mkdir(parents=True, exist_ok=True)
        job = {"what": what, "experiment": self.experiment, "settings": settings}
        (folder / "job.json").write_text(json.dumps(job), encoding="utf-8")
        done = subprocess.run(
            [sys.executable, "-m", "pbdkit.benching.worker", str(folder)],
            env=os.environ | {"PBDKIT_CACHE_DIR": str(cache)},
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            said = [line for line in done.stderr.splitlines() if line.strip()]
            why = said[-1] if said else f"it ended with status {done.returncode} (out of memory?)"
            raise ExperimentError(f"the measurement failed: {why}")
        result: dict[str, Any] = json.loads((folder / "result.json").read_text("utf-8"))
        if "fault" in result:
            raise FAULTS.get(result["fault"], ExperimentError)(result["message"])
        return result


def _error(folder: Path, reference: Path, steps: Iterable[int]) -> float | None:
    """max |x - x_ref| / max |x_ref - X|, over the steps looked at."""
    worst = largest = 0.0
    for step in steps:
        there = np.load(reference / f"{step}.npy")
        here = np.load(folder / f"{step}.npy").astype(np.float64)
        worst = max(worst, _longest(here - there), key=_not_a_number_last)
        largest = max(largest, _longest(there), key=_not_a_number_last)
    if not np.isfinite(worst) or not np.isfinite(largest):
        return None
    return worst / largest if worst else 0.0


def _longest(u: NDArray[np.float64]) -> float:
    with np.errstate(all="ignore"):
        return float(np.hypot(u[0], u[1]).max(initial=0.0))


def _not_a_number_last(value: float) -> float:
    return np.inf if np.isnan(value) else value
