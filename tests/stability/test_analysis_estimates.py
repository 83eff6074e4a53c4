"""Estimates for large bodies, against exact results for small ones, and omitted predictions."""

import json
import math

import pytest
from property_cases import HOLD_LEFT, experiment, pull_right, scene_of

import pbdkit
from pbdkit.stability.analysis import Analysis, StabilityEstimate
from pbdkit.stability.distance import distance_from_equilibrium

pytest.importorskip("numba")

LEADERS = [HOLD_LEFT, pull_right(0.01, 0.0, 300)]
ELASTIC = {"type": "elastic", "poisson_ratio": 0.3}
BODIES = {
    "barycentre": {"rule": "barycentre"},
    "wide": {"rule": "barycentre", "columns": 30, "rows": 80},
    "relaxed": {"rule": "barycentre", "solver": {"type": "stepping", "relaxation": 0.7}},
    "elastic": {"rule": ELASTIC, "neighbours": "chebyshev-1", "frame": {"type": "natural"}},
    "hexagonal": {
        "rule": {"type": "springs"},
        "lattice": "hexagonal",
        "frame": {"type": "natural"},
    },
    "unsymmetric": {
        "rule": "distance-weighted",
        "neighbours": "chebyshev-1",
        "solver": {"type": "stepping", "relaxation": 0.7},
    },
}


def body(columns=48, rows=40, **parts):
    return scene_of(columns=columns, rows=rows, leaders=LEADERS, steps=300, **parts)


@pytest.mark.parametrize("parts", BODIES.values(), ids=BODIES)
def test_estimates_are_close_to_exact_values(parts):
    """1 - λ of the slowest mode within 1 %, the smallest eigenvalue within 2 % of the width of the
    spectrum, the lag within 2 %."""
    scene = body(**parts)
    exact, estimate = Analysis(scene), StabilityEstimate(scene)
    own, found = exact.spectra.of_rule, estimate.spectrum
    assert not exact.estimated
    assert 1 - found.largest == pytest.approx(1 - own.largest, rel=0.01)
    assert 1 - found.smallest == pytest.approx(1 - own.smallest, rel=0.02)
    slowness = 1 / (scene.experiment.stepping.relaxation * (1 - found.largest))
    distance = distance_from_equilibrium(scene, estimate.at_rest, estimate.system, slowness)
    assert distance.steady == pytest.approx(exact.leader_distance.steady, rel=0.02)


def test_coarse_grids_suffice_for_large_bodies(monkeypatch):
    """1 - λ = ½ (1 - cos(π/N)) within 1 %, without a turn on the finest grid."""
    monkeypatch.setattr("pbdkit.stability.analysis.LARGE_BODY", 0)
    scene = body(240, 60)
    exact = (1 - math.cos(math.pi / 239)) / 2
    assert 1 - StabilityEstimate(scene).spectrum.largest == pytest.approx(exact, rel=0.01)


def test_sign_changing_waves_decay_before_the_slowest_mode():
    """The barycentre on the square lattice: waves have -1, held bodies nothing beyond -ρ."""
    found = StabilityEstimate(body()).spectrum
    assert found.smallest == -found.largest
    assert found.radius < 1.0


def estimated(monkeypatch, **parts):
    """The analysis of a body that counts as large."""
    monkeypatch.setattr("pbdkit.stability.analysis.LARGEST_REPEATED", 0)
    return Analysis(body(**{"columns": 16, "rows": 12} | parts))


def test_stability_follows_from_the_estimate(monkeypatch):
    analysis = estimated(monkeypatch, rule="distance-weighted", neighbours="chebyshev-1")
    bound = analysis.largest_stable_relaxation
    assert analysis.estimated
    assert analysis.stable is False
    assert analysis.stable_at(0.99 * bound, 0.0)
    assert not analysis.stable_at(1.01 * bound, 0.0)
    assert any(f"it is stable below {bound:.4g}" in w for w in analysis.warnings())


LEFT_OUT = {
    "period": (
        {"solver": {"type": "stepping", "memory": 0.3}},
        "the period is omitted, because a body",
    ),
    "edges": (
        {"frame": {"type": "none"}, "solver": {"type": "stepping", "relaxation": 0.95}},
        "0.95 is near the bound of plane waves, 1.006, and at edges without a frame",
    ),
}


@pytest.mark.parametrize(("parts", "said"), LEFT_OUT.values(), ids=LEFT_OUT)
def test_limits_of_an_estimate_are_reported(parts, said, monkeypatch):
    (found,) = [w for w in estimated(monkeypatch, **parts).warnings() if said in w]
    assert found


def test_distance_of_an_unsupported_body_is_omitted_with_a_message(monkeypatch):
    """At first one particle moves, around which an elastic body turns freely."""
    pull = {"type": "velocity", "velocity": [0.01, 0.0], "steps": 9}
    first = {"select": {"numbers": [30]}, "motion": pull, "until": 9}
    monkeypatch.setattr("pbdkit.stability.analysis.LARGEST_REPEATED", 0)
    parts = BODIES["elastic"] | {"leaders": [first, HOLD_LEFT | {"from": 10}], "steps": 40}
    analysis = Analysis(scene_of(16, 12, **parts))
    assert analysis.spectrum
    assert analysis.leader_distance is None
    assert any(
        "the distance from equilibrium is omitted, because the leaders do not " in w
        for w in analysis.warnings()
    )


def test_changing_neighbours_are_not_analysed_and_check_reports_it():
    anew = {"type": "euclidean", "radius": 1.1, "reevaluate": True}
    (said,) = [w for w in pbdkit.analyse(experiment(neighbours=anew)).warnings() if "omitted" in w]
    assert said.endswith("are omitted, neighbours are re-evaluated at every step")


def test_check_estimates_for_a_body_too_large_for_a_matrix(call):
    sheet = ["body.columns=231", "body.rows=220", "leaders.1.motion.velocity=[0.01, 0.0]"]
    options = [word for setting in sheet for word in ("--set", setting)]
    figures = json.loads(call("check", "paper/a", *options, "--json").out)
    assert figures["estimated"]
    assert figures["stable"]
    assert figures["lag"] == pytest.approx(4 * 0.01 * 230**2 / (9 * math.sqrt(3)), rel=0.02)
    assert not any("omitted" in w for w in figures["warnings"])
