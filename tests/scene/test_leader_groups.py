"""Leader groups that lead along one axis: rollers and planes of symmetry."""

import numpy as np
import pytest
from changed_axes import Change, changed
from scene_strategies import in_turn

import pbdkit
from pbdkit.equilibrium.load_stepping import equilibrium_state
from pbdkit.linear.operator import step_operator
from pbdkit.scene.scene import build_scene
from pbdkit.stability.forecast import forecast
from pbdkit.stepping.engine_choice import Choice, make_engine
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import initial_state

HOLD = {"type": "hold"}
STRETCH = 0.01


def sheet(columns=9, rows=6, **parts):
    """A sheet on rollers at the left and at the bottom, pulled at the right."""
    pull = {"type": "displace", "displacement": [STRETCH * (columns - 1), 7.0]}
    return {
        "name": "rollers",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "grid", "columns": columns, "rows": rows},
        "neighbours": {"type": "chebyshev", "shells": 1},
        "rule": {"type": "elastic", "poisson_ratio": 0.3},
        "frame": {"type": "natural"},
        "leaders": [
            {"select": {"edge": "left"}, "motion": HOLD, "axes": ["x"]},
            {"select": {"edge": "bottom"}, "motion": HOLD, "axes": ["y"]},
            {"select": {"edge": "right"}, "motion": pull, "axes": ["x"]},
        ],
        "steps": 5,
        "diagnostics": [{"type": "displacement"}],
        **parts,
    }


BARYCENTRES = {
    "elastic": {"rule": {"type": "elastic", "poisson_ratio": -1.0}, "frame": {"type": "mean"}},
    "barycentre": {
        "rule": {"type": "barycentre"},
        "frame": {"type": "mean"},
        "neighbours": {"type": "coordination", "shells": 1},
    },
}


@pytest.mark.parametrize(
    "solver",
    [
        {"type": "stepping", "engine": "numpy"},
        {"type": "stepping", "engine": "compiled"},
        {"type": "equilibrium", "method": "lu"},
        {"type": "equilibrium", "method": "multigrid"},
    ],
)
def test_calibrated_rule_without_a_material_is_guided_like_a_plain_one(solver, request):
    """With ν = -1 nothing is left on the diagonals, and no force is known."""
    if solver.get("engine") == "compiled":
        request.getfixturevalue("compiled_at_length")
    one, other = (run(sheet(solver=solver, **parts)) for parts in BARYCENTRES.values())
    assert np.abs(one.u.values[-1, :, 0]).max() > STRETCH
    np.testing.assert_allclose(one.u.values, other.u.values, rtol=0, atol=1e-7)


def scene_of(data):
    return build_scene(pbdkit.Experiment(**data))


def run(data):
    return pbdkit.run(pbdkit.Experiment(**data), progress=False)


@pytest.mark.parametrize("method", ["lu", "multigrid"])
def test_a_pulled_sheet_contracts_uniformly(method):
    """Uniaxial stress: u = ε (x, -ν y), and a force of ε A at both ends, none at the bottom."""
    reaction = {"type": "reaction", "youngs_modulus": 1.0}
    solver = {"type": "equilibrium", "method": method, "tolerance": 1e-12}
    ds = run(sheet(solver=solver, diagnostics=[{"type": "displacement"}, reaction]))
    X = ds.reference.values
    exact = STRETCH * np.stack([X[:, 0], -0.3 * X[:, 1]], axis=1)
    assert np.abs(ds.u.values[-1] - exact).max() < 1e-13
    force = STRETCH * 5.0
    wanted = [[-force, 0.0], [0.0, 0.0], [force, 0.0]]
    assert np.allclose(ds.reaction.values[-1], wanted, rtol=0, atol=1e-13)
    assert (ds.kind.values[-1] == 0).sum() == 6 + 6 + 9 - 2


def rectangle(width, height, x=0.0, y=0.0):
    return {"type": "rectangle", "width": width, "height": height, "origin": [x, y]}


def quarters(part):
    """A plate with a hole, pulled at both sides, or its quarter on two planes of symmetry."""
    whole = {"type": "difference", "of": [rectangle(10, 8, -5, -4), rectangle(3, 3, -1.5, -1.5)]}
    body = {"type": "intersection", "of": [whole, rectangle(6, 6)]} if part else whole
    pull = {"type": "velocity", "velocity": [0.05, 0.0], "steps": 20}
    push = {"type": "velocity", "velocity": [-0.05, 0.0], "steps": 20}
    leaders = [{"select": {"box": [5, -2, 5, 2]}, "motion": pull, "axes": ["x"]}]
    if part:
        leaders += [
            {"select": {"box": [-0.1, 0, 0.1, 6]}, "motion": HOLD, "axes": ["x"]},
            {"select": {"box": [0, -0.1, 6, 0.1]}, "motion": HOLD, "axes": ["y"]},
        ]
    else:
        leaders += [{"select": {"box": [-5, -2, -5, 2]}, "motion": push, "axes": ["x"]}]
    return sheet(body=body, leaders=leaders, steps=40)


@pytest.mark.parametrize("rule", ["elastic", "springs"])
def test_quarter_with_symmetry_planes_equals_a_quarter_of_the_whole(rule):
    """In every step: also where the outline meets a plane, at corners of the quarter."""
    chosen = {"type": rule} | ({"poisson_ratio": 0.3} if rule == "elastic" else {})
    solver = {"type": "stepping", "memory": 0.4}
    whole, part = (run(quarters(n) | {"rule": chosen, "solver": solver}) for n in (0, 1))
    at = {tuple(x): n for n, x in enumerate(whole.reference.values.tolist())}
    same = [at[tuple(x)] for x in part.reference.values.tolist()]
    assert np.abs(whole.u.values[-1]).max() > 0.9
    assert np.abs(whole.u.values[:, same] - part.u.values).max() < 1e-13


PLAIN = {
    "rule": {"type": "barycentre"},
    "frame": {"type": "mean"},
    "neighbours": {"type": "coordination", "shells": 1},
}


@pytest.mark.parametrize(
    ("parts", "precision", "threads"),
    in_turn([({}, "float64", 2), (PLAIN, "float32", 1)], 2),
)
def test_both_engines_agree_bit_for_bit(parts, precision, threads, request):
    """At the upper left corner too, where what pushes at the guide adds to the move. Single
    precision is compiled, as Python would round otherwise: in the profile `long`, and guided in
    one direction in `components/test_fracture`."""
    if precision == "float64":
        request.getfixturevalue("compiled_at_length")
    solver = {"type": "stepping", "relaxation": 0.8, "memory": 0.5, "precision": precision}
    data = sheet(initial={"type": "noise", "amplitude": 0.1}, solver=solver, **parts)
    data["leaders"][0] |= {"until": 9}
    found = []
    for name in ("numpy", "compiled"):
        scene = scene_of(data)
        engine, _ = make_engine(scene, Choice(name, threads, "asked for"))
        found.append(engine.advance(initial_state(scene), 15))
    assert engine.name == "compiled"
    assert np.array_equal(found[0].u, found[1].u)
    assert np.array_equal(found[0].previous, found[1].previous)


LAGGING = {
    "rule": {"type": "mixed-coordinate", "K": -0.002},
    "frame": {"type": "mean", "lag": 1},
    "neighbours": {"type": "coordination", "shells": 1},
    "solver": {"type": "stepping", "relaxation": 0.7},
}
CUT = {
    "body": {"type": "disc", "radius": 4.3, "centre": [5.0, 5.0]},
    "solver": {"type": "stepping", "relaxation": 0.7, "memory": 0.3},
}


@pytest.mark.parametrize("parts", [LAGGING, CUT], ids=["lag", "cut cells"])
def test_step_operator_equals_the_step(parts):
    data = sheet(initial={"type": "noise", "amplitude": 0.1}, **parts)
    for group in data["leaders"]:
        group["motion"] = HOLD
    scene = scene_of(data)
    operator, engine = step_operator(scene), Stepper(scene)
    follow, lead = (scene.raster.place_of(rows) for rows in (operator.followers, operator.leaders))

    def table(planes, place):
        return planes.reshape(2, -1)[:, place].T.ravel().copy()

    state = engine.advance(initial_state(scene))
    step = operator.current @ table(state.u, follow) + operator.previous @ table(
        state.previous, follow
    )
    step += operator.leader @ table(state.u, lead) + operator.source
    after = table(engine.advance(state).u, follow)
    free = np.setdiff1d(np.arange(len(after)), operator.prescribed_unknowns)
    assert len(operator.prescribed_unknowns) > 0
    assert np.abs(step - after)[free].max() < 1e-15
    assert not operator.current[operator.prescribed_unknowns].nnz
    assert not operator.current[:, operator.prescribed_unknowns].nnz


@pytest.mark.parametrize("method", ["matrix", "stencils"])
def test_rollers_need_no_more_iterations_than_clamps(method, monkeypatch):
    if method == "matrix":
        monkeypatch.setattr("pbdkit.equilibrium.linearise.find_spec", lambda _: None)

    def iterations(**clamped):
        data = sheet(60, 40, solver={"type": "equilibrium", "method": "multigrid"})
        data["leaders"] = [group | clamped for group in data["leaders"]][:: 2 if clamped else 1]
        return equilibrium_state(scene_of(data))[1].inner_iterations

    assert iterations() <= iterations(axes=["x", "y"]) + 4


def test_check_predicts_the_step_of_a_sheet_on_rollers():
    """Its modes are those of the whole sheet, of twice the size, that are symmetric."""
    moving = {"type": "velocity", "velocity": [0.02, 0.0], "steps": 100}
    data = sheet(5, 4, steps=100)
    data["leaders"][2]["motion"] = moving
    found = forecast(scene_of(data))
    assert not [text for text in found.warnings if "reaches" in text or "holds" in text]
    assert 0.0 < found.spectral_radius < 1.0
    end = run(data).u.values[-1]
    rest = run(data | {"solver": {"type": "equilibrium"}}).u.values[-1]
    behind = np.linalg.norm(rest - end, axis=1).max()
    assert found.lag_reached == pytest.approx(behind, rel=1e-6)


def test_run_converges_on_rollers():
    settle = {"tolerance": 1e-6}
    solver = {"type": "stepping", "memory": 0.6, "settle": settle}
    ds = run(sheet(steps=5000, record={"every": 5000}, solver=solver))
    assert ds.status == "settled"
    assert np.abs(ds.u.values[-1, :, 0] - STRETCH * ds.reference.values[:, 0]).max() < 1e-7


def test_free_direction_keeps_its_mean():
    data = sheet(solver={"type": "equilibrium"})
    data["leaders"] = [data["leaders"][0], data["leaders"][2]]
    u = run(data).u.values[-1]
    assert np.abs(u[:, 1].mean()) < 1e-12
    y = data["body"]["rows"] - 1
    assert np.ptp(u[:, 1]) == pytest.approx(0.3 * STRETCH * y)


def test_groups_contradict_each_other_only_on_a_common_axis():
    data = sheet()
    data["leaders"][1]["axes"] = ["x"]
    data["leaders"][1]["motion"] = {"type": "displace", "displacement": [0.1, 0.0]}
    with pytest.raises(pbdkit.ExperimentError, match=r"leaders\.1: moves particle 1 .*leaders\.0"):
        run(data)
    turn = {"type": "rotation", "centre": [0.0, 0.0], "angle": 1.0, "steps": 3}
    data["leaders"] = [
        {"select": {"edge": "left"}, "motion": HOLD, "axes": ["x"]},
        {"select": {"edge": "left"}, "motion": turn, "from": 3, "axes": ["x"]},
    ]
    written = pbdkit.Experiment(**data).model_dump(mode="json", by_alias=True)
    for unit in (1.0, 2.0**-40, 2.0**40):
        with pytest.raises(pbdkit.ExperimentError, match="two groups move particle 2 differently"):
            run(changed(written, Change(unit)))


@pytest.mark.parametrize(
    ("axes", "text"),
    [
        (["x", "x"], "axes has an axis twice: x, x"),
        (["z"], "should be 'x' or 'y'"),
        ([], "should have at least 1"),
        ("x", "should be a list"),
    ],
)
def test_invalid_axes_are_refused(axes, text):
    data = sheet()
    data["leaders"][0]["axes"] = axes
    with pytest.raises(pbdkit.ExperimentError, match=text):
        pbdkit.Experiment(**data)


def test_group_without_axes_omits_them():
    data = sheet()
    del data["leaders"][0]["axes"]
    groups = pbdkit.Experiment(**data).model_dump(mode="json")["leaders"]
    assert "axes" not in groups[0]
    assert groups[1]["axes"] == ["y"]
