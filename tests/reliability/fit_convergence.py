"""Fit plates with holes, notches and cracks to fields that resemble measurements.

    python tests/reliability/fit_convergence.py [--trials N] [--seed S] [--only NUMBER ...]

The fields are equilibria on a lattice with a third of the spacing of the fit, and the closed forms
of Kirsch (hole) and Williams (crack). To them are added a rigid-body motion, noise (white or
correlated over neighbouring points), and in part of the trials the distortion of a lens, a gradient
out of the plane, outliers, and patches without points. The points are coarser or finer than the
lattice. Bounds are wide, and the truth is often near one end of them. The noise that the fit is
given is right, too small by a factor of 3 to 10, or absent. Two to five groups of particles have
measured displacements.

A trial succeeds if the fit converges to the right minimum: its cost is not larger than that of the
true parameters with the best boundaries, and where the model of the fit is complete (no distortion
without its terms, no outliers under a linear loss), each identifiable parameter is within four
standard errors and the tolerance for the error of the coarser lattice. Exits with 1 if fewer than
95 of 100 trials succeed, less three times the sampling error if there are fewer trials.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
import traceback
import warnings
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import xarray
from trials import row

import pbdkit
from pbdkit.errors import AccuracyWarning
from pbdkit.fitting.fit_result import Fitted
from pbdkit.fitting.observations import Interpolation
from pbdkit.fitting.problem import Problem, cost_of, solved
from pbdkit.fitting.sensitivity import RestingScene

Floats = np.ndarray
GOAL = 0.95
WORSE = 1e-3
"""Relative increase of the cost over that of the true parameters that is accepted."""
ERRORS = 4.0
TOLERANCE, RELATIVE = 0.05, 0.3
"""Tolerance for the error of the coarser lattice: of Poisson's ratio, and of ratios of stiffness as
a fraction. A notch has steps on a lattice with twelve cells across; with three times as many cells
the truth is found within the standard errors."""
FINER = 3
WIDTH, HEIGHT = 24.0, 12.0
FAMILIES = ("hole", "notch", "crack", "Kirsch", "Williams")


@dataclass
class Trial:
    """One synthetic measurement, and the fit to it."""

    family: str
    experiment: dict[str, Any]
    true: dict[str, float]
    fit: dict[str, Any]
    table: xarray.Dataset
    is_complete: bool
    traits: list[str] = field(default_factory=list)


def chosen(generator: np.random.Generator, *options: Any) -> Any:
    """Return one of the options."""
    return options[generator.integers(len(options))]


def body_of(family: str, generator: np.random.Generator) -> dict[str, Any]:
    """Return body and cuts of an experiment."""
    whole = {"type": "rectangle", "width": WIDTH, "height": HEIGHT}
    x = float(generator.uniform(0.35, 0.65) * WIDTH)
    if family == "hole":
        disc = {"type": "disc", "radius": float(generator.uniform(1.8, 3.5)), "centre": [x, 6.0]}
        return {"body": {"type": "difference", "of": [whole, disc]}}
    if family == "notch":
        depth, half = generator.uniform(3.0, 6.0), generator.uniform(0.8, 2.0)
        vertices = [[x - half, -0.5], [x + half, -0.5], [x, float(depth)]]
        notch = {"type": "polygon", "vertices": vertices}
        return {"body": {"type": "difference", "of": [whole, notch]}}
    x = float(np.floor(x)) + 0.5
    if generator.random() < 0.6:
        ends = {"from": [x, -1.0], "to": [x, float(generator.integers(3, 7)) + 0.5]}
    else:
        angle = generator.uniform(0.2, 1.2)
        part = 3.0 * np.array([np.cos(angle), np.sin(angle)])
        middle = np.array([x, 6.1])
        ends = {"from": (middle - part).tolist(), "to": (middle + part).tolist()}
    return {"body": whole, "cuts": [ends]}


def plate(parts: dict[str, Any], spacing: float) -> dict[str, Any]:
    """Return an experiment without leaders."""
    return {
        "name": "plate",
        "lattice": {"type": "square", "a": spacing},
        "neighbours": {"type": "chebyshev", "shells": 1},
        "frame": {"type": "natural"},
        "steps": 1,
        "solver": {"type": "equilibrium"},
    } | parts


def ends_of_truth(generator: np.random.Generator) -> list[dict[str, Any]]:
    """Return two ends that move as grips do, by polynomials of the third degree."""
    y = np.linspace(0.0, HEIGHT, 4 * 12 + 1)
    s, pull = 2.0 * y / HEIGHT - 1.0, 0.03 * np.exp(generator.normal(0.0, 0.5))
    groups = []
    for edge, x in (("left", 0.0), ("right", WIDTH)):
        c = generator.normal(size=(2, 4)) * pull * np.array([0.3, 0.2, 0.06, 0.03])
        u = np.polynomial.polynomial.polyval(s, c.T).T
        u[:, 0] += pull * (x > 0.0)
        u[:, 1] += -0.3 * pull * s * generator.uniform(0.0, 0.4)
        points = np.c_[np.full(len(y), x), y]
        motion = {"type": "measured", "points": points.tolist(), "displacements": u.tolist()}
        groups.append({"select": {"edge": edge}, "motion": motion})
    return groups


def equilibrium_field(experiment: dict[str, Any], at: Floats) -> tuple[Floats, Floats]:
    """Return displacements at points, and a mask of the points inside the body."""
    resting = RestingScene.of(pbdkit.Experiment(**experiment))
    found = Interpolation.at(resting.scene, at)
    return found.of(resting.state.u, resting.scene), found.inside


def kirsch(x: Floats, nu: float, radius: float, load: tuple[float, float]) -> Floats:
    """Return the displacements of a plate with a hole at 0 under stresses along x and y."""
    kappa, mu = (3.0 - nu) / (1.0 + nu), 1.0 / (2.0 * (1.0 + nu))

    def pulled(x: Floats, y: Floats) -> Floats:
        r, t = np.maximum(np.hypot(x, y), radius) / radius, np.arctan2(y, x)
        ux = r * (kappa + 1) * np.cos(t) + 2 / r * ((1 + kappa) * np.cos(t) + np.cos(3 * t))
        uy = r * (kappa - 3) * np.sin(t) + 2 / r * ((1 - kappa) * np.sin(t) + np.sin(3 * t))
        cubes = 2 / r**3 * np.array([np.cos(3 * t), np.sin(3 * t)])
        return radius / (8.0 * mu) * (np.array([ux, uy]) - cubes)

    along, across = pulled(*x.T), pulled(x[:, 1], -x[:, 0])
    turned = np.array([-across[1], across[0]])
    return (load[0] * along + load[1] * turned).T


def williams(x: Floats, nu: float, numbers: Floats) -> Floats:
    """Return the displacements about a crack on the negative axis: modes I and II, and T."""
    kappa, mu = (3.0 - nu) / (1.0 + nu), 1.0 / (2.0 * (1.0 + nu))
    r, t = np.hypot(*x.T), np.arctan2(x[:, 1], x[:, 0])
    s, c = np.sin(t / 2), np.cos(t / 2)
    first = [c * (kappa - 1 + 2 * s**2), s * (kappa + 1 - 2 * c**2)]
    second = [s * (kappa + 1 + 2 * c**2), -c * (kappa - 1 - 2 * s**2)]
    singular = np.sqrt(r / (2 * np.pi)) / (2 * mu) * np.array([first, second])
    uniform = np.array([x[:, 0], -nu * x[:, 1]])
    return np.einsum("kap,k->pa", np.array([*singular, uniform]), numbers)


def material(family: str, generator: np.random.Generator) -> tuple[dict[str, Any], Any, Any]:
    """Return the parts of an experiment with its material, the truth and the bounds."""
    nu = float(generator.uniform(0.05, 0.42))
    bounds = chosen(generator, (0.0, 0.49), (-0.9, 0.495), (nu - 0.04, 0.49), (-0.5, nu + 0.05))
    kind = generator.integers(3) if family in ("hole", "notch", "crack") else 0
    true, unknown = {"rule.poisson_ratio": nu}, {"rule.poisson_ratio": bounds}
    if kind == 0:
        return {"rule": {"type": "elastic", "poisson_ratio": nu}}, true, unknown
    if kind == 1:
        ratio = float(np.exp(generator.normal(0.0, 0.7)))
        region = {"type": "rectangle", "width": WIDTH / 2, "height": HEIGHT}
        if generator.random() < 0.5:
            region = {"type": "disc", "radius": 4.0, "centre": [6.0, 6.0]}
        rule = {"type": "elastic", "poisson_ratio": nu}
        rule["stiffness"] = {"otherwise": 1.0, "part": ratio}
        path = "rule.stiffness.part"
        wide = chosen(generator, (0.01, 100.0), (0.1, 10.0), (0.8 * ratio, 30.0 * ratio))
        return (
            {"rule": rule, "regions": {"part": region}},
            true | {path: ratio},
            unknown | {path: wide},
        )
    modulus = float(np.exp(generator.normal(-0.3, 0.5)))
    shear = float(modulus**0.5 * generator.uniform(0.2, 0.5))
    rule = {"type": "orthotropic", "poisson_ratio": nu}
    rule |= {"modulus_ratio": modulus, "shear_ratio": shear}
    true |= {"rule.modulus_ratio": modulus, "rule.shear_ratio": shear}
    unknown = {"rule.poisson_ratio": chosen(generator, (0.0, 0.49), (nu - 0.04, 0.45))}
    wide = (0.01, min(20.0, 0.95 / nu**2))
    wide = chosen(generator, wide, (0.05, min(4.0, wide[1])), (0.7 * modulus, wide[1]))
    return (
        {"rule": rule},
        true,
        unknown
        | {
            "rule.modulus_ratio": wide,
            "rule.shear_ratio": chosen(generator, (0.01, 3.0), (0.05, 1.5)),
        },
    )


def points_of(generator: np.random.Generator, traits: list[str]) -> Floats:
    """Return a grid of points with jitter, in part of the trials without those in some discs."""
    spacing = chosen(generator, 0.5, 0.8, 1.2, 1.8, 2.4)
    shape = np.array([WIDTH, HEIGHT])
    axes = [np.arange(0.3 * spacing, size, spacing) for size in shape]
    at = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    at = np.clip(at + 0.2 * spacing * generator.normal(size=at.shape), 0.0, shape)
    traits.append(f"points every {spacing}")
    if generator.random() < 0.4:
        traits.append("patches")
        for _ in range(generator.integers(1, 4)):
            centre = generator.uniform([0.0, 0.0], shape)
            at = at[np.hypot(*(at - centre).T) > generator.uniform(1.0, 3.0)]
    return at


def measured_noise(generator: np.random.Generator, at: Floats, traits: list[str]) -> Floats:
    """Return noise of the standard deviation 1, white or correlated."""
    noise = generator.normal(size=(len(at), 2))
    if generator.random() < 0.3 and len(at) < 1200:
        traits.append("correlated")
        r2 = np.square(at[:, None] - at).sum(axis=2)
        weights = np.exp(-r2 / (2.0 * 1.0**2))
        noise = (weights / np.linalg.norm(weights, axis=1)[:, None]) @ noise
    return noise


def distorted(generator: np.random.Generator, at: Floats, size: float, traits: list[str]) -> Any:
    """Return apparent displacements of a camera, and their terms in a fit."""
    s = 2.0 * at / [WIDTH, HEIGHT] - 1.0
    x, y = s.T
    a, b, c = generator.normal(0.0, 0.5 * size, 3)
    u = np.c_[a - c * y * HEIGHT / WIDTH, b + c * x]  # a rigid-body motion
    rigid = {"ux": [[0, 0], [0, 1]], "uy": [[0, 0], [1, 0]]}
    kind = chosen(generator, "none", "none", "lens", "gradient")
    if kind == "none":
        return u, chosen(generator, {}, {}, rigid), True
    k = generator.normal(0.0, 0.1 * size)
    if kind == "lens":
        r2 = x**2 + (HEIGHT / WIDTH * y) ** 2
        u += k * np.c_[x * r2, y * r2 * HEIGHT / WIDTH]
        terms = {"ux": [[3, 0], [1, 2]], "uy": [[2, 1], [0, 3]]}
    else:
        u += k * np.c_[x**2, x * y * HEIGHT / WIDTH]
        terms = {"ux": [[2, 0]], "uy": [[1, 1]]}
    is_modelled = generator.random() < 0.6
    traits.append(f"{kind}{'' if is_modelled else ', not modelled'}")
    return u, terms if is_modelled else {}, is_modelled


def boundary_groups(
    family: str, parts: dict[str, Any], generator: np.random.Generator, traits: list[str]
) -> list[dict[str, Any]]:
    """Return the selections of the measured boundaries, in part of the trials in short pieces."""

    def line(ends: Floats, at: float, axis: int, gap: float = 0.05) -> list[dict[str, Any]]:
        boxes = []
        for low, high in pairwise(ends):
            box = [low + gap, at - 0.01, high - gap, at + 0.01]
            boxes.append({"box": box if axis == 0 else [box[1], box[0], box[3], box[2]]})
        return boxes

    pieces = int(generator.integers(1, 4)) if generator.random() < 0.5 else 1
    if pieces > 1:
        traits.append(f"edges in {pieces} pieces")
    down = np.linspace(-0.1, HEIGHT + 0.1, min(pieces, 2) + 1)
    across = np.linspace(0.9, WIDTH - 0.9, pieces + 1)
    sides = [*line(down, 0.0, 1), *line(down, WIDTH, 1)]
    both = [*line(across, 0.0, 0), *line(across, HEIGHT, 0)]
    if family == "Kirsch":
        return [*sides, *both]
    if family == "Williams":
        y = parts["cuts"][0]["to"][1]
        mouth = np.array([-0.1, y, HEIGHT + 0.1])
        return [*line(mouth, 0.0, 1), *line(down, WIDTH, 1), *both]
    return [*sides, *both[pieces:]] if generator.random() < 0.4 else sides


def make_trial(seed: int, number: int) -> Trial:
    """Return a trial, which depends on the seed and its number only."""
    generator = np.random.default_rng([seed, number])
    family = FAMILIES[number % len(FAMILIES)]
    traits: list[str] = []
    rule, true, unknown = material(family, generator)
    at = points_of(generator, traits)
    nu = true["rule.poisson_ratio"]
    if family == "Kirsch":
        radius, centre = float(generator.uniform(2.5, 4.0)), np.array([12.0, 6.0])
        load = generator.normal(size=2) * [1.5e-3, 7e-4]
        disc = {"type": "disc", "radius": radius, "centre": centre.tolist()}
        whole = {"type": "rectangle", "width": WIDTH, "height": HEIGHT}
        parts = {"body": {"type": "difference", "of": [whole, disc]}} | rule
        at = at[np.hypot(*(at - centre).T) > radius]
        u = kirsch(at - centre, nu, radius, load)
    elif family == "Williams":
        tip = np.array([float(generator.integers(8, 15)) + 0.5, 5.5])
        numbers = generator.normal(size=3) * [4e-3, 2e-3, 5e-4]
        parts = {
            "body": {"type": "rectangle", "width": WIDTH, "height": HEIGHT},
            "cuts": [{"from": [-1.0, 5.5], "to": tip.tolist()}],
        } | rule
        u = williams(at - tip, nu, numbers)
    else:
        parts = body_of(family, generator) | rule
        actual = parts
        if rule["rule"]["type"] == "elastic" and generator.random() < 0.2:
            traits.append("anisotropic")
            other = {"type": "orthotropic", "poisson_ratio": nu, "modulus_ratio": 0.8}
            other |= {"shear_ratio": 0.3} | (
                {"stiffness": s} if (s := rule["rule"].get("stiffness")) else {}
            )
            actual = parts | {"rule": other}
        fine = plate(actual, 1.0 / FINER) | {"leaders": ends_of_truth(generator)}
        u, inside = equilibrium_field(fine, at)
        at = at[inside]
    size = float(np.sqrt(np.mean(np.square(u - u.mean(axis=0)))))
    apparent, terms, is_complete = distorted(generator, at, size, traits)
    noise = size * float(np.exp(generator.uniform(np.log(0.003), np.log(0.1))))
    traits.append(f"noise {noise / size:.3f}")
    is_complete &= "anisotropic" not in traits
    u = u + apparent + noise * measured_noise(generator, at, traits)
    loss = "linear"
    if generator.random() < 0.4:
        wrong = generator.random(len(at)) < generator.uniform(0.005, 0.05)
        scale = noise * chosen(generator, 10.0, 30.0) + size * chosen(generator, 0.0, 1.0)
        u[wrong] += scale * generator.normal(size=(int(wrong.sum()), 2))
        loss = chosen(generator, "soft_l1", "soft_l1", "huber", "cauchy", "linear")
        traits.append(f"outliers, {loss}")
        is_complete &= loss != "linear"
    stated = {"none": None, "right": noise, "small": noise / generator.uniform(3.0, 10.0)}
    knowledge = chosen(generator, "right", "right", "small", "none")
    traits.append(f"stated noise {knowledge}")
    motion = {"type": "measured", "points": at.tolist(), "displacements": u.tolist()}
    motion["outside"] = "nearest"
    selections = boundary_groups(family, parts, generator, traits)
    groups = [{"select": select, "motion": motion} for select in selections]
    measured: dict[str, Any] = {"file": "-", "distortion": terms}
    if stated[knowledge] is not None:
        measured["noise"] = stated[knowledge]
    columns = zip(("x", "y", "ux", "uy"), (*at.T, *u.T), strict=True)
    table = xarray.Dataset({name: ("point", column) for name, column in columns})
    fit = {"unknown": unknown, "measured": measured, "loss": loss}
    experiment = plate(parts, chosen(generator, 1.0, 1.0, 0.5)) | {"leaders": groups}
    return Trial(family, experiment, true, fit, table, is_complete, traits)


def cost_at_truth(trial: Trial, found: Fitted) -> float:
    """Return the cost of the true parameters with the best boundaries and distortions."""
    problem = found.problem
    observations = tuple(
        replace(item, experiment=problem.experiment_at(item, np.array([*trial.true.values()])))
        for item in problem.observations
    )
    rest = Problem((), observations)
    z = found.solution.z[len(problem.unknowns) :]
    return cost_of(solved(rest, z, trial.fit["loss"]).at.residuals, trial.fit["loss"])


def judge(trial: Trial) -> tuple[str, str]:
    """Return a verdict, "good" if the trial succeeds, and details."""
    try:
        found = pbdkit.fit(trial.fit, experiment=trial.experiment, measured=trial.table)
    except (pbdkit.ExperimentError, pbdkit.DivergedError) as error:
        return type(error).__name__, str(error)
    except Exception:
        return "defect", traceback.format_exc()
    parts = [
        f"{path.rpartition('.')[2]} {found.values[path]} ({value:.4g})"
        for path, value in trial.true.items()
    ]
    details = f"{', '.join(parts)}; residual {found.ratio:.2f}; {found.solution.evaluations} states"
    cost, least = (
        cost_of(found.solution.at.residuals, trial.fit["loss"]),
        cost_at_truth(trial, found),
    )
    if cost > (1.0 + WORSE) * least:
        return "not the minimum", f"{details}; cost {cost:.6g}, of the truth {least:.6g}"
    for path, value in trial.true.items():
        estimate = found.values[path]
        tolerance = TOLERANCE if path == "rule.poisson_ratio" else RELATIVE * value
        is_far = abs(estimate.value - value) > ERRORS * estimate.error + tolerance
        if trial.is_complete and estimate.identifiable and is_far:
            return "far from the truth", details
    return "good", details


def main() -> int:
    """Run all trials, one after another."""
    asked = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    asked.add_argument("--trials", type=int, default=100)
    asked.add_argument("--seed", type=int, default=0)
    asked.add_argument("--only", type=int, nargs="+")
    given = asked.parse_args()
    warnings.simplefilter("ignore", AccuracyWarning)
    numbers = given.only or range(given.trials)
    verdicts: list[tuple[str, str]] = []
    for number in numbers:
        trial = make_trial(given.seed, number)
        start = time.process_time()
        verdict, details = judge(trial)
        verdicts.append((trial.family, verdict))
        seconds = time.process_time() - start
        spacing = f"lattice constant {trial.experiment['lattice']['a']}"
        text = f"{number} {trial.family} ({', '.join((spacing, *trial.traits))})"
        row(f"{text}: {verdict}", f"{seconds:.1f} s; {details}")
    count = len(verdicts)
    for family in FAMILIES:
        own = [verdict for name, verdict in verdicts if name == family]
        others = {v: own.count(v) for v in own if v != "good"}
        row(
            f"{family}: converge to the right minimum",
            f"{own.count('good')} of {len(own)} {others or ''}",
        )
    good = sum(verdict == "good" for _, verdict in verdicts)
    row(f"all: at least {GOAL:.0%} converge to the right minimum", f"{good} of {count}")
    slack = 3.0 * np.sqrt(GOAL * (1.0 - GOAL) / count) if count < 100 else 0.0
    return 0 if good >= (GOAL - slack) * count else 1


if __name__ == "__main__":
    sys.exit(main())
