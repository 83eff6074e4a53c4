"""The processes that share a run, each by its rank, and what they say to each other by MPI."""

from __future__ import annotations

import atexit
import pickle
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from platform import node
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import PbdkitError
from pbdkit.io.paged_file import Bytes
from pbdkit.simulation import Processes

NUMBERS_AT_ONCE = 2**20
"""So many of all processes together are compared at a time."""
PAUSE_S = 0.05
"""For which processes sleep that wait for the first."""
FAILED = 1
"""The exit status of a run that is given up because one process failed."""


class Ranks(Processes):
    """The processes of a communicator, of which this one is `rank` of `size`. All but `agreeing`
    raise nothing; each call is made by all of them, in the same order."""

    def __init__(self, comm: Any) -> None:
        self._comm = comm
        self.rank, self.size = int(comm.rank), int(comm.size)
        self.first = self.rank == 0

    def told(self, value: Any) -> Any:
        """The first process's value, to all."""
        return self._comm.bcast(value)

    def every(self, value: Any) -> list[Any]:
        """The values of all processes, by rank, to all."""
        return list(self._comm.allgather(value))

    def most(self, value: float) -> float:
        """The largest number of all; not a number where one is none."""
        return float(np.max(self.every(value)))

    def least(self, numbers: NDArray[Any]) -> NDArray[Any]:
        """The smallest of all, place by place of arrays of one shape."""
        flat = np.ascontiguousarray(numbers).ravel()
        found, some = np.empty_like(flat), max(1, NUMBERS_AT_ONCE // self.size)
        for at in range(0, len(flat), some):
            mine = flat[at : at + some]
            every = np.empty((self.size, len(mine)), mine.dtype)
            self._comm.Allgather(mine, every)
            every.min(axis=0, out=found[at : at + some])
        return found.reshape(numbers.shape)

    def on_machine(self) -> int:
        """How many processes share the machine of this one."""
        name = node()
        return self.every(name).count(name)

    def any(self, value: bool) -> bool:
        """Whether it is so in any process."""
        mine, found = np.array([value], np.uint8), np.empty(self.size, np.uint8)
        self._comm.Allgather(mine, found)
        return bool(found.any())

    def send(self, block: Bytes, rank: int) -> None:
        """To one process, which receives as many bytes."""
        self._comm.Send(block, rank)

    def receive(self, into: Bytes, rank: int) -> None:
        """From one process, as many bytes as there is room for."""
        self._comm.Recv(into, rank)

    def dealt(self, each: Iterable[Any] | None) -> Any:
        """To each process what the first has for it, made one after the other. What is raised in
        making it is raised in all."""
        own: Any = None
        with self.agreeing():
            if each is None:
                own = self._comm.recv(source=0)
            else:
                rank = 0
                try:
                    for rank, value in enumerate(each):
                        if rank:
                            self._comm.send(value, rank)
                        else:
                            own = value
                except Exception:
                    for waiting in range(rank + 1, self.size):
                        self._comm.send(None, waiting)
                    raise
        return own

    def exchange(self, sent: dict[int, list[Bytes]], received: dict[int, list[Bytes]]) -> None:
        """Sends blocks to some ranks, and fills those that are to be received from them."""
        waiting = [self._comm.Irecv(b, rank) for rank, each in received.items() for b in each]
        waiting += [self._comm.Isend(b, rank) for rank, each in sent.items() for b in each]
        for request in waiting:
            request.Wait()

    @contextmanager
    def agreeing(self) -> Iterator[None]:
        """What is raised in the block, in any process, is raised in all of them at its end: the
        error of the lowest rank."""
        error: Exception | None = None
        try:
            yield
        except Exception as raised:
            error = raised
        self.raise_first(error)

    def raise_first(self, error: Exception | None) -> None:
        """Raises the error of the lowest rank that has one, in all processes."""
        if not self.any(error is not None):
            return
        errors = self.every(error and _carried(error))
        first = next(n for n, one in enumerate(errors) if one is not None)
        raised: Exception = error if first == self.rank and error else errors[first]
        raise raised

    def by_first(self, work: Callable[[], int]) -> int:
        """The others sleep meanwhile."""
        if not self.first:
            while not self._comm.iprobe(source=0):
                time.sleep(PAUSE_S)
            return int(self._comm.recv(source=0))
        status = FAILED
        try:
            status = work()
        except PbdkitError as error:
            status = error.exit_status
            raise
        finally:
            for rank in range(1, self.size):
                self._comm.send(status, rank)
        return status

    @contextmanager
    def speaking(self) -> Iterator[None]:
        """The first process alone says what ends the block. After what is no PbdkitError this one
        ends all processes when it ends: others would wait for it for ever."""
        try:
            yield
        except PbdkitError as error:
            error.told = not self.first
            raise
        except BaseException:
            atexit.register(self._comm.Abort, FAILED)
            raise


def _carried(error: Exception) -> Exception:
    """An error that can be sent: itself, or one that says the same."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return PbdkitError(str(error))
    return error
