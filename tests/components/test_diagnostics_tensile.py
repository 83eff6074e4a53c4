"""The stress-strain curve of a specimen."""

import numpy as np
import pytest

import pbdkit
from tests.components.test_elasticity import HEXAGONAL, NATURAL, SQUARE

E = 7.0
CURVE = {"type": "stress-strain", "youngs_modulus": E}
STEPS = 5


def specimen(parts, body, nu=0.0, diagnostic=None, pull=(0.01, 0.0), **more):
    """Both ends led, the second one pulled a little more at every step, in equilibrium."""
    path = {"type": "velocity", "velocity": list(pull), "steps": STEPS}
    base = {
        "name": "specimen",
        "body": body,
        "rule": {"type": "elastic", "poisson_ratio": nu},
        "frame": NATURAL,
        "leaders": [
            {"select": {"edge": "left"}, "motion": {"type": "hold"}},
            {"select": {"edge": "right"}, "motion": path},
        ],
        "steps": STEPS,
        "solver": {"type": "equilibrium"},
        "diagnostics": [CURVE | (diagnostic or {})],
    }
    return base | parts | more


def curve(given):
    """The last stress and strain."""
    ds = pbdkit.run(given, progress=False)
    return float(ds.nominal_stress[-1]), float(ds.nominal_strain[-1])


BAR = {"type": "grid", "columns": 9, "rows": 6}
"""4 long and 2.5 wide with a spacing of ½."""
GAUGES = {
    "leaders": {},
    "points": {"points": [[1.0, 1.0], [3.1, 0.9]]},
    "backwards": {"points": [[3.0, 1.0], [1.0, 1.0]]},
    "numbers": {"numbers": [15, 45]},
}


@pytest.mark.parametrize("gauge", GAUGES.values(), ids=GAUGES)
def test_bar_without_contraction_has_youngs_modulus_as_slope(gauge):
    stress, strain = curve(specimen(SQUARE, BAR, diagnostic={"width": 2.5} | gauge))
    assert strain == pytest.approx(0.05 / 4, rel=1e-10)
    assert stress / strain == pytest.approx(E, rel=1e-10)


@pytest.mark.parametrize(("axis", "edges"), [("x", "left right"), ("y", "bottom top")])
@pytest.mark.parametrize("pulled", [0, 1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_tension_is_positive_for_any_group_and_direction(axis, edges, pulled, sign):
    outwards = sign * (1.0 if pulled else -1.0) * 0.01
    pull = [outwards, 0.0] if axis == "x" else [0.0, outwards]
    names = {"group": pulled, "against": 1 - pulled, "axis": axis}
    given = specimen(SQUARE, BAR, diagnostic={"width": 1.0} | names)
    path = {"type": "velocity", "velocity": pull, "steps": STEPS}
    motions = [{"type": "hold"}, path] if pulled else [path, {"type": "hold"}]
    given["leaders"] = [
        {"select": {"edge": edge}, "motion": motion}
        for edge, motion in zip(edges.split(), motions, strict=True)
    ]
    stress, strain = curve(given)
    assert np.sign(stress) == np.sign(strain) == sign


def test_curve_has_one_point_per_record():
    """Two levels of load, each held until the body has come to rest."""
    given = specimen(SQUARE, BAR, diagnostic={"width": 2.5}, steps=800)
    path = {"steps": [1, 400, 401], "displacements": [[0.1, 0.0], [0.1, 0.0], [0.3, 0.0]]}
    given["leaders"][1]["motion"] = {"type": "path"} | path
    given |= {"record": {"every": 400}, "solver": {"type": "stepping", "memory": 0.8}}
    ds = pbdkit.run(given, progress=False)
    assert ds.nominal_stress.dims == ds.nominal_strain.dims == ("time",)
    np.testing.assert_allclose(ds.nominal_strain, [0.0, 0.025, 0.075], rtol=1e-12)
    np.testing.assert_allclose(ds.nominal_stress, [0.0, 0.025 * E, 0.075 * E], rtol=1e-10)


def modulus(parts, rule, a, pull):
    """Nominal stress over nominal strain in the middle of a bar 8 × 1 with clamped ends, over E."""
    given = specimen(
        parts | {"lattice": parts["lattice"] | {"a": a}, "rule": rule},
        {"type": "rectangle", "width": 8.0, "height": 1.0},
        diagnostic={"width": 1.0, "points": [[3.0, 0.5], [5.0, 0.5]]},
        pull=(pull, 0.0),
    )
    for leader, box in zip(given["leaders"], ([-1, -1, 0.01, 2], [7.99, -1, 9, 2]), strict=True):
        leader["select"] = {"box": box}
    stress, strain = curve(given)
    return stress / strain / E


@pytest.mark.parametrize(
    ("parts", "within"), [(SQUARE, 1e-6), (HEXAGONAL, 1e-3)], ids=["square", "hexagonal"]
)
def test_clamps_do_not_affect_the_middle_of_a_long_bar(parts, within):
    """Triangles that the outline cuts are rough at the edge; squares here are whole."""
    rule = {"type": "elastic", "poisson_ratio": 0.3}
    assert modulus(parts, rule, 0.25, 0.01) == pytest.approx(1.0, rel=within)


def test_gauge_of_a_dogbone_has_youngs_modulus_as_slope():
    """The specimen of docs/dataset.md, at half the spacing the error is smaller."""
    outline = {"length": 20.0, "width": 6.0, "gauge_length": 8.0, "gauge_width": 3.0, "radius": 3.0}
    gauge = {"width": 3.0, "points": [[7.0, 3.0], [13.0, 3.0]]}
    off = []
    for a in (0.5, 0.25):
        parts = SQUARE | {"lattice": {"type": "square", "a": a}}
        given = specimen(parts, {"type": "dogbone"} | outline, nu=0.3, diagnostic=gauge)
        stress, strain = curve(given)
        off.append(abs(stress / strain / E - 1))
    assert off[0] < 5e-4
    assert off[1] < off[0]


def test_springs_start_at_youngs_modulus_and_deviate_in_proportion():
    """To first order in the strain."""
    off = [modulus(SQUARE, {"type": "springs"}, 0.25, pull) - 1 for pull in (1e-4, 1e-3, 1e-2)]
    assert 0 < off[0] < 3e-5
    assert off[1] / off[0] == pytest.approx(10, rel=0.02)
    assert off[2] / off[1] == pytest.approx(10, rel=0.02)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"group": 2}, "diagnostics.0.group: there is no leader group 2; "
         "there are 2, counted from 0"),
        ({"against": 5}, "diagnostics.0.against: there is no leader group 5; "
         "there are 2, counted from 0"),
        ({"numbers": [1, 99]}, "diagnostics.0.numbers.1: there is no particle 99; they are "
         "numbered 1 to 54"),
        ({"numbers": [1, 2], "points": [[0, 0], [1, 0]]},
         "diagnostics.0: the gauge has both points and numbers; give only one of them"),
        ({"points": [[0, 0], [0, 1]]}, "diagnostics.0: the gauge has no length along x: both ends "
         "are at 0; choose points that differ along this axis"),
        ({"axis": "y", "points": [[0, 0], [0, 2.5]]}, "diagnostics.0: leader group 1 is in the "
         "middle of the gauge along y, at 1.25, so that tension and compression cannot be "
         "distinguished; choose points with the middle at one side of the group, or another group"),
    ],
)  # fmt: skip
def test_scenes_without_a_curve_are_refused(wrong, message):
    with pytest.raises(pbdkit.ExperimentError) as caught:
        pbdkit.run(specimen(SQUARE, BAR, diagnostic={"width": 1.0} | wrong), progress=False)
    assert str(caught.value) == message
