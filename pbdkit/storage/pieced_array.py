"""Arrays that come piece by piece, because nobody holds the whole."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Bytes = NDArray[np.uint8]


class PiecedArray:
    """An array of a shape and dtype, of which the `pieces` come in the order of memory. Who asks
    for it takes them: that can be done once."""

    def __init__(self, shape: tuple[int, ...], dtype: np.dtype[Any], pieces: Iterable[Array]):
        self.shape, self.dtype, self.ndim = shape, dtype, len(shape)
        self.nbytes = math.prod(shape) * dtype.itemsize
        self._pieces = map(as_bytes, pieces)
        self._left: Bytes = np.empty(0, np.uint8)

    @classmethod
    def of(cls, array: Array) -> PiecedArray:
        """One that is there, as a single piece."""
        return cls(array.shape, array.dtype, [array])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        """The whole."""
        whole = self._read(self.nbytes).view(self.dtype).reshape(self.shape)
        return whole if dtype is None else whole.astype(dtype, copy=False)

    def blocks(self, nbytes: int) -> Iterator[Bytes]:
        """Of so many bytes each; the last has what is left."""
        for at in range(0, self.nbytes, nbytes):
            yield self._read(min(nbytes, self.nbytes - at))

    def rows(self, count: int) -> Iterator[Array]:
        """So many entries of the first axis each; the last has what is left."""
        each = math.prod(self.shape[1:]) * self.dtype.itemsize
        for block in self.blocks(max(1, count * each)):
            yield block.view(self.dtype).reshape(-1, *self.shape[1:])

    def tiles(self, nbytes: int) -> Iterator[tuple[tuple[Any, ...], Array]]:
        """Places of it and what stands there, of about so many bytes each: some entries along an
        axis, the first of two axes or of fewer, else the last but one."""
        *lead, count = self.shape[: max(1, self.ndim - 1)]
        inner = self.shape[len(lead) + 1 :]
        each = math.prod(inner) * self.dtype.itemsize
        step = max(1, nbytes // max(1, each))
        for at in np.ndindex(*lead):
            for first in range(0, count, step):
                last = min(first + step, count)
                found = self._read((last - first) * each).view(self.dtype)
                yield (*at, slice(first, last)), found.reshape(last - first, *inner)

    def drain(self) -> None:
        """Takes what nobody has asked for."""
        for _ in self._pieces:
            pass

    def _read(self, nbytes: int) -> Bytes:
        """So many bytes more."""
        found, size = [self._left], self._left.size
        while size < nbytes:
            found.append(next(self._pieces))
            size += found[-1].size
        whole = np.concatenate(found) if len(found) > 2 or found[0].size else found[-1]
        self._left = whole[nbytes:]
        return whole[:nbytes]


def as_bytes(array: Array) -> Bytes:
    """The bytes of an array, in the order of memory."""
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8)
