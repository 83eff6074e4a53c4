"""A rule's answer to the plane waves u = exp(i k·r), and its expansion for long ones.

With L(k) = -(own + Σ W exp(i k·r)) a step takes a wave to (1 - L(k)) times itself. Where there are
several sites a cell, L couples them; the slow waves, in which all sites move nearly alike, are

    L(k) X(k) = X(k) A(k),  A(k) = Σ_m A_m,  A_m of degree m in k,

order by order, with the shifts of the sites against each other eliminated (X_0: all alike,
Y·X = 1 with Y the left null vectors of L(0)). The eigenvalues of the 2 × 2 matrix A(k) are then the
rates of the slow waves to every order: of u, a step takes away A(k) u. With one site A is L.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.region import Complex
from pbdkit.identity.primitive import Primitive

Floats = NDArray[np.float64]
ZERO = 1e-8
"""What is smaller, as a share of the stencil's largest entry, is nothing."""


class NoSlowWavesError(ValueError):
    """The rule has no pair of slow waves; the message says why."""


@dataclass(frozen=True)
class SlowWaves:
    """The slow waves of a stencil: see the module."""

    stencil: Primitive
    left: Complex
    solver: Complex

    def series(self, direction: Floats, order: int = 4) -> list[Complex]:
        """A_0 to A_order for k along `direction`, to be multiplied by |k|^m / |direction|^m;
        exact, from the moments of the stencil."""
        terms = [_moment(self.stencil, direction, m) for m in range(order + 1)]
        alike = _all_alike(self.stencil.sites).astype(complex)
        x, a = [alike], [np.zeros((2, 2), complex)]
        for m in range(1, order + 1):
            pushed = sum((terms[j] @ x[m - j] for j in range(1, m + 1)), 0 * alike)
            a.append(self.left @ pushed)
            taken = sum((x[m - j] @ a[j] for j in range(1, m + 1)), 0 * alike)
            right = np.concatenate([taken - pushed, np.zeros((2, 2))])
            x.append((self.solver @ right)[: len(alike)])
        return a

    def rates(self, k: Floats) -> Floats:
        """(wave, 2): real parts of the two rates at finite k, (wave, axis), the larger first.

        With several sites those whose waves move all sites most alike.
        """
        values, vectors = np.linalg.eig(operator(self.stencil, k))
        if self.stencil.sites > 1:
            alike = _all_alike(self.stencil.sites)
            shared = np.linalg.norm(np.swapaxes(vectors, 1, 2) @ alike, axis=-1)
            best = np.argsort(-shared, axis=1)[:, :2]
            values = np.take_along_axis(values, best, axis=1)
        return np.sort(values.real, axis=1)[:, ::-1]


def slow_waves(stencil: Primitive) -> SlowWaves:
    """The slow waves; NoSlowWavesError where a translation of the whole is not left alone, or
    sites move by themselves."""
    rest = operator(stencil, np.zeros((1, 2)))[0].real
    alike, scale = _all_alike(stencil.sites), _scale(stencil)
    defect = rest @ alike
    if np.abs(defect).max() > ZERO * scale:
        worst = np.unravel_index(np.abs(defect).argmax(), defect.shape)
        raise NoSlowWavesError(
            "a rigid translation is not left alone: when everything moves by 1 along "
            f"{'xy'[worst[1]]}, the rule moves a particle by {-defect[worst]:.6g} along "
            f"{'xy'[worst[0] % 2]} a step"
        )
    u, sizes, _ = np.linalg.svd(rest)
    left = u[:, -2:].T
    if len(rest) > 2 and sizes[-3] < ZERO * scale:
        raise NoSlowWavesError(
            "the sublattices can move against each other at no rate at all: not one body"
        )
    shared = left @ alike
    if abs(np.linalg.det(shared)) < ZERO:
        raise NoSlowWavesError("the sublattices keep moving once they are shifted, ever faster")
    left = np.linalg.inv(shared) @ left
    bordered = np.block([[rest, alike], [left, np.zeros((2, 2))]])
    return SlowWaves(stencil, left.astype(complex), np.linalg.inv(bordered).astype(complex))


def operator(stencil: Primitive, k: Floats) -> Complex:
    """L(k) for waves k, (wave, axis): (wave, 2S, 2S); 1 - L(k) is what a step multiplies by."""
    found = np.zeros((len(k), 2 * stencil.sites, 2 * stencil.sites), complex)
    for s, own in enumerate(stencil.own):
        found[:, 2 * s : 2 * s + 2, 2 * s : 2 * s + 2] -= own
    phase = np.exp(1j * k @ stencil.rest.T)
    for e, (s, t) in enumerate(zip(stencil.source, stencil.target, strict=True)):
        term = phase[:, e, None, None] * stencil.matrix[e]
        found[:, 2 * s : 2 * s + 2, 2 * t : 2 * t + 2] -= term
    return found


def _moment(stencil: Primitive, direction: Floats, m: int) -> Complex:
    """The part of L of degree m in k: -(i^m / m!) Σ W (k·r)^m, and -own for m = 0."""
    if m == 0:
        still: Complex = operator(stencil, np.zeros((1, 2)))[0]
        return still
    found = np.zeros((2 * stencil.sites, 2 * stencil.sites), complex)
    weight = -(1j**m) / math.factorial(m) * (stencil.rest @ direction) ** m
    for e, (s, t) in enumerate(zip(stencil.source, stencil.target, strict=True)):
        found[2 * s : 2 * s + 2, 2 * t : 2 * t + 2] += weight[e] * stencil.matrix[e]
    return found


def _all_alike(sites: int) -> Floats:
    return np.tile(np.eye(2), (sites, 1))


def _scale(stencil: Primitive) -> float:
    return float(max(np.abs(stencil.matrix).max(), np.abs(stencil.own).max()))
