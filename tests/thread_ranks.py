"""Several processes played by threads of one: what mpi4py's communicator does, over queues."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from queue import Queue
from typing import Any

from pbdkit.mpi.communicator import MPICommunicator
from pbdkit.mpi.distributed_run import DistributedExecution

PATIENCE_S = 120.0


class ThreadComm:
    """Communicator of one thread; all share `boxes`, a queue for each pair."""

    def __init__(self, rank: int, size: int, boxes: dict[tuple[int, int], Queue[Any]]) -> None:
        self.rank, self.size, self._boxes = rank, size, boxes

    def send(self, value: Any, dest: int) -> None:
        self._boxes[self.rank, dest].put(pickle.dumps(value))

    def recv(self, source: int) -> Any:
        return pickle.loads(self._boxes[source, self.rank].get(timeout=PATIENCE_S))

    def Send(self, array: Any, dest: int) -> None:  # noqa: N802
        self.send(array.copy(), dest)

    def Recv(self, into: Any, source: int) -> None:  # noqa: N802
        into[...] = self.recv(source)

    def Isend(self, array: Any, dest: int) -> Request:  # noqa: N802
        self.Send(array, dest)
        return Request(lambda: None)

    def Irecv(self, into: Any, source: int) -> Request:  # noqa: N802
        return Request(lambda: self.Recv(into, source))

    def allgather(self, value: Any) -> list[Any]:
        for rank in range(self.size):
            self.send(value, rank)
        return [self.recv(rank) for rank in range(self.size)]

    def Allgather(self, mine: Any, found: Any) -> None:  # noqa: N802
        for rank, value in enumerate(self.allgather(mine)):
            found[rank] = value.reshape(found.shape[1:])

    def bcast(self, value: Any) -> Any:
        if self.rank == 0:
            for rank in range(self.size):
                self.send(value, rank)
        return self.recv(0)


class Request:
    """A request for a pending message."""

    def __init__(self, wait: Callable[[], None]) -> None:
        self.Wait = wait


def on_ranks(size: int, work: Callable[[DistributedExecution], Any]) -> list[Any]:
    """Return the results of the work in each of a number of processes; raise the first
    exception."""
    boxes: dict[tuple[int, int], Queue[Any]] = {
        (a, b): Queue() for a in range(size) for b in range(size)
    }
    with ThreadPoolExecutor(size) as threads:
        comms = [MPICommunicator(ThreadComm(rank, size, boxes)) for rank in range(size)]
        every = [threads.submit(work, DistributedExecution(comm)) for comm in comms]
        return [one.result() for one in every]
