"""The stiffness of a lattice's cells, rectangles and equilateral triangles, bond by bond."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Setting, Slot, Stiffness

Floats = NDArray[np.float64]

CORNERS = ((0, 0), (1, 0), (1, 1), (0, 1))
"""Of a rectangular cell, counterclockwise, in units of its sides."""
HOURGLASS = np.array([1.0, -1.0, 1.0, -1.0])
"""The displacement of the corners that no mean strain knows."""


@cache
def rectangle_matrix(c: Stiffness, a: float, b: float) -> Floats:
    """The stiffness of a cell a × b over modulus and thickness, (corner, axis, corner, axis)."""
    # The gradient of the bilinear displacement in the middle: ∂N/∂x = ±1/(2a), ∂N/∂y = ±1/(2b).
    signs = 2 * np.array(CORNERS) - 1.0
    K = _of_mean_strain(c, signs / (2 * np.array([a, b])), a * b)
    stiffness = c.shear * (a / b + b / a) / 4
    K += stiffness * np.einsum("m,n,ab->manb", HOURGLASS, HOURGLASS, np.eye(2))
    K.flags.writeable = False
    return K


def _of_mean_strain(c: Stiffness, gradient: Floats, area: float) -> Floats:
    """∫ Bᵀ C B over a cell of constant strain, gradient (corner, axis) of its shape functions."""
    B = np.zeros((3, len(gradient), 2))
    B[0, :, 0] = B[2, :, 1] = gradient[:, 0]
    B[1, :, 1] = B[2, :, 0] = gradient[:, 1]
    C = np.array([[c.xx, c.xy, 0.0], [c.xy, c.yy, 0.0], [0.0, 0.0, c.shear]])
    K: Floats = area * np.einsum("ima,ij,jnb->manb", B, C, B)
    return K


def in_rectangles(slot: Slot, c: Stiffness, a: float, b: float) -> tuple[Floats, Floats]:
    """-K_jk in the cell a × b to the left and in that to the right of a slot, half of it in each
    where both are one cell."""
    K = rectangle_matrix(c, a, b)
    x, y = int(np.sign(slot.rest.x)), int(np.sign(slot.rest.y))
    ends = {corner: n for n, corner in enumerate(CORNERS)}
    if x and y:
        block: Floats = -K[ends[int(x < 0), int(y < 0)], :, ends[int(x > 0), int(y > 0)], :] / 2
        return block, block
    found = []
    for towards in ((-y, x), (y, -x)):  # where the cell to the left and that to the right lie
        start = int(x + towards[0] < 0), int(y + towards[1] < 0)
        found.append(-K[ends[start], :, ends[start[0] + x, start[1] + y], :])
    return found[0], found[1]


def in_triangles(slot: Slot, c: Stiffness) -> tuple[Floats, Floats]:
    """-K_jk in the equilateral triangle to the left and in that to the right of a slot."""
    return _in_triangle(slot, c, 1), _in_triangle(slot, c, -1)


def _in_triangle(slot: Slot, c: Stiffness, turn: int) -> Floats:
    x, y = slot.rest
    half, height = 0.5, turn * math.sqrt(0.75)
    corners = np.array([[0.0, 0.0], [x, y], [half * x - height * y, height * x + half * y]])
    gradient = np.linalg.inv(np.column_stack([np.ones(3), corners]))[1:].T
    area = math.sqrt(0.75) * (x * x + y * y) / 2
    block: Floats = -_of_mean_strain(c, gradient, area)[0, :, 1, :]
    return block


def rectangle_of(setting: Setting) -> tuple[float, float] | None:
    """The sides of the cells, where every site has the 8 neighbours of a rectangular lattice."""
    a, b = setting.cell.vectors
    if len(setting.cell.sites) > 1 or a.y != 0.0 or b.x != 0.0:
        return None
    around = {slot.cell for slot in setting.slots[0]}
    ring = {(m, n) for m in (-1, 0, 1) for n in (-1, 0, 1)} - {(0, 0)}
    return (abs(a.x), abs(b.y)) if around == ring and len(setting.slots[0]) == 8 else None


def is_triangular(setting: Setting) -> bool:
    """Whether every site has six neighbours at 60 degrees."""
    for slots in setting.slots:
        rests = [complex(*slot.rest) for slot in slots]
        turned = [rest * complex(0.5, math.sqrt(0.75)) for rest in rests]
        near = [min(abs(t - rest) for rest in rests) for t in turned]
        if len(rests) != 6 or max(near) > 1e-9 * abs(rests[0]):
            return False
    return True
