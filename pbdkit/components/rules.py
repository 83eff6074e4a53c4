"""The paper's follower rules (its section 3; model.md, section 5)."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field

from pbdkit.interfaces import FollowerRule, Here, Setting, Vector, length, where


class Barycentre(FollowerRule):
    """x_j = (1/N) Σ x_k.

    The rest offsets are summed apart from the differences: with all neighbours present they
    cancel exactly, and small differences keep all their digits.
    """

    type: Literal["barycentre"] = "barycentre"

    linear: ClassVar[bool] = True

    @staticmethod
    def gather(d: Any, r: Any, w: Any, p: Any) -> tuple[Any, ...]:
        """(d, r, 1)."""
        return d, r, 1.0

    @staticmethod
    def apply(total: Any, here: Here, p: Any) -> Any:
        """(Σd + Σr) / N."""
        return (total[0] + total[1]) / total[2]


class MeanDisplacement(FollowerRule):
    """u_j = (1/N) Σ u_k."""

    type: Literal["mean-displacement"] = "mean-displacement"

    linear: ClassVar[bool] = True

    @staticmethod
    def gather(d: Any, r: Any, w: Any, p: Any) -> tuple[Any, ...]:
        """(d, 1)."""
        return d, 1.0

    @staticmethod
    def apply(total: Any, here: Here, p: Any) -> Any:
        """Σd / N."""
        return total[0] / total[1]


class DistanceWeighted(FollowerRule):
    """x_j = Σ |x_k - x_j| x_k / Σ |x_k - x_j|; where the sum is 0 the particle stays.

    As printed in the paper it is linearly unstable on every lattice: after some 50 steps rounding
    decides. A relaxation below 1 settles it (0.66 on the square lattice).
    """

    type: Literal["distance-weighted"] = "distance-weighted"

    @staticmethod
    def gather(d: Any, r: Any, w: Any, p: Any) -> tuple[Any, ...]:
        """(|r + d| (r + d), |r + d|)."""
        there = r + d
        distance = length(there)
        return distance * there, distance

    @staticmethod
    def apply(total: Any, here: Here, p: Any) -> Any:
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
    K: float = Field(
        description="Contraction across the loading axis, per way and height (1 / lattice unit).",
        examples=[-0.004],
    )
    axis: Literal["x", "y"] = Field("x", description="The loading axis.", examples=["y"])

    linear: ClassVar[bool] = True
    uses_reference: ClassVar[bool] = True

    def parameters(self, setting: Setting) -> dict[str, float]:
        """K, and the loading axis as 0 or 1."""
        return {"K": self.K, "along": ("x", "y").index(self.axis)}

    @staticmethod
    def gather(d: Any, r: Any, w: Any, p: Any) -> tuple[Any, ...]:
        """(d, r, 1)."""
        return d, r, 1.0

    @staticmethod
    def apply(total: Any, here: Here, p: Any) -> Vector:
        """The barycentre's move, and K · (u + move along the axis) · da across it."""
        move = (total[0] + total[1]) / total[2]
        there = here.u + move
        if p.along == 0:
            return Vector(move.x, move.y + p.K * there.x * here.centred.y)
        return Vector(move.x + p.K * there.y * here.centred.x, move.y)
