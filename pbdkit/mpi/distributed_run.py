"""Runs on several ranks: construction of the scene of each part, recording, and execution."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats
from pbdkit.communicator import Communicator
from pbdkit.errors import ExperimentError, PbdkitError
from pbdkit.io.checkpoint import Checkpoint
from pbdkit.io.layout import Column, Values, When, when_measured
from pbdkit.io.paged_file import PiecedArray
from pbdkit.io.recorder import RecordedVariables, Recorder, columns_of
from pbdkit.io.sinks import KeepingSink, Sink
from pbdkit.io.snapshot import StateMoment, Tables
from pbdkit.lattice.raster import RowRange, Stretch
from pbdkit.linear.stencil import Bound, wave_bound
from pbdkit.model.experiment import Experiment
from pbdkit.model.solver import Equilibrium, Solver, Stepping
from pbdkit.mpi import driver, partition
from pbdkit.mpi.communicator import MPICommunicator
from pbdkit.plugin import AppliesTwice, Cell, Diagnostic, FollowerRule
from pbdkit.plugin.discovery import errors_attributed_to
from pbdkit.progress import Watch
from pbdkit.scene.memory_estimate import TooLargeError
from pbdkit.scene.scene import LatticeSetup, Scene, build_scene
from pbdkit.simulation import Driver, Execution, Simulation
from pbdkit.stability.forecast import prediction, quick_warnings
from pbdkit.stability.relaxation import tuned, with_solver
from pbdkit.stepping.state import State


class PartitionScheme(NamedTuple):
    """Partition of a scene for a solver.

    `subdomains` divides the scene. `widest` returns an upper bound of the number of rows of the
    halo. Its first two arguments are the numbers of rows that a step reads and that neighbours
    reach. The others are the minimum number of rows of a part, and the number of parts.
    """

    subdomains: Callable[[Scene, int], list[partition.Subdomain]]
    widest: Callable[[int, int, int, int], int]


CUTS: dict[type[Solver], PartitionScheme] = {
    Stepping: PartitionScheme(partition.subdomains, partition.widest_halo),
    Equilibrium: PartitionScheme(driver.deep_subdomains, driver.deep_halo),
}
"""Partition schemes by solver."""


class RemoteError(PbdkitError):
    """An error has occurred in another process."""


class BuildCommunicator(Communicator):
    """Communicator during the construction of a scene: if one process fails, all others raise
    RemoteError at their next call."""

    def __init__(self, communicator: MPICommunicator) -> None:
        self._inner = communicator
        self.rank, self.size = communicator.rank, communicator.size

    def allgather(self, value: Any) -> list[Any]:
        """Return the values of all processes, by rank."""
        values = self._inner.allgather((True, value))
        if not all(goes_on for goes_on, _ in values):
            raise RemoteError("another process has failed")
        return [each for _, each in values]

    def smallest(self, numbers: NDArray[Any]) -> NDArray[Any]:
        """Return the elementwise minimum over arrays of one shape."""
        self.allgather(None)
        return self._inner.smallest(numbers)

    @contextmanager
    def raise_together(self) -> Iterator[None]:
        """Run the block. If an exception occurs in a process, all other processes raise
        RemoteError at the end of the block."""
        try:
            yield
        except RemoteError:
            raise
        except BaseException:
            self._inner.allgather((False, None))
            raise
        self.allgather(None)


def built(ranks: MPICommunicator, experiment: Experiment) -> Scene:
    """Return the scene of the rows of a process and their halo. If frame points follow distant
    particles, the whole scene is returned. After an error the whole scene is built, too, so that
    the same error is raised as in a run with a single process.

    Raises the errors of `build_scene`, in all processes.
    """
    if experiment.frame.local:
        error: Exception | None = None
        try:
            building = BuildCommunicator(ranks)
            with building.raise_together():
                return _built(experiment, building)
        except Exception as raised:
            error = None if isinstance(raised, RemoteError) else raised
        bug = error is not None and not isinstance(error, PbdkitError)
        if ranks.any(bug or _is_too_large(experiment)):
            if isinstance(error, ExperimentError):
                error = experiment.located(error)
            ranks.raise_first(error)
    with ranks.raise_together():
        return build_scene(experiment)


def _is_too_large(experiment: Experiment) -> bool:
    """Return whether the whole scene is too large for one process."""
    try:
        LatticeSetup(experiment)
    except TooLargeError:
        return True
    except PbdkitError:
        pass
    return False


def _built(experiment: Experiment, ranks: Communicator) -> Scene:
    ground = LatticeSetup(experiment, ranks)
    if not (counts := partition.count_rows(ground, ranks)):
        raise ground.nothing()
    bounds = partition.bounds_of(counts.rows, ranks.size)
    begin, end = bounds[ranks.rank : ranks.rank + 2]
    search, reach = _search(ground), ground.neighbourhood.reach_in_cells[0]
    each, smallest = _levels(experiment.rule) * (reach + search), int(np.diff(bounds).min())
    cut = CUTS[type(experiment.solver)]
    halo = cut.widest(each, reach, smallest, ranks.size)

    def around(rows: int) -> Stretch:
        return counts.stretch(begin - rows, end + rows)

    build = RowRange(around(halo + search + reach), around(0).lines, around(halo).lines)
    scene = build_scene(experiment, ranks, build)
    if any(
        p.low < p.begin - halo or p.high > p.end + halo for p in cut.subdomains(scene, ranks.size)
    ):
        raise ExperimentError(
            "its points follow particles farther away than it declares", ("frame",)
        )
    return scene


def _levels(rule: FollowerRule) -> int:
    """Return an upper bound of the number of successive evaluations of neighbours in a step. The
    evaluation of the forces on masses is included."""
    levels = 2
    while isinstance(rule, AppliesTwice):
        with errors_attributed_to(rule, "to return its inner rule", "rule"):
            levels, rule = levels + 1, rule.inner()
    return levels


def _search(ground: LatticeSetup) -> int:
    """Return an upper bound of the number of rows between a frame point and the particles that it
    can follow. These are its nearest particles, or particles with site indices that differ by twice
    the depth of the frame."""
    cell: Cell = ground.cell
    steps = [math.hypot(*v) / p for v, p in zip(cell.vectors, cell.period, strict=True)]
    farthest = ground.layers * sum(steps) + sum(math.hypot(*v) for v in cell.vectors)
    vectors: Floats = np.array(cell.vectors)
    height = 1.0 / float(np.linalg.norm(np.linalg.inv(vectors)[:, 0]))
    near = math.ceil(farthest / height) if ground.layers else 0
    return 1 + max(near, math.ceil(2 * ground.layers / cell.period[0]))


class DistributedRecorder(Recorder):
    """Recorder of a part. For diagnostics that are not `local` the first process gathers the whole
    state."""

    def __init__(self, division: driver.Division, sink: PartSink) -> None:
        super().__init__(division.scene, sink)
        self._joining = sink
        self._division, self._ranks = division, division.ranks
        whole = division.whole
        self._wholes = (Tables(whole), RecordedVariables(whole)) if whole else None
        self._whole: State | None = None
        diagnostics = division.scene.experiment.diagnostics
        self._gathered = {when_measured(d) for d in diagnostics if not d.local}
        self._local = {when_measured(d) for d in diagnostics if d.local}

    def begin(self, history: Iterable[Values] | None = None) -> None:
        """Begin the record. The history contains the whole lattice and is therefore used only in
        the first process."""
        super().begin(None if history is None else ())
        if history is not None:
            self._joining.take(history)

    def observe(self, state: State, *, last: bool = False, time: float | None = None) -> None:
        """Record a state in the same way as a single process. Equilibria within steps are not
        recorded. An error on one rank is raised on all ranks."""
        if state.step <= self.last_steps.step and not last:
            return
        recorded = last or self._scene.experiment.records(state.step)
        measured = {When.STEP, When.RECORD} if recorded else {When.STEP}
        if measured & self._gathered:
            self._whole = self._division.gathered(state)
        if measured & self._local:
            self._division.halo.renew_previous(state)
        with self._ranks.raise_together(), np.errstate(all="ignore"):
            values = self._record_of(state, last)
        self._put(state, values)

    def finish(self, state: State, outcome: Any, prediction: dict[str, Any]) -> None:
        """Finish in the same way as a single process."""
        self._whole = self._division.gathered(state) if When.END in self._gathered else None
        if When.END in self._local:
            self._division.halo.renew_previous(state)
        super().finish(state, outcome, prediction)

    def _diagnosed(self, when: When, moment: StateMoment) -> Values:
        values = self._measured.diagnosed(when, moment, _is_local)
        if self._wholes and self._whole and when in self._gathered:
            tables, measured = self._wholes
            whole = moment.of(self._whole, tables)
            values |= measured.diagnosed(when, whole, lambda d: not _is_local(d))
        return values

    def _inside_out(self, state: State) -> str | None:
        """Return the description of inverted cells. The state is gathered only if some part has
        inverted cells."""
        if not self._ranks.any(super()._inside_out(state) is not None):
            return None
        whole = self._division.gathered(state)
        if whole is None:
            return None
        tables = self._wholes[0] if self._wholes else Tables(build_scene(self._scene.experiment))
        return StateMoment(whole, tables).cells.inside_out()


def _is_local(diagnostic: Diagnostic) -> bool:
    return diagnostic.local


class PartSink(KeepingSink):
    """Sink that joins the parts of all processes and passes them to the sink of the first
    process."""

    def __init__(self, division: driver.Division, inner: KeepingSink) -> None:
        self._ranks = division.ranks
        self._inner = inner if self._ranks.is_root else None
        self._own = {"particle": division.part.rows}
        if division.scene.experiment.shows_bonds:
            rows, ends = division.part.rows, division.scene.bonds.ends[:, 0]
            self._own["bond"] = slice(*np.searchsorted(ends, (rows.start, rows.stop)).tolist())
        counts = {dim: span.stop - span.start for dim, span in self._own.items()}
        self._lengths = {dim: self._ranks.allgather(count) for dim, count in counts.items()}
        self._sizes = {dim: sum(lengths) for dim, lengths in self._lengths.items()}
        diagnostics = division.scene.experiment.diagnostics
        self._not_local = {v.name for d in diagnostics if not d.local for v in d.variables()}
        columns = columns_of(division.scene)
        self._parts = {c.name: part for c in columns if (part := self._parted(c))}

    def begin(self, columns: list[Column], sizes: dict[str, int], planned: dict[str, int]) -> None:
        """Begin with the sizes of the whole lattice."""
        self._first(lambda inner: inner.begin(columns, sizes | self._sizes, planned))

    def take(self, history: Iterable[Values]) -> None:
        """Write entries of the whole lattice. Only the first process does this."""

        def put(inner: Sink) -> None:
            for values in history:
                inner.put(values)

        self._first(put)

    def _parted(self, column: Column) -> tuple[str, int] | None:
        """Return the dimension of a column that is divided among processes, and the axis of this
        dimension in an entry. Return None if each process has all values."""
        dims = column.dims[1:] if column.grows else column.dims
        along = [n for n, dim in enumerate(dims) if dim in self._own]
        if not along or column.name in self._not_local:
            return None
        return dims[along[0]], along[0]

    def put(self, values: Values) -> None:
        """Write an entry. If it is divided among processes, it is joined from the parts; otherwise
        the entry of the first process is written."""
        whole = dict(values)
        for name in [name for name in values if name in self._parts]:
            dim, axis = self._parts[name]
            part = np.asarray(values[name])[(*(slice(None),) * axis, self._own[dim])]
            if name == "bond":  # Each part counts only its own bonds.
                part += sum(self._lengths[name][: self._ranks.rank]) + 1 - part[:1]
            whole[name] = partition.joined(self._ranks, part, axis, self._lengths[dim])
        self._first(lambda inner: inner.put(whole), whole)

    def due(self) -> bool:
        """Return whether a checkpoint is due, according to the sink of the first process."""
        return bool(self._ranks.bcast(self._inner is not None and self._inner.due()))

    def keep(self, checkpoint: Checkpoint) -> None:
        """Write one checkpoint with the state of the whole lattice."""
        self._first(lambda inner: inner.keep(checkpoint), checkpoint.arrays)

    def suspend(self, checkpoint: Checkpoint) -> None:
        """Write one checkpoint with the state of the whole lattice."""
        self._first(lambda inner: inner.suspend(checkpoint), checkpoint.arrays)

    def keep_final(self, checkpoint: Checkpoint) -> None:
        """Write one checkpoint with the state of the whole lattice."""
        self._first(lambda inner: inner.keep_final(checkpoint), checkpoint.arrays)

    def finish(self, attributes: dict[str, str]) -> None:
        """Finish the result. The number of processes is added to its attributes."""
        self._first(lambda inner: inner.finish(attributes | {"ranks": str(self._ranks.size)}))

    def abandon(self) -> None:
        """Remove the file of the first process."""
        if self._inner:
            self._inner.abandon()

    def _first(
        self, call: Callable[[KeepingSink], None], joining: Mapping[str, Any] | None = None
    ) -> None:
        """Call the sink in the first process, and raise its errors in all processes. During the
        call the other processes send their parts of arrays."""
        with self._ranks.raise_together():
            if self._inner:
                try:
                    call(self._inner)
                finally:
                    for array in (joining or {}).values():
                        if isinstance(array, PiecedArray):
                            array.drain()
            else:
                for share in (joining or {}).values():
                    if isinstance(share, partition.Share):
                        share.send(self._ranks)


DRIVERS: dict[type[Solver], Callable[[driver.Division, Scene, Watch], Driver]] = {
    Stepping: driver.DistributedSteppingDriver,
    Equilibrium: driver.DistributedEquilibriumDriver,
}
"""Driver of each solver on a rank."""


class DistributedSimulation(Simulation):
    """Run that several processes share. Each process has a part of the scene, and the states of its
    run are states of this part. Every error is raised in all processes."""

    def __init__(self, ranks: MPICommunicator, scene: Scene, watch: Watch) -> None:
        automatic = scene.experiment.stepping.open_parameters
        scene, kind = _tuned(ranks, scene), type(scene.experiment.solver)
        with ranks.raise_together():
            parts = CUTS[kind].subdomains(scene, ranks.size)
        self.division = driver.Division(ranks, scene, parts)
        self.scene, self.outcome, self.processes = self.division.scene, None, ranks.size
        self.driver = DRIVERS[kind](self.division, scene, watch)
        self.driver.automatic = automatic
        bound = wave_bound(scene)
        self.warnings, self.prediction = self._warnings(scene, bound), prediction(scene, bound)

    def _warnings(self, scene: Scene, bound: Bound | None) -> tuple[str, ...]:
        """Return the warnings about the part of the scene in this process. Warnings about masses
        refer to the whole scene and are issued by the first process."""
        if not any(leading.share is not None for leading in scene.leading):
            return quick_warnings(scene, bound)
        with self.division.ranks.raise_together():
            whole = self.division.whole_of(scene)
            return quick_warnings(whole, bound) if whole else ()

    def further_warnings(self) -> list[str]:
        """Return no warnings, because `check` evaluates the whole scene."""
        return []

    @property
    def particles(self) -> int:
        """Number of particles of the whole lattice."""
        return self.division.count

    def recorder(self, sink: Sink) -> Recorder:
        """Return the recorder of the part of the scene in this process. It writes to a sink that
        was returned by the method `sink`."""
        assert isinstance(sink, PartSink)
        return DistributedRecorder(self.division, sink)

    def sink(self, inner: KeepingSink) -> KeepingSink:
        """Return a sink that joins the parts for the sink of the first process."""
        return PartSink(self.division, inner)


def _tuned(ranks: MPICommunicator, scene: Scene) -> Scene:
    """Return the scene with numbers in place of `auto`. The first process computes them for the
    whole scene."""
    if not scene.experiment.stepping.is_open:
        return scene
    solver = None
    with ranks.raise_together():
        if whole := driver.whole_of(ranks, scene):
            solver = tuned(whole).experiment.stepping
    return with_solver(scene, ranks.bcast(solver))


class DistributedExecution(Execution):
    """Execution in which the processes of an MPI communicator share every run."""

    communicator: MPICommunicator

    def __init__(self, communicator: MPICommunicator) -> None:
        super().__init__(communicator)

    def scene(self, experiment: Experiment) -> Scene:
        """Return the part of the scene that this process needs."""
        return built(self.communicator, experiment)

    def tuned(self, scene: Scene) -> Scene:
        """Return the part of the scene with numbers in place of `auto`, which are computed for the
        whole scene."""
        return _tuned(self.communicator, scene)

    def by_root(self, work: Callable[[], int]) -> int:
        """Return the result of work that only the root does. The other processes sleep until it is
        done."""
        return self.communicator.by_root(work)

    def run(self, scene: Scene, watch: Watch) -> Simulation:
        """Return the run of this process's part."""
        return DistributedSimulation(self.communicator, scene, watch)
