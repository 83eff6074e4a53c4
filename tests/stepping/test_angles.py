"""Rules that sum over pairs of neighbours."""

from typing import ClassVar, Literal

import numpy as np
import pytest
from interpreted_kernels import interpreting
from pydantic import Field

import pbdkit
from pbdkit.linear.operator import step_operator
from pbdkit.plugin import (
    AppliesTwice,
    FollowerRule,
    UsesAngles,
    Vector,
    dot,
    squared_length,
    where,
)
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.engine_choice import gpu_obstacle
from pbdkit.testing import examine
from pbdkit.testing.states import advanced, displacements


class Conformal(UsesAngles, FollowerRule):
    """Move to the mean of the apexes of triangles that are similar to those at rest."""

    type: Literal["conformal"] = "conformal"
    linear: ClassVar[bool] = True

    @staticmethod
    def gather(d, r, w, p):
        return (1.0,)

    @staticmethod
    def gather_pair(d1, d2, r1, r2, w1, w2, p):
        side, change = r2 - r1, d2 - d1
        square = squared_length(side)
        along = -dot(r1, side) / square
        across = (r1.y * side.x - r1.x * side.y) / square
        return d1 + along * change + across * Vector(change.y, -change.x), 1.0

    @staticmethod
    def apply(total, here, p):
        return total[1] / where(total[2] > 0.0, total[2], 1.0)


class Hinges(Conformal):
    """Nonlinear: neighbours attract, with a factor that depends on the cosine of the angle."""

    type: Literal["hinges"] = "hinges"
    linear: ClassVar[bool] = False
    has_axes: ClassVar[bool] = True
    factor: float = Field(0.4, description="Factor of the cosine of an angle.")

    def weights(self, slot, setting):
        return {"share": 1.0 / slot.shell}

    @staticmethod
    def gather(d, r, w, p):
        return w.share * d, w.share

    @staticmethod
    def gather_pair(d1, d2, r1, r2, w1, w2, p):
        a, b = r1 + d1, r2 + d2
        square = squared_length(a) * squared_length(b)
        cosine = dot(a, b) / np.sqrt(where(square > 0.0, square, 1.0))
        return (w1.share * p.factor * cosine * (d1 + d2) + w2.share * d2,)

    @staticmethod
    def apply(total, here, p):
        return (total[0] + total[2]) / (3.0 * total[1])


class Twice(AppliesTwice, Conformal):
    """Applies the rule to its own moves."""

    type: Literal["twice"] = "twice"

    def inner(self):
        return Conformal()

    @staticmethod
    def apply(total, here, p):
        return -0.25 * total[1] / where(total[2] > 0.0, total[2], 1.0)


RULES = [Conformal, Hinges, Twice]


def scene_of(rule, *settings, name="paper/d1"):
    everything = [f"rule={{type: {rule}}}", "steps=14", "diagnostics=[]", *settings]
    return pbdkit.load(name, components=RULES, settings=everything)


def position(experiment):
    return pbdkit.run(experiment, progress=False).position.values


def angles_move(u, X, neighbours, rule):
    """The rule in a plain loop over particles and consecutive neighbours of a shell."""
    moves = np.zeros_like(u)
    for j, shells in neighbours.items():
        totals = rule.gather(Vector(0.0, 0.0), Vector(1.0, 0.0), None, None)
        total, count = np.zeros(2), 0.0
        for shell in shells:
            shell.sort(key=lambda k: np.arctan2(*(X[k] - X[j])[::-1]))
            for k, n in zip(shell, [*shell[1:], shell[0]], strict=True):
                pair = (Vector(*(u[k] - u[j])), Vector(*(u[n] - u[j])))
                rest = (Vector(*(X[k] - X[j])), Vector(*(X[n] - X[j])))
                (x, y), one = rule.gather_pair(*pair, *rest, None, None, None)
                total, count = total + np.array([x, y]), count + one
        moves[j] = rule.apply((*totals, Vector(*total), count), None, None)
    return moves


def test_the_pairs_of_a_shell_are_consecutive_counterclockwise():
    experiment = scene_of("conformal", "fracture={type: none}", name="paper/a")
    ds = pbdkit.run(experiment, progress=False)
    X = ds.reference.values
    inner = [n for n in range(len(X)) if 1.5 < X[n, 0] < 7.5 and -0.5 < X[n, 1] < 9.5]
    near = {
        n: [[k for k in range(len(X)) if abs(np.hypot(*(X[k] - X[n])) - 1.0) < 1e-9]] for n in inner
    }
    u = ds.position.values - X
    for t in (5, 13):
        expected = u[t][inner] + angles_move(u[t], X, near, Conformal)[inner]
        assert np.abs(u[t + 1][inner] - expected).max() < 1e-13


@pytest.mark.parametrize(
    ("rule", "settings"),
    [
        ("conformal", ["frame={type: none}"]),
        ("hinges", ["lattice={type: hexagonal, a: 1.0}", "solver.precision=float32"]),
        ("hinges", ["neighbours.shells=2", "fracture.thresholds=[1.3, 1.9]"]),
        ("hinges", ["rule.factor={otherwise: 0.4, all: 0.2}", "fracture={type: none}",
                    "regions={all: {type: rectangle, width: 4, height: 4}}"]),
        ("hinges", ["neighbours={type: euclidean, radius: 3.7}", "fracture={type: none}",
                    "rule.factor={otherwise: 0.4, all: 0.2}", "frame={type: none}", "steps=4",
                    "regions={all: {type: rectangle, width: 4, height: 4}}"]),
        ("hinges", ["fracture={type: damage, onset: 0.05, failure: 0.4}"]),
        ("twice", ["fracture={type: none}"]),
    ],
)  # fmt: skip
def test_kernels_give_the_same_bits(rule, settings):
    numpy, kernel = (
        scene_of(rule, *settings, f"solver.engine={engine}") for engine in ("numpy", "compiled")
    )
    first = position(numpy)
    with interpreting():
        second = position(kernel)
    # In single precision, kernels round the products of constants.
    tolerance = 1e-4 if "solver.precision=float32" in settings else 0.0
    assert np.abs(first - second).max() <= tolerance
    assert np.abs(first[-1] - first[0]).max() > 0.3
    assert np.isfinite(first).all()


def test_similarities_cost_nothing():
    gradient = [[0.2, -0.3], [0.3, 0.2]]
    settings = ["frame={type: none}", "fracture={type: none}", "leaders=[]"]
    for lattice in ("square", "hexagonal", "oblique"):
        more = ["angle: 70", "b: 1.2"] if lattice == "oblique" else []
        experiment = scene_of(
            "conformal",
            *settings,
            f"lattice={{{', '.join([f'type: {lattice}', 'a: 1.0', *more])}}}",
            f"initial={{type: affine, gradient: {gradient}, shift: [1.0, 2.0]}}",
        )
        x = position(experiment)
        assert np.abs(x[-1] - x[0]).max() < 1e-12
        assert np.abs(x[0] - pbdkit.run(experiment, progress=False).reference.values).max() > 1.0


def test_a_torn_bond_is_a_fictitious_neighbour():
    torn = position(scene_of("conformal", "fracture.thresholds=[1.2]"))
    whole = position(scene_of("conformal", "fracture={type: none}"))
    assert np.abs(torn - whole).max() > 0.1


@pytest.mark.parametrize("rule", ["conformal", "hinges"])
def test_the_response_is_the_derivative_of_a_step(rule):
    settings = ["frame={type: none}", "fracture={type: none}", "leaders=[]"]
    scene = build_scene(scene_of(rule, *settings))
    operator, u = step_operator(scene).current, displacements(scene, 3, share=1e-6)
    step = [advanced(scene, sign * u, 1)[1] for sign in (1.0, -1.0)]
    assert np.abs((step[0] - step[1]).ravel() / 2 - operator @ u.ravel()).max() < 1e-15


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["neighbours={type: euclidean, radius: 1.5, reevaluate: true}", "fracture={type: none}"],
         "rule: 'conformal' sums over pairs of constant neighbours; set neighbours.reevaluate"),
    ],
)  # fmt: skip
def test_what_angles_exclude_is_refused_by_name(settings, message):
    with pytest.raises(pbdkit.ExperimentError, match=message):
        pbdkit.run(scene_of("conformal", *settings), progress=False)


def test_a_gpu_is_refused_by_name():
    assert "sums over pairs of neighbours" in gpu_obstacle(build_scene(scene_of("conformal")))


def test_every_property_holds():
    with interpreting():
        report = examine(Hinges(), lattice={"type": "hexagonal", "a": 0.7})
    assert report.holds, str(report)
    assert {"changes-no-input", "is-the-same-compiled"} <= {o.property for o in report.outcomes}


@pytest.mark.parametrize("lattice", ["square", "hexagonal"])
def test_conformal_rule_is_identified(lattice):
    """Harmonic functions are its equilibria: in the interior it moves to the mean of the 4 or 6
    neighbours, which diffuses with D = h²/4, and rotations are preserved, also at edges."""
    settings = ["rule={type: conformal}", f"lattice.type={lattice}", "leaders=[]"]
    identity = pbdkit.identify(pbdkit.load("paper/a", components=[Conformal], settings=settings))
    assert (identity.kind, identity.isotropic) == ("diffusion", True)
    assert identity.diffusivity == pytest.approx(0.25, rel=1e-12)
    assert identity.linear
    assert identity.turns
    assert identity.rests_at_edges
