"""Table of all state machines, by name."""

from __future__ import annotations

from machines.counted import Counted
from machines.live_session import LiveSessionMachine
from machines.result_file import ResultFileMachine
from machines.run import RunMachine
from machines.run_store import PagedFileMachine, PiecesMachine
from machines.simulation import SimulationMachine
from machines.sweeps import SweepMachine, SweepStoreMachine

MACHINES: dict[str, type[Counted]] = {
    "pieces": PiecesMachine,
    "paged-file": PagedFileMachine,
    "run": RunMachine,
    "sweep-store": SweepStoreMachine,
    "sweep": SweepMachine,
    "simulation": SimulationMachine,
    "live": LiveSessionMachine,
    "result-file": ResultFileMachine,
}
