"""Each of several processes builds the scene of its own rows: what it comes to is cut from the
scene of the whole."""

from dataclasses import fields, is_dataclass
from typing import ClassVar, Literal

import numpy as np
import pytest
from hypothesis import given, strategies as st
from property_cases import HOLD_LEFT, pull_right
from scene_strategies import calibrated_experiments, experiments, samples
from thread_ranks import on_ranks

import pbdkit
from pbdkit.mpi.distributed_run import CUTS
from pbdkit.mpi.partition import part_of
from pbdkit.plugin.frame_policy import FrameMap, FramePolicy
from pbdkit.scene.scene import build_scene
from tests.mpi.test_distributed_run import CASES, OTHERS, assert_same, sheet, written

LEFT_OUT = {
    "experiment",
    "neighbourhood",
    "communicator",
    "row_range",
    "extent",
    "lattice",
    "rule",
    "group",
    "tiling",
}
"""Fields of scenes that both take from the same experiment."""


def assert_alike(one, other, name="part"):
    """Assert that all numbers are equal, down to the last array."""
    if is_dataclass(one):
        assert type(one) is type(other), name
        for field in fields(one):
            if field.name not in LEFT_OUT and field.init:
                own = (getattr(each, field.name) for each in (one, other))
                assert_alike(*own, f"{name}.{field.name}")
    elif isinstance(one, np.ndarray):
        np.testing.assert_array_equal(one, other, err_msg=name, strict=True)
    elif isinstance(one, dict):
        assert one.keys() == other.keys(), name
        for key, value in one.items():
            assert_alike(value, other[key], f"{name}.{key}")
    elif isinstance(one, tuple | list):
        assert len(one) == len(other), name
        for n, (a, b) in enumerate(zip(one, other, strict=True)):
            assert_alike(a, b, f"{name}.{n}")
    else:
        assert repr(one) == repr(other), name


def refused(work):
    try:
        work()
    except pbdkit.ExperimentError as error:
        return str(error)
    return ""


def assert_built_as_cut(given_, size):
    experiment = pbdkit.Experiment.model_validate(given_)
    cut = CUTS[type(experiment.solver)].subdomains
    refusal = refused(lambda: cut(build_scene(experiment), size))
    if refusal:
        assert refused(lambda: on_ranks(size, lambda r: cut(r.scene(experiment), size))) == refusal
        return
    whole = build_scene(experiment)
    parts = cut(whole, size)

    def built(ranks):
        scene = ranks.scene(experiment)
        assert scene.raster.extent is not None
        found = cut(scene, size)
        return found, part_of(scene, found[ranks.communicator.rank]), scene.warnings

    for rank, (found, part, warnings) in enumerate(on_ranks(size, built)):
        assert found == parts
        assert warnings == whole.warnings
        expected = part_of(whole, parts[rank])
        assert_alike(part, expected)
        assert part.scene.raster.total == whole.raster.count
        assert part.scene.raster.whole_shape == whole.raster.shape


local = st.one_of(experiments(), calibrated_experiments())


@samples(40)
@given(local, st.integers(2, 4))
def test_random_scenes(given_, size):
    assert_built_as_cut(given_, size)


@pytest.mark.parametrize("name", [*CASES, *OTHERS])
def test_every_kind_of_scene(name):
    assert_built_as_cut(sheet(**(CASES | OTHERS)[name]), 3)


EQUILIBRIUM = {
    "body": {"type": "disc", "radius": 20.0, "centre": [0.3, 0.2]},
    "neighbours": {"type": "chebyshev", "shells": 1},
    "rule": {"type": "elastic", "poisson_ratio": 0.3},
    "frame": {"type": "natural"},
    "leaders": [HOLD_LEFT, pull_right(0.3, 0.1)],
    "solver": {"type": "equilibrium"},
}


def test_partitions_with_deep_halos():
    assert_built_as_cut(sheet(**EQUILIBRIUM), 2)


def test_selections_find_their_particles_on_any_rank():
    leaders = [
        {"select": select, "motion": {"type": "hold"}}
        for select in (
            {"edge": "left"},
            {"edge": "right"},
            {"edge": "top"},
            {"edge": "bottom"},
            {"nearest": [[0.0, 0.0], [4.5, 2.5], [16.0, 2.0], [90.0, 3.0]]},
            {"numbers": [80, 81, 90]},
            {"box": [3.0, 2.0, 12.0, 4.0]},
        )
    ]
    assert_built_as_cut(sheet(leaders=leaders), 4)


BEYOND = 1 + 2**20
"""Sites at which rounding decides what lies on an outline."""


def test_outlines_far_from_the_origin():
    body = {"type": "rectangle", "width": 30.0, "height": 5.0, "origin": [BEYOND * 0.1, 0.0]}
    lattice = {"type": "square", "a": 0.1, "origin": [0.05, 0.0]}
    leaders = [HOLD_LEFT, pull_right(0.01, 0.0)]
    assert_built_as_cut(sheet(body=body, lattice=lattice, leaders=leaders), 3)


def test_each_frame_point_is_in_a_part():
    given_ = sheet(body={"type": "grid", "columns": 30, "rows": 4}) | {"frame": {"type": "mean"}}
    scene = build_scene(pbdkit.Experiment(**given_))
    subdomains = CUTS[type(scene.experiment.solver)].subdomains(scene, 3)
    frames = [part_of(scene, each).scene.frame for each in subdomains]
    assert sum(len(frame.place) for frame in frames) >= len(scene.frame.place)


def test_each_process_stores_only_its_rows():
    experiment = pbdkit.Experiment.model_validate(
        sheet(body={"type": "grid", "columns": 400, "rows": 3})
    )
    rows = on_ranks(4, lambda ranks: ranks.scene(experiment).raster.shape[1])
    assert max(rows) < 404 / 4 + 2 * 40


def of_the_first(frame):
    every = np.arange(len(frame.site))
    first = frame.body_at(np.array([frame.low], np.int32))
    return FrameMap(every, np.repeat(first, len(every)), np.ones(len(every)))


class Copied(FramePolicy):
    """Follows the body's first particle, wherever that is."""

    type: Literal["copied"] = "copied"

    def depth(self, reach):
        return reach

    def follow(self, frame):
        return of_the_first(frame)


class ClaimsToBeLocal(FramePolicy):
    """And does the same."""

    type: Literal["says-it-is-local"] = "says-it-is-local"

    local: ClassVar[bool] = True

    def depth(self, reach):
        return reach

    def follow(self, frame):
        return of_the_first(frame)


@pytest.mark.parametrize("frame", [Copied(), ClaimsToBeLocal()])
def test_frames_with_distant_particles_are_built_whole_everywhere(frame):
    experiment = pbdkit.Experiment(
        **sheet(body={"type": "grid", "columns": 400, "rows": 3}) | {"frame": frame}
    )
    extents = on_ranks(2, lambda ranks: ranks.scene(experiment).raster.extent)
    assert extents == [None, None]


def bounded(monkeypatch, mib):
    monkeypatch.setattr(
        "pbdkit.scene.memory_estimate.machine_memory", lambda processes=1: mib * 2**20
    )


LARGE = {"body": {"type": "grid", "columns": 300, "rows": 300}, "steps": 8, "record": {"every": 8}}


def test_a_body_larger_than_the_memory_of_one_process_runs_on_several(tmp_path, monkeypatch):
    one, several = tmp_path / "one.nc", tmp_path / "several.nc"
    written(sheet(**LARGE), one)
    bounded(monkeypatch, 11)
    with pytest.raises(pbdkit.ExperimentError, match=r"9.12e\+04 particles need about"):
        written(sheet(**LARGE), tmp_path / "none.nc")
    on_ranks(3, lambda ranks: written(sheet(**LARGE), several, ranks))
    assert_same(one, several)


def test_errors_are_reported_if_the_whole_cannot_be_built(tmp_path, monkeypatch):
    bounded(monkeypatch, 11)
    nobody = {"leaders": [{"select": {"box": [-9, -9, -8, -8]}, "motion": {"type": "hold"}}]}
    with pytest.raises(pbdkit.ExperimentError, match="selects no particle"):
        on_ranks(3, lambda ranks: written(sheet(**LARGE | nobody), tmp_path / "out.nc", ranks))
    bounded(monkeypatch, 6)
    with pytest.raises(
        pbdkit.ExperimentError, match=r"in each process.*start more processes on other"
    ):
        on_ranks(3, lambda ranks: written(sheet(**LARGE), tmp_path / "out.nc", ranks))


def test_a_bug_in_one_process_ends_all(monkeypatch):
    wide = {"type": "grid", "columns": 400, "rows": 3}
    experiment = pbdkit.Experiment.model_validate(sheet(body=wide))
    original = pbdkit.scene.scene.build_leading

    def breaks(raster, given_):
        if raster.particle_offset > 0:
            raise ZeroDivisionError("somewhere")
        return original(raster, given_)

    monkeypatch.setattr("pbdkit.scene.scene.build_leading", breaks)
    found = on_ranks(3, lambda ranks: raised(lambda: ranks.scene(experiment)))
    assert found == [ZeroDivisionError] * 3


def raised(work):
    try:
        work()
    except Exception as error:
        return type(error)
    return None
