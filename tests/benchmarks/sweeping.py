"""Measure the cost of the small runs of a sweep: ``python tests/benchmarks/sweeping.py``.

1000 runs of paper/a over its relaxation with two workers, against the same by `pbdkit.run` in one
process, of which a sample is timed before and after. Goals: 1.7 times faster, and a store of 10 MB
at most with `keep: {variables: [pe1], times: last}`.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import pbdkit

MEMBERS, SAMPLE, WORKERS = 1000, 40, 2
RELAXATIONS = np.linspace(0.5, 1.0, MEMBERS)
SMALL, ALL = {"variables": ["pe1"], "times": "last"}, {"variables": ["pe1"], "times": "all"}


def alone() -> float:
    """Seconds a run in this process, over the sample."""
    chosen = RELAXATIONS[:: MEMBERS // SAMPLE]
    begun = time.perf_counter()
    for relaxation in chosen:
        settings = [f"solver.relaxation={relaxation}"]
        pbdkit.run(pbdkit.load("paper/a", settings=settings), progress=False)
    return (time.perf_counter() - begun) / len(chosen)


def swept(keep: dict[str, Any], members: int) -> tuple[float, float]:
    """Seconds a member, and MB that the store takes."""
    chosen = RELAXATIONS[:: MEMBERS // members]
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        pbdkit.sweep(
            "paper/a", vary={"solver.relaxation": chosen}, keep=keep, folder=folder,
            workers=WORKERS, progress=False,
        ).close()  # fmt: skip
        seconds = (time.perf_counter() - begun) / len(chosen)
        size = sum(p.stat().st_size for p in Path(folder).rglob("*") if p.name != "sweep.nc")
    return seconds, size / 1e6


def main() -> None:
    """Prints goals and measured."""
    alone()
    before = alone()
    seconds, size = swept(SMALL, MEMBERS)
    between = alone()
    every, _ = swept(ALL, MEMBERS // 5)
    after = alone()
    single = (before + between) / 2
    print(f"pbdkit.run in one process: {single * 1e3:.1f} ms a run")
    print(f"swept, {WORKERS} workers, the last PE1 kept: {seconds * 1e3:.1f} ms a run")
    print(f"swept, {WORKERS} workers, every PE1 kept: {every * 1e3:.1f} ms a run")
    ratio, full = single / seconds, (between + after) / 2 / every
    print(f"times faster, the last PE1 kept: goal 1.7  measured {ratio:.2f}")
    print(f"times faster, every PE1 kept:    goal 1.7  measured {full:.2f}")
    print(f"MB of store: goal 10  measured {size:.2f}")
    sys.exit(not (ratio >= 1.7 and size <= 10))


if __name__ == "__main__":
    main()
