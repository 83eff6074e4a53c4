"""Who moves with whom: the blocks, (axis, axis), that a step operator is made of."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.matrices import Entries

Floats = NDArray[np.float64]
Indices = NDArray[np.signedinteger[Any]]


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

    def entries(self) -> Entries:
        """Of the matrix with the unknowns 2n (x) and 2n + 1 (y) of particle n in the plane, 3n to
        3n + 2 in space."""
        found: list[tuple[Indices, Indices, Floats]] = []
        axes = self.axes
        for rows, columns, blocks in self.parts:
            for a, b in np.ndindex(axes, axes):
                value = blocks[:, a, b]
                kept = value != 0.0
                found.append((axes * rows[kept] + a, axes * columns[kept] + b, value[kept]))
        return _joined(found, (axes * self.shape[0], axes * self.shape[1]))

    def between(self, a: int, b: int) -> Entries:
        """Of the matrix from axis b to axis a alone, an unknown a particle."""
        parts = [
            (rows, columns, blocks[:, a, b])
            for rows, columns, blocks in self.parts
            if _of_one(blocks)[:, a, b].any()
        ]
        return _joined(parts, self.shape)

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
        product = np.zeros((self.shape[0], self.axes))
        for rows, columns, blocks in self.parts:
            terms = np.einsum("eab,eb->ea", blocks, vectors[columns])
            for axis in range(self.axes):
                product[:, axis] += np.bincount(rows, terms[:, axis], self.shape[0])
        return product


def some_of(blocks: Floats, chosen: NDArray[np.bool_]) -> Floats:
    """Those chosen; still a view where all are one."""
    if is_one(blocks):
        return blocks[: np.count_nonzero(chosen)]
    return blocks[chosen]


def is_one(blocks: Floats) -> bool:
    """Whether the blocks are views of a single one."""
    return len(blocks) > 1 and blocks.strides[0] == 0


def frame_matrices(weights: Floats, axes: int) -> Floats:
    """(entry, axis, axis): a frame's weights as matrices."""
    return weights[:, None, None] * np.eye(axes) if weights.ndim == 1 else weights


def _of_one(blocks: Floats) -> Floats:
    return blocks[:1] if is_one(blocks) else blocks


def _joined(parts: list[tuple[Any, Any, Any]], shape: tuple[int, int]) -> Entries:
    if not parts:
        nothing = np.empty(0, np.intp)
        return Entries(nothing, nothing, np.empty(0), shape)
    rows, columns, values = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Entries(rows, columns, values, shape)
