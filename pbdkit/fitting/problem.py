"""The least-squares problem of a fit: residuals divided by their noise, their derivatives, a start,
and the iteration with what the data determine.

The start minimises the equilibrium gap: measured displacements, put on the particles, would not
move under the right rule, m(u, θ) = 0 where all neighbours are known. m is nearly linear in θ, so
that a few linear problems find θ without one equilibrium (Claire, Hild, Roux 2004). Noise biases
that estimate, wide bounds do not: the middle of wide bounds is far off.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pbdkit.equilibrium.certificate import UnconvergedError
from pbdkit.equilibrium.system import Moves
from pbdkit.errors import ExperimentError
from pbdkit.fitting.observations import FieldObservation, Near, Observation, Prediction
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.sensitivity import scene_like
from pbdkit.model.experiment import Experiment
from pbdkit.stepping.state import Floats, initial_state

TURNS, INSET = 3, 1e-3
"""Linear problems; the share of the way between bounds by which a start keeps away from them."""
PLANE, NEAREST, FAR = 3, 12, 2.0
"""How few points tell a plane, and how many it goes through; farther than so many times their
spacing none is known."""


def least_gap(
    field: FieldObservation, parameters: Sequence[Parameter], low: Floats, high: Floats
) -> Floats:
    """The parameters between bounds, (parameter,); their middle where too little is known."""
    middle, inset = (low + high) / 2.0, INSET * (high - low)
    values = middle
    if len(field.evidence.points) < PLANE:
        return middle
    state = initial_state(field.scene)
    u = _on_particles(field)

    def moves(experiment: Experiment) -> Floats:
        scene = scene_like(field.scene, experiment).at(experiment.steps)
        with np.errstate(invalid="ignore"):
            found = Moves(scene, compiles=False).at(replace(state, u=u.copy()), experiment.steps)
        return np.asarray(found)

    try:
        for _ in range(TURNS):
            experiment = field.experiment
            for parameter, value in zip(parameters, values, strict=True):
                experiment = parameter.put(experiment, float(value))
            gap = moves(experiment)
            known = np.isfinite(gap)
            if known.sum() < 2 * len(values):
                return middle
            slopes = [p.derivative(experiment, moves)[known] for p in parameters]
            step, *_ = np.linalg.lstsq(np.stack(slopes, axis=1), -gap[known], rcond=1e-9)
            values = np.clip(values + step, low + inset, high - inset)
    except ExperimentError:
        return middle
    return np.asarray(values)


def _on_particles(field: FieldObservation) -> Floats:
    """What was measured as planes: at each particle, by a plane through the nearest points. NaN
    where there are none near."""
    from scipy.spatial import KDTree

    scene, raster = field.scene, field.scene.raster
    rows, at = raster.body_rows, field.evidence.points
    places, measured = raster.reference(rows), field.measured.reshape(2, -1).T
    tree = KDTree(at)
    between, _ = tree.query(at, 2)
    distance, near = tree.query(places, min(NEAREST, len(at)))
    ways = at[near] - places[:, None]
    basis = np.concatenate([np.ones((*near.shape, 1)), ways], axis=2)
    products = np.einsum("pki,pkj->pij", basis, basis)
    products += 1e-9 * np.trace(products, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    right = np.einsum("pki,pka->pia", basis, measured[near])
    known = np.linalg.solve(products, right)[:, 0]
    known[distance[:, 0] > FAR * np.median(between[:, 1])] = np.nan
    u = np.full((scene.axes, *raster.shape), np.nan)
    flat = u.reshape(scene.axes, -1)
    flat[:, raster.place_of(rows)] = known.T
    if frame := scene.at(scene.experiment.steps).frame:
        frame.follow(flat, flat)
    return u


WIDE = 10.0
"""Bounds in such a ratio have a middle that says nothing."""


@dataclass(frozen=True)
class Unknown:
    """A parameter and the bounds between which it is looked for."""

    parameter: Parameter
    low: float
    high: float

    @property
    def span(self) -> float:
        """From bound to bound."""
        return self.high - self.low


@dataclass(frozen=True)
class At:
    """The problem at z: the residuals (measured - predicted) / weighted noise of all observations,
    one after another, their derivatives (residual, unknown), and each observation by itself."""

    z: Floats
    residuals: Floats
    jacobian: Floats
    seen: tuple[Prediction, ...]


@dataclass(frozen=True)
class Problem:
    """z is the parameters, then Young's modulus where an observation needs it, then what each
    observation has of its own."""

    unknowns: tuple[Unknown, ...]
    observations: tuple[Observation, ...]

    @cached_property
    def with_modulus(self) -> bool:
        """Whether Young's modulus is unknown too."""
        return any(o.needs_modulus for o in self.observations)

    @cached_property
    def shared(self) -> int:
        """How many unknowns are those of all observations."""
        return len(self.unknowns) + self.with_modulus

    @cached_property
    def size(self) -> int:
        """Of z."""
        return self.shared + sum(o.own for o in self.observations)

    def rows(self) -> Iterator[tuple[Observation, slice]]:
        """Each observation with its residuals among all."""
        first = 0
        for observation in self.observations:
            yield observation, slice(first, first := first + len(observation.measured))

    def owned(self) -> Iterator[tuple[Observation, slice]]:
        """Each observation with what it owns of z."""
        first = self.shared
        for observation in self.observations:
            yield observation, slice(first, first := first + observation.own)

    def start(self) -> Floats:
        """In the middle between bounds; where these are wide, with a field, where the gap to
        equilibrium is least. Boundaries are as they were measured."""
        z, count = np.zeros(self.size), len(self.unknowns)
        low, high = (bound[:count] for bound in self.bounds())
        z[:count] = (low + high) / 2.0
        fields = [o for o in self.observations if isinstance(o, FieldObservation)]
        wide = (low > 0.0) & (high > WIDE * low)
        if fields and wide.any():
            parameters = [u.parameter for u in self.unknowns]
            found = least_gap(fields[0], parameters, low, high)
            z[:count] = np.where(wide, found, z[:count])
        for observation, own in self.owned():
            z[own] = observation.start()
        return self.with_best_modulus(z)

    def with_best_modulus(self, z: Floats) -> Floats:
        """The same with the modulus that fits best there. Raises ExperimentError where the model
        exerts no force."""
        if not self.with_modulus:
            return z
        terms = [o.modulus_terms(self.experiment_at(o, z)) for o in self.observations]
        product, square = np.sum(terms, axis=0)
        if square == 0.0:
            raise ExperimentError("the group exerts no force in this experiment", ("measured",))
        if product < 0.0:
            raise ExperimentError(
                "what was measured of the force has the other sign than in this experiment; turn "
                "it, or name another `group` or `axis`",
                ("measured",),
            )
        z = z.copy()
        z[len(self.unknowns)] = product / square
        return z

    def bounds(self) -> tuple[Floats, Floats]:
        """Of parameters; the others have none."""
        low, high = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        for n, unknown in enumerate(self.unknowns):
            low[n], high[n] = unknown.low, unknown.high
        return low, high

    def experiment_at(self, observation: Observation, z: Floats) -> Experiment:
        """The experiment of an observation with these parameters."""
        found = observation.experiment
        for unknown, value in zip(self.unknowns, z, strict=False):
            found = unknown.parameter.put(found, float(value))
        return found

    def at(self, z: Floats, near: At | None = None) -> At:
        """All of it, sooner with what was found `near` there. Raises ExperimentError, and
        UnconvergedError where nothing is predicted."""
        parameters = [u.parameter for u in self.unknowns]
        count = sum(len(o.measured) for o in self.observations)
        jacobian, seen, residuals = np.zeros((count, self.size)), [], np.zeros(count)
        modulus = float(z[len(parameters)]) if self.with_modulus else 1.0
        before = self._near(near, z) if near else [None] * len(self.observations)
        each = zip(self.rows(), self.owned(), before, strict=True)
        for (observation, rows), (_, own), seen_near in each:
            experiment = self.experiment_at(observation, z)
            found = observation.at(experiment, parameters, z[own], modulus, seen_near)
            seen.append(found)
            residuals[rows] = found.residuals
            jacobian[rows, : len(parameters)] = found.by_parameter
            jacobian[rows, own] = found.by_own
            if self.with_modulus:
                jacobian[rows, len(parameters)] = found.by_modulus
        return At(z, residuals, jacobian, tuple(seen))

    def residuals(self, z: Floats) -> Floats:
        """The residuals at z alone. Raises as `at` does."""
        return np.concatenate([self.residuals_of(n, o, z) for n, o in enumerate(self.observations)])

    def residuals_of(self, n: int, part: Observation, z: Floats) -> Floats:
        """Those of some rows of observation n."""
        own = z[[*self.owned()][n][1]]
        modulus = float(z[len(self.unknowns)]) if self.with_modulus else 1.0
        return part.at(self.experiment_at(part, z), (), own, modulus).residuals

    def _near(self, at: At, z: Floats) -> list[Near]:
        ways = [abs(z[n] - at.z[n]) / u.span for n, u in enumerate(self.unknowns)]
        return [Near(seen, float(max(ways, default=0.0))) for seen in at.seen]


Loss = Literal["linear", "soft_l1", "huber", "cauchy"]
TELLS = 0.25
"""A direction is told where its standard error is a smaller share of the way between bounds."""
PART = 0.3
"""A parameter belongs to a direction that has more of it."""
AT_BOUND = 1e-6
"""The share of the way between bounds by which a value stands on one."""
MOST_TURNS, SMALLEST = 30, 1e-3
"""Of Gauss and Newton; the smallest share of a step that is taken."""
ENOUGH, SLACK = 0.25, 1e-9
"""The share of the gain that is foretold which a step has to bring (Armijo), but for rounding."""
MOST_WEIGHTINGS, STEADY, RANK = 100, 1e-6, 1e-5
"""Of a linear problem with a loss; the change of residuals at which weights stay; the share of the
largest singular value of columns of unit length below which one is none: derivatives are no more
accurate."""
INVOLVED = 1e-2
"""An unknown has no part in a direction that is none where its column has less than that of it."""
UNTOLD = 1e12
"""The variance along such a direction."""
MODULUS = "Young's modulus"
SETTLED = 1e-2
"""The share of its standard error by which no unknown would move any more."""
SWING = 0.25
"""A step that takes back more than such a share of the last one swings: less of it is taken."""
FROZEN = 1e-3
"""What changes all residuals together by less of their noise, from bound to bound, stays."""
LEAST_SLOPE = 0.05
"""Of a loss on the mean; below it nearly all residuals are outliers."""
OUTLIERS = 1.345
"""Residuals beyond so many times their noise count less, where a loss says so (Huber)."""


@dataclass(frozen=True)
class Directions:
    """Independent directions of z, (direction, unknown), in which each unknown counts in its
    `scale`, (unknown,), and the variance along each, (direction,)."""

    ways: Floats
    variance: Floats
    scale: Floats

    @property
    def covariance(self) -> Floats:
        """Of z."""
        return (self.ways.T * self.variance) @ self.ways * np.outer(self.scale, self.scale)

    @property
    def are_none(self) -> NDArray[np.bool_]:
        """The directions along which nothing changes, (direction,)."""
        return self.variance >= UNTOLD

    @property
    def unsure(self) -> NDArray[np.bool_]:
        """The unknowns of which each direction tells too little, (direction, unknown)."""
        share = np.abs(self.ways)
        moved = share * np.sqrt(self.variance)[:, None] > TELLS
        few = (self.variance > TELLS**2)[:, None]
        return np.where(self.are_none[:, None], share > 0.0, few & (moved | (share > PART)))

    def errors(self, step: Floats) -> Floats:
        """A step along each direction, in standard errors; 0 where nothing changes."""
        along = (self.ways @ (step / self.scale)) / np.sqrt(self.variance)
        return np.where(self.are_none, 0.0, along)

    def error_of(self, gradient: Floats) -> float:
        """The standard error of a number with that gradient by z, which is the same along
        directions in which nothing changes."""
        along = self.ways @ (gradient * self.scale)
        return float(np.sqrt(np.square(along[~self.are_none]) @ self.variance[~self.are_none]))


@dataclass(frozen=True)
class Solution:
    """The best z with the problem there, how well it is known, how much larger residuals are than
    their noise, and by name the parameters that the data cannot tell, and those on their bounds."""

    z: Floats
    at: At
    directions: Directions
    ratio: float
    untold: tuple[str, ...]
    on_bounds: tuple[str, ...]
    evaluations: int

    @cached_property
    def covariance(self) -> Floats:
        """Of z."""
        return self.directions.covariance

    @property
    def errors(self) -> Floats:
        """The standard error of each z."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def solved(problem: Problem, start: Floats, loss: Loss = "linear") -> Solution:
    """By Gauss and Newton with exact derivatives: the problem as it is linear at z is solved
    between bounds, with its loss, until z stays where it is along all directions that the data
    tell; along others it stays where it began.

    The covariance is (JᵀJ)⁻¹, times the square of the ratio where residuals are larger than their
    noise says (Birge), or with a loss that of M-estimators (Huber). Raises UnconvergedError.
    """
    low, high = problem.bounds()
    z = np.clip(start, low, high)
    at, count, share = problem.at(z), 1, 1.0
    before = np.zeros(len(at.residuals))
    for _ in range(MOST_TURNS):
        step = _linear_step(at, low - z, high - z, loss)
        directions, untold = _known(problem, at, loss)
        ratio = spread_of(at.residuals, problem.size, loss)
        if (np.abs(directions.errors(step)) <= SETTLED).all():
            break
        change = at.jacobian @ step
        swings = change @ before < -SWING * (before @ before)
        share = share / 2.0 if swings else min(1.0, 2.0 * share)
        share, at, tried = _taken(problem, at, z, step, share, loss)
        z, before, count = z + share * step, share * change, count + tried
    else:
        raise UnconvergedError(f"the fit still moves after {MOST_TURNS} turns")
    return Solution(z, at, directions, ratio, untold, _on_bounds(problem, z), count)


def _taken(
    problem: Problem, at: At, z: Floats, step: Floats, share: float, loss: Loss
) -> tuple[float, At, int]:
    """The share of a step that is taken, the problem there, and how often it was looked at."""
    cost = cost_of(at.residuals, loss)
    gain = cost - cost_of(at.residuals - at.jacobian @ step, loss)
    count = 0
    while share >= SMALLEST:
        there, count = _at(problem, z + share * step, at, share), count + 1
        most = cost * (1.0 + SLACK) - ENOUGH * share * gain
        if there is not None and cost_of(there.residuals, loss) <= most:
            return share, there, count
        share /= 4.0
    raise UnconvergedError("the fit finds no way to fit better, and none to stay")


def _at(problem: Problem, z: Floats, near: At, share: float) -> At | None:
    """None where nothing is predicted there, as long as a smaller step may be taken."""
    try:
        return problem.at(z, near)
    except UnconvergedError:
        if share < 4.0 * SMALLEST:
            raise
        return None


def _linear_step(at: At, low: Floats, high: Floats, loss: Loss) -> Floats:
    """What would fit best if residuals stayed linear: by least squares between bounds, weighted
    anew until weights stay."""
    size = np.linalg.norm(at.jacobian, axis=0)
    matters = size * np.minimum(high - low, 1e100) > FROZEN
    size = np.where(matters, size, 1.0)
    scaled, y = np.where(matters, at.jacobian / size, 0.0), np.zeros(len(size))
    for _ in range(1 if loss == "linear" else MOST_WEIGHTINGS):
        weight = np.sqrt(_weight(at.residuals - scaled @ y, loss))
        basis, sizes, ways = _singular(scaled * weight[:, None])
        right = basis.T @ (at.residuals * weight)
        before, y = y, ways.T @ (right / sizes)
        if (y < low * size).any() or (y > high * size).any():
            from scipy.optimize import lsq_linear

            seen = sizes[:, None] * ways
            y = lsq_linear(seen, right, (low * size, high * size), tol=1e-14).x
        if (np.abs(y - before) <= STEADY).all():
            break
    return np.asarray(y / size)


def _singular(columns: Floats) -> tuple[Floats, Floats, Floats]:
    """The singular value decomposition of columns of unit length, without what is none."""
    basis, triangle = np.linalg.qr(columns)
    own, sizes, ways = np.linalg.svd(triangle, full_matrices=False)
    told = sizes > RANK * sizes.max(initial=0.0)
    return basis @ own[:, told], sizes[told], ways[told]


def _weight(residuals: Floats, loss: Loss) -> Floats:
    """How much each residual counts."""
    z = np.square(residuals / OUTLIERS)
    if loss == "linear":
        return np.ones(len(z))
    if loss == "huber":
        return np.asarray(1.0 / np.sqrt(np.maximum(z, 1.0)))
    return np.asarray(1.0 / np.sqrt(1.0 + z) if loss == "soft_l1" else 1.0 / (1.0 + z))


def cost_of(residuals: Floats, loss: Loss) -> float:
    """-2 log L of residuals over their noise: Σ r², or what the loss makes of it."""
    z = np.square(residuals / OUTLIERS)
    if loss == "huber":
        z = np.where(z <= 1.0, z, 2.0 * np.sqrt(z) - 1.0)
    elif loss == "soft_l1":
        z = 2.0 * (np.sqrt(1.0 + z) - 1.0)
    elif loss == "cauchy":
        z = np.log1p(z)
    return float(z.sum()) * OUTLIERS**2


def spread_of(residuals: Floats, unknowns: int, loss: Loss) -> float:
    """The residuals' standard deviation in units of their noise; with a loss, by their median."""
    if loss == "linear":
        return float(np.sqrt(residuals @ residuals / max(1, len(residuals) - unknowns)))
    return float(1.4826 * np.median(np.abs(residuals)))


def _known(problem: Problem, at: At, loss: Loss) -> tuple[Directions, tuple[str, ...]]:
    """How well z is known, for residuals at least as large as their noise, and the parameters that
    the data cannot tell.

    Parameters count in the way between their bounds, Young's modulus in its own size.
    """
    count, size = len(problem.unknowns), np.linalg.norm(at.jacobian, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    scale = 1.0 / size
    scale[:count] = [u.span for u in problem.unknowns]
    if problem.with_modulus:
        scale[count] = abs(at.z[count]) or 1.0
    _, sizes, ways = _singular(at.jacobian / size)
    told = len(sizes)
    _, sizes, ways = np.linalg.svd(sizes[:, None] * ways * (size * scale))
    variance = np.full(len(ways), UNTOLD)
    variance[:told] = np.minimum(_of_loss(at.residuals, problem.size, loss) / sizes**2, UNTOLD)
    shares = np.abs(ways[told:] * (size * scale))
    ways[told:][shares < INVOLVED * shares.max(axis=1, initial=0.0)[:, None]] = 0.0
    directions = Directions(ways, variance, scale)
    spread = np.sqrt(np.diag(directions.covariance)) / scale
    untold = (directions.unsure.any(axis=0) | (spread > TELLS))[:count]
    names = [unknown.parameter.path for unknown in problem.unknowns]
    return directions, tuple(name for name, each in zip(names, untold, strict=True) if each)


def _of_loss(residuals: Floats, unknowns: int, loss: Loss) -> float:
    """By how much larger the variance is: mean ψ² / (mean ψ')², in units of the noise."""
    square, slope = _scores(residuals, unknowns, loss)
    return square / slope**2


def rise_of_loss(residuals: Floats, unknowns: int, loss: Loss) -> float:
    """By how much more -2 log L rises than χ² does: mean ψ² / mean ψ'."""
    square, slope = _scores(residuals, unknowns, loss)
    return square / slope


def _scores(residuals: Floats, unknowns: int, loss: Loss) -> tuple[float, float]:
    """Mean ψ², in units of the noise, and mean ψ', of residuals that are at least as large as it;
    where the loss is linear the first is the square of Birge's ratio."""
    spread = spread_of(residuals, unknowns, loss)
    if loss == "linear":
        return max(1.0, spread) ** 2, 1.0
    z = residuals / min(1.0, max(spread, 1e-300)) / OUTLIERS
    if loss == "huber":
        psi, slope = np.clip(z, -1.0, 1.0), np.abs(z) <= 1.0
    elif loss == "soft_l1":
        psi, slope = z / np.sqrt(1.0 + z * z), (1.0 + z * z) ** -1.5
    else:
        psi, slope = z / (1.0 + z * z), (1.0 - z * z) / (1.0 + z * z) ** 2
    return float(np.mean(psi**2) * OUTLIERS**2), max(float(np.mean(slope)), LEAST_SLOPE)


def _on_bounds(problem: Problem, z: Floats) -> tuple[str, ...]:
    found = []
    for unknown, value in zip(problem.unknowns, z, strict=False):
        if min(value - unknown.low, unknown.high - value) <= AT_BOUND * unknown.span:
            found.append(unknown.parameter.path)
    return tuple(found)
