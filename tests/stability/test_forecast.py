"""Compare predictions before the first step with runs, on scenes drawn at random.

A run is compared with the same run of another start: their distance obeys the step without loads.
It is left alone until the slowest mode remains, then followed for the steps in which that changes
by a million by prediction. The excess over the prediction, a factor, stays within 10^(± 6 · 5 %),
that is within a factor of 2.
"""

import math

import numpy as np
from hypothesis import HealthCheck, Phase, assume, event, given, settings, strategies as st
from property_cases import (
    BOTH_ENDS_HELD,
    HOLD_LEFT,
    RULES,
    followers_of,
    scene_of,
)
from scene_strategies import AT_LENGTH, lattices, neighbours

import pbdkit
from pbdkit.linear.stencil import stability_remedy, wave_bound
from pbdkit.stability.analysis import Analysis
from pbdkit.stability.forecast import prediction
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.state import initial_state

MILLION, LONGEST, FIVE_PERCENT = math.log(1e6), 400, 2.0
BURN_IN = 300
FRAMES = [
    {"type": "none"},
    {"type": "mean"},
    {"type": "first"},
    {"type": "mean", "lag": 1},
    {"type": "first", "lag": 1},
    {"type": "mean", "layers": 1},
    {"type": "mean", "layers": 3},
    {"type": "mirror"},
]
LEADERS = [
    [],
    [HOLD_LEFT],
    BOTH_ENDS_HELD,
    [{"select": {"edge": "bottom"}, "motion": {"type": "hold"}}],
    [{"select": {"box": [0.1, 0.1, 2.0, 2.0]}, "motion": {"type": "hold"}}],
    [{"select": {"nearest": [[1.0, 1.0]]}, "motion": {"type": "hold"}}],
]
one_of = st.sampled_from
solvers = st.builds(
    lambda w, b: {"type": "stepping", "relaxation": w, "memory": b},
    st.just(1.0) | st.floats(0.2, 2.0),
    st.just(0.0) | st.floats(-0.9, 0.9),
)


@st.composite
def scenes(draw):
    """Parts of small bodies, held or free."""
    return {
        "columns": draw(st.integers(1, 7)),
        "rows": draw(st.integers(1, 7)),
        "lattice": draw(lattices),
        "neighbours": draw(neighbours),
        "frame": draw(one_of(FRAMES)),
        "rule": RULES[draw(one_of(list(RULES)))],
        "leaders": draw(one_of(LEADERS)),
        "solver": draw(solvers),
    }


def built(parts):
    try:
        return scene_of(**parts)
    except pbdkit.ExperimentError:
        assume(False)


class Pair:
    """Two runs of one scene, one of them from rest, and how far they are apart.

    Both go back to rest and noise where the difference is rescaled, which for linear rules
    changes nothing, and rules that are not start where rest stays.
    """

    def __init__(self, scene, seed, size, pushed):
        self.scene, self.size, self.pushed = scene, size, pushed
        self.stepper = Stepper(scene)
        raster = scene.raster
        self.followers = raster.place_of(raster.body_rows[followers_of(scene)])
        noise = size * np.random.default_rng(seed).uniform(-1, 1, (2, 2, len(self.followers)))
        start = initial_state(scene)
        now, before = (planes.reshape(2, -1) for planes in (start.u, start.previous))
        now[:, self.followers], before[:, self.followers] = noise
        if scene.frame:
            scene.frame.follow(before, before)
            scene.frame.follow(before if scene.frame.map.delay else now, now)
        self.restart(np.array([start.u, start.previous]))

    def restart(self, apart):
        """`apart`: all planes, now and before."""
        self.rest, self.moved = initial_state(self.scene), initial_state(self.scene)
        for planes, values in zip((self.moved.u, self.moved.previous), apart, strict=True):
            planes += values

    def advance(self, steps):
        self.moved = self.stepper.advance(self.moved, steps)
        if self.pushed:
            self.rest = self.stepper.advance(self.rest, steps)

    def apart(self):
        return np.array([self.moved.u - self.rest.u, self.moved.previous - self.rest.previous])

    def distance(self):
        """Along the loading axis for rules that have one: across it they are driven."""
        axis = getattr(self.scene.experiment.rule, "axis", None)
        apart = (self.moved.u - self.rest.u).reshape(2, -1)[:, self.followers]
        return float(np.abs(apart if axis is None else apart["xy".index(axis)]).max())

    def rescale(self):
        apart = self.apart()
        if 0.0 < (largest := float(np.abs(apart).max())) < np.inf:
            self.restart(apart * (self.size / largest))


def excess(scene, analysis, seed):
    """Return the change of the slowest mode of a run beyond its prediction, while that predicts a
    million, or LONGEST steps are over."""
    rate = math.log(analysis.spectral_radius)
    steps = min(LONGEST, math.ceil(MILLION / abs(rate)) if rate else LONGEST)
    pushed = bool(np.abs(analysis.operator.source).max() > 1e-13)
    # Small enough to end in the linear range, large enough to end above rounding.
    pair = Pair(scene, seed, 1e-5 if rate < 0 else 1e-11, pushed)
    few = max(1, steps // 2)
    for _ in range(max(6, BURN_IN // few)):
        pair.advance(few)
        pair.rescale()
    assume((window := half_period(analysis)) <= steps)
    sizes = []
    for _ in range(steps + window):
        sizes.append(pair.distance() * math.exp(-rate * len(sizes)))
        pair.advance(1)
    return max(sizes[-window:]) / max(sizes[:window])


def half_period(analysis):
    """Return the steps over which the size of the slowest mode is measured, as it may oscillate."""
    every = analysis.spectrum.eigenvalues
    slowest = every[np.abs(every) > (1 - 1e-6) * analysis.spectral_radius]
    angles = np.abs(np.angle(slowest))
    turns = np.minimum(angles, math.pi - angles)
    return max(2, math.ceil(math.pi / turns[turns > 1e-9].min(initial=math.pi)))


thoroughly = settings(
    max_examples=12 if AT_LENGTH else 6,
    derandomize=True,
    deadline=None,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow],
)


@thoroughly
@given(scenes(), st.integers(0, 9))
def test_runs_converge_and_diverge_at_the_predicted_rate(parts, seed):
    scene = built(parts)
    analysis = Analysis(scene)
    assume(len(analysis.operator.followers) and analysis.spectral_radius > 1e-3)
    linear = scene.experiment.rule.type != "distance-weighted"
    assume(linear or np.abs(analysis.operator.source).max() < 1e-13)
    event("stable" if analysis.stable else "unstable")
    assert 1 / FIVE_PERCENT < excess(scene, analysis, seed) < FIVE_PERCENT


@settings(thoroughly, max_examples=15 if AT_LENGTH else 8)
@given(scenes())
def test_bodies_are_stable_if_the_wave_bound_is(parts):
    """Compare the estimate of `run`, in milliseconds, with that of `check`."""
    scene = built(parts)
    assume(prediction(scene, wave_bound(scene)).get("stable"))
    assert Analysis(scene).stable


def test_run_predicts_nothing_if_waves_do_not_bound_the_body():
    """Six neighbours on a centred sheet, no frame: it diverges, and no wave grows."""
    parts = {
        "lattice": {"type": "centred-rectangular", "a": 1.0, "b": 1.2},
        "neighbours": {"type": "chebyshev", "shells": 1},
        "leaders": [{"select": {"edge": "left"}, "motion": {"type": "hold"}}],
        "solver": {"type": "stepping", "memory": 0.95},
    }
    for frame, promise in (("none", None), ("mean", None)):
        scene = scene_of(frame={"type": frame}, **parts)
        bound = wave_bound(scene)
        assert bound.radius <= 1.0 + 1e-9
        assert prediction(scene, bound)["stable"] is promise
    scene = scene_of(frame={"type": "mean"}, **parts | {"solver": {"type": "stepping"}})
    assert prediction(scene, wave_bound(scene))["stable"] is True


def test_remedy_mentions_memory_only_if_there_is_memory():
    assert "memory" not in stability_remedy(None, 0.0)
    assert "keep |memory| below 1" in stability_remedy(None, 1.1)
    assert stability_remedy(1.5, 0.5) == "; it is stable below 1.5"
