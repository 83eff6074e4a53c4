"""Detection of a start by mpiexec. If a program is started in another way, little is imported."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from pbdkit.communicator import SERIAL, Communicator
from pbdkit.errors import ExperimentError, refuse_without

if TYPE_CHECKING:
    from pbdkit.simulation import Execution

SIZES = ("PMI_SIZE", "OMPI_COMM_WORLD_SIZE", "MV2_COMM_WORLD_SIZE")
"""Environment variables in which launchers of MPI programs store the number of processes."""
RANK = "PMIX_RANK"
"""Environment variable that other launchers set, and that contains the rank."""


@contextmanager
def launched() -> Iterator[Communicator]:
    """Yield the communicator of the processes that were started together, as by `mpiexec -n 4`.

    In the block, only the root prints. If the process was started alone, the serial communicator is
    yielded.

    Raises ExperimentError if mpi4py is missing, finds no MPI library, or uses another MPI library
    than the launcher.
    """
    size = max(int(os.environ.get(name, 1)) for name in SIZES)
    if RANK not in os.environ and size == 1:
        yield SERIAL
        return
    refuse_without("mpi4py", "mpi", "a run on several processes requires mpi4py")
    try:
        from mpi4py import MPI
    except (ImportError, RuntimeError) as error:
        raise ExperimentError(
            "mpi4py finds no MPI library; install one, for instance by pip install mpich, and "
            f"start the processes by its mpiexec ({str(error).splitlines()[0]})"
        ) from None
    if MPI.COMM_WORLD.size == 1:
        if size > 1:
            raise ExperimentError(
                f"{size} processes were started, but mpi4py finds only one in each: its MPI "
                "library is not that of the launcher; use the mpiexec of the library that mpi4py "
                "loads"
            )
        yield SERIAL
        return
    from pbdkit.mpi.communicator import MPICommunicator

    communicator = MPICommunicator(MPI.COMM_WORLD)
    with communicator.root_speaks():
        yield communicator


def execution_of(communicator: Communicator) -> Execution:
    """Return the execution of runs for the processes of a communicator."""
    if communicator is SERIAL:
        from pbdkit.simulation import Execution

        return Execution()
    from pbdkit.mpi.communicator import MPICommunicator
    from pbdkit.mpi.distributed_run import DistributedExecution

    assert isinstance(communicator, MPICommunicator)
    return DistributedExecution(communicator)
