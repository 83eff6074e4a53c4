"""The matrix of small and middle bodies as a band, and its factors: loops for kernels.

A c = r with A = 1 - (step operator), an unknown a follower and axis; or, where all axes move alike
and each by itself, an unknown a follower, for all axes at a time: `wide` is how many unknowns a
follower has. Row i of a band holds A[i, i - half] to A[i, i + half]. Factors are L with ones on
the diagonal and U, without exchanges, in its place. A row depends on those before it alone:
where rows change, those before the first of them stay as they are, to the bit.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

SAME = 1e-12
"""By so much entries may differ that are alike but for rounding; they are shares of a move."""
SAFETY = 3.0
"""What the estimated spread is multiplied with."""


def rows_of(work: Any, count: int, reach: int, wide: int) -> Any:
    """The band of `count` followers, each coupled to those up to `reach` before and after it."""
    width = 2 * ((reach + 1) * wide - 1) + 1
    return work[: count * wide * width].reshape(count * wide, width)


def are_alike(blocks: Any) -> Any:
    """Whether all blocks (follower, neighbour, axis, axis) are multiples of 1."""
    count, slots, axes, _ = blocks.shape
    for e in range(count):
        for k in range(slots):
            for a in range(axes):
                for b in range(axes):
                    like = blocks[e, k, 0, 0] if a == b else 0.0
                    if not abs(blocks[e, k, a, b] - like) <= SAME:
                        return False
    return True


def assemble(band: Any, blocks: Any, pattern: Any, first: int, wide: int) -> None:
    """Writes the rows of A from follower `first` on. Who does not move at all has a row of zeros,
    and stays: its diagonal becomes 1."""
    first_entry, slot, column, weight = pattern
    half, inner = band.shape[1] // 2, wide if wide > 1 else 1
    for e in range(first, len(blocks)):
        for i in range(e * wide, (e + 1) * wide):
            for m in range(band.shape[1]):
                band[i, m] = 0.0
        for n in range(first_entry[e], first_entry[e + 1]):
            away = half + (column[n] - e) * wide
            for a in range(wide):
                for b in range(wide):
                    value = 0.0
                    for c in range(inner):
                        value += blocks[e, slot[n], a, c] * weight[n, c, b]
                    band[e * wide + a, away + b - a] -= value
        for i in range(e * wide, (e + 1) * wide):
            most = 0.0
            for m in range(band.shape[1]):
                most = max(most, abs(band[i, m]))
            if most == 0.0:
                band[i, half] = 1.0


def factor(band: Any, first: int, diagonal: Any, inverse: Any) -> None:
    """Replaces the rows of A from `first` on by those of its factors; notes what stood on its
    diagonal, and the inverse of each pivot."""
    half = band.shape[1] // 2
    for i in range(first, len(band)):
        row = band[i]
        diagonal[i] = row[half]
        for k in range(max(0, i - half), i):
            at = k - i + half
            if row[at] != 0.0:
                share = row[at] * inverse[k]
                row[at] = share
                here, above = row[at + 1 : at + 1 + half], band[k, half + 1 :]
                for m in range(half):
                    here[m] -= share * above[m]
        inverse[i] = 1.0 / row[half]


def solve(band: Any, inverse: Any, x: Any) -> None:
    """Replaces the right sides (unknown, side) by the solutions."""
    half, sides = band.shape[1] // 2, x.shape[1]
    for i in range(len(band)):
        for k in range(max(0, i - half), i):
            for s in range(sides):
                x[i, s] -= band[i, k - i + half] * x[k, s]
    for i in range(len(band) - 1, -1, -1):
        for k in range(i + 1, min(len(band), i + half + 1)):
            for s in range(sides):
                x[i, s] -= band[i, k - i + half] * x[k, s]
        for s in range(sides):
            x[i, s] *= inverse[i]


def refactor(
    work: Any, blocks: Any, pattern: Any, factors: Any, known: Any, first: int, alike: bool
) -> None:
    """Factors anew from follower `first` on. `known` are the unknowns a follower has, how far A⁻¹
    takes random signs, with a margin, the largest diagonal entry, and the reach of the band;
    `alike` whether frame points follow with all axes alike."""
    diagonal, inverse, signs = factors
    count, axes = blocks.shape[0], blocks.shape[2]
    wide = 1 if alike and are_alike(blocks) else axes
    if wide != known[0]:
        first = 0
    known[0], known[2] = wide, 1.0
    band, size = rows_of(work, count, int(known[3]), wide), count * wide
    assemble(band, blocks, pattern, first, wide)
    factor(band, first * wide, diagonal, inverse)
    x = np.empty((size, 1))
    for i in range(size):
        x[i, 0] = signs[i]
        known[2] = max(known[2], abs(diagonal[i]))
    solve(band, inverse, x)
    known[1] = SAFETY * largest(x)


def correct(work: Any, factors: Any, known: Any, r: Any, c: Any) -> None:
    """c (follower, axis) with A c = r."""
    count, axes = r.shape
    wide = 1 if known[0] == 1.0 else axes
    for e in range(count):
        for a in range(axes):
            c[e, a] = r[e, a]
    band = rows_of(work, count, int(known[3]), wide)
    solve(band, factors[1], c.reshape(count * wide, axes // wide))


def largest(table: Any) -> Any:
    """The largest size in a table; not a number where one is none."""
    most = 0.0
    for n in range(table.shape[0]):
        for m in range(table.shape[1]):
            if not abs(table[n, m]) <= most:
                most = abs(table[n, m])
    return most


def norm(table: Any) -> Any:
    """The root of the sum of squares."""
    found = 0.0
    for n in range(table.shape[0]):
        for m in range(table.shape[1]):
            found += table[n, m] * table[n, m]
    return math.sqrt(found)
