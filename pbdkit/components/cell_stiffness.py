"""The stiffness of a lattice's cells, rectangles and equilateral triangles, bond by bond."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Slot, Stiffness, Vector, dot, where
from pbdkit.interfaces.polygons import Tiling

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


def torn_pull(d: Any, r: Any, w: Any, t: Any) -> Any:
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


def pulled(d: Any, w: Any) -> tuple[Any, ...]:
    """W d with the weight of a bond, and the entries xx, xy, yy of W."""
    whole = w.left + w.right
    xx, yy = w.xx * whole, w.yy * whole
    xy, yx = w.xy * w.left + w.yx * w.right, w.yx * w.left + w.xy * w.right
    return Vector(xx * d.x + xy * d.y, yx * d.x + yy * d.y), xx, xy, yy


def mean_move(total: Any) -> Vector:
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
