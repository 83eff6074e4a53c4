"""Who moves with whom: blocks, (axis, axis), and the matrices by their entries that they make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.signedinteger[Any]]

DENSE = 500
"""Matrices of up to so many rows are made dense."""


@dataclass(frozen=True)
class Entries:
    """A matrix as (row, column, value); entries of one place are added."""

    rows: NDArray[np.signedinteger[Any]]
    columns: NDArray[np.signedinteger[Any]]
    values: NDArray[np.float64]
    shape: tuple[int, int]

    def plus(self, other: Entries, factor: float = 1.0) -> Entries:
        """The sum with `factor` times a matrix, in the shape of that."""
        rows = np.concatenate([self.rows, other.rows])
        columns = np.concatenate([self.columns, other.columns])
        values = np.concatenate([self.values, factor * other.values])
        return Entries(rows, columns, values, other.shape)

    def without(self, unknowns: Indices) -> Entries:
        """The matrix less some rows and columns."""
        kept = np.ones(self.shape[0], bool)
        kept[unknowns] = False
        number = np.cumsum(kept) - 1
        some = kept[self.rows] & kept[self.columns]
        size = int(np.count_nonzero(kept))
        at = number[self.rows[some]], number[self.columns[some]]
        return Entries(*at, self.values[some], (size, size))

    def matrix(self) -> Any:
        """Dense up to DENSE rows, else sparse."""
        if self.shape[0] > DENSE:
            return self.sparse()
        dense = np.zeros(self.shape)
        np.add.at(dense, (self.rows, self.columns), self.values)
        return dense

    def sparse(self) -> Any:
        """A scipy.sparse.csr_array."""
        import scipy.sparse

        return scipy.sparse.coo_array((self.values, (self.rows, self.columns)), self.shape).tocsr()


def identity_like(matrix: Any) -> Any:
    """1, dense or sparse as a square matrix is."""
    if isinstance(matrix, np.ndarray):
        return np.eye(len(matrix))
    from scipy.sparse import eye_array

    return eye_array(matrix.shape[0], format="csr")


def one_minus(matrix: Any) -> Any:
    """1 - a matrix, dense or sparse as it is."""
    found = identity_like(matrix) - matrix
    return found if isinstance(matrix, np.ndarray) else found.tocsr()


def connected(matrix: Any, *, strongly: bool) -> tuple[int, Indices]:
    """(count, label): the groups of unknowns that reach one another, along arrows or either way."""
    if not matrix.shape[0]:
        return 0, np.empty(0, np.intp)
    if not isinstance(matrix, np.ndarray):
        from scipy.sparse.csgraph import connected_components

        kind = "strong" if strongly else "weak"
        count, label = connected_components(matrix, connection=kind)
        return count, label
    reach = (matrix != 0.0) | np.eye(len(matrix), dtype=bool)
    if not strongly:
        return _touching(reach | reach.T)
    while True:
        further = reach.astype(np.float32) @ reach.astype(np.float32) > 0.0
        if (further == reach).all():
            break
        reach = further
    first = np.argmax(reach & reach.T, axis=1)  # the lowest unknown of each group names it
    names, label = np.unique(first, return_inverse=True)
    return len(names), label


def _touching(reach: NDArray[np.bool_]) -> tuple[int, Indices]:
    """The same where all lead both ways: each group from its lowest unknown outwards."""
    count, label = 0, np.full(len(reach), -1)
    for first in range(len(reach)):
        front = np.array([first] if label[first] < 0 else [], int)
        count += len(front)
        while len(front):
            label[front] = count - 1
            front = np.flatnonzero(reach[front].any(axis=0) & (label < 0))
    return count, label


@dataclass
class Couplings:
    """Blocks (axis, axis) at (row, column), in parts, counted in particles; those of one place add.

    `shape` is in particles, `axes` how many space has. Blocks that are the same everywhere may be
    views of one.
    """

    shape: tuple[int, int]
    axes: int
    parts: list[tuple[Indices, Indices, Floats]] = field(default_factory=list)

    def add(self, rows: Indices, columns: Indices, blocks: Floats) -> None:
        """Adds blocks, (entry, axis, axis)."""
        if len(rows):
            self.parts.append((rows, columns, blocks))

    def add_scaled_identity(self, rows: Indices, factor: float) -> None:
        """Adds factor · 1 on the diagonal of some rows."""
        block = factor * np.eye(self.axes)
        self.add(rows, rows, np.broadcast_to(block, (len(rows), *block.shape)))

    def entries(self, to: Sequence[int] = (), of: Sequence[int] = ()) -> Entries:
        """Of the matrix from some axes `of` particles `to` others, (all of them, the same): with
        unknowns 2n (x) and 2n + 1 (y) of particle n in the plane, 3n to 3n + 2 in space, n for one
        axis."""
        to = to or range(self.axes)
        of = of or to
        nothing = np.empty(0, np.intp)
        found: list[tuple[Any, Any, Any]] = [(nothing, nothing, np.empty(0))]
        for rows, columns, blocks in self.parts:
            for (i, a), (j, b) in product(enumerate(to), enumerate(of)):
                if not _of_one(blocks)[:, a, b].any():
                    continue
                value = blocks[:, a, b]
                kept = slice(None) if is_one(blocks) else value != 0.0
                found.append((len(to) * rows[kept] + i, len(of) * columns[kept] + j, value[kept]))
        rows, columns, values = (np.concatenate(part) for part in zip(*found, strict=True))
        return Entries(rows, columns, values, (len(to) * self.shape[0], len(of) * self.shape[1]))

    def couples(self, a: int, b: int) -> bool:
        """Whether anything leads from axis b to axis a."""
        return any(_of_one(blocks)[:, a, b].any() for _, _, blocks in self.parts)

    def is_isotropic(self) -> bool:
        """Whether all axes move alike."""
        blocks = [_of_one(blocks) for _, _, blocks in self.parts]
        first, *others = range(self.axes)
        return all(np.array_equal(b[:, first, first], b[:, a, a]) for b in blocks for a in others)

    def times(self, vectors: Floats) -> Floats:
        """The product with vectors, (particle, axis)."""
        found = np.zeros((self.shape[0], self.axes))
        for rows, columns, blocks in self.parts:
            terms = np.einsum("eab,eb->ea", blocks, vectors[columns])
            for axis in range(self.axes):
                found[:, axis] += np.bincount(rows, terms[:, axis], self.shape[0])
        return found


def some_of(blocks: Floats, chosen: NDArray[np.bool_]) -> Floats:
    """Those chosen; still a view where all are one."""
    return blocks[: np.count_nonzero(chosen)] if is_one(blocks) else blocks[chosen]


def scaled(factor: float, blocks: Floats) -> Floats:
    """The multiple; still a view where all are one."""
    return np.broadcast_to(factor * blocks[:1], blocks.shape) if is_one(blocks) else factor * blocks


def is_one(blocks: Floats) -> bool:
    """Whether the blocks are views of a single one."""
    return len(blocks) > 1 and blocks.strides[0] == 0


def frame_matrices(weights: Floats, axes: int) -> Floats:
    """(entry, axis, axis): a frame's weights as matrices."""
    return weights[:, None, None] * np.eye(axes) if weights.ndim == 1 else weights


def _of_one(blocks: Floats) -> Floats:
    return blocks[:1] if is_one(blocks) else blocks
