"""Coverage of the standard errors of fracture energy and strength, fitted to load-opening curves.

    python tests/reliability/softening_coverage.py [--trials N] [--seed S] [--finer N] [--time]

The beam is that of `fracture/notched-beam` on a lattice twice as coarse, with five cells in the
ligament and 20 increments. Its curve has 60 points with noise of 2 % of the peak load, which the
fit estimates from the residuals. The curve is computed with the model of the fit, so that the
trials test the errors due to noise alone; all trials share the runs about the start of the fit.
Printed is how often the true value lies within two standard errors, which is the case for 95.0 % of
normal errors with 58 degrees of freedom, and mean and standard deviation of the errors over the
standard error. The same is printed for the linear problem with the derivatives at the true values
and the same noise, which shows the share of the draws in the deviations. Exits with 1 if fewer than
93 % of the trials hold the true value, by more than sampling explains (three times its standard
deviation).

With `--finer`, further trials fit curves of the shipped lattice, which shows the error of the
coarse lattice. With `--time`, the shipped fit `notched-beam`, with the beam on the shipped lattice,
is timed; it has to take at most 60 s of processor time.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path[:0] = [str(Path(__file__).parents[2])]

import numpy as np

import pbdkit
from pbdkit.fitting.fit import _solve, problem_of
from pbdkit.fitting.fit_file import Fit, read_fit

TRUE = {"fracture.strength": 3.0, "fracture.energy": 0.1}
"""Strength in MPa and fracture energy in N/mm."""
BOUNDS = {
    "fracture.strength": ["2.0 MPa", "4.2 MPa"],
    "fracture.energy": ["0.06 N/mm", "0.15 N/mm"],
}
NOISE, POINTS, MODULUS = 0.02, 60, 30e3
"""Noise over the peak load, number of points, and Young's modulus in MPa."""
GOAL, MAX_SECONDS = 93.0, 60.0
OPENINGS = np.linspace(0.005, 0.3, POINTS)


def coarse():
    """Return the experiment of the fit."""
    return pbdkit.load("fracture/notched-beam").with_settings(
        {
            "lattice.a": 10.0,
            "fracture.cracks": [[[185.0, -5.0], [185.0, 48.0]]],
            "solver.control.between": [[180.0, 0.0], [190.0, 0.0]],
            "steps": 20,
            "diagnostics": [],
        }
    )


def loads(experiment):
    """Return the loads at the measured openings in N."""
    ds = pbdkit.run(experiment, progress=False)
    return np.interp(OPENINGS, ds.opening, 1e3 * ds.load_factor)


def problem_for(values, folder):
    """Return the fit and its problem, for measured loads."""
    file = Path(folder) / "curve.csv"
    header = "opening,load"
    np.savetxt(file, np.c_[OPENINGS, values], "%.9g", ",", header=header, comments="")
    measured = {
        "type": "curve",
        "file": str(file),
        "columns": header.split(","),
        "load": 0,
        "against": "opening",
        "youngs_modulus": MODULUS,
    }
    fit, _ = read_fit(Fit, {"unknown": BOUNDS, "measured": measured}, has_experiment=True)
    return fit, problem_of(fit, coarse())


def trial(fit, problem, exact, noise):
    """Return estimates and standard errors of one trial, (2, parameter)."""
    (observation,) = problem.observations
    observation = replace(observation, measured=(exact + noise) / observation.unit)
    _, solution = _solve(replace(problem, observations=(observation,)), fit)
    return solution.z, solution.errors


def linear_trial(jacobian, noise):
    """Return estimates and standard errors of the linear problem, (2, parameter)."""
    change, (square,), *_ = np.linalg.lstsq(jacobian, noise)
    covariance = np.linalg.inv(jacobian.T @ jacobian) * square / (POINTS - len(change))
    return np.array([*TRUE.values()]) + change, np.sqrt(np.diag(covariance))


def derivatives(problem):
    """Return the derivatives of the loads in N at the true values, (point, parameter)."""
    (observation,) = problem.observations
    at = problem.at(np.array([*TRUE.values()]))
    return at.jacobian * observation.noise * observation.unit


def report(name, results):
    """Print one line for each parameter, and return the percentages within two errors."""
    values, errors = np.moveaxis(np.array(results), 1, 0)
    scaled, within = (values - [*TRUE.values()]) / errors, []
    for path, z, error, mean in zip(TRUE, scaled.T, errors.T, values.mean(axis=0), strict=True):
        inside = 100 * np.mean(np.abs(z) <= 2.0)
        within.append(inside)
        print(
            f"{name}, {path}: {len(z)} trials, {inside:.1f} % within two standard errors, mean "
            f"{z.mean():+.2f}, deviation {z.std():.2f} standard errors; mean estimate {mean:.4g}, "
            f"standard error {100 * error.mean() / TRUE[path]:.2f} %",
            flush=True,
        )
    return within


def main() -> int:
    """Run the trials, and print their results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--finer", type=int, default=0)
    parser.add_argument("--time", action="store_true")
    options = parser.parse_args()
    generator, held = np.random.default_rng(options.seed), True
    with tempfile.TemporaryDirectory() as folder:
        exact = loads(coarse())
        fit, problem = problem_for(exact, folder)
        start = time.process_time()
        noise = NOISE * exact.max() * generator.normal(size=(options.trials, POINTS))
        results = []
        for n, each in enumerate(noise):
            results.append(trial(fit, problem, exact, each))
            print(n, *results[-1], f"{time.process_time() - start:.0f} s", file=sys.stderr)
        allowance = 300 * np.sqrt(0.95 * 0.05 / max(options.trials, 1))
        if results:
            held &= min(report("same lattice", results)) >= GOAL - allowance
            jacobian = derivatives(problem)
            report("linear problem", [linear_trial(jacobian, each) for each in noise])
        if options.finer:
            finer = loads(pbdkit.load("fracture/notched-beam"))
            fit, problem = problem_for(finer, folder)
            noise = NOISE * finer.max() * generator.normal(size=(options.finer, POINTS))
            results = [trial(fit, problem, finer, each) for each in noise]
            report("curve of a finer lattice", results)
    if options.time:
        start = time.process_time()
        print(pbdkit.fit("notched-beam"))
        seconds = time.process_time() - start
        held &= seconds <= MAX_SECONDS
        print(f"shipped fit: {seconds:.1f} s of processor time")
    return int(not held)


if __name__ == "__main__":
    sys.exit(main())
