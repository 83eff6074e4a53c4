"""Workers of this machine: a process each, and another in its place where one is killed."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import active_children, get_context, parent_process
from multiprocessing.process import BaseProcess
from types import ModuleType
from typing import Any

from pbdkit.errors import PbdkitError
from pbdkit.sweeps.crew import AHEAD, HEARTBEAT_S, Crew, Queue
from pbdkit.sweeps.member import Job
from pbdkit.sweeps.worker import Report, run_members

GRACE_S = 1.0
"""Seconds that members have to end once the sweep is stopped."""
MOST_STARTS = 10
"""So many workers that end before they have begun, with nothing reported between, are no chance."""
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)
"""What limits the threads of linear algebra where it is said before that is loaded. Kernels keep to
the one that each member asks for."""


class Processes(Crew):
    """So many workers, each a pool of one process, so that who is killed takes nobody along and
    what it was doing is known."""

    def __init__(self, workers: int) -> None:
        self._workers = workers

    def work(self, jobs: list[Job], stopping: Callable[[], bool]) -> Iterator[Report | None]:
        """Raises PbdkitError where workers cannot be started."""
        workers = [_Worker() for _ in range(min(self._workers, len(jobs)))]
        queue = Queue(deque(jobs), max(1, len(workers)))
        try:
            while queue.jobs or any(worker.chunks for worker in workers):
                if stopping():
                    wait([f for worker in workers for f in worker.chunks], GRACE_S)
                    queue.jobs.clear()
                for worker in workers:
                    while queue.jobs and len(worker.chunks) < AHEAD and worker.take(queue):
                        pass
                if not _any_done(workers):
                    yield None
                for worker in workers:
                    yield from worker.reports(queue)
                if stopping():
                    return
        finally:
            for worker in workers:
                worker.end()


def _any_done(workers: list[_Worker]) -> bool:
    """Whether any chunk is done now, or soon."""
    futures = [future for worker in workers for future in worker.chunks]
    return bool(wait(futures, HEARTBEAT_S, FIRST_COMPLETED).done)


class _Worker:
    """One process at a time, and the chunks that it has, the one that it is at first."""

    def __init__(self) -> None:
        self.chunks: dict[Future[list[Report]], list[Job]] = {}
        self._pool: ProcessPoolExecutor | None = None
        self._processes: set[BaseProcess] = set()

    def take(self, queue: Queue) -> bool:
        """Whether it could take the next chunk: not where it was killed and has still to say so."""
        chunk = queue.chunk()
        for _ in range(1 + (not self.chunks)):
            try:
                with _spawning():
                    self.chunks[self._current().submit(run_members, chunk)] = chunk
                return True
            except BrokenProcessPool:  # with nothing to do, another takes its place at once
                if not self.chunks:
                    self._renew()
        queue.jobs.extendleft(reversed(chunk))
        return False

    def reports(self, queue: Queue) -> Iterator[Report]:
        """Of the chunks that are done. Where the process was killed the first is what it was at."""
        for future in [future for future in self.chunks if future.done()]:
            chunk = self.chunks.pop(future, None)
            if chunk is None:
                return
            try:
                reports = future.result()
            except BrokenProcessPool:
                yield from self._killed(chunk, queue)
                return
            queue.false_starts = 0
            yield from queue.reported(reports)

    def end(self) -> None:
        """Ends the process, whatever it is at, begun or not."""
        if self._pool is not None:
            for process in self._processes:
                process.kill()
            self._pool.shutdown(cancel_futures=True)
            self._pool = None

    def _killed(self, chunk: list[Job], queue: Queue) -> Iterator[Report]:
        waiting = [job for jobs in self.chunks.values() for job in jobs]
        self.chunks.clear()
        queue.jobs.extendleft(reversed(waiting))
        begun = not self._begun.exception()
        self._renew()
        if begun:
            yield from queue.lost(chunk, "its process was killed, as where memory runs out,")
            return
        queue.jobs.extendleft(reversed(chunk))
        queue.false_starts += 1
        if queue.false_starts >= MOST_STARTS:
            raise PbdkitError(
                f"{MOST_STARTS} worker processes ended while they were starting; --workers 1 runs "
                "the members in this process, and shows why"
            )

    def _renew(self) -> None:
        assert self._pool is not None
        self._pool.shutdown()
        self._pool = None

    def _current(self) -> ProcessPoolExecutor:
        if self._pool is None:
            others = {*active_children()}
            self._pool = ProcessPoolExecutor(1, get_context("spawn"), _begin)
            self._begun = self._pool.submit(os.getpid)
            self._processes = {*active_children()} - others
        return self._pool


def _begin() -> None:
    """In a worker: Ctrl-C is for the sweep, and with the sweep's process its workers end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    assert parent is not None
    threading.Thread(target=_end_after, args=(parent,), daemon=True).start()


def _end_after(parent: Any) -> None:
    parent.join()
    os._exit(1)


@contextmanager
def _spawning() -> Iterator[None]:
    """What a process that is started in the block finds: one thread of linear algebra, Ctrl-C
    blocked until it is ignored, and no script of the caller, which would run once more."""
    blocks: Any = getattr(signal, "pthread_sigmask", None)
    mask = blocks(signal.SIG_BLOCK, {signal.SIGINT}) if blocks else None
    main, before = sys.modules["__main__"], {name: os.environ.get(name) for name in ONE_THREAD}
    sys.modules["__main__"] = ModuleType("__main__")
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        sys.modules["__main__"] = main
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        if blocks:
            blocks(signal.SIG_SETMASK, mask)
