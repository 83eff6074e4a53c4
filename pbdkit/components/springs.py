"""A rule that is a net of springs: nonlinear, and exact under rotation."""

from __future__ import annotations

import math
from typing import Any, ClassVar, Literal

from pbdkit.errors import ExperimentError
from pbdkit.interfaces import (
    FollowerRule,
    Here,
    Setting,
    Slot,
    Stiffness,
    StoresEnergy,
    dot,
    length,
    where,
)

EDGE_OF_SQUARE, DIAGONAL_OF_SQUARE, OF_TRIANGLE = 0.75, 0.375, math.sqrt(0.75)
"""Stiffnesses of the springs over Young's modulus and thickness: isotropic with ν = 1/3."""


class Springs(StoresEnergy, FollowerRule):
    """Each neighbour proposes the place at its rest distance, on the line to where the particle
    stands: x_k + l₀ (x_j - x_k)/|x_j - x_k|; the particle goes to the weighted mean.

    Weights are equal on the hexagonal lattice with 6 neighbours, 2 : 1 for edges and diagonals on
    the square one with 8, and half on free edges. For small strain it is elasticity in plane stress
    with ν = 1/3; rotations are exact, and the springs' energy never rises with relaxation 1.
    """

    type: Literal["springs"] = "springs"

    uses_cells: ClassVar[bool] = True

    def stiffness(self) -> Stiffness:
        """Plane stress with ν = 1/3, for small strain."""
        return Stiffness(9 / 8, 9 / 8, 3 / 8, 3 / 8)

    def weights(self, slot: Slot, setting: Setting) -> dict[str, float]:
        """Half the spring's stiffness, for each of the cells beside it, and its rest length."""
        cells, rest = setting.cells, math.hypot(*slot.rest)
        if cells.regular == 3:
            return {"half": OF_TRIANGLE / 2, "rest": rest}
        if cells.regular == 4:
            k = DIAGONAL_OF_SQUARE if cells.is_diagonal(slot) else EDGE_OF_SQUARE
            return {"half": k / 2, "rest": rest}
        raise ExperimentError(
            "'springs' works on the hexagonal lattice with 6 neighbours ({type: coordination, "
            "shells: 1}) and on the square lattice with 8 ({type: chebyshev, shells: 1})"
        )

    @staticmethod
    def gather(d: Any, r: Any, w: Any, p: Any) -> tuple[Any, ...]:
        """(k e n, k) with the elongation e = |r + d| - |r| along n = (r + d)/|r + d|."""
        stiffness, v = w.half * (w.left + w.right), r + d
        distance = length(v)
        elongation = dot(d, r + v) / (distance + w.rest)
        return (stiffness * elongation / where(distance > 0.0, distance, 1.0)) * v, stiffness

    @staticmethod
    def apply(total: Any, here: Here, p: Any) -> Any:
        """Σ k e n / Σ k; no move where there is no cell."""
        pull, stiffness = total
        return pull / where(stiffness > 0.0, stiffness, 1.0)

    @staticmethod
    def force(total: Any, here: Here, p: Any) -> Any:
        """Σ k e n."""
        return total[0]

    @staticmethod
    def energy(d: Any, r: Any, w: Any, p: Any) -> Any:
        """Half of ½ k e²."""
        v = r + d
        elongation = dot(d, r + v) / (length(v) + w.rest)
        return w.half * (w.left + w.right) * elongation * elongation / 4
