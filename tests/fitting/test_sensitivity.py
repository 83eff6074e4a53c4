"""Derivatives of equilibria with respect to parameters, against complex steps, differences and
closed forms."""

from __future__ import annotations

import operator
import re
from importlib.util import find_spec

import numpy as np
import pytest
import sensitivity_cases
from scene_strategies import AT_LENGTH

import pbdkit
from pbdkit.equilibrium.system import one_thread
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.sensitivity import RestingScene
from pbdkit.lattice.raster import FOLLOWER
from pbdkit.plugin import BUILTIN, FollowerRule, FramePolicy
from pbdkit.plugin.registry import Registry
from pbdkit.scene import constants as homes
from pbdkit.scene.leader_groups import kinds_of_places
from pbdkit.scene.scene import build_scene, renumbered
from pbdkit.stepping.followers import SlotFollowers

H = 1e-30
EIGHT = {"type": "chebyshev", "shells": 1}
SHEET = {
    "name": "sheet",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "grid", "columns": 6, "rows": 5},
    "neighbours": EIGHT,
    "leaders": [
        {"select": {"edge": "left"}, "motion": {"type": "hold"}},
        {
            "select": {"edge": "right"},
            "motion": {"type": "rotation", "centre": [4.0, 1.0], "angle": 6.0, "steps": 1},
        },
    ],
    "steps": 1,
    "solver": {"type": "equilibrium", "tolerance": 1e-10},
}
ELASTIC = {"type": "elastic", "poisson_ratio": 0.3}
RULES = {
    "elastic": (ELASTIC, "rule.poisson_ratio", {}),
    "plane strain": (ELASTIC | {"plane": "strain"}, "rule.poisson_ratio", {}),
    "hexagonal": (
        ELASTIC,
        "rule.poisson_ratio",
        {"lattice": {"type": "hexagonal", "a": 1.0}, "neighbours": {"type": "coordination"}},
    ),
    "orthotropic": (
        {"type": "orthotropic", "poisson_ratio": 0.2, "modulus_ratio": 0.4, "shear_ratio": 0.3},
        "rule.modulus_ratio",
        {},
    ),
    "shear": (
        {"type": "orthotropic", "poisson_ratio": 0.2, "modulus_ratio": 0.4, "shear_ratio": 0.3},
        "rule.shear_ratio",
        {},
    ),
    "mixed-coordinate": (
        {"type": "mixed-coordinate", "K": -0.01},
        "rule.K",
        {"neighbours": {"type": "coordination"}},
    ),
}
FRAMES = ("natural", "mean", "first", "none")


class Complex(complex):
    """A complex number that is compared, and judged finite, by its real part, as code for real
    numbers does."""

    def __float__(self):
        return self.real


def _wrapped(name):
    def method(self, other):
        found = getattr(complex, name)(self, other)
        return Complex(found) if isinstance(found, complex) else found

    return method


for _name in ("add", "radd", "sub", "rsub", "mul", "rmul", "truediv", "rtruediv", "pow"):
    setattr(Complex, f"__{_name}__", _wrapped(f"__{_name}__"))
for _name in ("gt", "ge", "lt", "le"):
    setattr(
        Complex, f"__{_name}__", lambda self, other, n=_name: getattr(operator, n)(self.real, other)
    )


def by_complex_step(experiment, path, monkeypatch):
    """∂u/∂θ from the functions of the rule alone, at θ + ih, and a dense matrix of their moves."""
    scene = build_scene(experiment)
    _, name = path.split(".")
    resting = RestingScene.of(experiment)
    state, frame = resting.state, scene.frame
    place = np.flatnonzero(
        kinds_of_places(scene.raster, scene.leading, experiment.steps) == FOLLOWER
    )

    def moves(scene, u):
        flat = u.reshape(len(u), -1)
        if frame and not np.iscomplexobj(u):  # else in line already
            frame.follow(flat, flat)
        found = SlotFollowers(scene).moves(u, state)
        return found.reshape(len(u), -1)[:, place].ravel()

    with np.errstate(all="ignore"):
        here = moves(scene, state.u.copy())
        columns = []
        for n in range(2 * len(place)):
            u = state.u.copy()
            u.reshape(2, -1)[n // len(place), place[n % len(place)]] += 1.0
            columns.append(here - moves(scene, u))
        with monkeypatch.context() as patch:
            patch.setattr(homes, "float", Complex, raising=False)
            rule = experiment.rule.model_copy(
                update={name: getattr(experiment.rule, name) + Complex(0.0, H)}
            )
            other = renumbered(scene, experiment.model_copy(update={"rule": rule}))
            changed = moves(other, state.u.astype(complex)).imag / H
    return np.linalg.solve(np.stack(columns, axis=1), changed), place


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("name", RULES)
def test_derivatives_match_complex_steps(name, frame, monkeypatch):
    rule, path, more = RULES[name]
    calibrated = rule["type"] in ("elastic", "orthotropic")
    if frame == "natural" and not calibrated:
        frame = "mirror"
    given = SHEET | {"rule": rule, "frame": {"type": frame}} | more
    experiment = pbdkit.Experiment(**given)
    with one_thread():
        expected, place = by_complex_step(experiment, path, monkeypatch)
    found = RestingScene.of(experiment).change(Parameter(path)).reshape(2, -1)[:, place].ravel()
    assert np.abs(expected).max() > 1e-6
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9 * np.abs(expected).max())


LINEAR = {
    "force": (
        {"leaders": SHEET["leaders"][:1], "rule": ELASTIC, "frame": {"type": "natural"},
         "loads": [{"select": {"edge": "right"}, "force": [0.01, -0.02]}]},
        "loads.0.force.1",
    ),
    "displacement": (
        {"leaders": [SHEET["leaders"][0], {"select": {"edge": "right"}, "motion":
            {"type": "displace", "displacement": [0.1, 0.2]}}],
         "rule": ELASTIC, "frame": {"type": "natural"}},
        "leaders.1.motion.displacement.0",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LINEAR)
def test_derivative_of_linear_parameters_equals_differences(name):
    parts, path = LINEAR[name]
    experiment = pbdkit.Experiment(**SHEET | parts)
    parameter = Parameter(path)
    here = RestingScene.of(experiment)
    there = RestingScene.of(parameter.put(experiment, parameter.value_in(experiment) + 0.5))
    difference = (there.state.u - here.state.u) / 0.5
    np.testing.assert_allclose(here.change(parameter), difference, atol=1e-9)


SMOOTH = {
    "stiffness of a region": (
        {"regions": {"core": {"type": "disc", "radius": 1.6, "centre": [3.2, 2.1]}},
         "rule": ELASTIC | {"stiffness": {"otherwise": 1.0, "core": 4.0}},
         "frame": {"type": "natural"}},
        "rule.stiffness.core",
    ),
    "length": (
        {"rule": {"type": "strain-gradient", "poisson_ratio": 0.2, "length": 0.6}},
        "rule.length",
    ),
    "angle, springs": (
        {"rule": {"type": "springs"}, "frame": {"type": "natural"}}, "leaders.1.motion.angle",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SMOOTH)
def test_derivatives_match_differences_of_equilibria(name):
    parts, path = SMOOTH[name]
    experiment, parameter = pbdkit.Experiment(**SHEET | parts), Parameter(path)
    found = RestingScene.of(experiment).change(parameter)
    expected = parameter.derivative(experiment, lambda e: RestingScene.of(e).state.u)
    size = np.abs(expected).max()
    assert size > 1e-5
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-7 * size)


def test_load_response_decreases_with_stiffness_beside_another_field():
    """u is as 1/k: ∂u/∂k = -u/k, whatever Poisson's ratio of each cell."""
    core = {"core": {"type": "disc", "radius": 1.2, "centre": [1.9, 1.4]}}
    rule = ELASTIC | {"stiffness": 4.0, "poisson_ratio": {"otherwise": 0.3, "core": 0.1}}
    load = {"select": {"edge": "right"}, "force": [0.1, -0.2]}
    parts = {"rule": rule, "regions": core, "leaders": SHEET["leaders"][:1], "loads": [load]}
    resting = RestingScene.of(pbdkit.Experiment(**SHEET | parts | {"frame": {"type": "natural"}}))
    found, u = resting.change(Parameter("rule.stiffness")), resting.state.u
    np.testing.assert_allclose(found, -u / 4.0, rtol=0.0, atol=1e-8 * np.abs(u).max())


RULES_AND_FRAMES = [
    (rule, frame)
    for n, rule in enumerate(sensitivity_cases.RULES)
    for m, frame in enumerate(sensitivity_cases.FRAMES)
    if AT_LENGTH or frame == sensitivity_cases.full_frame(rule) or (n + m) % 10 == 0
]
"""Each rule with the frame for which all its parameters are compared, and with others in turn."""


@pytest.mark.parametrize(("rule", "frame"), RULES_AND_FRAMES)
def test_derivatives_and_gradients_match_recomputed_equilibria(rule, frame):
    given = sensitivity_cases.case(rule, frame)
    rules, told = sensitivity_cases.REFUSED.get(frame, ((), ""))
    if rule in rules:
        with pytest.raises(pbdkit.ExperimentError, match=told):
            build_scene(pbdkit.Experiment(**given))
        pytest.skip(f"the rule does not take this frame: it {told}")
    for path, size, off, along in sensitivity_cases.errors(
        given, sensitivity_cases.paths_of(rule, frame)
    ):
        assert size > 1e-3, path
        assert off < 1e-9, path
        assert not along > 1e-12, path


@pytest.mark.parametrize(
    ("path", "frame"),
    [
        (path, frame)
        for n, path in enumerate(sensitivity_cases.MORE)
        for m, frame in enumerate(("natural", "mean"))
        if AT_LENGTH or (n + m) % 2
    ],
)
def test_derivatives_by_other_parameters_match_recomputed_equilibria(path, frame):
    given = sensitivity_cases.other_case(frame, sensitivity_cases.MORE[path])
    ((_, size, off, along),) = sensitivity_cases.errors(given, [path])
    assert size > 1e-3
    assert off < 1e-9
    assert along < 1e-12


def test_every_shipped_rule_and_frame_is_compared():
    own = next(plugin for plugin in Registry().plugins if plugin.distribution == BUILTIN)
    rules = {sensitivity_cases.RULES[name][0]["type"] for name, _ in RULES_AND_FRAMES}
    frames = {frame for _, frame in RULES_AND_FRAMES}
    for kind, compared in ((FollowerRule, rules), (FramePolicy, frames)):
        assert {offer.name for offer in own.offers if offer.interface is kind} == compared


METHODS = {
    "inverse": ("auto", (7, 6), "lu"),
    "factors": ("lu", (32, 24), "lu"),
    "grids of a lattice": ("multigrid", (32, 24), "multigrid"),
    "without a preconditioner": ("conjugate-gradients", (12, 9), "conjugate-gradients|gmres"),
}


@pytest.mark.parametrize("frame", ["natural", "mean", "mirror"])
@pytest.mark.parametrize("method", METHODS)
def test_transposed_solve_solves_the_transpose(method, frame):
    """⟨A⁻¹a, b⟩ = ⟨a, A⁻ᵀb⟩: of symmetric systems, of others, and of ones in stages."""
    asked, (columns, rows), name = METHODS[method]
    for rule in (ELASTIC, {"type": "mixed-coordinate", "K": -0.01}):
        parts = {"neighbours": {"type": "coordination"}} if rule is not ELASTIC else {}
        if parts and frame != "mean":
            continue
        given = SHEET | parts | {
            "rule": rule, "frame": {"type": frame},
            "body": {"type": "grid", "columns": columns, "rows": rows},
            "solver": {"type": "equilibrium", "method": asked},
        }  # fmt: skip
        resting = RestingScene.of(pbdkit.Experiment(**given))
        kinds = kinds_of_places(resting.scene.raster, resting.scene.leading, 1)
        a, b = np.random.default_rng(0).normal(size=(2, *resting.state.u.shape))
        for planes in (a, b):
            planes.reshape(2, -1)[:, kinds != FOLLOWER] = 0.0
        there, back = resting.system.answer(a, 1e-12), resting.system.solve_transposed(b, 1e-12)
        size = np.linalg.norm(there) * np.linalg.norm(b)
        assert abs((there * b).sum() - (a * back).sum()) < 1e-9 * size
        assert re.search(name, resting.system.methods)


by_grids = pytest.mark.skipif(not find_spec("numba"), reason="grids are compiled by numba")
WIDE = SHEET | {
    "rule": ELASTIC, "frame": {"type": "natural"},
    "body": {"type": "grid", "columns": 32, "rows": 24},
    "solver": {"type": "equilibrium", "method": "multigrid"},
}  # fmt: skip


@by_grids
def test_solutions_started_from_another_equilibrium_are_the_same():
    parameter, accuracy = Parameter("rule.poisson_ratio"), 1e-9
    there = RestingScene.of(pbdkit.Experiment(**WIDE), accuracy=accuracy)
    led = np.zeros_like(there.state.u)
    led.reshape(2, -1)[0, there.scene.leading[1].place] = 1.0
    nearby = parameter.put(there.scene.experiment, 0.31)
    found, counts = [], []
    for start in (None, there):
        there.answer(led), there.change(parameter)
        here = RestingScene.of(nearby, start, accuracy)
        before = here.system.iterations
        found.append((here.answer(led), here.change(parameter)))
        counts.append(here.system.iterations - before)
    for alone, begun in zip(*found, strict=True):
        np.testing.assert_allclose(begun, alone, rtol=0.0, atol=1e-7 * np.abs(alone).max())
    assert counts[1] < 0.8 * counts[0]


@by_grids
def test_leader_columns_are_part_of_the_stencils():
    resting = RestingScene.of(pbdkit.Experiment(**WIDE))
    led = np.zeros_like(resting.state.u)
    place = resting.scene.leading[1].place
    led.reshape(2, -1)[:, place] = np.random.default_rng(0).normal(size=(2, len(place)))
    pushed = resting.system.pushed_by(led)
    np.testing.assert_allclose(pushed, resting.along(resting._moves, led), atol=1e-13)


def test_loose_derivative_meets_its_tolerance():
    exact, rough = (RestingScene.of(pbdkit.Experiment(**WIDE), None, a) for a in (1e-12, 1e-7))
    one, other = (resting.change(Parameter("rule.poisson_ratio")) for resting in (exact, rough))
    assert 0.0 < np.abs(one - other).max() < 1e-6 * np.abs(one).max()


def test_sensitivities_compile_no_new_kernel():
    pytest.importorskip("numba")
    from pbdkit.equilibrium.stencil_matrix import kernels

    resting = RestingScene.of(pbdkit.Experiment(**WIDE))
    resting.gradient(np.ones_like(resting.state.u), [Parameter("rule.poisson_ratio")])
    again = RestingScene.of(resting.scene.experiment, resting)
    again.answer(np.ones_like(resting.state.u))
    for name, ways in (("product", 1), ("scaled", 1), ("dot", 2)):
        assert len(getattr(kernels(), name).signatures) == ways, name


def test_unsupported_displaced_part_is_refused():
    pulled = [
        {"select": {"edge": edge}, "force": [sign * 0.01, 0.0]}
        for edge, sign in (("left", -1.0), ("right", 1.0))
    ]
    free = SHEET | {"leaders": [], "rule": ELASTIC, "frame": {"type": "natural"}}
    resting = RestingScene.of(pbdkit.Experiment(**free | {"loads": pulled}))
    with pytest.raises(pbdkit.ExperimentError, match="a part of the body is not constrained"):
        resting.change(Parameter("rule.poisson_ratio"))
    with pytest.raises(pbdkit.ExperimentError, match="a part of the body is not constrained"):
        resting.gradient(resting.state.u, [Parameter("rule.poisson_ratio")])


def test_changing_bonds_and_obstacles_are_refused():
    torn = {"rule": ELASTIC, "frame": {"type": "natural"},
            "fracture": {"type": "strain", "failure": 0.01}}  # fmt: skip
    with pytest.raises(pbdkit.ExperimentError, match="bonds break or soften on the load path"):
        RestingScene.of(pbdkit.Experiment(**SHEET | torn))
    indented = pbdkit.load("modelling/indentation", settings=["solver={type: equilibrium}"])
    with pytest.raises(pbdkit.ExperimentError, match="remove the obstacles"):
        RestingScene.of(indented)


@pytest.mark.parametrize(
    ("path", "told"),
    [
        ("rule.poison_ratio", "there is no 'poison_ratio'"),
        ("rule", "'rule' is not a number"),
        ("leaders.7.motion", "there is no '7'"),
        ("rule.type", "is not a number"),
    ],
)
def test_parameter_that_is_not_a_number_is_refused(path, told):
    experiment = pbdkit.Experiment(**SHEET | {"rule": ELASTIC})
    with pytest.raises(pbdkit.ExperimentError, match=told):
        Parameter(path).value_in(experiment)


def test_parameter_on_its_bound_has_no_derivative():
    experiment = pbdkit.Experiment(**SHEET | {"rule": ELASTIC | {"poisson_ratio": 0.5}})
    with pytest.raises(pbdkit.ExperimentError, match="is at its bound"):
        RestingScene.of(experiment).change(Parameter("rule.poisson_ratio"))


RECTANGLE = {"type": "rectangle", "width": 5.1, "height": 4.1}
HOLE = {"type": "disc", "centre": [2.0, 2.0], "radius": 1.0005}
BODIES = {
    "body.width": RECTANGLE,
    "body.of.1.radius": {"type": "difference", "of": [RECTANGLE, HOLE]},
}
"""Bodies with particles on the outline that a parameter moves."""


@pytest.mark.parametrize("path", BODIES)
def test_parameter_that_changes_the_particles_has_no_derivative(path):
    experiment = pbdkit.Experiment(**SHEET | {"rule": ELASTIC, "body": BODIES[path]})
    with pytest.raises(pbdkit.ExperimentError, match="changes the set of particles"):
        RestingScene.of(experiment).change(Parameter(path))
