"""Several processes find the equilibrium of one, bit for bit, on grids that they share."""

import json
import re
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, strategies as st
from property_cases import HOLD_LEFT, pull_right
from scene_strategies import in_turn, samples
from thread_ranks import on_ranks
from turning_frame import Turning

import pbdkit
from pbdkit.equilibrium import multigrid as parted_grids
from pbdkit.equilibrium.lattice_system import LatticeSystem
from pbdkit.equilibrium.system import StagnationError
from pbdkit.mpi.driver import deep_subdomains, strip_of
from pbdkit.progress import Watch
from pbdkit.restart import resumption
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import Execution
from tests.equilibrium.test_multigrid import Skew
from tests.mpi.test_distributed_run import (
    assert_same,
    on,
    stopping_after,
    written,
)

pytest.importorskip("numba")
MULTIGRID = {"type": "equilibrium", "method": "multigrid"}
EIGHT = {"type": "chebyshev", "shells": 1}
ELASTIC = {"type": "elastic", "poisson_ratio": 0.3}


@pytest.fixture(autouse=True)
def share_small_grids(monkeypatch):
    """So that grids of some hundred particles are parted."""
    monkeypatch.setattr(parted_grids, "SMALL", 900)


def strip(**parts):
    """Return a strip of 260 rows, of which two grids are divided."""
    return {
        "name": "strip",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "grid", "columns": 260, "rows": 12},
        "neighbours": EIGHT,
        "rule": ELASTIC,
        "frame": {"type": "natural"},
        "leaders": [HOLD_LEFT, pull_right(0.3, 0.1)],
        "steps": 1,
        "diagnostics": [{"type": "displacement"}, {"type": "strain"}],
        "solver": MULTIGRID,
    } | parts


BARYCENTRE = {"rule": {"type": "barycentre"}}
FOUR = {"type": "coordination", "shells": 1}
DISC = {"type": "disc", "radius": 4.0}
UP = {"type": "displace", "displacement": [0.1, 0.4]}
INSIDE = [
    HOLD_LEFT,
    {"select": {"box": [20.5, 3.5, 60.0, 5.0]}, "motion": UP},
    {"select": {"edge": "bottom"}, "motion": {"type": "hold"}, "axes": ["y"]},
    {"select": {"box": [129.5, 5.5, 132.0, 8.0]}, "motion": UP, "axes": ["x"]},
]
CASES = {
    "elastic": {},
    "nearly incompressible": {"rule": ELASTIC | {"poisson_ratio": 0.45}},
    "stiffer along": {"lattice": {"type": "rectangular", "a": 1.0, "b": 3.0}},
    "stiffer across": {"lattice": {"type": "rectangular", "a": 3.0, "b": 1.0}},
    "barycentre": BARYCENTRE | {"frame": {"type": "mean"}, "neighbours": FOUR},
    "rows to balance": BARYCENTRE | {"frame": {"type": "none"}},
    "oblique": {
        "lattice": {"type": "oblique", "a": 1.0, "b": 0.9, "angle": 65.0},
        "rule": {"type": "mean-displacement"},
        "frame": {"type": "first"},
    },
    "mirror": {"frame": {"type": "mirror"}},
    "not symmetric": {"rule": Skew(), "frame": {"type": "none"}},
    "leaders inside and guided": {"leaders": INSIDE},
    "loads": {
        "leaders": [HOLD_LEFT],
        "loads": [{"select": {"edge": "right"}, "force": [0.01, 0.02]}],
    },
    "released on the way": {
        "leaders": [HOLD_LEFT, pull_right(0.3, 0.1) | {"until": 9}],
        "steps": 40,
        "record": {"every": 7},
    },
    "a noisy start": {"initial": {"type": "noise", "amplitude": 0.1}},
    "a field": {
        "regions": {"inner": {"type": "disc", "centre": [99.0, 3.0], "radius": 5.0}},
        "rule": ELASTIC | {"stiffness": {"otherwise": 1.0, "inner": 5.0}},
    },
    "a course": {
        "rule": ELASTIC | {"stiffness": {"steps": [0, 4], "values": [1.0, 0.5]}},
        "steps": 4,
    },
}


@pytest.mark.parametrize("name", in_turn(CASES, 3))
def test_several_processes_agree_with_one(name, tmp_path):
    given_ = strip(**CASES[name])
    compare(given_, tmp_path, 3)


def compare(given_, folder, size):
    one, several = folder / "one.nc", folder / "several.nc"
    alone = written(given_, one)
    assert alone.status == "complete"
    found = on_ranks(size, lambda ranks: written(given_, several, ranks))
    assert found == [alone] * size
    assert_same(one, several)


RING = {"type": "ring", "inner": 9.0, "outer": 24.4, "centre": [0.0, 0.0]}
ENDS = [
    {"select": {"box": [-25.0, -25.0, -20.0, 25.0]}, "motion": {"type": "hold"}},
    {"select": {"box": [20.0, -25.0, 25.0, 25.0]}, "motion": UP},
]
SHAPES = {
    "a hole and uneven cuts": (strip(body=RING, leaders=ENDS), 4),
    "more processes than rows of the coarsest shared grid": (
        strip(body={"type": "grid", "columns": 30, "rows": 70}),
        7,
    ),
    "a grid that is not worth sharing": (strip(body={"type": "grid", "columns": 9, "rows": 8}), 4),
    "frame points that are large at the start alone": (
        strip(
            body={"type": "grid", "columns": 56, "rows": 3},
            rule=ELASTIC | {"poisson_ratio": -0.4},
            frame={"type": "mirror"},
            leaders=[HOLD_LEFT],
            initial={"type": "noise", "amplitude": 0.1},
        ),
        2,
    ),
    "a part where nobody follows": (
        strip(leaders=[{"select": {"box": [0, 0, 129, 12]}, "motion": UP}, pull_right(0.3, 0.1)]),
        3,
    ),
}


@pytest.mark.parametrize("name", in_turn(SHAPES, 2))
def test_partitions_of_every_shape(name, tmp_path):
    given_, size = SHAPES[name]
    compare(given_, tmp_path, size)


SENT_BACK = re.compile("run it in one process$|too few for")


def solution_and_bound(path):
    found = pbdkit.open(path)
    return found.u.values[-1], json.loads(found.attrs["certificate"])


def test_error_bound_holds(tmp_path):
    """The result by factors of a matrix is more accurate."""
    given_ = strip(body=RING, leaders=ENDS)
    exact = {"type": "equilibrium", "method": "lu", "tolerance": 1e-11}
    written(given_ | {"solver": exact}, tmp_path / "exact.nc")
    grids = {"type": "equilibrium", "method": "multigrid"}
    sought, path = given_ | {"solver": grids}, tmp_path / "several.nc"
    outcomes = on_ranks(2, lambda ranks: written(sought, path, ranks))
    (right, _), (u, error_bound) = (
        solution_and_bound(tmp_path / "exact.nc"),
        solution_and_bound(path),
    )
    assert {one.status for one in outcomes} == {"complete"}
    assert error_bound["method"] == "multigrid, conjugate-gradients"
    assert np.hypot(*(u - right).T).max() <= error_bound["distance"] <= 1e-8


BREAKING = {"type": "threshold", "thresholds": [1.9]}
REFUSED = {
    "an equilibrium with breaking bonds": {"fracture": BREAKING},
    "an equilibrium before obstacles": {
        "obstacles": [{"shape": DISC | {"centre": [99.0, 17.0]}, "motion": {"type": "hold"}}]
    },
    "the equilibrium of rule 'springs', which is not linear": {"rule": {"type": "springs"}},
    "the equilibrium of rule 'strain-gradient', which applies twice": {
        "rule": {"type": "strain-gradient", "poisson_ratio": 0.3, "length": 0.5}
    },
    "an equilibrium on a lattice with several sites per cell": {
        "lattice": {"type": "hexagonal", "a": 1.0},
        "neighbours": FOUR,
    },
    "an equilibrium with neighbours beyond": BARYCENTRE
    | {"neighbours": {"type": "chebyshev", "shells": 2}, "frame": {"type": "none"}},
    "an equilibrium by method 'lu'": {"solver": MULTIGRID | {"method": "lu"}},
    "leaders must constrain the whole body": {"leaders": []},
    "frame points must follow nearby particles": {"frame": Turning()},
    "axes must be mutual or absent": {
        "rule": {"type": "mixed-coordinate", "K": -0.004},
        "frame": {"type": "mean"},
    },
}


@pytest.mark.parametrize("text", REFUSED)
def test_undistributed_features_are_refused_in_one_message(text, tmp_path):
    given_ = strip(**REFUSED[text])
    refused = on_ranks(2, lambda ranks: ended(given_, tmp_path / "out.nc", ranks))
    assert refused[0] == refused[1]
    assert text in refused[0]
    assert refused[0].endswith("run it in one process")
    assert not (tmp_path / "out.nc").exists()


def test_stalled_iteration_recommends_one_process(tmp_path, monkeypatch):
    def stuck(*given):
        raise StagnationError

    monkeypatch.setattr(LatticeSystem, "solve", stuck)
    refused = on_ranks(2, lambda ranks: ended(strip(), tmp_path / "out.nc", ranks))
    assert refused[0] == refused[1]
    assert refused[0].startswith("solver: the distributed iteration does not converge")


one_of = st.sampled_from
RULES = [
    {"rule": ELASTIC, "frame": {"type": "natural"}},
    {"rule": ELASTIC | {"poisson_ratio": -0.4}, "frame": {"type": "mirror"}},
    {"rule": {"type": "barycentre"}, "frame": {"type": "none"}},
    {"rule": {"type": "barycentre"}, "neighbours": FOUR, "frame": {"type": "first"}},
    {"rule": {"type": "mean-displacement"}, "frame": {"type": "mean"}},
]
LATTICES = [
    {"type": "square", "a": 0.7},
    {"type": "rectangular", "a": 1.0, "b": 1.9},
    {"type": "rectangular", "a": 2.1, "b": 0.6},
]
spots = st.tuples(st.floats(1.0, 90.0), st.floats(0.0, 6.0), st.floats(0.0, 60.0))
inner_leaders = st.builds(
    lambda spot, axes: (
        {
            "select": {"box": [spot[0], spot[1], spot[0] + spot[2], spot[1] + 1.5]},
            "motion": UP,
        }
        | axes
    ),
    spots,
    one_of([{}, {"axes": ["x"]}, {"axes": ["y"]}]),
)
bodies = st.builds(
    lambda columns, rows: {"type": "grid", "columns": columns, "rows": rows},
    st.integers(20, 260),
    one_of([3, 8, 14]),
)
starts = one_of([{}, {"initial": {"type": "noise", "amplitude": 0.1}}])


@samples(6)
@given(
    bodies,
    one_of(LATTICES),
    one_of(RULES),
    st.lists(inner_leaders, max_size=1),
    starts,
    st.integers(2, 5),
)
def test_random_scenes(tmp_path_factory, body, lattice, rule, inner, start, size):
    leaders = [HOLD_LEFT, *inner]
    given_ = strip(body=body, lattice=lattice, leaders=leaders, **start | rule)
    folder = tmp_path_factory.mktemp("ranks")
    one, several = folder / "one.nc", folder / "several.nc"
    found = on_ranks(size, lambda ranks: ended(given_, several, ranks))
    assert all(each == found[0] for each in found)
    if SENT_BACK.search(str(found[0])):
        return
    assert found[0] == ended(given_, one)
    if not isinstance(found[0], str):
        assert_same(one, several)


def ended(given_, path, processes=None):
    """An outcome, or in which words it was refused."""
    try:
        return written(given_, path, processes)
    except pbdkit.PbdkitError as error:
        return str(error)


def test_strips_divide_every_grid():
    """The parts have no gaps; each process has its own rows there, and some around them."""
    scene = build_scene(pbdkit.Experiment.model_validate(strip()))
    for parts in (2, 3, 5, 9):
        strips = [strip_of(scene, own, parts) for own in deep_subdomains(scene, parts)]
        while True:
            assert [s.begin for s in strips[1:]] == [s.end for s in strips[:-1]]
            assert (strips[0].begin, strips[-1].end) == (0, strips[0].count)
            for s in strips:
                assert s.first <= max(0, s.begin - 2)
                assert s.last >= min(s.count, s.end + 2)
            if not strips[0].depth:
                break
            strips = [s.coarser(1) for s in strips]


@pytest.mark.parametrize("sizes", in_turn([(3, 2), (2, 1), (1, 3)], 3))
def test_interrupted_and_resumed_on_another_number_of_processes(sizes, tmp_path):
    given_ = strip(**CASES["released on the way"])
    one, several = tmp_path / "one.nc", tmp_path / "several.nc"
    written(given_, one)

    def begin(ranks):
        return written(given_, several, ranks, stopping_after(3)).status

    def resume(ranks):
        return resumption(several, Watch(), execution=ranks).record().outcome.status

    assert set(on(sizes[0], begin)) == {"interrupted"}
    assert set(on(sizes[1], resume)) == {"complete"}
    assert_same(one, several)


def test_no_process_stores_the_whole_body(monkeypatch):
    """Three processes together take about as much as one, not three times as much. Each evaluates
    moves in blocks of a constant size, which one process needs once."""
    monkeypatch.setattr(parted_grids, "SMALL", 20_000)
    body = {"type": "grid", "columns": 900, "rows": 130}
    scene = build_scene(pbdkit.Experiment.model_validate(strip(body=body, diagnostics=[])))

    def steps(processes):
        return [state.step for state in processes.run(scene, Watch())]

    def peak(work):
        tracemalloc.start()
        try:
            assert work()
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    steps(Execution())  # caches are filled, and counted for neither
    alone = peak(lambda: steps(Execution()))
    assert peak(lambda: on_ranks(3, steps)) < 1.8 * alone
