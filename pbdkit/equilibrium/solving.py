"""What every method of solving linear systems offers."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class LinearSolver(ABC):
    """Solves A x = b for one matrix, with an unknown a row."""

    name: str
    iterations = 0

    @abstractmethod
    def solve(self, b: Floats, accuracy: float) -> Floats:
        """x with ‖b - A x‖₂ ≤ accuracy · ‖b‖₂ as far as the method gets."""

    @abstractmethod
    def solve_transposed(self, b: Floats, accuracy: float) -> Floats:
        """The same for Aᵀ."""
