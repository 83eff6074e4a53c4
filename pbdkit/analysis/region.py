"""For which relaxation and memory a step settles, and where its modes swing.

A mode λ of the rule's own step is taken by relaxation w and memory b to the two roots of

    μ² - s μ + b = 0,  s = 1 + b - w z,  z = 1 - λ.

Both lie in the unit disc where |b| < 1 and |s - b s̄| < 1 - b² (Schur, Cohn), that is with s inside
the ellipse of half axes 1 + b along the real numbers and 1 - b along the imaginary ones:

    w < 2 (1 + b) x / (x² + y² ((1 + b) / (1 - b))²),  z = x + iy,

and w (1 - λ_min) < 2 (1 + b) for real λ. Where s is real and s² < 4b the roots are √b exp(±iω) with
cos ω = s / (2 √b): the mode swings, and shrinks by √b a step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Complex = NDArray[np.complexfloating[Any, Any]]
NEUTRAL = 1e-9
"""Eigenvalues this near to 1 in modulus count as 1."""
STRAIGHT = 1e-6
"""Imaginary parts below this are rounding: a mode that turns by less a step does not swing."""


@dataclass(frozen=True)
class Swing:
    """A mode that swings: its period in steps, 2π / |arg μ|, and by what it shrinks a step, |μ|."""

    period: float
    decay: float


def modes(eigenvalues: Complex, relaxation: float, memory: float) -> Complex:
    """(2n,): both roots μ for each of n eigenvalues λ of the rule's own step; the λ themselves,
    relaxed, and zeros without memory."""
    half = (1.0 + memory - relaxation * (1.0 - eigenvalues)) / 2.0
    root = np.sqrt(half * half - memory + 0j)
    return np.concatenate([half + root, half - root])


def largest_stable_relaxation(eigenvalues: Complex, memory: float) -> float | None:
    """The w below which all modes λ shrink with this memory, those with λ = 1 apart.

    None where there is no such w > 0 (an eigenvalue above 1, |memory| ≥ 1) or no bound to it.
    """
    z = 1.0 - eigenvalues[np.abs(1.0 - eigenvalues) > NEUTRAL]
    if not len(z) or z.real.min() < NEUTRAL or abs(memory) >= 1.0:
        return None
    stretched = z.imag * ((1.0 + memory) / (1.0 - memory))
    return float((2.0 * (1.0 + memory) * z.real / (z.real**2 + stretched**2)).min())


def slowest_swing(found: Complex) -> Swing | None:
    """The swing of the longest period among modes μ of a step; None where all have real μ."""
    swinging = found[np.abs(found.imag) > STRAIGHT]
    if not len(swinging):
        return None
    slowest = swinging[np.argmin(np.abs(np.angle(swinging)))]
    return Swing(float(2.0 * np.pi / np.abs(np.angle(slowest))), float(np.abs(slowest)))


def swings_below(relaxation: float, memory: float) -> float:
    """Real λ swing from here down, 1 - (1 - √b)² / w for 0 < b, as long as they are above
    1 - (1 + √b)² / w."""
    return 1.0 - float((1.0 - np.sqrt(memory)) ** 2) / relaxation
