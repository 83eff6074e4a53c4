"""`pbdkit.Simulation` beside a model that makes single steps with numpy."""

from __future__ import annotations

from copy import deepcopy
from functools import cache
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.stateful import precondition, rule
from machines.counted import Counted
from machines.run import BASE

import pbdkit
from pbdkit.equilibrium.load_stepping import equilibrate_at_step
from pbdkit.errors import DivergedError, ExperimentError
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.simulation import Recording, Simulation
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import State, initial_state

STEPS = 12
EXPERIMENTS: dict[str, dict[str, Any]] = {
    "plain": BASE | {"steps": STEPS, "record": {"every": 5}},
    "momentum": BASE
    | {
        "steps": STEPS,
        "record": {"at": [3, 4]},
        "solver": {"type": "stepping", "engine": "numpy", "memory": 0.4, "relaxation": 0.8},
    },
    "breaking": BASE
    | {"steps": STEPS, "fracture": {"type": "damage", "onset": 0.1, "failure": 0.3}},
    "diverging": BASE
    | {
        "steps": STEPS,
        "solver": {"type": "stepping", "engine": "numpy", "relaxation": 1e6},
    },
}
KINDS = st.sampled_from(sorted(EXPERIMENTS))


@cache
def scene_of(kind: str) -> Scene:
    """Return the scene of a simulation."""
    return build_scene(pbdkit.Experiment(**EXPERIMENTS[kind]))


def one_by_one(kind: str, state: State, steps: int) -> State:
    """Make single steps from a copy of a state."""
    state = state.copy()
    for _ in range(steps):
        state = Stepper(scene_of(kind)).advance(state, 1)
    return state


def assert_same(state: State, right: State) -> None:
    """Assert that two states have the same bits."""
    assert state.step == right.step
    for name in ("u", "previous", "broken_step"):
        one, other = getattr(state, name), getattr(right, name)
        assert (one is None) == (other is None)
        assert one is None or one.tobytes() == other.tobytes(), name


class SimulationMachine(Counted):
    """A simulation that is stepped, recorded, equilibrated and used as a start. Its states and
    records are those of single steps."""

    run: Simulation | None = None

    def begin(self, run: Simulation, kind: str, state: State) -> None:
        self.run, self.kind, self.model = run, kind, state
        self.records: list[tuple[Recording, dict[int, State], bool]] = []
        """Recordings, the states that they have, and whether they write a file."""
        self.has_diverged = False

    @rule(kind=KINDS)
    def start(self, kind: str) -> None:
        self.leave()
        run = Simulation.of_scene(scene_of(kind))
        self.begin(run, kind, initial_state(scene_of(kind)))

    @precondition(lambda self: self.run)
    @rule()
    def start_from_the_present_one(self) -> None:
        assert self.run
        earlier, before = self.run, deepcopy(self.run.driver.state)
        if not self.is_finite():
            return
        run = Simulation(EXPERIMENTS[self.kind], start=earlier)
        self.leave()
        self.begin(run, self.kind, self.model)
        run.step(min(1, STEPS - run.time))
        assert_same(earlier.driver.state, before)
        self.begin(Simulation(EXPERIMENTS[self.kind], start=earlier), self.kind, self.model)

    def is_finite(self) -> bool:
        return bool(np.isfinite(self.model.u).all())

    def leave(self) -> None:
        for recording, *_ in self.records if self.run else []:
            recording.abandon()

    def teardown(self) -> None:
        self.leave()
        super().teardown()

    def advance(self, count: int) -> None:
        """The model makes steps, of which some are recorded."""
        for _ in range(count):
            due = scene_of(self.kind).experiment.records(self.model.step)
            for _recording, states, _writes in self.records:
                if due or not states:
                    states[self.model.step] = self.model
            self.model = one_by_one(self.kind, self.model, 1)

    @precondition(lambda self: self.run and not self.run.outcome)
    @rule(count=st.integers(0, 4))
    def step(self, count: int) -> None:
        assert self.run
        left = STEPS - self.model.step
        if count > left:
            try:
                self.run.step(count)
            except ExperimentError as error:
                assert "more steps exceed" in str(error)  # noqa: PT017
            else:
                raise AssertionError("more steps than the experiment has")
            return
        self.make(lambda run: run.step(count), count)

    @precondition(lambda self: self.run and not self.run.outcome)
    @rule()
    def run_to_the_end(self) -> None:
        self.make(lambda run: run.run(), STEPS - self.model.step)

    def make(self, call: Any, count: int) -> None:
        assert self.run
        try:
            call(self.run)
        except DivergedError:
            assert self.kind == "diverging"
            assert self.run.outcome
            self.run = None
            return
        self.advance(count)
        assert_same(self.run.driver.state, self.model)
        if self.run.outcome:  # recording has ended too
            for _recording, states, _writes in self.records:
                states[self.model.step] = self.model

    @precondition(lambda self: self.run)
    @rule(count=st.sampled_from([-1, 1.0, True, None]))
    def step_wrongly(self, count: Any) -> None:
        assert self.run
        try:
            self.run.step(count)
        except ExperimentError:
            assert_same(self.run.driver.state, self.model)
        else:
            raise AssertionError(f"step({count!r}) is accepted")

    @precondition(lambda self: self.run and self.run.outcome)
    @rule()
    def step_after_the_end(self) -> None:
        assert self.run
        for call in (lambda run: run.step(1), lambda run: run.record()):
            try:
                call(self.run)
            except ExperimentError as error:
                assert "has ended" in str(error)  # noqa: PT017
            else:
                raise AssertionError("a simulation goes on after its end")

    @precondition(lambda self: self.run)
    @rule()
    def read_the_state(self) -> None:
        assert self.run
        if not self.is_finite():
            return
        dataset, table = self.run.state, scene_of(self.kind).raster.table
        assert dataset["u"].values.tobytes() == np.ascontiguousarray(table(self.model.u)).tobytes()
        try:
            dataset["u"].values[0] = 1.0
        except ValueError:
            assert_same(self.run.driver.state, self.model)
        else:
            raise AssertionError("the state of a simulation can be changed through a dataset")

    @precondition(lambda self: self.run and self.kind in ("plain", "momentum"))
    @rule()
    def equilibrate(self) -> None:
        assert self.run
        state = self.model.copy()
        equilibrate_at_step(scene_of(self.kind), state)
        bound = self.run.equilibrate()
        assert bound.as_dict()
        self.model = state
        assert_same(self.run.driver.state, state)

    @precondition(lambda self: self.run and not self.run.outcome and len(self.records) < 3)
    @rule(writes=st.sampled_from([False] * 7 + [True]))
    def record(self, writes: bool) -> None:
        assert self.run
        path = self.folder / f"{len(list(self.folder.iterdir()))}.nc" if writes else None
        recording = self.run.record(path)
        self.records.append((recording, {}, writes))

    @precondition(lambda self: self.run and self.records)
    @rule(place=st.integers(0, 2))
    def close(self, place: int) -> None:
        assert self.run
        entry = self.records.pop(place % len(self.records))
        recording, states, _ = entry
        was_over = self.run.outcome is not None
        last = self.model.step
        try:
            recording.close()
        except FloatingPointError:
            assert self.kind == "diverging"
            return
        if not was_over:
            states[last] = self.model
            if self.run.outcome:  # the other recordings have ended, too
                for _recording, others, _writes in self.records:
                    others[last] = self.model
        if self.kind == "diverging":
            return
        with recording.dataset as dataset:
            self.check_records(dataset, states)
            status = dataset.attrs["status"]
            assert status == ("complete" if last == STEPS else "interrupted"), was_over
        if last == STEPS and not self.run.outcome:
            raise AssertionError("the run is complete, but has no outcome")

    def check_records(self, dataset: Any, states: dict[int, State]) -> None:
        """Assert that the records are the states of the model. A state that was changed between
        two steps is recorded as it was before the next step or at the end of the recording."""
        assert dataset["time"].values.tolist() == sorted(states)
        table = scene_of(self.kind).raster.table
        reference = dataset["reference"].values
        for step, state in states.items():
            values = dataset["position"].sel(time=step).values
            right = np.ascontiguousarray(table(state.u)) + reference
            np.testing.assert_allclose(values, right, atol=1e-15)
