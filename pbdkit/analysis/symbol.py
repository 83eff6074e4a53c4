"""How a rule answers plane waves on the infinite lattice: a bound that costs milliseconds.

A displacement exp(iθ·c) over repeat cells c is multiplied in a step by the symbol, a matrix of
2 × 2 blocks over sublattices. Modes of a finite body lie within what the waves reach, as long as
its frame copies or mirrors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.linearising import H
from pbdkit.interfaces import Here, Slot, Vector
from pbdkit.scene.scene import Scene

Complex = NDArray[np.complexfloating[Any, Any]]
WAVES = 48
"""Wave numbers along each axis; an even number, so that the shortest waves are among them."""


@dataclass(frozen=True)
class Bound:
    """Over all waves: the smallest and largest real part of the eigenvalues of the rule's step
    without relaxation and memory, and the largest modulus of the solver's step with them."""

    smallest: float
    largest: float
    radius: float

    def largest_stable_relaxation(self, memory: float) -> float:
        """2 (1 + memory) / (1 - λ_min), for real spectra."""
        return 2.0 * (1.0 + memory) / (1.0 - self.smallest)


def wave_bound(scene: Scene) -> Bound | None:
    """The bound for the scene's rule at rest; None for rules that depend on the place, and where
    neighbours are found anew."""
    if scene.experiment.rule.uses_reference or scene.experiment.neighbours.nearness():
        return None
    solver = scene.experiment.solver
    eigenvalues = _eigenvalues(_symbols(scene)).ravel()
    relaxed = 1.0 + solver.relaxation * (eigenvalues - 1.0)
    return Bound(
        float(eigenvalues.real.min()),
        float(eigenvalues.real.max()),
        float(np.abs(with_memory(relaxed, solver.memory)).max()),
    )


def with_memory(eigenvalues: Complex, memory: float) -> Complex:
    """Both roots of μ² - (λ + b) μ + b = 0 for every eigenvalue."""
    half = (eigenvalues + memory) / 2.0
    root = np.sqrt(half * half - memory + 0j)
    return np.concatenate([half + root, half - root])


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
    """(wave, 2S, 2S): the rule's step on plane waves, of which opposite ones answer alike."""
    slots = scene.neighbourhood.slots
    angle = 2 * np.pi * np.arange(WAVES) / WAVES
    half = angle[: WAVES // 2 + 1]
    theta = np.stack(np.meshgrid(half, angle, indexing="ij"), axis=-1).reshape(-1, 2)
    symbols = np.zeros((len(theta), 2 * len(slots), 2 * len(slots)), complex)
    symbols += np.eye(2 * len(slots))
    for s, own in enumerate(slots):
        here = slice(2 * s, 2 * s + 2)
        symbols[:, here, here] += _derivative(scene, own, None)
        for slot in own:
            there = slice(2 * slot.target, 2 * slot.target + 2)
            phase = np.exp(1j * theta @ np.array(slot.cell, float))
            symbols[:, here, there] += phase[:, None, None] * _derivative(scene, own, slot)
    return symbols


def _derivative(scene: Scene, slots: tuple[Slot, ...], of: Slot | None) -> NDArray[np.float64]:
    """∂move/∂u_k at rest, or ∂move/∂u_j with all neighbours where they are: (2, 2)."""
    rule, constants = scene.experiment.rule, scene.constants
    columns = []
    for axis in (0, 1):
        nudge = Vector(*(np.complex128(1j * H if axis == n else 0.0) for n in (0, 1)))
        still = Vector(np.complex128(0.0), np.complex128(0.0))
        back = Vector(-nudge.x, -nudge.y)
        parts = [
            rule.gather(
                nudge if slot is of else back if of is None else still,
                slot.rest,
                constants.weights[slot],
                constants.rule,
            )
            for slot in slots
        ]
        total = tuple(sum(part[1:], part[0]) for part in zip(*parts, strict=True))
        here = Here(nudge if of is None else still, Vector(None, None))
        with np.errstate(all="ignore"):
            columns.append([np.imag(m) / H for m in rule.apply(total, here, constants.rule)])
    return np.array(columns).T
