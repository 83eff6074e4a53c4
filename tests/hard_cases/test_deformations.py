"""Cases 1, 2, 3, 22 and 25 of the stability page: bodies that are stretched, pushed
through themselves, pulled fast and turned, against the equilibrium that they go to."""

import json
from pathlib import Path

import numpy as np
import pytest
from property_cases import (
    HOLD_LEFT,
    LATTICES,
    all_pairs,
    displace,
    displacements,
    experiment,
    pull_right,
    scene_of,
)
from scene_strategies import in_turn

import pbdkit

STABILITY = (Path(__file__).parents[2] / "docs/validation/stability.md").read_text("utf-8")
RELAXED = {"type": "stepping", "relaxation": 0.9}
sheets = pytest.mark.parametrize(
    ("lattice", "neighbours"),
    [
        ("square", "coordination-1"),
        ("square", "chebyshev-1"),
        ("rectangular", "chebyshev-1"),
        ("hexagonal", "coordination-1"),
    ],
)


def few_steps(steps):
    """Parts of a run of which only the first and last states are recorded."""
    return {"steps": steps, "record": {"every": steps}}


def stretched(lattice, neighbours, stretch):
    """Return parts of a 6 x 6 sheet with end columns at their places after a stretch along x, the
    rows of its body, its displacements in equilibrium, and its leaders."""
    parts = {"lattice": lattice, "neighbours": neighbours}
    raster = scene_of(6, 6, **parts).raster
    X, ends = raster.reference(), np.isin(raster.site_table()[:, 0], (0, 5))
    expected = np.stack([stretch * X[:, 0], np.zeros(len(X))], axis=1)
    rows = [n for n in raster.body_rows.tolist() if ends[n]]
    leaders = [displace([n + 1], *expected[n].tolist()) for n in rows]
    return parts, raster.body_rows, expected, leaders


@pytest.mark.parametrize(
    ("lattice", "neighbours", "rule"),
    in_turn(
        all_pairs(LATTICES, ["coordination-1", "chebyshev-1"], ["barycentre", "mean-displacement"]),
        2,
    ),
)
def test_affine_leaders_all_round_give_an_affine_interior(lattice, neighbours, rule):
    parts = {"lattice": lattice, "neighbours": neighbours, "rule": rule}
    scene = scene_of(7, 7, **parts)
    body, reach = scene.raster, scene.neighbourhood.reach
    gradient, shift = np.array([[0.2, -0.1], [0.3, 0.4]]), np.array([0.5, -0.7])
    expected = body.reference() @ gradient.T + shift
    outside = (body.site_table() < reach) | (body.site_table() > 6 - reach)
    rim = [n for n in body.body_rows.tolist() if outside[n].any()]
    leaders = [displace([n + 1], *expected[n].tolist()) for n in rim]
    u = displacements(7, 7, leaders=leaders, **few_steps(300), solver=RELAXED, **parts)[-1]
    # The slowest mode has decayed by (1 - 0.9 (1 - cos(π/6)))^300 = 1e-17.
    np.testing.assert_allclose(u[body.body_rows], expected[body.body_rows], rtol=0, atol=1e-12)


@pytest.mark.parametrize("stretch", in_turn([0.4, 0.9, 9.0], 2))
@sheets
def test_case_1_the_equilibrium_of_a_stretched_sheet_is_affine(lattice, neighbours, stretch):
    parts, inside, expected, leaders = stretched(lattice, neighbours, stretch)
    u = displacements(6, 6, leaders=leaders, **few_steps(400), solver=RELAXED, **parts)[-1]
    np.testing.assert_allclose(u[inside], expected[inside], rtol=0, atol=1e-12 * max(1, stretch))
    assert not u[:, 1].any()


@pytest.mark.parametrize("through", in_turn([1.001, 1.2, 3.0], 2))
@sheets
def test_case_2_an_inverted_sheet_has_signed_area_and_a_warning(lattice, neighbours, through):
    parts, _, _, leaders = stretched(lattice, neighbours, -through)
    cells = 50 if lattice == "hexagonal" else 25
    given = experiment(6, 6, leaders=leaders, **few_steps(400), solver=RELAXED, **parts)
    given |= {"diagnostics": [{"type": "smallest-cell-area"}]}
    message = (
        rf"inverted cells: {cells} of {cells} cells .* has -\S+ times its area .* reduce the "
        "displacement of the leaders"
    )
    with pytest.warns(pbdkit.PbdkitWarning, match=message):
        ds = pbdkit.run(given, progress=False)
    # The equilibrium is affine, of determinant 1 - through.
    np.testing.assert_allclose(ds.smallest_cell_area, [1.0, 1.0 - through], rtol=0, atol=1e-11)


def test_case_2_an_almost_flat_sheet_gives_no_warning(recwarn):
    parts, _, _, leaders = stretched("square", "coordination-1", -0.999)
    given = experiment(6, 6, leaders=leaders, **few_steps(400), solver=RELAXED, **parts)
    ds = pbdkit.run(given | {"diagnostics": [{"type": "smallest-cell-area"}]}, progress=False)
    assert ds.smallest_cell_area[-1] == pytest.approx(0.001, abs=1e-12)
    assert not recwarn.list


def coupled(K, reach):
    """A sheet with one particle of its right column pulled, under mixed coordinates."""
    rule = {"type": "mixed-coordinate", "K": K}
    return experiment(rule=rule, leaders=[HOLD_LEFT, displace([48], reach, 0.0)], steps=300)


def test_case_3_an_excessive_coupling_is_exact_and_gives_a_warning():
    """x does not feel y, and y is proportional to K: finite, and inside out."""
    with pytest.warns(pbdkit.PbdkitWarning, match="reduce the displacement of the leaders"):
        absurd = pbdkit.run(coupled(1e6, 0.5), progress=False).u.values
    small = pbdkit.run(coupled(2.0**-10, 0.5), progress=False).u.values
    assert np.array_equal(absurd[..., 0], small[..., 0])
    np.testing.assert_allclose(absurd[..., 1] / 1e6, small[..., 1] * 2.0**10, rtol=0, atol=1e-13)
    assert 4e6 < np.abs(absurd).max() < 5e6


@pytest.mark.parametrize("steps_of", ["one particle", "paper/b"])
def test_case_3_a_coupling_beyond_a_million_body_lengths_is_stopped(steps_of):
    wide = pbdkit.load("paper/b", settings=["rule.K=1e6"])
    given = coupled(1e6, 1.0) if steps_of == "one particle" else wide
    with pytest.raises(pbdkit.DivergedError, match="diverged under rule 'mixed-coordinate'"):
        pbdkit.run(given, progress=False)


@pytest.mark.parametrize(("columns", "speed"), [(14, 0.0035), (12, 0.35)])
def test_case_22_the_lag_behind_a_leader_matches_the_formula(columns, speed):
    """The steady lag w solves (1 - P) w = the motion of the equilibrium in a step, less the part
    that the leaders, which move first, pass on within the step: (2v/3N) i (N² - i² - 3/2), N =
    columns - 1."""
    N, steps = columns - 1, 10 * columns**2
    leaders = [HOLD_LEFT, pull_right(speed, 0.0, steps)]
    given = experiment(columns, 3, leaders=leaders, steps=steps, record={"every": steps})
    ds = pbdkit.run(given, progress=False)
    body = ds.kind[-1].values != 2
    i = ds.site.values[body, 0]
    lag = speed * steps * i / N - ds.u.values[-1, body, 0]
    expected = np.where(i < N, 2 * speed / (3 * N) * i * (N**2 - i**2 - 1.5), 0.0)
    np.testing.assert_allclose(lag, expected, rtol=0, atol=1e-8 * expected.max())
    # The continuous formula, 4vL² / 9√3.
    assert lag.max() == pytest.approx(4 * speed * N**2 / (9 * np.sqrt(3)), rel=0.023)


def test_case_22_a_fast_leader_stretches_its_first_bond_ninefold():
    long = ["body.columns=20", "record={every: 1}", "diagnostics=[{type: displacement}]"]
    ds = pbdkit.run(pbdkit.load("paper/a", settings=long), progress=False)
    row = ds.u.values[:, ((ds.kind[0] != 2) & (ds.site[:, 1] == 0)).values, 0]
    # All rows move alike: two of a follower's four neighbours stand where it stands.
    u = np.zeros(20)
    for step in range(1, 11):
        u[-1] = 0.35 * step
        u[1:-1] = u[1:-1] / 2 + (u[:-2] + u[2:]) / 4
        np.testing.assert_allclose(row[step], u, rtol=0, atol=1e-14)
    stretch = np.diff(row, axis=1).max()
    assert stretch == pytest.approx(1.6578, abs=1e-4)
    assert stretch / (3.5 / 19) == pytest.approx(9.0, abs=0.01)


def test_case_25_the_barycentre_does_not_follow_a_rotation_of_its_leaders():
    """The case is documented and warned of, and within its error bound of the equilibrium of its
    rule."""
    turn = {"type": "rotation", "centre": [5.5, 5.5], "angle": 1.0, "steps": 90}
    leaders = [{"select": {"edge": e}, "motion": turn} for e in ("left", "right")]
    given = experiment(12, 12, leaders=leaders, steps=90, solver={"type": "equilibrium"})
    with pytest.warns(pbdkit.PbdkitWarning, match="8 of 121 cells are inverted"):
        ds = pbdkit.run(given, progress=False)
    body = ds.kind[-1].values != 2
    away = (ds.reference.values[body] - 5.5).reshape(12, 12, 2)
    turned = np.stack([-away[..., 1], away[..., 0]], axis=2) - away
    u = np.where((np.arange(12) % 11 == 0)[:, None, None], turned, 0.0)
    for _ in range(2000):
        wide = np.pad(u, ((0, 0), (1, 1), (0, 0)), mode="edge")[1:-1]
        u[1:-1] = (wide[:, 2:] + wide[:, :-2] + u[2:] + u[:-2]) / 4
    found = ds.u.values[-1, body].reshape(12, 12, 2)
    assert np.abs(found - u).max() < json.loads(ds.certificate)["distance"] + 1e-13 < 1e-11
    assert np.abs(found - turned).max() == pytest.approx(3.29, abs=0.005)
    place = ds.position.values[-1, body].reshape(12, 12, 2)
    one, other = place[1:, 1:] - place[:-1, :-1], place[:-1, 1:] - place[1:, :-1]
    inside_out = one[..., 0] * other[..., 1] < one[..., 1] * other[..., 0]
    assert f"| {inside_out.sum()} of 121 cells are inverted (their signed area" in STABILITY
