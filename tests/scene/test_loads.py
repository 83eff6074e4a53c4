"""Loads: their distribution on particles, their times, and their effect on bodies."""

import math

import numpy as np
import pytest
from finite_elements import weight
from interpreted_kernels import interpreting
from turning_frame import Turning

import pbdkit
from pbdkit.equilibrium import system as moves_of
from pbdkit.equilibrium.load_stepping import moments
from pbdkit.linear.operator import step_operator
from pbdkit.model.boundary_conditions import Load
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import initial_state
from tests.components.test_elasticity import NATURAL

UNIT = {"youngs_modulus": 1.0}
MEASURED = [{"type": name} | UNIT for name in ("reaction", "load-displacement", "strain-energy")]
SQUARE = {
    "lattice": {"type": "square", "a": 1.0},
    "neighbours": {"type": "chebyshev", "shells": 1},
}
HEXAGONAL = {
    "lattice": {"type": "hexagonal", "a": 1.0},
    "neighbours": {"type": "coordination", "shells": 1},
}
SPRINGS = {"type": "springs"}
ELASTIC = {"type": "elastic", "poisson_ratio": 0.3}
GRADIENT = {"type": "strain-gradient", "poisson_ratio": 0.3, "length": 0.4}
HELD = [{"select": {"edge": "left"}, "motion": {"type": "hold"}}]
FREE = {"leaders": [], "diagnostics": []}
QUICK = {"type": "stepping", "memory": "auto"}
TIP = {"select": {"edge": "right"}, "force": [0.03, -0.01]}
ALL = {"box": [-1, -1, 9, 9]}
WEIGHT = {"select": ALL, "body_force": [0.0, -0.002]}


def loaded(*loads, **parts):
    """A sheet 5 by 3, held at its left edge."""
    base = SQUARE | {
        "name": "loaded",
        "body": {"type": "grid", "columns": 6, "rows": 4},
        "rule": ELASTIC,
        "frame": NATURAL,
        "leaders": HELD,
        "loads": list(loads),
        "steps": 1,
        "solver": {"type": "equilibrium"},
        "diagnostics": MEASURED,
    }
    return base | parts


def ran(given):
    return pbdkit.run(given, progress=False)


def scene_of(given):
    return build_scene(pbdkit.Experiment(**given))


def test_a_hanging_bar_is_exact_at_its_particles():
    ds = ran(pbdkit.load("modelling/hanging-bar"))
    y, u = ds.reference.values[:, 1], ds.position.values[-1] - ds.reference.values
    exact = -1e-3 * (4.0**2 - y**2) / 2 - 2e-3 * (4.0 - y)
    assert abs(u - np.stack([0.0 * y, exact], axis=1)).max() < 1e-12
    assert ds.reaction.values[-1, 0] == pytest.approx([0.0, 0.006], abs=1e-12)


def test_a_hanging_bar_of_triangles_converges():
    """Its sides are cut, and its top is held where its particles are."""

    def off(rows):
        a = 4.0 / (rows * math.sqrt(0.75))
        body = {"type": "rectangle", "width": 1.0, "height": 4.0}
        parts = HEXAGONAL | {"lattice": {"type": "hexagonal", "a": a}, "body": body}
        top = {"box": [-1.0, 4.0 - 1e-6, 2.0, 5.0]}
        given = loaded({"select": {"box": [-9, -9, 9, 9]}, "body_force": [0.0, -1e-3]}, **parts)
        given |= {"leaders": [{"select": top, "motion": {"type": "hold"}}]}
        given |= {"rule": {"type": "elastic", "poisson_ratio": 0.0}}
        ds = ran(given)
        y, u = ds.reference.values[:, 1], (ds.position - ds.reference).values[-1, :, 1]
        return np.sqrt(np.mean((u + 1e-3 * (4.0**2 - y**2) / 2) ** 2))

    assert math.log2(off(16) / off(32)) > 1.8


def test_deflection_of_a_cantilever_matches_finite_elements():
    rule, elements = (
        [error(*found(n)) for n in weight.SIZES]
        for error, found in (
            (weight.error, lambda n: (weight.lattice(n).places, weight.lattice(n).u)),
            (weight.error, weight.bilinear),
        )
    )
    assert rule == pytest.approx([1.49e-2, 4.12e-3, 1.16e-3], rel=0.01)
    orders = [math.log(errors[0] / errors[-1], 4) for errors in (rule, elements)]
    assert orders[0] > max(1.8, orders[1])
    whole = [0.0, weight.WEIGHT * weight.LENGTH * weight.HEIGHT]
    assert weight.lattice(40).reaction == pytest.approx(whole, abs=1e-10 * whole[1])


@pytest.mark.parametrize("rule", [ELASTIC, SPRINGS, GRADIENT, GRADIENT | {"length": 0.0}])
def test_reactions_balance_loads(rule):
    """Leaders have loads too: the left edge bears its weight."""
    ds = ran(loaded(TIP, WEIGHT, rule=rule))
    assert ds.attrs["status"] == "complete"
    total = ds.load_resultant.values[-1].sum(axis=0)
    assert total == pytest.approx([0.03, -0.01 - 0.002 * 15], rel=1e-12)
    assert ds.reaction.values[-1].sum(axis=0) == pytest.approx(-total, abs=1e-10)


def test_half_the_work_of_a_load_is_stored():
    ds = ran(loaded(TIP, WEIGHT))
    work = (ds.load_resultant * ds.load_displacement).sum(["load", "axis"])
    assert float(work[-1]) == pytest.approx(2 * float(ds.strain_energy[-1]), rel=1e-9)


def shares(select, key="force", **parts):
    scene = scene_of(loaded({"select": select, key: [1.0, 0.0]}, **parts))
    return scene.loads.each[0].share


def test_force_is_distributed_by_tributary_length_on_a_line():
    assert shares({"edge": "right"}) == pytest.approx([1 / 6, 1 / 3, 1 / 3, 1 / 6])
    along = {"nearest": [[0, 0], [1, 1], [3, 3]]}
    assert shares(along) == pytest.approx([1 / 6, 1 / 2, 1 / 3])
    assert shares({"numbers": [1, 2, 7]}) == pytest.approx([1 / 3] * 3)
    assert shares({"numbers": [9]}) == [1.0]


def test_body_force_is_weighted_by_cell_area():
    whole = shares(ALL, "body_force")
    assert sorted(set(whole)) == [0.25, 0.5, 1.0]
    assert whole.sum() == 15.0
    assert (shares(ALL, "body_force", frame={"type": "none"}) == whole).all()
    disc = {"type": "disc", "radius": 3.0, "centre": [3.0, 3.0]}
    for lattice in (SQUARE, HEXAGONAL):
        area = shares(ALL, "body_force", body=disc, **lattice).sum()
        assert area == pytest.approx(9 * math.pi, rel=2e-3)


def test_loads_act_between_from_and_until():
    """Before the load no particle has moved, exactly; after it, the body comes back to rest."""
    given = loaded(TIP | {"from": 4, "until": 9}, steps=900, solver=QUICK)
    ds = ran(given | {"record": {"at": [3, 4, 9, 10]}})
    u = abs(ds.position - ds.reference).max(["particle", "axis"])
    assert u.sel(time=3) == 0.0 < u.sel(time=4) < u.sel(time=9)
    assert float(u.sel(time=900)) < 1e-9
    acting = ds.load_resultant.sel(time=[3, 4, 9, 10])[:, 0, 0]
    assert acting.values == pytest.approx([0.0, 0.03, 0.03, 0.0])


@pytest.mark.parametrize("rule", [ELASTIC, SPRINGS], ids=["elastic", "springs"])
def test_steps_converge_to_the_equilibrium(rule):
    parts = {"rule": rule, "steps": 5000, "record": {"at": [1]}, "diagnostics": []}
    there = ran(loaded(TIP, WEIGHT, **parts)).position.values[-1]
    ds = ran(loaded(TIP, WEIGHT, solver=QUICK | {"settle": {"tolerance": 1e-4}}, **parts))
    assert ds.attrs["status"] == "settled"
    way = abs(there - ds.reference.values).max()
    assert abs(ds.position.values[-1] - there).max() < 1e-4 * way


def test_tolerance_is_relative_to_the_displacement_of_loads():
    """A thousandth of the load converges as the load does."""
    solver = QUICK | {"settle": {"tolerance": 1e-3}}
    found = []
    for size in (1.0, 1e-6):
        tip = TIP | {"force": [0.03 * size, -0.01 * size]}
        ds = ran(loaded(tip, steps=5000, solver=solver, record={"at": [1]}, diagnostics=[]))
        found.append(((ds.position - ds.reference).values[-1] / size, ds.time.values[-1]))
    assert found[0][1] == pytest.approx(found[1][1], rel=0.01)
    np.testing.assert_allclose(found[0][0], found[1][0], atol=1e-3 * abs(found[0][0]).max())


def test_released_body_rests_where_its_steps_end():
    """If nothing holds the body, its displacement under the load counts."""
    push = TIP | {"until": 20}
    free = loaded(push, steps=600, **FREE)
    stepped = ran(free | {"solver": {"type": "stepping"}})
    with pytest.raises(pbdkit.ExperimentError, match=r"at step 1 there is no .* `record: {at: \["):
        ran(free)
    last = free | {"record": {"at": [600]}}
    np.testing.assert_allclose(ran(last).position[-1], stepped.position[-1], atol=1e-8)


@pytest.mark.parametrize("rule", [ELASTIC, SPRINGS], ids=["elastic", "springs"])
def test_unsupported_body_has_no_equilibrium(rule):
    with pytest.raises(
        pbdkit.ExperimentError,
        match=r"a part of 24 particles \(with number .* is loaded, but not constrained",
    ):
        ran(loaded(TIP, rule=rule, **FREE))


def test_balanced_forces_need_no_leader():
    back = {"select": {"edge": "left"}, "force": [-0.03, 0.0]}
    forth = {"select": {"edge": "right"}, "force": [0.03, 0.0]}
    ds = ran(loaded(back, forth, **FREE))
    u = (ds.position - ds.reference).values[-1]
    strain = np.polyfit(ds.reference.values[:, 0], u[:, 0], 1)[0]
    assert strain == pytest.approx(0.01, rel=1e-8)


@pytest.mark.parametrize("frame", [NATURAL, Turning(), {"type": "mean", "lag": 1}])
def test_step_operator_includes_loads(frame):
    solver = {"type": "stepping", "relaxation": 0.7, "memory": 0.2}
    start = {"type": "noise", "amplitude": 0.1}
    parts = {"frame": frame, "solver": solver, "initial": start, "diagnostics": []}
    scene = scene_of(loaded(TIP, WEIGHT, steps=9, **parts))
    state = Stepper(scene).advance(initial_state(scene), 3)
    known = step_operator(scene, state)
    place, led = (scene.raster.place_of(rows) for rows in (known.followers, known.leaders))
    u, previous, w = (
        of.reshape(2, -1)[:, at].T.ravel()
        for of, at in ((state.u, place), (state.previous, place), (state.u, led))
    )
    expected = known.current @ u + known.previous @ previous + known.leader @ w + known.source
    after = Stepper(scene).advance(state).u.reshape(2, -1)[:, place].T.ravel()
    np.testing.assert_allclose(after, expected, atol=1e-13)


def test_compiled_displacements_are_the_same_at_any_time(monkeypatch):
    scene = scene_of(loaded(TIP | {"from": 2}, WEIGHT, rule=SPRINGS, steps=5))
    state, plain = initial_state(scene), moves_of.Moves(scene)
    monkeypatch.setattr(moves_of, "LARGEST_BY_NUMPY", 0)
    with interpreting():
        compiled = moves_of.Moves(scene)
        assert compiled.compile()
        for moment in (0.5, 1.0, 1.25, 2.0):
            np.testing.assert_array_equal(compiled.at(state, moment), plain.at(state, moment))
    assert scene.loads.held_at is None


def test_multigrid_gives_the_same_solution():
    parts = {"body": {"type": "grid", "columns": 30, "rows": 20}, "diagnostics": []}
    one, other = (
        ran(loaded(TIP, WEIGHT, **parts, solver={"type": "equilibrium", "method": method}))
        for method in ("lu", "multigrid")
    )
    way = abs(one.position - one.reference).max()
    assert abs(one.position - other.position).max() < 1e-7 * way


def test_loads_are_applied_in_increments_if_bonds_can_break():
    breaking = {"type": "strain", "failure": 0.05}
    given = loaded(TIP | {"from": 2, "until": 3}, rule=SPRINGS, fracture=breaking, steps=6)
    found = moments(scene_of(given), 10)
    assert found == pytest.approx([1.0, *np.linspace(1.2, 2.0, 5), 3.0, *np.linspace(3.2, 4.0, 5)])
    parts = {"solver": {"type": "equilibrium", "increments": 4}, "diagnostics": []}
    whole = loaded(TIP, rule=SPRINGS, fracture=breaking | {"failure": 0.5}, **parts)
    torn = ran(whole)
    assert (torn.broken_step.values < 0).all()
    plain = ran(loaded(TIP, rule=SPRINGS, **parts))
    np.testing.assert_allclose(torn.position[-1], plain.position[-1], atol=1e-8)


def test_a_load_is_linear_between_steps():
    load = Load(**{"select": {"edge": "left"}, "force": [2.0, 0.0], "from": 3, "until": 5})
    moments_ = [0, 2, 2.5, 3, 5, 5.25, 6, 100]
    assert [load.amplitude(m) for m in moments_] == [0, 0, 0.5, 1, 1, 0.75, 0, 0]


def test_dataset_reruns_and_describes_its_loads():
    ds = ran(loaded(TIP | {"from": 2}, steps=8, solver={"type": "stepping"}))
    again = pbdkit.rerun(ds, progress=False)
    np.testing.assert_array_equal(ds.position, again.position)
    assert '"force":[0.03,-0.01]' in ds.attrs["experiment"].replace(" ", "")
    assert ds.load_resultant.attrs["units"]
    assert ds["load"].values.tolist() == [0]


KNOWS_NONE = r"loads: the rule '.*' with these parameters defines moves, .* use a calibrated"
REFUSED = {
    "barycentre": ({"rule": {"type": "barycentre"}, "frame": {"type": "mean"}}, KNOWS_NONE),
    "auxetic": ({"rule": ELASTIC | {"poisson_ratio": -1.0}}, KNOWS_NONE),
    "anew": (
        {
            "neighbours": {"type": "euclidean", "radius": 1.5, "reevaluate": True},
            "solver": {"type": "stepping"},
        },
        "loads: loads require fixed neighbours; set neighbours.reevaluate: false",
    ),
    "both": ({"loads": [TIP | {"body_force": [1, 0]}]}, r"loads.0: give exactly one of force, bo"),
    "neither": ({"loads": [{"select": ALL}]}, r"loads.0: give exactly one of force, body_force"),
    "order": ({"loads": [TIP | {"from": 5, "until": 4}]}, r"loads.0: until \(4\) is before from"),
    "infinite": ({"loads": [TIP | {"force": [math.inf, 0]}]}, r"loads.0.force.0: should be a fin"),
    "too large": (
        {"loads": [WEIGHT | {"body_force": [1e308, 0.0]}]},
        r"loads.0: the force is not finite",
    ),
    "nobody": (
        {"loads": [TIP | {"select": {"box": [50, 50, 51, 51]}}]},
        r"loads.0.select: selects no particle",
    ),
    "none to measure": ({"loads": []}, r"diagnostics.1: 'load-displacement' requires loads; the"),
}


@pytest.mark.parametrize(("parts", "message"), REFUSED.values(), ids=REFUSED)
def test_invalid_loads_are_refused(parts, message):
    with pytest.raises(pbdkit.ExperimentError, match=message):
        scene_of(loaded(TIP) | {"diagnostics": MEASURED[:2]} | parts)


@pytest.mark.filterwarnings("ignore:loads.0. begins to act")
def test_load_after_the_end_gives_a_warning():
    from pbdkit.stability.forecast import forecast

    found = forecast(scene_of(loaded(TIP | {"from": 9})))
    assert "loads.0: starts after the last step of the run" in found.warnings
