"""Quasi-static tests: an equilibrium at every recorded step, increments of load, separation."""

import json
import math
import re
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from reliability.dogbones import faults_of, run, specimen, strains
from scene_strategies import AT_LENGTH, in_turn

import pbdkit
from pbdkit.equilibrium import breaking_kernel, newton
from pbdkit.io.netcdf import NetcdfSink
from pbdkit.progress import Watch
from pbdkit.restart import resumption
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import Simulation, record

VELOCITY, STEPS = 0.02, 30
HELD = {"select": {"edge": "left"}, "motion": {"type": "hold"}}
PULL = {"type": "velocity", "velocity": [VELOCITY, 0.0], "steps": STEPS}
PULLED = {"select": {"edge": "right"}, "motion": PULL}
BAR = {
    "version": 1,
    "name": "bar",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "grid", "columns": 8, "rows": 4},
    "neighbours": {"type": "coordination", "shells": 2},
    "rule": {"type": "elastic", "poisson_ratio": 0.3},
    "frame": {"type": "natural"},
    "leaders": [HELD, PULLED],
    "steps": STEPS,
    "solver": {"type": "equilibrium"},
    "diagnostics": [
        {"type": "displacement"},
        {"type": "reaction", "youngs_modulus": 1.0},
        {"type": "track", "numbers": [9]},
    ],
}
FRACTURE = {"fracture": {"type": "strain", "failure": 0.05}}
RISES = {"steps": [0, 10], "values": [0.0, 0.5]}
LOADED = {
    "leaders": [HELD],
    "steps": 10,
    "loads": [
        {"select": {"edge": "right"}, "force": [{"steps": [0, 10], "values": [0.0, 0.5]}, 0.0]}
    ],
}


def ran(*parts):
    given = BAR
    for part in parts:
        given = given | part
    return pbdkit.run(given, progress=False)


def came_apart(*parts):
    with pytest.raises(pbdkit.DivergedError) as caught:
        ran(*parts)
    return caught.value.dataset


def refuse_overstretched(ds, failure):
    """Every bond of every recorded state that is above its limit is broken."""
    for n, moment in enumerate(ds.time.values):
        broken = (ds.broken_step.values >= 0) & (ds.broken_step.values <= np.ceil(moment))
        assert (strains(ds, n)[~broken] <= failure * (1 + 1e-9)).all(), moment


def test_each_recorded_step_of_a_pull_is_an_equilibrium():
    ds = ran()
    steps = np.arange(STEPS + 1)
    np.testing.assert_array_equal(ds.time, steps)
    assert ds.time.dtype == ds.step.dtype == np.int64
    led = ds.kind.isel(time=0).values == 0
    right = led & (ds.reference.isel(axis=0) == 7.0)
    np.testing.assert_allclose(
        ds.u.values[:, right.values, 0], np.outer(VELOCITY * steps, np.ones(4)), rtol=1e-14
    )
    force = ds.reaction.values[:, 1, 0]
    np.testing.assert_allclose(force, force[-1] * steps / STEPS, atol=1e-12)
    np.testing.assert_allclose(
        ds.track.values.squeeze(), ds.position.sel(particle=9).values, atol=1e-15
    )


SCENES = {
    "pull": {},
    "force from a step until another": LOADED
    | {"loads": [{"select": {"edge": "right"}, "force": [0.01, 0.0], "from": 3, "until": 6}]},
    "force that grows": LOADED,
    "rule that changes": {
        "rule": {"type": "elastic", "poisson_ratio": 0.3, "stiffness": 1.0},
        "steps": 8,
        "solver": {"type": "equilibrium"},
        "leaders": [HELD, PULLED | {"from": 2, "until": 5}],
    },
    "course of a number": {
        "rule": {"type": "mixed-coordinate", "K": {"steps": [0, 8], "values": [0.0, -0.02]}},
        "frame": {"type": "mean"},
        "diagnostics": [{"type": "displacement"}],
        "steps": 8,
    },
    "springs": {"rule": {"type": "springs"}, "steps": 6},
    "obstacle that moves": {
        "leaders": [HELD],
        "steps": 6,
        "obstacles": [
            {
                "shape": {"type": "disc", "radius": 2.0, "centre": [4.0, 5.5]},
                "motion": {"type": "velocity", "velocity": [0.0, -0.1], "steps": 5},
            }
        ],
    },
    "cut": {
        "cuts": [{"from": [3.5, -0.5], "to": [3.5, 1.5], "at": 3}],
        "steps": 6,
        "solver": {"type": "equilibrium", "increments": 6},
    },
}


@pytest.mark.parametrize("parts", SCENES.values(), ids=SCENES)
def test_each_recorded_step_equals_the_equilibrium_of_as_many_steps(parts):
    """With the roles, loads, numbers, cuts and obstacles of that step."""
    whole = ran(parts)
    assert len(whole.time) == whole.time[-1] + 1
    for step in range(1 + 2 * ("cuts" in parts), len(whole.time), 2):
        alone = ran(parts, {"steps": step, "record": {"at": [step]}})
        np.testing.assert_allclose(whole.u[step], alone.u[-1], rtol=0, atol=2e-7)
        np.testing.assert_array_equal(whole.kind[step], alone.kind[-1])


def test_recording_changes_no_result():
    whole, some = ran(), ran({"record": {"at": [7, 12]}})
    np.testing.assert_array_equal(some.time, [0, 7, 12, STEPS])
    np.testing.assert_array_equal(some.u, whole.u.sel(time=some.time))
    assert some.attrs["certificate"] == whole.attrs["certificate"]


def test_linear_body_is_factorised_once_while_roles_are_unchanged(monkeypatch):
    made, linearised = [], newton.linearised
    monkeypatch.setattr(
        newton, "linearised", lambda *given: made.append(given[2]) or linearised(*given)
    )
    ran()
    assert made == [1]
    made.clear()
    ran({"leaders": [HELD, PULLED | {"until": 12}]})
    assert made == [1, 13]


def test_increments_are_recorded_with_fractional_steps_on_request():
    parts = FRACTURE | {"steps": 4, "solver": {"type": "equilibrium", "increments": 8}}
    course = {"leaders": [HELD, PULLED | {"from": 3}]}
    plain, fine = (ran(parts, course, {"record": {"increments": i}}) for i in (False, True))
    assert plain.time.dtype == np.int64
    assert fine.time.dtype == fine.step.dtype == np.float64
    np.testing.assert_array_equal(plain.time, range(5))
    between = fine.time.values % 1.0 > 0.0
    assert between.sum() >= 4
    np.testing.assert_array_equal(fine.u.values[~between], plain.u.values)
    np.testing.assert_allclose(
        fine.reaction.values[:, 1, 0],
        np.interp(fine.time, plain.time, plain.reaction.values[:, 1, 0]),
        atol=1e-9,
    )
    # Within step 3 the group that leads from step 3 on leads.
    leads = (fine.kind == 0).sum("particle").values
    np.testing.assert_array_equal(leads, np.where(fine.time > 2.0, 8, 4))
    narrow = ran(parts, {"record": {"increments": True, "dtype": "float32"}})
    assert narrow.time.dtype == np.float64
    assert narrow.position.dtype == np.float32


def test_increments_are_refused_for_the_stepping_solver():
    with pytest.raises(pbdkit.ExperimentError, match="increments of load exist only for an equil"):
        ran({"record": {"increments": True}, "solver": {"type": "stepping"}})


def test_detached_part_ends_the_run_at_the_last_equilibrium():
    ds = came_apart(LOADED, FRACTURE)
    assert ds.attrs["status"] == "separated"
    assert "certificate" not in ds.attrs
    reason = ds.attrs["stop_reason"]
    assert reason.startswith("the body came apart between step ")
    assert "the bond between particles" in reason
    assert "a part of" in reason
    assert f"the last equilibrium is that of step {ds.time.values[-1]}" in reason
    assert "memory: auto" in reason
    assert 1 < len(ds.time) < 11
    np.testing.assert_allclose(
        -ds.reaction.values[:, 0, 0], 0.05 * ds.time.values, atol=1e-9, err_msg="load"
    )
    refuse_overstretched(ds, 0.05)


def test_records_of_a_separated_run_are_kept_in_its_file(call, tmp_path):
    path, out = tmp_path / "bar.json", tmp_path / "bar.nc"
    path.write_text(json.dumps(BAR | LOADED | FRACTURE))
    ended = call("run", str(path), "-o", str(out))
    assert ended.code == 4
    assert "separated: the body came apart between step" in ended.err
    assert "resume" not in ended.err
    with pbdkit.open(out) as ds:
        assert ds.attrs["status"] == "separated"
        assert len(ds.time) > 1
    refused = call("resume", str(out), "--steps", "20")
    assert refused.code == 2
    assert "has the status separated" in refused.err


def test_refusal_during_a_run_leaves_nothing_to_resume(call, tmp_path, monkeypatch):
    """Resumed, it would be refused again."""
    monkeypatch.setattr(NetcdfSink, "due", lambda self: True)
    push = {"select": {"edge": "right"}, "force": [0.01, 0.0], "from": 5, "until": 8}
    parts = {"leaders": [HELD | {"until": 4}], "loads": [push], "steps": 9}
    path, out = tmp_path / "bar.json", tmp_path / "bar.nc"
    diagnostics = [{"type": "displacement"}]
    path.write_text(json.dumps(BAR | parts | {"diagnostics": diagnostics}))
    ended = call("run", str(path), "-o", str(out))
    assert ended.code == 2
    assert "is loaded, but not constrained" in ended.err
    assert "would fail in the same way" in ended.err
    assert "continues it" not in ended.err


def test_body_broken_into_two_held_halves_has_a_complete_curve():
    """There are equilibria after the fracture: the halves are held, and bear no load."""
    ds = ran(FRACTURE, {"steps": STEPS})
    force = ds.reaction.values[:, 1, 0]
    assert ds.attrs["status"] == "complete"
    peak = int(force.argmax())
    assert 10 < peak < STEPS
    np.testing.assert_allclose(force[: peak + 1], force[1] * np.arange(peak + 1), rtol=1e-6)
    assert abs(force[-1]) < 1e-3 * force[peak]
    refuse_overstretched(ds, 0.05)


@pytest.mark.parametrize("increments", [False, True])
def test_quasi_static_test_in_parts_equals_the_whole(increments, tmp_path):
    """A run that is stopped anywhere continues to the same file; steps after the last event too."""
    given = BAR | FRACTURE | {"steps": STEPS + 5, "record": {"increments": increments}}
    given |= {"solver": {"type": "equilibrium", "increments": 30}}
    whole = ran(given)
    path, scene = tmp_path / "bar.nc", build_scene(pbdkit.Experiment(**given))

    def watch():
        looks = count()
        return Watch(lambda: next(looks) > 12)

    report = record(Simulation.of_scene(scene, watch=watch()), NetcdfSink(path))
    resumed = 0
    while report.outcome.status == "interrupted":
        report, resumed = resumption(path, watch()).record(), resumed + 1
    assert resumed > 1
    with pbdkit.open(path) as ds:
        np.testing.assert_array_equal(ds.time, whole.time)
        np.testing.assert_array_equal(ds.u, whole.u)
        np.testing.assert_array_equal(ds.track, whole.track)
        assert ds.attrs["certificate"] == whole.attrs["certificate"]


def test_separated_members_of_a_sweep_are_kept(call, tmp_path):
    path = tmp_path / "sweep.yaml"
    (tmp_path / "bar.json").write_text(json.dumps(BAR | LOADED | FRACTURE))
    path.write_text(
        "version: 1\nexperiment: bar.json\nvary: {fracture.failure: [0.05, 0.06]}\n"
        "keep: {variables: [reaction]}\n"
    )
    ended = call("sweep", str(path), "-o", str(tmp_path / "out"), "--workers", "1")
    assert ended.code == 0, ended.err
    with pbdkit.open(tmp_path / "out" / "sweep.nc") as ds:
        assert set(ds.status.values.tolist()) == {"separated"}
        assert (ds.reaction.max(("time", "leader_group", "axis")).values >= 0.0).all()


DOGBONES = {
    "hexagonal, elastic, steps": ("hexagonal", "elastic", False),
    "hexagonal, elastic, at once": ("hexagonal", "elastic", True),
    "hexagonal, springs": ("hexagonal", "springs", False),
    "square, springs": ("square", "springs", True),
    "square, orthotropic": ("square", "orthotropic", False),
}


@pytest.mark.parametrize("given", in_turn(DOGBONES.values(), 3), ids=in_turn(DOGBONES, 3))
def test_dogbones_break_without_flying_parts(given):
    """tests/reliability/dogbones.py tries random ones."""
    lattice, rule, once = given
    experiment = specimen(lattice, rule, failure=0.02, once=once)
    ds = run(experiment)
    assert faults_of(experiment, ds) == []
    force = ds.reaction.values[:, 1, 0]
    assert force.max() > 1.5 * abs(force[-1])


def test_part_on_one_bond_does_not_end_the_test():
    """Two bars of springs between grips; the upper one is cut, and its end hangs by one bond."""
    given = BAR | {
        "rule": {"type": "springs"},
        "body": {"type": "grid", "columns": 6, "rows": 2},
        "neighbours": {"type": "coordination", "shells": 2},
        "cuts": [
            {"from": [2.5, -0.5], "to": [2.5, 0.6], "at": 2},
            {"from": [1.4, 0.5], "to": [2.6, 0.5], "at": 2},
            {"from": [1.5, -0.5], "to": [1.5, 0.2], "at": 0},
        ],
        "steps": 6,
        "solver": {"type": "equilibrium", "increments": 6},
        "diagnostics": [{"type": "displacement"}, {"type": "reaction", "youngs_modulus": 1.0}],
    }
    ds = pbdkit.run(given, progress=False)
    assert ds.attrs["status"] == "complete"
    assert len(ds.time) == 7


def test_shipped_dogbone_has_the_documented_strength(monkeypatch):
    if not AT_LENGTH:  # numpy is done before its kernel is compiled
        monkeypatch.setattr(breaking_kernel, "COMPILING_S", math.inf)
    hexagonal = "lattice={type: hexagonal, a: 1.0}", "neighbours={type: coordination, shells: 1}"
    ds = pbdkit.run(pbdkit.load("modelling/dogbone-to-failure", settings=hexagonal), progress=False)
    force = ds.reaction.values[:, 1, 0]
    assert force.argmax() == 20
    assert force.max() == pytest.approx(1601.0, abs=1.0)
    assert abs(force[21:]).max() < 1e-6
    refuse_overstretched(ds, 0.02)


def test_equilibria_within_a_step_are_plotted_and_explained(call, tmp_path):
    given = specimen("square", "elastic", failure=0.02, once=True)
    Path("dogbone.json").write_text(json.dumps(given))
    assert call("run", "dogbone.json", "-o", "dogbone.nc").code == 0
    with pbdkit.open("dogbone.nc") as ds:
        moment = float(f"{ds.time.values[3]:.6g}")
        strain = np.where(ds.broken_step.values < 0, strains(ds, 5), 0.0)
        a, b = map(str, ds.bond_ends.values[strain.argmax()].tolist())
    assert moment % 1.0 > 0.0
    assert call("plot", "dogbone.nc", "--time", str(moment), "-o", "plot.png").code == 0
    refused = call("plot", "dogbone.nc", "--time", "0.33", "-o", "other.png")
    assert "step 0.33 was not recorded; the nearest recorded: 0." in refused.err
    assert call("curve", "dogbone.nc", "load-displacement", "-o", "curve.png").code == 0
    explained = call("explain", "dogbone.nc", "--bond", a, b).out
    assert re.search(r"largest strain in a recorded step: .*, in step 0\.", explained)


def test_a_particle_can_hang_by_bonds_along_one_axis(monkeypatch):
    """With random strengths, the last bonds of a particle can couple one of its components to the
    clamped part and leave the other one free."""
    monkeypatch.setattr(breaking_kernel, "COMPILING_S", math.inf)
    settings = "fracture.scatter=0.1", "seed=2", "steps=24"
    ds = pbdkit.run(pbdkit.load("modelling/dogbone-to-failure", settings=settings), progress=False)
    assert ds.attrs["status"] == "complete"
    force = np.abs(ds.reaction.values[:, 1, 0])
    assert force.max() > 1000.0
    assert force[-1] < 1e-6 * force.max()
