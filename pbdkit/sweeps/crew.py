"""Who runs the members of a sweep: this process, others on this machine, or a dask cluster."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from asyncio import CancelledError
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from pbdkit.errors import ExperimentError, StorageError
from pbdkit.interfaces import Component
from pbdkit.sweeps.member import Job
from pbdkit.sweeps.worker import LOST, Report, report_of, run_member, run_members

HANDED_OUT_S = 0.25
"""Members are handed out in chunks that take about so long."""
MOST_AT_ONCE = 16
"""So many at most, so that no chunk fills the pipe to a worker that was killed."""
HEARTBEAT_S = 0.2
MOST_LOSSES = 3
"""So often a member may be lost with the process that ran it, and it alone; then it has failed."""
AHEAD = 2
"""Chunks that a worker has at a time, so that it need not wait for the next."""
WAIT_FOR_WORKERS_S = 30.0


class Crew(ABC):
    """Runs members in whatever order."""

    @abstractmethod
    def work(self, jobs: list[Job], stopping: Callable[[], bool]) -> Iterator[Report | None]:
        """A report for each job, and None every now and then while there is none. Once `stopping`
        says so nothing more is begun. Whoever closes the iterator ends the workers, too."""


@dataclass
class Queue:
    """What is still to be handed out, how long members take, and how often each was lost."""

    jobs: deque[Job]
    workers: int
    false_starts: int = 0
    _seconds: float = 0.0
    _count: int = 0
    _losses: dict[str, int] = field(default_factory=dict)

    def chunk(self) -> list[Job]:
        """The next members for one worker: one as long as nothing is known, and one alone that was
        lost before."""
        if not self._count or self.jobs[0].key in self._losses:
            return [self.jobs.popleft()]
        size = int(HANDED_OUT_S * self._count / max(self._seconds, 1e-9))
        size = min(size, MOST_AT_ONCE, len(self.jobs) // (2 * self.workers))
        found = [self.jobs.popleft()]
        while len(found) < size and self.jobs and self.jobs[0].key not in self._losses:
            found.append(self.jobs.popleft())
        return found

    def reported(self, reports: list[Report]) -> Iterator[Report]:
        """The reports."""
        for report in reports:
            self._seconds, self._count = self._seconds + report.seconds, self._count + 1
            yield report

    def lost(self, chunk: list[Job], reason: str) -> Iterator[Report]:
        """Takes members back whose worker came to an end; one that was alone too often is given
        up."""
        again = []
        for job in chunk:
            losses = self._losses.get(job.key, 0) + (len(chunk) == 1)
            self._losses[job.key] = losses
            if losses >= MOST_LOSSES:
                text = f"{reason} {losses} times while it ran; it runs again with the next call"
                yield report_of(job.key, LOST, text, lasting=False)
            else:
                again.append(job)
        self.jobs.extendleft(reversed(again))


class Alone(Crew):
    """This process, with classes from Python where there are any."""

    def __init__(self, components: tuple[type[Component], ...] = ()) -> None:
        self._components = components

    def work(self, jobs: list[Job], stopping: Callable[[], bool]) -> Iterator[Report | None]:
        """One after the other."""
        for job in jobs:
            if stopping():
                return
            yield run_member(job, self._components, stopping)


class Cluster(Crew):
    """The workers of a dask cluster. Who can reach it can run code on it."""

    def __init__(self, client: Any) -> None:
        self._client = client

    def work(self, jobs: list[Job], stopping: Callable[[], bool]) -> Iterator[Report | None]:
        """Chunks as tasks, a few more than there are threads; those still out are cancelled where
        the work ends early. Raises ExperimentError where no worker is there, and StorageError where
        the scheduler is lost."""
        out: dict[Any, list[Job]] = {}
        try:
            yield from self._with_workers(stopping)
            yield from self._handed_out(jobs, out, stopping)
        except (Exception, CancelledError) as error:
            if self._is_there():
                raise
            raise StorageError(
                f"--dask: the scheduler is lost ({type(error).__name__}); what was finished is "
                "held, and the same command goes on with the others"
            ) from None
        finally:
            if self._is_there():
                self._client.cancel(list(out))

    def _is_there(self) -> bool:
        """Whether the scheduler is connected."""
        return bool(self._client.status == "running")

    def _with_workers(self, stopping: Callable[[], bool]) -> Iterator[None]:
        """Wait for the first worker."""
        end = time.monotonic() + WAIT_FOR_WORKERS_S
        while not self._client.nthreads():
            if time.monotonic() > end:
                what = f"the cluster has had no worker for {WAIT_FOR_WORKERS_S:g} s"
                raise ExperimentError(f"--dask: {what}")
            if stopping():
                return
            time.sleep(HEARTBEAT_S)
            yield None

    def _handed_out(
        self, jobs: list[Job], out: dict[Any, list[Job]], stopping: Callable[[], bool]
    ) -> Iterator[Report | None]:
        from distributed import wait as wait_for

        wait: Any = wait_for
        queue = Queue(deque(jobs), 1)
        while (out or queue.jobs) and not stopping():
            queue.workers = max(1, sum(self._client.nthreads().values()))
            while queue.jobs and len(out) < AHEAD * queue.workers and not stopping():
                chunk = queue.chunk()
                out[self._client.submit(run_members, chunk, pure=False)] = chunk
            try:
                wait(list(out), timeout=HEARTBEAT_S, return_when="FIRST_COMPLETED")
            except TimeoutError:
                yield None
            for future in [future for future in out if future.done()]:
                yield from _reports(future, out.pop(future), queue)


def _reports(future: Any, chunk: list[Job], queue: Queue) -> Iterator[Report]:
    """Of a task that has ended, well or not."""
    try:
        reports = future.result()
    except Exception as error:  # a worker was lost, or cannot import pbdkit
        yield from queue.lost(chunk, f"{type(error).__name__}: {error}:")
    else:
        yield from queue.reported(reports)
