"""The solver `equilibrium` finds the state to which steps lead, and its error bound is never below
the error."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import assume, given
from scene_strategies import experiments, samples

import pbdkit
from pbdkit.cli import program
from pbdkit.equilibrium.load_stepping import changes
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import initial_state

STRAIGHT = {"type": "equilibrium"}
LEFT = {"select": {"edge": "left"}, "motion": {"type": "hold"}}


def pulled(dx, dy=0.0, **more):
    motion = {"type": "displace", "displacement": [dx, dy]}
    return {"select": {"edge": "right"}, "motion": motion, **more}


def sheet(columns=12, rows=10, **parts):
    return {
        "name": "sheet",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "grid", "columns": columns, "rows": rows},
        "rule": {"type": "barycentre"},
        "leaders": [LEFT, pulled(1.0)],
        "diagnostics": [{"type": "displacement"}],
        "steps": 60,
        "solver": STRAIGHT,
    } | parts


def run(given):
    return pbdkit.run(given, progress=False)


def error_bound(ds):
    return json.loads(ds.attrs["certificate"])


@pytest.mark.parametrize("method", ["lu", "multigrid", "conjugate-gradients"])
@pytest.mark.parametrize("size", [10, 60])
def test_every_method_solves_the_affine_sheet_within_its_error_bound(method, size):
    ds = run(sheet(size, size, solver=STRAIGHT | {"method": method, "tolerance": 1e-10}))
    exact = ds.reference.isel(axis=0) / (size - 1)
    body = ds.kind.isel(time=-1) < 2
    error = abs(ds.u.isel(time=-1, axis=0) - exact).where(body).max()
    known = error_bound(ds)
    assert error <= known["distance"] <= 1e-10
    assert ds.attrs["status"] == "complete"
    assert ds.time.values.tolist() == list(range(61))
    assert abs(ds.u.isel(time=-1, axis=1)).max() <= known["distance"]


def came_to_rest(state):
    """Return whether the last of some steps, in which every drawn motion has ended, moved
    nothing."""
    last, scale = np.abs(state.u - state.previous).max(), max(1.0, np.abs(state.u).max())
    return state.step >= 100 and last < 1e-15 * scale


@pytest.mark.filterwarnings("ignore::pbdkit.PbdkitWarning")  # drawn scenes may be doubtful
@samples(2)
@given(experiments())
def test_stepping_random_scenes_leads_to_their_equilibrium(experiment):
    """If steps from the start converge, they do so within the error bound."""
    assume(experiment["fracture"]["type"] == "none")
    assume(experiment["rule"]["type"] != "distance-weighted")
    assume(not experiment["neighbours"].get("reevaluate"))
    steps = 600
    try:
        relaxed = {"type": "stepping", "relaxation": 1.0}
        scene = build_scene(pbdkit.Experiment(**experiment | {"solver": relaxed, "steps": steps}))
        assume(not changes(scene, steps))  # equilibria do not wait for them
        straight = run(experiment | {"solver": STRAIGHT, "steps": steps, "diagnostics": []})
        stepper, state = Stepper(scene), initial_state(scene)
        while not (rests := came_to_rest(state)) and state.step < steps:
            state = stepper.advance(state, 100)
        assume(rests)
    except (pbdkit.ExperimentError, pbdkit.DivergedError):
        assume(False)
    u = scene.raster.table(state.u)
    scale = max(1.0, np.abs(u).max())
    found = (straight.position[-1] - straight.reference).values
    reached = error_bound(straight)["distance"] + 1e-9 * scale
    assert np.abs(found - u).max() <= reached


LAST = {"every": 10_000}
"""Records of the last step alone."""


@pytest.mark.parametrize("until", [7, 600])
def test_released_body_keeps_its_mean_displacement_at_rest(until):
    """If there is no leader in the last step, the mean at the release remains, that of the body at
    rest."""

    def parts(until):
        leaders = [LEFT | {"until": until}, pulled(2.0, 1.0, until=until)]
        return {"leaders": leaders, "steps": 1_200, "record": LAST}

    straight = run(sheet(6, 4, **parts(until)))
    stepped = run(sheet(6, 4, **parts(600), solver={"type": "stepping"}))
    np.testing.assert_allclose(straight.u[-1], stepped.u[-1], rtol=0, atol=1e-8)
    assert abs(straight.u[-1]).max() > 0.5


@pytest.mark.parametrize("lag", [0, 1])
def test_late_leaders_start_at_the_equilibrium_position(lag):
    """Stopping works in any step, also after so long that steps rest there."""

    def parts(begin):
        held = {"select": {"nearest": [[2.0, 2.0]]}, "motion": {"type": "hold"}, "from": begin}
        leaders = [LEFT | {"until": begin - 1}, pulled(1.0, 0.5), held]
        frame = {"type": "mean", "lag": lag}
        return {"leaders": leaders, "frame": frame, "steps": 1_500, "record": LAST}

    straight = [run(sheet(6, 4, **parts(begin))) for begin in (2, 6, 600)]
    stepped = run(sheet(6, 4, **parts(600), solver={"type": "stepping"}))
    for ds in straight:
        np.testing.assert_allclose(ds.u[-1], stepped.u[-1], rtol=0, atol=1e-7)
    assert abs(stepped.u[-1]).max() > 0.5


@pytest.mark.parametrize("nu", [0.3, 0.4, 0.49])
@pytest.mark.parametrize("begin", [30, 300])
def test_late_leaders_start_at_rest_if_undamped_steps_diverge(nu, begin):
    parts = {
        "neighbours": {"type": "chebyshev", "shells": 1},
        "rule": {"type": "elastic", "poisson_ratio": nu},
        "frame": {"type": "natural"},
    }
    held = {"select": {"nearest": [[4.0, 3.0]]}, "motion": {"type": "hold"}, "from": begin}
    ends = [LEFT, pulled(0.1, 0.03)]
    ds = run(sheet(9, 6, leaders=[*ends, held], steps=begin + 1, record=LAST, **parts))
    rest = run(sheet(9, 6, leaders=ends, steps=1, **parts))
    np.testing.assert_allclose(ds.u[-1], rest.u[-1], rtol=0, atol=1e-10)


def test_late_leaders_hold_a_loaded_body_where_steps_have_moved_it():
    """The load moves the body as a whole in each step before."""
    parts = {
        "neighbours": {"type": "chebyshev", "shells": 1},
        "rule": {"type": "elastic", "poisson_ratio": 0.3},
        "frame": {"type": "natural"},
        "loads": [{"select": {"edge": "right"}, "force": [0.01, 0.004]}],
    }
    held = run(sheet(5, 4, **parts, leaders=[LEFT | {"from": 8}], steps=9, record=LAST))
    stepped = run(sheet(5, 4, **parts, leaders=[], steps=7, solver={"type": "stepping"}))
    left = np.isclose(held.reference[:, 0], 0.0)
    np.testing.assert_allclose(held.u[-1][left], stepped.u[-1][left], rtol=0, atol=1e-15)
    assert abs(stepped.u[-1][left]).max() > 1e-4


def test_check_lists_changes_before_which_the_body_converges(tmp_path):
    leaders = [LEFT | {"until": 9}, pulled(1.0, 0.5), LEFT | {"from": 30}]
    path = tmp_path / "late.yaml"
    load = {"select": {"edge": "top"}, "force": [0.0, 1e-3], "from": 13}
    rule = {"type": "elastic", "poisson_ratio": 0.3}
    parts = {"rule": rule, "neighbours": {"type": "chebyshev", "shells": 1}, "loads": [load]}
    path.write_text(json.dumps(sheet(leaders=leaders, **parts, record=LAST)))
    output = CliRunner().invoke(program, ["check", str(path)]).output
    assert "also before leaders or loads change, after steps 9, 12, 29" in output


def test_load_before_leaders_is_refused_if_steps_diverge():
    push = {"select": {"edge": "right"}, "force": [0.1, 0.0]}
    parts = {
        "neighbours": {"type": "chebyshev", "shells": 1},
        "rule": {"type": "elastic", "poisson_ratio": 0.45},
        "frame": {"type": "natural"},
    }
    with pytest.raises(
        pbdkit.ExperimentError, match=r"at step 9 .* is loaded, but not constrained"
    ):
        run(sheet(6, 5, leaders=[LEFT | {"from": 10}], loads=[push], record=LAST, **parts))


def test_nonlinear_rule_is_relinearised_and_rests_at_the_solution():
    solver = STRAIGHT | {"tolerance": 1e-10}
    ds = run(sheet(9, 7, rule={"type": "distance-weighted"}, leaders=[LEFT, pulled(3.0, 1.0)],
                   solver=solver))  # fmt: skip
    known = error_bound(ds)
    assert known["linearised"]
    assert known["iterations"] > 1
    assert known["residual"] < 1e-10


def test_fracture_by_increments_breaks_only_overlong_bonds():
    fracture = {"type": "threshold", "thresholds": [1.52]}
    motion = {"type": "velocity", "velocity": [0.5, 0.0], "steps": 20}
    leaders = [LEFT, {"select": {"edge": "right"}, "motion": motion}]
    whole = run(sheet(9, 5, leaders=leaders, fracture={"type": "threshold", "thresholds": [9.0]}))
    assert (whole.broken_step == -1).all()
    torn = run(sheet(9, 5, leaders=leaders, fracture=fracture))
    # Affine until the bonds reach 1.5: at step 8 the sheet of 8 bonds is 4 longer, at step 9 4.5.
    assert set(torn.broken_step.values[torn.broken_step.values >= 0].tolist()) == {9}
    assert torn.attrs["status"] == "complete"


def test_endless_motions_are_refused():
    swinging = {"type": "oscillation", "amplitude": [1.0, 0.0], "period": 30.0}
    leaders = [LEFT, {"select": {"edge": "right"}, "motion": swinging}]
    with pytest.raises(pbdkit.ExperimentError, match=r"leaders.1.motion.*never comes to rest"):
        run(sheet(leaders=leaders))


class Pushed(pbdkit.FollowerRule):
    """A barycentre that also goes its own way."""

    type: str = "pushed"

    @staticmethod
    def gather(d, r, w, p):
        return (d,)

    @staticmethod
    def apply(total, here, p):
        return total[0] / 4 + pbdkit.plugin.Vector(0.01, 0.0)


def test_part_under_unbalanced_load_is_refused_by_name():
    with pytest.raises(pbdkit.ExperimentError, match=r"a part of 12 particles \(with number"):
        run(sheet(4, 3, rule=Pushed(type="pushed"), leaders=[]))
    held = run(sheet(4, 3, rule=Pushed(type="pushed")))
    assert error_bound(held)["distance"] < 1e-8


class Limited(Pushed):
    """A barycentre that fails at large displacements."""

    type: str = "limited"

    @staticmethod
    def apply(total, here, p):
        if np.max(np.abs(here.u.x)) > 2.0:
            raise OverflowError("displacements exceed 2")
        return total[0] / 4


def test_an_error_of_a_rule_names_the_rule_and_the_step():
    leaders = [LEFT, pulled(3.0)]
    with pytest.raises(pbdkit.PluginError, match=r"'limited'.* at step 60: .*exceed 2"):
        run(sheet(4, 3, rule=Limited(type="limited"), leaders=leaders))


def test_tolerance_below_rounding_is_reported_as_unreachable(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        pbdkit.DivergedError, match="rounding errors limit the relative distance"
    ) as caught:
        run(sheet(30, 30, solver=STRAIGHT | {"tolerance": 1e-16}))
    assert caught.value.dataset.attrs["status"] == "unconverged"
    change = "solver={type: equilibrium, tolerance: 1e-16}"
    result = CliRunner().invoke(program, ["run", "paper/b", "--set", change])
    assert "unconverged: rounding errors" in result.output


def test_changing_neighbours_have_no_equilibrium_solver():
    neighbours = {"type": "euclidean", "radius": 1.1, "reevaluate": True}
    with pytest.raises(pbdkit.ExperimentError, match="an equilibrium is not defined"):
        run(sheet(neighbours=neighbours))
