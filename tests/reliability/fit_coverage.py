"""Compare the errors of `pbdkit.fit` with the scatter of repeats: plates, fitted again and again.

    python tests/reliability/fit_coverage.py [--trials N] [--kinds poisson ...] [--loss soft_l1]

The true field is an equilibrium on the lattice of the fit, between ends that move by cubics. Each
repeat draws new noise, as large as that of image correlation, for the points of the field and for
those of both ends, and fits. The output is how often the true value lies within 1.96 standard
errors, and mean and standard deviation of value - true, in standard errors. The number behind ± is
twice the sampling error for the number of repeats. Exits with 1 where a goal is missed by more than
sampling explains (three times its standard deviation); values may spread by 5 % more or less than
their errors, and as much besides.
"""

from __future__ import annotations

import argparse
import csv
import os
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from trials import row

import pbdkit

WIDTH, HEIGHT = 20.0, 10.0
NOISE, POINTS, ENDS = 3e-4, 500, 11
"""Noise of a displacement in mm, as of the shipped plate with a hole; points of the field, and of
each end."""
WITHIN, BIAS, COVERAGE = 1.96, 0.1, (93.5, 96.5)
MODULUS = 210e3
YOUNG = "youngs_modulus"


@dataclass(frozen=True)
class Kind:
    """A material, and of what is unknown the bounds and the truth."""

    rule: dict[str, Any]
    unknown: dict[str, tuple[float, float]]
    true: dict[str, float]
    parts: dict[str, Any] = field(default_factory=dict)
    forced: bool = False


ELASTIC = {"type": "elastic", "poisson_ratio": 0.3}
KINDS = {
    "poisson": Kind(
        ELASTIC,
        {"rule.poisson_ratio": (0.1, 0.49)},
        {"rule.poisson_ratio": 0.3, YOUNG: MODULUS},
        forced=True,
    ),
    "regions": Kind(
        ELASTIC | {"stiffness": {"otherwise": 1.0, "half": 1.7}},
        {"rule.stiffness.half": (1.0, 2.5)},
        {"rule.stiffness.half": 1.7},
        {"regions": {"half": {"type": "rectangle", "width": 10.0, "height": HEIGHT}}},
    ),
    "orthotropic": Kind(
        {"type": "orthotropic", "poisson_ratio": 0.2, "modulus_ratio": 0.6, "shear_ratio": 0.3},
        {
            "rule.poisson_ratio": (0.0, 0.4),
            "rule.modulus_ratio": (0.2, 1.0),
            "rule.shear_ratio": (0.1, 0.5),
        },
        {"rule.poisson_ratio": 0.2, "rule.modulus_ratio": 0.6, "rule.shear_ratio": 0.3},
    ),
    "length": Kind(
        {"type": "strain-gradient", "poisson_ratio": 0.3, "length": 3.0},
        {"rule.length": (1.0, 5.0)},
        {"rule.length": 3.0},
    ),
}


def motion(x: float, noise: np.ndarray | None = None) -> dict[str, Any]:
    """An end that moves as it was measured: pulled, sheared and bent, not evenly."""
    y = np.linspace(0.0, HEIGHT, ENDS)
    s, far = 2.0 * y / HEIGHT - 1.0, x / WIDTH
    u = np.c_[
        far * (0.04 + 0.008 * s + 0.004 * s**2) - 0.002 * s**3,
        far * 0.03 - 0.003 * s + 0.001 * s**3,
    ]
    u = u if noise is None else u + noise
    points = np.c_[np.full(ENDS, x), y]
    return {"type": "measured", "points": points.tolist(), "displacements": u.tolist()}


def plate(kind: Kind, noises: np.ndarray | None = None) -> dict[str, Any]:
    """A plate with a hole, softer or stiffer in one half if the rule is to be wrong."""
    hole = {"type": "disc", "radius": 2.0, "centre": [10.0, 5.0]}
    sides = (("left", 0.0), ("right", WIDTH))
    return {
        "name": "plate",
        "lattice": {"type": "square", "a": 1.25},
        "body": {
            "type": "difference",
            "of": [{"type": "rectangle", "width": WIDTH, "height": HEIGHT}, hole],
        },
        "neighbours": {"type": "chebyshev", "shells": 1},
        "rule": kind.rule,
        "frame": {"type": "natural"},
        "leaders": [
            {
                "select": {"edge": edge},
                "motion": motion(x, None if noises is None else noises[n]),
            }
            for n, (edge, x) in enumerate(sides)
        ],
        "steps": 1,
        "solver": {"type": "equilibrium", "tolerance": 1e-9},
    } | kind.parts


@dataclass(frozen=True)
class Truth:
    """Points, the displacements there (point, axis), and the force on the right end."""

    points: np.ndarray
    displacements: np.ndarray
    force: list[float]


@cache
def truth(name: str) -> Truth:
    """Return the true field of a kind."""
    return true_field(KINDS[name])


def true_field(kind: Kind) -> Truth:
    """Return an equilibrium, bilinear between particles as in a fit; points in cells that lack a
    particle are left out."""
    diagnostics: list[dict[str, Any]] = [{"type": "displacement"}]
    if kind.forced:
        diagnostics.append({"type": "reaction", "youngs_modulus": MODULUS, "thickness": 1.0})
    ds = pbdkit.run(plate(kind) | {"diagnostics": diagnostics}, progress=False)
    at, u = ds.reference.values, ds.u.values[-1]
    x, y = np.unique(at[:, 0]), np.unique(at[:, 1])
    grid = np.full((len(x), len(y), 2), np.nan)
    grid[np.searchsorted(x, at[:, 0]), np.searchsorted(y, at[:, 1])] = u
    points = np.random.default_rng(0).uniform([0.0, 0.0], [WIDTH, HEIGHT], (POINTS, 2))
    found = RegularGridInterpolator((x, y), grid)(points)
    inside = np.isfinite(found).all(axis=1)
    force = ds.reaction.values[-1, 1].tolist() if kind.forced else [0.0, 0.0]
    return Truth(points[inside], found[inside], force)


def repeat(name: str, seed: int, trial: int, loss: str) -> list[tuple[float, float]]:
    """Return value and standard error of all unknowns; NaN if the fit reports one as not
    identifiable."""
    kind, true = KINDS[name], truth(name)
    generator = np.random.default_rng([seed, list(KINDS).index(name), trial])
    noises = NOISE * generator.normal(size=(2, ENDS, 2))
    u = true.displacements + NOISE * generator.normal(size=true.displacements.shape)
    with tempfile.NamedTemporaryFile("w", suffix=".csv", newline="") as file:
        lines = csv.writer(file)
        lines.writerow(["x", "y", "ux", "uy"])
        lines.writerows(np.c_[true.points, u].tolist())
        file.flush()
        fit = {
            "experiment": plate(kind, noises),
            "unknown": kind.unknown,
            "measured": {"file": file.name, "noise": NOISE},
            "modes": 4,
            "loss": loss,
        }
        if kind.forced:
            fit["force"] = {"group": 1, "value": true.force}
        found = pbdkit.fit(fit)
    estimates = [found.youngs_modulus if p == YOUNG else found.values[p] for p in kind.true]
    return [(e.value, e.error) if e.identifiable else (np.nan, np.nan) for e in estimates]


def report(name: str, found: np.ndarray) -> bool:
    """Prints a row for each unknown of (trial, unknown, value and error); whether none misses its
    goal by more than sampling explains."""
    count, good = len(found), True
    for n, (path, true) in enumerate(KINDS[name].true.items()):
        value, error = found[:, n].T
        off = (value - true) / error
        bias, covered = float(off.mean()), 100.0 * np.mean(np.abs(off) <= WITHIN)
        of_bias = 1.0 / np.sqrt(count)
        of_coverage = 100.0 * np.sqrt(0.95 * 0.05 / count)
        row(
            f"{name}, {path}: bias below {BIAS} standard errors, {WITHIN} of them hold "
            f"{COVERAGE[0]}-{COVERAGE[1]} %",
            f"{bias:+.3f} ± {2.0 * of_bias:.3f}, {covered:.1f} ± {2.0 * of_coverage:.1f} % of "
            f"{count}; values spread by {off.std():.3f} errors; {np.mean(value):.6g}, "
            f"true {true:g}, error {np.median(error):.3g}",
        )
        off_goal = max(COVERAGE[0] - covered, covered - COVERAGE[1])
        good &= abs(bias) < BIAS + 3.0 * of_bias and off_goal < 3.0 * of_coverage
        good &= abs(off.std() - 1.0) < 0.05 + 3.0 / np.sqrt(2.0 * count)
    return bool(good)


def main() -> int:
    """Run all kinds, one after another."""
    asked = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    asked.add_argument("--trials", type=int, default=2000)
    asked.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    asked.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    asked.add_argument("--seed", type=int, default=0)
    asked.add_argument("--loss", default="linear")
    given = asked.parse_args()
    good = True
    with ProcessPoolExecutor(given.processes) as pool:
        for name in given.kinds:
            repeat(name, given.seed, 0, given.loss)  # compiles what all of them use
            one = partial(repeat, name, given.seed, loss=given.loss)
            found = np.array(list(pool.map(one, range(given.trials), chunksize=10)))
            good &= report(name, found)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
