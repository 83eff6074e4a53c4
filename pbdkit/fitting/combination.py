"""Combinations of parameters that the data tell, and those that they cannot, where they do not tell
each parameter by itself: the ratio of two stiffnesses, say, and their product.

A way v of parameters along which nothing changes is one of their logarithms, d ln θ = v / θ, as
well. Products of powers Π θ^e with e · d ln θ = 0 are told, and so are sums Σ e θ with e · v = 0.
Both are the same near the fit; which of them is told farther along the way is found by going there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.equilibrium.certificate import UnconvergedError
from pbdkit.errors import ExperimentError
from pbdkit.fitting.estimate import Estimate
from pbdkit.fitting.least_squares import MODULUS, TELLS, Directions, Solution
from pbdkit.fitting.problem import Problem
from pbdkit.stepping.state import Floats

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
