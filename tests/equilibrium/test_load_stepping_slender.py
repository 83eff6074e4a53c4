"""Equilibria of bodies that are slender, soft, free to slide, or small: right, or refused."""

import json

import numpy as np
import pytest
from reliability import slender_bodies
from scene_strategies import in_turn

import pbdkit

HOLD = {"select": {"edge": "left"}, "motion": {"type": "hold"}}


def cantilever(columns, rows, force, a=1.0, **parts):
    return {
        "name": "cantilever",
        "lattice": {"type": "square", "a": a},
        "body": {"type": "grid", "columns": columns, "rows": rows},
        "neighbours": {"type": "chebyshev", "shells": 1},
        "rule": {"type": "elastic", "poisson_ratio": 0.3},
        "frame": {"type": "natural"},
        "leaders": [HOLD],
        "loads": [{"select": {"edge": "right"}, "force": force}],
        "steps": 1,
        "solver": {"type": "equilibrium", "tolerance": 1e-4},
        "diagnostics": [{"type": "displacement"}, {"type": "reaction", "youngs_modulus": 1.0}],
    } | parts


NO_REACTION = {"diagnostics": [{"type": "displacement"}]}


def soft(columns, rows, stiffness, nu=0.3):
    """A rule that is softer in a rectangle at the origin."""
    region = {"type": "rectangle", "width": columns, "height": rows, "origin": [-0.5, -9.0]}
    stiffnesses = {"otherwise": 1.0, "root": stiffness}
    rule = {"type": "elastic", "poisson_ratio": nu, "stiffness": stiffnesses}
    return {"regions": {"root": region}, "rule": rule}


def run(experiment):
    return pbdkit.run(experiment, progress=False)


@pytest.mark.filterwarnings("ignore::pbdkit.PbdkitWarning")
@pytest.mark.parametrize("n", in_turn(range(10), 2))
def test_equilibria_are_within_their_error_bounds(n):
    """A short sample of tests/reliability/slender_bodies.py."""
    experiment, known = slender_bodies.scene(np.random.default_rng([7, n]), 24)
    if experiment["solver"]["method"] == "multigrid":
        experiment["solver"]["method"] = "conjugate-gradients"  # no kernels are compiled
    assert not slender_bodies.trial(experiment, known).startswith("differs")


@pytest.mark.parametrize("load", [1e-10, 1e-6])
def test_softly_supported_body_is_supported(load):
    """Solved independently, a load of 1e-10 moves the tip by .03138."""
    ds = run(cantilever(60, 2, [0.0, -load], **soft(30.5, 99.0, 1e-3)))
    tip = -float(abs(ds.u.values[-1, :, 1]).max())
    bound = json.loads(ds.attrs["certificate"])["distance"]
    assert abs(tip / load + 3.138e8) < bound / load + 2e5
    assert float(ds.reaction.values[-1].sum(axis=0)[1]) == pytest.approx(load, rel=1e-3)


def test_block_on_the_softest_layer_is_supported():
    layer = {"type": "rectangle", "width": 99.0, "height": 1.0, "origin": [-9.0, 0.0]}
    rule = {
        "type": "elastic",
        "poisson_ratio": 0.0,
        "stiffness": {"otherwise": 1.0, "layer": 1e-9},
    }
    base = {"select": {"edge": "bottom"}, "motion": {"type": "hold"}}
    pull = {"select": {"edge": "top"}, "force": [0.0, 1e-12]}
    parts = {"regions": {"layer": layer}, "rule": rule, "leaders": [base], "loads": [pull]}
    parts["solver"] = {"type": "equilibrium", "tolerance": 1e-2}
    ds = run(cantilever(12, 12, None, **parts))
    stretch = float(ds.u.values[-1, :, 1].max())
    assert stretch == pytest.approx(1e-12 / (11 * 1e-9), rel=1e-4)


@pytest.mark.parametrize("columns", [600, 1500])
def test_slender_cantilevers_bend_like_beams(columns):
    """The deflection under a load is that of a shorter one by the cube of the lengths."""

    def softness(columns):
        experiment = cantilever(columns, 2, [0.0, -1e-12])
        experiment["solver"]["tolerance"] = 2e-2
        return -float(run(experiment).u.values[-1, :, 1].min()) / (columns - 1) ** 3

    assert softness(columns) == pytest.approx(softness(100), rel=2e-2)


def test_bodies_too_soft_for_double_precision_are_reported():
    experiment = cantilever(120, 2, [0.0, -1e-10], **soft(31.0, 99.0, 1e-8))
    with pytest.raises((pbdkit.ExperimentError, pbdkit.DivergedError), match="double precision"):
        run(experiment)


@pytest.mark.parametrize("a", [1e-9, 1e-6, 1.0, 1e9])
@pytest.mark.parametrize("strain", [1e-12, 1e-4])
@pytest.mark.parametrize("leaders", [[HOLD | {"axes": ["y"]}], []], ids=["sliding", "free"])
def test_unbalanced_load_is_refused_in_all_units(a, strain, leaders):
    push = [strain * 4 * a, 0.0]
    with pytest.raises(pbdkit.ExperimentError, match="is loaded, but not constrained"):
        run(cantilever(9, 5, push, a=a, leaders=leaders, **NO_REACTION))


@pytest.mark.parametrize("a", [1e-9, 1.0, 1e9])
def test_balanced_loads_do_not_move_a_free_body(a):
    loads = [
        {"select": {"edge": edge}, "force": [force * a, 0.0]}
        for edge, force in (("left", -0.004), ("right", 0.004))
    ]
    ds = run(cantilever(9, 5, None, a=a, leaders=[], loads=loads, **NO_REACTION))
    u = ds.u.values[-1] / a
    assert u[:, 0].max() - u[:, 0].min() == pytest.approx(0.001 * 8, rel=1e-6)
    assert abs(u.mean(axis=0)).max() < 1e-6


def test_stalled_iteration_certifies_nothing():
    solver = {"type": "equilibrium", "tolerance": 1e-3, "method": "conjugate-gradients"}
    with pytest.raises(pbdkit.DivergedError, match=r"does not converge.* set solver\.method: lu"):
        run(cantilever(200, 2, [0.0, -1e-6], solver=solver))


@pytest.mark.filterwarnings("error")
def test_multigrid_on_a_slender_soft_body_converges_or_stalls():
    pytest.importorskip("numba")
    parts = {
        "lattice": {"type": "hexagonal", "a": 1.0},
        "neighbours": {"type": "coordination", "shells": 1},
        "solver": {"type": "equilibrium", "method": "multigrid"},
    }
    experiment = cantilever(123, 2, [0.0, -1e-10], **soft(61.5, 99.0, 1e-3, 0.073)) | parts
    with pytest.raises(pbdkit.DivergedError, match=r"set solver\.method: lu"):
        run(experiment)


@pytest.mark.parametrize("power", [-20, 20])
def test_springs_reach_equilibrium_in_all_units(power):
    """If all lengths are scaled by a power of 2 all numbers are the same except for their
    exponent."""

    def found(a):
        way = {"type": "displace", "displacement": [0.3 * a, 0.15 * a]}
        ends = [HOLD, {"select": {"edge": "right"}, "motion": way}]
        parts = {"rule": {"type": "springs"}, "leaders": ends, "loads": []}
        ds = run(cantilever(9, 5, None, a=a, **parts))
        return ds.u.values[-1] / a, json.loads(ds.attrs["certificate"])

    (u, known), (scaled, same) = found(1.0), found(2.0**power)
    np.testing.assert_array_equal(scaled, u)
    assert same["share"] == known["share"]


@pytest.mark.parametrize("rule", [{"type": "elastic", "poisson_ratio": 0.3}, {"type": "springs"}])
def test_reachable_tolerance_is_named(rule):
    way = {"type": "displace", "displacement": [0.3, 0.15]}
    ends = [HOLD, {"select": {"edge": "right"}, "motion": way}]
    solver = {"type": "equilibrium", "tolerance": 1e-17}
    parts = {"leaders": ends, "loads": [], "solver": solver, "rule": rule}
    with pytest.raises(pbdkit.DivergedError, match="rounding errors limit") as caught:
        run(cantilever(9, 5, None, **parts))
    named = float(str(caught.value).partition("solver.tolerance: ")[2].partition(";")[0])
    assert named <= 1e-11
    assert run(cantilever(9, 5, None, **parts | {"solver": solver | {"tolerance": named}}))
