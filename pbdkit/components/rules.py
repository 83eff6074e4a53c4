"""The paper's follower rules (its section 3; model.md, section 5), and a net of springs."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from pbdkit.components.elasticity import Factor
from pbdkit.errors import ExperimentError
from pbdkit.plugin import (
    FollowerRule,
    Here,
    Loadable,
    Number,
    Parameters,
    Setting,
    Slot,
    Stiffness,
    StoresEnergy,
    TearsCells,
    Torn,
    Vector,
    Weights,
    dot,
    length,
    where,
)
from pbdkit.plugin.units import PER_LENGTH


class Barycentre(FollowerRule):
    """x_j = (1/N) Σ x_k.

    The rest offsets are summed apart from the differences: with all neighbours present they
    cancel exactly, and small differences keep all their digits.
    """

    type: Literal["barycentre"] = "barycentre"

    linear: ClassVar[bool] = True

    @staticmethod
    def gather(d: Vector, r: Vector, w: Weights, p: Parameters) -> tuple[Vector, Vector, Number]:
        """(d, r, 1)."""
        return d, r, 1.0

    @staticmethod
    def apply(total: tuple[Vector, Vector, Number], here: Here, p: Parameters) -> Vector:
        """(Σd + Σr) / N."""
        return (total[0] + total[1]) / total[2]


class MeanDisplacement(FollowerRule):
    """u_j = (1/N) Σ u_k."""

    type: Literal["mean-displacement"] = "mean-displacement"

    linear: ClassVar[bool] = True

    @staticmethod
    def gather(d: Vector, r: Vector, w: Weights, p: Parameters) -> tuple[Vector, Number]:
        """(d, 1)."""
        return d, 1.0

    @staticmethod
    def apply(total: tuple[Vector, Number], here: Here, p: Parameters) -> Vector:
        """Σd / N."""
        return total[0] / total[1]


class DistanceWeighted(FollowerRule):
    """x_j = Σ |x_k - x_j| x_k / Σ |x_k - x_j|; where the sum is 0 the particle stays.

    As printed in the paper it is linearly unstable on every lattice: after some 50 steps rounding
    decides. A relaxation below 1 settles it (0.66 on the square lattice).
    """

    type: Literal["distance-weighted"] = "distance-weighted"

    @staticmethod
    def gather(d: Vector, r: Vector, w: Weights, p: Parameters) -> tuple[Vector, Number]:
        """(|r + d| (r + d), |r + d|)."""
        there = r + d
        distance = length(there)
        return distance * there, distance

    @staticmethod
    def apply(total: tuple[Vector, Number], here: Here, p: Parameters) -> Vector:
        """Σ |r + d| (r + d) / Σ |r + d|."""
        there, distance = total
        return there / where(distance > 0.0, distance, 1.0)


class MixedCoordinate(FollowerRule):
    """Barycentre along the loading axis; across it y_j = K (x_j - X_j) da + (1/N) Σ y_k.

    x_j is the target just computed and da = Y_j - (Y_min + Y_max)/2 over the body's reference
    configuration. K < 0 contracts under extension; it is no Poisson ratio: its effect grows with
    x and with the number of rows. `axis` is the loading axis.
    """

    type: Literal["mixed-coordinate"] = "mixed-coordinate"
    K: Annotated[float, PER_LENGTH] = Field(
        description="Contraction across the loading axis, per way and height (1 / lattice unit).",
        examples=[-0.004],
    )
    axis: Literal["x", "y"] = Field("x", description="The loading axis.", examples=["y"])

    linear: ClassVar[bool] = True
    uses_reference: ClassVar[bool] = True
    has_axes: ClassVar[bool] = True

    def parameters(self, setting: Setting) -> dict[str, float]:
        """K, and the loading axis as 0 or 1."""
        return {"K": self.K, "along": ("x", "y").index(self.axis)}

    @staticmethod
    def gather(d: Vector, r: Vector, w: Weights, p: Parameters) -> tuple[Vector, Vector, Number]:
        """(d, r, 1)."""
        return d, r, 1.0

    @staticmethod
    def apply(total: tuple[Vector, Vector, Number], here: Here, p: Parameters) -> Vector:
        """The barycentre's move, and K · (u + move along the axis) · da across it."""
        move = (total[0] + total[1]) / total[2]
        there = here.u + move
        if p.along == 0:
            return Vector(move.x, move.y + p.K * there.x * here.centred.y)
        return Vector(move.x + p.K * there.y * here.centred.x, move.y)


EDGE_OF_SQUARE, DIAGONAL_OF_SQUARE, OF_TRIANGLE = 0.75, 0.375, math.sqrt(0.75)
"""Stiffnesses of the springs over Young's modulus and thickness: isotropic with ν = 1/3."""


class Springs(TearsCells, Loadable, StoresEnergy, FollowerRule):
    """Each neighbour proposes the place at its rest distance, on the line to where the particle
    stands: x_k + l₀ (x_j - x_k)/|x_j - x_k|; the particle goes to the weighted mean.

    Weights are equal on the hexagonal lattice with 6 neighbours, 2 : 1 for edges and diagonals on
    the square one with 8, and half on free edges. For small strain it is elasticity in plane stress
    with ν = 1/3; rotations are exact, and the springs' energy never rises with relaxation 1.
    """

    type: Literal["springs"] = "springs"

    uses_cells: ClassVar[bool] = True

    stiffness: Factor = 1.0

    def elasticity(self) -> Stiffness:
        """Plane stress with ν = 1/3, for small strain, times `stiffness`."""
        return Stiffness(*(self.stiffness * ratio for ratio in (9 / 8, 9 / 8, 3 / 8, 3 / 8)))

    def weights(self, slot: Slot, setting: Setting) -> dict[str, float]:
        """Half the spring's stiffness, for each of the cells beside it, and its rest length."""
        cells, rest = setting.cells, math.hypot(*slot.rest)
        if cells.regular == 3:
            return {"half": self.stiffness * OF_TRIANGLE / 2, "rest": rest}
        if cells.regular == 4:
            k = DIAGONAL_OF_SQUARE if cells.is_diagonal(slot) else EDGE_OF_SQUARE
            return {"half": self.stiffness * k / 2, "rest": rest}
        raise ExperimentError(
            "'springs' works on the hexagonal lattice with 6 neighbours ({type: coordination, "
            "shells: 1}) and on the square lattice with 8 ({type: chebyshev, shells: 1})"
        )

    @staticmethod
    def gather(d: Vector, r: Vector, w: Weights, p: Parameters) -> tuple[Vector, Number]:
        """(k e n, k) with the elongation e = |r + d| - |r| along n = (r + d)/|r + d|."""
        stiffness = w.half * (w.left + w.right)
        return spring_pull(d, r, stiffness, w.rest), stiffness

    @staticmethod
    def torn(d: Vector, r: Vector, w: Weights, t: Torn, p: Parameters) -> tuple[Vector, Number]:
        """((1 - D) k e n, k): the stiffness k stays, so that moves are no larger for a given force,
        whatever is broken."""
        left, right = w.left * (1.0 - t.bond_left), w.right * (1.0 - t.bond_right)
        return spring_pull(d, r, w.half * (left + right), w.rest), w.half * (w.left + w.right)

    @staticmethod
    def apply(total: tuple[Vector, Number], here: Here, p: Parameters) -> Vector:
        """Σ k e n / Σ k; no move where there is no cell."""
        pull, stiffness = total
        return pull / where(stiffness > 0.0, stiffness, 1.0)

    @staticmethod
    def force(total: tuple[Vector, Number], here: Here, p: Parameters) -> Vector:
        """Σ k e n."""
        return total[0]

    @staticmethod
    def loaded(total: tuple[Vector, Number], load: Vector, p: Parameters) -> tuple[Vector, Number]:
        """The load besides Σ k e n."""
        return total[0] + load, total[1]

    @staticmethod
    def energy(d: Vector, r: Vector, w: Weights, p: Parameters) -> Number:
        """Half of ½ k e²."""
        v = r + d
        elongation = dot(d, r + v) / (length(v) + w.rest)
        return w.half * (w.left + w.right) * elongation * elongation / 4


def spring_pull(d: Vector, r: Vector, stiffness: Number, rest: Number) -> Vector:
    """k e n with the elongation e = |r + d| - |r| along n = (r + d)/|r + d|."""
    v = r + d
    distance = length(v)
    elongation = dot(d, r + v) / (distance + rest)
    return (stiffness * elongation / where(distance > 0.0, distance, 1.0)) * v
