"""Run one member of a sweep, and return a report.

An exception is returned as a report too. The results of a member are bytes: names and shapes of the
variables as JSON, followed by the values.
"""

from __future__ import annotations

import json
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterable
from multiprocessing import parent_process
from typing import Any, NamedTuple

import numpy as np
import xxhash
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pbdkit.errors import ExperimentError, PbdkitError, PluginError
from pbdkit.hooks import pbdkit_version, worded
from pbdkit.io.atomic_file import WHOLE
from pbdkit.io.layout import Column, Values, When
from pbdkit.io.physical import TWIN_OF
from pbdkit.io.sinks import MemorySink
from pbdkit.model.experiment import Experiment
from pbdkit.model.reading import Source
from pbdkit.plugin import Component
from pbdkit.progress import Watch
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import Simulation, record
from pbdkit.sweeps.specification import Job

LENGTH = 8
"""Number of bytes of the length of the JSON header."""


class MemberVariable(NamedTuple):
    """One variable of a run; `fixed` is true if it has its values before the first step."""

    dims: tuple[str, ...]
    values: NDArray[Any]
    attributes: dict[str, Any]
    coordinate: bool
    fixed: bool


def packed(variables: dict[str, MemberVariable]) -> bytes:
    """Serialise variables as bytes."""
    head, parts = {}, []
    for name, (dims, values, attributes, *marks) in variables.items():
        entries = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in attributes.items()}
        head[name] = [dims, values.dtype.str, values.shape, entries, *marks]
        parts.append(np.ascontiguousarray(values).tobytes())
    header = json.dumps(head).encode()
    return b"".join([len(header).to_bytes(LENGTH, "little"), header, *parts])


def unpacked(content: bytes) -> dict[str, MemberVariable]:
    """Deserialise variables. Their values are views of the bytes."""
    begin = LENGTH + int.from_bytes(content[:LENGTH], "little")
    variables = {}
    for name, entry in json.loads(content[LENGTH:begin]).items():
        dims, dtype, shape, attributes, coordinate, fixed = entry
        count, kind = int(np.prod(shape, dtype=np.int64)), np.dtype(dtype)
        values = np.frombuffer(content, kind, count, begin) if count else np.zeros(0, kind)
        begin += count * kind.itemsize
        flags = {k: np.array(v, kind) if isinstance(v, list) else v for k, v in attributes.items()}
        variables[name] = MemberVariable(
            tuple(dims), values.reshape(shape), flags, coordinate, fixed
        )
    return variables


SEPARATED = "separated"
"""Status of members with a body that came apart."""
STORED_STATUSES = (*WHOLE, SEPARATED)
"""Status of members with values in the dataset.

A run with the status "separated" ended because its body separated into parts in the equilibrium
solver. It has the values that were recorded before.
"""
FAILED = "failed"
"""Status of members that cannot be run."""
INTERRUPTED = "interrupted"
"""Status of members that were interrupted."""
LOST = "lost"
"""Status of members that were lost with their process."""
AGAIN = "the same command runs this member again"
"""Remedy for a failure that need not be repeated."""
_one_at_a_time = threading.Lock()
"""Lock by which only one thread of a process, for example of a dask worker, runs a member.

The reason is that warnings and the number of threads of linear algebra are global.
"""


class MemberReport(NamedTuple):
    """Result of a member.

    `message` is the reason of a failure, or contains the warnings of the run. `digest` is computed
    from all other fields. `lasting` is False if a second attempt could have a different result.
    """

    key: str
    status: str
    message: str
    content: bytes
    digest: bytes
    lasting: bool = True
    seconds: float = 0.0


def report_of(
    key: str, status: str, message: str, content: bytes = b"", lasting: bool = True, **options: Any
) -> MemberReport:
    """Return a report with its digest."""
    whole = digest_of(key, status, message, content)
    return MemberReport(key, status, message, content, whole, lasting, **options)


def digest_of(key: str, status: str, message: str, content: bytes) -> bytes:
    """Return the digest of a report."""
    digest = xxhash.xxh3_128(json.dumps([key, status, message]).encode())
    digest.update(content)
    return digest.digest()


class SelectiveSink(MemorySink):
    """Sink that stores selected variables of a run.

    They are stored at all recorded steps, at the last one, or at selected steps.
    """

    def __init__(self, variables: Iterable[str] | None, times: str | tuple[int, ...]) -> None:
        self._variables = None if variables is None else set(variables)
        self._times = times

    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """Select the columns to be stored, and store the coordinates of their dimensions."""
        super().begin(selected_columns(columns, self._variables), sizes, planned)

    def put(self, values: Values) -> None:
        """Store the values of the selected columns at a recorded step."""
        super().put({name: value for name, value in values.items() if name in self._entries})

    def content(self) -> bytes:
        """Return the variables as bytes."""
        return packed({column.name: self._variable(column) for column in self.columns})

    def _variable(self, column: Column) -> MemberVariable:
        rows, steps = None, self._entries.get("time", [])
        if column.grows and column.dims[0] == "time" and self._times != "all":
            wanted = steps[-1:] if self._times == "last" else self._times
            rows = [row for row, step in enumerate(steps) if step in wanted]
        values, fixed = self.values(column, rows), column.when is When.START
        return MemberVariable(column.dims, values, column.attributes, column.coordinate, fixed)


def chosen_columns(columns: Iterable[Column], variables: set[str] | None) -> list[Column]:
    """Return the columns of the given variables with their copies in mm."""
    return [
        c
        for c in columns
        if variables is None or c.name in variables or c.extra.get(TWIN_OF) in variables
    ]


def selected_columns(columns: list[Column], variables: set[str] | None) -> list[Column]:
    """Return the columns of the given variables, and the coordinates of their dimensions.

    For variables of particles the reference positions are included too.
    """
    chosen = chosen_columns(columns, variables)
    dims = {dim for column in chosen for dim in column.dims}
    if "particle" in dims:
        dims.add("axis")
    return [c for c in columns if c in chosen or (c.coordinate and c.dims and {*c.dims} <= dims)]


def begin_worker() -> None:
    """Prepare a worker process.

    It ignores Ctrl-C, which the process of the sweep handles, and ends when this process ends.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    assert parent is not None
    threading.Thread(target=_end_after, args=(parent,), daemon=True).start()


def _end_after(parent: Any) -> None:
    parent.join()
    os._exit(1)


def run_members(jobs: list[Job]) -> list[MemberReport]:
    """Run members one after the other."""
    return [run_member(job) for job in jobs]


def run_member(
    job: Job,
    components: Iterable[type[Component]] = (),
    stopping: Callable[[], bool] = lambda: False,
) -> MemberReport:
    """Run a member on one thread. An exception is returned as a report with the status `failed`."""
    start, sink = time.perf_counter(), SelectiveSink(job.variables, job.times)
    content, lasting = b"", False
    with _one_at_a_time, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the message contains them
        try:
            experiment = Experiment.build(Source(data=json.loads(job.experiment)), components)
            _refuse_other_versions(job, experiment)
            if not experiment.solver.makes_steps:
                import scipy.linalg  # noqa: F401  # so that its threads are known, and limited
            with threadpool_limits(1):
                status, message = _ran(experiment, sink, stopping)
            lasting = status != INTERRUPTED
            content = sink.content() if status in STORED_STATUSES else b""
        except ExperimentError as error:
            status, message, lasting = FAILED, str(error), True
        except PbdkitError as error:
            status, message = FAILED, str(error)
        except MemoryError as error:
            status = FAILED
            message = "; ".join(["out of memory", *filter(None, [str(error)]), AGAIN])
        except (Exception, SystemExit) as error:
            status, message = FAILED, worded(error)
    seconds = time.perf_counter() - start
    return report_of(job.key, status, message, content, lasting, seconds=seconds)


def _ran(
    experiment: Experiment, sink: SelectiveSink, stopping: Callable[[], bool]
) -> tuple[str, str]:
    """Return status and message of the run."""
    run = Simulation.of_scene(build_scene(experiment), watch=Watch(stopping))
    messages = run.warnings
    report = record(run, sink)
    status, reason = report.outcome.status, report.outcome.stop_reason
    return status, "; ".join((*messages, *report.warnings)) if status in WHOLE else reason


def _refuse_other_versions(job: Job, experiment: Experiment) -> None:
    """Raise PluginError if a machine of a cluster has other versions than the sweep."""
    installed = {"pbdkit": pbdkit_version()} | experiment.distributions()
    if installed != job.versions:
        differences = [
            f"{k} {installed.get(k)}, not {v}"
            for k, v in job.versions.items()
            if installed.get(k) != v
        ]
        raise PluginError(
            f"the worker has {', '.join(differences)}; install the same versions there"
        )
