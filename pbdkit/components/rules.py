"""Follower rules of the paper (its section 3), and a network of springs."""

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
    """Each follower moves to the barycentre of its neighbours, x_j = (1/N) Σ x_k.

    The rest offsets are summed separately from the differences of displacements. If no neighbour is
    missing, the rest offsets cancel exactly, so that small differences of displacements are not
    rounded.
    """

    type: Literal["barycentre"] = "barycentre"

    linear: ClassVar[bool] = True

    @staticmethod
    def gather(d: Vector, r: Vector, w: Weights, p: Parameters) -> tuple[Vector, Vector, Number]:
        """Return (d, r, 1)."""
        return d, r, 1.0

    @staticmethod
    def apply(total: tuple[Vector, Vector, Number], here: Here, p: Parameters) -> Vector:
        """Return (Σd + Σr) / N."""
        return (total[0] + total[1]) / total[2]


class MeanDisplacement(FollowerRule):
    """Each follower moves by the mean displacement of its neighbours, u_j = (1/N) Σ u_k."""

    type: Literal["mean-displacement"] = "mean-displacement"

    linear: ClassVar[bool] = True

    @staticmethod
    def gather(d: Vector, r: Vector, w: Weights, p: Parameters) -> tuple[Vector, Number]:
        """Return the contributions (d, 1)."""
        return d, 1.0

    @staticmethod
    def apply(total: tuple[Vector, Number], here: Here, p: Parameters) -> Vector:
        """Return Σd / N."""
        return total[0] / total[1]


class DistanceWeighted(FollowerRule):
    """Each follower moves to the mean of its neighbours weighted by distance.

    The target is x_j = Σ |x_k - x_j| x_k / Σ |x_k - x_j|. A particle for which the sum of distances
    is 0 does not move. As printed in the paper, the rule is linearly unstable on every lattice:
    after about 50 steps rounding errors dominate. With a relaxation below 1, it is stable (0.66 on
    the square lattice).
    """

    type: Literal["distance-weighted"] = "distance-weighted"

    @staticmethod
    def gather(d: Vector, r: Vector, w: Weights, p: Parameters) -> tuple[Vector, Number]:
        """Return (|r + d| (r + d), |r + d|)."""
        offset = r + d
        distance = length(offset)
        return distance * offset, distance

    @staticmethod
    def apply(total: tuple[Vector, Number], here: Here, p: Parameters) -> Vector:
        """Return Σ |r + d| (r + d) / Σ |r + d|."""
        weighted, distance = total
        return weighted / where(distance > 0.0, distance, 1.0)


class MixedCoordinate(FollowerRule):
    """Barycentre along the loading axis; y_j = K (x_j - X_j) da + (1/N) Σ y_k across it.

    Here x is the coordinate along the loading axis, and x_j its new value. da = Y_j - (Y_min +
    Y_max)/2 is the distance from the middle of the body in its reference configuration. K < 0
    contracts the body under extension. K is not a Poisson ratio: its effect increases with x and
    with the number of rows.
    """

    type: Literal["mixed-coordinate"] = "mixed-coordinate"
    K: Annotated[float, PER_LENGTH] = Field(
        description="Lateral contraction per displacement and height (1 / lattice unit).",
        examples=[-0.004],
    )
    axis: Literal["x", "y"] = Field("x", description="The loading axis.", examples=["y"])

    linear: ClassVar[bool] = True
    uses_reference: ClassVar[bool] = True
    has_axes: ClassVar[bool] = True

    def parameters(self, setting: Setting) -> dict[str, float]:
        """Return K, and the loading axis as 0 or 1."""
        return {"K": self.K, "along": ("x", "y").index(self.axis)}

    @staticmethod
    def gather(d: Vector, r: Vector, w: Weights, p: Parameters) -> tuple[Vector, Vector, Number]:
        """Return (d, r, 1)."""
        return d, r, 1.0

    @staticmethod
    def apply(total: tuple[Vector, Vector, Number], here: Here, p: Parameters) -> Vector:
        """Return the move of the barycentre rule, plus K (u_x + move_x) da across the loading axis
        x.
        """
        move = (total[0] + total[1]) / total[2]
        displacement = here.u + move
        if p.along == 0:
            return Vector(move.x, move.y + p.K * displacement.x * here.centred.y)
        return Vector(move.x + p.K * displacement.y * here.centred.x, move.y)


SQUARE_EDGE_STIFFNESS = 0.75
"""Stiffness of a spring along an edge of a square cell, divided by E and thickness."""
SQUARE_DIAGONAL_STIFFNESS = 0.375
"""Stiffness of a spring along a diagonal of a square cell, divided by E and thickness."""
TRIANGLE_STIFFNESS = math.sqrt(0.75)
"""Stiffness of a spring along an edge of a triangle, divided by E and thickness."""


class Springs(TearsCells, Loadable, StoresEnergy, FollowerRule):
    """Network of springs.

    At the position x_k + l₀ (x_j - x_k)/|x_j - x_k| of a follower the spring to neighbour k, of
    rest length l₀, has no force. The follower moves to the weighted mean of these positions over
    its neighbours. The weights are equal on the hexagonal lattice with 6 neighbours. On the square
    lattice with 8 neighbours, edges have twice the weight of diagonals. Weights of bonds on free
    edges are half as large. For small strain, the network is linear elastic in plane stress with ν
    = 1/3. Rotations are exact, and the energy of the springs does not increase with relaxation 1.
    """

    type: Literal["springs"] = "springs"

    uses_cells: ClassVar[bool] = True

    stiffness: Factor = 1.0

    def elasticity(self) -> Stiffness:
        """Return the stiffness for small strain: plane stress with ν = 1/3, times `stiffness`."""
        return Stiffness(*(self.stiffness * ratio for ratio in (9 / 8, 9 / 8, 3 / 8, 3 / 8)))

    def weights(self, slot: Slot, setting: Setting) -> dict[str, float]:
        """Return the rest length of the spring, and half of its stiffness.

        Each of the two cells beside the bond contributes one half.
        """
        cells, rest = setting.cells, math.hypot(*slot.rest)
        if cells.regular == 3:
            return {"half": self.stiffness * TRIANGLE_STIFFNESS / 2, "rest": rest}
        if cells.regular == 4:
            is_diagonal = cells.is_diagonal(slot)
            k = SQUARE_DIAGONAL_STIFFNESS if is_diagonal else SQUARE_EDGE_STIFFNESS
            return {"half": self.stiffness * k / 2, "rest": rest}
        raise ExperimentError(
            "'springs' requires the hexagonal lattice with 6 neighbours ({type: coordination, "
            "shells: 1}) or the square lattice with 8 ({type: chebyshev, shells: 1})"
        )

    @staticmethod
    def gather(d: Vector, r: Vector, w: Weights, p: Parameters) -> tuple[Vector, Number]:
        """Return (k e n, k) with the elongation e = |r + d| - |r| along n = (r + d)/|r + d|."""
        stiffness = w.half * (w.left + w.right)
        return spring_pull(d, r, stiffness, w.rest), stiffness

    @staticmethod
    def torn(d: Vector, r: Vector, w: Weights, t: Torn, p: Parameters) -> tuple[Vector, Number]:
        """Return ((1 - D) k e n, k).

        The stiffness k is not reduced by damage, so that the move that a given force causes does
        not increase with damage.
        """
        left, right = w.left * (1.0 - t.bond_left), w.right * (1.0 - t.bond_right)
        return spring_pull(d, r, w.half * (left + right), w.rest), w.half * (w.left + w.right)

    @staticmethod
    def apply(total: tuple[Vector, Number], here: Here, p: Parameters) -> Vector:
        """Return Σ k e n / Σ k, or zero at a particle without cells."""
        pull, stiffness = total
        return pull / where(stiffness > 0.0, stiffness, 1.0)

    @staticmethod
    def force(total: tuple[Vector, Number], here: Here, p: Parameters) -> Vector:
        """Return Σ k e n."""
        return total[0]

    @staticmethod
    def loaded(total: tuple[Vector, Number], load: Vector, p: Parameters) -> tuple[Vector, Number]:
        """Add the load to Σ k e n."""
        return total[0] + load, total[1]

    @staticmethod
    def energy(d: Vector, r: Vector, w: Weights, p: Parameters) -> Number:
        """Return half of the energy ½ k e² of the spring; the other half belongs to the other
        end."""
        v = r + d
        elongation = dot(d, r + v) / (length(v) + w.rest)
        return w.half * (w.left + w.right) * elongation * elongation / 4


def spring_pull(d: Vector, r: Vector, stiffness: Number, rest: Number) -> Vector:
    """Return k e n with the elongation e = |r + d| - |r| along n = (r + d)/|r + d|."""
    v = r + d
    distance = length(v)
    elongation = dot(d, r + v) / (distance + rest)
    return (stiffness * elongation / where(distance > 0.0, distance, 1.0)) * v
