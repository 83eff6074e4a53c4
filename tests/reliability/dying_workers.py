"""Simulate sweeps with workers that die and with kills of the sweep itself, in one process. Each
simulation is determined by a seed.

    python tests/reliability/dying_workers.py [--seeds N] [--first S]

Workers die before, while and after they run members, chunks end in any order, the clock stands
still or jumps, and the process of the sweep is killed at any line and started again with other
members. Goal: all members have the values of their runs, and none that was committed is lost or run
again. `sweep_under_fire.py` kills real processes.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parent.parent)]

from machines.counted import MEMORY
from machines.dying_workers import simulate
from trials import row


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    asked.add_argument("--seeds", type=int, default=5000)
    asked.add_argument("--first", type=int, default=0)
    given = asked.parse_args()
    failed = deaths = kills = members = 0
    begin = time.process_time()
    warnings.simplefilter("ignore")
    for seed in range(given.first, given.first + given.seeds):
        with tempfile.TemporaryDirectory(dir=MEMORY) as folder:
            try:
                figures = simulate(seed, Path(folder))
            except Exception:
                failed += 1
                print(f"seed {seed}:", flush=True)
                traceback.print_exc()
                continue
        deaths, kills = deaths + figures.deaths, kills + figures.kills
        members += figures.members
    seconds = time.process_time() - begin
    row(
        "members of sweeps under seeded deaths that are lost, wrong or run again: 0",
        f"{failed} of {given.seeds} seeds failed: {members} members, {deaths} deaths of workers, "
        f"{kills} kills of the sweep, {seconds:.0f} s of processor time",
    )
    raise SystemExit(failed > 0)


if __name__ == "__main__":
    main()
