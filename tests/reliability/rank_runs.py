"""Run random scenes with one process and with several, which must give the same file.

    mpiexec -n 3 python tests/reliability/rank_runs.py [--trials N] [--seed S] [--only NUMBER]

Variables, attributes and the final state are compared bit for bit, except `created` and `ranks`.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, Phase, given, seed, settings, strategies as st
from mpi4py import MPI
from trials import differences, row

# isort: split
from scene_strategies import calibrated_experiments, experiments, pulled_apart  # beside trials

from pbdkit.errors import PbdkitError
from pbdkit.io.netcdf import NetcdfSink
from pbdkit.model.experiment import Experiment
from pbdkit.mpi.communicator import MPICommunicator
from pbdkit.mpi.distributed_run import DistributedExecution
from pbdkit.progress import Watch
from pbdkit.simulation import Execution, record

Parts = dict[str, Any]
ENGINES = st.sampled_from(["numpy", "numpy", "numpy", "compiled"])


def drawn(count: int, number: int) -> list[Parts]:
    """Return a number of experiments from a seed, each with one of the engines."""
    found: list[Parts] = []
    kinds = st.one_of(
        experiments(),
        experiments(leaders=pulled_apart(), fracturing=st.just(True)),
        calibrated_experiments(),
    )

    @seed(number)
    @settings(
        max_examples=count, database=None, deadline=None, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(kinds, ENGINES)
    def draw(parts: Parts, engine: str) -> None:
        solver = {"type": "stepping"} | parts.get("solver", {}) | {"engine": engine}
        found.append(parts | {"solver": solver})

    draw()
    return found


def ran(parts: Parts, output: Path, processes: Execution) -> str:
    """Run it into a file; return the refusal, with its message."""
    try:
        scene = processes.scene(Experiment.model_validate(parts))
        run = processes.run(scene, Watch())
        record(run, run.sink(NetcdfSink(output, replace=True)))
    except PbdkitError as error:
        return str(error)
    return ""


def tried(parts: Parts, folder: Path, ranks: DistributedExecution) -> tuple[str, list[str]]:
    """Return the outcome, and the differences of the file of several processes."""
    alone = ranks.communicator.bcast(
        ran(parts, folder / "one.nc", Execution()) if ranks.communicator.is_root else ""
    )
    several = ran(parts, folder / "several.nc", ranks)
    if alone or several:
        shared = "several processes" in several or "too few for" in several
        differs = [] if shared or alone == several else [alone, several]
        return ("not shared" if shared else "refused"), differs
    return "compared", differences(
        folder / "one.nc", folder / "several.nc"
    ) if ranks.communicator.is_root else []


def main() -> None:
    """Run the requested number of trials, or one."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", type=int)
    asked = parser.parse_args()
    ranks = DistributedExecution(MPICommunicator(MPI.COMM_WORLD))
    with ranks.communicator.root_speaks():
        every = ranks.communicator.bcast(
            drawn(asked.trials, asked.seed) if ranks.communicator.is_root else None
        )
        chosen = range(len(every)) if asked.only is None else [asked.only]
        counts, wrong = Counter[str](), 0
        with tempfile.TemporaryDirectory() as folder:
            for number in chosen:
                outcome, found = ranks.communicator.bcast(tried(every[number], Path(folder), ranks))
                counts[outcome] += 1
                wrong += bool(found)
                if found and ranks.communicator.is_root:
                    print(f"number {number}: {'; '.join(found)}", file=sys.stderr, flush=True)
                if asked.only is not None and ranks.communicator.is_root:
                    print(every[number])
        if ranks.communicator.is_root:
            row(
                f"random scenes on {ranks.communicator.size} processes {dict(counts)}: that differ",
                str(wrong),
            )
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
