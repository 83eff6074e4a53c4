"""Parts of a body that nothing holds, or not wholly."""

from __future__ import annotations

import math
from contextlib import suppress
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.couplings import DENSE
from pbdkit.equilibrium.krylov import Deflated, Shifted
from pbdkit.equilibrium.linear_solver import Dense
from pbdkit.equilibrium.newton import LinearSolver
from pbdkit.equilibrium.system_parts import SAFETY, SINGULAR, DriftingError, Part, estimated_norm

Floats = NDArray[np.float64]


class Floating(Part):
    """A part with modes that no step changes: what their invariants Yᵀ u, Yᵀ A = 0, were, they
    remain. `before` is the share of A that looks back a step: it has a share in the invariants."""

    def __init__(self, matrix: Any, before: Any) -> None:
        self._size = matrix.shape[0]
        shifted = Shifted(matrix) if self._size > DENSE else None
        self._left = shifted.left if shifted else _left_kernel(matrix)
        rows = self._left.T + (self._left.T @ before if before is not None else 0.0)
        self._solver: LinearSolver | None = None
        with suppress(np.linalg.LinAlgError):  # modes that grow: only rest is an equilibrium
            self._solver = (
                Deflated(shifted, np.asarray(rows))
                if shifted
                else Dense(_bordered(matrix, self._left, np.asarray(rows)))
            )

    @property
    def name(self) -> str:
        """That of the linear solver."""
        return "lu"

    def solve(self, r: Floats, accuracy: float, owed: Floats | None = None) -> Floats:
        """By this method."""
        push = self._left.T @ r
        if self._solver is None:
            if r.any():
                raise DriftingError
            return np.zeros(self._size)
        if np.abs(push).max(initial=0.0) > SINGULAR * max(1.0, float(np.linalg.norm(r))):
            raise DriftingError
        kept = np.zeros(len(push)) if owed is None else self._left.T @ owed
        x = self._solver.solve(np.concatenate([r - self._left @ push, kept]), accuracy)
        return x[: self._size]

    def farthest(self, r: Floats) -> float:
        """From the inverse where it is at hand, else from a bound on it."""
        if isinstance(self._solver, Dense):
            own = np.abs(self._solver.inverse[: self._size, : self._size])
            return float((own @ r).max(initial=0.0))
        if self._solver is None:
            return math.inf if r.any() else 0.0
        return self._norm * float(r.max(initial=0.0))

    @property
    def how(self) -> str:
        """By the inverse where it is at hand, else by what the matrix allows."""
        return "inverse" if isinstance(self._solver, Dense) else "estimated norm of the inverse"

    @cached_property
    def _norm(self) -> float:
        assert self._solver is not None
        return SAFETY * estimated_norm(self._solver, self._size + self._left.shape[1])


def _left_kernel(matrix: Any) -> Floats:
    """(unknown, mode): an orthonormal basis of all y with yᵀ A = 0."""
    left, values, _ = np.linalg.svd(_dense(matrix))
    basis: Floats = left[:, values <= SINGULAR * max(1.0, values.max(initial=0.0))]
    return basis


def _bordered(matrix: Any, left: Floats, rows: Floats) -> Floats:
    corner = np.zeros((left.shape[1], left.shape[1]))
    return np.block([[_dense(matrix), left], [rows, corner]])


def _dense(matrix: Any) -> Floats:
    return matrix if isinstance(matrix, np.ndarray) else np.asarray(matrix.toarray())
