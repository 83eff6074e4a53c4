"""References for sensitivities of equilibria: equilibria for slightly changed numbers, by a dense
matrix of the moves and a chord iteration, to rounding.

``python tests/sensitivity_cases.py`` prints the worst error by rule and frame.
"""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
from scene_strategies import AT_LENGTH

import pbdkit
from pbdkit.equilibrium.system import Moves, one_thread
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.sensitivity import RestingScene
from pbdkit.lattice.raster import FOLLOWER
from pbdkit.scene.leader_groups import guided_at, kinds_of_places
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.leaders import place, prescribe
from pbdkit.stepping.state import initial_state

WEIGHTS = (3 / 4, -3 / 20, 1 / 60)
"""Weights of central differences of order 6, over 1 to 3 steps to both sides."""
STEP, MOST, NEAR = 5e-3, 60, 1e-10
"""The step as a share of a value, iterations, and below what way one that grows is rounding."""
EIGHT = {"type": "chebyshev", "shells": 1}
HEXAGONAL = {"lattice": {"type": "hexagonal", "a": 1.0}, "neighbours": {"type": "coordination"}}
RECTANGULAR = {"lattice": {"type": "rectangular", "a": 1.0, "b": 0.8}}
FOUR = {"neighbours": {"type": "coordination"}}
TURNED = {"type": "rotation", "centre": [4.0, 1.0], "angle": 6.0, "steps": 1}
SHEET = {
    "name": "sheet",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "grid", "columns": 5, "rows": 4},
    "regions": {"core": {"type": "disc", "radius": 1.2, "centre": [1.9, 1.4]}},
    "neighbours": EIGHT,
    "leaders": [
        {"select": {"edge": "left"}, "motion": {"type": "hold"}},
        {"select": {"edge": "right"}, "motion": TURNED},
    ],
    "steps": 1,
    "solver": {"type": "equilibrium", "tolerance": 1e-12},
}
LOADED = {"loads": [{"select": {"edge": "top"}, "force": [0.01, -0.02]}]}
FIELD = {"stiffness": {"otherwise": 1.0, "core": 2.5}}
FORCE, ANGLE = "loads.0.force.0", "leaders.1.motion.angle"
ELASTIC = {"type": "elastic", "poisson_ratio": 0.3} | FIELD
ISOTROPIC = ("rule.poisson_ratio", "rule.stiffness.core", "rule.stiffness.otherwise", FORCE, ANGLE)
ORTHOTROPIC = {"type": "orthotropic", "poisson_ratio": 0.2, "modulus_ratio": 0.4}
UNEQUAL = ("rule.modulus_ratio", "rule.shear_ratio", *ISOTROPIC)
GRADIENT = {"type": "strain-gradient", "poisson_ratio": 0.2, "length": 0.6}
MIXED = {"type": "mixed-coordinate", "K": -0.01}
RULES = {
    "barycentre": ({"type": "barycentre"}, {}, (ANGLE,)),
    "mean-displacement": ({"type": "mean-displacement"}, {}, (ANGLE,)),
    "distance-weighted": ({"type": "distance-weighted"}, {}, (ANGLE,)),
    "mixed-coordinate": (MIXED, FOUR, ("rule.K", ANGLE)),
    "mixed-coordinate, y": (MIXED | {"axis": "y"}, FOUR, ("rule.K", ANGLE)),
    "springs": ({"type": "springs"} | FIELD, LOADED, (*ISOTROPIC[1:],)),
    "springs, hexagonal": ({"type": "springs"} | FIELD, LOADED | HEXAGONAL, ISOTROPIC[1:]),
    "elastic": (ELASTIC, LOADED, ISOTROPIC),
    "elastic, plane strain": (ELASTIC | {"plane": "strain"}, LOADED, ISOTROPIC),
    "elastic, rectangular": (ELASTIC, LOADED | RECTANGULAR, ISOTROPIC),
    "elastic, hexagonal": (ELASTIC, LOADED | HEXAGONAL, ISOTROPIC),
    "orthotropic": (ORTHOTROPIC | {"shear_ratio": 0.3} | FIELD, LOADED, UNEQUAL),
    "strain-gradient": (
        GRADIENT, LOADED, ("rule.length", "rule.poisson_ratio", "rule.stiffness", FORCE, ANGLE)
    ),
}  # fmt: skip
"""Cases by name: the rule, the other differences from SHEET, and the parameters."""
FRAMES = ("none", "natural", "mean", "first", "mirror")
BY_DISTANCE = (
    "barycentre", "mean-displacement", "distance-weighted", "mixed-coordinate",
    "mixed-coordinate, y",
)  # fmt: skip
ON_TRIANGLES = ("springs, hexagonal", "elastic, hexagonal")
REFUSED = {
    "natural": (BY_DISTANCE, "is not defined by cells"),
    "mirror": (ON_TRIANGLES, "requires a square or rectangular lattice"),
}
"""Rules that do not accept a frame, with the message."""
RIGHT = {"select": {"edge": "right"}}
ROD = {"type": "elastic", "poisson_ratio": 0.3}
LINE = [[4.0, -1.0], [4.0, 1.3], [4.0, 4.0]]


def led(**motion):
    return {"leaders": [SHEET["leaders"][0], RIGHT | {"motion": motion}]}


MORE = {
    "leaders.1.motion.centre.0": {},
    "leaders.1.motion.displacement.0": led(type="displace", displacement=[0.1, 0.2]),
    "leaders.1.motion.velocity.1": led(type="velocity", velocity=[0.1, 0.2], steps=1),
    "leaders.1.motion.displacements.0.1": led(type="path", steps=[1], displacements=[[0.1, 0.2]]),
    "leaders.1.motion.displacements.1.0": led(
        type="measured", points=LINE, displacements=[[0.1, 0.0], [0.2, 0.1], [0.1, 0.3]]
    ),
    "leaders.1.motion.points.1.1": led(
        type="measured", points=LINE, displacements=[[0.1, 0.0], [0.2, 0.1], [0.1, 0.3]]
    ),
    "loads.0.body_force.1": {"loads": [{"select": {"edge": "top"}, "body_force": [0.0, 0.01]}]},
    "loads.0.force.1.values.1": {
        "loads": [{"select": {"edge": "top"},
                   "force": [0.0, {"steps": [1, 3], "values": [0.0, 0.01]}]}],
        "steps": 4,
    },
    "rule.stiffness.values.1": {
        "rule": ROD | {"stiffness": {"steps": [1, 3], "values": [1.0, 2.0]}}, "steps": 4, **LOADED,
    },
    "rule.stiffness.values.1.0": {
        "rule": ROD | {"stiffness": {"x": [0.0, 5.0], "y": [0.0, 3.0],
                                     "values": [[1.0, 2.0], [1.5, 1.2]]}},
    },
    "lattice.a": {},
    "rule.poisson_ratio": {"leaders": [
        {"select": {"edge": "left"}, "axes": ["x"], "motion": {"type": "hold"}},
        {"select": {"nearest": [[0.0, 0.0]]}, "motion": {"type": "hold"}},
        RIGHT | {"axes": ["x"], "motion": TURNED},
    ]},
}  # fmt: skip
"""Differences from SHEET, for parameters of other parts, and of leaders along one axis."""


def case(rule, frame, **more):
    """An experiment as a dict."""
    given, parts, _ = RULES[rule]
    return SHEET | parts | {"rule": given, "frame": {"type": frame}} | more


def other_case(frame, parts):
    """An experiment of MORE as a dict."""
    return SHEET | {"rule": ROD, "frame": {"type": frame}} | parts


def paths_of(rule, frame):
    """Return all parameters with one frame; with others some of the rule, which act on the frame
    too. Rules that differ from `elastic` or `springs` in the plane or the lattice have the first
    and the last parameter, and all of them in the profile `long`."""
    paths = RULES[rule][2]
    if frame != full_frame(rule):
        return paths[: max(1, len(paths) - 3)]
    return paths if AT_LENGTH or "," not in rule else (paths[0], paths[-1])


def full_frame(rule):
    """Return the frame with which all parameters of a rule are compared."""
    return "mean" if rule in BY_DISTANCE else "natural"


class Plain:
    """Equilibria of an experiment and of those that differ from it by a number."""

    def __init__(self, given):
        self.given, self.experiment = given, pbdkit.Experiment(**given)
        scene = build_scene(self.experiment)
        kinds = kinds_of_places(scene.raster, scene.leading, self.experiment.steps)
        free = np.stack([kinds == FOLLOWER] * 2)
        guided = guided_at(scene.raster, scene.leading, self.experiment.steps)
        free[:, guided.place] &= ~guided.lead_axes
        self.free, self._start = np.flatnonzero(free), np.zeros(np.count_nonzero(free))
        for _ in range(MOST if not self.experiment.rule.linear else 1):  # Newton's
            self._slope = self._slope_at(scene, self._start)
            before, self._start = self._start, self._equilibrium(scene)
            if np.abs(self._start - before).max() < 1e-13:
                break

    def equilibrium(self, given):
        """The displacements of the scene of an experiment, frame and leaders too, (axis, place)."""
        scene = build_scene(pbdkit.Experiment(**given))
        moves, u = self._moves_of(scene)
        moves(self._equilibrium(scene))
        flat = u.reshape(2, -1)
        if scene.frame:
            scene.frame.follow(flat, flat)
        return flat.copy()

    def derivative(self, path):
        """∂u/∂θ by differences of order 6."""
        *parents, last = [int(w) if w.isdecimal() else w for w in path.split(".")]
        value, total = float(Parameter(path).value_in(self.experiment)), 0.0
        step = STEP * max(abs(value), 0.1)
        for n, weight in enumerate(WEIGHTS, 1):
            for sign in (1, -1):
                given = copy.deepcopy(self.given)
                part = given
                for word in parents:
                    part = part[word]
                part[last] = value + sign * n * step
                total = total + sign * weight / step * self.equilibrium(given)
        return total

    def _moves_of(self, scene):
        state, steps = initial_state(scene), scene.experiment.steps
        state.u[...] = 0.0
        led, _ = prescribe(scene, state, steps)
        place(state.u, led)
        found, u = Moves(scene, compiles=False), state.u

        def moves(x):
            u.ravel()[self.free] = x
            return found.at(replace(state, u=u), steps).ravel()[self.free]

        return moves, u

    def _slope_at(self, scene, x):
        """The inverse of -∂moves/∂u, dense; of rules that are not linear by differences, for a
        chord."""
        moves, _ = self._moves_of(scene)
        here, h = moves(x), 1.0 if self.experiment.rule.linear else 1e-6
        columns = []
        for n in range(x.size):
            there = x.copy()
            there[n] += h
            columns.append((here - moves(there)) / h)
        return np.linalg.inv(np.stack(columns, axis=1))

    def _equilibrium(self, scene):
        """Find the equilibrium from the previous one, as near as rounding permits."""
        moves, _ = self._moves_of(scene)
        x, best = self._start.copy(), np.inf
        for _ in range(MOST):
            way = self._slope @ moves(x)
            size = np.abs(way).max()
            if size >= best and size < NEAR:
                break
            x, best = x + way, min(size, best)
        return x


def errors(given, paths):
    """(path, size, error, adjoint's error) of each parameter: the largest derivative, what is off
    as a share of it, and so of the gradient of a random sum by the first and last of them (NaN: of
    others). Raises ExperimentError where the rule does not take the frame."""
    plain, found = Plain(given), []
    with one_thread():
        resting = RestingScene.of(plain.experiment)
        weights = np.random.default_rng(0).normal(size=resting.state.u.shape)
        known = np.zeros(resting.state.u[0].size, bool)
        known[resting.scene.raster.place_of(np.arange(len(resting.scene.raster.table_kind)))] = True
        weights.reshape(2, -1)[:, ~known] = 0.0
        ends = [paths[0], paths[-1]]
        slopes = dict(zip(ends, resting.gradient(weights, list(map(Parameter, ends))), strict=True))
        for path in paths:
            change = resting.change(Parameter(path))
            expected = plain.derivative(path)
            off = np.abs(change.reshape(2, -1) - expected)[:, known].max()
            size = np.abs(expected).max()
            slope, along = slopes.get(path, np.nan), weights * change
            along = abs(slope - along.sum()) / np.abs(along).sum()
            found.append((path, size, off / size, along))
    return found


def table():
    """Lines of the worst error by rule and frame, and by what else is a parameter."""
    for rule, (_, _, paths) in RULES.items():
        for frame in FRAMES:
            try:
                rows = errors(case(rule, frame), paths)
            except pbdkit.ExperimentError as error:
                yield f"{rule:24}{frame:15}not taken: {error}"
                continue
            path, _, off, _ = max(rows, key=lambda row: row[2])
            yield f"{rule:24}{frame:15}{off:8.0e} {rows[0][3]:8.0e}  {path}"
    for frame in ("natural", "mean"):
        for path, parts in MORE.items():
            ((_, _, off, along),) = errors(other_case(frame, parts), [path])
            yield f"{'elastic':24}{frame:15}{off:8.0e} {along:8.0e}  {path}"


if __name__ == "__main__":
    print(f"{'rule':24}{'frame':15}{'worst':>8} {'adjoint':>8}  of")
    for line in table():
        print(line)
