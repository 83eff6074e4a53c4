"""A sample of the state machines, and some seeds of a sweep with dying workers; the scripts
tests/reliability/state_machines.py and dying_workers.py make any number."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import run_state_machine_as_test
from machines.dying_workers import simulate
from machines.every import MACHINES

SHARES = {
    "pieces": 1200,
    "paged-file": 1200,
    "sweep-store": 900,
    "live": 900,
    "simulation": 300,
    "result-file": 40,
    "run": 120,
    "sweep": 100,
}
"""Steps of each machine, about 4800 in all. Where a step takes more time, there are fewer."""
STEPS_PER_EXAMPLE = 20
SEEDS = 15


@pytest.mark.parametrize("name", MACHINES)
def test_random_calls_agree_with_a_model(name: str) -> None:
    machine = MACHINES[name]
    examples = max(2, SHARES[name] // STEPS_PER_EXAMPLE * settings().max_examples // 40)
    run_state_machine_as_test(
        machine,
        settings=settings(
            max_examples=examples,
            stateful_step_count=STEPS_PER_EXAMPLE,
            suppress_health_check=list(HealthCheck),
            phases=[Phase.explicit, Phase.reuse, Phase.generate, Phase.shrink],
        ),
    )
    assert machine.steps >= examples


@pytest.mark.parametrize("seed", range(SEEDS))
def test_sweep_whose_workers_die_is_completed(seed: int, tmp_path: Path) -> None:
    simulate(seed, tmp_path)
