"""Execute the members of a sweep that have no stored result.

They are run in this process, in worker processes or on a dask cluster. A worker process that is
killed is replaced.
"""

from __future__ import annotations

import json
import math
import os
import signal
import sys
import tempfile
import time
from abc import ABC, abstractmethod
from asyncio import CancelledError
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from multiprocessing import active_children, get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
import xxhash

from pbdkit.errors import (
    ExperimentError,
    PbdkitError,
    StorageError,
    StorageWarning,
    SweepWarning,
    did_you_mean,
    warn_caller,
)
from pbdkit.hooks import pbdkit_version
from pbdkit.io.layout import CONVENTIONS, SCHEMA_VERSION, Column, diagnostics_that_provide
from pbdkit.io.open import open as open_result
from pbdkit.io.recorder import Recorder
from pbdkit.io.save import write_dataset
from pbdkit.io.sinks import MemorySink
from pbdkit.memory import machine_memory
from pbdkit.model.experiment import Experiment, given_classes
from pbdkit.model.reading import OF_PROGRAM, Source
from pbdkit.plugin import Component
from pbdkit.plugin.registry import GIVEN
from pbdkit.progress import progress_bar
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.engine_choice import processors
from pbdkit.sweeps.combine import combine_members
from pbdkit.sweeps.specification import Dimension, Job, Keep, Member, SweepPlan, checked, named
from pbdkit.sweeps.store import Store
from pbdkit.sweeps.worker import (
    INTERRUPTED,
    LOST,
    SEPARATED,
    STORED_STATUSES,
    MemberReport,
    begin_worker,
    chosen_columns,
    report_of,
    run_member,
    run_members,
)

if TYPE_CHECKING:
    import xarray


CHUNK_S = 0.25
"""Duration of a chunk of members in seconds."""
MAX_AT_ONCE = 16
"""Maximum number of members in a chunk.

A chunk must fit into the pipe to a worker, so that sending it to a killed worker does not block.
"""
HEARTBEAT_S = 0.2
"""Maximum time in seconds between two checks of the progress of workers."""
MAX_LOSSES = 3
"""Number of losses after which a member has failed.

A member is lost if the process that runs it is killed. Only losses of processes that ran no other
member are counted.
"""
CHUNKS_PER_WORKER = 2
"""Number of chunks that a worker has at a time, so that it need not wait for the next one."""
WAIT_FOR_WORKERS_S = 30.0
"""Maximum time in seconds to wait for the first worker of a cluster."""


class Executor(ABC):
    """Run members in any order."""

    @abstractmethod
    def work(self, jobs: list[Job], stopping: Callable[[], bool]) -> Iterator[MemberReport | None]:
        """Yield a report for each job, and None at intervals while there is no report.

        After `stopping` has returned true, no further job is started. When the iterator is closed,
        the workers are ended.
        """


@dataclass
class Queue:
    """Queue of members, with the duration of members and the number of losses of each."""

    jobs: deque[Job]
    workers: int
    false_starts: int = 0
    _seconds: float = 0.0
    _count: int = 0
    _losses: dict[str, int] = field(default_factory=dict)

    def chunk(self) -> list[Job]:
        """Return the next members for one worker.

        A chunk contains only one member if no duration has been measured yet, or if the member was
        lost before.
        """
        if not self._count or self.jobs[0].key in self._losses:
            return [self.jobs.popleft()]
        size = int(CHUNK_S * self._count / max(self._seconds, 1e-9))
        size = min(size, MAX_AT_ONCE, len(self.jobs) // (2 * self.workers))
        chunk = [self.jobs.popleft()]
        while len(chunk) < size and self.jobs and self.jobs[0].key not in self._losses:
            chunk.append(self.jobs.popleft())
        return chunk

    def reported(self, reports: list[MemberReport]) -> Iterator[MemberReport]:
        """Count the reports, and return them."""
        for report in reports:
            self._seconds, self._count = self._seconds + report.seconds, self._count + 1
            yield report

    def lost(self, chunk: list[Job], reason: str) -> Iterator[MemberReport]:
        """Put the members of a lost worker back into the queue.

        A member that was lost too often while it was the only one in a chunk has failed.
        """
        retries = []
        for job in chunk:
            losses = self._losses.get(job.key, 0) + (len(chunk) == 1)
            self._losses[job.key] = losses
            if losses >= MAX_LOSSES:
                text = f"{reason} {losses} times while it ran; it runs again with the next call"
                yield report_of(job.key, LOST, text, lasting=False)
            else:
                retries.append(job)
        self.jobs.extendleft(reversed(retries))


class SerialExecutor(Executor):
    """Run members in this process. Component classes can be passed as Python objects."""

    def __init__(self, components: tuple[type[Component], ...] = ()) -> None:
        self._components = components

    def work(self, jobs: list[Job], stopping: Callable[[], bool]) -> Iterator[MemberReport | None]:
        """Run one member after the other."""
        for job in jobs:
            if stopping():
                return
            yield run_member(job, self._components, stopping)


class ClusterExecutor(Executor):
    """Run members on the workers of a dask cluster.

    Any client of a cluster can execute arbitrary code on it.
    """

    def __init__(self, client: Any) -> None:
        self._client = client

    def work(self, jobs: list[Job], stopping: Callable[[], bool]) -> Iterator[MemberReport | None]:
        """Run chunks as tasks.

        The number of tasks at a time is slightly larger than that of threads.

        If the work ends early, pending tasks are cancelled. ExperimentError is raised if the
        cluster has no worker, and StorageError if the scheduler is lost.
        """
        out: dict[Any, list[Job]] = {}
        try:
            yield from self._with_workers(stopping)
            yield from self._distributed(jobs, out, stopping)
        except (Exception, CancelledError) as error:
            if self._is_there():
                raise
            raise StorageError(
                f"--dask: the scheduler is lost ({type(error).__name__}); finished members are "
                "stored, and the same command runs the remaining ones"
            ) from None
        finally:
            if self._is_there():
                self._client.cancel(list(out))

    def _is_there(self) -> bool:
        """Return whether the scheduler is connected."""
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

    def _distributed(
        self, jobs: list[Job], out: dict[Any, list[Job]], stopping: Callable[[], bool]
    ) -> Iterator[MemberReport | None]:
        from distributed import wait as wait_for

        wait: Any = wait_for
        queue = Queue(deque(jobs), 1)
        while (out or queue.jobs) and not stopping():
            queue.workers = max(1, sum(self._client.nthreads().values()))
            while queue.jobs and len(out) < CHUNKS_PER_WORKER * queue.workers and not stopping():
                chunk = queue.chunk()
                out[self._client.submit(run_members, chunk, pure=False)] = chunk
            try:
                wait(list(out), timeout=HEARTBEAT_S, return_when="FIRST_COMPLETED")
            except TimeoutError:
                yield None
            for future in [future for future in out if future.done()]:
                yield from _reports(future, out.pop(future), queue)


def _reports(future: Any, chunk: list[Job], queue: Queue) -> Iterator[MemberReport]:
    """Return the reports of a task that has ended."""
    try:
        reports = future.result()
    except Exception as error:  # A worker was lost, or cannot import pbdkit.
        yield from queue.lost(chunk, f"{type(error).__name__}: {error}:")
    else:
        yield from queue.reported(reports)


SHAPING = ("lattice", "body", "neighbours", "frame", "fracture", "diagnostics", "units")
"""Parts of an experiment that determine the shape of its dataset, apart from the recorded steps."""
SHARE = 0.5
"""Fraction of the memory of this machine that the dataset of a sweep may occupy."""
TEXT = 8
"""Approximate size of a text in bytes."""


class SizeEstimate:
    """Estimate of the size of the dataset, from the experiments of all members.

    For each distinct body one scene is built.
    """

    def __init__(self, keep: Keep, count: int) -> None:
        self._keep, self._count = keep, count
        self._seen: set[bytes] = set()
        self._columns: dict[str, Column] = {}
        self._sizes: dict[str, int] = {}
        self._times: set[tuple[int, tuple[int, ...] | None, int, int]] = set()

    def look(self, experiment: Experiment, words: str) -> None:
        """Include a member in the estimate; `words` describe it in messages.

        ExperimentError or PluginError is raised if the scene of the member cannot be built, or if
        its dataset would lack a variable that the sweep selects.
        """
        steps, record = experiment.steps, experiment.record
        between = experiment.record_count - record.count(steps)
        self._times.add((steps, record.at, record.every, between))
        data = experiment.model_dump(mode="json", by_alias=True)
        shape = xxhash.xxh3_128_digest(json.dumps([data.get(part) for part in SHAPING]).encode())
        if shape in self._seen:
            return
        self._seen.add(shape)
        plan = MemorySink()
        with named(words):
            Recorder(build_scene(experiment), plan).begin()
        columns = {column.name: column for column in plan.columns}
        for name in self._keep.variables or ():
            if name not in columns:
                hint = did_you_mean(name, columns)
                if makers := diagnostics_that_provide({name}):
                    hint = f"; add {' or '.join(makers)} to `diagnostics` of the experiment"
                what = f"there is no variable '{name}'{hint} (known: {', '.join(columns)})"
                raise ExperimentError(what, ("keep", "variables"))
        self._columns |= columns
        for dim, size in plan.sizes.items():
            self._sizes[dim] = max(size, self._sizes.get(dim, 0))
        self._sizes["step"] = max(steps + 1, self._sizes.get("step", 0))

    def refuse_too_large(self) -> None:
        """Raise ExperimentError if the dataset does not fit into memory.

        It is also raised if no member reaches a step that the sweep selects.
        """
        keep, last = self._keep, max(steps for steps, *_ in self._times)
        if isinstance(keep.times, tuple) and min(keep.times) > last:
            text = f"{min(keep.times)} exceeds the last step of all members, {last}"
            raise ExperimentError(text, ("keep", "times"))
        sizes = self._sizes | {"time": self._number_of_times()}
        names = None if keep.variables is None else {*keep.variables}
        columns = chosen_columns(self._columns.values(), names)
        each = sum(math.prod(sizes.get(d, 1) for d in c.dims) * _bytes(c) for c in columns)
        if each * self._count > (limit := int(SHARE * machine_memory())):
            raise ExperimentError(
                f"the dataset of {self._count} members takes {each * self._count / 2**30:.3g} GiB, "
                f"more than the {limit / 2**30:.3g} GiB allowed on this machine; keep fewer "
                "variables, keep `times: last`, or vary fewer values",
                ("keep",),
            )

    def _number_of_times(self) -> int:
        """Estimate the length of the joined dimension before the members run."""
        times = self._keep.times
        if times == "last":
            return len({steps for steps, *_ in self._times})
        if isinstance(times, tuple):
            return len(set(times))
        return max(
            between + (steps // every + 2 if at is None else len({0, steps, *at}))
            for steps, at, every, between in self._times
        )


def _bytes(column: Column) -> int:
    return TEXT if column.dtype == "str" else np.dtype(column.dtype).itemsize


RESULT = "sweep.nc"
"""File name of the dataset of a sweep."""
Show = Callable[[str, float], None]


@dataclass(frozen=True)
class Summary:
    """Outcome of a sweep.

    - `members` are all members.
    - `ends` contains, by key, the status and the message of each member that has ended.
    - `run` is the number of members that were run.
    - `faults` are messages about damage.
    - `path` is the path of the dataset; None if the sweep was stopped.
    """

    members: list[Member]
    ends: dict[str, tuple[str, str]]
    run: int
    faults: list[str]
    path: Path | None

    @property
    def separated(self) -> list[Member]:
        """The members with values of which the body came apart before the last step."""
        return [m for m in self.members if self.ends.get(m.job.key, ("",))[0] == SEPARATED]

    @property
    def failures(self) -> list[tuple[Member, str, str]]:
        """The members that ended without values, with status and message."""
        ended = [member for member in self.members if member.job.key in self.ends]
        every = [(member, *self.ends[member.job.key]) for member in ended]
        return [entry for entry in every if entry[1] not in STORED_STATUSES]


def carry_out(
    plan: SweepPlan, folder: Path, executor: Executor, stopping: Callable[[], bool], show: Show
) -> Summary:
    """Validate all members, run those without a result in the folder, and write the dataset.

    `stopping` is called continually. After it has returned True, no further member is run; results
    of completed members remain in the folder, and no dataset is written. ExperimentError and
    PluginError are raised before the first member runs. StorageError can be raised at any time.
    """

    def show_unless_stopped(what: str, share: float) -> None:
        if stopping():
            raise _StoppedError
        show(what, share)

    try:
        grid, members, versions = validated(plan, show_unless_stopped)
    except _StoppedError:
        return Summary([], {}, 0, [], None)
    jobs = {member.job.key: member.job for member in members}
    with Store(folder) as store:
        ends = store.held()
        todo = [job for key, job in jobs.items() if key not in ends]
        passing: dict[str, MemberReport] = {}
        run = 0
        for report in _reported(executor.work(todo, stopping), len(jobs), len(todo), show):
            store.commit_if_due()
            if report is None:
                continue
            if report.lasting:
                store.put(report)
            else:
                passing[report.key] = report
            ends[report.key], run = (report.status, report.message), run + 1
        store.commit()
        store.check_existence()
        if run < len(todo):
            return Summary(members, ends, run, store.faults, None)
        dataset = combine_members(grid, members, lambda key: passing.get(key) or store.report(key))
        dataset.attrs = _attributes(plan, versions)
        write_dataset(dataset, folder / RESULT, replace=True)
    return Summary(members, ends, run, store.faults, folder / RESULT)


class _StoppedError(Exception):
    """The sweep was stopped while its members were validated."""


def _reported(
    reports: Iterator[MemberReport | None], members: int, todo: int, show: Show
) -> Iterator[MemberReport | None]:
    """Yield the reports of members except for interrupted ones, and show the progress."""
    run = failed = 0
    for report in reports:
        if report is not None and report.status == INTERRUPTED:
            continue
        run, failed = (
            run + bool(report),
            failed + bool(report and report.status not in STORED_STATUSES),
        )
        progress = f"{members - todo + run} of {members} members"
        show(progress + (f", {failed} failed" if failed else ""), run / todo)
        yield report


def validated(plan: SweepPlan, show: Show) -> tuple[list[Dimension], list[Member], dict[str, str]]:
    """Validate all members.

    Returns
    -------
    grid, members, versions
        Dimensions, members, and versions of pbdkit and plugins.

    Raises
    ------
    ExperimentError, PluginError
        If a member is invalid. The message contains the parameters of the member.
    """
    base = plan.experiment()
    grid, outlook = plan.grid(base), SizeEstimate(plan.sweep.keep, plan.sweep.count)
    members: list[Member] = []
    versions: dict[str, str] = {}
    try:
        for member, experiment in plan.members(grid, lambda share: show("validating", share)):
            outlook.look(experiment, member.words)
            members.append(member)
            versions |= member.job.versions
        outlook.refuse_too_large()
    except ExperimentError as error:
        name, text = plan.source.name, str(error)
        if error.where[:1] == ("keep",):
            text = plan.source.message(error.where, text)
        elif name:
            text = f"{name}: {text}"
        raise ExperimentError(text, error.where) from None
    return grid, members, versions


def _attributes(plan: SweepPlan, versions: dict[str, str]) -> dict[str, str]:
    experiment = plan.experiment()
    sweep = plan.sweep.model_dump(mode="json", by_alias=True)
    sweep["experiment"] = experiment.model_dump(mode="json", by_alias=True)
    return {
        "Conventions": CONVENTIONS,
        "schema_version": SCHEMA_VERSION,
        "title": f"sweep of {experiment.name}",
        "pbdkit_version": pbdkit_version(),
        "sweep": json.dumps(sweep),
        "plugins": json.dumps({k: v for k, v in versions.items() if k != GIVEN}),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }


GRACE_S = 1.0
"""Time in seconds in which running members can end after the sweep has been stopped."""
MAX_STARTS = 10
"""Maximum number of successive workers that end while they start."""
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)
"""Environment variables that limit libraries of linear algebra to one thread.

They must be set before the libraries are loaded. The threads of kernels are limited by the settings
of each member.
"""


class ProcessExecutor(Executor):
    """Run members in worker processes.

    Each process has its own pool, so that a killed process does not affect the others.
    """

    def __init__(self, workers: int) -> None:
        self._workers = workers

    def work(self, jobs: list[Job], stopping: Callable[[], bool]) -> Iterator[MemberReport | None]:
        """Raises PbdkitError if workers cannot be started."""
        workers = [_Worker() for _ in range(min(self._workers, len(jobs)))]
        queue = Queue(deque(jobs), max(1, len(workers)))
        try:
            while queue.jobs or any(worker.chunks for worker in workers):
                if stopping():
                    wait([f for worker in workers for f in worker.chunks], GRACE_S)
                    queue.jobs.clear()
                for worker in workers:
                    while (
                        queue.jobs and len(worker.chunks) < CHUNKS_PER_WORKER and worker.take(queue)
                    ):
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
    """Return whether a chunk is done, now or after a short waiting time."""
    futures = [future for worker in workers for future in worker.chunks]
    return bool(wait(futures, HEARTBEAT_S, FIRST_COMPLETED).done)


class _Worker:
    """One worker process and its chunks, of which the first one is running."""

    def __init__(self) -> None:
        self.chunks: dict[Future[list[MemberReport]], list[Job]] = {}
        self._pool: ProcessPoolExecutor | None = None
        self._processes: set[BaseProcess] = set()

    def take(self, queue: Queue) -> bool:
        """Give the next chunk to the worker, and return whether it was possible.

        A killed worker receives no chunk until its end has been reported.
        """
        chunk = queue.chunk()
        for _ in range(1 + (not self.chunks)):
            try:
                with _spawning():
                    self.chunks[self._current().submit(run_members, chunk)] = chunk
                return True
            except BrokenProcessPool:  # A worker without chunks is replaced at once.
                if not self.chunks:
                    self._renew()
        queue.jobs.extendleft(reversed(chunk))
        return False

    def reports(self, queue: Queue) -> Iterator[MemberReport]:
        """Return the reports of finished chunks.

        If the process was killed, the first unfinished chunk was running at that time, and its
        members are lost.
        """
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
        """End the process, whatever its state."""
        if self._pool is not None:
            for process in self._processes:
                process.kill()
            self._pool.shutdown(cancel_futures=True)
            self._pool = None

    def _killed(self, chunk: list[Job], queue: Queue) -> Iterator[MemberReport]:
        waiting = [job for jobs in self.chunks.values() for job in jobs]
        self.chunks.clear()
        queue.jobs.extendleft(reversed(waiting))
        has_started = not self._begun.exception()
        self._renew()
        if has_started:
            yield from queue.lost(chunk, "its process was killed, possibly for lack of memory,")
            return
        queue.jobs.extendleft(reversed(chunk))
        queue.false_starts += 1
        if queue.false_starts >= MAX_STARTS:
            raise PbdkitError(
                f"{MAX_STARTS} worker processes ended while they were starting; --workers 1 runs "
                "the members in this process and shows the error"
            )

    def _renew(self) -> None:
        assert self._pool is not None
        self._pool.shutdown()
        self._pool = None

    def _current(self) -> ProcessPoolExecutor:
        if self._pool is None:
            earlier = {*active_children()}
            self._pool = ProcessPoolExecutor(1, get_context("spawn"), begin_worker)
            self._begun = self._pool.submit(os.getpid)
            self._processes = {*active_children()} - earlier
        return self._pool


@contextmanager
def _spawning() -> Iterator[None]:
    """Set up the environment of processes that are started in the block.

    They use one thread for linear algebra and do not run the script of the caller again. Ctrl-C is
    blocked until they ignore it.
    """
    blocks: Any = getattr(signal, "pthread_sigmask", None)
    mask = blocks(signal.SIG_BLOCK, {signal.SIGINT}) if blocks else None
    main, environment = sys.modules["__main__"], {name: os.environ.get(name) for name in ONE_THREAD}
    sys.modules["__main__"] = ModuleType("__main__")
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        sys.modules["__main__"] = main
        for name, value in environment.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        if blocks:
            blocks(signal.SIG_SETMASK, mask)


def called(
    experiment: Experiment,
    parts: dict[str, Any],
    folder: str | Path | None,
    workers: int | None,
    client: Any,
    progress: bool,
) -> xarray.Dataset:
    """Return the dataset of a sweep. It is loaded into memory unless a folder contains it."""
    base = replace(experiment.as_written(), name="")
    if base.files.folder is None:
        base.files = OF_PROGRAM
    classes = given_classes(experiment)
    if classes and folder is not None:
        raise ExperimentError(
            "folder: stored members are identified by the versions of their components, which "
            "classes from Python do not have; omit it, or put the classes into a plugin "
            "(`pbdkit plugins new`)"
        )
    executor = executor_of(workers, client, classes)
    sweep = checked(parts | {"experiment": base.data}, Source())
    plan = SweepPlan(sweep, base, Source(), classes)
    with ExitStack() as ending:
        path = Path(folder or ending.enter_context(tempfile.TemporaryDirectory(prefix="pbdkit-")))
        with progress_bar(progress) as show:
            summary = carry_out(plan, path, executor, lambda: False, show)
        for text in summary.faults:
            warn_caller(text, StorageWarning)
        if failures := summary.failures:
            member, status, message = failures[0]
            text = (
                f"{len(failures)} of {len(summary.members)} members have no values; the first "
                f"is {status}"
            )
            warn_caller(f"{text}: {member.words}: {message}", SweepWarning)
        if separated := summary.separated:
            text = f"{len(separated)} of {len(summary.members)} members are separated"
            message = summary.ends[separated[0].job.key][1]
            warn_caller(f"{text}; the first is {separated[0].words}: {message}", SweepWarning)
        assert summary.path is not None  # The sweep can be stopped by an exception only.
        dataset = open_result(summary.path)
        if folder is None:
            with dataset:
                return dataset.load()
        return dataset


def executor_of(
    workers: int | None, client: Any, components: tuple[type[Component], ...] = ()
) -> Executor:
    """Return the executor of a sweep; raise ExperimentError if it is not available."""
    if workers is not None and (type(workers) is not int or workers < 1):
        raise ExperimentError(f"workers: expected a number from 1, got {workers!r}")
    if client is not None and workers is not None:
        raise ExperimentError("give either workers of this machine or a cluster, not both")
    if components and (client is not None or (workers or 1) > 1):
        raise ExperimentError(
            "classes from Python exist in this process only; omit workers and client, or put the "
            "classes into a plugin (`pbdkit plugins new`)"
        )
    if client is not None:
        return ClusterExecutor(client)
    number = workers or (1 if components else processors())
    return SerialExecutor(components) if number == 1 else ProcessExecutor(number)
