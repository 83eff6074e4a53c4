"""Branches of equilibria that are followed by a control, beyond the peak of the load."""

import re
from itertools import count

import numpy as np
import pytest

import pbdkit
from pbdkit.equilibrium.branch import follow
from pbdkit.equilibrium.cell_forces import DamagingCells, changed_cells, shapes_of
from pbdkit.errors import DivergedError, ExperimentError
from pbdkit.io.netcdf import NetcdfSink
from pbdkit.model.loading import as_experiment
from pbdkit.progress import Watch
from pbdkit.restart import resumption
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import Simulation, record
from pbdkit.stepping.bond_breaking import Fracturing
from pbdkit.stepping.followers import SlotFollowers
from pbdkit.stepping.state import initial_state

ONSET, ENERGY, LENGTH = 1e-3, 4.5e-6, 30.0
FAILURE = 2.0 * ENERGY / ONSET
ONE = {"youngs_modulus": 1.0, "thickness": 1.0}
HELD = {"select": {"edge": "left"}, "motion": {"type": "hold"}}
PULLED = {
    "select": {"edge": "right"},
    "axes": ["x"],
    "motion": {"type": "displace", "displacement": [0.01, 0.0]},
}
LOAD = {"select": {"edge": "right"}, "force": [1.0, 0.0]}
FORCES = [{"type": "load-displacement", **ONE}, {"type": "strain-energy", **ONE}]
REACTIONS = [{"type": "reaction", **ONE}, {"type": "strain-energy", **ONE}]
BAR = {
    "version": 1,
    "name": "bar",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "rectangle", "width": LENGTH, "height": 1.0},
    "neighbours": {"type": "chebyshev", "shells": 1},
    "rule": {"type": "elastic", "poisson_ratio": 0.0},
    "frame": {"type": "natural"},
    "regions": {
        "weak": {"type": "rectangle", "width": 0.9, "height": 5.0, "origin": [15.05, -2.0]}
    },
    "fracture": {
        "type": "cohesive",
        "onset": {"otherwise": 1.1 * ONSET, "weak": ONSET},
        "energy": ENERGY,
    },
    "leaders": [HELD, PULLED],
    "steps": 20,
    "diagnostics": REACTIONS,
}
STRAIGHT = {
    "select": {"nearest": [[float(x), y] for x in range(1, int(LENGTH)) for y in (0.0, 1.0)]},
    "axes": ["y"],
    "motion": {"type": "hold"},
}
"""A bar that is not held straight can bend where it softens, so that the branch splits."""
NOTCHED = BAR | {
    "body": {"type": "rectangle", "width": 12.0, "height": 6.0},
    "rule": {"type": "elastic", "poisson_ratio": 0.2},
    "regions": {},
    "fracture": {
        "type": "cohesive",
        "onset": ONSET,
        "energy": 6e-6,
        "cracks": [[[5.5, -1.0], [5.5, 2.5]]],
    },
    "leaders": [HELD],
    "loads": [LOAD],
    "steps": 12,
    "diagnostics": FORCES,
}
MOUTH = {"type": "opening", "between": [[5, 0], [6, 0]], "to": 0.036}
CELL = {"type": "opening", "between": [[15, 0], [16, 0]], "to": 0.95 * FAILURE}
DISSIPATED = {"type": "dissipation", "to": 0.9 * ENERGY}


def controlled(experiment, control=None, **changes):
    solver = {"type": "equilibrium"} | ({"control": control} if control else {})
    return experiment | {"solver": solver} | changes


def ran(experiment, control=None, **changes):
    return pbdkit.run(controlled(experiment, control, **changes), progress=False)


def ended(experiment, control=None, **changes):
    with pytest.raises(DivergedError) as caught:
        ran(experiment, control, **changes)
    return caught.value.dataset


def external_work(force, displacement):
    return np.append(0.0, np.cumsum((force[1:] + force[:-1]) / 2 * np.diff(displacement)))


@pytest.fixture(scope="module")
def notched():
    return ran(NOTCHED, MOUTH)


@pytest.mark.parametrize("control", [CELL, DISSIPATED], ids=["opening", "dissipation"])
def test_snap_back_of_a_bar_is_that_of_springs_in_series(control):
    ds = ran(BAR, control, leaders=[HELD, PULLED, STRAIGHT])
    u = (ds.position - ds.reference).sel(axis="x").values
    at = {x: np.isclose(ds.reference.values[:, 0], x) for x in (15.0, 16.0, LENGTH)}
    opening, end = u[:, at[16.0]].mean(1) - u[:, at[15.0]].mean(1), u[:, at[LENGTH]].mean(1)
    softening = ONSET * (FAILURE - opening) / (FAILURE - ONSET)
    stress = np.where(opening <= ONSET * (1 + 1e-9), opening, softening)
    reaction = ds.reaction.sel(leader_group=1, axis="x").values
    np.testing.assert_allclose(reaction, stress, atol=1e-8 * ONSET)
    np.testing.assert_allclose(end, opening + stress * (LENGTH - 1), atol=1e-8 * end.max())
    np.testing.assert_allclose(ds.load_factor, end / 0.01, atol=1e-8)
    assert (np.diff(end) < 0).sum() > 10
    work = external_work(reaction, end)
    dissipated = ds.dissipated_energy.values
    np.testing.assert_allclose(work - ds.strain_energy.values, dissipated, atol=1e-7 * ENERGY)
    if control is CELL:
        np.testing.assert_allclose(ds.opening, opening, atol=1e-12)
        np.testing.assert_allclose(opening, CELL["to"] * np.arange(21) / 20, atol=1e-12)
    else:
        np.testing.assert_allclose(
            dissipated[1:], DISSIPATED["to"] * np.arange(20) / 19, atol=1e-12
        )
        assert opening[1] == pytest.approx(ONSET, rel=1e-6)


def test_stress_at_particles_is_that_which_softened_cells_transmit():
    """The weak cells are those at the left end, where stress is extrapolated."""
    bar = BAR | {
        "body": {"type": "rectangle", "width": 4.0, "height": 2.0},
        "regions": {"weak": BAR["regions"]["weak"] | {"origin": [0.05, -2.0]}},
        "diagnostics": [*REACTIONS, {"type": "stress", "youngs_modulus": 1.0}],
    }
    ds = ran(bar, CELL | {"between": [[0, 0], [1, 0]]}, steps=2)
    stress = ds.reaction.sel(leader_group=1, axis="x").values / 2.0
    assert stress[-1] < 0.2 * ONSET
    expected = np.broadcast_to(stress[:, None], ds.stress_xx.shape)
    np.testing.assert_allclose(ds.stress_xx, expected, atol=1e-8 * ONSET)


def test_branch_of_an_elastic_body_is_a_straight_line():
    elastic = {"fracture": {"type": "none"}, "steps": 3}
    by_load = ran(NOTCHED, **elastic)
    stiffness = float(by_load.load_resultant[-1, 0, 0] / by_load.load_displacement[-1, 0, 0])
    for control in (MOUTH, MOUTH | {"between": [[0, 3], [12, 3]]}):
        ds = ran(NOTCHED, control, **elastic)
        force = ds.load_resultant.values[:, 0, 0]
        np.testing.assert_allclose(force, stiffness * ds.load_displacement.values[:, 0, 0])
        np.testing.assert_allclose(force, force[-1] * np.arange(4) / 3, atol=1e-15)
        np.testing.assert_allclose(ds.load_factor, force)
    both = ran(NOTCHED, MOUTH, **elastic, leaders=[HELD, PULLED], loads=[LOAD | {
        "select": {"nearest": [[6, 6]]}, "force": [0.0, 0.001]}])  # fmt: skip
    moved = (both.position - both.reference).sel(axis="x").values[:, -1]
    np.testing.assert_allclose(moved, 0.01 * both.load_factor.values)
    np.testing.assert_allclose(both.load_resultant.values[:, 0, 1], 0.001 * both.load_factor.values)


def test_branch_ends_with_the_last_step():
    scene = build_scene(
        as_experiment(controlled(NOTCHED, MOUTH, fracture={"type": "none"}, steps=3))
    )
    state = initial_state(scene)
    assert [reached.moment for reached in follow(scene, state, Watch())] == [1, 2]
    assert state.step == 3


def test_work_of_the_load_is_stored_or_dissipated(notched):
    force, moved = notched.load_resultant.values[:, 0, 0], notched.load_displacement.values[:, 0, 0]
    assert 0 < force.argmax() < 12
    lost = external_work(force, moved) - notched.strain_energy.values
    np.testing.assert_allclose(notched.dissipated_energy, lost, atol=1e-10 * lost[-1])
    assert (np.diff(lost) > -1e-12).all()
    assert lost[-1] > 8e-6


def test_order_of_the_points_turns_a_sign(notched):
    exchanged = MOUTH | {"between": MOUTH["between"][::-1]}
    same = ran(NOTCHED, exchanged)
    turned = ran(NOTCHED, exchanged | {"direction": [2.0, 0.0], "to": -MOUTH["to"]})
    np.testing.assert_array_equal(same.load_factor, notched.load_factor)
    np.testing.assert_array_equal(turned.load_factor, notched.load_factor)
    np.testing.assert_array_equal(turned.opening, -notched.opening)


def test_half_steps_and_other_controls_give_the_same_branch(notched):
    force = notched.load_factor.values
    halved = ran(NOTCHED, MOUTH, steps=24)
    np.testing.assert_allclose(halved.load_factor[::2], force, atol=1e-4 * force.max())
    energy = float(halved.dissipated_energy[-1])
    ds = ran(NOTCHED, {"type": "dissipation", "to": energy}, steps=24)
    mouth = [np.isclose(ds.reference.values, [x, 0.0]).all(axis=1) for x in (5.0, 6.0)]
    sides = [(ds.position - ds.reference).values[:, at, 0].ravel() for at in mouth]
    opening = sides[1] - sides[0]
    both = opening <= MOUTH["to"]
    expected = np.interp(opening[both], halved.opening, halved.load_factor)
    np.testing.assert_allclose(ds.load_factor[both], expected, atol=0.01 * force.max())
    assert both.sum() > 20
    assert float(ds.load_factor[-1]) < 0.6 * force.max()


def test_points_are_those_of_prescribed_displacements():
    tough = {
        "body": {"type": "rectangle", "width": 9.0, "height": 1.0},
        "regions": {"weak": BAR["regions"]["weak"] | {"origin": [4.05, -2.0]}},
        "fracture": BAR["fracture"] | {"energy": 4e-5},
    }
    branch = ran(BAR, CELL | {"between": [[4, 0], [5, 0]], "to": 0.005}, **tough, steps=5)
    force = branch.reaction.sel(leader_group=1, axis="x").values
    assert (np.diff(branch.load_factor) > 0).all()
    for step in (1, 4):
        displacement = 0.01 * float(branch.load_factor[step])
        to = PULLED | {"motion": {"type": "displace", "displacement": [displacement, 0.0]}}
        solver = {"type": "equilibrium", "increments": 2}
        given = BAR | tough | {"leaders": [HELD, to], "steps": 1, "solver": solver}
        ds = pbdkit.run(given, progress=False)
        assert float(ds.reaction[-1, 1, 0]) == pytest.approx(force[step], rel=1e-6)
    assert branch.dissipated_energy[4] > 0.0


def test_bonds_without_softening_break_one_after_the_other():
    strain = {"type": "strain", "failure": 1.5e-3, "cracks": NOTCHED["fracture"]["cracks"]}
    ds = ran(NOTCHED, MOUTH, fracture=strain)
    assert (ds.broken_step > 0).sum() >= 3
    assert (np.diff(ds.dissipated_energy) > -1e-15).all()
    rise = np.diff(ds.load_factor.values)
    assert (rise < 0).any()
    assert (rise[rise.argmin() :] > 0).any()
    np.testing.assert_allclose(ds.opening, MOUTH["to"] * np.arange(13) / 12, atol=1e-12)


def test_bonds_that_soften_by_their_strain_are_followed():
    damage = {"type": "damage", "onset": ONSET, "failure": 0.02}
    ds = ran(NOTCHED, MOUTH, fracture=damage | {"cracks": NOTCHED["fracture"]["cracks"]})
    force, moved = ds.load_resultant.values[:, 0, 0], ds.load_displacement.values[:, 0, 0]
    lost = external_work(force, moved) - ds.strain_energy.values
    np.testing.assert_allclose(ds.dissipated_energy, lost, atol=1e-9 * lost[-1])
    assert 0 < force.argmax() < 12


@pytest.mark.parametrize("fracture", ["cohesive", "damage"])
@pytest.mark.parametrize("lattice", ["square", "hexagonal"])
@pytest.mark.parametrize("stiffness", [1.0, {"otherwise": 1.0, "weak": 0.5}], ids=["one", "two"])
def test_forces_of_single_cells_add_up_to_those_of_the_lattice(lattice, fracture, stiffness):
    law = {"failure": 0.3} if fracture == "damage" else {"energy": 1.0}
    square = lattice == "square"
    given = NOTCHED | {
        "lattice": {"type": lattice, "a": 1.0},
        "body": {"type": "rectangle", "width": 5.5, "height": 4.2},
        "neighbours": {"type": "chebyshev" if square else "coordination", "shells": 1},
        "regions": {"weak": {"type": "rectangle", "width": 2.6, "height": 9.0}},
        "rule": NOTCHED["rule"] | {"stiffness": stiffness},
        "fracture": {"type": fracture, "onset": 0.01} | law,
    }
    scene = build_scene(as_experiment(given))
    start, state = initial_state(scene), initial_state(scene)
    body = scene.raster.place_of(scene.raster.body_rows)
    random = np.random.default_rng(1)
    state.u.reshape(2, -1)[:, body] = random.uniform(-0.08, 0.08, (2, len(body)))
    Fracturing(scene).break_bonds(state.u, state, 1)
    followers, shapes = SlotFollowers(scene), shapes_of(scene)
    expected = followers.forces(state.u, state) - followers.forces(state.u, start)
    total = np.zeros(expected.shape).reshape(2, -1)
    for shape, place in zip(shapes, changed_cells(scene, shapes, state, start), strict=True):
        cells = DamagingCells(scene, shape, place, start, start)
        u = state.u.reshape(2, -1)[:, cells.corners].transpose(1, 2, 0)
        change, derivatives = cells.tangent(u)
        for axis, plane in enumerate(total):
            np.add.at(plane, cells.corners, change[:, :, axis])
        du = 1e-6 * random.normal(size=u.shape)
        ahead, behind = cells.change(np.stack([u + du, u - du]))
        along = np.einsum("nij,nj->ni", derivatives, du.reshape(len(u), -1)).reshape(u.shape)
        np.testing.assert_allclose(along, (ahead - behind) / 2, atol=1e-4 * np.abs(along).max())
    assert np.abs(expected).max() > 0.01
    np.testing.assert_allclose(total, expected.reshape(2, -1), atol=1e-14)


def test_interrupted_branch_continues_with_the_same_bits(tmp_path):
    experiment = as_experiment(controlled(NOTCHED, MOUTH))
    whole = pbdkit.run(experiment, output=tmp_path / "whole.nc", progress=False)
    path = tmp_path / "parts.nc"

    def watch():
        looks = count()
        return Watch(lambda: next(looks) > 40)

    run = Simulation.of_scene(build_scene(experiment), watch=watch())
    report, resumed = record(run, NetcdfSink(path)), 0
    while report.outcome.status == "interrupted":
        assert resumed < 20
        report, resumed = resumption(path, watch()).record(), resumed + 1
    assert resumed > 1
    with pbdkit.open(path) as parts:
        for name in (*whole.variables, *whole.coords):
            np.testing.assert_array_equal(parts[name].values, whole[name].values)
        assert parts.attrs["certificate"] == whole.attrs["certificate"]


def test_branches_that_split_are_refused():
    uniform = {"fracture": {"type": "cohesive", "onset": ONSET, "energy": ENERGY}}
    ds = ended(BAR, {"type": "dissipation", "to": ENERGY}, **uniform)
    assert ds.status == "unconverged"
    assert re.search(
        r"ends between step 1 and step 1\.\d+, at the load factor 3.*: the tangent stiffness has "
        r"\d+ negative eigenvalues: the branch splits into several, .*; make one place weaker",
        ds.stop_reason,
    )
    assert ds.sizes["time"] == 2
    by_length = ended(BAR, CELL | {"between": [[0, 0], [LENGTH, 0]], "to": 0.06}, steps=4)
    assert "use more steps, a control that grows on the branch" in by_length.stop_reason
    assert by_length.sizes["time"] == 3


def test_branch_ends_when_the_body_has_come_apart_or_the_opening_decreases():
    pulled = {"loads": [], "leaders": [HELD, PULLED], "diagnostics": REACTIONS}
    tough = {
        "body": {"type": "rectangle", "width": 6.0, "height": 6.0},
        "rule": {"type": "elastic", "poisson_ratio": 0.0},
        "fracture": NOTCHED["fracture"] | {"energy": 2e-5, "cracks": [[[2.5, -1.0], [2.5, 2.5]]]},
    }
    mouth = MOUTH | {"between": [[2, 0], [3, 0]], "to": 0.05}
    ds = ended(NOTCHED, mouth, steps=10, **pulled, **tough)
    assert ds.status == "separated"
    end = ds.stop_reason.removeprefix("the body has come apart after step ")
    assert re.match(r"\d+(\.\d+)?, at the load factor [\d.]+ and the opening [\d.]+ of 0.05 ", end)
    to = float(re.search(r"records up to there .* set solver.control.to to ([\d.]+) ", end)[1])
    assert to == pytest.approx(2.0 * 2e-5 / ONSET, rel=0.01)
    assert float(ds.opening[-1]) <= to < float(ds.opening[-1]) + 0.05 / 10
    ends = CELL | {"between": [[0, 0], [LENGTH, 0]], "to": 0.06}
    ds = ended(BAR, ends, leaders=[HELD, PULLED, STRAIGHT], steps=8)
    assert ds.status == "unconverged"
    assert "the controlled quantity has its largest value on the branch" in ds.stop_reason


def test_increments_within_steps_are_recorded(monkeypatch):
    monkeypatch.setattr("pbdkit.equilibrium.branch.MAX_ITERATIONS", 3)
    ds = ran(NOTCHED, MOUTH, steps=3, record={"increments": True})
    assert ds.sizes["time"] > 4
    time = ds.time.values
    np.testing.assert_allclose(ds.opening, MOUTH["to"] * time / 3, atol=1e-15)
    parts = np.diff(time)
    assert (parts[1:] <= 2.0 * parts[:-1]).all()


def test_experiments_without_control_are_written_as_before():
    assert "control" not in as_experiment(controlled(BAR)).model_dump_json()
    experiment = as_experiment(controlled(BAR, CELL))
    assert as_experiment(experiment.model_dump(by_alias=True)).solver == experiment.solver


SPRINGS = {"rule": {"type": "springs"}, "fracture": {"type": "none"}, "regions": {}}
THRESHOLD = {"fracture": {"type": "threshold", "thresholds": [1.1, 1.6]}, "regions": {}}
REFUSED = {
    "a nonlinear rule": (CELL, SPRINGS, "computed for linear rules with forces"),
    "a rule without forces": (
        CELL,
        {"rule": {"type": "barycentre"}, "fracture": {"type": "none"}, "regions": {},
         "diagnostics": []},
        "'barycentre' is none",
    ),
    "a frame with points": (CELL, {"frame": {"type": "mirror"}}, "with frame: {type: natural}"),
    "dissipation without softening": (DISSIPATED, THRESHOLD, "'threshold' does not soften"),
    "one step of dissipation": (DISSIPATED, {"steps": 1}, "set steps to 2 or more"),
    "no load": (CELL, {"leaders": [], "diagnostics": []}, "there is no load"),
    "a late load": (
        CELL,
        {"leaders": [HELD], "loads": [LOAD | {"from": 2}], "diagnostics": []},
        "have to act in all steps",
    ),
    "a cut": (
        CELL,
        {"cuts": [{"from": [3.5, -1.0], "to": [3.5, 0.5], "at": 3}]},
        "make it at step 0",
    ),
    "an opening of 0": (CELL | {"to": 0.0}, {}, "the opening in the last step is 0"),
    "no direction": (CELL | {"direction": [0, 0]}, {}, "the direction is zero"),
    "one point": (CELL | {"between": [[15, 0], [15.2, 0]]}, {}, "nearest to particle 31"),
    "an opening without load": (
        CELL | {"direction": [0.0, 1.0]},
        {},
        "do not change the opening; choose other points or another direction",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_impossible_controls_are_refused(case):
    control, changes, message = REFUSED[case]
    with pytest.raises(ExperimentError, match=re.escape(message)) as caught:
        ran(BAR, control, **changes)
    assert "solver.control" in str(caught.value)
