"""A run that leaves all bounds is stopped soon, and what was recorded before is kept."""

import numpy as np
import pytest

import pbdkit
from pbdkit.stepping.guard import EVERY

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


@pytest.mark.parametrize("engine", ["numpy", "compiled"])
@pytest.mark.parametrize("every", [1, 7, 5000])
def test_a_run_that_diverges_is_stopped_within_a_hundred_steps_or_a_record(engine, every):
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
        return d.x, d.y

    @staticmethod
    def apply(total, here, p):
        return total[0] / 4 + 0.0 * np.log(-total[0] - 1e-9), total[1] / 4


@pytest.mark.parametrize("every", [1, 5000])
def test_not_a_number_is_found(every):
    given = BLOWN | {"rule": Poisoned(type="poisoned"), "record": {"every": every}}
    with pytest.raises(pbdkit.DivergedError, match="under rule 'poisoned'") as caught:
        pbdkit.run(given, progress=False)
    assert np.isfinite(caught.value.dataset.position).all()


def test_a_far_start_and_a_released_leader_are_no_divergence():
    start = {"type": "affine", "gradient": [[0.0, 0.0], [0.0, 0.0]], "shift": [1e9, 0.0]}
    far = {"type": "displace", "displacement": [1e9, 0.0]}
    released = [{"select": {"edge": "right"}, "motion": far, "until": 4}]
    for parts in ({"initial": start, "leaders": []}, {"leaders": released}):
        ds = pbdkit.run(BLOWN | parts | {"steps": 250}, progress=False)
        assert ds.attrs["status"] == "complete"


def test_groups_that_contradict_each_other_from_where_they_stand_are_refused():
    start = {"type": "affine", "gradient": [[0.0, 0.0], [0.0, 0.0]], "shift": [1.0, 0.0]}
    turn = {"type": "rotation", "centre": [0.0, 0.0], "angle": 5.0, "steps": 3}
    one = {"numbers": [10]}
    leaders = [{"select": one, "motion": turn}, {"select": one, "motion": {"type": "hold"}}]
    with pytest.raises(pbdkit.ExperimentError, match="move particle 10 differently in step 1"):
        pbdkit.run(BLOWN | {"initial": start, "leaders": leaders}, progress=False)
    leaders[0]["motion"] = turn | {"centre": [1.0, 0.0]}  # where number 10 stands: it does not move
    ds = pbdkit.run(BLOWN | {"initial": start, "leaders": leaders, "steps": 5}, progress=False)
    assert ds.attrs["status"] == "complete"
