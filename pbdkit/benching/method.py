"""What the table compares: a method, and a method measured at a size."""

from __future__ import annotations

import os
from dataclasses import dataclass


@dataclass(frozen=True)
class Method:
    """A way to get through an experiment: `settings`, as after ``--set``, make a run use it.

    `name` is what the table calls it. `precision` and `threads` are columns of their own.
    """

    name: str
    precision: str
    threads: int
    settings: tuple[str, ...]

    def __str__(self) -> str:
        threads = f", {self.threads} threads" if self.threads > 1 else ""
        return f"{self.name}, {self.precision}{threads}"


@dataclass(frozen=True)
class Measured:
    """A method measured at a size.

    `size` is None where the experiment was run as it is. `setup_s` is the time from the experiment
    to an engine that is ready; `setup_first_s` the same when nothing has been compiled before.
    `peak_memory_mib` is above that of a process that has only imported what the method needs.
    `error` is the largest |x - x_ref| over the run and its particles, against the reference,
    relative to the largest displacement there; None where a run left the finite numbers.
    """

    method: Method
    size: int | None
    particles: int
    steps: int
    setup_first_s: float
    setup_s: float
    ns_per_particle_step: float
    peak_memory_mib: float
    error: float | None


@dataclass(frozen=True)
class NotMeasured:
    """A method that cannot be had at a size, and why in one line."""

    method: Method
    size: int | None
    reason: str


def stepping(engine: str, precision: str, threads: int) -> Method:
    """One step after the other by one of the engines."""
    settings = (
        f"solver.engine={engine}",
        f"solver.precision={precision}",
        f"solver.threads={threads}",
    )
    return Method(engine, precision, threads, settings)


REFERENCE = stepping("numpy", "float64", 1)
"""What errors are measured against."""


def methods() -> list[Method]:
    """All that can be compared on this machine, the reference first."""
    found = [REFERENCE, stepping("numpy", "float32", 1)]
    for threads in dict.fromkeys((1, processors())):
        found += [stepping("compiled", precision, threads) for precision in ("float64", "float32")]
    return found


def processors() -> int:
    """Those that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
