"""Analytic answers: spectra, rates, periods and closed forms of physics.md, met by the program."""

import numpy as np
import pytest
from property_cases import (
    BOTH_ENDS_HELD,
    HOLD_LEFT,
    LATTICES,
    advanced,
    body_sites,
    displacements,
    experiment,
    followers_of,
    pull_right,
    scene_of,
    step_map,
)

import pbdkit

CHEBYSHEV_8 = {"type": "chebyshev", "shells": 1}
SQUARE_4 = {"type": "coordination", "shells": 1}


def closed_form(columns, rows, neighbours):
    """Return all eigenvalues of the step between two held end columns, with a copying frame."""
    a = np.cos(np.arange(1, columns - 1) * np.pi / (columns - 1))[:, None]
    b = np.cos(np.arange(rows) * np.pi / rows)[None, :]
    values = (a + b) / 2 if neighbours is SQUARE_4 else (2 * a + 2 * b + 4 * a * b) / 8
    return np.sort(values.ravel())


def slowest(columns):
    """The spectral radius on square 4: p = 1, q = 0."""
    return (np.cos(np.pi / (columns - 1)) + 1) / 2


def along_sine(scene, u):
    """The part of u_x in the slowest mode, sin(πi/N), (step,)."""
    i = body_sites(scene)[:, 0]
    mode = np.sin(np.pi * i / i.max())
    return u[..., 0] @ mode / (mode @ mode)


@pytest.mark.parametrize("neighbours", [SQUARE_4, CHEBYSHEV_8], ids=["square-4", "chebyshev-8"])
@pytest.mark.parametrize(("columns", "rows"), [(5, 4), (9, 6), (8, 7), (4, 1)])
def test_every_eigenvalue_of_the_step_has_its_closed_form(neighbours, columns, rows):
    scene = scene_of(columns, rows, neighbours=neighbours, leaders=BOTH_ENDS_HELD)
    step = step_map(scene)
    np.testing.assert_allclose(step, step.T, rtol=0, atol=1e-15)
    expected = closed_form(columns, rows, neighbours)
    np.testing.assert_allclose(np.linalg.eigvalsh(step), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("neighbours", [SQUARE_4, CHEBYSHEV_8], ids=["square-4", "chebyshev-8"])
def test_a_released_body_decays_at_the_predicted_rate(neighbours):
    release = pull_right(0.5, 0.0, steps=2) | {"until": 2}
    hold = {"select": {"edge": "right"}, "motion": {"type": "displace", "displacement": [-1, 0]}}
    parts = {"neighbours": neighbours, "columns": 8, "rows": 5}
    leaders = [HOLD_LEFT, release, hold | {"from": 3}]
    u = displacements(leaders=leaders, steps=300, **parts)
    size = np.linalg.norm(u[:, :, 0], axis=1)
    # 150 steps in, the next slower mode has lost a factor of (0.87/0.95)^150 = 1e-6 more.
    measured = (size[300] / size[150]) ** (1 / 150)
    assert measured == pytest.approx(closed_form(8, 5, neighbours)[-1], rel=1e-7)


@pytest.mark.parametrize("columns", [10, 20])
def test_the_steps_to_a_tolerance_are_predicted_within_5_percent(columns):
    pull = {"select": {"edge": "right"}, "motion": {"type": "displace", "displacement": [1, 0]}}
    predicted = np.log(1e-6) / np.log(slowest(columns))
    u = displacements(columns, 4, leaders=[HOLD_LEFT, pull], steps=int(predicted * 1.1))
    site = scene_of(columns, 4).raster.site_table()[:, 0]
    equilibrium = np.clip(site, 0, columns - 1) / (columns - 1)
    error = np.abs(u[:, :, 0] - equilibrium).max(axis=1)
    counted = int(np.argmax(error < 1e-6))
    assert counted == pytest.approx(predicted, rel=0.05)


@pytest.mark.parametrize(("columns", "period"), [(20, 76.07), (10, None)])
def test_momentum_1_oscillates_with_the_predicted_period(columns, period):
    predicted = 2 * np.pi / np.arccos((1 + slowest(columns)) / 2)
    assert period is None or predicted == pytest.approx(period, abs=0.005)
    solver = {"type": "stepping", "memory": 1.0}
    parts = {"columns": columns, "rows": columns, "leaders": BOTH_ENDS_HELD, "solver": solver}
    scene = scene_of(**parts)
    start = np.random.default_rng(0).normal(size=(len(body_sites(scene)), 2)) * 0.1
    start[np.isin(body_sites(scene)[:, 0], (0, columns - 1))] = 0.0
    amplitude = along_sine(scene, advanced(scene, start, int(10.5 * predicted)))
    sign_changes = np.flatnonzero(amplitude[1:] * amplitude[:-1] < 0)
    before, after = amplitude[sign_changes], amplitude[sign_changes + 1]
    zeros = sign_changes + before / (before - after)
    measured = 2 * (zeros[-1] - zeros[0]) / (len(zeros) - 1)
    # Straight lines between steps misplace a zero by less than 1e-3 of a step, over 10 periods.
    assert measured == pytest.approx(predicted, abs=1e-3)


def test_with_momentum_every_mode_satisfies_its_quadratic():
    columns, rows, b = 6, 4, 0.6
    solver = {"type": "stepping", "memory": b}
    scene = scene_of(columns, rows, leaders=BOTH_ENDS_HELD, solver=solver)
    plain = step_map(scene_of(columns, rows, leaders=BOTH_ENDS_HELD))
    start = np.random.default_rng(0).normal(size=(len(body_sites(scene)), 2))
    followers = followers_of(scene)
    start[np.setdiff1d(np.arange(len(start)), followers)] = 0.0
    u = advanced(scene, start, 20)[:, followers, 0]
    # μ² - (λ + b) μ + b = 0 is u(t+1) = (P + b) u(t) - b u(t-1) in the eigenvectors of P.
    for t in range(1, 20):
        expected = u[t] @ plain.T + b * (u[t] - u[t - 1])
        np.testing.assert_allclose(u[t + 1], expected, rtol=0, atol=1e-13)


def test_distance_behind_moving_leaders_matches_the_formula():
    columns, v = 20, 0.0035
    steps = 1500  # ten relaxation times of 147 steps
    u = displacements(columns, 3, leaders=[HOLD_LEFT, pull_right(v, 0.0, steps)], steps=steps)
    length = columns - 1
    site = np.clip(scene_of(columns, 3).raster.site_table()[:, 0], 0, length)
    lag = (v * steps * site / length - u[-1, :, 0]).max()
    predicted = 4 * v * length**2 / (9 * np.sqrt(3))
    assert predicted == pytest.approx(0.3242, abs=5e-5)
    assert lag == pytest.approx(predicted, rel=0.02)


@pytest.mark.parametrize(("rows", "steps"), [(6, 700), (10, 1500)])
def test_mixed_coordinates_contract_by_the_formula(rows, steps):
    kappa, epsilon, columns = 0.001, 0.01, 101
    rule = {"type": "mixed-coordinate", "K": -kappa}
    scene = scene_of(columns, rows, rule=rule, leaders=BOTH_ENDS_HELD)
    X = body_sites(scene).astype(float)
    y = X[:, 1] - (rows - 1) / 2
    start = np.stack([epsilon * X[:, 0], np.zeros(len(X))], axis=1)
    u = advanced(scene, start, steps)[-1]
    np.testing.assert_allclose(u[:, 0], epsilon * X[:, 0], rtol=0, atol=1e-12)
    # The held right end disturbs exp(-π d/rows) at a distance d; at x = 20 nothing is left of it.
    near = X[:, 0] <= 20
    formula = 4 * kappa * epsilon * X[:, 0] * (y**3 / 6 - (rows**2 / 8 + 1 / 24) * y)
    np.testing.assert_allclose(u[near, 1], formula[near], rtol=0, atol=1e-6 * epsilon)
    at_20 = u[X[:, 0] == 20, 1] / epsilon
    contraction = at_20.max() - at_20.min()
    # Between the outer rows, over their distance rows - 1, and per unit ε: 0.73333 for 10 rows.
    transverse_strain = contraction / (rows - 1)
    assert transverse_strain == pytest.approx(kappa * 20 * rows * (rows + 1) / 3, abs=1e-6)
    if rows == 10:
        assert transverse_strain == pytest.approx(0.73333, abs=5e-6)


def test_without_leaders_the_mean_is_invariant_under_a_mean_frame():
    solver = {"type": "stepping", "relaxation": 0.9}
    scene = scene_of(7, 6, solver=solver)
    start = np.random.default_rng(3).normal(size=(42, 2))
    u = advanced(scene, start, 800)
    np.testing.assert_allclose(u.mean(axis=1), np.broadcast_to(start.mean(axis=0), (801, 2)),
                               rtol=0, atol=1e-12)  # fmt: skip
    everywhere = np.broadcast_to(start.mean(axis=0), (42, 2))
    np.testing.assert_allclose(u[-1], everywhere, rtol=0, atol=1e-12)


@pytest.mark.parametrize("lattice", LATTICES)
@pytest.mark.parametrize("frame", ["mean", "first"])
def test_without_leaders_the_left_eigenvector_gives_the_invariant_mean(lattice, frame):
    parts = {"lattice": lattice, "frame": frame, "neighbours": CHEBYSHEV_8}
    scene = scene_of(5, 4, **parts)
    values, vectors = np.linalg.eig(step_map(scene).T)
    one = np.argmax(values.real)
    assert values[one] == pytest.approx(1.0, abs=1e-12)
    weight = vectors[:, one].real / vectors[:, one].real.sum()
    start = np.random.default_rng(3).normal(size=(20, 2))
    u = advanced(scene, start, 400)
    np.testing.assert_allclose(u[-1], np.tile(weight @ start, (20, 1)), rtol=0, atol=1e-10)


@pytest.mark.filterwarnings("ignore:leaders. all particles are leaders")
def test_released_translation_is_a_geometric_series_of_the_momentum():
    v, b = np.array([0.25, -0.5]), 0.5
    motion = {"type": "velocity", "velocity": v.tolist(), "steps": 3}
    everyone = {"select": {"box": [0, 0, 5, 4]}, "motion": motion, "until": 3}
    u = displacements(leaders=[everyone], solver={"type": "stepping", "memory": b}, steps=20)
    # All displacements are equal, so that the rule moves no particle:
    # u(t+1) = u(t) + b (u(t) - u(t-1)).
    travelled = [min(t, 3) + sum(b**n for n in range(1, t - 2)) for t in range(21)]
    expected = np.array(travelled)[:, None, None] * v
    np.testing.assert_allclose(u, np.broadcast_to(expected, u.shape), rtol=0, atol=1e-14)


def test_pe2_of_a_leader_is_the_length_of_its_step():
    leaders = [HOLD_LEFT, pull_right(0.3, -0.4, steps=4)]
    given = experiment(leaders=leaders, diagnostics=[{"type": "pe2"}], record={"every": 3})
    ds = pbdkit.run(given, progress=False)
    right = (ds.kind[0] == 0).values & (ds.site[:, 0] == 5).values
    # Against the step before, whatever is recorded; 0 at time 0 (model.md, section 8).
    expected = np.where((ds.time > 0) & (ds.time <= 4), 0.5, 0.0)[:, None]
    np.testing.assert_allclose(ds.pe2.values[:, right] - expected, 0.0, atol=1e-15)
