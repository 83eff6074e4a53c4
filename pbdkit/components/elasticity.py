"""Rules of linear elasticity, calibrated to a material: bond coefficients derived from the
stiffness of the lattice's cells, rectangles and equilateral triangles.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from functools import cache
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pbdkit.errors import ExperimentError
from pbdkit.plugin import (
    AppliesTwice,
    FollowerRule,
    Here,
    Loadable,
    MixesCells,
    Number,
    Parameters,
    Setting,
    Slot,
    Stiffness,
    TearsCells,
    Torn,
    Vector,
    Weights,
    dot,
    where,
)
from pbdkit.plugin.lattice import Tiling
from pbdkit.plugin.units import LENGTH

Floats = NDArray[np.float64]

CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
"""Of a rectangular cell from its middle, counterclockwise, in units of half its sides."""


@cache
def rectangle_matrix(c: Stiffness, a: float, b: float) -> Floats:
    """The stiffness of a cell a × b over modulus and thickness, (corner, axis, corner, axis)."""
    # The gradient of the bilinear displacement in the middle: ∂N/∂x = ±1/(2a), ∂N/∂y = ±1/(2b).
    K = _of_mean_strain(c, CORNERS / (2 * np.array([a, b])), a * b)
    stiffness = c.shear * (a / b + b / a) / 4
    hourglass = CORNERS.prod(axis=1)  # the displacement that no mean strain knows
    K += stiffness * np.einsum("m,n,ab->manb", hourglass, hourglass, np.eye(2))
    K.flags.writeable = False
    return K


def _of_mean_strain(c: Stiffness, gradient: Floats, area: float) -> Floats:
    """∫ Bᵀ C B over a cell of constant strain, gradient (corner, axis) of its shape functions."""
    B = np.zeros((3, len(gradient), 2))
    B[0, :, 0] = B[2, :, 1] = gradient[:, 0]
    B[1, :, 1] = B[2, :, 0] = gradient[:, 1]
    C = np.array(
        [[c.xx, c.xy, c.x_shear], [c.xy, c.yy, c.y_shear], [c.x_shear, c.y_shear, c.shear]]
    )
    K: Floats = area * np.einsum("ima,ij,jnb->manb", B, C, B)
    return K


def bond_weights(slot: Slot, c: Stiffness, cells: Tiling) -> dict[str, float]:
    """xx, xy, yx, yy: of the cell to the left of a slot [[xx, xy], [yx, yy]], of that to the right
    the transpose; a cell on both sides counts half on each."""
    left, right = _on_both_sides(slot, c, cells)
    mean = (left + right.T) / 2
    return {"xx": mean[0, 0], "xy": mean[0, 1], "yx": mean[1, 0], "yy": mean[1, 1]}


def bond_springs(slot: Slot, c: Stiffness, cells: Tiling) -> float:
    """The spring along a slot in the cell on either side of it, over modulus and the squared length
    of the bond; a cell on both sides counts half on each.

    The springs of a cell are as stiff as they can be without exceeding the cell: what they leave of
    its stiffness is positive semidefinite. On squares of an isotropic material with 0 ≤ ν ≤ 1/3
    what they leave is shear alone, so that the edges beside a straight cut carry the stress along
    it as half a cell does.
    """
    x, y = slot.rest
    if cells.regular == 3:
        share = min(2 / 3 * (c.xx + c.xy), 8 / 3 * c.shear)
        return float(share * math.sqrt(0.75) / 2 / (x * x + y * y))
    assert cells.rectangle
    along, across, diagonal = rectangle_springs(c, *cells.rectangle)
    if cells.is_diagonal(slot):
        return float(diagonal / 2 / (x * x + y * y))
    return float(along / (x * x) if x else across / (y * y))


@cache
def rectangle_springs(c: Stiffness, a: float, b: float) -> tuple[float, float, float]:
    """Stiffnesses over modulus and thickness of the springs along an edge a, an edge b, and a
    diagonal of a cell a × b.

    The two diagonals have C_xy = C_shear = g, C_xx = g a²/b² and C_yy = g b²/a²; edges add to C_xx
    and C_yy alone. Hourglass motions stretch edges only.
    """
    square = (a / b) ** 2
    spare = (c.xx * c.yy - c.xy**2) / (c.xx / square + c.yy * square - 2 * c.xy)
    g = min(max(c.xy, 0.0), c.shear, spare / 2)
    xx, yy, xy = c.xx - g * square, c.yy - g / square, abs(c.xy - g)
    ratio = math.sqrt(xx / yy)
    hourglass = c.shear * (a / b + b / a) / 2
    along = min((xx - xy * ratio) * b / (2 * a), hourglass)
    across = min((yy - xy / ratio) * a / (2 * b), hourglass)
    return max(along, 0.0), max(across, 0.0), g * (a * a + b * b) / (2 * a * b)


def springs_in(stiffness: Floats, c: Stiffness, cells: Tiling) -> Floats:
    """(cell,): how many times the springs of material c cells of a stiffness over the modulus,
    (cell, 3, 3), have: the most that their stiffness exceeds, in uniform and hourglass motions."""
    if cells.regular == 3:
        share = min(2 / 3 * (c.xx + c.xy), 8 / 3 * c.shear)
        springs = share * np.array([[9, 3, 0], [3, 9, 0], [0, 0, 3]]) / 8
        caps = np.full(len(stiffness), np.inf)
    else:
        assert cells.rectangle
        a, b = cells.rectangle
        along, across, diagonal = rectangle_springs(c, a, b)
        g = 2 * diagonal * a * b / (a * a + b * b)
        xx, yy = 2 * along * a / b + g * (a / b) ** 2, 2 * across * b / a + g * (b / a) ** 2
        springs = np.array([[xx, g, 0.0], [g, yy, 0.0], [0.0, 0.0, g]])
        stiffest = max(along, across)
        hourglass = stiffness[:, 2, 2] * (a / b + b / a) / 2
        caps = hourglass / stiffest if stiffest else np.full(len(stiffness), np.inf)
    root = np.linalg.inv(np.linalg.cholesky(stiffness))
    largest = np.linalg.eigvalsh(root @ springs @ np.swapaxes(root, 1, 2))[:, -1]
    with np.errstate(divide="ignore"):
        found: Floats = np.minimum(np.where(largest > 0.0, 1.0 / largest, np.inf), caps)
    return np.where(np.isfinite(found), found, 0.0)


Sums = tuple[Vector, Number, Number, Number]
"""Σ W d, and the entries xx, xy, yy of Σ W."""


def torn_pull(d: Vector, r: Vector, w: Weights, t: Torn) -> Vector:
    """The pull of a bond in damaged cells: of K = (1 - m) K_whole + Σ_b (m - D_b) K_b, with the
    damage D_b of each bond b in the cell, the largest of them m, and the cell's springs K_b."""
    left, right = w.left * (1.0 - t.left), w.right * (1.0 - t.right)
    whole = left + right
    xy, yx = w.xy * left + w.yx * right, w.yx * left + w.xy * right
    spring = w.left * (t.left - t.bond_left) + w.right * (t.right - t.bond_right)
    along = w.spring * spring * dot(r, d)
    return Vector(
        w.xx * whole * d.x + xy * d.y + along * r.x, yx * d.x + w.yy * whole * d.y + along * r.y
    )


def pulled(d: Vector, w: Weights) -> Sums:
    """W d with the weight of a bond, and the entries xx, xy, yy of W."""
    whole = w.left + w.right
    xx, yy = w.xx * whole, w.yy * whole
    xy, yx = w.xy * w.left + w.yx * w.right, w.yx * w.left + w.xy * w.right
    return Vector(xx * d.x + xy * d.y, yx * d.x + yy * d.y), xx, xy, yy


def mean_move(total: Sums) -> Vector:
    """(Σ W)⁻¹ Σ W d from the sums; zero where there is no cell."""
    pull, xx, xy, yy = total
    det = xx * yy - xy * xy
    some = det > 0.0
    move = Vector(yy * pull.x - xy * pull.y, xx * pull.y - xy * pull.x) / where(some, det, 1.0)
    return Vector(where(some, move.x, 0.0), where(some, move.y, 0.0))


def _on_both_sides(slot: Slot, c: Stiffness, cells: Tiling) -> list[Floats]:
    """-K_jk in the cell to the left and in that to the right of a slot, half of it in each where
    both are one cell."""
    if not cells.rectangle:
        return [_in_triangle(slot, c, turn) for turn in (1, -1)]
    K, share = rectangle_matrix(c, *cells.rectangle), 2 if cells.is_diagonal(slot) else 1
    return [-K[side.start, :, side.end, :] / share for side in cells.beside[slot]]


def _in_triangle(slot: Slot, c: Stiffness, turn: int) -> Floats:
    (x, y), height = slot.rest, turn * math.sqrt(0.75)
    corners = np.array([[0.0, 0.0], [x, y], [0.5 * x - height * y, height * x + 0.5 * y]])
    gradient = np.linalg.inv(np.column_stack([np.ones(3), corners]))[1:].T
    area = math.sqrt(0.75) * (x * x + y * y) / 2
    block: Floats = -_of_mean_strain(c, gradient, area)[0, :, 1, :]
    return block


Factor = Annotated[
    float,
    Field(ge=1e-9, le=1e9, description="Stiffness over that of the material.", examples=[10.0]),
]


class CellElastic(MixesCells, TearsCells, Loadable, FollowerRule):
    """Common to the rules x_j = (Σ W_k)⁻¹ Σ W_k x_k whose 2 × 2 weights are the stiffness of the
    cells on both sides of each bond, -K_jk of the cells' matrices.

    A rectangle has the energy of its mean strain, and against hourglassing the shear stiffness
    G (a/b + b/a)/4; a triangle is the linear one of finite elements. Inside the body of a square
    lattice the isotropic weights are W_E = W_W = diag(3 - ν, 1 - 3ν)/(2(5 - 3ν)), W_N = W_S with
    the entries exchanged, and (1 + ν)/(4(5 - 3ν)) [[1, s], [s, 1]] on the diagonals (s = ±1).
    """

    linear: ClassVar[bool] = True
    uses_cells: ClassVar[bool] = True

    stiffness: Factor = 1.0

    @abstractmethod
    def material(self) -> tuple[float, Stiffness]:
        """A modulus over Young's, and the stiffness over that modulus: its ratios are finite for
        every material that the rule takes."""

    def elasticity(self) -> Stiffness | None:
        """Ratios times modulus and `stiffness`, where the modulus is finite."""
        modulus, ratios = self.material()
        modulus *= self.stiffness
        finite = math.isfinite(modulus)
        return Stiffness(*(modulus * ratio for ratio in ratios)) if finite else None

    def parameters(self, setting: Setting) -> dict[str, float]:
        """The modulus; ExperimentError where the lattice has no such cells."""
        modulus, ratios = self.material()
        if not (setting.cells.rectangle or setting.cells.regular == 3):
            raise ExperimentError(
                f"'{self.type}' works on the square and the rectangular lattice with 8 neighbours "
                "({type: chebyshev, shells: 1}) and, where it is isotropic, on the hexagonal "
                "lattice with 6 ({type: coordination, shells: 1})"
            )
        xx, yy, xy, shear = ratios[:4]
        isotropic = xx == yy and math.isclose(xx, xy + 2 * shear, rel_tol=1e-12)
        if setting.cells.regular == 3 and not isotropic:
            raise ExperimentError(
                f"'{self.type}' is not isotropic and goes with the square or rectangular lattice"
            )
        return {"modulus": self.stiffness * modulus}

    def weights(self, slot: Slot, setting: Setting) -> dict[str, float]:
        """xx, xy, yx, yy: the weight of the cell to the left is [[xx, xy], [yx, yy]], of that
        to the right the transpose; a cell on both sides counts half on each. `spring` is what
        remains along the bond where the cell is torn, over its squared length."""
        material, cells = self.material()[1], setting.cells
        springs = {"spring": bond_springs(slot, material, cells)}
        return bond_weights(slot, material, cells) | springs

    def cell_weights(self, slot: Slot, setting: Setting, c: Stiffness) -> dict[str, float]:
        """The same of cells of that stiffness."""
        modulus = self.stiffness * self.material()[0]
        whole = bond_weights(slot, Stiffness(*(value / modulus for value in c)), setting.cells)
        return whole | {"spring": 0.0}

    def spring_weights(self, slot: Slot, setting: Setting) -> dict[str, float]:
        """`spring` alone."""
        weights = self.weights(slot, setting)
        return dict.fromkeys(weights, 0.0) | {"spring": weights["spring"]}

    def spring_share(self, c: NDArray[np.float64], setting: Setting) -> NDArray[np.float64]:
        """The most that a stiffness exceeds."""
        modulus, material = self.material()
        return springs_in(c / (self.stiffness * modulus), material, setting.cells)

    @staticmethod
    def gather(d: Vector, r: Vector, w: Weights, p: Parameters) -> Sums:
        """W d, and entries of W, of which the sum is symmetric."""
        return pulled(d, w)

    @staticmethod
    def torn(d: Vector, r: Vector, w: Weights, t: Torn, p: Parameters) -> Sums:
        """The same with what torn cells pull in place of W d; the entries of W stay, so that moves
        are no larger for a given force, whatever is broken."""
        _, xx, xy, yy = pulled(d, w)
        return torn_pull(d, r, w, t), xx, xy, yy

    @staticmethod
    def apply(total: Sums, here: Here, p: Parameters) -> Vector:
        """(Σ W)⁻¹ Σ W d; no move where there is no cell."""
        return mean_move(total)

    @staticmethod
    def force(total: Sums, here: Here, p: Parameters) -> Vector:
        """Modulus · Σ W d."""
        return p.modulus * total[0]

    @staticmethod
    def loaded(total: Sums, load: Vector, p: Parameters) -> Sums:
        """The load over the modulus, besides Σ W d."""
        pull, xx, xy, yy = total
        return pull + load / p.modulus, xx, xy, yy


class IsotropicElastic(CellElastic):
    """Common to the isotropic rules: a Poisson ratio, in plane stress or plane strain."""

    poisson_ratio: Annotated[float, Field(ge=-1.0, le=0.5)] = Field(
        description="ν, from -1 to 0.5.", examples=[0.3, -1.0]
    )
    plane: Literal["stress", "strain"] = Field(
        "stress", description="Plane stress or plane strain.", examples=["strain"]
    )

    @model_validator(mode="after")
    def _compressible(self) -> Self:
        if self.plane == "strain" and self.poisson_ratio > 0.49:
            raise ValueError("in plane strain poisson_ratio must be at most 0.49")
        return self

    def material(self) -> tuple[float, Stiffness]:
        """1/(1 - ν²) in plane stress, in plane strain ν' = ν/(1 - ν) for ν and all over 1 - ν²;
        1, 1, ν', (1 - ν')/2."""
        nu, in_plane, out_of_plane = self.poisson_ratio, self.poisson_ratio, 1.0
        if self.plane == "strain":
            in_plane, out_of_plane = nu / (1 - nu), 1 - nu * nu
        ratios = Stiffness(1.0, 1.0, in_plane, (1 - in_plane) / 2)
        if nu == -1.0:
            return math.nan, ratios  # no positive stiffness belongs to it
        return 1 / (out_of_plane * (1 - in_plane * in_plane)), ratios

    def through_thickness(self) -> float:
        """ν in plane strain."""
        return self.poisson_ratio if self.plane == "strain" else 0.0


class Elastic(IsotropicElastic):
    """Isotropic linear elasticity with a Poisson ratio, in plane stress or plane strain.

    On the square and rectangular lattice with 8 neighbours, and on the hexagonal one with 6, where
    it is linear triangles. At ν = -1 it is the barycentre, of the four nearest or all six.
    Stable with a relaxation below (5 - 3ν)/4 (square, ν ≥ 0) or 3(3 - ν)/8 (hexagonal, ν ≥ -1/3).
    """

    type: Literal["elastic"] = "elastic"


class Orthotropic(CellElastic):
    """Orthotropic linear elasticity in plane stress along the axes of the square or rectangular
    lattice with 8 neighbours.

    `poisson_ratio` is ν_xy, the contraction along y under tension along x; `modulus_ratio` E_y/E_x;
    `shear_ratio` G_xy/E_x. Young's modulus, where forces ask for it, is E_x.
    """

    has_axes: ClassVar[bool] = True

    type: Literal["orthotropic"] = "orthotropic"
    poisson_ratio: Annotated[float, Field(gt=-10.0, lt=10.0)] = Field(
        description="ν_xy, the contraction along y under tension along x.", examples=[0.3]
    )
    modulus_ratio: Annotated[float, Field(gt=0.0, le=1e6)] = Field(
        description="E_y/E_x.", examples=[0.5]
    )
    shear_ratio: Annotated[float, Field(gt=0.0, le=1e6)] = Field(
        description="G_xy/E_x.", examples=[0.4]
    )

    @model_validator(mode="after")
    def _positive(self) -> Self:
        if self.poisson_ratio**2 * self.modulus_ratio >= 1.0:
            raise ValueError(
                "no elastic material: poisson_ratio² · modulus_ratio must be below 1, and is "
                f"{self.poisson_ratio**2 * self.modulus_ratio:g}"
            )
        return self

    def material(self) -> tuple[float, Stiffness]:
        """1/(1 - ν_xy ν_yx); 1, E_y/E_x, ν_xy E_y/E_x, and the shear ratio over the modulus."""
        modulus = 1 / (1 - self.poisson_ratio**2 * self.modulus_ratio)
        coupled = self.poisson_ratio * self.modulus_ratio
        return modulus, Stiffness(1.0, self.modulus_ratio, coupled, self.shear_ratio / modulus)


class StrainGradient(AppliesTwice, IsotropicElastic):
    """Elasticity with an internal length l: the elastic move z, less c = l²/D times the elastic
    move that is made of z.

    D is the diffusion of longitudinal waves in a move, 2h²/(5 - 3ν') on the square lattice and
    h²/(3 - ν') on the hexagonal one. Along an axis it is u'' - l² u'''' = 0; the length of shear
    waves is √((1 - ν')/2) l. Where leaders hold an edge they hold the slope too. For cells of equal
    sides, with the natural frame. Stable with a relaxation below 2/(λ + cλ²) where the elastic
    rule's bound is 2/λ: mostly very small, so that solver: {type: equilibrium} serves it best.
    """

    type: Literal["strain-gradient"] = "strain-gradient"
    length: Annotated[float, Field(ge=0.0, le=1e6), LENGTH] = Field(
        description="The internal length l (lattice units).", examples=[0.5]
    )

    def inner(self) -> Elastic:
        """The elastic rule."""
        return Elastic(poisson_ratio=self.poisson_ratio, plane=self.plane)

    def parameters(self, setting: Setting) -> dict[str, float]:
        """The modulus and c."""
        parameters = super().parameters(setting)
        sides = setting.cells.rectangle
        if sides and not math.isclose(*sides):
            raise ExperimentError(
                f"'{self.type}' works on cells of equal sides, and these are {sides[0]:g} by "
                f"{sides[1]:g}; take a square or a hexagonal lattice"
            )
        weights = [(slot.rest.x, self.weights(slot, setting)["xx"]) for slot in setting.slots[0]]
        diffusion = sum(w * x * x for x, w in weights) / sum(w for _, w in weights) / 2
        return parameters | {"c": self.length**2 / diffusion}

    @staticmethod
    def gather(d: Vector, r: Vector, w: Weights, p: Parameters) -> Sums:
        """c W d, and entries of W."""
        pull, xx, xy, yy = pulled(d, w)
        return p.c * pull, xx, xy, yy

    @staticmethod
    def torn(d: Vector, r: Vector, w: Weights, t: Torn, p: Parameters) -> Sums:
        """The same with what torn cells pull in place of W d."""
        _, xx, xy, yy = pulled(d, w)
        return p.c * torn_pull(d, r, w, t), xx, xy, yy

    @staticmethod
    def apply(total: Sums, here: Here, p: Parameters) -> Vector:
        """z - (Σ W)⁻¹ c Σ W (z_k - z_j)."""
        return here.u - mean_move(total)

    @staticmethod
    def force(total: Sums, here: Here, p: Parameters) -> Vector:
        """Modulus · (Σ W z_j - c Σ W (z_k - z_j))."""
        pull, xx, xy, yy = total
        x, y = here.u
        return p.modulus * (Vector(xx * x + xy * y, xy * x + yy * y) - pull)

    @staticmethod
    def loaded(total: Sums, load: Vector, p: Parameters) -> Sums:
        """Less the load over the modulus, besides c Σ W d: that counts against z."""
        pull, xx, xy, yy = total
        return pull - load / p.modulus, xx, xy, yy
