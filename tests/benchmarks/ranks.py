"""Several processes on one lattice: against one and against threads, what an exchange costs, and
what each holds in memory."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sheets import Running, moving, scene_of

from pbdkit.mpi.communicator import MPICommunicator
from pbdkit.mpi.distributed_run import DistributedExecution
from pbdkit.mpi.driver import DistributedStepper, Division
from pbdkit.mpi.partition import MAX_STEPS_PER_EXCHANGE, subdomains
from pbdkit.simulation import peak_memory
from pbdkit.stepping.numba_engine.engine import CompiledStepper

SIZE, STEPS, TURNS = 3000, 32, 9
HELD, PARTS, SMALL = 4000, 4, 200
MILLION, ROWS = 10**6, (1000, 100, 32)
"""Parts of 10⁹ particles among 1000 processes: of 10⁶ rows, of 100 000, and of a square."""
PAUSE_S = 0.01


def ranks() -> dict[str, Any] | None:
    """Return None, after a message, if there is no mpiexec."""
    if not shutil.which("mpiexec"):
        print("ranks: not measured: there is no mpiexec: pip install mpich")
        return None
    found = _on(2, "speed")[0]
    one, every = _on(1, "memory")[0], _on(PARTS, "memory")
    return found | {"alone_bytes": one, "rank_bytes": every}


def weak_scaling() -> list[dict[str, float]] | None:
    """Return None, after a message, if there is no mpiexec."""
    if not shutil.which("mpiexec"):
        print("weak: not measured: there is no mpiexec: pip install mpich")
        return None
    found: list[dict[str, float]] = _on(2, "weak")[0]
    return found


def _on(size: int, what: str) -> list[Any]:
    """Return what the processes of a launch have recorded, by rank."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, __file__, what, folder]
        subprocess.run([*(["mpiexec", "-n", str(size)] * (size > 1)), *command], check=True)
        return [json.loads((Path(folder) / str(n)).read_text()) for n in range(size)]


class Sharing:
    """A sheet in motion on all ranks; a call makes further steps."""

    def __init__(self, ranks: DistributedExecution, parts: dict[str, Any]) -> None:
        scene = scene_of(parts)
        self.division = Division(
            ranks.communicator, scene, subdomains(scene, ranks.communicator.size)
        )
        part, self.halo = self.division.scene, self.division.halo
        engine, steps = CompiledStepper(part, 1), self.division.part.subdomain.steps
        self.steps, self.sent = steps, 0
        for rows in self.halo.received.values():
            self.sent += (rows.stop - rows.start) * part.raster.shape[2] * 16
        self._stepper = DistributedStepper(ranks, part, engine, self.halo, steps)
        self.state, _ = self.division.initial_part(scene)

    def __call__(self) -> None:
        self.state = self._stepper.advance(self.state, STEPS)


def speed(ranks: DistributedExecution) -> dict[str, float]:
    """Return the best seconds of a number of steps, in turns; while one process works the others
    sleep."""
    shared = Sharing(ranks, moving(SIZE))
    alone = (
        [Running(moving(SIZE), STEPS, threads=n) for n in (1, 2)]
        if ranks.communicator.is_root
        else []
    )
    seconds: dict[str, list[float]] = {"shared": [], "exchange": [], "1": [], "2": []}
    works = {"shared": shared, "exchange": lambda: shared.halo.renew(shared.state)}
    for turn in range(TURNS + 1):
        _timed(ranks, works, seconds, turn)
        for running in alone:
            begun = time.perf_counter()
            running()
            seconds[str(running.engine.threads)] += [time.perf_counter() - begun] * (turn > 0)
        _wait(ranks)
    best = {name: min(taken, default=0.0) for name, taken in seconds.items()}
    known = {"steps": STEPS, "size": SIZE, "between": shared.steps}
    return best | known | {"sent_bytes": shared.sent}


def _timed(
    ranks: DistributedExecution,
    works: dict[str, Callable[[], Any]],
    seconds: dict[str, list[float]],
    turn: int,
) -> None:
    """Notes what each takes in all processes at once; not of the first turn."""
    for name, work in works.items():
        ranks.communicator.any(False)
        begun = time.perf_counter()
        work()
        ranks.communicator.any(False)
        seconds[name] += [time.perf_counter() - begun] * (turn > 0)


def weak(ranks: DistributedExecution) -> list[dict[str, float]]:
    """Measure parts of a million particles with a neighbour on either side: their steps between two
    exchanges, an exchange with one neighbour, and as many steps of such a body alone."""
    return [_weak(ranks, rows, MILLION // rows) for rows in ROWS]


def _weak(ranks: DistributedExecution, rows: int, places: int) -> dict[str, float]:
    def sheet(count: int) -> dict[str, Any]:
        body = {"type": "grid", "columns": count, "rows": places}
        return moving(0, body=body, frame={"type": "none"})

    shared = Sharing(ranks, sheet(ranks.communicator.size * rows))
    own = shared.division.part.subdomain
    halo = max(own.begin - own.low, own.high - own.end)
    works = {
        "part": Running(sheet(rows + 2 * halo), shared.steps),
        "exchange": lambda: shared.halo.renew(shared.state),
        "alone": Running(sheet(rows), MAX_STEPS_PER_EXCHANGE),
    }
    seconds: dict[str, list[float]] = {name: [] for name in works}
    for turn in range(TURNS + 1):
        _timed(ranks, works, seconds, turn)
    best = {name: min(taken) for name, taken in seconds.items()}
    best["alone"] *= shared.steps / MAX_STEPS_PER_EXCHANGE
    return best | {"rows": rows, "places": places, "steps": shared.steps}


def _wait(ranks: DistributedExecution) -> None:
    """For the first process, asleep."""
    if ranks.communicator.is_root:
        for rank in range(1, ranks.communicator.size):
            ranks.communicator._comm.send(None, rank)
    else:
        while not ranks.communicator._comm.iprobe(source=0):
            time.sleep(PAUSE_S)
        ranks.communicator._comm.recv(source=0)


def memory(ranks: DistributedExecution | None) -> float:
    """Bytes that a run of a large body takes in this process beyond one of a small body."""
    from pbdkit.io.netcdf import NetcdfSink
    from pbdkit.model.experiment import Experiment
    from pbdkit.progress import Watch
    from pbdkit.simulation import Execution, record

    held = []
    for size in (SMALL, HELD):
        with tempfile.TemporaryDirectory() as folder:
            parts = moving(size, initial={"type": "reference"}, steps=20, record={"every": 20})
            solver = {"type": "stepping", "engine": "compiled", "threads": 1}
            experiment = Experiment.model_validate(parts | {"solver": solver})
            together = ranks or Execution()
            run = together.run(together.scene(experiment), Watch())
            record(run, run.sink(NetcdfSink(Path(folder) / "out.nc")))
            held.append(peak_memory())
    return float(held[1] - held[0])


def main() -> None:
    """One of the processes of a launch."""
    what, folder = sys.argv[1:]
    from mpi4py import MPI

    comm = MPI.COMM_WORLD
    found: Any
    if comm.size == 1:
        found = memory(None)
    else:
        execution = DistributedExecution(MPICommunicator(comm))
        found = {"speed": speed, "memory": memory, "weak": weak}[what](execution)
    (Path(folder) / str(comm.rank)).write_text(json.dumps(found))


if __name__ == "__main__":
    main()
