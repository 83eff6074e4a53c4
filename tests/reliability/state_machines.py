"""Random calls of the stores, of sweeps, of `Simulation`, of live sessions and of the readers of
results, compared with models in memory.

    python tests/reliability/state_machines.py [--steps N] [--seed S] [--machines NAME ...]

Each machine of tests/machines makes at least N steps; a counterexample is shortened and printed.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
import traceback
import warnings
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parent.parent)]

from hypothesis import HealthCheck, seed as seeded, settings
from hypothesis.stateful import run_state_machine_as_test
from machines.counted import Counted
from machines.every import MACHINES
from trials import row

STEPS_PER_EXAMPLE = 50
EXAMPLES = 100
"""Examples of one seed. Hypothesis draws them so that they differ from each other."""


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    asked.add_argument("--steps", type=int, default=100_000)
    asked.add_argument("--seed", type=int, default=1)
    asked.add_argument("--machines", nargs="+", choices=[*MACHINES], default=[*MACHINES])
    given = asked.parse_args()
    print("machine | steps | counterexamples | seconds of processor time", flush=True)
    total, failed = 0, 0
    for name in given.machines:
        machine = MACHINES[name]
        begin = time.process_time()
        found = counterexamples(machine, given.steps, given.seed)
        seconds = time.process_time() - begin
        print(f"{name} | {machine.steps} | {found} | {seconds:.0f}", flush=True)
        total, failed = total + machine.steps, failed + found
    row("random calls that differ from a model in memory: 0", f"{failed} in {total} steps")
    raise SystemExit(failed > 0)


def counterexamples(machine: type[Counted], steps: int, seed: int) -> int:
    """Make at least this number of steps, and return the number of seeds with a counterexample;
    after three of them the machine stops."""
    found = 0
    while machine.steps < steps and found < 3:
        left = -(-(steps - machine.steps) // STEPS_PER_EXAMPLE)
        chosen = settings(
            max_examples=max(1, min(EXAMPLES, left)),
            stateful_step_count=STEPS_PER_EXAMPLE,
            database=None,
            deadline=None,
            suppress_health_check=list(HealthCheck),
            report_multiple_bugs=False,
        )
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                run_state_machine_as_test(seeded(seed)(machine), settings=chosen)
        except Exception:
            found += 1
            print(f"seed {seed}:", flush=True)
            traceback.print_exc()
        seed += 1
    return found


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
