"""Relaxation and memory for which a step converges or oscillates, and the period."""

import json
import math

import numpy as np
import pytest
from hypothesis import assume, given, strategies as st
from property_cases import (
    BOTH_ENDS_HELD,
    LATTICES,
    LINEAR_RULES,
    RULES,
    advanced,
    all_pairs,
    body_sites,
    experiment,
    scene_of,
)
from scene_strategies import AT_LENGTH

import pbdkit
from pbdkit.linear.spectrum import (
    NEUTRAL,
    largest_stable_relaxation,
    modes,
    oscillation_limit,
    slowest_oscillation,
)
from pbdkit.linear.stencil import wave_bound

EIGENVALUES = {
    "real": st.builds(complex, st.floats(-3.0, 0.999)),
    "complex": st.builds(complex, st.floats(-3.0, 0.999), st.floats(-2.0, 2.0)),
}
MEMORIES = [-0.8, -0.4, 0.0, 0.5, 0.97]


def sheet(columns=7, rows=6, **parts):
    return experiment(columns, rows, leaders=BOTH_ENDS_HELD, **parts)


def stepping(relaxation=1.0, memory=0.0):
    return {"type": "stepping", "relaxation": relaxation, "memory": memory}


def roots(eigenvalue, w, b):
    return np.roots([1.0, -(1.0 + w * (eigenvalue - 1.0) + b), b])


@pytest.mark.parametrize("kind", EIGENVALUES)
@given(data=st.data())
def test_closed_form_of_the_region_matches_the_roots(kind, data):
    eigenvalue = data.draw(EIGENVALUES[kind])
    b = data.draw(st.floats(-1.2, 1.2))
    bound = largest_stable_relaxation(np.array([eigenvalue]), b)
    if abs(b) >= 1.0:
        assert bound is None
        # The product of both roots is b: whatever the relaxation, one does not decay.
        assert np.abs(roots(eigenvalue, 0.5, b)).max() >= 1.0 - 1e-12
        return
    if kind == "real":
        assert bound == pytest.approx(2.0 * (1.0 + b) / (1.0 - eigenvalue.real), rel=1e-12)
    assume(0.99 * bound > 1e-3)
    assert np.abs(roots(eigenvalue, 0.99 * bound, b)).max() < 1.0
    assert np.abs(roots(eigenvalue, 1.01 * bound, b)).max() > 1.0


@given(
    st.lists(EIGENVALUES["complex"], min_size=1, max_size=5), st.floats(0.1, 2), st.floats(-1, 1)
)
def test_modes_are_the_roots(eigenvalues, w, b):
    expected = np.concatenate([roots(e, w, b) for e in eigenvalues])
    found = modes(np.array(eigenvalues), w, b)
    # A double root is known to the square root of the rounding.
    for mu in expected:
        assert np.abs(found - mu).min() < 1e-6


@given(
    st.lists(st.floats(-1.0, 0.999), min_size=1, max_size=6), st.floats(0.1, 1.0), st.floats(0, 1)
)
def test_slowest_oscillation_is_that_of_the_largest_oscillating_eigenvalue(some, w, b):
    eigenvalues = np.array(some, complex)
    s = 1.0 + b - w * (1.0 - eigenvalues.real)
    assume((np.abs(s * s - 4.0 * b) > 1e-9).all())
    is_oscillating = s * s < 4.0 * b
    assert (eigenvalues.real[is_oscillating] < oscillation_limit(w, b)).all()
    found = slowest_oscillation(modes(eigenvalues, w, b))
    if not is_oscillating.any():
        assert found is None
        return
    assert found.period == pytest.approx(
        2.0 * math.pi / math.acos(s[is_oscillating].max() / (2.0 * math.sqrt(b))), rel=1e-6
    )
    assert found.decay == pytest.approx(math.sqrt(b), rel=1e-9)


@pytest.mark.parametrize(
    ("rule", "lattice", "memory"),
    # Each rule has one of the memories, and each memory one of the rules; any two meet in the
    # profile `long`.
    [
        (rule, ("square", "hexagonal")[(n + m) % 2], memory)
        for n, rule in enumerate(RULES)
        for m, memory in enumerate(MEMORIES)
        if AT_LENGTH or (n + 2 * m) % 5 < 1
    ],
)
def test_two_percent_inside_the_region_converges_and_outside_diverges(rule, lattice, memory):
    parts = {"columns": 6, "rows": 5, "rule": rule, "lattice": lattice, "leaders": BOTH_ENDS_HELD}
    analysis = pbdkit.analyse(experiment(**parts, solver=stepping(0.3, memory)))
    bound = analysis.largest_stable_relaxation
    for factor in (0.98, 1.02):
        assert analysis.stable_at(factor * bound, memory) == (factor < 1)
        growth = growth_of(**parts, solver=stepping(factor * bound, memory))
        assert growth < 0.1 if factor < 1 else growth > 10


@pytest.mark.parametrize(("memory", "stable"), [(0.98, True), (-0.98, True), (1.02, False)])
def test_momentum_is_bounded_by_1(memory, stable):
    w = 0.49 * (1 + memory)
    assert pbdkit.analyse(sheet(4, 3)).stable_at(w, memory) == stable
    growth = growth_of(columns=4, rows=3, leaders=BOTH_ENDS_HELD, solver=stepping(w, memory))
    assert growth < 0.1 if stable else growth > 10


def growth_of(**parts):
    """Return the growth of small noise in the second half of the steps in which the slowest mode
    changes by 900: some thirty, or one over it. The first half is for the modes to separate: a
    start at rest has little of those that alternate."""
    scene = scene_of(**parts)
    radius = pbdkit.analyse(experiment(**parts)).spectral_radius
    half = math.ceil(math.log(30.0) / abs(math.log(radius)))
    u = advanced(scene, 1e-9 * noise_of(scene), 2 * half)
    return np.abs(u[-1]).max() / np.abs(u[half]).max()


def noise_of(scene):
    """Uniform in [-1, 1) for the followers, (body particle, axis)."""
    site = body_sites(scene)
    start = np.random.default_rng(0).uniform(-1, 1, (len(site), 2))
    start[np.isin(site[:, 0], (0, site[:, 0].max()))] = 0.0
    return start


def test_momentum_stabilises_the_distance_weighted_rule_as_printed():
    """λ_min = -2 on the square lattice: relaxation 1 is inside where 3 < 2 (1 + b), b > ½."""
    bound = wave_bound(scene_of(rule="distance-weighted"))
    assert bound.largest_stable_relaxation(0.5) == pytest.approx(1.0, rel=1e-9)
    sizes = {}
    for memory in (0.4, 0.55):
        scene = scene_of(
            20, 20, rule="distance-weighted", leaders=BOTH_ENDS_HELD, solver=stepping(1.0, memory)
        )
        sizes[memory] = np.abs(advanced(scene, 1e-3 * noise_of(scene), 1500)[-1]).max()
    assert sizes[0.55] < 1e-6
    assert sizes[0.4] > 1e-2


def zeros_of(x):
    """Return the zeros of a series, on straight lines between its steps."""
    n = np.flatnonzero(x[:-1] * x[1:] < 0)
    return n + x[n] / (x[n] - x[n + 1])


def period_of(x):
    zeros = zeros_of(x)
    return 2 * (zeros[-1] - zeros[0]) / (len(zeros) - 1)


@pytest.mark.parametrize(("memory", "period"), [(1.0, 76.07), (0.99, None), (0.95, None)])
def test_slowest_mode_of_a_sheet_has_the_predicted_period_and_decay(memory, period):
    mode = pbdkit.analyse(sheet(20, 20)).oscillation(1.0, memory)
    assert period is None or mode.period == pytest.approx(period, abs=0.01)
    assert mode.decay == pytest.approx(math.sqrt(memory))
    scene = scene_of(20, 20, leaders=BOTH_ENDS_HELD, solver=stepping(1.0, memory))
    column = body_sites(scene)[:, 0]
    start = np.stack([np.zeros(len(column)), np.sin(np.pi * column / 19)], axis=1)
    y = advanced(scene, start, 500)[:, 8 * 20 + 9, 1]
    assert period_of(y) == pytest.approx(mode.period, rel=0.005)
    # The remainder u(t+1) - 2 √b cos ω u(t) + b u(t-1) is rounding.
    s = 2 * mode.decay * math.cos(2 * math.pi / mode.period)
    np.testing.assert_allclose(y[2:] - s * y[1:-1] + mode.decay**2 * y[:-2], 0, atol=1e-9)


def test_shipped_experiment_has_the_period_of_the_closed_form():
    ds = pbdkit.run("stability/oscillation", progress=False)
    b, largest = 0.98, (1 + math.cos(math.pi / 21)) / 2
    closed = 2 * math.pi / math.acos((largest + b) / (2 * math.sqrt(b)))
    assert closed == pytest.approx(84.4, abs=0.01)
    y = ds.u.sel(particle=116, axis="y").values[300:]
    assert period_of(y) == pytest.approx(closed, rel=0.01)
    # Heights half a period apart: √b to the half period.
    heights = [np.abs(part).max() for part in np.split(y, zeros_of(y).astype(int) + 1)[1:-1]]
    shrinks = np.exp(np.polyfit(np.arange(len(heights)), np.log(heights), 1)[0])
    assert shrinks == pytest.approx(b ** (closed / 4), rel=0.02)


def test_check_prints_the_period(call):
    figures = json.loads(call("check", "stability/oscillation", "--json").out)
    assert figures["period"] == pytest.approx(84.4, abs=0.01)
    assert figures["decay"] == pytest.approx(math.sqrt(0.98))
    said = call("check", "stability/oscillation").out
    assert "oscillates slowest period 84.4 steps, decaying by a factor of 0.9899 per step" in said


@pytest.mark.parametrize("memory", [0.0, -0.5, 0.01])
def test_check_prints_no_period_without_oscillation(call, memory):
    arguments = [
        "check",
        "e.json",
        "--set",
        f"solver.memory={memory}",
        "--set",
        "solver.relaxation=.1",
    ]
    figures = json.loads(call(*arguments, "--json").out)
    assert figures["period"] is figures["decay"] is None
    assert "oscillates" not in call(*arguments).out


@pytest.mark.parametrize("memory", [0.9, 0.999])
def test_slowest_oscillation_of_large_sheets_matches_the_closed_form(memory):
    """If the slowest modes creep back, the first that oscillates lies inside the spectrum."""
    n = 40
    analysis = pbdkit.analyse(sheet(n, n, solver=stepping(1.0, memory)))
    a = np.cos(np.pi * np.arange(1, n - 1) / (n - 1))[:, None]
    b = np.cos(np.pi * np.arange(n) / n)[None, :]
    every = modes((a + b).ravel() / 2 + 0j, 1.0, memory)
    exact = slowest_oscillation(every)
    found = analysis.oscillation(1.0, memory)
    assert found.period == pytest.approx(exact.period, rel=1e-9)
    assert found.decay == pytest.approx(exact.decay, rel=1e-9)
    assert analysis.spectral_radius == pytest.approx(np.abs(every).max(), abs=1e-11)
    assert np.abs(every).max() < 1.0 - NEUTRAL


@pytest.mark.parametrize("lattice", LATTICES)
@pytest.mark.parametrize("rule", RULES)
def test_without_momentum_nothing_oscillates_at_any_relaxation(rule, lattice):
    """Behind copying frames; overshooting makes short waves alternate, or diverge."""
    analysis = pbdkit.analyse(sheet(rule=rule, lattice=lattice))
    for relaxation in (0.5, 1.0, 1.3, 2.0):
        assert analysis.oscillation(relaxation, 0.0) is None


def test_delayed_frames_have_no_prediction():
    analysis = pbdkit.analyse(sheet(frame="lag"))
    assert analysis.stable_at(1.0, 0.5) is None
    assert analysis.oscillation(1.0, 0.5) is None


@pytest.mark.parametrize(
    ("lattice", "neighbours", "frame"),
    all_pairs(
        LATTICES, ["coordination-1", "chebyshev-1"], ["mean", "first", "lag", {"type": "none"}]
    ),
)
def test_rotating_modes_without_momentum_decay_within_a_period(lattice, neighbours, frame):
    """Frames that lag or lean make some eigenvalues complex; all of them are looked at."""
    found = [
        pbdkit.analyse(
            sheet(8, 8, rule=rule, lattice=lattice, neighbours=neighbours, frame=frame)
        ).spectrum.eigenvalues
        for rule in LINEAR_RULES
    ]
    every = np.concatenate(found)
    period = 2 * np.pi / np.abs(np.angle(every[np.abs(every.imag) > 1e-6]))
    kept = np.abs(every[np.abs(every.imag) > 1e-6]) ** period
    assert kept[period > 2.5].max(initial=0.0) < 0.021
