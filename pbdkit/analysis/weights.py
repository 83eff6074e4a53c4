"""Relaxation w and memory b with which the slowest mode of a rule shrinks fastest.

A mode with the eigenvalue λ of the rule's own step becomes two, μ² - (1 + b - wz) μ + b = 0 with
z = 1 - λ: the heavy ball (Polyak 1964). For real z from m to M, what is asked for is where the
moduli at both ends are equal, and both roots meet at an end.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from pbdkit.analysis.spectrum import NEUTRAL, STRAIGHT, Complex, modes

BELOW, FINEST = 1e-6, 1e-4
"""How near to 1 - √b and its bound w a search comes, and how fine it is."""


class Weights(NamedTuple):
    """What a move is multiplied with, and the last step."""

    relaxation: float
    memory: float

    def rate(self, eigenvalues: Complex) -> float:
        """max |μ| over modes λ, those with λ = 1 apart; 0 where there is none."""
        moving = eigenvalues[np.abs(1.0 - eigenvalues) > NEUTRAL]
        return float(np.abs(modes(moving, *self)).max(initial=0.0))


class HopelessError(ValueError):
    """With no such numbers do all modes shrink; says why."""


def best_weights(
    eigenvalues: Complex, relaxation: float | None = None, memory: float | None = None
) -> Weights:
    """The best w and b for modes λ, those with λ = 1 apart; a number that is given stays.

    Raises HopelessError where there are none.
    """
    z = 1.0 - eigenvalues[np.abs(1.0 - eigenvalues) > NEUTRAL]
    if not len(z):
        return Weights(relaxation or 1.0, memory or 0.0)
    if z.real.min() <= 0.0:
        raise HopelessError(f"the rule has a mode with the eigenvalue {1 - z.real.min():.6g}")
    if memory is not None and abs(memory) >= 1.0:
        raise HopelessError(f"memory {memory:g} lets every mode go on, or grow")
    found = _of_real(float(z.real.min()), float(z.real.max()), relaxation, memory)
    if np.abs(z.imag).max() > STRAIGHT:
        found = _of_complex(eigenvalues, relaxation, memory)
    if not found.rate(eigenvalues) < 1.0:
        raise HopelessError(f"no memory lets all modes shrink with relaxation {found[0]:g}")
    return found


def _of_real(m: float, M: float, w: float | None, b: float | None) -> Weights:
    """Both roots are real up to (1 - √b)² / w, complex to (1 + √b)² / w and real beyond."""
    if b is None and w is None:
        b = ((math.sqrt(M) - math.sqrt(m)) / (math.sqrt(M) + math.sqrt(m))) ** 2
    if w is None:
        assert b is not None
        return Weights(2.0 * (1.0 + b) / (m + M), b)
    if b is None:
        b = max((1.0 - math.sqrt(w * m)) ** 2, (1.0 - math.sqrt(w * M)) ** 2)
    return Weights(w, b)


def _of_complex(eigenvalues: Complex, w: float | None, b: float | None) -> Weights:
    """By search: over 1 - √b in factors, over w for each below its bound."""
    from pbdkit.analysis.spectrum import largest_stable_relaxation

    def at(memory: float) -> Weights:
        if w is not None:
            return Weights(w, memory)
        bound = largest_stable_relaxation(eigenvalues, memory)
        assert bound is not None
        found = _least(lambda x: Weights(x, memory).rate(eigenvalues), BELOW * bound, bound)
        return Weights(found, memory)

    def kept(logarithm: float) -> Weights:
        return at((1.0 - math.exp(logarithm)) ** 2)

    if b is not None:
        return at(b)
    starts = np.linspace(math.log(FINEST), 0.0, 20)
    rates = [kept(start).rate(eigenvalues) for start in starts]
    n = int(np.argmin(rates))
    low, high = starts[max(0, n - 1)], starts[min(len(starts) - 1, n + 1)]
    return kept(_least(lambda x: kept(x).rate(eigenvalues), low, high))


def _least(function: Any, low: float, high: float) -> float:
    """Where a function of one number with one minimum is least."""
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(function, bounds=(low, high), method="bounded")
    return float(found.x)
