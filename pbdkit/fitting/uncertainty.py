"""Uncertainty of a fit, and comparison of models.

Profile likelihood: for each value of one parameter, all other parameters are fitted again. The 95 %
interval contains the values at which -2 log L exceeds its minimum by less than 3.84 (Wilks). This
is also valid for strongly nonlinear predictions. With a loss, the increase is divided by mean ψ² /
mean ψ', as for M-estimators. If residuals are correlated, it is divided by the factor by which the
variance of the parameter grows; for samples, by the mean of this factor (Pauli, Racugno and Ventura
2011, Statistica Sinica 21, 149).

Posterior: unknowns on which predictions depend linearly are integrated out exactly. These are the
boundaries of a linear rule, distortions and Young's modulus. The boundaries of nonlinear rules are
integrated out after linearisation at the fit. With the derivatives J with respect to these
unknowns, the remaining residuals r and a flat prior, log p = -½ |r|² - ½ log det JᵀJ. The sampler
uses the affine-invariant stretch moves of Goodman and Weare (emcee).

Combinations: let the predictions not change if the parameters θ change along a direction v. To
first order they do not change either if ln θ changes along the direction v / θ. Products of powers
Π θ^e with e · (v / θ) = 0 are then identifiable, and so are sums Σ e θ with e · v = 0. Near the fit
a product and a sum are equivalent. Farther away they differ, and residuals are evaluated to choose
the one that is valid over the longer distance.

Cross-validation: blocks of adjacent points are left out (Roberts et al. 2017, Ecography 40, 913),
because a single point could be predicted from its neighbours.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats
from pbdkit.equilibrium.error_bound import UnconvergedError
from pbdkit.errors import ExperimentError, refuse_without
from pbdkit.fitting.fit_file import Force
from pbdkit.fitting.observations import FieldPrediction, GroupReaction
from pbdkit.fitting.problem import (
    IDENTIFIABLE_RATIO,
    MODULUS,
    RANK,
    Directions,
    Loss,
    Problem,
    Solution,
    cost_of,
    rise_of_loss,
    solved,
)
from pbdkit.plugin.units import STRESS


@dataclass(frozen=True)
class Estimate:
    """An estimate with its standard error.

    Parameters
    ----------
    value, error : float
        Value and standard error.
    identifiable : bool
        Whether the data determine the value.
    on_bound : bool
        Whether the value is at a bound, so that the fit might be better without the bound.
    unit : str
        Unit of value and error; empty if the experiment has no units.
    growth : float
        Factor by which the correlation of residuals increases the error.
    """

    value: float
    error: float
    identifiable: bool = True
    on_bound: bool = False
    unit: str = ""
    growth: float = 1.0

    def __str__(self) -> str:
        if not self.identifiable:
            return "not identifiable from the data"
        text = f"{self.value:.{self.decimals}f} ± {self.error:.{self.decimals}f}"
        return text + f" {self.unit}" * bool(self.unit) + ", at its bound" * self.on_bound

    @property
    def decimals(self) -> int:
        """Number of decimals with which two digits of the error are printed."""
        digits = 1 - int(np.floor(np.log10(self.error))) if self.error > 0.0 else 6
        return min(max(0, digits), 12)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values; None if the value is not identifiable."""
        return (
            asdict(self)
            if self.identifiable
            else {"value": None, "error": None, "identifiable": False}
        )


def youngs_modulus(force: Force | None, problem: Problem, solution: Solution) -> Estimate | None:
    """Return Young's modulus, computed from curves or, if there are none, from a force.

    The result is None if there are neither curves nor a force. It is in MPa if the experiment has
    units.
    """
    count, units = len(problem.unknowns), problem.observations[0].experiment.units
    unit = STRESS.unit if units else ""
    if problem.with_modulus:
        value, gradient = float(solution.z[count]), np.eye(problem.size)[count]
        return _modulus(value, *errors_of(gradient, problem, solution), unit)
    if force is None:
        return None
    value, error, independent = _modulus_from_force(force, problem, solution)
    size = units.length_mm if units else 1.0
    return _modulus(value / size, error / size, independent / size, unit)


def _modulus(value: float, error: float, independent: float, unit: str) -> Estimate:
    """Return the estimate of a modulus. It has no bounds, so that its error is compared with its
    value."""
    identifiable = error < IDENTIFIABLE_RATIO * abs(value)
    growth = error / independent if independent > 0.0 else 1.0
    return Estimate(value, error, identifiable=identifiable, unit=unit, growth=growth)


def errors_of(gradient: Floats, problem: Problem, solution: Solution) -> tuple[float, float]:
    """Return the standard error of a function of z, and that for independent residuals."""
    paths = [unknown.parameter.path for unknown in problem.unknowns]
    unidentified = [paths.index(path) for path in solution.unidentified]
    error = solution.directions.error_of(gradient, unidentified)
    if solution.independent is None:
        return error, error
    return error, solution.independent.error_of(gradient, unidentified)


def _modulus_from_force(
    force: Force, problem: Problem, solution: Solution
) -> tuple[float, float, float]:
    """Return the ratio of the measured force per thickness to the group's force divided by
    Young's modulus, both along the measured force.

    Also return its standard error, and that for independent residuals.
    """
    unit, gradient = reaction_along(force, problem, solution)
    errors = np.array(errors_of(gradient, problem, solution))
    if unit <= 0.0:
        raise ExperimentError(
            f"the force of group {force.group} has the opposite direction in this experiment; "
            "change its sign, or use the force of another group",
            ("force", "value"),
        )
    size = float(np.hypot(*force.value))
    value = size / force.thickness / unit
    error, independent = abs(value) * np.hypot(errors / unit, force.noise / size)
    return value, float(error), float(independent)


def reaction_along(force: Force, problem: Problem, solution: Solution) -> tuple[float, Floats]:
    """Return the fitted force of a group along the measured force, divided by Young's modulus and
    thickness, and its derivatives with respect to the unknowns, (unknown,)."""
    direction = np.array(force.value) / np.hypot(*force.value)
    count, prediction = len(problem.unknowns), solution.at.predictions[0]
    assert isinstance(prediction, FieldPrediction)
    reaction = GroupReaction(prediction.resting_scene, force.group)
    unit, gradient = float(direction @ reaction.predicted), np.zeros(problem.size)
    for n, (du, unknown) in enumerate(zip(prediction.changes, problem.unknowns, strict=True)):
        gradient[n] = direction @ reaction.change(du, unknown.parameter)
    problem.convert_to_units(gradient[None], solution.z)
    reaction = GroupReaction(
        prediction.answering, force.group
    )  # The responses to boundary modes are those at this state.
    for n, du in enumerate(prediction.answers, start=count):
        gradient[n] = direction @ reaction.change(du)
    return unit, gradient


BLOCKS_PER_SIDE = 32
"""Number of blocks along the longest side.

With larger blocks, the displacement of an end would depend on a single block.
"""


@dataclass(frozen=True)
class Candidate:
    """Cross-validation of a model.

    Models within two standard errors of the best are equivalent.

    Parameters
    ----------
    name
        Name of the model.
    left_out, error
        Mean square of the residuals of points that were left out, divided by their noise, and its
        standard error over blocks. The mean square is 1 if the residuals are only noise.
    behind, behind_error
        Mean difference over blocks between `left_out` and that of the best model, and its standard
        error.
    differs
        Root mean square difference from the predictions of the best model, divided by the noise.
    values
        Fitted parameters by path.
    """

    name: str
    left_out: float
    error: float
    behind: float
    behind_error: float
    differs: float
    values: dict[str, float]

    def __str__(self) -> str:
        return (
            f"{self.name}: mean squared residuals of left-out data are {self.left_out:.3f} "
            f"noise², exceeding the best by {self.behind:.3f} ± {self.behind_error:.3f}; "
            f"predictions differ by {self.differs:.2g} of the noise"
        )


@dataclass(frozen=True)
class SolvedProblem:
    """Least-squares problem of a model, and its solution."""

    name: str
    problem: Problem
    solution: Solution


def compare_models(
    models: Sequence[SolvedProblem], folds: int, loss: Loss, seed: int
) -> tuple[Candidate, ...]:
    """Compare models by cross-validation, and return them in order, the best one first.

    Only points that all models can predict are used.

    Raises
    ------
    UnconvergedError
        If a fit does not converge.
    """
    models = _fit_common_rows(models, loss)
    blocks = [_blocks(observation.places(), seed) for observation in models[0].problem.observations]
    scores = [_cross_validate(model, blocks, folds, loss) for model in models]
    best = int(np.argmin([score.mean() for score in scores]))
    best_residuals = models[best].solution.at.residuals
    weight = _mean_weight(models[best].problem)
    candidates = [
        Candidate(
            model.name,
            *_mean(score),
            *_mean(score - scores[best]),
            float(np.sqrt(np.mean((model.solution.at.residuals - best_residuals) ** 2) / weight)),
            _values(model),
        )
        for model, score in zip(models, scores, strict=True)
    ]
    return tuple(sorted(candidates, key=lambda candidate: candidate.left_out))


def _mean_weight(problem: Problem) -> float:
    """Return the mean weight of the measured numbers."""
    weights, counts = zip(
        *((observation.weight, len(observation.measured)) for observation in problem.observations),
        strict=True,
    )
    return float(np.average(weights, weights=counts))


def _mean(score: Floats) -> tuple[float, float]:
    """Return the mean and its standard error."""
    return float(score.mean()), float(score.std(ddof=1) / np.sqrt(len(score)))


def _fit_common_rows(models: Sequence[SolvedProblem], loss: Loss) -> list[SolvedProblem]:
    """Fit each model to the rows that all of them can predict."""
    groups = zip(*(model.problem.observations for model in models), strict=True)
    common_rows = [
        reduce(np.intersect1d, (observation.rows for observation in group)) for group in groups
    ]
    result = []
    for model in models:
        pairs = zip(model.problem.observations, common_rows, strict=True)
        parts = tuple(
            observation.part(np.isin(observation.rows, rows)) for observation, rows in pairs
        )
        problem = replace(model.problem, observations=parts)
        result.append(SolvedProblem(model.name, problem, solved(problem, model.solution.z, loss)))
    return result


def _values(model: SolvedProblem) -> dict[str, float]:
    names = [unknown.parameter.path for unknown in model.problem.unknowns]
    return dict(zip(names, map(float, model.solution.z), strict=False))


def _cross_validate(
    model: SolvedProblem, blocks: Sequence[NDArray[np.intp]], folds: int, loss: Loss
) -> Floats:
    """Return the mean square residual of each block, predicted by a fit to the other folds,
    (block,)."""
    scores = []
    observations = model.problem.observations
    for fold in range(folds):
        masks = [numbers % folds == fold for numbers in blocks]
        rest = tuple(item.part(~mask) for item, mask in zip(observations, masks, strict=True))
        z = solved(replace(model.problem, observations=rest), model.solution.z, loss).z
        for n, (observation, mask) in enumerate(zip(observations, masks, strict=True)):
            if mask.any():
                residuals = model.problem.residuals_of(n, observation.part(mask), z)
                block_of_row = blocks[n][mask]
                parts = (
                    residuals.reshape(-1, len(block_of_row))[:, block_of_row == block]
                    for block in np.unique(block_of_row)
                )
                scores += [cost_of(part.ravel(), loss) / part.size for part in parts]
    return np.array(scores) / _mean_weight(model.problem)


def _blocks(places: Floats, seed: int) -> NDArray[np.intp]:
    """Return the block of each row, numbered in a random order."""
    low = places.min(axis=0)
    side = max(float(np.ptp(places, axis=0).max()) / BLOCKS_PER_SIDE, 1e-300)
    cells = np.floor((places - low) / side * (1.0 - 1e-12)).astype(np.intp)
    _, numbers = np.unique(cells, axis=0, return_inverse=True)
    order = np.random.default_rng(seed).permutation(int(numbers.max()) + 1)
    return np.asarray(order[numbers.ravel()])


STEP = 0.75
"""First step of a profile in standard errors."""

EQUAL_STEPS = 4
"""Number of equal steps. Each further step is twice as long as the previous one."""

MAX_STEPS = 12
"""Largest number of steps."""
MAX_FIRST_STEP = 0.1
"""Largest first step, as a fraction of the interval between the bounds."""
STRAIGHT = 1.5
"""Largest increment of the square root of the rise for linear interpolation of the root."""

REFINEMENTS = 30
"""Maximum number of additional values of a profile between which the root is interpolated."""
MAX_RISE = 8.0
"""Rise at which a profile ends."""
RISE_95 = 3.841
"""The 95 % quantile of χ² with one degree of freedom."""


@dataclass(frozen=True)
class Profile:
    """Profile likelihood of a parameter.

    Parameters
    ----------
    values : array of float, shape (value,)
        Values of the parameter.
    rises : array of float, shape (value,)
        Increase of -2 log L.
    low, high : float or None
        Ends of the 95 % interval; None if the data do not bound it within the bounds of the fit.
    """

    values: Floats
    rises: Floats
    low: float | None
    high: float | None

    def as_dict(self) -> dict[str, Any]:
        """Return the profile as plain values."""
        return {
            "values": self.values.tolist(),
            "rises": self.rises.tolist(),
            "interval": [self.low, self.high],
        }

    def __str__(self) -> str:
        low, high = (f"{v:.6g}" if v is not None else "no bound" for v in (self.low, self.high))
        return f"95 % interval from {low} to {high}"


def profile_likelihood(problem: Problem, solution: Solution, n: int, loss: Loss) -> Profile:
    """Compute the profile of parameter n in both directions, beginning at the fit."""
    best = (float(solution.z[n]), 0.0)
    sides = [
        _refine(
            np.array([best, *_walk(problem, solution, n, direction, loss)]),
            problem,
            solution,
            n,
            loss,
        )
        for direction in (-1.0, 1.0)
    ]
    low, high = (_crossing(*side.T) for side in sides)
    values, rises = np.concatenate([sides[0][:0:-1], sides[1]]).T
    return Profile(values, rises, low, high)


def _walk(
    problem: Problem, solution: Solution, n: int, direction: float, loss: Loss
) -> Iterator[tuple[float, float]]:
    """Yield values of one parameter in one direction, with the increase of -2 log L at each.

    The iteration ends at the first value for which the other parameters cannot be fitted.
    """
    low, high = _ends(problem.unknowns[n])
    value, z = float(solution.z[n]), solution.z
    step = min(STEP * float(solution.errors[n]), MAX_FIRST_STEP * (high - low))
    unit, minimum = _unit(problem, solution, n, loss)
    for count in range(MAX_STEPS):
        value = min(max(value + direction * step, low), high)
        try:
            cost, z = _fit_at(problem, n, value, z, loss)
        except UnconvergedError:
            return
        yield value, (cost - minimum) / unit
        if value in (low, high) or cost - minimum > MAX_RISE * unit:
            return
        step *= 1.0 if count < EQUAL_STEPS else 2.0


def _refine(side: Floats, problem: Problem, solution: Solution, n: int, loss: Loss) -> Floats:
    """Insert values of shape (value, 2) where the rise reaches RISE_95.

    The square root of the rise is not linear near this value if the profile is flat near the fit.
    """
    unit, minimum = _unit(problem, solution, n, loss)
    for _ in range(REFINEMENTS):
        roots = np.sqrt(np.maximum(side[:, 1], 0.0))
        indices = np.flatnonzero(roots >= np.sqrt(RISE_95))
        if not indices.size or (k := int(indices[0])) == 0 or roots[k] - roots[k - 1] <= STRAIGHT:
            break
        value = float(side[k - 1 : k + 1, 0].mean())
        try:
            cost, _ = _fit_at(problem, n, value, solution.z, loss)
        except UnconvergedError:
            break
        side = np.insert(side, k, (value, (cost - minimum) / unit), axis=0)
    return side


def _unit(problem: Problem, solution: Solution, n: int, loss: Loss) -> tuple[float, float]:
    """Return the increase of the cost that corresponds to 1 in -2 log L, and the minimum cost.

    Correlated residuals contain less information, by the square of the growth of the error.
    """
    residuals = solution.at.residuals
    growth = float(solution.growth[n]) ** 2
    return growth * rise_of_loss(residuals, problem.size, loss), cost_of(residuals, loss)


def _ends(unknown: Any) -> tuple[float, float]:
    """Return bounds that are slightly narrower, because derivatives use values on both sides."""
    inset = 1e-9 * unknown.span
    return unknown.low + inset, unknown.high - inset


def _fit_at(
    problem: Problem, n: int, value: float, start: Floats, loss: Loss
) -> tuple[float, Floats]:
    """Return the smallest cost for a fixed value of parameter n, and the z with this cost."""
    unknown = problem.unknowns[n]
    observations = tuple(
        replace(observation, experiment=unknown.put(observation.experiment, value))
        for observation in problem.observations
    )
    reduced = Problem((*problem.unknowns[:n], *problem.unknowns[n + 1 :]), observations)
    rest = np.delete(start, n)
    if reduced.size:
        solution = solved(reduced, rest, loss)
        at, rest = solution.at, solution.z
    else:
        at = reduced.at(rest)
    return cost_of(at.residuals, loss), np.insert(rest, n, value)


def _crossing(values: Floats, rises: Floats) -> float | None:
    """Return the value at which the rise first reaches RISE_95, by interpolation.

    The square root of the rise is interpolated linearly, because it is nearly a linear function.
    """
    roots = np.sqrt(np.maximum(rises, 0.0))
    indices = np.flatnonzero(roots >= np.sqrt(RISE_95))
    if not indices.size or indices[0] == 0:
        return None
    k = int(indices[0])
    return float(np.interp(np.sqrt(RISE_95), roots[k - 1 : k + 1], values[k - 1 : k + 1]))


BURN_IN = 0.25
"""Fraction of the steps that is discarded."""


@dataclass(frozen=True)
class Sample:
    """Sample of the posterior.

    Parameters
    ----------
    draws : array of float, shape (draw, parameter)
        Values of the parameters.
    acceptance : float
        Fraction of accepted moves.
    memory : float
        Autocorrelation time in steps; NaN if there are too few steps.
    """

    draws: Floats
    acceptance: float
    memory: float

    @property
    def mean(self) -> Floats:
        """Return the means, (parameter,)."""
        return np.asarray(self.draws.mean(axis=0))

    @property
    def deviation(self) -> Floats:
        """Return the standard deviations, (parameter,)."""
        return np.asarray(self.draws.std(axis=0))

    @property
    def error(self) -> Floats:
        """Return the standard errors of the means due to the number of draws, (parameter,)."""
        return np.asarray(self.deviation * np.sqrt(self.memory / len(self.draws)))


def refuse_no_sampler() -> None:
    """Raise ExperimentError if emcee is not installed."""
    refuse_without("emcee", "sample", "the sampler requires emcee")


def sample_posterior(
    problem: Problem, solution: Solution, *, walkers: int, steps: int, seed: int
) -> Sample:
    """Sample the posterior with a number of walkers and steps."""
    import emcee

    low, high = (bound[: len(problem.unknowns)] for bound in problem.bounds())
    growth = solution.growth[: len(problem.unknowns)]
    size = max(1.0, solution.ratio) * float(np.sqrt(np.mean(growth**2)))

    def log_posterior(values: Floats) -> float:
        if (values <= low).any() or (values >= high).any():
            return -np.inf
        return _marginal(problem, solution.z, values, size)

    generator, count = np.random.default_rng(seed), len(problem.unknowns)
    spread = np.minimum(solution.errors[:count], 0.1 * (high - low))
    start = solution.z[:count] + spread * generator.normal(size=(walkers, count))
    start = np.clip(start, low + 1e-6 * (high - low), high - 1e-6 * (high - low))
    chain = emcee.EnsembleSampler(walkers, count, log_posterior)
    # emcee stores a state of its own for random numbers.
    chain.random_state = np.random.RandomState(seed).get_state()
    chain.run_mcmc(start, steps)
    memory = chain.get_autocorr_time(quiet=True, tol=0)
    draws = chain.get_chain(discard=int(BURN_IN * steps), flat=True)
    return Sample(draws, float(np.mean(chain.acceptance_fraction)), float(np.max(memory)))


def _marginal(problem: Problem, z: Floats, values: Floats, size: float) -> float:
    """Return log p of parameters, if the residuals are `size` times as large as their noise."""
    observations = []
    for observation in problem.observations:
        experiment = observation.experiment
        for unknown, value in zip(problem.unknowns, values, strict=True):
            experiment = unknown.put(experiment, float(value))
        observations.append(replace(observation, experiment=experiment))
    rest = Problem((), tuple(observations))
    try:
        linearisation = rest.at(z[len(values) :])
    except (UnconvergedError, ExperimentError):
        return -np.inf
    residuals, log_volume = linearisation.residuals, 0.0
    if rest.size:
        size_of = np.linalg.norm(linearisation.jacobian, axis=0)
        size_of[size_of == 0.0] = 1.0
        basis, sizes, _ = np.linalg.svd(linearisation.jacobian / size_of, full_matrices=False)
        # All other directions have no influence.
        is_regular = sizes > RANK * sizes.max(initial=0.0)
        residuals = residuals - basis[:, is_regular] @ (basis[:, is_regular].T @ residuals)
        log_volume = float(np.log(size_of).sum() + np.log(sizes[is_regular]).sum())
    return float(-0.5 * (residuals @ residuals) / size**2 - log_volume)


SAME = 1e-3
"""Fraction of the largest exponent below which an exponent is treated as 0."""

SIMPLE = 5e-3
"""Largest deviation of an exponent from a whole or half number to which it is rounded."""
NEAR_ZERO = 1e-2
"""Distance from 0 up to which the true value of a parameter may be 0.

It is a fraction of the interval between the bounds.
"""
UNSEEN = 1e-2
"""Largest negligible change of the squared residuals, relative to that due to noise."""
MAX_RELATIVE_CHANGE = 0.2
"""Largest relative change of parameters along a direction that is not identifiable."""

MAX_BOUND_FRACTION = 0.8
"""Largest change along a direction that is not identifiable, relative to the bounds.

It is a fraction of the distance to the bounds.
"""


@dataclass(frozen=True)
class Combination:
    """A product of powers of parameters, or a weighted sum.

    Parameters
    ----------
    weights
        Exponents, or factors, by path.
    is_product
        Whether it is a product.
    estimate
        Its value.
    """

    weights: dict[str, float]
    is_product: bool
    estimate: Estimate

    @property
    def name(self) -> str:
        """Return the combination as a formula."""
        if not self.is_product:
            terms = (f"{_times(abs(factor))}{path}" for path, factor in self.weights.items())
            signs = (" - " if factor < 0.0 else " + " for factor in self.weights.values())
            return "".join(map("".join, zip(signs, terms, strict=True))).removeprefix(" + ")
        numerator = [_power(path, weight) for path, weight in self.weights.items() if weight > 0.0]
        denominators = [
            _power(path, -weight) for path, weight in self.weights.items() if weight < 0.0
        ]
        return " / ".join([" · ".join(numerator), *denominators])

    def __str__(self) -> str:
        return f"{self.name}: {self.estimate}"

    def as_dict(self) -> dict[str, Any]:
        """Return the combination as plain values."""
        key = "exponents" if self.is_product else "factors"
        return {key: self.weights} | self.estimate.as_dict()


def _times(factor: float) -> str:
    return "" if factor == 1.0 else f"{factor:.3g} "


def _power(path: str, exponent: float) -> str:
    return path if exponent == 1.0 else f"{path}^{exponent:.3g}"


def combinations(problem: Problem, solution: Solution) -> tuple[Combination, ...]:
    """Return combinations of parameters that are not identifiable separately.

    Identifiable combinations come first.
    """
    count, directions = problem.shared, solution.directions
    names = [unknown.parameter.path for unknown in problem.unknowns]
    names += [MODULUS] if problem.with_modulus else []
    unsure_shared = directions.unsure[:, :count]
    unsure, rows = unsure_shared.any(axis=1), np.flatnonzero(unsure_shared.any(axis=0))
    if len(rows) < 2:
        return ()
    z, span = solution.z[rows], directions.scale[rows]
    vectors = directions.vectors[unsure][:, rows]
    paths = [names[n] for n in rows]
    is_product = bool((np.abs(z) > NEAR_ZERO * span).all())
    if is_product:
        is_whole = all(
            (weights % 1.0 == 0.0).all() for weights in _complementary(vectors * span / z)
        )
        is_product = bool((z > 0.0).all() or is_whole)
        is_product = is_product and _is_product(problem, solution, rows, vectors[0] * span / z)
    null, complement = (
        _complementary(vectors * span / z) if is_product else _complementary(vectors, span)
    )
    identifiable = [
        _identifiable_combination(directions, rows, z, weights, paths, is_product)
        for weights in complement
    ]
    unidentified = [_make_combination(weights, z, paths, is_product) for weights in null]
    return (*identifiable, *unidentified)


def _is_product(
    problem: Problem, solution: Solution, rows: NDArray[np.intp], direction: Floats
) -> bool:
    """Return whether a product is a better combination than a sum for a direction.

    It is better if residuals change less when the logarithms of the parameters change along the
    direction than when the parameters themselves change along it.
    """
    low, high = (bound[rows] for bound in problem.bounds())
    z, direction = solution.z[rows], direction / np.abs(direction).max()
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(low - z) / (z * direction), (high - z) / (z * direction)])
    ends[:, np.abs(direction) <= SAME] = [[-np.inf], [np.inf]]
    room = max(ends.max(axis=0).min(), ends.min(axis=0).max(), key=abs)
    room = float(np.clip(MAX_BOUND_FRACTION * room, -MAX_RELATIVE_CHANGE, MAX_RELATIVE_CHANGE))
    changes = []
    for values in (z * np.exp(room * direction), z * (1.0 + room * direction)):
        z_moved = solution.z.copy()
        z_moved[rows] = np.clip(values, low, high)
        try:
            change = problem.residuals(z_moved) - solution.at.residuals
        except (UnconvergedError, ExperimentError):
            return True
        changes.append(float(change @ change))
    return changes[0] <= max(2.0 * changes[1], UNSEEN)


def _complementary(directions: Floats, scale: Floats | float = 1.0) -> tuple[Floats, Floats]:
    """Return a basis of a space of directions, and a basis of its orthogonal complement.

    The second basis consists of factors of parameters.

    Parameters
    ----------
    directions
        Directions.
    scale
        Scale of the parameters.
    """
    _, sizes, basis = np.linalg.svd(directions)
    rank = int((sizes > SAME * sizes.max(initial=0.0)).sum())
    space, complement = _row_reduce(basis[:rank]) * scale, _row_reduce(basis[rank:]) / scale
    return _round_factors(space), _round_factors(complement)


def _round_factors(rows: Floats) -> Floats:
    """Divide each row by its first entry, and round entries close to a multiple of one half."""
    first = (rows != 0.0).argmax(axis=1)
    rows = rows / rows[np.arange(len(rows)), first][:, None]
    simple = np.round(2.0 * rows) / 2.0
    return np.where(np.abs(rows - simple) <= SIMPLE, simple, rows)


def _row_reduce(rows: Floats) -> Floats:
    """Return a basis with as many zeros as possible, by Gaussian elimination."""
    rows, first = rows.copy(), 0
    for column in range(rows.shape[1]):
        if first == len(rows):
            break
        pivot = first + int(np.abs(rows[first:, column]).argmax())
        if abs(rows[pivot, column]) <= SAME:
            continue
        rows[[first, pivot]] = rows[[pivot, first]]
        rows[first] /= rows[first, column]
        other_rows = np.arange(len(rows)) != first
        rows[other_rows] -= rows[other_rows, column, None] * rows[first]
        first += 1
    return np.where(np.abs(rows) > SAME, rows, 0.0)


def _make_combination(
    weights: Floats, z: Floats, paths: Sequence[str], is_product: bool
) -> Combination:
    """Return an unidentified combination; `weights` are exponents or factors."""
    value = float(np.prod(z**weights) if is_product else weights @ z)
    by_path = {path: float(weight) for path, weight in zip(paths, weights, strict=True) if weight}
    return Combination(by_path, is_product, Estimate(value, np.inf, identifiable=False))


def _identifiable_combination(
    directions: Directions,
    rows: NDArray[np.intp],
    z: Floats,
    weights: Floats,
    paths: Sequence[str],
    is_product: bool,
) -> Combination:
    """Return an identifiable combination with its error."""
    combination, gradient = (
        _make_combination(weights, z, paths, is_product),
        np.zeros(len(directions.scale)),
    )
    gradient[rows] = weights / z if is_product else weights
    error = directions.error_of(gradient)
    largest = 1.0 if is_product else np.abs(weights * directions.scale[rows]).max()
    size = abs(combination.estimate.value) if is_product else 1.0
    return replace(
        combination,
        estimate=Estimate(
            combination.estimate.value, error * size, error < IDENTIFIABLE_RATIO * largest
        ),
    )
