"""A run, its store and its result: recorded, killed, suspended, damaged, resumed and extended."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from hypothesis import strategies as st
from hypothesis.stateful import initialize, precondition, rule
from machines.counted import Counted, contents, damaged, put_back, without_counters

import pbdkit
from pbdkit.errors import ExperimentError, PbdkitError
from pbdkit.io import netcdf
from pbdkit.io.netcdf import NetcdfSink
from pbdkit.io.recorder import RunOutcome
from pbdkit.io.run_store import StoreState, status_of, store_state
from pbdkit.io.save import refuse_existing
from pbdkit.io.seal import SealedFile, open_sealed
from pbdkit.model.shipped import shipped_names
from pbdkit.progress import Watch
from pbdkit.restart import resumption
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.simulation import Recording, Simulation
from pbdkit.stepping.state import State

SHORT, LONG = 5, 8
"""Numbers of steps of a run, and of its extension."""
BASE: dict[str, Any] = {
    "name": "run",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "grid", "columns": 4, "rows": 3},
    "rule": {"type": "barycentre"},
    "leaders": [
        {"select": {"edge": "left"}, "motion": {"type": "hold"}},
        {
            "select": {"edge": "right"},
            "motion": {"type": "velocity", "velocity": [0.2, 0.01], "steps": 9},
        },
    ],
    "solver": {"type": "stepping", "engine": "numpy"},
    "frame": {"type": "none"},
}
EXPERIMENTS: dict[str, dict[str, Any]] = {
    "plain": BASE,
    "compressed": BASE | {"record": {"compression": "zlib"}, "diagnostics": [{"type": "pe1"}]},
    "breaking": BASE
    | {
        "fracture": {"type": "damage", "onset": 0.1, "failure": 0.3},
        "diagnostics": [{"type": "broken"}],
    },
}
CHUNK_BYTES = 600
"""Chunks of a few records, so that some are in the file and others wait at a commit."""
SHIPPED = shipped_names()
"""Names that are listed once; the files of the package are a fifth of the time of a step."""
CODE = ("pbdkit/io/", "pbdkit/restart", "pbdkit/simulation")


class Whole(NamedTuple):
    """Values of an uninterrupted run, by variable: those along time, and those before it."""

    growing: dict[str, Any]
    fixed: dict[str, Any]


@cache
def scene_of(kind: str, steps: int) -> Scene:
    """Return the scene of a run."""
    return build_scene(pbdkit.Experiment(**EXPERIMENTS[kind] | {"steps": steps}))


@cache
def whole(kind: str, steps: int) -> Whole:
    """Return the values of the uninterrupted run."""
    run = pbdkit.run(EXPERIMENTS[kind] | {"steps": steps}, progress=False)
    names = {str(name): values.values for name, values in run.variables.items()}
    growing = {n for n in names if run[n].dims[:1] in (("time",), ("step",))}
    return Whole({n: names[n] for n in growing}, {n: names[n] for n in {*names} - growing})


class View(NamedTuple):
    """Step of the last commit of an unfinished run, and number of steps of the result; each is None
    if there is no such file."""

    committed: int | None
    result: int | None


class RunMachine(Counted):
    """The files of a run. What was committed is read back bit for bit and continues to the result
    of the uninterrupted run, wherever the process is killed."""

    recording: Recording | None = None
    states: Iterator[State]
    view = View(None, None)
    is_new = True
    """True before the first state of the run in progress."""
    target = planned = SHORT
    """Steps of the run in progress, and of the last commit."""
    commits = False

    @initialize(kind=st.sampled_from(sorted(EXPERIMENTS)))
    def choose(self, kind: str) -> None:
        self.kind = kind
        whole(kind, SHORT)
        self.patch.setattr(netcdf, "CHUNK_BYTES", CHUNK_BYTES)
        self.patch.setattr(NetcdfSink, "due", lambda sink: self.commits)
        self.patch.setattr(Simulation, "sink", lambda run, file: file)
        self.patch.setattr("pbdkit.io.other_files.shipped_names", lambda: SHIPPED)

    def teardown(self) -> None:
        self.drop()
        super().teardown()

    @property
    def output(self) -> Path:
        return self.folder / "out.nc"

    def drop(self) -> None:
        """Close the files of a killed process, in a folder that is no longer used."""
        if self.recording:
            self.recording.abandon()
            self.recording = None

    @precondition(lambda self: not self.recording)
    @rule(force=st.booleans())
    def begin(self, force: bool) -> None:
        try:
            refuse_existing(self.output, force=force)
        except ExperimentError:
            assert not force
            assert self.view != (None, None)
            return
        assert force or self.view == (None, None)
        self.view = self.view._replace(committed=None)
        run = Simulation.of_scene(scene_of(self.kind, SHORT))
        self.target, self.states, self.is_new = SHORT, iter(run), True
        self.recording = Recording(run, NetcdfSink(self.output, force, self.compression))

    @property
    def compression(self) -> str:
        return scene_of(self.kind, SHORT).experiment.record.compression

    def go_on(self) -> None:
        """Make a step, or finish after the last one."""
        assert self.recording
        self.is_new = False
        if (state := next(self.states, None)) is not None:
            self.recording.take(state)
            return
        run = self.recording._simulation
        assert run.outcome
        self.recording.finish(run.outcome)
        self.recording = None

    def next_view(self, commits: bool) -> View:
        """Return what there is after the next step. The first state is that of the start."""
        assert self.recording
        time = self.recording._simulation.time
        if time == self.target and not self.is_new:
            return View(None, self.target)
        step = time if self.is_new else time + 1
        return self.view._replace(committed=step) if commits and step < self.target else self.view

    @precondition(lambda self: self.recording)
    @rule(commits=st.booleans())
    def step(self, commits: bool) -> None:
        self.commits, new = commits, self.next_view(commits)
        self.go_on()
        self.note(new, commits)

    def note(self, new: View, commits: bool) -> None:
        """Note what there is after a step."""
        if commits and new.committed is not None:
            self.planned = self.target
        self.view = new

    @precondition(lambda self: self.recording)
    @rule(commits=st.booleans(), line=st.integers(1, 600))
    def step_and_be_killed(self, commits: bool, line: int) -> None:
        self.commits, new = commits, self.next_view(commits)
        old = self.view
        if not self.killed(line, CODE, self.go_on):
            self.note(new, commits)
            return
        self.drop()
        # At the end, a commit notes that all steps are done before the result gets its name.
        concluded = View(self.target, old.result)
        allowed = [old, new, *([concluded] if new.committed is None and old.committed else [])]
        found, planned = self.found()
        assert found in allowed
        assert planned in (self.planned, self.target)
        self.view, self.planned = found, planned

    def found(self) -> tuple[View, int]:
        """Return what the files contain, and the number of steps of the unfinished run."""
        committed, result, planned = None, None, self.planned
        if self.output.exists():
            with open_sealed(self.output) as content:
                result = int(content["time"][-1])
        if store_state(self.output) is StoreState.COMMITTED:
            status = status_of(self.output)
            assert status
            committed, planned = status["step"], status["steps"]
        return View(committed, result), planned

    @precondition(lambda self: self.recording)
    @rule()
    def be_killed(self) -> None:
        self.move_to_copy()
        self.drop()

    @precondition(lambda self: self.recording and not self.is_new)
    @rule()
    def be_suspended(self) -> None:
        assert self.recording
        step = self.recording._simulation.time
        self.recording.suspend(RunOutcome("interrupted", "on request", step))
        self.recording, self.planned = None, self.target
        self.view = self.view._replace(committed=step)

    @precondition(lambda self: self.recording)
    @rule()
    def fail(self) -> None:
        """Abandon the run like after an exception, which leaves no debris."""
        assert self.recording
        self.recording.abandon()
        self.recording = None
        names = {path.name for path in self.folder.iterdir()}
        kept = {"out.nc"} if self.view.result else set()
        kept |= {"out.nc.run", "out.nc.run-records"} if self.view.committed is not None else set()
        assert {name for name in names if not name.endswith((".part", ".tmp"))} == kept

    @precondition(lambda self: not self.recording)
    @rule(steps=st.sampled_from([None, SHORT, LONG]))
    def resume(self, steps: int | None) -> None:
        committed, result = self.view
        try:
            resumed = resumption(self.output, Watch(), steps=steps)
        except ExperimentError:
            done = result if committed is None else committed
            assert done is None or (steps or 0) <= done
            return
        self.target = steps or self.planned
        if resumed is None:
            assert committed is not None
            assert self.output.exists()
            self.view = View(None, committed)
            return
        assert resumed.run.time == (result if committed is None else committed)
        self.states = iter(resumed.run)
        self.recording, self.is_new = (
            Recording(resumed.run, resumed.sink, resumed.recorder),
            True,
        )

    @rule()
    def ask_for_the_status(self) -> None:
        status = status_of(self.output)
        if self.view.committed is None:
            assert status is None
            return
        assert status
        assert (status["step"], status["steps"]) == (self.view.committed, self.planned)
        assert status["state"] == ("running" if self.recording else "stopped")

    @precondition(lambda self: self.view != (None, None))
    @rule()
    def read(self) -> None:
        step = self.view.committed if self.view.result is None else self.view.result
        assert step is not None
        assert self.read_until() == step

    def read_until(self) -> int:
        """Read all values, which must be those of the uninterrupted run, and return the last
        step."""
        with pbdkit.open(self.output) as dataset:
            last = int(dataset["time"][-1])
            right = whole(self.kind, LONG if last > SHORT else SHORT)
            assert {*dataset.variables} == {*right.growing, *right.fixed}
            for name, values in right.growing.items():
                present = dataset[name].values
                assert present.tobytes() == values[: last + 1].tobytes(), name
            if last in (SHORT, LONG) and dataset.attrs["status"] == "complete":
                for name, values in right.fixed.items():
                    present = dataset[name].values
                    assert present.tobytes() == values.tobytes(), name
            return last

    @precondition(lambda self: self.view.result)
    @rule()
    def verify(self) -> None:
        with SealedFile(self.output) as content:
            content.check()
            assert content.seal

    @precondition(lambda self: not self.recording and self.view.committed is not None)
    @rule(seed=st.integers(0, 2**20), command=st.sampled_from(["status", "read", "resume", "run"]))
    def damage(self, seed: int, command: str) -> None:
        """A damage is refused, and nothing is changed, or has no effect on any value."""
        before = contents(self.folder)
        how = damaged(self.folder, "out.nc.run*", seed)
        files, view = contents(self.folder), self.view
        try:
            self.call(command)
        except PbdkitError:
            assert without_counters(contents(self.folder)) == without_counters(files), (
                how,
                command,
            )
        if command != "resume" or self.view == view:
            put_back(self.folder, before)

    def call(self, command: str) -> None:
        """A command that reads the files of the unfinished run."""
        if command == "status":
            status = status_of(self.output)
            assert status
            assert status["step"] <= self.planned
        elif command == "read" and self.view.result is None:
            self.read_until()
        elif command == "run":
            refuse_existing(self.output, force=False)
            raise AssertionError("an unfinished run would be overwritten")
        elif command == "resume":
            resumed = resumption(self.output, Watch())
            if resumed:
                resumed.record()
            self.view = View(None, self.planned)
            assert self.read_until() == self.planned
