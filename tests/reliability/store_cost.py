"""Measure the cost of storing unfinished runs, against the same without; in turns, medians of
pairs.

python tests/reliability/store_cost.py [--turns N] [--records N]
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from trials import BASE, row

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
from pairing import wait_for_quiet
from sheets import Running, moving, scene_of

from pbdkit.io.netcdf import FIRST_S, NetcdfSink
from pbdkit.io.run_store import store_of
from pbdkit.io.sinks import OverlappingSink
from pbdkit.simulation import Simulation, record

NEVER = 1e9
Work = Callable[[], object]


def seconds(work: Work) -> float:
    """Return the wall-clock time of the work."""
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun


def in_pairs(one: Work, other: Work, turns: int) -> tuple[float, str]:
    """Return the median of the ratios of turns, and the ratios; the order alternates."""
    wait_for_quiet()
    ratios = []
    for turn in range(turns):
        order = (one, other) if turn % 2 else (other, one)
        took = {work: seconds(work) for work in order}
        ratios.append(took[one] / took[other])
    told = f"{min(ratios):.3f} to {max(ratios):.3f} in {turns} pairs, {took[one]:.2f} s the last"
    return statistics.median(ratios), told


def recording(parts: dict[str, Any], path: Path, first_s: float = FIRST_S) -> Work:
    """One recorded run, as `pbdkit run` does it."""
    scene = scene_of(parts)

    def work() -> None:
        path.unlink(missing_ok=True)
        record(Simulation.of_scene(scene), OverlappingSink(NetcdfSink(path, first_s=first_s)))

    return work


def one_record_in_100_ms(folder: Path, turns: int, length_s: float) -> tuple[float, str]:
    """Records of 64 KiB, each after as many steps as take 100 ms."""
    size = 60  # with its frame 4096 bodies and frame points, less some: 16 bytes each, 64 KiB
    solver = {"type": "stepping", "engine": "compiled", "threads": 1}
    parts = moving(size, solver=solver, steps=10**6)
    running = Running(parts, 2000)
    running()
    every = max(1, round(2000 * 0.1 / seconds(running)))
    parts |= {"steps": round(every * length_s * 10), "record": {"every": every}}
    path = folder / "out.nc"
    kept, plain = recording(parts, path), recording(parts, path, NEVER)
    kept()
    return in_pairs(kept, plain, turns)


def against_raw(folder: Path, turns: int, records: int) -> tuple[float, str]:
    """1000², every tenth step, against stepping and plain writing of the same bytes, synced."""
    solver = {"type": "stepping", "engine": "compiled", "threads": 1}
    running = Running(moving(1000, solver=solver), 10)
    running()
    parts = moving(1000, solver=solver, steps=10 * records, record={"every": 10})
    path, plain = folder / "out.nc", folder / "plain"
    work = recording(parts, path)
    work()
    snapshot = bytes(path.stat().st_size // (records + 1))

    def by_hand() -> None:
        plain.unlink(missing_ok=True)
        with plain.open("wb", buffering=0) as file:
            file.write(snapshot)
            for _ in range(records):
                running()
                file.write(snapshot)
            os.fsync(file.fileno())

    found = in_pairs(work, by_hand, turns)
    path.unlink()
    plain.unlink()
    return found


def files_of_short_runs(folder: Path) -> int:
    """Return the number of further files that a run of less than a second leaves in its folder."""
    path = folder / "short.nc"
    recording(BASE | {"name": "short"}, path)()
    assert not store_of(path).exists()
    return len(list(folder.iterdir())) - 1


def main() -> int:
    asked = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    asked.add_argument("--turns", type=int, default=5)
    asked.add_argument("--records", type=int, default=500)
    asked.add_argument("--folder", help="on the disk to measure")
    given = asked.parse_args()
    with tempfile.TemporaryDirectory(dir=given.folder) as name:
        folder = Path(name)
        left = files_of_short_runs(folder)
        row("a run of less than a second leaves 0 files", f"{left}")
        found, told = one_record_in_100_ms(folder, 2 * given.turns, 4.0)
        row("store, 64 KiB each 100 ms: at most 1.05", f"{found:.3f} ({told})")
        found, told = against_raw(folder, given.turns, 20)
        row("20 records, about a second, against raw: at most 1.3", f"{found:.3f} ({told})")
        found, told = against_raw(folder, given.turns, given.records)
        row("recording, store included, against raw: at most 1.5", f"{found:.3f} ({told})")
    return int(left > 0)


if __name__ == "__main__":
    sys.exit(main())
