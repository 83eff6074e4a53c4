"""How a rule answers plane waves on the infinite lattice: a bound that costs milliseconds.

A displacement exp(iθ·c) over repeat cells c is multiplied in a step by the symbol, a matrix of
blocks (axis, axis) over sublattices. Modes of a finite body lie within what the waves reach, as
long as its frame copies or mirrors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pbdkit.analysis.composition import linearised
from pbdkit.analysis.spectrum import Complex, modes
from pbdkit.registry.blame import blaming
from pbdkit.scene.scene import Scene

WAVES = 48
"""Wave numbers along each axis; an even number, so that the shortest waves are among them."""

MOST_ANSWERS = 100_000
"""Of a rule that is asked what each neighbour does to each: about half a second."""
LITTLE_MEMORY = 0.9
"""Up to which plane waves were seen to bound random bodies (tests/test_predictions.py)."""


@dataclass(frozen=True)
class Bound:
    """Over all waves: the smallest and largest real part and the largest imaginary part of the
    eigenvalues of the rule's step without relaxation and memory, and the largest modulus of the
    solver's step with them."""

    smallest: float
    largest: float
    imaginary: float
    radius: float

    def largest_stable_relaxation(self, memory: float) -> float | None:
        """2 (1 + memory) / (1 - λ_min); None where eigenvalues are complex or above 1, or the
        memory grows by itself: no such bound exists there."""
        if self.imaginary > 1e-9 or self.largest > 1.0 + 1e-9 or abs(memory) >= 1.0:
            return None
        return 2.0 * (1.0 + memory) / (1.0 - self.smallest) if self.smallest < 1.0 - 1e-9 else None


def wave_bound(scene: Scene) -> Bound | None:
    """The bound for the scene's rule at rest.

    None for rules that depend on the place or take no single numbers, where neighbours are found
    anew or are more than some 300, and where the frame lags: its delay can make modes grow that no
    plane wave knows.
    """
    if sum(len(slots) ** 2 for slots in scene.neighbourhood.slots) > MOST_ANSWERS:
        return None
    solver, lags = scene.experiment.stepping, scene.frame is not None and scene.frame.map.lag
    if lags or scene.experiment.rule.uses_reference or scene.experiment.neighbours.nearness():
        return None
    try:
        with blaming(scene.experiment.rule, "when asked about plane waves"):
            eigenvalues = _eigenvalues(_symbols(scene)).ravel()
    except (Exception, SystemExit):  # a prediction stops no run; the run names the rule at fault
        return None
    if not np.isfinite(eigenvalues).all():
        return None
    return Bound(
        float(eigenvalues.real.min()),
        float(eigenvalues.real.max()),
        float(np.abs(eigenvalues.imag).max()),
        float(np.abs(modes(eigenvalues, solver.relaxation, solver.memory)).max()),
    )


def bounds_the_body(scene: Scene) -> bool:
    """Whether no mode of the body can grow where no wave does: particles with fewer neighbours have
    modes of their own, and with much memory so have frames on leaning lattices."""
    reach = scene.neighbourhood.reach
    whole = scene.experiment.frame.depth(reach) >= reach
    return whole and abs(scene.experiment.stepping.memory) <= LITTLE_MEMORY


def _eigenvalues(matrices: Complex) -> Complex:
    """Of (wave, n, n) matrices; two by two in closed form."""
    if matrices.shape[-1] > 2:
        found: Complex = np.linalg.eigvals(matrices)
        return found
    (a, b), (c, d) = np.moveaxis(matrices, 0, -1)
    middle, half = (a + d) / 2, (a - d) / 2
    root = np.sqrt(half * half + b * c)
    return np.stack([middle + root, middle - root])


def _symbols(scene: Scene) -> Complex:
    """(wave, axes · S, axes · S): the rule's step on plane waves; opposite ones answer
    alike."""
    stencil = linearised(scene)
    angle = 2 * np.pi * np.arange(WAVES) / WAVES
    half = angle[: WAVES // 2 + 1]
    axes, waves = scene.axes, [half, *[angle] * (scene.axes - 1)]
    theta = np.stack(np.meshgrid(*waves, indexing="ij"), axis=-1).reshape(-1, axes)
    size = axes * len(stencil.own)
    symbols: Complex = np.zeros((len(theta), size, size), complex)
    symbols += np.eye(size)
    of = [slice(axes * s, axes * (s + 1)) for s in range(len(stencil.own))]
    for s, own in enumerate(stencil.own):
        symbols[:, of[s], of[s]] += own
    for slot, matrix in stencil.neighbours.items():
        here, there = of[slot.source], of[slot.target]
        phase = np.exp(1j * theta @ np.array(slot.cell, float))
        symbols[:, here, there] += phase[:, None, None] * matrix
    return symbols
