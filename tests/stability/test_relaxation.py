"""Relaxation and memory `auto`: the best of the spectrum, chosen once, kept with the result."""

from __future__ import annotations

import json
import math
import re
from itertools import product
from typing import Any, Literal

import numpy as np
import pytest
from property_cases import BOTH_ENDS_HELD, FRAMES, LATTICES, RULES, experiment

import pbdkit
from pbdkit.components.rules import Springs
from pbdkit.linear.spectrum import has_symmetric_rows
from pbdkit.plugin import length
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stability.analysis import Analysis
from pbdkit.stability.forecast import forecast
from pbdkit.stability.relaxation import (
    MARGIN,
    NoStableWeightsError,
    StepWeights,
    best_weights,
    tuned,
)

AUTO = {"type": "stepping", "engine": "numpy", "relaxation": "auto", "memory": "auto"}
OTHERS = {"none": {"type": "none"}, "mean": FRAMES["mean"], "first": FRAMES["first"],
          "wide": FRAMES["wide"]}  # fmt: skip
MIRRORED = ("square", "rectangular")
ELASTIC = {"type": "elastic", "poisson_ratio": 0.3}
SPRINGS = {"type": "springs"}
EIGHT, SIX = {"type": "chebyshev", "shells": 1}, {"type": "coordination", "shells": 1}
CALIBRATED = [
    *product(["square"], [ELASTIC, SPRINGS], [EIGHT], ["natural", "mean"]),
    *product(["hexagonal"], [ELASTIC, SPRINGS], [SIX], ["natural", "mean"]),
    ("square", {"type": "strain-gradient", "poisson_ratio": 0.2, "length": 1.5}, EIGHT, "natural"),
]


def scene_of(columns: int = 6, rows: int = 5, **parts: Any) -> Scene:
    given = {"leaders": BOTH_ENDS_HELD, "solver": AUTO} | parts
    return build_scene(pbdkit.Experiment(**experiment(columns, rows, **given)))


def chosen(scene: Scene) -> StepWeights:
    return StepWeights(*(getattr(scene.experiment.stepping, name) for name in StepWeights._fields))


def rate(scene: Scene) -> float:
    found = Analysis(scene).spectral_radius
    assert found is not None
    return found


@pytest.mark.parametrize("lattice", LATTICES)
def test_choice_converges_for_every_rule_lattice_and_frame(lattice):
    frames = dict(OTHERS, mirror={"type": "mirror"}) if lattice in MIRRORED else OTHERS
    pairs = [("barycentre", frame) for frame in frames] + [(rule, "mean") for rule in RULES]
    for rule, frame in pairs:
        parts = {"lattice": lattice, "neighbours": "chebyshev-1", "frame": frames[frame]}
        scene = tuned(scene_of(5, 4, rule=rule, **parts))
        assert rate(scene) < 1.0, (rule, frame)


@pytest.mark.parametrize(("lattice", "rule", "neighbours", "frame"), CALIBRATED)
def test_choice_converges_for_calibrated_rules(lattice, rule, neighbours, frame):
    parts = {"lattice": lattice, "rule": rule, "neighbours": neighbours}
    assert rate(tuned(scene_of(**parts, frame={"type": frame}))) < 1.0


def test_choice_equals_the_heavy_ball_optimum():
    """λ of a sheet with held ends is known: m and M are 1 - λ at the ends."""
    scene = tuned(scene_of(12, 12))
    slowest = (1 + math.cos(math.pi / 11)) / 2
    m, M = 1 - slowest, 1 - Analysis(scene).smallest_eigenvalue
    root = (math.sqrt(M) - math.sqrt(m)) / (math.sqrt(M) + math.sqrt(m))
    assert chosen(scene) == pytest.approx((4 / (math.sqrt(m) + math.sqrt(M)) ** 2, root**2))
    assert rate(scene) == pytest.approx(root, abs=1e-6)


def test_nearby_weights_are_not_better():
    for z in (np.linspace(0.01, 1.9, 60), np.linspace(0.01, 1.5, 60) + 0.02j):
        modes = np.concatenate([1 - z, 1 - z.conj()])
        best = best_weights(modes)
        for dw, db in product((-0.01, 0.0, 0.01), repeat=2):
            near = StepWeights(best.relaxation + dw, best.memory + db)
            assert near.rate(modes) > best.rate(modes) - 1e-5


def test_given_number_is_kept():
    modes = 1 - np.linspace(0.01, 1.9, 60).astype(complex)
    relaxed = scene_of(solver=AUTO | {"memory": 0.25})
    assert tuned(relaxed).experiment.stepping.memory == 0.25
    assert best_weights(modes, memory=0.0).relaxation == pytest.approx(2 / 1.91)
    assert best_weights(modes, relaxation=1.0).memory == pytest.approx(0.81)
    for given in ({"relaxation": 2.5}, {"memory": 1.0}):
        with pytest.raises(NoStableWeightsError):
            best_weights(modes, **given)


@pytest.mark.parametrize("parts", [{}, {"rule": SPRINGS, "neighbours": EIGHT}])
def test_spectral_ends_of_large_bodies_are_found_by_iteration(parts):
    """The modes of 24 × 24 with four neighbours have a closed form; those of the springs come from
    the analysis of the choice."""
    scene = tuned(scene_of(24, 24, **parts))
    w, b = chosen(scene)
    assert rate(scene) < math.sqrt(b) + 1e-3
    if not parts:
        m = (1 - math.cos(math.pi / 23)) / 2
        assert (1 - math.sqrt(b)) ** 2 / w == pytest.approx(m, rel=3 * MARGIN)


def test_result_contains_the_weights_and_reruns_with_them():
    noise = {"type": "noise", "amplitude": 0.1}
    given = experiment(solver=AUTO, leaders=BOTH_ENDS_HELD, initial=noise)
    first = pbdkit.run(given, progress=False)
    solver = json.loads(first.attrs["experiment"])["solver"]
    assert (solver["relaxation"], solver["memory"]) == chosen(tuned(scene_of()))
    again = pbdkit.rerun(first, progress=False)
    assert np.array_equal(first.position, again.position)
    assert json.loads(again.attrs["experiment"])["solver"] == solver


@pytest.mark.parametrize(
    ("parts", "text"),
    [
        ({"frame": {"type": "mean", "lag": 1}}, "a frame with delay depends on earlier ones; set "
         "frame.lag: 0, or give numbers"),
        ({"neighbours": {"type": "euclidean", "radius": 1.1, "reevaluate": True}},
         "which does not exist if neighbours are re-evaluated; set "
         "neighbours.reevaluate: false"),
        ({"solver": AUTO | {"relaxation": 4.0}}, "no value of memory makes all modes decay with "
                                                 "relaxation "
         "4; give numbers, or omit them (relaxation 1, memory 0)"),
    ],
)  # fmt: skip
def test_impossible_choice_names_the_remedy(parts, text):
    with pytest.raises(pbdkit.ExperimentError) as caught:
        tuned(scene_of(**parts))
    assert caught.value.where == ("solver",)
    assert text in str(caught.value)


def test_check_prints_the_choice_and_its_basis(call):
    auto = ["--set", "solver.memory=auto", "--set", "solver.relaxation=auto"]
    linear = call("check", "paper/a", *auto).out
    assert "  chosen     relaxation 1.83, memory 0.789057\n" in linear
    torn = call("check", "paper/d1", *auto).out
    assert ", for the step linearised at rest: the rule is not linear or bonds can break" in torn
    found = json.loads(call("check", "paper/a", "--json", *auto[:2]).out)
    assert (found["relaxation"], found["memory"]) == (1.0, pytest.approx(0.841661, abs=1e-6))


PULLED = [
    {"select": {"edge": "left"}, "motion": {"type": "hold"}},
    {
        "select": {"edge": "right"},
        "motion": {"type": "velocity", "velocity": [0.01, 0.0], "steps": 200},
    },
]
SPRINGS = {
    "name": "springs",
    "body": {"type": "grid", "columns": 12, "rows": 6},
    "lattice": {"type": "hexagonal", "a": 1.0},
    "rule": {"type": "springs"},
    "frame": {"type": "natural"},
    "leaders": PULLED,
    "steps": 300,
}


def test_choice_for_a_nonlinear_rule_is_stable_in_the_deformed_body():
    auto = {"solver": {"type": "stepping", "relaxation": "auto", "memory": "auto"}}
    ds = pbdkit.run(SPRINGS | auto, progress=False)
    assert ds.attrs["status"] == "complete"
    relaxation = json.loads(ds.attrs["experiment"])["solver"]["relaxation"]
    assert relaxation < 0.85 * pbdkit.analyse(SPRINGS | auto).largest_stable_relaxation


def test_check_and_run_name_one_limit_for_a_nonlinear_rule():
    solver = {"solver": {"type": "stepping", "relaxation": 3.59, "memory": 0.79194}, "steps": 1}
    predicted = forecast(pbdkit.analyse(SPRINGS | solver).scene)
    (warning,) = [text for text in predicted.warnings if "can diverge" in text]
    assert f"it is stable below {predicted.largest_stable_relaxation:.4g}" in warning
    with pytest.warns(pbdkit.errors.StabilityWarning, match=re.escape(warning)):
        pbdkit.run(SPRINGS | solver, progress=False)


class Cubic(Springs):
    """Springs with a cubic term that equals the linear one at an elongation of 0.1."""

    type: Literal["cubic"] = "cubic"

    @staticmethod
    def energy(d, r, w, p):
        energy = Springs.energy(d, r, w, p)
        return energy + 50.0 * energy * (length(r + d) - w.rest) ** 2


@pytest.mark.parametrize(
    ("rule", "velocity", "words"),
    [
        (
            "cubic",
            0.01,
            ["'stress' is computed from strains by the linear elasticity", "'reaction'"],
        ),
        ("cubic", 1e-5, []),
        ("springs", 0.01, []),
    ],
)
def test_stress_of_a_nonlinear_rule_has_a_warning_where_strains_are_large(rule, velocity, words):
    motion = {"type": "velocity", "velocity": [velocity, 0.0], "steps": 200}
    leaders = [PULLED[0], PULLED[1] | {"motion": motion}]
    given = SPRINGS | {
        "rule": {"type": rule},
        "leaders": leaders,
        "diagnostics": [{"type": "stress", "youngs_modulus": 1.0}],
    }
    scene = pbdkit.analyse(given, components=[Cubic]).scene
    warnings = [text for text in forecast(scene).warnings if text.startswith("diagnostics.0")]
    assert len(warnings) == bool(words)
    assert [word for word in words if word not in warnings[0]] == []


@pytest.mark.parametrize("name", ["memory", "threads"])
def test_invalid_word_gives_one_message(name, call):
    told = call("check", "paper/a", "--set", f"solver.{name}=aut").err
    assert f"solver.{name}: should be a number or 'auto', got 'aut'; did you mean 'auto'?" in told
    assert "literal" not in told


def test_weights_not_yet_chosen_have_no_value():
    with pytest.raises(pbdkit.ExperimentError, match="has no value yet"):
        _ = scene_of().experiment.stepping.memory


def test_symmetrisable_rows_have_real_eigenvalues():
    from scipy.sparse import csr_array

    even = np.array([[0.0, 2.0, 0.0], [0.5, 0.0, 3.0], [0.0, 1.0, 1.0]])
    assert has_symmetric_rows(csr_array(even))
    assert not has_symmetric_rows(csr_array(even * [[1, -1, 1]]))
