"""Communicator of ranks that uses MPI."""

from __future__ import annotations

import atexit
import pickle
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Bytes
from pbdkit.communicator import Communicator
from pbdkit.errors import PbdkitError

NUMBERS_AT_ONCE = 2**20
"""Number of values, summed over all processes, that are compared at once."""
PAUSE_S = 0.05
"""Interval in seconds at which processes test for a message from the root."""
FAILED = 1
"""Exit status of a run that ends because one process failed."""


class MPICommunicator(Communicator):
    """Communicator of mpi4py.

    An exception in another process is raised in this process only by `raise_together`,
    `raise_first` and `scatter`.
    """

    def __init__(self, comm: Any) -> None:
        self._comm = comm
        self.rank, self.size = int(comm.rank), int(comm.size)

    def bcast(self, value: Any) -> Any:
        """Return the value of the root."""
        return self._comm.bcast(value)

    def allgather(self, value: Any) -> list[Any]:
        """Return the values of all processes, by rank."""
        return list(self._comm.allgather(value))

    def smallest(self, numbers: NDArray[Any]) -> NDArray[Any]:
        """Return the elementwise minimum over arrays of one shape."""
        flat = np.ascontiguousarray(numbers).ravel()
        minimum, size = np.empty_like(flat), max(1, NUMBERS_AT_ONCE // self.size)
        for at in range(0, len(flat), size):
            local = flat[at : at + size]
            every = np.empty((self.size, len(local)), local.dtype)
            self._comm.Allgather(local, every)
            every.min(axis=0, out=minimum[at : at + size])
        return minimum.reshape(numbers.shape)

    def any(self, value: Any) -> bool:
        """Return whether the value is true in any process."""
        local, values = np.array([bool(value)], np.uint8), np.empty(self.size, np.uint8)
        self._comm.Allgather(local, values)
        return bool(values.any())

    def send(self, block: Bytes, rank: int) -> None:
        """Send bytes to one process, which has to expect the same number of bytes."""
        self._comm.Send(block, rank)

    def receive(self, into: Bytes, rank: int) -> None:
        """Receive bytes from one process into an array."""
        self._comm.Recv(into, rank)

    def scatter(self, each: Iterable[Any] | None) -> Any:
        """Return the object that the root generates for this process. The root generates the
        objects of all processes one after the other; if this raises an exception, it is raised in
        all processes."""
        result: Any = None
        with self.raise_together():
            if each is None:
                result = self._comm.recv(source=0)
            else:
                rank = 0
                try:
                    for rank, value in enumerate(each):
                        if rank:
                            self._comm.send(value, rank)
                        else:
                            result = value
                except Exception:
                    for waiting in range(rank + 1, self.size):
                        self._comm.send(None, waiting)
                    raise
        return result

    def exchange(self, sent: dict[int, list[Bytes]], received: dict[int, list[Bytes]]) -> None:
        """Send the blocks `sent` to other ranks, and fill the blocks `received` with data from
        them."""
        waiting = [self._comm.Irecv(b, rank) for rank, each in received.items() for b in each]
        waiting += [self._comm.Isend(b, rank) for rank, each in sent.items() for b in each]
        for request in waiting:
            request.Wait()

    @contextmanager
    def raise_together(self) -> Iterator[None]:
        """Run the block. If an exception occurs in any process, it is raised in all processes at
        the end of the block. If exceptions occur in several processes, the exception of the lowest
        rank is raised."""
        error: Exception | None = None
        try:
            yield
        except Exception as raised:
            error = raised
        self.raise_first(error)

    def raise_first(self, error: Exception | None) -> None:
        """Raise, in all processes, the error of the lowest rank that has an error."""
        if not self.any(error is not None):
            return
        errors = self.allgather(error and _picklable(error))
        first = next(n for n, error_of_rank in enumerate(errors) if error_of_rank is not None)
        raised: Exception = error if first == self.rank and error else errors[first]
        raise raised

    def by_root(self, work: Callable[[], int]) -> int:
        """Return the result of work that only the root does. The other processes sleep until it is
        done."""
        if not self.is_root:
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
    def root_speaks(self) -> Iterator[None]:
        """Let only the root report an exception that ends the block. After an exception that is not
        a PbdkitError, the end of this process also ends all other processes, because they would
        otherwise wait for it."""
        try:
            yield
        except PbdkitError as error:
            error.is_reported = not self.is_root
            raise
        except BaseException:
            atexit.register(self._comm.Abort, FAILED)
            raise


def _picklable(error: Exception) -> Exception:
    """Return an error that can be sent to other processes: the same error if possible, otherwise an
    error with the same message."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return PbdkitError(str(error))
    return error
