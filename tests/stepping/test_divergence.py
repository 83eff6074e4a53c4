"""A run that leaves all bounds is stopped soon, and what was recorded before is kept."""

from typing import Literal

import numpy as np
import pytest

import pbdkit
from pbdkit.io.sinks import MemorySink
from pbdkit.progress import Watch
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import Simulation, record
from pbdkit.stepping import divergence as guard
from pbdkit.stepping.divergence import EVERY, Guard
from pbdkit.stepping.state import initial_state

# A warning before the first step reports that these runs can diverge; here they do.
pytestmark = pytest.mark.filterwarnings("ignore:solver.relaxation. .* can diverge")

BLOWN = {
    "name": "blown",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "grid", "columns": 8, "rows": 6},
    "rule": {"type": "barycentre"},
    "leaders": [
        {"select": {"edge": "left"}, "motion": {"type": "hold"}},
        {"select": {"edge": "right"}, "motion": {"type": "displace", "displacement": [0.1, 0.0]}},
    ],
    "initial": {"type": "noise", "amplitude": 0.01},
    "steps": 5000,
}


@pytest.mark.parametrize(("engine", "every"), [("numpy", 1), ("compiled", 7), ("numpy", 5000)])
def test_diverging_run_is_stopped_within_100_steps_or_a_record(engine, every, compiled_at_length):
    solver = {"type": "stepping", "relaxation": 1.5, "engine": engine}
    given = BLOWN | {"solver": solver, "record": {"every": every}}
    with pytest.raises(pbdkit.DivergedError, match=r"particle \d+, found at step (\d+)") as caught:
        pbdkit.run(given, progress=False)
    ds = caught.value.dataset
    found = int(str(caught.value).split("step ")[1].split(",")[0])
    # Some 14 doublings of 1.9 a step pass a million times the size within two looks.
    assert found <= 2 * EVERY
    assert ds.attrs["status"] == "diverged"
    assert ds.attrs["stop_reason"] == str(caught.value)
    assert abs(ds.position).max() < 1e8
    assert int(ds.time[-1]) < found
    assert np.diff(ds.time).max(initial=0) <= every


def test_far_moving_leaders_are_no_divergence():
    far = {"type": "displace", "displacement": [1e12, 0.0]}
    leaders = [BLOWN["leaders"][0], {"select": {"edge": "right"}, "motion": far}]
    ds = pbdkit.run(BLOWN | {"leaders": leaders, "steps": 300}, progress=False)
    assert ds.attrs["status"] == "complete"


class Poisoned(pbdkit.FollowerRule):
    type: str = "poisoned"

    @staticmethod
    def gather(d, r, w, p):
        return (d,)

    @staticmethod
    def apply(total, here, p):
        x, y = total[0] / 4
        return pbdkit.plugin.Vector(x + 0.0 * np.log(-4 * x - 1e-9), y)


@pytest.mark.parametrize("every", [1, 5000])
def test_nan_is_detected(every):
    given = BLOWN | {"rule": Poisoned(type="poisoned"), "record": {"every": every}}
    with pytest.raises(pbdkit.DivergedError, match="under rule 'poisoned'") as caught:
        pbdkit.run(given, progress=False)
    assert np.isfinite(caught.value.dataset.position).all()


@pytest.mark.filterwarnings("ignore:leaders. the experiment has neither")
def test_a_far_start_and_a_released_leader_are_no_divergence():
    start = {"type": "affine", "gradient": [[0.0, 0.0], [0.0, 0.0]], "shift": [1e9, 0.0]}
    far = {"type": "displace", "displacement": [1e9, 0.0]}
    released = [{"select": {"edge": "right"}, "motion": far, "until": 4}]
    for parts in ({"initial": start, "leaders": []}, {"leaders": released}):
        ds = pbdkit.run(BLOWN | parts | {"steps": 250}, progress=False)
        assert ds.attrs["status"] == "complete"


def test_groups_contradictory_at_their_current_position_are_refused():
    start = {"type": "affine", "gradient": [[0.0, 0.0], [0.0, 0.0]], "shift": [1.0, 0.0]}
    turn = {"type": "rotation", "centre": [0.0, 0.0], "angle": 5.0, "steps": 3}
    one = {"numbers": [10]}
    leaders = [{"select": one, "motion": turn}, {"select": one, "motion": {"type": "hold"}}]
    with pytest.raises(pbdkit.ExperimentError, match="move particle 10 differently in step 1"):
        pbdkit.run(BLOWN | {"initial": start, "leaders": leaders}, progress=False)
    leaders[0]["motion"] = turn | {"centre": [1.0, 0.0]}  # where number 10 stands: it does not move
    ds = pbdkit.run(BLOWN | {"initial": start, "leaders": leaders, "steps": 5}, progress=False)
    assert ds.attrs["status"] == "complete"


def diverged(**parts):
    with pytest.raises(pbdkit.DivergedError) as caught:
        pbdkit.run(BLOWN | parts, progress=False)
    return caught.value.dataset


@pytest.mark.parametrize("engine", ["numpy", "compiled"])
@pytest.mark.parametrize(
    ("growth", "kept_every"), [(1.5, 5000), (1.07, 100)], ids=["from the start", "from a copy"]
)
def test_last_good_state_of_a_diverging_run_is_kept(
    engine, growth, kept_every, monkeypatch, compiled_at_length
):
    """From the start again where the guard has copied no state yet."""
    begun = []
    monkeypatch.setattr(guard, "COPY_INTERVAL", kept_every)
    monkeypatch.setattr(guard, "initial_state", lambda s: begun.append(s) or initial_state(s))
    crack = [[2.5, -1.0], [2.5, 1.5]]
    parts = {
        "body": {"type": "grid", "columns": 8, "rows": 3},
        "initial": {"type": "noise", "amplitude": 1e-9},
        "fracture": {"type": "threshold", "thresholds": [1e12], "cracks": [crack]},
        "diagnostics": [{"type": "displacement"}, {"type": "pe2"}, {"type": "broken"}],
    }
    relaxation = 0.5 * (1 + growth) * pbdkit.analyse(BLOWN | parts).largest_stable_relaxation
    parts["solver"] = {"type": "stepping", "relaxation": relaxation, "engine": engine}
    sparse = diverged(record={"every": 5000}, **parts)
    last = int(sparse.time[-1])
    assert last > (200 if kept_every == 100 else 20)  # a second copy goes over the first
    assert len(begun) == (kept_every > last)
    assert sparse.stop_reason.endswith(
        f"the last recorded state is step {last}, the last in which no displacement exceeds "
        "the size of the body and the paths of its leaders"
    )
    every = diverged(record={"at": [0, last, last + 1]}, **parts).sel(time=slice(0, last + 1))
    for name in ("position", "u", "pe2", "broken_bonds"):
        assert np.array_equal(sparse[name][-1], every[name][1]), name
    sizes = abs(every.u).max(axis=(1, 2))
    assert sizes[1] <= 7 + 1 + 0.1 + 1e-9 < sizes[2]  # the body, a spacing, the way, the noise
    # The bonds across the crack; what tears at 1e12 on the way out of all bounds is no result.
    assert sparse.broken_bonds[-1] == (sparse.broken_step >= 0).sum() > 0
    assert (sparse.broken_step <= 0).all()


def test_no_step_is_repeated_if_every_step_is_recorded(monkeypatch):
    def again(*_):
        raise AssertionError("stepped again")

    monkeypatch.setattr(Guard, "last_good", again)
    ds = diverged(solver={"type": "stepping", "relaxation": 1.5}, record={"every": 1})
    assert int(ds.time[-1]) > 0
    assert "the last recorded state is" not in ds.stop_reason


def test_stop_during_the_search_for_the_last_good_state_keeps_records():
    given = BLOWN | {"solver": {"type": "stepping", "relaxation": 1.5}, "record": {"every": 5000}}
    calls = iter(range(10**6))
    sink = MemorySink()
    scene = build_scene(pbdkit.Experiment(**given))
    # Two calls of a hundred steps at most blow up; from the third on a stop is requested.
    report = record(Simulation.of_scene(scene, watch=Watch(lambda: next(calls) >= 2)), sink)
    assert report.outcome.status == "diverged"
    assert sink.dataset().time.values.tolist() == [0]


class Vanishing(pbdkit.Diagnostic):
    type: Literal["vanishing"] = "vanishing"

    def variables(self):
        return (pbdkit.plugin.Variable("vanishing", (), "a number at the start alone", "1"),)

    def measure(self, now):
        return (np.inf if now.step else 0.0,)


def test_state_with_a_diagnostic_that_is_not_finite_is_not_kept():
    solver = {"type": "stepping", "relaxation": 1.5}
    ds = diverged(diagnostics=[Vanishing()], solver=solver, record={"every": 5000})
    assert ds.time.values.tolist() == [0]
    assert "the last recorded state is" not in ds.stop_reason


def test_divergence_with_changing_neighbours_keeps_its_records():
    neighbours = {"type": "euclidean", "radius": 1.5, "reevaluate": True}
    solver = {"type": "stepping", "relaxation": 50.0, "memory": 3.0}
    given = BLOWN | {"neighbours": neighbours, "solver": solver, "record": {"every": 1}}
    with pytest.raises(pbdkit.DivergedError, match=r"particle \d+, found at step \d+") as caught:
        pbdkit.run(given, progress=False)
    kept = caught.value.dataset
    assert kept.attrs["status"] == "diverged"
    assert len(kept.time) > 2
    assert np.isfinite(kept.position).all()
