"""Commands of live pages to a session, in any order and repeated."""

from __future__ import annotations

import json
import random
from functools import cache
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.stateful import initialize, precondition, rule
from machines.counted import Counted
from machines.run import BASE

import pbdkit
from pbdkit.errors import PbdkitError
from pbdkit.model.experiment import Experiment
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import Simulation
from pbdkit.stepping.state import State
from pbdkit.web.requests import command_of, execute
from pbdkit.web.server import as_json
from pbdkit.web.session import Session, static_message, status_message

EXPERIMENTS: dict[str, dict[str, Any]] = {
    "plain": BASE | {"steps": 20, "frame": {"type": "mean"}},
    "breaking": BASE
    | {"steps": 20, "fracture": {"type": "strain", "failure": 0.5}, "rule": {"type": "barycentre"}},
    "damage": BASE | {"steps": 20, "fracture": {"type": "damage", "onset": 0.2, "failure": 0.6}},
    "scheduled": BASE
    | {
        "steps": 20,
        "lattice": {"type": "hexagonal", "a": 1.0},
        "solver": {
            "type": "stepping",
            "engine": "numpy",
            "relaxation": {"steps": [0, 7, 15], "values": [1.0, 0.4, 0.9]},
        },
    },
    "elastic": BASE
    | {
        "steps": 20,
        "rule": {"type": "elastic", "poisson_ratio": 0.3},
        "neighbours": {"type": "chebyshev"},
        "solver": {"type": "stepping", "engine": "numpy", "relaxation": 0.7, "memory": 0.3},
    },
}
WRONG: list[Any] = [
    {"do": "sing"}, {"do": "play"}, {"do": "speed", "steps": 0}, {"do": "step", "count": -1}, [],
    {"do": "drag", "by": [float("nan"), 0.0]}, {"do": "grab", "row": 10**6}, {"do": "rewind"},
    {"do": "turn", "name": "rule.none", "value": 1.0}, {"do": "cut-bond", "row": 10**6},
    {"do": "turn", "name": "solver.relaxation", "value": float("inf")}, {"do": "save", "as": "x"},
    {"do": "drag", "by": [1e13, 0.0]}, {"do": "cut", "from": [1.0], "to": [2.0, 3.0]},
]  # fmt: skip


@cache
def experiment(kind: str) -> Experiment:
    """Return a validated experiment."""
    return pbdkit.Experiment(**EXPERIMENTS[kind])


class LiveSessionMachine(Counted):
    """A session with the commands of a page. No command ends it or gives a state that is not
    finite, and a saved experiment repeats its state bit for bit."""

    @initialize(kind=st.sampled_from(sorted(EXPERIMENTS)))
    def begin(self, kind: str) -> None:
        self.messages: list[dict[str, Any]] = []
        self.session = Session(experiment(kind), self.folder / "made.yaml", self.messages.append)

    def do(self, **command: Any) -> bool:
        """Execute a command, as a page sends it. Return whether it was accepted."""
        before, script = self.session.state, self.written()
        try:
            execute(self.session, command_of(json.dumps(command)))
        except PbdkitError:
            assert self.written() == script
            assert self.session.state.step == before.step
            assert self.session.state.u.tobytes() == before.u.tobytes()
            return False
        return True

    def written(self) -> Any:
        return self.session.script.written(10**6)

    def diverged(self) -> bool:
        """Return whether the session has diverged, or is about to."""
        u = self.session.state.u
        return not np.isfinite(u).all() or np.abs(u).max() > 1e6

    @rule(on=st.booleans())
    def play(self, on: bool) -> None:
        self.do(do="play", on=on)

    @rule(count=st.sampled_from([1, 2, 5]))
    def request_steps(self, count: int) -> None:
        self.do(do="step", count=count)

    @rule(steps=st.sampled_from([1, 3, 20]))
    def set_speed(self, steps: int) -> None:
        self.do(do="speed", steps=steps)

    @rule(repeat=st.integers(1, 3))
    def advance(self, repeat: int) -> None:
        """Advance like the server between two pictures."""
        for _ in range(repeat):
            if steps := self.session.next_steps:
                self.session.advance(min(steps, 20))
        self.is_shown()

    @rule(count=st.integers(1, 4))
    def advance_some_steps(self, count: int) -> None:
        self.session.advance(count)
        self.is_shown()

    def is_shown(self) -> None:
        """Pictures and messages can be sent. Positions are finite unless a message reports
        that the session diverged."""
        session = self.session
        as_json(status_message(session))
        assert session.frame().encoded(None)
        if not np.isfinite(session.state.u).all():
            assert any("diverged" in str(message.get("text")) for message in self.messages)

    @rule(row=st.integers(0, 14))
    def grab(self, row: int) -> None:
        self.do(do="grab", row=row)

    @rule(x=st.floats(-0.4, 0.4), y=st.floats(-0.4, 0.4))
    def drag(self, x: float, y: float) -> None:
        self.do(do="drag", by=[x, y])

    @rule()
    def release(self) -> None:
        self.do(do="release")
        assert self.session.grabbed is None

    @rule(place=st.integers(0, 20), share=st.floats(0.0, 1.0))
    def turn(self, place: int, share: float) -> None:
        numbers = [*self.session.script.numbers.values()]
        number = numbers[place % len(numbers)]
        low, high = number.span
        self.do(do="turn", name=number.name, value=low + share * (min(high, 1.2) - low))

    @rule(seed=st.integers(0, 2**20))
    def cut(self, seed: int) -> None:
        if self.diverged():
            return
        draw, positions = random.Random(seed), self.session.camera.positions(self.session.state)
        begin = draw.choice(positions.tolist())
        end = [x + draw.uniform(-1.5, 1.5) for x in begin]
        self.do(do="cut", **{"from": begin, "to": end})

    @rule(row=st.integers(0, 60))
    def cut_bond(self, row: int) -> None:
        self.do(do="cut-bond", row=row)

    @rule(share=st.floats(0.0, 1.1))
    def rewind(self, share: float) -> None:
        step = int(share * self.session.end)
        self.do(do="rewind", step=step)
        assert self.session.step <= self.session.end

    @rule(by=st.sampled_from(["kind", "displacement", "last-step", "strain", "none"]))
    def colour(self, by: str) -> None:
        self.do(do="colour", by=by)
        self.is_shown()

    @rule()
    def leave(self) -> None:
        """Rest, because the last page is closed."""
        self.session.rest()
        as_json(static_message(self.session))

    @rule(command=st.sampled_from(WRONG))
    def send_nonsense(self, command: Any) -> None:
        try:
            execute(self.session, command_of(json.dumps(command)))
        except PbdkitError:
            return
        raise AssertionError(f"accepted: {command}")

    @precondition(lambda self: self.session.step)
    @rule()
    def save(self) -> None:
        if self.diverged():
            return
        if not self.do(do="save"):
            raise AssertionError("a session cannot be saved")
        assert_same(self.session.state, repeated(self.messages[-1]["path"]))


def repeated(path: str) -> State:
    """Run a saved experiment, and return its last state."""
    run = Simulation.of_scene(build_scene(pbdkit.load(path)))
    for _ in run:
        pass
    assert run.outcome
    assert run.outcome.status == "complete", run.outcome
    return run.driver.state


def assert_same(state: State, right: State) -> None:
    """Assert that a saved session ends in the same state. A run does not have the arrays of bonds
    if it cuts none."""
    assert state.step == right.step
    assert state.u.tobytes() == right.u.tobytes()
    assert state.previous.tobytes() == right.previous.tobytes()
    if right.broken_step is not None:
        assert state.broken_step is not None
        assert state.broken_step.tobytes() == right.broken_step.tobytes()
