"""Rules of linear elasticity, calibrated to a material.

The weights of bonds are computed from the stiffness of the cells of the lattice, which are
rectangles or equilateral triangles.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from functools import cache
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from pbdkit.array_types import Floats
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

CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
"""Corners of a rectangular cell relative to its centre, counterclockwise.

The unit along each axis is half of the side.
"""


@cache
def rectangle_matrix(c: Stiffness, a: float, b: float) -> Floats:
    """Assemble the stiffness matrix of a rectangular cell.

    Parameters
    ----------
    c
        Stiffness of the material divided by the modulus.
    a, b
        Side lengths of the cell.

    Returns
    -------
    NDArray
        Read-only array of shape (corner, axis, corner, axis): the stiffness divided by modulus and
        thickness.
    """
    # The gradient of the bilinear displacement in the middle: ∂N/∂x = ±1/(2a), ∂N/∂y = ±1/(2b).
    K = _of_mean_strain(c, CORNERS / (2 * np.array([a, b])), a * b)
    stiffness = c.shear * (a / b + b / a) / 4
    hourglass = CORNERS.prod(axis=1)  # The mode with zero mean strain.
    K += stiffness * np.einsum("m,n,ab->manb", hourglass, hourglass, np.eye(2))
    K.flags.writeable = False
    return K


def _of_mean_strain(c: Stiffness, gradient: Floats, area: float) -> Floats:
    """Integrate Bᵀ C B over a cell of constant strain.

    `gradient` holds the gradients of the shape functions, (corner, axis).
    """
    B = np.zeros((3, len(gradient), 2))
    B[0, :, 0] = B[2, :, 1] = gradient[:, 0]
    B[1, :, 1] = B[2, :, 0] = gradient[:, 1]
    C = np.array(
        [[c.xx, c.xy, c.x_shear], [c.xy, c.yy, c.y_shear], [c.x_shear, c.y_shear, c.shear]]
    )
    K: Floats = area * np.einsum("ima,ij,jnb->manb", B, C, B)
    return K


def bond_weights(slot: Slot, c: Stiffness, cells: Tiling) -> dict[str, float]:
    """Compute the weights of the cells on both sides of a bond.

    Parameters
    ----------
    slot
        The bond.
    c
        Stiffness of the material divided by the modulus.
    cells
        Cells of the lattice.

    Returns
    -------
    dict
        `xx`, `xy`, `yx`, `yy`: the weight of the left cell is [[xx, xy], [yx, yy]], that of the
        right cell its transpose. If the same cell lies on both sides, each side has half of it.
    """
    left, right = _on_both_sides(slot, c, cells)
    mean = (left + right.T) / 2
    return {"xx": mean[0, 0], "xy": mean[0, 1], "yx": mean[1, 0], "yy": mean[1, 1]}


def bond_springs(slot: Slot, c: Stiffness, cells: Tiling) -> float:
    """Compute the stiffness of the spring along a bond in the cell on either side of it.

    Parameters
    ----------
    slot
        The bond.
    c
        Stiffness of the material divided by the modulus.
    cells
        Cells of the lattice.

    Returns
    -------
    float
        Stiffness divided by the modulus and the squared length of the bond. If the same cell lies
        on both sides, each side has half of the stiffness.

    Notes
    -----
    The springs of a cell are as stiff as possible under one condition: the stiffness of the cell
    minus that of its springs must be positive semidefinite. On squares of an isotropic material
    with 0 ≤ ν ≤ 1/3 this remainder is a pure shear stiffness. An edge beside a straight cut then
    has the stiffness 1/(2(1 + ν)). That is 1/(1 + ν) of the stiffness of half a cell under stress
    along the cut: all of it at ν = 0, and 75 % at ν = 1/3.
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
    """Compute the stiffnesses of the springs of a rectangular cell.

    Parameters
    ----------
    c
        Stiffness of the material divided by the modulus.
    a, b
        Side lengths of the cell.

    Returns
    -------
    tuple
        Stiffnesses of the springs along an edge of length a, along an edge of length b, and along a
        diagonal, divided by modulus and thickness.

    Notes
    -----
    The two diagonals contribute C_xy = C_shear = g, C_xx = g a²/b² and C_yy = g b²/a²; edges
    contribute to C_xx and C_yy only. Hourglass modes stretch only the edges.
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
    """Compute the largest factor for the stiffness of the springs of a material in other cells.

    With a larger factor the springs would be stiffer than the cell, for a uniform strain or for an
    hourglass mode.

    Parameters
    ----------
    stiffness
        Stiffness of cells divided by the modulus, (cell, 3, 3).
    c
        Stiffness of the material of the springs, divided by the modulus.
    cells
        Cells of the lattice.

    Returns
    -------
    NDArray
        Factors, (cell,).
    """
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
        multiples: Floats = np.minimum(np.where(largest > 0.0, 1.0 / largest, np.inf), caps)
    return np.where(np.isfinite(multiples), multiples, 0.0)


Sums = tuple[Vector, Number, Number, Number]
"""Type of sums: Σ W d, and the entries xx, xy, yy of Σ W."""


def torn_pull(d: Vector, r: Vector, w: Weights, t: Torn) -> Vector:
    """Return the force of a bond in damaged cells.

    The stiffness of a cell is K = (1 - m) K_whole + Σ_b (m - D_b) K_b with the damage D_b of each
    of its bonds b, the maximum m of the D_b, and the stiffness K_b of the spring along b.
    """
    left, right = w.left * (1.0 - t.left), w.right * (1.0 - t.right)
    whole = left + right
    xy, yx = w.xy * left + w.yx * right, w.yx * left + w.xy * right
    spring = w.left * (t.left - t.bond_left) + w.right * (t.right - t.bond_right)
    along = w.spring * spring * dot(r, d)
    return Vector(
        w.xx * whole * d.x + xy * d.y + along * r.x, yx * d.x + w.yy * whole * d.y + along * r.y
    )


def pulled(d: Vector, w: Weights) -> Sums:
    """Return W d with the weight W of a bond, and the entries xx, xy, yy of W."""
    whole = w.left + w.right
    xx, yy = w.xx * whole, w.yy * whole
    xy, yx = w.xy * w.left + w.yx * w.right, w.yx * w.left + w.xy * w.right
    return Vector(xx * d.x + xy * d.y, yx * d.x + yy * d.y), xx, xy, yy


def mean_move(total: Sums) -> Vector:
    """Return (Σ W)⁻¹ Σ W d from the sums, or zero if there is no cell."""
    pull, xx, xy, yy = total
    det = xx * yy - xy * xy
    is_regular = det > 0.0
    move = Vector(yy * pull.x - xy * pull.y, xx * pull.y - xy * pull.x) / where(
        is_regular, det, 1.0
    )
    return Vector(where(is_regular, move.x, 0.0), where(is_regular, move.y, 0.0))


def _on_both_sides(slot: Slot, c: Stiffness, cells: Tiling) -> list[Floats]:
    """Return -K_jk of the cell to the left and of the cell to the right of a slot. If both sides
    belong to one cell, each entry is half of its -K_jk.
    """
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
    Field(ge=1e-9, le=1e9, description="Factor of the stiffness.", examples=[10.0]),
]
"""Type of a factor on the stiffness of the material."""


class CellElastic(MixesCells, TearsCells, Loadable, FollowerRule):
    """Base class of the rules x_j = (Σ W_k)⁻¹ Σ W_k x_k with weights from the stiffness of cells.

    The weight W_k of a bond is a 2 × 2 matrix: the sum of the blocks -K_jk in the stiffness
    matrices of the two cells beside the bond. A rectangle has the energy of its mean strain and the
    hourglass stiffness G (a/b + b/a)/4. A triangle is the linear finite element. In the interior of
    a body on a square lattice an isotropic rule has the following weights, with s = ±1:

    - W_E = W_W = diag(3 - ν, 1 - 3ν)/(2(5 - 3ν)) along x;
    - the same with exchanged entries along y, W_N = W_S;
    - (1 + ν)/(4(5 - 3ν)) [[1, s], [s, 1]] along the diagonals.
    """

    linear: ClassVar[bool] = True
    uses_cells: ClassVar[bool] = True

    stiffness: Factor = 1.0

    @abstractmethod
    def material(self) -> tuple[float, Stiffness]:
        """Return a reference modulus divided by Young's modulus, and the stiffness divided by the
        reference modulus.

        The reference modulus is chosen so that the ratios in the stiffness are finite for every
        admissible material.
        """

    def elasticity(self) -> Stiffness | None:
        """Return the stiffness divided by Young's modulus, or None if the modulus is not finite."""
        modulus, ratios = self.material()
        modulus *= self.stiffness
        finite = math.isfinite(modulus)
        return Stiffness(*(modulus * ratio for ratio in ratios)) if finite else None

    def parameters(self, setting: Setting) -> dict[str, float]:
        """Return the modulus.

        Raises
        ------
        ExperimentError
            If the rule does not support the cells of the lattice.
        """
        modulus, ratios = self.material()
        if not (setting.cells.rectangle or setting.cells.regular == 3):
            raise ExperimentError(
                f"'{self.type}' requires the square or the rectangular lattice with 8 neighbours "
                "({type: chebyshev, shells: 1}) or, if it is isotropic, the hexagonal lattice with "
                "6 ({type: coordination, shells: 1})"
            )
        xx, yy, xy, shear = ratios[:4]
        isotropic = xx == yy and math.isclose(xx, xy + 2 * shear, rel_tol=1e-12)
        if setting.cells.regular == 3 and not isotropic:
            raise ExperimentError(
                f"'{self.type}' is not isotropic and requires the square or rectangular lattice"
            )
        return {"modulus": self.stiffness * modulus}

    def weights(self, slot: Slot, setting: Setting) -> dict[str, float]:
        """Return the weights xx, xy, yx, yy of the cells beside a bond, and `spring`.

        The weight of the left cell is [[xx, xy], [yx, yy]], that of the right cell is its
        transpose. If the same cell lies on both sides, each side has half of its weight. `spring`
        is the stiffness that remains along the bond in a torn cell, divided by the squared length
        of the bond.
        """
        material, cells = self.material()[1], setting.cells
        springs = {"spring": bond_springs(slot, material, cells)}
        return bond_weights(slot, material, cells) | springs

    def cell_weights(self, slot: Slot, setting: Setting, c: Stiffness) -> dict[str, float]:
        """Return the weights for cells of the stiffness `c`, without springs."""
        modulus = self.stiffness * self.material()[0]
        whole = bond_weights(slot, Stiffness(*(value / modulus for value in c)), setting.cells)
        return whole | {"spring": 0.0}

    def spring_weights(self, slot: Slot, setting: Setting) -> dict[str, float]:
        """Return the weights in which all entries except `spring` are 0."""
        weights = self.weights(slot, setting)
        return dict.fromkeys(weights, 0.0) | {"spring": weights["spring"]}

    def spring_share(self, c: Floats, setting: Setting) -> Floats:
        """Return the largest factor for the stiffness of all springs of each cell.

        With larger factors the springs would be stiffer than the material of the cell.
        """
        modulus, material = self.material()
        return springs_in(c / (self.stiffness * modulus), material, setting.cells)

    @staticmethod
    def gather(d: Vector, r: Vector, w: Weights, p: Parameters) -> Sums:
        """Return W d and the entries xx, xy, yy of W.

        The entry yx is not needed, because the sum of W over all slots is symmetric.
        """
        return pulled(d, w)

    @staticmethod
    def torn(d: Vector, r: Vector, w: Weights, t: Torn, p: Parameters) -> Sums:
        """Return the force in torn cells, which replaces W d, and the entries of W.

        The entries of W are not reduced by damage, so that the move that a given force causes does
        not increase with damage.
        """
        _, xx, xy, yy = pulled(d, w)
        return torn_pull(d, r, w, t), xx, xy, yy

    @staticmethod
    def apply(total: Sums, here: Here, p: Parameters) -> Vector:
        """Return (Σ W)⁻¹ Σ W d, or zero at a particle without cells."""
        return mean_move(total)

    @staticmethod
    def force(total: Sums, here: Here, p: Parameters) -> Vector:
        """Return the modulus times Σ W d."""
        return p.modulus * total[0]

    @staticmethod
    def loaded(total: Sums, load: Vector, p: Parameters) -> Sums:
        """Add the load, divided by the modulus, to Σ W d."""
        pull, xx, xy, yy = total
        return pull + load / p.modulus, xx, xy, yy


class IsotropicElastic(CellElastic):
    """Base class of the isotropic rules, with Poisson's ratio as parameter.

    They represent plane stress or plane strain.
    """

    poisson_ratio: Annotated[float, Field(ge=-1.0, le=0.5)] = Field(
        description="Poisson's ratio ν, from -1 to 0.5.", examples=[0.3, -1.0]
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
        """Return a modulus divided by Young's modulus, and the ratios 1, 1, ν', (1 - ν')/2.

        The ratios are xx, yy, xy and shear of the stiffness, divided by the modulus. In plane
        stress, ν' = ν and the modulus is 1/(1 - ν²). In plane strain, ν' = ν/(1 - ν) and the
        modulus is 1/((1 - ν²)(1 - ν'²)).
        """
        nu, in_plane, out_of_plane = self.poisson_ratio, self.poisson_ratio, 1.0
        if self.plane == "strain":
            in_plane, out_of_plane = nu / (1 - nu), 1 - nu * nu
        ratios = Stiffness(1.0, 1.0, in_plane, (1 - in_plane) / 2)
        if nu == -1.0:
            return math.nan, ratios  # The stiffness is singular.
        return 1 / (out_of_plane * (1 - in_plane * in_plane)), ratios

    def through_thickness(self) -> float:
        """Return ν in plane strain, 0 in plane stress."""
        return self.poisson_ratio if self.plane == "strain" else 0.0


class Elastic(IsotropicElastic):
    """Isotropic linear elasticity, in plane stress or plane strain.

    The rule requires the square or rectangular lattice with 8 neighbours, or the hexagonal lattice
    with 6 neighbours. On the hexagonal lattice the cells are linear triangles. For ν = -1, it is
    the barycentre rule, on the square lattice with the four nearest neighbours and on the hexagonal
    lattice with all six. The rule is stable for a relaxation below (5 - 3ν)/4 (square, ν ≥ 0) or
    3(3 - ν)/8 (hexagonal, ν ≥ -1/3).
    """

    type: Literal["elastic"] = "elastic"


class Orthotropic(CellElastic):
    """Orthotropic linear elasticity in plane stress along the axes of the lattice.

    Requires the square or rectangular lattice with 8 neighbours. `poisson_ratio` is ν_xy, the
    contraction along y under tension along x; `modulus_ratio` is E_y/E_x and `shear_ratio`
    G_xy/E_x. Young's modulus in forces and stresses is E_x.
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
                "the stiffness is not positive definite: poisson_ratio² · modulus_ratio must be "
                f"below 1, got {self.poisson_ratio**2 * self.modulus_ratio:g}"
            )
        return self

    def material(self) -> tuple[float, Stiffness]:
        """Return the modulus 1/(1 - ν_xy ν_yx), and four ratios.

        The ratios are 1, E_y/E_x, ν_xy E_y/E_x, and G_xy divided by the modulus.
        """
        modulus = 1 / (1 - self.poisson_ratio**2 * self.modulus_ratio)
        coupled = self.poisson_ratio * self.modulus_ratio
        return modulus, Stiffness(1.0, self.modulus_ratio, coupled, self.shear_ratio / modulus)


class StrainGradient(AppliesTwice, IsotropicElastic):
    """Strain-gradient elasticity with an internal length l.

    The move is z - c z', where z is the move of the elastic rule, z' is the move that this rule
    computes from z in place of the displacements, and c = l²/D. D is the diffusion coefficient of
    longitudinal waves, 2h²/(5 - 3ν') on the square lattice and h²/(3 - ν') on the hexagonal
    lattice. Along an axis the equilibrium satisfies u'' - l² u'''' = 0. The internal length for
    shear waves is √((1 - ν')/2) l. Leaders on an edge prescribe its displacement and its slope. The
    rule requires cells of equal sides and the natural frame. It is stable for a relaxation below
    2/(λ + cλ²), where 2/λ is the bound of the elastic rule. In most cases this bound is very small,
    and solver: {type: equilibrium} is more efficient.
    """

    type: Literal["strain-gradient"] = "strain-gradient"
    length: Annotated[float, Field(ge=0.0, le=1e6), LENGTH] = Field(
        description="The internal length l (lattice units).", examples=[0.5]
    )

    def inner(self) -> Elastic:
        """Return the elastic rule."""
        return Elastic(poisson_ratio=self.poisson_ratio, plane=self.plane)

    def parameters(self, setting: Setting) -> dict[str, float]:
        """Return the modulus and c.

        Raises
        ------
        ExperimentError
            If the sides of the cells differ, or the rule does not support the cells of the lattice.
        """
        parameters = super().parameters(setting)
        sides = setting.cells.rectangle
        if sides and not math.isclose(*sides):
            raise ExperimentError(
                f"'{self.type}' requires cells of equal sides, but these are {sides[0]:g} by "
                f"{sides[1]:g}; use a square or a hexagonal lattice"
            )
        weights = [(slot.rest.x, self.weights(slot, setting)["xx"]) for slot in setting.slots[0]]
        diffusion = sum(w * x * x for x, w in weights) / sum(w for _, w in weights) / 2
        return parameters | {"c": self.length**2 / diffusion}

    @staticmethod
    def gather(d: Vector, r: Vector, w: Weights, p: Parameters) -> Sums:
        """Return c W d, and the entries xx, xy, yy of W."""
        pull, xx, xy, yy = pulled(d, w)
        return p.c * pull, xx, xy, yy

    @staticmethod
    def torn(d: Vector, r: Vector, w: Weights, t: Torn, p: Parameters) -> Sums:
        """Return c times the force in torn cells, and the entries xx, xy, yy of W."""
        _, xx, xy, yy = pulled(d, w)
        return p.c * torn_pull(d, r, w, t), xx, xy, yy

    @staticmethod
    def apply(total: Sums, here: Here, p: Parameters) -> Vector:
        """Return z - (Σ W)⁻¹ c Σ W (z_k - z_j)."""
        return here.u - mean_move(total)

    @staticmethod
    def force(total: Sums, here: Here, p: Parameters) -> Vector:
        """Return the modulus times (Σ W z_j - c Σ W (z_k - z_j))."""
        pull, xx, xy, yy = total
        x, y = here.u
        return p.modulus * (Vector(xx * x + xy * y, xy * x + yy * y) - pull)

    @staticmethod
    def loaded(total: Sums, load: Vector, p: Parameters) -> Sums:
        """Subtract the load, divided by the modulus, from c Σ W d.

        The sign is negative because c Σ W d is subtracted in the move.
        """
        pull, xx, xy, yy = total
        return pull - load / p.modulus, xx, xy, yy
