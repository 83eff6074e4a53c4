"""Errors of a fit: standard errors, identifiable combinations, profile likelihoods, samples of the
posterior, and comparison of models by cross-validation.

Profile likelihood: for each value of a parameter all others are fitted anew. Where -2 log L exceeds
its minimum by less than 3.84 lies the 95 % interval (Wilks), however the parameter bends the
predictions. With a loss the increase is that of M-estimators: it is divided by mean ψ² / mean ψ'.

Posterior: all that enters linearly - boundaries of a linear rule, distortions, Young's modulus - is
integrated out exactly, boundaries of other rules as far as they are linear around the fit: with
their derivatives J, the remaining residuals r and a flat prior, log p = -½ |r|² - ½ log det JᵀJ.
Walkers make the affine-invariant stretch moves of Goodman and Weare (emcee).

Combinations: a direction v of parameters along which nothing changes is also one of their
logarithms, d ln θ = v / θ. Products of powers Π θ^e with e · d ln θ = 0 are identifiable, and so
are sums Σ e θ with e · v = 0. Both agree near the fit; the one that holds farther along the
direction is found by going there.

Cross-validation leaves out blocks of neighbouring points together (Roberts et al. 2017, Ecography
40, 913), since the points beside a left-out point would reveal it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.equilibrium.certificate import UnconvergedError
from pbdkit.errors import ExperimentError, refuse_without
from pbdkit.fitting.observations import Carried, FieldPrediction
from pbdkit.fitting.problem import (
    MODULUS,
    RANK,
    TELLS,
    Directions,
    Loss,
    Problem,
    Solution,
    cost_of,
    rise_of_loss,
    solved,
)
from pbdkit.fitting.specification import Force
from pbdkit.plugin.units import STRESS
from pbdkit.stepping.state import Floats


@dataclass(frozen=True)
class Estimate:
    """A value with its standard error. `told` is False where the data cannot tell it: then it says
    nothing. `on_bound`: it stands on a bound, beyond which it might fit better. `unit` is that of
    both, empty where the experiment has no units."""

    value: float
    error: float
    told: bool = True
    on_bound: bool = False
    unit: str = ""

    def __str__(self) -> str:
        if not self.told:
            return "the data cannot tell it"
        digits = max(0, 1 - int(np.floor(np.log10(self.error)))) if self.error > 0.0 else 6
        text = f"{self.value:.{min(digits, 12)}f} ± {self.error:.{min(digits, 12)}f}"
        return text + f" {self.unit}" * bool(self.unit) + ", on its bound" * self.on_bound

    def as_dict(self) -> dict[str, Any]:
        """In plain values; none of what the data cannot tell."""
        return asdict(self) if self.told else {"value": None, "error": None, "told": False}


def youngs_modulus(force: Force | None, problem: Problem, solution: Solution) -> Estimate | None:
    """What curves tell of it, else what follows from a force; None where there is neither. In MPa
    where the experiment has units."""
    count, units = len(problem.unknowns), problem.observations[0].experiment.units
    unit = STRESS.unit if units else ""
    if problem.with_modulus:
        value, error = float(solution.z[count]), float(solution.errors[count])
        return Estimate(value, error, told=error < TELLS * abs(value), unit=unit)
    if force is None:
        return None
    found, size = _of_force(force, problem, solution), units.length_mm if units else 1.0
    return replace(found, value=found.value / size, error=found.error / size, unit=unit)


def _of_force(force: Force, problem: Problem, solution: Solution) -> Estimate:
    """Force over thickness and what the group carries over Young's modulus, along the force."""
    way = np.array(force.value) / np.hypot(*force.value)
    count, seen = len(problem.unknowns), solution.at.seen[0]
    assert isinstance(seen, FieldPrediction)
    carried = Carried(seen.resting, force.group)
    unit, gradient = float(way @ carried.predicted), np.zeros(problem.size)
    for n, (du, unknown) in enumerate(zip(seen.changes, problem.unknowns, strict=True)):
        gradient[n] = way @ carried.change(du, unknown.parameter)
    carried = Carried(seen.answering, force.group)  # answers in balance with this state alone
    for n, du in enumerate(seen.answers, start=count):
        gradient[n] = way @ carried.change(du)
    untold = [n for n, u in enumerate(problem.unknowns) if u.parameter.path in solution.untold]
    matters = (np.abs(gradient[untold]) > 1e-9 * abs(unit)).any()
    gradient[untold] = 0.0
    part = solution.directions.error_of(gradient)
    if unit <= 0.0:
        raise ExperimentError(
            f"group {force.group} carries no force that way in this experiment, rather one the "
            "other way; turn its sign, or look for it at another group",
            ("force", "value"),
        )
    size = float(np.hypot(*force.value))
    value = size / force.thickness / unit
    error = abs(value) * np.hypot(part / unit, force.noise / size)
    return Estimate(value, float(error), told=not matters)


BLOCKS = 32
"""So many along the longest way: of larger ones at an end, nothing else tells how it moves."""


@dataclass(frozen=True)
class Candidate:
    """A model by name: the mean square of left-out residuals over their noise and its standard
    error over blocks; by how much that is `behind` the best one's, block by block, and the error of
    this; the root mean square by which its predictions differ from the best one's, over the noise;
    and the parameters that fit, by path.

    1 is the noise alone. Who is behind by less than two errors is as good.
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
            f"{self.name}: left-out residuals² are {self.left_out:.3f} of the noise's, behind by "
            f"{self.behind:.3f} ± {self.behind_error:.3f}; {self.differs:.2g} of the noise away"
        )


@dataclass(frozen=True)
class Posed:
    """A candidate's problem and its solution."""

    name: str
    problem: Problem
    solution: Solution


def compared(posed: Sequence[Posed], folds: int, loss: Loss, seed: int) -> tuple[Candidate, ...]:
    """All against the same blocks of the points that each of them has, the best first. Raises
    UnconvergedError."""
    posed = _of_common_rows(posed, loss)
    blocks = [_blocks(o.places(), seed) for o in posed[0].problem.observations]
    scores = [_left_out(each, blocks, folds, loss) for each in posed]
    best = int(np.argmin([score.mean() for score in scores]))
    right = posed[best].solution.at.residuals
    weight = _mean_weight(posed[best].problem)
    found = [
        Candidate(
            each.name,
            *_mean(score),
            *_mean(score - scores[best]),
            float(np.sqrt(np.mean((each.solution.at.residuals - right) ** 2) / weight)),
            _values(each),
        )
        for each, score in zip(posed, scores, strict=True)
    ]
    return tuple(sorted(found, key=lambda candidate: candidate.left_out))


def _mean_weight(problem: Problem) -> float:
    """The mean weight of the numbers that were measured."""
    weights, counts = zip(*((o.weight, len(o.measured)) for o in problem.observations), strict=True)
    return float(np.average(weights, weights=counts))


def _mean(score: Floats) -> tuple[float, float]:
    """With its standard error."""
    return float(score.mean()), float(score.std(ddof=1) / np.sqrt(len(score)))


def _of_common_rows(posed: Sequence[Posed], loss: Loss) -> list[Posed]:
    """Each fitted to what all of them can predict."""
    groups = zip(*(each.problem.observations for each in posed), strict=True)
    common = [reduce(np.intersect1d, (o.rows for o in group)) for group in groups]
    found = []
    for each in posed:
        pairs = zip(each.problem.observations, common, strict=True)
        parts = tuple(o.part(np.isin(o.rows, rows)) for o, rows in pairs)
        problem = replace(each.problem, observations=parts)
        found.append(Posed(each.name, problem, solved(problem, each.solution.z, loss)))
    return found


def _values(posed: Posed) -> dict[str, float]:
    names = [u.parameter.path for u in posed.problem.unknowns]
    return dict(zip(names, map(float, posed.solution.z), strict=False))


def _left_out(posed: Posed, blocks: Sequence[NDArray[np.intp]], folds: int, loss: Loss) -> Floats:
    """The mean square residual of each block by what was fitted to the other folds, (block,)."""
    found = []
    observations = posed.problem.observations
    for fold in range(folds):
        chosen = [numbers % folds == fold for numbers in blocks]
        kept = tuple(o.part(~c) for o, c in zip(observations, chosen, strict=True))
        z = solved(replace(posed.problem, observations=kept), posed.solution.z, loss).z
        for n, (observation, c) in enumerate(zip(observations, chosen, strict=True)):
            if c.any():
                left = posed.problem.residuals_of(n, observation.part(c), z)
                own = blocks[n][c]
                parts = (left.reshape(-1, len(own))[:, own == block] for block in np.unique(own))
                found += [cost_of(part.ravel(), loss) / part.size for part in parts]
    return np.array(found) / _mean_weight(posed.problem)


def _blocks(places: Floats, seed: int) -> NDArray[np.intp]:
    """To which block each row belongs, numbered in an order drawn at random."""
    low = places.min(axis=0)
    side = max(float(np.ptp(places, axis=0).max()) / BLOCKS, 1e-300)
    cells = np.floor((places - low) / side * (1.0 - 1e-12)).astype(np.intp)
    _, numbers = np.unique(cells, axis=0, return_inverse=True)
    order = np.random.default_rng(seed).permutation(int(numbers.max()) + 1)
    return np.asarray(order[numbers.ravel()])


STEP, EVEN, MOST = 0.75, 4, 12
"""Values are so many standard errors apart, and after so many twice as far each time."""
WIDEST = 0.1
"""The largest first step, as a share of the way between bounds."""
STRAIGHT, REFINEMENTS = 1.5, 30
"""The root of the rise counts as straight over so much of it; the most values that are looked at
until it is."""
ENOUGH = 8.0
"""The rise after which no farther value is looked at."""
RISE = 3.841
"""The 95 % quantile of χ² with one degree of freedom."""


@dataclass(frozen=True)
class Profile:
    """Values of a parameter, (value,), and by how much -2 log L rises there, (value,), with the
    ends of the 95 % interval; None where data do not bound it within the bounds of the fit."""

    values: Floats
    rises: Floats
    low: float | None
    high: float | None

    def as_dict(self) -> dict[str, Any]:
        """In plain values."""
        return {
            "values": self.values.tolist(),
            "rises": self.rises.tolist(),
            "interval": [self.low, self.high],
        }

    def __str__(self) -> str:
        low, high = (f"{v:.6g}" if v is not None else "no bound" for v in (self.low, self.high))
        return f"95 % interval from {low} to {high}"


def profiled(problem: Problem, solution: Solution, n: int, loss: Loss) -> Profile:
    """The profile of parameter n: outward from the fit until it has risen enough, on both sides."""
    best = (float(solution.z[n]), 0.0)
    sides = [
        _refined(
            np.array([best, *_walk(problem, solution, n, way, loss)]), problem, solution, n, loss
        )
        for way in (-1.0, 1.0)
    ]
    low, high = (_crossing(*side.T) for side in sides)
    values, rises = np.concatenate([sides[0][:0:-1], sides[1]]).T
    return Profile(values, rises, low, high)


def _walk(
    problem: Problem, solution: Solution, n: int, way: float, loss: Loss
) -> Iterator[tuple[float, float]]:
    """Values one way, and the rise at each, as far as all else can be fitted."""
    low, high = _ends(problem.unknowns[n])
    value, z = float(solution.z[n]), solution.z
    step = min(STEP * float(solution.errors[n]), WIDEST * (high - low))
    unit, least = _unit(problem, solution, loss)
    for count in range(MOST):
        value = min(max(value + way * step, low), high)
        try:
            cost, z = _fitted_at(problem, n, value, z, loss)
        except UnconvergedError:
            return
        yield value, (cost - least) / unit
        if value in (low, high) or cost - least > ENOUGH * unit:
            return
        step *= 1.0 if count < EVEN else 2.0


def _refined(side: Floats, problem: Problem, solution: Solution, n: int, loss: Loss) -> Floats:
    """Values and rises going outward, (value, 2), with more of them where the rise comes to RISE:
    where it is flat at first, it is not straight there."""
    unit, least = _unit(problem, solution, loss)
    for _ in range(REFINEMENTS):
        roots = np.sqrt(np.maximum(side[:, 1], 0.0))
        beyond = np.flatnonzero(roots >= np.sqrt(RISE))
        if not beyond.size or (k := int(beyond[0])) == 0 or roots[k] - roots[k - 1] <= STRAIGHT:
            break
        value = float(side[k - 1 : k + 1, 0].mean())
        try:
            cost, _ = _fitted_at(problem, n, value, solution.z, loss)
        except UnconvergedError:
            break
        side = np.insert(side, k, (value, (cost - least) / unit), axis=0)
    return side


def _unit(problem: Problem, solution: Solution, loss: Loss) -> tuple[float, float]:
    """The rise of -2 log L that counts as 1, and its least value."""
    residuals = solution.at.residuals
    return rise_of_loss(residuals, problem.size, loss), cost_of(residuals, loss)


def _ends(unknown: Any) -> tuple[float, float]:
    """The bounds, and a little within them: derivatives look to both sides."""
    inset = 1e-9 * unknown.span
    return unknown.low + inset, unknown.high - inset


def _fitted_at(
    problem: Problem, n: int, value: float, start: Floats, loss: Loss
) -> tuple[float, Floats]:
    """The least cost with parameter n at a value, and the whole z there."""
    parameter = problem.unknowns[n].parameter
    observations = tuple(
        replace(o, experiment=parameter.put(o.experiment, value)) for o in problem.observations
    )
    others = Problem((*problem.unknowns[:n], *problem.unknowns[n + 1 :]), observations)
    rest = np.delete(start, n)
    if others.size:
        found = solved(others, rest, loss)
        at, rest = found.at, found.z
    else:
        at = others.at(rest)
    return cost_of(at.residuals, loss), np.insert(rest, n, value)


def _crossing(values: Floats, rises: Floats) -> float | None:
    """Where the rise, going outward, first comes to RISE: its root is nearly straight."""
    roots = np.sqrt(np.maximum(rises, 0.0))
    beyond = np.flatnonzero(roots >= np.sqrt(RISE))
    if not beyond.size or beyond[0] == 0:
        return None
    k = int(beyond[0])
    return float(np.interp(np.sqrt(RISE), roots[k - 1 : k + 1], values[k - 1 : k + 1]))


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


SAME, SIMPLE = 1e-3, 5e-3
"""The share of the largest below which an exponent is 0; how far one may be from a half or whole
number that is taken for it."""
NEAR_ZERO = 1e-2
"""A parameter that is a smaller share of the way between its bounds may be 0."""
UNSEEN = 1e-2
"""The change of residuals², over that of the noise, that is none."""
FARTHER, WITHIN = 0.2, 0.8
"""How far parameters go along a way where the data tell nothing, as a share of themselves, and of
the way to their bounds."""


@dataclass(frozen=True)
class Combination:
    """A product of powers of parameters, or a weighted sum: `weights` by path are exponents or
    factors."""

    weights: dict[str, float]
    is_product: bool
    estimate: Estimate

    @property
    def name(self) -> str:
        """A formula of it."""
        if not self.is_product:
            terms = (f"{_times(abs(w))}{path}" for path, w in self.weights.items())
            signs = (" - " if w < 0.0 else " + " for w in self.weights.values())
            return "".join(map("".join, zip(signs, terms, strict=True))).removeprefix(" + ")
        over = [_power(path, weight) for path, weight in self.weights.items() if weight > 0.0]
        under = [_power(path, -weight) for path, weight in self.weights.items() if weight < 0.0]
        return " / ".join([" · ".join(over), *under])

    def __str__(self) -> str:
        return f"{self.name}: {self.estimate}"

    def as_dict(self) -> dict[str, Any]:
        """In plain values."""
        what = "exponents" if self.is_product else "factors"
        return {what: self.weights} | self.estimate.as_dict()


def _times(factor: float) -> str:
    return "" if factor == 1.0 else f"{factor:.3g} "


def _power(path: str, exponent: float) -> str:
    return path if exponent == 1.0 else f"{path}^{exponent:.3g}"


def combinations(problem: Problem, solution: Solution) -> tuple[Combination, ...]:
    """Those of parameters that are not told one by one: first those that are told."""
    count, found = problem.shared, solution.directions
    names = [unknown.parameter.path for unknown in problem.unknowns]
    names += [MODULUS] if problem.with_modulus else []
    among = found.unsure[:, :count]
    unsure, rows = among.any(axis=1), np.flatnonzero(among.any(axis=0))
    if len(rows) < 2:
        return ()
    z, span = solution.z[rows], found.scale[rows]
    ways = found.ways[unsure][:, rows]
    paths = [names[n] for n in rows]
    is_product = bool((np.abs(z) > NEAR_ZERO * span).all())
    if is_product:
        is_whole = all((each % 1.0 == 0.0).all() for each in _complementary(ways * span / z))
        is_product = bool((z > 0.0).all() or is_whole)
        is_product = is_product and _is_product(problem, solution, rows, ways[0] * span / z)
    blind, seen = _complementary(ways * span / z) if is_product else _complementary(ways, span)
    some = [_told(found, rows, z, each, paths, is_product) for each in seen]
    none = [_combination(each, z, paths, is_product) for each in blind]
    return (*some, *none)


def _is_product(problem: Problem, solution: Solution, rows: NDArray[np.intp], way: Floats) -> bool:
    """Whether less changes where the logarithms of parameters go on along a way than where they go
    on themselves."""
    low, high = (bound[rows] for bound in problem.bounds())
    z, way = solution.z[rows], way / np.abs(way).max()
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(low - z) / (z * way), (high - z) / (z * way)])
    ends[:, np.abs(way) <= SAME] = [[-np.inf], [np.inf]]
    room = max(ends.max(axis=0).min(), ends.min(axis=0).max(), key=abs)
    room = float(np.clip(WITHIN * room, -FARTHER, FARTHER))
    changes = []
    for moved in (z * np.exp(room * way), z * (1.0 + room * way)):
        there = solution.z.copy()
        there[rows] = np.clip(moved, low, high)
        try:
            change = problem.residuals(there) - solution.at.residuals
        except (UnconvergedError, ExperimentError):
            return True
        changes.append(float(change @ change))
    return changes[0] <= max(2.0 * changes[1], UNSEEN)


def _complementary(ways: Floats, scale: Floats | float = 1.0) -> tuple[Floats, Floats]:
    """Bases of the space of some directions, in which parameters count in a scale, as the way that
    parameters go, and of what is at right angles to it, as factors of parameters."""
    _, sizes, basis = np.linalg.svd(ways)
    rank = int((sizes > SAME * sizes.max(initial=0.0)).sum())
    blind, seen = _reduced(basis[:rank]) * scale, _reduced(basis[rank:]) / scale
    return _simplified(blind), _simplified(seen)


def _simplified(rows: Floats) -> Floats:
    """Factors over the first of each row, and those as whole or half numbers that nearly are."""
    first = (rows != 0.0).argmax(axis=1)
    rows = rows / rows[np.arange(len(rows)), first][:, None]
    simple = np.round(2.0 * rows) / 2.0
    return np.where(np.abs(rows - simple) <= SIMPLE, simple, rows)


def _reduced(rows: Floats) -> Floats:
    """A basis with as many zeros as there can be, by Gauss's elimination."""
    rows, first = rows.copy(), 0
    for column in range(rows.shape[1]):
        if first == len(rows):
            break
        pivot = first + int(np.abs(rows[first:, column]).argmax())
        if abs(rows[pivot, column]) <= SAME:
            continue
        rows[[first, pivot]] = rows[[pivot, first]]
        rows[first] /= rows[first, column]
        others = np.arange(len(rows)) != first
        rows[others] -= rows[others, column, None] * rows[first]
        first += 1
    return np.where(np.abs(rows) > SAME, rows, 0.0)


def _combination(weights: Floats, z: Floats, paths: Sequence[str], is_product: bool) -> Combination:
    """One that is not told; `weights` are exponents or factors."""
    value = float(np.prod(z**weights) if is_product else weights @ z)
    named = {path: float(e) for path, e in zip(paths, weights, strict=True) if e}
    return Combination(named, is_product, Estimate(value, np.inf, told=False))


def _told(
    directions: Directions,
    rows: NDArray[np.intp],
    z: Floats,
    weights: Floats,
    paths: Sequence[str],
    is_product: bool,
) -> Combination:
    """One that is told, with its error."""
    found, gradient = _combination(weights, z, paths, is_product), np.zeros(len(directions.scale))
    gradient[rows] = weights / z if is_product else weights
    error = directions.error_of(gradient)
    most = 1.0 if is_product else np.abs(weights * directions.scale[rows]).max()
    size = abs(found.estimate.value) if is_product else 1.0
    return replace(
        found, estimate=Estimate(found.estimate.value, error * size, error < TELLS * most)
    )
