"""What a matrix of stencils is: symmetric, perhaps once rows are multiplied; held by leaders."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.equilibrium.grids.grid_functions import kernels
from pbdkit.equilibrium.grids.stencil_matrix import (
    FREE,
    LED,
    OUTSIDE,
    OWN,
    WINDOW,
    StencilMatrix,
)
from pbdkit.equilibrium.rows import ALL, Rows

Floats = NDArray[np.floating[Any]]
EXACT, DIFFERENCED = 1e-9, 1e-5
"""Relative difference up to which a matrix counts as symmetric: one by derivatives, one by
differences."""
DIGITS = 13
"""Of factors of rows; rounding decides the others."""


def is_symmetric(matrix: StencilMatrix, alike: float = EXACT, rows: Rows = ALL) -> bool:
    """Up to a share of its largest entry."""
    largest = rows.most(max(float(matrix.stencils.max()), -float(matrix.stencils.min())))
    return rows.most(kernels().asymmetry(matrix.code, matrix.stencils)) <= alike * largest


def balanced(
    matrix: StencilMatrix, alike: float = EXACT, rows: Rows = ALL
) -> tuple[StencilMatrix, bool]:
    """The matrix with its rows multiplied so that it is symmetric, and whether that can be: those
    of particles with fewer neighbours, of which each has more weight. What is left of a difference
    is shared by both sides."""
    if is_symmetric(matrix, rows=rows):
        return matrix, True
    factor = _factors(matrix, rows)
    if factor is None:
        return matrix, False
    lone = np.nonzero(matrix.code > 0)
    row, times = matrix.code[lone], factor[lone].round(DIGITS)
    number = np.arange(len(row))
    if len(row) >= len(matrix.stencils):
        pairs = np.stack([row, times], axis=1)
        kinds, number = np.unique(pairs, axis=0, return_inverse=True)
        row, times = kinds[:, 0].astype(int), kinds[:, 1]
    code = matrix.code.copy()
    code[lone] = 1 + number.ravel()
    stencils, scale = (
        np.concatenate([table[:1], table[row] * times.reshape(-1, *[1] * (table.ndim - 1))])
        for table in (matrix.stencils, matrix.scale)
    )
    found = replace(matrix, code=code, stencils=stencils, scale=scale)
    if not is_symmetric(found, alike, rows):
        return matrix, False
    if alike > EXACT:
        kernels().symmetrise(code, stencils)
    return found, True


def _factors(matrix: StencilMatrix, rows: Rows) -> Floats | None:
    """By which rows are multiplied, 1 for the stencil of most; None where some have none."""
    factor = (matrix.code == 0).astype(float)
    while True:
        left, before = kernels().balance(matrix.code, matrix.stencils, factor)
        if not rows.any(left < before):
            return None if rows.any(left > 0) else factor
        told = factor.copy()
        rows.meet(told)
        np.copyto(factor, told, where=told > 0.0)


def transposed(matrix: StencilMatrix) -> StencilMatrix:
    """Kᵀ, with stencils of their own for all but those whose neighbourhood is like that of most;
    `scale` is that of K."""
    code, (row, place) = matrix.code, np.nonzero(matrix.code >= 0)
    there = np.stack([code[row + s // 3 - 1, place + s % 3 - 1] for s in range(WINDOW)], axis=1)
    alike = (there == 0).all(axis=1)
    codes = code.copy()
    codes[row, place] = np.where(alike, 0, np.cumsum(~alike))
    kept = np.concatenate([np.zeros((1, WINDOW), there.dtype), there[~alike]])
    found = matrix.stencils[np.maximum(kept, 0), WINDOW - 1 - np.arange(WINDOW)][..., [0, 2, 1, 3]]
    found *= (kept >= 0)[..., None]
    scale = matrix.scale[np.maximum(kept[:, OWN], 0)]
    return replace(matrix, code=codes, stencils=np.ascontiguousarray(found), scale=scale)


def leads_one_way(matrix: StencilMatrix, rows: Rows = ALL) -> bool:
    """Whether one axis moves the other and not the reverse: they are better solved in turn."""
    ways = matrix.stencils[..., 1], matrix.stencils[..., 2]
    return len({rows.any(bool(way.any())) for way in ways}) > 1


def is_held(matrix: StencilMatrix, held: NDArray[np.bool_] | None = None, rows: Rows = ALL) -> bool:
    """Whether every connected part of the body touches a leader, along each axis, or has `held`
    components, and no neighbours are apart, as across a crack: without a bond, and without a
    neighbour that both have one with."""
    from scipy.ndimage import binary_dilation, label

    bonds = np.logical_or.reduce([matrix.stencils[..., e] != 0.0 for e in range(4)])
    known = np.logical_or.reduce(rows.every(bonds.any(axis=0)))
    if rows.any(any(_apart(matrix, bonds, s) for s in np.flatnonzero(known).tolist())):
        return False
    pattern = (known | known[::-1]).reshape(3, 3)
    parts, count = label(matrix.kind == FREE, structure=pattern)
    for axis in range(2):
        led = binary_dilation(matrix.kind == LED, structure=pattern)
        if held is not None:
            led |= held[axis]
        if not _reached(parts, count, led, rows):
            return False
    return True


def _reached(parts: Any, count: int, led: Any, rows: Rows) -> bool:
    """Whether all parts have led places, each going on where other processes have rows."""
    while True:
        reached = np.zeros(count + 1, bool)
        reached[parts[led]] = True
        reached[0] = False
        if not rows.any(not reached[1:].all()):
            return True
        here = reached[parts]
        there = here.copy()
        rows.meet(there)
        if not rows.any(bool((there > here).any())):
            return not rows.any(bool((here < (parts > 0))[rows.own].any()))
        led = here | there


def _apart(matrix: StencilMatrix, bonds: NDArray[np.bool_], s: int) -> bool:
    """Whether there are such neighbours along place s of the stencils."""
    row, place = np.nonzero(matrix.code > 0)
    down, along = s // 3 - 1, s % 3 - 1
    there = matrix.kind[row + down, place + along] != OUTSIDE
    some = np.flatnonzero(there & ~bonds[matrix.code[row, place], s])
    one = matrix.code[row[some], place[some]]
    other = matrix.code[row[some] + down, place[some] + along]
    linked = other < 0  # a leader: nothing moves it
    for t in range(9):
        a, b = t // 3 - 1 - down, t % 3 - 1 - along
        if max(abs(a), abs(b)) <= 1:
            linked |= bonds[one, t] & bonds[other, 3 * (a + 1) + b + 1]
    return not linked.all()
