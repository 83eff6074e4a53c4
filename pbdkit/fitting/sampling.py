"""The posterior of the parameters by a sampler: a check of standard errors, which take the problem
to be straight.

All that comes in linearly - boundaries of a linear rule, distortions, Young's modulus - is
integrated out exactly, boundaries of other rules as far as they are straight around the fit: with
its derivatives J, what is left of the residuals r and a flat prior, log p = -½ |r|² - ½ log det
JᵀJ. Walkers move by the affine-invariant stretch of Goodman and Weare (emcee).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pbdkit.equilibrium.certificate import UnconvergedError
from pbdkit.errors import ExperimentError
from pbdkit.fitting.least_squares import RANK, Solution
from pbdkit.fitting.problem import Problem
from pbdkit.registry.extras import refuse_without
from pbdkit.stepping.state import Floats

BURN = 0.25
"""The share of steps that is not counted."""


@dataclass(frozen=True)
class Sample:
    """Draws of the parameters, (draw, parameter), the share of moves that were taken, and the steps
    after which a walker has forgotten where it was (NaN where there are too few to tell)."""

    draws: Floats
    acceptance: float
    memory: float

    @property
    def mean(self) -> Floats:
        """(parameter,)."""
        return np.asarray(self.draws.mean(axis=0))

    @property
    def deviation(self) -> Floats:
        """The standard deviation, (parameter,)."""
        return np.asarray(self.draws.std(axis=0))

    @property
    def error(self) -> Floats:
        """How far the mean may be off for want of draws, (parameter,): one standard error."""
        return np.asarray(self.deviation * np.sqrt(self.memory / len(self.draws)))


def refuse_no_sampler() -> None:
    """Raises ExperimentError where emcee is missing."""
    refuse_without("emcee", "sample", "the sampler needs emcee")


def sampled(problem: Problem, solution: Solution, *, walkers: int, steps: int, seed: int) -> Sample:
    """By so many walkers, so many steps each."""
    import emcee

    low, high = (bound[: len(problem.unknowns)] for bound in problem.bounds())
    size = max(1.0, solution.ratio)

    def log_posterior(values: Floats) -> float:
        if (values <= low).any() or (values >= high).any():
            return -np.inf
        return _marginal(problem, solution.z, values, size)

    generator, count = np.random.default_rng(seed), len(problem.unknowns)
    spread = np.minimum(solution.errors[:count], 0.1 * (high - low))
    start = solution.z[:count] + spread * generator.normal(size=(walkers, count))
    start = np.clip(start, low + 1e-6 * (high - low), high - 1e-6 * (high - low))
    chain = emcee.EnsembleSampler(walkers, count, log_posterior)
    chain.random_state = np.random.RandomState(seed).get_state()  # emcee's own
    chain.run_mcmc(start, steps)
    memory = chain.get_autocorr_time(quiet=True, tol=0)
    draws = chain.get_chain(discard=int(BURN * steps), flat=True)
    return Sample(draws, float(np.mean(chain.acceptance_fraction)), float(np.max(memory)))


def _marginal(problem: Problem, z: Floats, values: Floats, size: float) -> float:
    """log p of parameters, with residuals that are so many times as large as their noise."""
    observations = []
    for observation in problem.observations:
        experiment = observation.experiment
        for unknown, value in zip(problem.unknowns, values, strict=True):
            experiment = unknown.parameter.put(experiment, float(value))
        observations.append(replace(observation, experiment=experiment))
    rest = Problem((), tuple(observations))
    try:
        at = rest.at(z[len(values) :])
    except (UnconvergedError, ExperimentError):
        return -np.inf
    left, log_volume = at.residuals, 0.0
    if rest.size:
        size_of = np.linalg.norm(at.jacobian, axis=0)
        size_of[size_of == 0.0] = 1.0
        basis, sizes, _ = np.linalg.svd(at.jacobian / size_of, full_matrices=False)
        own = sizes > RANK * sizes.max(initial=0.0)  # the others change nothing, in any way
        left = left - basis[:, own] @ (basis[:, own].T @ left)
        log_volume = float(np.log(size_of).sum() + np.log(sizes[own]).sum())
    return float(-0.5 * (left @ left) / size**2 - log_volume)
