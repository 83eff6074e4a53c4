"""Interactive bodies: a saved session repeats it, and no other client moves it."""

import asyncio
import json
import random
import re
import threading
import time
import urllib.error
import urllib.request
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from socket import create_connection
from typing import ClassVar, Literal
from urllib.parse import urlsplit

import numpy as np
import pytest
from browser import until, until_page
from scene_strategies import in_turn
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

import pbdkit
from pbdkit.io.physical import in_physical_units
from pbdkit.lattice.raster import FOLLOWER
from pbdkit.model.shipped import shipped_names
from pbdkit.plotting.style import signed
from pbdkit.plugin import Variable
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import Simulation
from pbdkit.web import script as saving, session as history, session as stage
from pbdkit.web.command_line import live
from pbdkit.web.requests import MAX_COMMAND_BYTES, MAX_COORDINATE, command_of, execute
from pbdkit.web.script import numbers_of, parts_of
from pbdkit.web.server import Access, Conductor, SessionServer, SocketViewer
from pbdkit.web.session import Session, judged, static_message, status_message
from pbdkit.web.widget import LiveWidget

CHANGED = {
    "paper/b": ["solver.memory=0.3"],
    "paper/f2": ["fracture.thresholds=[1.3, 2.3]"],
}


def session_of(name, tmp_path, settings=(), **more):
    said = []
    loaded = pbdkit.load(name, settings=settings)
    return Session(loaded, tmp_path / "made.yaml", notify=said.append, **more), said


def do(session, **command):
    execute(session, command_of(json.dumps(command)))


def run_of(path):
    run = Simulation.of_scene(build_scene(pbdkit.load(path)))
    for _ in run:
        pass
    return run.driver.state


def assert_same(a, b):
    assert a.step == b.step
    np.testing.assert_array_equal(a.u, b.u)
    np.testing.assert_array_equal(a.previous, b.previous)
    assert (a.broken_step is None) == (b.broken_step is None)
    if a.broken_step is not None:
        np.testing.assert_array_equal(a.broken_step, b.broken_step)
    for mine, others in zip(a.particle_values, b.particle_values, strict=True):
        np.testing.assert_array_equal(mine, others)


def at_random(session, seed, turns=40):
    """Whatever a user may do; what cannot be is refused and changes nothing."""
    dice = random.Random(seed)
    for _ in range(turns):
        with suppress(pbdkit.ExperimentError):
            something(session, dice)
        for _ in range(dice.randrange(3)):
            session.advance(dice.choice([1, 1, 2, 7]))
    followers = np.flatnonzero(session.frame().kinds == FOLLOWER)
    do(session, do="grab", row=int(followers[len(followers) // 2]))
    do(session, do="drag", by=[0.1, 0.2])
    session.advance(3)


def something(session, dice):
    kind = dice.choice(["grab", "drag", "drag", "drag", "release", "turn", "cut", "bond", "rewind"])
    positions = session.camera.positions(session.state)
    row = dice.randrange(len(positions))
    if kind == "grab":
        do(session, do="grab", row=row)
    elif kind == "drag":
        do(session, do="drag", by=[dice.gauss(0, 0.2), dice.gauss(0, 0.2)])
    elif kind == "release":
        do(session, do="release")
    elif kind == "turn":
        name = dice.choice([*session.script.numbers])
        now = session.script.numbers[name].at(session.step + 1)
        do(session, do="turn", name=name, value=now * dice.uniform(0.9, 1.0))
    elif kind == "cut" and dice.random() < 0.4:
        begin = positions[row].tolist()
        end = [x + dice.uniform(-1.5, 1.5) * session.camera.spacing for x in begin]
        do(session, do="cut", **{"from": begin, "to": end})
    elif kind == "bond" and len(session.camera.bonds):
        do(session, do="cut-bond", row=dice.randrange(len(session.camera.bonds)))
    elif kind == "rewind":
        do(session, do="rewind", step=dice.randrange(session.end + 1))


@pytest.mark.parametrize("name", in_turn(shipped_names(), 3))
def test_saved_session_is_reproduced_bit_for_bit(name, tmp_path):
    session, said = session_of(name, tmp_path, CHANGED.get(name, ()))
    at_random(session, name, 40 if session.camera.rows.size < 300 else 8)
    assert session.script.groups[-1].manual
    do(session, do="save")
    assert said[-1]["is"] == "saved"
    assert_same(session.state, run_of(tmp_path / "made.yaml"))


def test_part_of_a_session_is_saved(tmp_path):
    session, _ = session_of("paper/d1", tmp_path)
    at_random(session, 8)
    for n, step in enumerate((session.end // 3, session.end // 2, 1)):
        do(session, do="rewind", step=step)
        do(session, do="save")
        file = tmp_path / f"made{f'-{n + 1}' * (n > 0)}.yaml"
        assert_same(session.state, run_of(file))


def test_kernels_reproduce_the_session(interpreted, tmp_path, monkeypatch):
    monkeypatch.setattr(stage, "MAX_NUMPY_PARTICLES", 0)
    session, _ = session_of("paper/a", tmp_path, ["solver.engine=compiled"])
    assert session.stage.choice.engine == "compiled"
    at_random(session, 3)
    do(session, do="save")
    assert_same(session.state, run_of(tmp_path / "made.yaml"))


@pytest.mark.parametrize("name", ["paper/f2", "modelling/composite-plate"])
def test_fields_equal_the_variables_of_a_run_in_the_units_of_the_user(name, tmp_path):
    session, _ = session_of(name, tmp_path)
    session.advance(7)
    do(session, do="save")
    dataset = in_physical_units(pbdkit.run(tmp_path / "made.yaml", progress=False)).isel(time=-1)
    compared = set()
    for field, label in session.camera.fields.labels.items():
        if field not in dataset or dataset[field].dims != ("particle",):
            continue
        do(session, do="colour", by=field)
        expected = dataset[field].values.astype(np.float32)
        np.testing.assert_allclose(session.frame().values, expected, rtol=1e-6)
        assert label["units"] == signed(dataset[field].units)
        compared.add(field)
    assert compared & {"pe1", "stress_von_mises", "strain_xx"}


class Failing(pbdkit.Diagnostic):
    """A value for each particle that cannot be computed after step 3."""

    type: Literal["failing"] = "failing"
    measured: ClassVar[list[int]] = []

    def variables(self):
        return (Variable("failing", ("particle",), "a value", "1"),)

    def measure(self, now):
        self.measured.append(now.step)
        return (now.reference()[:, 0] * (1 / (3 - now.step)),)


def test_a_field_is_computed_only_while_it_is_selected(tmp_path):
    said = []
    parts = ["diagnostics=[{type: failing}]"]
    loaded = pbdkit.load("paper/a", settings=parts, components=[Failing])
    session = Session(loaded, tmp_path / "made.yaml", notify=said.append)
    session.advance(1)
    session.frame()
    assert Failing.measured == []
    do(session, do="colour", by="failing")
    assert session.frame().values.max() == session.camera.reference[:, 0].max() / 2
    with pytest.raises(pbdkit.ExperimentError, match="there is no field 'stres_xx'; did you mean"):
        do(session, do="colour", by="stres_xx")
    session.advance(2)
    assert session.frame().values is None
    assert session.camera.colour == "kind"
    assert "ZeroDivisionError" in said[-1]["text"]
    assert "failing" in said[-1]["text"]


def test_bonds_give_particles_the_fraction_that_is_broken(tmp_path):
    session, _ = session_of("paper/a", tmp_path)
    do(session, do="cut-bond", row=0)
    session.advance(1)
    do(session, do="colour", by="broken")
    ends, values = session.camera.bonds, session.frame().values
    bonds_of = [(ends == row).any(axis=1).sum() for row in ends[0]]
    np.testing.assert_allclose(values[ends[0]], 1 / np.array(bonds_of), rtol=1e-6)
    assert np.nansum(values) == pytest.approx(values[ends[0]].sum())


def test_rewinding_gives_the_same_states(tmp_path):
    session, _ = session_of("paper/d1", tmp_path)
    at_random(session, 5)
    seen = {}
    do(session, do="rewind", step=0)
    while session.step < session.end:
        session.advance(1)
        seen[session.step] = session.state.copy()
    for step in random.Random(1).sample(sorted(seen), 12):
        do(session, do="rewind", step=step)
        assert session.step == step
        np.testing.assert_array_equal(session.state.u, seen[step].u)


def test_action_after_a_rewind_discards_later_ones(tmp_path):
    session, _ = session_of("paper/a", tmp_path)
    session.advance(5)
    do(session, do="turn", name="solver.relaxation", value=0.5)
    session.advance(5)
    do(session, do="rewind", step=3)
    assert session.end == 10
    do(session, do="turn", name="solver.memory", value=0.25)
    assert session.end == 3
    session.advance(3)
    found = session.script.written(session.step)["solver"]
    assert found["relaxation"] == 1.0
    assert found["memory"] == {"steps": [3, 4], "values": [0.0, 0.25]}


def test_parameter_change_at_the_rewound_step_is_discarded(tmp_path):
    """It holds from the step after that one on, and was made after it."""
    session, _ = session_of("paper/a", tmp_path)
    session.advance(5)
    do(session, do="turn", name="solver.relaxation", value=0.5)
    session.advance(5)
    do(session, do="rewind", step=5)
    do(session, do="turn", name="solver.memory", value=0.25)
    session.advance(3)
    found = session.script.written(session.step)["solver"]
    assert found["relaxation"] == 1.0
    assert found["memory"] == {"steps": [5, 6], "values": [0.0, 0.25]}
    do(session, do="save")
    assert_same(session.state, run_of(tmp_path / "made.yaml"))


def test_failed_steps_discard_later_states(tmp_path, monkeypatch):
    session, said = session_of("paper/a", tmp_path)
    for _ in range(10):
        session.advance(1)
    do(session, do="rewind", step=4)

    def refused(state, steps):
        monkeypatch.undo()
        raise pbdkit.ExperimentError("leaders cannot go there")

    monkeypatch.setattr(session.stage, "advance", refused)
    session.advance(8)
    assert said[-1] == {"is": "error", "text": "leaders cannot go there"}
    assert session.step == session.end == max(session.history.steps) == 4


def test_dragged_group_follows_the_mouse_within_one_frame(tmp_path):
    session, _ = session_of("paper/a", tmp_path)
    session.advance(3)
    left = int(session.stage.scene.leading[0].rows[4])
    before = session.camera.positions(session.state)
    do(session, do="grab", row=left)
    do(session, do="drag", by=[0.5, -0.25])
    session.advance(4)
    moved = session.camera.positions(session.state) - before
    rows = session.stage.scene.leading[0].rows
    np.testing.assert_allclose(moved[rows], [[0.5, -0.25]] * len(rows), atol=1e-15)
    do(session, do="release")
    session.advance(2)
    assert session.stage.scene.leading[-1].group.leads(session.step + 1)


def test_released_follower_follows_again(tmp_path):
    session, _ = session_of("paper/a", tmp_path)
    follower = 67
    do(session, do="grab", row=follower)
    do(session, do="drag", by=[1.0, 0.0])
    session.advance(1)
    held = session.camera.positions(session.state)[follower]
    session.advance(3)
    np.testing.assert_array_equal(session.camera.positions(session.state)[follower], held)
    do(session, do="release")
    session.advance(1)
    assert (session.camera.positions(session.state)[follower] != held).any()
    group = session.script.written(session.step)["leaders"][-1]
    assert (group["from"], group["until"]) == (1, 4)


def test_line_across_a_moved_body_cuts_crossing_bonds(tmp_path):
    session, _ = session_of("paper/a", tmp_path)
    session.advance(12)
    ends = session.camera.positions(session.state)[session.camera.bonds.astype(int)]
    across = (ends[:, 0, 0] < 6.0) != (ends[:, 1, 0] < 6.0)
    level = (ends[:, :, 1] > 2.5).all(axis=1) & (ends[:, :, 1] < 6.5).all(axis=1)
    do(session, do="cut", **{"from": [6.0, 2.5], "to": [6.0, 6.5]})
    session.advance(1)
    broken = session.frame().broken.astype(bool)
    assert broken.sum() == (across & level).sum() == 4
    np.testing.assert_array_equal(np.flatnonzero(broken), np.flatnonzero(across & level))


def test_one_bond_is_cut_without_crossing_ones(tmp_path):
    session, _ = session_of("paper/a-chebyshev", tmp_path)
    for row in (3, 40, 131, 200):
        do(session, do="cut-bond", row=row)
    session.advance(1)
    np.testing.assert_array_equal(np.flatnonzero(session.frame().broken), [3, 40, 131, 200])


def test_long_mouse_paths_are_stored_in_a_table(tmp_path, monkeypatch):
    monkeypatch.setattr(saving, "MAX_INLINE_KNOTS", 10)
    session, said = session_of("paper/a", tmp_path)
    do(session, do="grab", row=int(session.stage.scene.leading[0].rows[0]))
    for n in range(20):
        do(session, do="drag", by=[0.01 * n, 1e-17 + 0.1 * n])
        session.advance(2)
    do(session, do="save")
    assert said[-1]["text"] is None
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["made-0.csv", "made.yaml"]
    assert_same(session.state, run_of(tmp_path / "made.yaml"))
    (tmp_path / "made.yaml").unlink()  # its table is still there
    do(session, do="save")
    assert Path(said[-1]["path"]).name == "made-2.yaml"
    assert_same(session.state, run_of(tmp_path / "made-2.yaml"))


def test_no_file_is_overwritten(tmp_path):
    session, said = session_of("paper/a", tmp_path)
    with pytest.raises(pbdkit.ExperimentError, match="no step has been made yet"):
        do(session, do="save")
    session.advance(1)
    do(session, do="save")
    do(session, do="save")
    assert [Path(message["path"]).name for message in said] == ["made.yaml", "made-2.yaml"]


def test_leaders_without_a_possible_position_stay_with_a_message(tmp_path):
    overlap = {
        "leaders": [
            {"select": {"edge": "left"}, "motion": {"type": "hold"}},
            {"select": {"edge": "bottom"}, "motion": {"type": "hold"}},
        ]
    }
    parts = pbdkit.load("paper/a").model_dump(mode="json", by_alias=True) | overlap
    said = []
    session = Session(pbdkit.Experiment(**parts), tmp_path / "made.yaml", said.append)
    session.advance(2)
    before = session.state.copy()
    do(session, do="grab", row=int(session.stage.scene.leading[0].rows[5]))
    do(session, do="drag", by=[1.0, 1.0])
    session.advance(3)
    assert "two groups move particle" in said[-1]["text"]
    assert_same(session.state, before)
    session.advance(1)
    assert session.step == 3


@pytest.mark.parametrize(
    ("command", "told"),
    [
        ({"do": "turn", "name": "rule.K", "value": 1.0}, "no parameter 'rule.K'"),
        ({"do": "turn", "name": "solver.relaxation", "value": -1.0}, "greater than 0"),
        ({"do": "grab", "row": 5000}, "no particle 5000"),
        ({"do": "grab", "row": 0}, "frame points follow the body"),
        ({"do": "cut-bond", "row": 9999}, "no bond 9999"),
        ({"do": "cut", "from": [90.0, 0.0], "to": [91.0, 0.0]}, "crosses no bond"),
        ({"do": "sing"}, "invalid command"),
        ({"do": "play"}, "invalid command: play.on"),
        ({"do": "speed", "steps": 0}, "greater than or equal to 1"),
        ({"do": "drag", "by": [float("nan"), 0.0]}, "finite"),
        ({"do": "step", "count": 1, "more": 2}, "unknown key"),
        ([], "invalid command"),
    ],
)
def test_invalid_actions_are_refused_without_effect(command, told, tmp_path):
    """A particle that is dragged at the time is not released, either."""
    session, equal = (session_of("paper/a", tmp_path)[0] for _ in range(2))
    for each in (session, equal):
        do(each, do="grab", row=67)
        do(each, do="drag", by=[1.0, 0.0])
    with pytest.raises(pbdkit.ExperimentError, match=re.escape(told)):
        execute(session, command_of(json.dumps(command)))
    assert session.grabbed is not None
    for each in (session, equal):
        each.advance(2)
    assert session.script.written(2) == equal.script.written(2)


REFUSED = [
    {"do": "turn", "name": "rule.K", "value": 1.0},
    {"do": "turn", "name": "solver.relaxation", "value": -1.0},
    {"do": "turn", "name": "solver.relaxation", "value": 0.75},
    {"do": "drag", "by": [0.3, 0.2]},
    {"do": "cut", "from": [3.5, -3.0], "to": [3.5, 3.0]},
    {"do": "release"},
]


@pytest.mark.parametrize("command", REFUSED)
@pytest.mark.parametrize("back", [False, True])
def test_refused_action_keeps_earlier_ones(command, back, tmp_path, monkeypatch):
    """Neither what was done at this step before, nor what came after it."""
    session, _ = session_of("paper/a", tmp_path)
    session.advance(4)
    followers = np.flatnonzero(session.frame().kinds == FOLLOWER)
    do(session, do="turn", name="solver.memory", value=0.25)
    do(session, do="grab", row=int(followers[len(followers) // 2]))
    if command["do"] != "drag":
        do(session, do="drag", by=[0.1, 0.2])
    session.advance(4)
    if back:
        do(session, do="rewind", step=4)
        do(session, do="grab", row=int(followers[len(followers) // 2]))
        if command["do"] == "release":  # nothing would have been led yet
            return
    else:
        do(session, do="turn", name="solver.relaxation", value=0.5)
    written, state, kept = session.script.written(10), session.state.copy(), session.history.steps
    actual, broken = session.stage.set, [True]

    def refusing(given):
        if broken and command != REFUSED[0]:
            broken.pop()
            raise pbdkit.ExperimentError("this scene cannot be")
        return actual(given)

    monkeypatch.setattr(session.stage, "set", refusing)
    with pytest.raises(pbdkit.ExperimentError):
        do(session, **command)
    assert session.script.written(10) == written
    assert (session.end, session.history.steps) == (8, kept)
    assert_same(session.state, state)
    monkeypatch.undo()
    do(session, do="rewind", step=8)
    do(session, do="save")
    assert_same(session.state, run_of(tmp_path / "made.yaml"))


def test_numbers_are_in_the_units_of_the_experiment_file():
    loaded = pbdkit.load(
        "paper/d1", settings=["units={length: 2 mm}", "fracture.thresholds=[8.4 mm]"]
    )
    numbers = numbers_of(loaded, parts_of(loaded))
    threshold, relaxation = numbers["fracture.thresholds.0"], numbers["solver.relaxation"]
    assert (threshold.at(0), threshold.units, threshold.factor) == (4.2, "mm", 2.0)
    assert (relaxation.units, relaxation.factor) == ("", 1.0)


def test_parameters_of_random_draws_cannot_be_changed(tmp_path):
    session, _ = session_of("modelling/ageing", tmp_path)
    assert "fracture.failure" in session.script.numbers
    with pytest.raises(pbdkit.ExperimentError, match=r"no parameter 'fracture\.scatter'"):
        do(session, do="turn", name="fracture.scatter", value=0.1)


def test_cuts_are_refused_for_rules_without_cuts(tmp_path):
    session, _ = session_of("material/gradient-layer", tmp_path)
    line = {"from": [0.3, -1.0], "to": [0.3, 5.0]}
    with pytest.raises(pbdkit.ExperimentError, match="is incompatible with this setting of cuts"):
        do(session, do="cut", **line)
    session.advance(1)
    assert not session.script.cuts


def test_number_of_stored_states_is_bounded(tmp_path, monkeypatch):
    session, _ = session_of("paper/a", tmp_path)
    monkeypatch.setattr(history, "MAX_STATES", 16)
    kept = history.History(session.state)
    for step in range(1, 1000):
        session.state.step = step
        kept.keep(session.state)
        assert len(kept.steps) <= 16
    assert kept.steps[0] == 0
    assert kept.steps[-1] > 900
    monkeypatch.setattr(history, "MAX_STATE_BYTES", 7 * history._size(session.state))
    kept.keep(replace(session.state, step=5000))
    assert len(kept.steps) <= 7


@pytest.mark.parametrize(
    ("settings", "word", "told"),
    [
        ([], "stable", "decays to 1/1000 in"),
        (["solver.relaxation=1.3"], "diverging", "relaxation below 1"),
        (["body.columns=60", "body.rows=60"], "slow", "memory"),
        (["body.columns=90", "body.rows=90"], "unknown", "more than 4000 particles"),
        (["leaders=[]", "frame.type=none"], "slow", "it is not constrained"),
        (["neighbours={type: euclidean, radius: 1.1, reevaluate: true}"], "unknown", "spectrum"),
    ],
)
def test_verdict_has_a_reason(settings, word, told):
    found = judged(pbdkit.load("paper/a", settings=settings))
    assert (found.word, told in found.why) == (word, True), found


class Onlooker:
    """A page without a browser, over a socket."""

    def __init__(self, address):
        self.line = connect(socket_of(address), origin=origin_of(address))

    def __enter__(self):
        self.socket = self.line.__enter__()
        return self

    def __exit__(self, *why):
        self.line.__exit__(*why)

    def do(self, **command):
        self.socket.send(json.dumps(command))

    def receive(self, kind, seconds=10.0):
        while True:
            message = self.socket.recv(timeout=seconds)
            if isinstance(message, bytes):
                if kind == "picture":
                    return message
            elif json.loads(message)["is"] == kind:
                return json.loads(message)


def socket_of(address):
    return address.replace("http://", "ws://").replace("/?", "/socket?")


def origin_of(address):
    return address.split("/?")[0]


@contextmanager
def served(session):
    conductor = Conductor(session)
    conductor.start()
    address, ends = [], []
    known = threading.Event()

    async def serve():
        end = asyncio.Event()
        ends.append((asyncio.get_running_loop(), end))
        await SessionServer(conductor, "a body").run(
            lambda found: (address.append(found), known.set()), end
        )

    thread = threading.Thread(target=lambda: asyncio.run(serve()))
    thread.start()
    assert known.wait(20)
    try:
        yield address[0]
    finally:
        loop, end = ends[0]
        loop.call_soon_threadsafe(end.set)
        thread.join()
        conductor.close()


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    session, _ = session_of("paper/a", tmp_path_factory.mktemp("live"))
    with served(session) as found:
        yield found


def response_of(address, headers=()):
    """The status of a page."""
    request = urllib.request.Request(address, headers=dict(headers))
    try:
        with urllib.request.urlopen(request, timeout=10) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code


STRANGERS = {
    "no token": ("", {}),
    "a wrong token": ("token=" + "A" * 43, {}),
    "two tokens": ("token={token}&token={token}", {}),
    "a foreign origin": ("token={token}", {"Origin": "http://evil.example"}),
    "no origin at all": ("token={token}", {"Origin": "null"}),
    "another port": ("token={token}", {"Origin": "http://127.0.0.1:1"}),
    "https": ("token={token}", {"Origin": "https://{host}"}),
    "a rebound host": ("token={token}", {"Host": "evil.example:{port}"}),
    "a rebound host of its own origin": (
        "token={token}",
        {"Host": "evil.example:{port}", "Origin": "http://evil.example:{port}"},
    ),
    "a host without its port": ("token={token}", {"Host": "127.0.0.1"}),
}


def strange(address, query, headers):
    host, token = origin_of(address).split("//")[1], address.split("token=")[1]
    known = {"token": token, "host": host, "port": host.split(":")[1]}
    there = f"{origin_of(address)}/?{query.format(**known)}"
    return there, {name: value.format(**known) for name, value in headers.items()}


@pytest.mark.parametrize("who", STRANGERS)
def test_requests_without_token_get_no_page(address, who):
    assert response_of(*strange(address, *STRANGERS[who])) == 403


@pytest.mark.parametrize("who", [*STRANGERS, "no page at all"])
def test_requests_without_token_get_no_socket(address, who):
    query, headers = STRANGERS.get(who, ("token={token}", {}))
    there, headers = strange(address, query, headers)
    if who != "no page at all":
        headers = {"Origin": origin_of(address)} | headers
    with pytest.raises(InvalidStatus) as refused, raw_socket(there, headers) as socket:
        socket.recv(timeout=5)
    assert refused.value.response.status_code == 403


@contextmanager
def raw_socket(address, headers):
    """With the headers as they are given; the library would add a Host of its own."""
    import websockets.sync.client as client

    class Strange(client.ClientProtocol):
        def connect(self):
            request = super().connect()
            for name, value in headers.items():
                if name in request.headers:
                    del request.headers[name]
                request.headers[name] = value
            return request

    before, client.ClientProtocol = client.ClientProtocol, Strange
    try:
        with connect(socket_of(address)) as socket:
            yield socket
    finally:
        client.ClientProtocol = before


def test_request_with_token_gets_the_page_and_nothing_else(address):
    with urllib.request.urlopen(address, timeout=10) as answer:
        text, policy = answer.read().decode(), answer.headers["Content-Security-Policy"]
    assert "http" not in re.sub(r"http://www.w3.org/2000/svg", "", text)
    nonce = re.search(r"script-src 'nonce-([^']+)'", policy)[1]
    assert f'nonce="{nonce}"' in text
    assert "default-src 'none'" in policy
    assert response_of(address.replace("127.0.0.1", "localhost")) == 200
    assert response_of(address.replace("/?", "/etc/passwd?")) == 404


def test_shutdown_waits_for_no_page(tmp_path):
    """Neither for requests of which half has come, nor for pages that read nothing."""
    session, _ = session_of("paper/a", tmp_path)
    with ExitStack() as lines:
        with served(session) as address:
            parts = urlsplit(address)
            half, silent = (
                lines.enter_context(create_connection((parts.hostname, parts.port)))
                for _ in range(2)
            )
            half.sendall(b"GET / HTT")
            silent.sendall(
                f"GET /socket?{parts.query} HTTP/1.1\r\nHost: {parts.netloc}\r\n"
                f"Origin: http://{parts.netloc}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
                .encode()
            )  # fmt: skip
            assert silent.recv(12) == b"HTTP/1.1 101"
            begin = time.monotonic()
        assert time.monotonic() - begin < 6.0


def test_occupied_port_is_reported(address, tmp_path):
    port = int(re.search(r":(\d+)/", address)[1])
    with pytest.raises(pbdkit.ExperimentError, match=f"--port {port}: cannot be served at"):
        live.main(["paper/a", "--no-browser", "--port", str(port)], standalone_mode=False)


def test_stepping_pauses_without_viewers(tmp_path):
    session, _ = session_of("paper/a", tmp_path)
    with served(session) as there:
        with Onlooker(there) as page:
            page.do(do="play", on=True)
            until(lambda: session.step > 3)
        until(lambda: not session.running)


class Gone:
    """A socket with its other end closed."""

    async def send(self, message):
        raise ConnectionClosed(None, None)


def test_messages_to_closed_pages_are_ignored():
    async def told():
        page = SocketViewer(asyncio.get_running_loop())
        page.post({"is": "note"})
        await page.send(Gone())
        return page

    page = asyncio.run(told())
    page.post({"is": "note"})  # the loop is closed by now
    assert page._waiting.empty()


def test_tokens_are_unique():
    tokens = {Access(1).token for _ in range(20)}
    assert len(tokens) == 20
    assert min(map(len, tokens)) >= 43
    assert Access(1).token not in repr(Access(1))


FAR = [
    {"do": "cut", "from": [1e308, -1e308], "to": [-1e308, 1e308]},
    {"do": "cut", "from": [1e300, 0], "to": [0, 0]},
    {"do": "drag", "by": [0, 1e200]},
]


@pytest.mark.parametrize("command", FAR)
def test_coordinates_out_of_range_are_refused(command):
    with pytest.raises(pbdkit.ExperimentError, match=r"invalid command: .* 1000000000000"):
        command_of(json.dumps(command))


def test_cuts_at_the_coordinate_limits_are_safe(tmp_path):
    session, _ = session_of("paper/d1", tmp_path)
    for end in ([MAX_COORDINATE, MAX_COORDINATE], [-MAX_COORDINATE, 0.0], [0.0, 0.0]):
        with suppress(pbdkit.ExperimentError):
            do(session, do="cut", **{"from": [MAX_COORDINATE, -MAX_COORDINATE], "to": end})
    session.advance(2)
    assert np.isfinite(session.state.u).all()


def test_invalid_messages_are_answered_and_the_session_continues(address):
    with Onlooker(address) as page, Onlooker(address) as other:
        assert page.receive("scene")["count"] == 144
        for nonsense in (
            "",
            "{",
            "[]",
            "\x00",
            '{"do": []}',
            "[" * 4000,
            '{"do": "sing"}',
            b"\xff",
        ):
            page.socket.send(nonsense)
            assert "invalid command" in page.receive("error")["text"]
        other.socket.send("x" * (MAX_COMMAND_BYTES + 1))
        with pytest.raises(ConnectionClosed, match="1009"):
            other.receive("nothing")
        page.do(do="seen")
        page.do(do="step")
        assert len(page.receive("picture")) >= 48 + 8 * 144


def test_page_gets_the_newest_picture_when_it_is_ready(tmp_path):
    session, _ = session_of("paper/a", tmp_path)
    with served(session) as there, Onlooker(there) as page:
        first = page.receive("picture")
        page.do(do="play", on=True)
        time.sleep(0.5)
        page.do(do="seen")
        second = page.receive("picture")
        made = [int.from_bytes(picture[12:16], "little") for picture in (first, second)]
        assert made[1] - made[0] > 5


def test_notebook_exchanges_the_messages_of_a_page(monkeypatch, tmp_path):
    sent = []
    monkeypatch.setattr(
        LiveWidget, "send", lambda self, message, buffers=None: sent.append((message, buffers))
    )
    widget = pbdkit.live("paper/a", output=tmp_path / "made.yaml")
    assert "class LatticeView" in widget._esm
    assert "export default { render }" in widget._esm
    assert "import " not in re.sub(r"//.*|/\*.*?\*/", "", widget._esm, flags=re.S)
    hear = widget._handle_custom_msg

    def wait(kind):
        until(lambda: any(one[0]["is"] == kind for one in sent))
        return next(one for one in reversed(sent) if one[0]["is"] == kind)

    hear({"do": "join"}, [])
    assert wait("scene")[0]["name"] == "paper/a"
    assert len(wait("picture")[1][0]) == 48 + 8 * 144 + 144 + len(widget.session.camera.bonds)
    hear({"do": "step", "count": 3}, [])
    until(lambda: widget.session.step == 3)
    hear({"do": "save"}, [])
    wait("saved")
    hear({"do": "nonsense"}, [])
    assert "invalid command" in wait("error")[0]["text"]
    widget.close()
    assert widget.session.step == 3


CELL = """async ([esm, messages, picture]) => {
  const address = URL.createObjectURL(new Blob([esm], { type: 'text/javascript' }));
  const { default: widget } = await import(address);
  const el = document.body.appendChild(document.createElement('div'));
  let hear;
  const asked = [];
  const send = (message) => asked.push(message.do);
  const model = { on: (name, act) => { hear = act; }, off: () => {}, send };
  const close = widget.render({ model, el });
  el.firstChild.style.height = '300px';
  for (const message of messages) hear(message, []);
  hear({ is: 'picture' }, [new DataView(Uint8Array.from(picture).buffer)]);
  await new Promise((done) => setTimeout(done, 300));
  const step = el.querySelector('.step').textContent;
  close();
  return [asked, step, el.childElementCount];
}"""


def test_notebook_module_shows_a_body_and_is_removed(page, tmp_path):
    session, _ = session_of("paper/a", tmp_path)
    session.advance(7)
    messages = json.loads(json.dumps([static_message(session), status_message(session)]))
    picture = list(session.frame().encoded(None))
    found = page.evaluate(CELL, [LiveWidget._esm, messages, picture])
    assert found == [["join", "seen"], "step 7", 0]


def test_missing_requirement_is_reported_with_the_remedy(monkeypatch):
    monkeypatch.setattr("pbdkit.errors.find_spec", lambda name: None)
    for call in (lambda: pbdkit.live("paper/a"), lambda: live.main(["paper/a", "--no-browser"])):
        with pytest.raises(pbdkit.ExperimentError, match=re.escape("pip install 'pbdkit[live]'")):
            call()


PLACE = """row => { const { view } = pbdkitLive;
  return view.toClient(...view.positions.subarray(2 * row, 2 * row + 2)); }"""


def test_page_in_a_browser_drags_changes_cuts_and_saves(page, tmp_path):
    session, _ = session_of("paper/a", tmp_path)
    with served(session) as address:
        page.goto(address)
        until_page(page, "globalThis.pbdkitLive?.received >= 1 && pbdkitLive.step === 0")
        page.get_by_role("button", name="Play").click()
        until_page(page, "pbdkitLive.step > 20")
        row = int(session.stage.scene.leading[0].rows[4])
        leads_to(page, row, by=(60, -40))
        turns(page, "solver.memory", 0.25)
        assert page.locator(".judgement strong").inner_text() == "stable"
        cuts(page)
        page.get_by_role("button", name="Pause").click()
        until_page(page, "!pbdkitLive.running")
        page.get_by_role("button", name="Save as experiment").click()
        until_page(page, "pbdkitLive.said.textContent.includes('made.yaml')")
        with page.expect_download() as download:
            page.get_by_role("link", name="Download").click()
        assert Path(download.value.path()).read_text() == (tmp_path / "made.yaml").read_text()
        page.keyboard.press("Home")
        until_page(page, "pbdkitLive.step === 0")
        page.goto("about:blank")
    steps = pbdkit.load(tmp_path / "made.yaml").steps
    session.rewind(steps)
    assert session.step == steps
    assert_same(session.state, run_of(tmp_path / "made.yaml"))


def test_page_on_a_phone_shows_the_body_above_the_controls(page, tmp_path):
    page.set_viewport_size({"width": 390, "height": 844})
    session, _ = session_of("paper/d1", tmp_path)
    with served(session) as address:
        page.goto(address)
        until_page(page, "globalThis.pbdkitLive?.received >= 1 && pbdkitLive.step === 0")
        assert page.evaluate("pbdkitLive.canvas.clientWidth") == 390
        page.get_by_label("Colour").select_option("strain_xx")
        page.get_by_role("button", name="Step", exact=True).click()
        until_page(page, "pbdkitLive.step === 1 && pbdkitLive.picture.values")
        until_page(page, "document.querySelector('.means')?.textContent.startsWith('small strain')")
        assert page.evaluate("document.documentElement.scrollWidth") == 390
        page.evaluate("scrollTo(0, 0)")
        inside = f"""row => {{ const [x, y] = ({PLACE})(row);
          return x > 0 && x < 390 && y > 0 && y < 844 * 0.55; }}"""
        assert all(page.evaluate(inside, row) for row in (0, 60))
        page.evaluate("pbdkitLive.view.pan(600, 0)")
        assert not page.evaluate(inside, 60)
        page.get_by_role("button", name="Fit view").click()
        until_page(page, f"({inside})(60)")
        follower = int(np.flatnonzero(session.frame().kinds == FOLLOWER)[20])
        page.mouse.move(*page.evaluate(PLACE, follower))
        assert page.evaluate("pbdkitLive.view.selected.particle") == follower
        page.mouse.down()
        until(lambda: session.grabbed is not None)
        assert session.grabbed.row == follower
        page.mouse.up()
        page.mouse.move(3, 3)
        assert page.evaluate("pbdkitLive.view.selected.particle") == -1
        page.goto("about:blank")


def leads_to(page, row, by):
    x, y = page.evaluate(PLACE, row)
    page.mouse.move(x, y)
    assert page.evaluate("pbdkitLive.root.dataset.over") == "leader"
    page.mouse.down()
    page.mouse.move(x + by[0], y + by[1], steps=6)
    close = f"""() => {{ const at = ({PLACE})({row});
      return Math.hypot(at[0] - {x + by[0]}, at[1] - {y + by[1]}) < 1; }}"""
    until_page(page, close)
    page.mouse.up()


def turns(page, name, value):
    page.get_by_role("slider", name=name, exact=True).evaluate(
        "(slider, value) => { slider.value = value; slider.dispatchEvent(new Event('input')); }",
        value,
    )
    until_page(page, f"Math.abs(pbdkitLive.now.numbers['{name}'] - {value}) < 1e-9")
    until_page(page, "pbdkitLive.word.textContent !== '…'")


def cuts(page):
    page.get_by_role("button", name="Cut").click()
    ends = [page.evaluate(PLACE, row) for row in (64, 91)]
    page.mouse.move(*ends[0])
    page.mouse.down()
    page.mouse.move(*ends[1], steps=3)
    page.mouse.up()
    until_page(page, "pbdkitLive.view.broken.some((bit) => bit === 1)")
