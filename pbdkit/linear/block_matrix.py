"""Matrices that consist of blocks (axis, axis) between particles, and their scalar entries.

Small matrices are dense arrays, other matrices are scipy.sparse.csr_array.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats, Integers

DENSE = 500
"""Largest number of rows of matrices that are stored densely."""


@dataclass(frozen=True)
class CoordinateMatrix:
    """Matrix in coordinate form: (row, column, value). Values at the same place are added."""

    rows: NDArray[np.signedinteger[Any]]
    columns: NDArray[np.signedinteger[Any]]
    values: Floats
    shape: tuple[int, int]

    def plus(self, other: CoordinateMatrix, factor: float = 1.0) -> CoordinateMatrix:
        """Return the sum of this matrix and `factor` times another matrix. The result has the shape
        of the other matrix."""
        rows = np.concatenate([self.rows, other.rows])
        columns = np.concatenate([self.columns, other.columns])
        values = np.concatenate([self.values, factor * other.values])
        return CoordinateMatrix(rows, columns, values, other.shape)

    def without(self, unknowns: Integers) -> CoordinateMatrix:
        """Return the matrix without the rows and columns of some unknowns."""
        is_remaining = np.ones(self.shape[0], bool)
        is_remaining[unknowns] = False
        number = np.cumsum(is_remaining) - 1
        entries = is_remaining[self.rows] & is_remaining[self.columns]
        size = int(np.count_nonzero(is_remaining))
        places = number[self.rows[entries]], number[self.columns[entries]]
        return CoordinateMatrix(*places, self.values[entries], (size, size))

    def matrix(self) -> Any:
        """Return a dense matrix up to DENSE rows, else a sparse one."""
        if self.shape[0] > DENSE:
            return self.sparse()
        place = self.rows * self.shape[1] + self.columns
        return np.bincount(place, self.values, self.shape[0] * self.shape[1]).reshape(self.shape)

    def sparse(self) -> Any:
        """Return the entries as a scipy.sparse.csr_array."""
        import scipy.sparse

        return scipy.sparse.coo_array((self.values, (self.rows, self.columns)), self.shape).tocsr()


def identity_like(matrix: Any) -> Any:
    """Return the identity matrix of the same size. It is dense if the given square matrix is dense,
    and otherwise sparse."""
    if isinstance(matrix, np.ndarray):
        return np.eye(len(matrix))
    from scipy.sparse import eye_array

    return eye_array(matrix.shape[0], format="csr")


def one_minus(matrix: Any) -> Any:
    """Return the identity minus a matrix. The result is dense if the matrix is dense, and otherwise
    sparse."""
    difference = identity_like(matrix) - matrix
    return difference if isinstance(matrix, np.ndarray) else difference.tocsr()


def connected(matrix: Any, *, strongly: bool) -> tuple[int, Integers]:
    """Find the connected components of the directed graph that is defined by the entries of a
    matrix.

    Parameters
    ----------
    strongly
        If true, edges connect in their direction only, so that the components are strongly
        connected.

    Returns
    -------
    count
        Number of components.
    label : (unknown,)
        Component of each unknown.
    """
    if not matrix.shape[0]:
        return 0, np.empty(0, np.intp)
    if not isinstance(matrix, np.ndarray):
        from scipy.sparse.csgraph import connected_components

        kind = "strong" if strongly else "weak"
        count, label = connected_components(matrix, connection=kind)
        return count, label
    reach = (matrix != 0.0) | np.eye(len(matrix), dtype=bool)
    if not strongly:
        return _undirected_components(reach | reach.T)
    while True:
        longer = reach.astype(np.float32) @ reach.astype(np.float32) > 0.0
        if (longer == reach).all():
            break
        reach = longer
    first = np.argmax(reach & reach.T, axis=1)  # In the order of lowest unknowns.
    names, label = np.unique(first, return_inverse=True)
    return len(names), label


def _undirected_components(reach: NDArray[np.bool_]) -> tuple[int, Integers]:
    """Find the components of a symmetric graph by breadth-first search."""
    count, label = 0, np.full(len(reach), -1)
    while (unlabelled := label < 0).any():
        front = np.flatnonzero(unlabelled)[:1]
        count += 1
        while len(front):
            label[front] = count - 1
            front = np.flatnonzero(reach[front].any(axis=0) & (label < 0))
    return count, label


@dataclass
class BlockMatrix:
    """Matrix of blocks (axis, axis). The rows and columns of blocks are particles.

    Parameters
    ----------
    shape
        Number of rows and columns in particles.
    axes
        Number of axes of space.
    parts
        Rows, columns and blocks, (entry, axis, axis). Blocks at the same place are added. If all
        blocks are equal, they may be a broadcast view of one block.
    """

    shape: tuple[int, int]
    axes: int
    parts: list[tuple[Integers, Integers, Floats]] = field(default_factory=list)

    def add(self, rows: Integers, columns: Integers, blocks: Floats) -> None:
        """Add blocks, (entry, axis, axis)."""
        if len(rows):
            self.parts.append((rows, columns, blocks))

    def add_scaled_identity(self, rows: Integers, factor: float) -> None:
        """Add factor · 1 on the diagonal of some rows."""
        block = factor * np.eye(self.axes)
        self.add(rows, rows, np.broadcast_to(block, (len(rows), *block.shape)))

    def entries(self, to: Sequence[int] = (), of: Sequence[int] = ()) -> CoordinateMatrix:
        """Return the scalar entries of the couplings between axes.

        Parameters
        ----------
        to, of
            Axes of the rows (`to`), by default all, and axes of the columns (`of`), by default the
            same as `to`. With all axes, particle n has the unknowns 2n (x) and 2n + 1 (y) in the
            plane.
        """
        to = to or range(self.axes)
        of = of or to
        shape = (len(to) * self.shape[0], len(of) * self.shape[1])
        rows, columns, blocks = self._joined()
        if len(to) + len(of) < 2 * self.axes:
            blocks = blocks[:, np.array(to)[:, None], of]
        entry, i, j = np.nonzero(blocks)
        values = blocks[entry, i, j]
        row, column = len(to) * rows[entry] + i, len(of) * columns[entry] + j
        return CoordinateMatrix(row, column, values, shape)

    def _joined(self) -> tuple[Integers, Integers, Floats]:
        """Return all parts, concatenated to a single part."""
        if not self.parts:
            nothing = np.empty(0, np.intp)
            return nothing, nothing, np.empty((0, self.axes, self.axes))
        rows, columns, blocks = (np.concatenate(values) for values in zip(*self.parts, strict=True))
        return rows, columns, blocks

    def couples(self, a: int, b: int) -> bool:
        """Return whether displacements along axis b change displacements along axis a."""
        return any(blocks[:, a, b].any() for _, _, blocks in self.parts)

    def is_isotropic(self) -> bool:
        """Return whether all axes have the same couplings and are not coupled to each other."""
        return all(
            np.array_equal(blocks[:, 0, 0], blocks[:, a, a])
            for _, _, blocks in self.parts
            for a in range(1, self.axes)
        )

    def times(self, vectors: Floats) -> Floats:
        """Return the product with vectors, (particle, axis)."""
        rows, columns, blocks = self._joined()
        terms = np.einsum("eab,eb->ea", blocks, vectors[columns])
        return np.stack([np.bincount(rows, along, self.shape[0]) for along in terms.T], axis=1)


def frame_matrices(weights: Floats, axes: int) -> Floats:
    """Return the weights of a frame as matrices, (entry, axis, axis)."""
    return weights[:, None, None] * np.eye(axes) if weights.ndim == 1 else weights
