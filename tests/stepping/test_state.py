"""Parts that remember: what bonds and particles keep is stepped, drawn, recorded and restored."""

import copy
import pickle

import numpy as np
import pytest
from property_cases import pull_right
from remembering_parts import Tiring, Weakest
from scene_strategies import in_turn

import pbdkit
from pbdkit.scene.scene import build_scene
from pbdkit.seeds import component_generator
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import cut_bonds, initial_state

PARTS = [Weakest, Tiring]
LEFT = {"select": {"edge": "left"}, "motion": {"type": "hold"}}
STRAIGHT = {"type": "equilibrium", "tolerance": 1e-11, "increments": 10}


def sheet(columns=8, rows=6, **parts):
    return {
        "name": "sheet",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "grid", "columns": columns, "rows": rows},
        "rule": {"type": "barycentre"},
        "fracture": Weakest(spread=0.3),
        "leaders": [LEFT, pull_right(0.3, 0.1, 5)],
        "diagnostics": [{"type": "displacement"}],
        "steps": 40,
    } | parts


def chain(bonds, **parts):
    return sheet(bonds + 1, 1, frame={"type": "none"}, **parts)


def run(given):
    return pbdkit.run(given, components=PARTS, progress=False)


def pulled(extension, steps):
    motion = {"type": "velocity", "velocity": [extension / steps, 0.0], "steps": steps}
    return {"select": {"edge": "right"}, "motion": motion}


BONDS, ONSET, FAILURE = 5, 0.1, 0.9


def force_of_a_chain(extension):
    """Return the force of equal bonds with stiffness 1, one of which softens from `ONSET` on: in
    series the forces are the same, n F + strain = extension, with F = o (f - strain) / (f - o) at
    the weak one."""
    peak = BONDS * ONSET
    if extension <= peak:
        return extension / BONDS
    return ONSET * (FAILURE - extension) / (FAILURE - peak)


@pytest.mark.parametrize("extension", in_turn([0.3, 0.7, 0.95], 2))
@pytest.mark.parametrize("way", ["steps", "equilibrium"])
def test_a_chain_with_a_weak_bond_follows_the_exact_law(extension, way):
    # The others would soften later: the weak one leads from the peak on.
    model = Weakest(onset=ONSET * 1.2, weak=1 / 1.2, failure=FAILURE)
    solver = STRAIGHT if way == "equilibrium" else {"type": "stepping", "engine": "numpy"}
    steps = 600
    ds = run(
        chain(BONDS, fracture=model, leaders=[LEFT, pulled(extension, steps // 2)], steps=steps,
              solver=solver, record={"every": steps})
    )  # fmt: skip
    strains = np.diff(ds.u.isel(time=-1, axis=0))
    if extension > FAILURE:
        assert (ds.broken_step >= 0).sum() == 1
        np.testing.assert_allclose(np.delete(strains, 2), 0.0, atol=1e-8)
        return
    expected = force_of_a_chain(extension)
    damage = ds.damage.isel(time=-1)
    assert (damage > 0).sum() == (extension > BONDS * ONSET)
    np.testing.assert_allclose((1 - damage) * strains, expected, rtol=0, atol=2e-6)
    assert not (ds.broken_step >= 0).any()


def test_damage_remains_after_unloading():
    motion = {"type": "path", "steps": [500, 1000, 1500],
              "displacements": [[0.7, 0.0], [0.1, 0.0], [0.1, 0.0]]}  # fmt: skip
    leaders = [LEFT, {"select": {"edge": "right"}, "motion": motion}]
    model = Weakest(onset=ONSET * 1.2, weak=1 / 1.2, failure=FAILURE)
    ds = run(chain(BONDS, fracture=model, leaders=leaders, steps=1_500, record={"every": 125}))
    damage = ds.damage.isel(bond=2)
    assert (np.diff(damage) >= 0).all()
    assert damage[-1] == damage[5] > 0.7
    weak = float(damage[-1])
    strains = np.diff(ds.u.isel(time=-1, axis=0))
    force = 0.1 / (BONDS - 1 + 1 / (1 - weak))  # springs in series
    np.testing.assert_allclose(strains[2], force / (1 - weak), atol=1e-9)
    np.testing.assert_allclose(np.delete(strains, 2), force, atol=1e-9)


def assert_same(one, other):
    assert one.step == other.step
    for name in ("u", "previous", "broken_step", "broken_length"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    for name in ("bond_values", "particle_values"):
        for a, b in zip(getattr(one, name), getattr(other, name), strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("store", [copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))])
def test_a_state_is_a_checkpoint(store):
    given = sheet(rule=Tiring(spread=0.05), leaders=[LEFT, pull_right(0.1, 0.0, 30)])
    scene = build_scene(pbdkit.Experiment(**given))
    whole = Stepper(scene).advance(initial_state(scene), 30)
    kept = store(Stepper(scene).advance(initial_state(scene), 7))
    again = build_scene(pbdkit.Experiment(**given))
    assert_same(whole, Stepper(again).advance(kept, 23))
    assert whole.bond_values[1].max() > 0.5
    assert whole.particle_values[0].max() > 0.1
    assert (whole.broken_step > 7).any()


def test_random_draw_depends_on_the_seed_alone():
    one, same = run(sheet(seed=7)), run(sheet(seed=7))
    other = run(sheet(seed=8))
    assert one.drop_attrs().identical(same.drop_attrs())
    assert (one.onset != other.onset).all()
    crowded = run(
        sheet(seed=7, rule=Tiring(spread=0.05), initial={"type": "noise", "amplitude": 0.1})
    )
    np.testing.assert_array_equal(one.onset, crowded.onset)
    expected = component_generator(7, "fracture").uniform(-1, 1, one.sizes["bond"])
    drawn = 0.1 * (1 + 0.3 * expected)
    np.testing.assert_array_equal(np.sort(one.onset), np.sort(drawn))
    rule = component_generator(7, "rule").uniform(-1, 1, 48)
    body = crowded.kind[0] != 2
    np.testing.assert_array_equal(crowded.zeal[body], 0.9 + 0.05 * rule)
    assert crowded.zeal[~body].isnull().all()


def test_rerunning_a_dataset_draws_the_same_numbers():
    ds = run(sheet(seed=3))
    again = pbdkit.rerun(ds, components=PARTS, progress=False)
    assert ds.drop_attrs().identical(again.drop_attrs())


def test_state_variables_are_recorded_with_units(tmp_path):
    ds = run(sheet(rule=Tiring()))
    assert ds.onset.dims == ds.broken_step.dims == ("bond",)
    assert ds.damage.dims == ds.visits.dims == ("time", "bond")
    assert ds.way.dims == ("time", "particle")
    assert ds.zeal.dims == ("particle",)
    assert ds.visits.dtype == np.int32
    assert ds.way.attrs == {"long_name": "way made in x", "units": "lattice unit"}
    broken = ds.broken_step >= 0
    assert broken.any()
    assert (ds.damage.isel(time=-1).where(broken) >= 1).sum() == broken.sum()
    assert (ds.damage.isel(time=-1).where(~broken, 0) < 1).all()
    assert not ds.way.isel(time=0).where(ds.role == 0, drop=True).any()
    assert ds.way.where(ds.role == 1, drop=True).isnull().all()
    narrow = run(sheet(record={"every": 1, "dtype": "float32"}))
    assert narrow.damage.dtype == np.float32


def test_unbreakable_bonds_keep_their_initial_values():
    ds = run(sheet(fracture=Weakest(spread=0.3, frame_bonds=False), frame={"type": "mean"}))
    frame = (ds.role.values == 1)[ds.bond_ends.values - 1].any(axis=1)
    assert not ds.damage[:, frame].any()
    assert ds.damage[:, ~frame].any()


def test_rule_reads_its_state_with_any_neighbour_search():
    near = {"type": "euclidean", "radius": 1.2}
    plain = {"type": "none"}
    leaders = [LEFT, pull_right(0.01, 0.0, 5)]
    fixed, anew = (
        run(sheet(rule=Tiring(spread=0.05), fracture=plain, leaders=leaders,
                  neighbours=near | {"reevaluate": anew}))
        for anew in (False, True)
    )  # fmt: skip
    np.testing.assert_allclose(fixed.u, anew.u, rtol=0, atol=1e-14)
    np.testing.assert_allclose(fixed.way, anew.way, rtol=0, atol=1e-14)
    assert fixed.way.max() > 1e-3


def test_single_precision_keeps_single_numbers():
    solver = {"type": "stepping", "precision": "float32", "engine": "numpy"}
    scene = build_scene(pbdkit.Experiment(**sheet(solver=solver)))
    state = Stepper(scene).advance(initial_state(scene), 20)
    assert [v.dtype.name for v in state.bond_values] == ["float32", "float32", "int32"]
    exact = run(sheet(steps=20, fracture=Weakest(onset=0.5, failure=5.0)))
    single = run(sheet(steps=20, fracture=Weakest(onset=0.5, failure=5.0), solver=solver))
    assert 0.0 < abs(single.damage - exact.damage).max() < 5e-6


def test_operator_of_a_softened_state_equals_the_step():
    """Linear in u at given damage: the operator makes the steps, to rounding."""
    from pbdkit.linear.operator import step_operator

    scene = build_scene(pbdkit.Experiment(**sheet(rule=Tiring(spread=0.05))))
    state = Stepper(scene).advance(initial_state(scene), 25)
    operator = step_operator(scene, state, 25)
    u = scene.raster.table(state.u)
    damage = state.bond_values[1].copy()
    predicted = (operator.current @ u[operator.followers].ravel() + operator.source).reshape(-1, 2)
    predicted += (operator.leader @ u[operator.leaders].ravel()).reshape(-1, 2)
    after = Stepper(scene).advance(state, 1)
    same = (after.bond_values[1] == damage).all()
    moved = scene.raster.table(after.u)[operator.followers]
    assert damage.max() > 0.5
    if not same:
        pytest.fail("the damage was to have come to rest")
    np.testing.assert_allclose(predicted, moved, rtol=0, atol=1e-13)


def test_cuts_break_intact_bonds_at_their_step():
    places = ((1.5, 0), (3.5, 1), (1.5, 1))
    cuts = [{"from": [x, -1.0], "to": [x, 1.0], "at": at} for x, at in places]
    scene = build_scene(pbdkit.Experiment(**chain(5, fracture={"type": "none"}, cuts=cuts)))
    broken = initial_state(scene).broken_step
    assert broken[broken >= 0].tolist() == [0]
    assert cut_bonds(scene, broken, 1)
    assert sorted(broken[broken >= 0].tolist()) == [0, 1]
