"""The program against the plain loops, on scenes drawn at random over everything that is built.

`plain_loops` was written from the definition of the model alone, in positions and one particle at
a time. Steps are few and thresholds lie off round numbers, so that no unstable mode and no tie
between a length and a threshold magnifies rounding into a difference.
"""

import numpy as np
import plain_loops
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

import pbdkit
from pbdkit import Lattice, NeighbourMetric
from pbdkit.registry.registry import Registry
from pbdkit.scene.neighbourhood import build_neighbourhood

TOLERANCE = 1e-11
MEASURED = ["pe1", "pe1_intact", "pe2", "u", "broken_bonds"]
DIAGNOSTICS = [{"type": t} for t in ("pe1", "pe1-intact", "pe2", "displacement", "broken")]

spacings = st.sampled_from([1.0, 0.7, 1.9])
lattices = st.one_of(
    st.builds(lambda a: {"type": "square", "a": a}, spacings),
    st.builds(lambda a: {"type": "hexagonal", "a": a}, spacings),
    st.builds(
        lambda kind, a, b: {"type": kind, "a": a, "b": b},
        st.sampled_from(["rectangular", "centred-rectangular"]),
        spacings,
        spacings,
    ),
    st.builds(
        lambda a, b, angle: {"type": "oblique", "a": a, "b": b, "angle": angle},
        spacings,
        spacings,
        st.sampled_from([60.0, 75.0, 110.0]),
    ),
)
origins = st.sampled_from([[0.0, 0.0], [3.0, -2.5]])
neighbours = st.builds(
    lambda kind, shells: {"type": kind, "shells": shells},
    st.sampled_from(["coordination", "chebyshev"]),
    st.integers(1, 2),
)
rules = st.one_of(
    st.sampled_from(
        [{"type": "barycentre"}, {"type": "mean-displacement"}, {"type": "distance-weighted"}]
    ),
    st.builds(
        lambda k, axis: {"type": "mixed-coordinate", "K": k, "axis": axis},
        st.sampled_from([-0.03, 0.011]),
        st.sampled_from(["x", "y"]),
    ),
)
frames = st.one_of(
    st.just({"type": "none"}),
    st.builds(
        lambda kind, lag, layers: {"type": kind, "lag": lag} | layers,
        st.sampled_from(["mean", "first"]),
        st.integers(0, 1),
        st.sampled_from([{}, {"layers": 1}, {"layers": 2}, {"layers": 3}]),
    ),
)
amounts = st.sampled_from([-1.53, -0.171, 0.0, 0.237, 0.61, 1.13])
motions = st.one_of(
    st.just({"type": "hold"}),
    st.builds(
        lambda x, y, n: {"type": "velocity", "velocity": [x, y], "steps": n},
        amounts,
        amounts,
        st.integers(1, 6),
    ),
    st.builds(lambda x, y: {"type": "displace", "displacement": [x, y]}, amounts, amounts),
)
selections = st.one_of(
    st.builds(lambda e: {"edge": e}, st.sampled_from(["left", "right", "bottom", "top"])),
    st.builds(
        lambda x, y, w: {"box": [x, y, x + w, y + w]},
        st.floats(-1, 1),
        st.floats(-1, 1),
        st.floats(2, 4),
    ),
    st.builds(
        lambda points: {"nearest": points},
        st.lists(
            st.tuples(st.sampled_from([0.1, 1.0, 2.5]), st.sampled_from([-0.2, 0.5, 3.0])).map(
                list
            ),
            min_size=1,
            max_size=3,
        ),
    ),
    st.builds(
        lambda n: {"numbers": sorted(n)}, st.sets(st.integers(1, 40), min_size=1, max_size=2)
    ),
)


@st.composite
def leader_groups(draw):
    group = {"select": draw(selections), "motion": draw(motions)}
    begin, length = draw(st.integers(1, 5)), draw(st.none() | st.integers(0, 5))
    if begin > 1:
        group["from"] = begin
    if length is not None:
        group["until"] = begin + length
    return group


def rest_lengths(lattice, near):
    registry = Registry()
    metric = registry.find(NeighbourMetric, near["type"])(**near)
    return build_neighbourhood(
        registry.find(Lattice, lattice["type"])(**lattice).cell(), metric
    ).shells()


@st.composite
def pulled_apart(draw):
    """Two opposite edges, moved until bonds break, and perhaps released."""
    edges = draw(st.sampled_from([("left", "right"), ("bottom", "top")]))
    pull = {
        "type": "velocity",
        "velocity": [draw(st.sampled_from([0.9, 0.4])), draw(st.sampled_from([0.7, 1.3]))],
        "steps": draw(st.integers(2, 8)),
    }
    released = draw(st.sampled_from([{}, {"until": 5}]))
    return [
        {"select": {"edge": edges[0]}, "motion": {"type": "hold"}},
        {"select": {"edge": edges[1]}, "motion": pull} | released,
    ]


sides = st.sampled_from([4, 5, 6, 3, 2, 1])
any_leaders = st.lists(leader_groups(), max_size=3)


@st.composite
def experiments(draw, leaders=any_leaders, fracturing=st.booleans()):  # noqa: B008
    rule, lattice = draw(rules), draw(lattices) | {"origin": draw(origins)}
    near = draw(neighbours)
    solver = {"type": "stepping"}
    if draw(st.booleans()):
        solver |= {"relaxation": draw(st.sampled_from([0.4, 0.9, 1.1]))}
        solver |= {"memory": draw(st.sampled_from([0.0, 0.3]))}
    fracture = {"type": "none"}
    if draw(fracturing):
        factor = draw(st.sampled_from([1.031234, 1.101234, 1.331234]))
        fracture = {
            "type": "threshold",
            "thresholds": [factor * max(lengths) for lengths in rest_lengths(lattice, near)],
            "placement": draw(st.sampled_from([1.0, 0.8, 1.25])),
            "fictitious": draw(st.sampled_from(["cell", "reference"])),
            "frame_bonds": draw(st.booleans()),
        }
    return {
        "version": 1,
        "name": "random",
        "lattice": lattice,
        "body": {
            "type": "grid",
            "columns": draw(sides),
            "rows": draw(sides),
        },
        "neighbours": near,
        "rule": rule,
        "frame": draw(frames),
        "fracture": fracture,
        "leaders": draw(leaders),
        "steps": draw(st.integers(1, 6 if rule["type"] == "distance-weighted" else 12)),
        "diagnostics": DIAGNOSTICS,
        "solver": solver,
    }


thoroughly = settings(
    max_examples=300,
    deadline=None,
    suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow],
)


def run_unless_refused(experiment):
    """Random leaders may select nobody, name frame points or contradict each other: such scenes
    are not what is tested here."""
    try:
        return pbdkit.run(experiment, progress=False)
    except pbdkit.ExperimentError:
        assume(False)


@thoroughly
@given(experiments())
def test_matches_the_plain_loops(experiment):
    compare(experiment)


@thoroughly
@given(experiments(leaders=pulled_apart(), fracturing=st.just(True)))
def test_fracture_matches_the_plain_loops(experiment):
    compare(experiment)


def compare(experiment):
    ds = run_unless_refused(experiment)
    expected = plain_loops.simulate(experiment)

    for name in ("number", "site", "kind", "bond", "shell"):
        np.testing.assert_array_equal(ds[name], np.array(expected[name]).reshape(ds[name].shape))
    if "broken_step" in ds:
        np.testing.assert_array_equal(ds["broken_step"], expected["broken_step"])
    for name in ("reference", "position", *MEASURED):
        np.testing.assert_allclose(
            ds[name], np.array(expected[name]), rtol=TOLERANCE, atol=TOLERANCE, err_msg=name
        )


@pytest.mark.parametrize("name", ["a", "b", "c", "d1", "d2", "e", "f1", "f2", "g"])
def test_the_papers_cases_match_the_plain_loops(name):
    experiment = pbdkit.load(f"paper/{name}", settings=["steps=60"])
    raw = experiment.model_dump(mode="json")
    ds, expected = pbdkit.run(experiment, progress=False), plain_loops.simulate(raw)

    np.testing.assert_allclose(ds["position"], expected["position"], rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(ds["pe1"], expected["pe1"], rtol=TOLERANCE, atol=TOLERANCE)
