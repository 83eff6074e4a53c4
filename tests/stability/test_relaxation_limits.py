"""Relaxations for which a step converges and diverges: the tables of largest stable relaxations."""

import numpy as np
import pytest
from property_cases import BOTH_ENDS_HELD, advanced, body_sites, scene_of
from scene_strategies import in_turn

from pbdkit.components.neighbours import Chebyshev, Coordination
from pbdkit.lattice.neighbourhood import build_neighbourhood
from pbdkit.simulation import Simulation
from pbdkit.stability.forecast import forecast

SQUARE = {"type": "square", "a": 1.0}
HEXAGONAL = {"type": "hexagonal", "a": 1.0}
RECTANGULAR = {"type": "rectangular", "a": 1.0, "b": 1.3}
CENTRED = {"type": "centred-rectangular", "a": 1.0, "b": 1.2}
OBLIQUE = {"type": "oblique", "a": 1.0, "b": 1.0, "angle": 75.0}

AVERAGING = {
    "square-4": (SQUARE, "coordination", 1, 1.0),
    "chebyshev-8": (SQUARE, "chebyshev", 1, 4 / 3),
    "chebyshev-24": (SQUARE, "chebyshev", 2, 1.536),
    "hexagonal-6": (HEXAGONAL, "coordination", 1, 4 / 3),
    "hexagonal-18": (HEXAGONAL, "coordination", 3, 1.607),
    "rectangular-4": (RECTANGULAR, "coordination", 2, 1.0),
    "centred-4": (CENTRED, "coordination", 1, 1.0),
    "oblique-4": (OBLIQUE, "coordination", 1, 1.0),
}
"""lattice, neighbours, shells, largest stable relaxation 2/(1 - λ_min)."""

DISTANCE_WEIGHTED = {
    "square-4": (SQUARE, "coordination", 1, 0.667),
    "chebyshev-8": (SQUARE, "chebyshev", 1, 0.774),
    "hexagonal-6": (HEXAGONAL, "coordination", 1, 0.853),
}
NOISE = 1e-6
"""A body of 32 x 32 reaches each bound within 0.6 %: its waves are not quite the worst ones."""


def step_sizes(lattice, neighbours, shells, rule, relaxation, steps, columns):
    """max |u(t + 1) - u(t)| from noise between held ends, (step,)."""
    scene = scene_of(
        columns,
        columns,
        lattice=lattice,
        neighbours={"type": neighbours, "shells": shells},
        rule=rule,
        leaders=BOTH_ENDS_HELD,
        solver={"type": "stepping", "relaxation": relaxation},
    )
    site = body_sites(scene)
    start = NOISE * np.random.default_rng(0).uniform(-1, 1, (len(site), 2))
    start[np.isin(site[:, 0], (0, columns - 1))] = 0.0
    return np.abs(np.diff(advanced(scene, start, steps), axis=0)).max(axis=(1, 2))


@pytest.mark.parametrize(
    ("case", "rule"),
    [
        (case, ("barycentre", "mean-displacement")[n % 2])
        for n, case in enumerate(in_turn(AVERAGING, 3))
    ],
)
def test_averaging_converges_1_percent_inside_its_bound_and_not_outside(case, rule):
    *where, bound = AVERAGING[case]
    inside, outside = (
        step_sizes(*where, rule, bound * factor, 600, columns=32) for factor in (0.99, 1.01)
    )
    assert inside[-1] < inside[300] < inside[0]
    assert outside[-1] > 1.2 * outside[300]


@pytest.mark.parametrize("case", DISTANCE_WEIGHTED)
def test_distance_weights_converge_1_percent_inside_their_bound_only(case):
    *where, bound = DISTANCE_WEIGHTED[case]
    inside, outside = (
        step_sizes(*where, "distance-weighted", bound * factor, 400, columns=24)
        for factor in (0.99, 1.01)
    )
    assert inside[-1] < inside[200] < inside[0]
    assert outside[-1] > 1.2 * outside[200]


def test_distance_weighted_rule_diverges_and_is_stable_at_relaxation_0_6():
    # Hard case 15: λ_min = -2 on the infinite lattice, so that noise grows by nearly 2 a step.
    printed = step_sizes(SQUARE, "coordination", 1, "distance-weighted", 1.0, 60, columns=10)
    assert printed[:50].max() > 0.1
    assert 1.85 < printed[18] / printed[17] < 2.0
    relaxed = step_sizes(SQUARE, "coordination", 1, "distance-weighted", 0.6, 400, columns=10)
    assert relaxed[-1] < 1e-3 * relaxed[0]


@pytest.mark.parametrize(
    ("lattice", "metric", "d", "lambda_min"),
    [
        (SQUARE, Coordination(), 1 / 4, -1.0),
        (SQUARE, Chebyshev(), 3 / 8, -1 / 2),
        (SQUARE, Chebyshev(shells=2), 25 / 24, -0.302),
        (HEXAGONAL, Coordination(), 1 / 4, -1 / 2),
        (HEXAGONAL, Coordination(shells=3), 2 / 3, -0.2449),
    ],
    ids=["square-4", "chebyshev-8", "chebyshev-24", "hexagonal-6", "hexagonal-18"],
)
def test_neighbourhoods_match_the_table_of_diffusivity_and_eigenvalues(
    lattice, metric, d, lambda_min
):
    cell = scene_of(lattice=lattice).experiment.lattice.cell()
    rest = np.array([slot.rest for slot in build_neighbourhood(cell, metric).slots[0]])
    second_moment = rest.T @ rest / len(rest)
    np.testing.assert_allclose(second_moment, 2 * d * np.eye(2), rtol=0, atol=1e-14)
    k = np.linspace(-2 * np.pi, 2 * np.pi, 401)
    waves = np.stack(np.meshgrid(k, k), axis=-1)
    symbol = np.cos(waves @ rest.T).mean(axis=-1)
    # Near its smallest value the symbol is a parabola: the spacing 0.03 of k costs < 3e-4.
    assert symbol.min() == pytest.approx(lambda_min, abs=1e-3)


def test_no_warning_for_an_equilibrium_that_smaller_steps_reach():
    """It makes no steps; where no relaxation leads there, it is."""
    gradient = {"type": "strain-gradient", "poisson_ratio": 0.3, "length": 2.0}
    parts = {
        "neighbours": "chebyshev-1",
        "rule": gradient,
        "frame": {"type": "natural"},
        "leaders": [{"select": {"edge": "left"}, "motion": {"type": "hold"}}],
    }
    stepping, straight = {"type": "stepping"}, {"type": "equilibrium"}
    warned = [
        [w for w in forecast(scene_of(**parts, solver=solver)).warnings if "diverges" in w]
        for solver in (stepping, straight)
    ]
    assert len(warned[0]) == 1
    assert warned[1] == []
    assert not any(
        "diverge" in w for w in Simulation.of_scene(scene_of(**parts, solver=straight)).warnings
    )
