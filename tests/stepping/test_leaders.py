"""Leaders by Newton's law: masses at the end of elastic bars."""

import math

import numpy as np
import pytest

import pbdkit
from pbdkit.scene.scene import build_scene
from pbdkit.stability.forecast import forecast
from pbdkit.stepping.engine_choice import Choice, make_engine
from pbdkit.stepping.state import initial_state

LENGTH, HEIGHT = 6, 1
DIFFUSION = 0.4
"""2 / (5 - 3ν) of a lattice unit squared a step, for ν = 0."""


def bar(mass, length=LENGTH, height=HEIGHT, steps=200, axes=("x",), **newton):
    """A bar held at the left; ν = 0, so that its columns move as one."""
    motion = {"type": "newton", "mass": mass, **newton}
    return {
        "name": "mass-on-a-bar",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "grid", "columns": length + 1, "rows": height + 1},
        "neighbours": {"type": "chebyshev", "shells": 1},
        "rule": {"type": "elastic", "poisson_ratio": 0.0},
        "frame": {"type": "natural"},
        "leaders": [
            {"select": {"edge": "left"}, "motion": {"type": "hold"}},
            {"select": {"edge": "right"}, "motion": motion, "axes": list(axes)},
        ],
        "steps": steps,
        "record": {"every": steps},
        "diagnostics": [{"type": "track", "numbers": [(length + 1) * (height + 1)]}],
    }


def path_of_mass(data):
    """(step,): how far the mass at the end has gone."""
    x = pbdkit.run(pbdkit.Experiment(**data), progress=False).track.values[:, 0, 0]
    return x - x[0]


def test_mass_on_a_bar_equals_the_chain_of_columns():
    """Each column goes to the mean of both beside it; the mass moves by m v' = F - c v."""
    mass, damping, force = 8.0, 0.7, 0.02
    data = bar(mass, damping=damping, force=[force, 5.0], velocity=[0.01, 3.0])
    u, v, found = np.zeros(LENGTH + 1), 0.01, [0.0]
    for _ in range(data["steps"]):
        pull = HEIGHT * (u[-2] - u[-1])
        v += (force + pull - damping * (HEIGHT + 1) * v) / (mass * (HEIGHT + 1))
        u[-1] += v
        u[1:-1] += DIFFUSION * (u[:-2] - 2 * u[1:-1] + u[2:])
        found.append(u[-1])
    assert np.abs(path_of_mass(data) - found).max() < 1e-13


def test_period_and_decay_of_a_mass_on_a_fast_bar():
    """A spring EA/L: s² M + s C + EA/L = 0."""
    period, damping, length, height = 1000.0, 50.0, 2, 1
    mass = (period / (2 * math.pi)) ** 2 * height / length
    data = bar(mass / 2, length, height, 1000, damping=damping / 2, velocity=[0.01, 0.0])
    data["solver"] = {"type": "stepping", "engine": "numpy"}
    u = path_of_mass(data)[100::50]
    a, b = np.linalg.lstsq(np.stack([u[1:-1], u[:-2]], axis=1), u[2:])[0]
    s = np.log(np.roots([1.0, -a, -b]).astype(complex))[0] / 50
    exact = np.roots([mass, damping, height / length])[0]
    assert s.real == pytest.approx(exact.real, rel=0.01)
    assert abs(s.imag) == pytest.approx(abs(exact.imag), rel=0.01)


def talbot(transform, t, terms=28):
    """The inverse Laplace transform at a time (Talbot's contour; Abate and Valkó 2004)."""
    r, angle = 2 * terms / (5 * t), np.arange(1, terms) * np.pi / terms
    cot = 1 / np.tan(angle)
    s, bend = r * angle * (cot + 1j), angle + (angle * cot - 1) * cot
    terms_of_s = np.exp(t * s) * transform(s) * (1 + 1j * bend)
    return float(r / terms * (0.5 * np.exp(r * t) * transform(r) + terms_of_s.real.sum()))


def test_mass_on_a_slow_bar_matches_the_continuum():
    """u_t = D u_xx in the bar and m a = -EA u_x at its end: s² M + EA q coth(qL), q² = s/D. What
    resists the mass in a bar and not in the steps is given to it as damping: half a column that
    relaxes, EA/2D, and the step by which forces come late, EA/h."""
    length, height, period, speed = 20, 1, 1200, 0.01
    mass = (period / (2 * math.pi)) ** 2 * height / length
    drag = height * (1 / (2 * DIFFUSION) + 1)
    data = bar(mass / 2, length, height, period, damping=drag / 2, velocity=[speed, 0.0])
    found = path_of_mass(data)

    def transform(s):
        q = np.sqrt(s / DIFFUSION)
        return mass * speed / (mass * s * s + height * q / np.tanh(q * length))

    times = np.arange(30, period + 1, 30)
    exact = np.array([talbot(transform, float(t)) for t in times])
    assert np.abs(found[times] - exact).max() < 0.03 * np.abs(exact).max()


def test_both_engines_agree_bit_for_bit_and_resume_from_the_state():
    data = bar(3.0, damping=0.1, force=[0.01, 0.02], axes=["x", "y"])
    found = []
    for name, parts in (("numpy", (50,)), ("compiled", (20, 30))):
        scene = build_scene(pbdkit.Experiment(**data))
        engine, _ = make_engine(scene, Choice(name, 1, "asked for"))
        state = initial_state(scene)
        for steps in parts:
            state = engine.advance(state.copy(), steps)
        found.append(state)
    assert np.array_equal(found[0].u, found[1].u)
    assert np.array_equal(found[0].starts[1], found[1].starts[1])
    assert np.abs(found[0].starts[1]).max() > 0.0


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_check_reports_the_smallest_mass(damping):
    """The stiffness of a particle between its held neighbours: k = 4 m - 2 c, from which steps grow
    or fade."""

    def data(mass):
        parts = bar(mass, 2, 2, 100, axes=("x", "y"), damping=damping, velocity=[1e-3, 0.0])
        parts["leaders"][1]["select"] = {"numbers": [5]}
        parts["leaders"][0]["select"] = {"numbers": [1, 2, 3, 4, 6, 7, 8, 9]}
        return parts

    def warned(mass):
        found = forecast(build_scene(pbdkit.Experiment(**data(mass)))).warnings
        return any("is too small" in text for text in found)

    stiffness = 2.5  # Σ W over both axes, for ν = 0
    least = stiffness / 4 + damping / 2
    assert warned(0.99 * least)
    assert not warned(1.01 * least)
    way = {share: np.abs(particle_5(data(share * least))).max() for share in (0.99, 1.01)}
    assert way[0.99] > 1.0
    assert way[1.01] < 0.1


def particle_5(data):
    data["diagnostics"] = [{"type": "track", "numbers": [5]}]
    track = pbdkit.run(pbdkit.Experiment(**data), progress=False).track.values[:, 0]
    return track - track[0]


@pytest.mark.parametrize(
    ("parts", "text"),
    [
        ({"solver": {"type": "equilibrium"}}, "solver: leaders that move by Newton's law have no"),
        ({"solver": {"type": "stepping", "settle": {}}}, "without `settle`"),
        (
            {"rule": {"type": "barycentre"}, "frame": {"type": "none"}},
            "rule: leaders that move by Newton's law require forces, which 'barycentre' with",
        ),
        (
            {"rule": {"type": "elastic", "poisson_ratio": -1.0}},
            "'elastic' with these parameters does not define",
        ),
    ],
)
def test_incompatible_use_of_masses_is_refused(parts, text):
    with pytest.raises(pbdkit.ExperimentError, match=text):
        pbdkit.Experiment(**bar(1.0) | parts)


@pytest.mark.parametrize("newton", [{"mass": 0.0}, {"mass": 1.0, "damping": -1.0}, {}])
def test_masses_are_positive_and_damping_is_not_negative(newton):
    data = bar(1.0)
    data["leaders"][1]["motion"] = {"type": "newton", **newton}
    with pytest.raises(pbdkit.ExperimentError, match=r"leaders\.1\.motion\.(mass|damping)"):
        pbdkit.Experiment(**data)
