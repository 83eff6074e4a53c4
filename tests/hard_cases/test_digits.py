"""Cases 10, 12, 18, 19 and 23 of the stability page: what rounding and the order of the
particles may not do, beside naive programs to which they do it."""

import numpy as np
import pytest
from property_cases import (
    BOTH_ENDS_HELD,
    HOLD_LEFT,
    LATTICES,
    advanced,
    experiment,
    pull_right,
    scene_of,
)

import pbdkit

every_lattice = pytest.mark.parametrize("lattice", LATTICES)


def naively_broken(spacing, origin):
    """The share of bonds of a square sheet at rest that are longer than its spacing, where lengths
    are differences of positions."""
    x, y = np.meshgrid(*[origin + spacing * np.arange(20.0)] * 2)
    lengths = [np.hypot(np.diff(x, axis=k), np.diff(y, axis=k)) for k in (0, 1)]
    return np.mean(np.concatenate([length.ravel() for length in lengths]) > spacing)


@every_lattice
@pytest.mark.parametrize("neighbours", ["coordination-1", "coordination-2"])
@pytest.mark.parametrize("h", [0.1, 0.7, 1.0, 1.23, 1 / 3, 1e-7, 123.4])
@pytest.mark.filterwarnings("ignore:neighbours. all lie along one line")
def test_case_10_nothing_breaks_at_rest_at_the_rest_distance(lattice, neighbours, h):
    scaled = {k: h * v if k in ("a", "b") else v for k, v in LATTICES[lattice].items()}
    parts = {"lattice": scaled, "neighbours": neighbours, "leaders": BOTH_ENDS_HELD}
    shells = scene_of(**parts).neighbourhood.shells()
    fracture = {"type": "threshold", "thresholds": [max(lengths) for lengths in shells]}
    ds = pbdkit.run(experiment(fracture=fracture, **parts, steps=5), progress=False)
    assert (ds.broken_step == -1).all()


@pytest.mark.parametrize("h", [0.1, 0.7, 1.0, 1.23, 2.37, 123.4])
def test_case_10_a_hexagonal_threshold_equal_to_the_spacing_breaks_nothing(h):
    parts = {"lattice": {"type": "hexagonal", "a": h}, "leaders": BOTH_ENDS_HELD}
    fracture = {"type": "threshold", "thresholds": [h]}
    ds = pbdkit.run(experiment(fracture=fracture, **parts, steps=5), progress=False)
    assert (ds.broken_step == -1).all()


@pytest.mark.parametrize("below", [1e-16, 2e-13, 5e-13, 8e-13, 2e-12, 1e-9])
@pytest.mark.filterwarnings("ignore:leaders. the experiment has neither")
def test_case_10_an_accepted_threshold_breaks_nothing_at_rest(below):
    fracture = {"type": "threshold", "thresholds": [1.0 - below]}
    try:
        ds = pbdkit.run(experiment(fracture=fracture, steps=2), progress=False)
    except pbdkit.ExperimentError:
        refused_or_whole = True
    else:
        refused_or_whole = bool((ds.broken_step == -1).all())
    assert refused_or_whole


def test_case_10_lengths_from_positions_break_bonds_at_rest():
    assert naively_broken(0.1, 0.0) == pytest.approx(0.42, abs=0.005)
    assert naively_broken(1.23, 0.0) == pytest.approx(0.58, abs=0.005)


def near_and_away(far, **parts):
    """The run near the origin is the same as far from it."""
    origins = [{"origin": [0.0, 0.0]}, {"origin": [far, -far]}]
    given = [experiment(**parts | {"lattice": parts["lattice"] | at}) for at in origins]
    return (pbdkit.run(one, progress=False) for one in given)


@every_lattice
def test_case_12_the_same_bonds_break_far_from_the_origin(lattice):
    parts = {"lattice": LATTICES[lattice], "neighbours": "chebyshev-1"}
    parts |= {"leaders": [HOLD_LEFT, pull_right(0.35, 0.1)]}
    fracture = {"type": "threshold", "thresholds": [2.2]}
    near, away = near_and_away(1e6, **parts, fracture=fracture)
    assert (near.broken_step > 0).any()
    assert not (near.broken_step > 0).all()
    assert np.array_equal(near.broken_step, away.broken_step)
    assert np.array_equal(near.u, away.u)
    assert naively_broken(0.1, 1e6) == pytest.approx(0.21, abs=0.005)


def by_positions(columns, pull, steps, dtype, origin=0.0):
    """Displacements of a square sheet, its right column pulled and its left one held, stepped
    naively: positions in the given precision."""
    X = np.indices((columns + 2, columns + 2)).astype(dtype) + dtype(origin - 1)
    x = X.copy()
    for _ in range(steps):
        x[0, -2, 1:-1] = dtype(origin + columns - 1 + pull)
        new = (x[:, 2:, 1:-1] + x[:, :-2, 1:-1] + x[:, 1:-1, 2:] + x[:, 1:-1, :-2]) / dtype(4)
        x[:, 2:-2, 1:-1] = new[:, 1:-1]
        x = X + np.pad((x - X)[:, 1:-1, 1:-1], ((0, 0), (1, 1), (1, 1)), mode="edge")
    return x - X


def test_case_18_single_precision_keeps_its_digits_in_displacements():
    pull = {"select": {"edge": "right"}, "motion": {"type": "displace", "displacement": [0.35, 0]}}
    given = experiment(20, 20, leaders=[HOLD_LEFT, pull], steps=2000, record={"every": 2000})
    single = given | {"solver": {"type": "stepping", "precision": "float32"}}
    full, short = (pbdkit.run(e, progress=False).u.values[-1] for e in (given, single))
    full_x, short_x = (by_positions(20, 0.35, 2000, t) for t in (np.float64, np.float32))
    # Both step the same sheet.
    assert np.abs(full_x.reshape(2, -1).T - full).max() < 1e-12
    assert np.abs(short - full).max() < 1.7e-6
    assert np.abs(short_x - full_x).max() > 1e-4


@every_lattice
@pytest.mark.parametrize("far", [1e8, 1e12])
@pytest.mark.filterwarnings("ignore:neighbours. all lie along one line")
def test_case_19_displacements_are_the_same_far_from_the_origin(lattice, far):
    parts = {"lattice": LATTICES[lattice], "leaders": [HOLD_LEFT, pull_right(0.35, 0.1)]}
    near, away = near_and_away(far, **parts, steps=60)
    assert np.abs(near.u).max() > 1.0
    assert np.array_equal(near.u, away.u)
    # Positions are sums, and keep what a double keeps there.
    assert np.abs(away.position - (away.reference + near.u)).max() <= np.spacing(far)


@pytest.mark.parametrize(("far", "error"), [(1e8, 5e-8), (1e12, 1e-3)])
def test_case_19_a_position_based_program_loses_digits_far_from_the_origin(far, error):
    near, away = (by_positions(20, 0.35, 1000, np.float64, at) for at in (0.0, far))
    assert np.abs(away - near).max() > error


def test_case_23_a_step_is_a_jacobi_iteration():
    scene = scene_of(5, 4)
    site = scene.raster.site_of(scene.raster.body_rows).tolist()
    u = np.random.default_rng(2).normal(size=(len(site), 2))
    # A copying frame hands back the displacement of the particle at the edge.
    near = [[site.index([min(max(i + p, 0), 4), min(max(j + q, 0), 3)])
             for p, q in ((1, 0), (-1, 0), (0, 1), (0, -1))] for i, j in site]  # fmt: skip
    found = advanced(scene, u, 1)[1]
    np.testing.assert_allclose(found, u[near].mean(axis=1), rtol=0, atol=1e-15)

    def in_place(order):
        v = u.copy()
        for n in order:
            v[n] = v[near[n]].mean(axis=0)
        return v

    forward, backward = in_place(range(20)), in_place(range(19, -1, -1))
    assert np.abs(forward - backward).max() > 0.1


def test_case_23_results_do_not_depend_on_particle_numbers():
    """The second sheet is the same, numbered along its rows in place of its columns, with x and y
    exchanged."""
    u = np.random.default_rng(3).normal(size=(4, 5, 2))
    one = advanced(scene_of(4, 5), u.reshape(20, 2), 30)[-1].reshape(4, 5, 2)
    swapped = u.transpose(1, 0, 2)[..., ::-1]
    other = advanced(scene_of(5, 4), swapped.reshape(20, 2), 30)[-1].reshape(5, 4, 2)
    np.testing.assert_allclose(other.transpose(1, 0, 2)[..., ::-1], one, rtol=0, atol=1e-14)
