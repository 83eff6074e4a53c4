"""Matrices by their entries: dense where small, so that nothing is imported, else sparse."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces.frame import Indices

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
        """The sum with `factor` times a matrix of the same shape."""
        return Entries(
            np.concatenate([self.rows, other.rows]),
            np.concatenate([self.columns, other.columns]),
            np.concatenate([self.values, factor * other.values]),
            self.shape,
        )

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


def connected(matrix: Any, *, strongly: bool) -> tuple[int, Indices]:
    """(count, label): the groups of unknowns that reach one another, along arrows or either way."""
    if not matrix.shape[0]:
        return 0, np.empty(0, np.intp)
    if not isinstance(matrix, np.ndarray):
        from scipy.sparse.csgraph import connected_components

        kind = "strong" if strongly else "weak"
        count, label = connected_components(matrix, connection=kind)
        return count, label
    if not strongly:
        return _connected_either_way(matrix)
    reach = (matrix != 0.0) | np.eye(len(matrix), dtype=bool)
    while True:
        further = reach.astype(np.float32) @ reach.astype(np.float32) > 0.0
        if (further == reach).all():
            break
        reach = further
    first = np.argmax(reach & reach.T, axis=1)  # the lowest unknown of each group names it
    names, label = np.unique(first, return_inverse=True)
    return len(names), label


def _connected_either_way(matrix: NDArray[Any]) -> tuple[int, Indices]:
    """Every unknown takes the lowest name of those that it is connected with, and that one's name,
    until nothing changes."""
    rows, columns = np.nonzero(matrix)
    name = np.arange(len(matrix))
    while True:
        lower = name.copy()
        np.minimum.at(lower, rows, name[columns])
        np.minimum.at(lower, columns, name[rows])
        lower = lower[lower]
        if (lower == name).all():
            break
        name = lower
    names, label = np.unique(name, return_inverse=True)
    return len(names), label
