"""Cases in which a naive program goes wrong (the numbers are those of physics.md's table), and
patches whose equilibrium is known."""

import numpy as np
import pytest
from property_cases import (
    BOTH_ENDS_HELD,
    HOLD_LEFT,
    LATTICES,
    advanced,
    displace,
    displacements,
    experiment,
    pull_right,
    scene_of,
    step_map,
)

import pbdkit

every_lattice = pytest.mark.parametrize("lattice", LATTICES)
RELAXED = {"type": "stepping", "relaxation": 0.9}


@every_lattice
@pytest.mark.parametrize("neighbours", ["coordination-1", "chebyshev-1"])
@pytest.mark.parametrize("rule", ["barycentre", "mean-displacement"])
def test_affine_leaders_all_round_make_an_affine_interior(lattice, neighbours, rule):
    parts = {"lattice": lattice, "neighbours": neighbours, "rule": rule}
    scene = scene_of(7, 7, **parts)
    body, reach = scene.raster, scene.neighbourhood.reach
    gradient, shift = np.array([[0.2, -0.1], [0.3, 0.4]]), np.array([0.5, -0.7])
    expected = body.reference() @ gradient.T + shift
    outside = (body.site_table() < reach) | (body.site_table() > 6 - reach)
    rim = [n for n in body.body_rows.tolist() if outside[n].any()]
    leaders = [displace([n + 1], *expected[n].tolist()) for n in rim]
    u = displacements(7, 7, leaders=leaders, steps=400, solver=RELAXED, **parts)[-1]
    # The slowest mode has decayed by (1 - 0.9 (1 - cos(π/6)))^400 = 1e-22.
    np.testing.assert_allclose(u[body.body_rows], expected[body.body_rows], rtol=0, atol=1e-12)


@pytest.mark.parametrize("stretch", [0.4, 0.9, 9.0])
@pytest.mark.parametrize(
    ("lattice", "neighbours"),
    [
        ("square", "coordination-1"),
        ("square", "chebyshev-1"),
        ("rectangular", "chebyshev-1"),
        ("hexagonal", "coordination-1"),
    ],
)
def test_case_1_the_equilibrium_of_a_stretched_sheet_is_affine(lattice, neighbours, stretch):
    parts = {"lattice": lattice, "neighbours": neighbours}
    raster = scene_of(6, 6, **parts).raster
    X, ends = raster.reference(), np.isin(raster.site_table()[:, 0], (0, 5))
    expected = np.stack([stretch * X[:, 0], np.zeros(len(X))], axis=1)
    rows = [n for n in raster.body_rows.tolist() if ends[n]]
    leaders = [displace([n + 1], *expected[n].tolist()) for n in rows]
    u = displacements(6, 6, leaders=leaders, steps=600, solver=RELAXED, **parts)[-1]
    inside = raster.body_rows
    np.testing.assert_allclose(u[inside], expected[inside], rtol=0, atol=1e-12 * max(1, stretch))
    assert not u[:, 1].any()


def test_case_5_collinear_neighbours_are_warned_of():
    oblique = {"type": "oblique", "a": 1.0, "b": 1.0, "angle": 5.0}
    (warning,) = scene_of(lattice=oblique, neighbours="coordination-1").warnings
    assert "along one line only" in warning
    assert "chebyshev" in warning
    assert not scene_of(lattice=oblique, neighbours="chebyshev-1").warnings


def test_case_6_a_component_without_leader_stays_put():
    flat = {"type": "rectangular", "a": 1.0, "b": 2.5}
    scene = scene_of(lattice=flat)
    assert "rows do not feel each other" in scene.warnings[0]
    one = int(scene.raster.body_rows[0]) + 1
    u = displacements(lattice=flat, leaders=[displace([one], 1.0, 0.5)], steps=50)[-1]
    row = scene.raster.site_table()[:, 1]
    assert not u[row >= 1].any()
    assert u[row == 0].any(axis=1).all()


@every_lattice
def test_case_7_a_single_follower_in_its_frame_stays_put(lattice):
    start = np.array([[0.3, -0.2]])
    u = advanced(scene_of(1, 1, lattice=lattice), start, 50)
    # Its frame stands as it does: only rounding of the mean of equal numbers can move it.
    np.testing.assert_allclose(u[-1], start, rtol=0, atol=1e-14)
    assert not displacements(1, 1, lattice=lattice, steps=50).any()


@pytest.mark.parametrize("frame", ["mean", {"type": "none"}], ids=["mean", "none"])
def test_case_9_coincident_particles_stay_under_distance_weights(frame):
    scene = scene_of(5, 4, rule="distance-weighted", frame=frame)
    at_origin = -scene.raster.reference(scene.raster.body_rows)
    if frame == "mean":
        # The frame copies displacements and is not at the origin: look at who does not see it.
        inside = ((scene.raster.site_of(scene.raster.body_rows) % (4, 3)) != 0).all(axis=1)
    else:
        inside = np.ones(20, bool)
    u = advanced(scene, at_origin, 20)
    assert np.isfinite(u).all()
    assert np.array_equal(u[1][inside], at_origin[inside])
    if frame != "mean":
        assert np.array_equal(u[-1], at_origin)


@every_lattice
@pytest.mark.parametrize("neighbours", ["coordination-1", "coordination-2"])
@pytest.mark.parametrize("h", [0.1, 0.7, 1.0, 1.23, 1 / 3, 1e-7, 123.4])
def test_case_10_nothing_breaks_at_rest_at_a_threshold_of_the_rest_distance(lattice, neighbours, h):
    scaled = {k: h * v if k in ("a", "b") else v for k, v in LATTICES[lattice].items()}
    parts = {"lattice": scaled, "neighbours": neighbours, "leaders": BOTH_ENDS_HELD}
    shells = scene_of(**parts).neighbourhood.shells()
    fracture = {"type": "threshold", "thresholds": [max(lengths) for lengths in shells]}
    ds = pbdkit.run(experiment(fracture=fracture, **parts, steps=5), progress=False)
    assert (ds.broken_step == -1).all()


@pytest.mark.parametrize("h", [0.1, 0.7, 1.0, 1.23, 2.37, 123.4])
def test_case_10_a_hexagonal_threshold_written_as_the_spacing_breaks_nothing_at_rest(h):
    parts = {"lattice": {"type": "hexagonal", "a": h}, "leaders": BOTH_ENDS_HELD}
    fracture = {"type": "threshold", "thresholds": [h]}
    ds = pbdkit.run(experiment(fracture=fracture, **parts, steps=5), progress=False)
    assert (ds.broken_step == -1).all()


@pytest.mark.parametrize("below", [1e-16, 2e-13, 5e-13, 8e-13, 2e-12, 1e-9])
def test_case_10_a_threshold_that_is_accepted_does_not_break_a_body_at_rest(below):
    fracture = {"type": "threshold", "thresholds": [1.0 - below]}
    try:
        ds = pbdkit.run(experiment(fracture=fracture, steps=2), progress=False)
    except pbdkit.ExperimentError:
        refused_or_whole = True
    else:
        refused_or_whole = bool((ds.broken_step == -1).all())
    assert refused_or_whole


@every_lattice
@pytest.mark.parametrize("far", [1e6, 1e8, 1e12])
def test_cases_12_and_19_far_from_the_origin_the_same_bonds_break_and_the_same_moves_are_made(
    lattice, far
):
    fracture = {"type": "threshold", "thresholds": [2.2]}
    leaders = [HOLD_LEFT, pull_right(0.35, 0.1)]
    near, away = (
        pbdkit.run(
            experiment(
                lattice=LATTICES[lattice] | {"origin": origin},
                neighbours="chebyshev-1",
                fracture=fracture,
                leaders=leaders,
            ),
            progress=False,
        )
        for origin in ([0.0, 0.0], [far, -far])
    )
    assert (near.broken_step > 0).any()
    assert not (near.broken_step > 0).all()
    assert np.array_equal(near.broken_step, away.broken_step)
    assert np.array_equal(near.u, away.u)


def test_case_24_a_diagnostic_beyond_the_finite_numbers_is_an_error_with_step_and_particle():
    leaders = [displace([9], 1e200, 0.0)]
    given = experiment(leaders=leaders, diagnostics=[{"type": "pe1"}], steps=3)
    with pytest.raises(pbdkit.DivergedError, match=r"particle \d+ at step 1") as caught:
        pbdkit.run(given, progress=False)
    assert np.isfinite(caught.value.dataset.pe1).all()
    assert caught.value.dataset.status == "diverged"


def test_case_14_leaders_all_round_give_a_symmetric_spectrum_and_settle():
    edges = [{"select": {"edge": e}, "motion": {"type": "hold"}} for e in ("bottom", "top")]
    scene = scene_of(7, 6, leaders=[*BOTH_ENDS_HELD, *edges])
    values = np.linalg.eigvalsh(step_map(scene))
    np.testing.assert_allclose(values, -values[::-1], rtol=0, atol=1e-14)
    assert values[-1] == pytest.approx((np.cos(np.pi / 6) + np.cos(np.pi / 5)) / 2, abs=1e-14)
    start = np.zeros((42, 2))
    start[15] = 1.0
    assert np.abs(advanced(scene, start, 400)[-1]).max() < 1e-12


def test_case_23_a_step_is_jacobi_every_follower_sees_the_same_configuration():
    scene = scene_of(5, 4)
    site = scene.raster.site_of(scene.raster.body_rows).tolist()
    u = np.random.default_rng(2).normal(size=(20, 2))
    expected = np.zeros_like(u)
    for n, (i, j) in enumerate(site):
        # A copying frame hands back the displacement of the particle at the edge.
        near = [(min(max(i + p, 0), 4), min(max(j + q, 0), 3))
                for p, q in ((1, 0), (-1, 0), (0, 1), (0, -1))]  # fmt: skip
        expected[n] = np.mean([u[site.index(list(s))] for s in near], axis=0)
    np.testing.assert_allclose(advanced(scene, u, 1)[1], expected, rtol=0, atol=1e-15)
