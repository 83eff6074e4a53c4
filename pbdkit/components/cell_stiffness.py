"""The stiffness of a lattice's cells, rectangles and equilateral triangles, bond by bond."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Slot, Stiffness, Vector, where
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
