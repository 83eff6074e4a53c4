"""The parameters that fit best, how well they are known, and which of them the data cannot tell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pbdkit.equilibrium.certificate import UnconvergedError
from pbdkit.fitting.problem import At, Problem
from pbdkit.stepping.state import Floats

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
MOST_WEIGHTINGS, STEADY, RANK = 100, 1e-6, 1e-13
"""Of a linear problem with a loss; the change of residuals at which weights stay; the share of the
largest singular value below which one is none."""
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
class Solution:
    """The best z with the problem there, the covariance of z, how much larger residuals are than
    their noise, and by name the parameters that the data cannot tell, and those on their bounds."""

    z: Floats
    at: At
    covariance: Floats
    ratio: float
    untold: tuple[str, ...]
    on_bounds: tuple[str, ...]
    evaluations: int

    @property
    def errors(self) -> Floats:
        """The standard error of each z."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def solved(problem: Problem, start: Floats, loss: Loss = "linear") -> Solution:
    """By Gauss and Newton with exact derivatives: the problem as it is linear at z is solved
    between bounds, with its loss, until z stays where it is.

    The covariance is (JᵀJ)⁻¹, times the square of the ratio where residuals are larger than their
    noise says (Birge), or with a loss that of M-estimators (Huber). Raises UnconvergedError.
    """
    low, high = problem.bounds()
    z = np.clip(start, low, high)
    at, count, share, before = problem.at(z), 1, 1.0, np.zeros(problem.size)
    for _ in range(MOST_TURNS):
        step = _linear_step(at, low - z, high - z, loss)
        covariance, untold = _known(problem, at, loss)
        ratio = spread_of(at.residuals, problem.size, loss)
        own = step / np.sqrt(np.diag(covariance))
        if (np.abs(own) <= SETTLED).all():
            break
        swings = own @ before < -SWING * (before @ before)
        share = share / 2.0 if swings else min(1.0, 2.0 * share)
        share, at, tried = _taken(problem, at, z, step, share, loss)
        z, before, count = z + share * step, share * own, count + tried
    else:
        raise UnconvergedError(f"the fit still moves after {MOST_TURNS} turns")
    return Solution(z, at, covariance, ratio, untold, _on_bounds(problem, z), count)


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
        basis, triangle = np.linalg.qr(scaled * weight[:, None])
        right = basis.T @ (at.residuals * weight)
        before, y = y, np.linalg.lstsq(triangle, right, rcond=RANK)[0]
        if (y < low * size).any() or (y > high * size).any():
            from scipy.optimize import lsq_linear

            y = lsq_linear(triangle, right, (low * size, high * size), tol=1e-14).x
        if (np.abs(y - before) <= STEADY).all():
            break
    return np.asarray(y / size)


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


def _known(problem: Problem, at: At, loss: Loss) -> tuple[Floats, tuple[str, ...]]:
    """The covariance of z, for residuals at least as large as their noise, and whom the data cannot
    tell.

    Parameters count in the way between their bounds; what cannot be told is left at that way.
    """
    count = len(problem.unknowns)
    scale = np.ones(problem.size)
    scale[:count] = [u.span for u in problem.unknowns]
    jacobian = at.jacobian * scale
    rest = np.linalg.norm(jacobian[:, count:], axis=0)
    jacobian[:, count:] /= np.where(rest > 0.0, rest, 1.0)
    scale[count:] /= np.where(rest > 0.0, rest, 1.0)
    _, sizes, ways = np.linalg.svd(np.linalg.qr(jacobian, mode="r"))
    sizes = np.append(sizes, np.zeros(len(ways) - len(sizes)))  # of fewer residuals than unknowns
    least = sizes.max(initial=0.0) * RANK
    variance = np.array([1.0 / s**2 if s > least else np.inf for s in sizes])
    variance *= _of_loss(at.residuals, problem.size, loss)
    own = ways[:, :count]
    unsure = (variance > TELLS**2) & (np.abs(own).max(axis=1, initial=0.0) > PART)
    untold = {n for row in own[unsure] for n in np.flatnonzero(np.abs(row) > PART).tolist()}
    variance = np.minimum(variance, 1e12)
    covariance = (ways.T * variance) @ ways * np.outer(scale, scale)
    spread = np.sqrt(np.diag(covariance))[:count]
    untold |= {n for n, u in enumerate(problem.unknowns) if spread[n] > TELLS * u.span}
    return covariance, tuple(problem.unknowns[n].parameter.path for n in sorted(untold))


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
