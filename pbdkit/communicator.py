"""Collective operations among the processes that share a run.

All processes must call every operation in the same order, and all receive the same value. `SERIAL`
is the communicator of a process that runs alone. The communicator of MPI is defined in
`pbdkit.mpi.communicator`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from contextlib import AbstractContextManager, nullcontext
from platform import node
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Communicator(ABC):
    """The processes that share a run, of which this one is `rank` of `size`."""

    rank: int = 0
    size: int = 1

    @property
    def is_root(self) -> bool:
        """True if this process is the root, which reads, writes and prints for all processes."""
        return self.rank == 0

    @abstractmethod
    def allgather(self, value: Any) -> list[Any]:
        """Return the values of all processes, by rank."""

    @abstractmethod
    def raise_together(self) -> AbstractContextManager[None]:
        """Run the block, and raise an exception of any process in all processes.

        The exception is raised at the end of the block. If several processes have one, that of the
        lowest rank is raised.
        """

    def bcast(self, value: Any) -> Any:
        """Return the value of the root."""
        return self.allgather(value)[0]

    def any(self, value: Any) -> bool:
        """Return whether the value is true in at least one process."""
        return any(self.allgather(bool(value)))

    def first(self, value: Any) -> Any:
        """Return the first value that is not None, in the order of ranks; None if there is none."""
        return next((item for item in self.allgather(value) if item is not None), None)

    def sum(self, value: Any) -> Any:
        """Return the sum over all processes."""
        return sum(self.allgather(value))

    def largest(self, value: float) -> float:
        """Return the largest value of all processes; NaN if one of them is NaN."""
        values = [float(number) for number in self.allgather(value)]
        return math.nan if any(map(math.isnan, values)) else max(values)

    @abstractmethod
    def smallest(self, numbers: NDArray[Any]) -> NDArray[Any]:
        """Return the elementwise minimum of arrays of all processes, which have the same shape."""

    def processes_on_machine(self) -> int:
        """Return the number of processes on the machine on which this process runs."""
        name = node()
        return self.allgather(name).count(name)


class SerialCommunicator(Communicator):
    """Communicator of a single process."""

    def allgather(self, value: Any) -> list[Any]:
        """Return the value, in a list."""
        return [value]

    def raise_together(self) -> AbstractContextManager[None]:
        """Run the block. There is no other process to which an exception must be sent."""
        return nullcontext()

    def smallest(self, numbers: NDArray[Any]) -> NDArray[Any]:
        """Return the numbers unchanged."""
        return numbers

    def processes_on_machine(self) -> int:
        """Return 1, because there is only one process."""
        return 1


SERIAL: Final = SerialCommunicator()
"""Communicator of a single process, used by default."""
