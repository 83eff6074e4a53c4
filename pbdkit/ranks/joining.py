"""Parts that several processes have, joined piece by piece in the first of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.ranks.communicator import Ranks
from pbdkit.storage.pieced_array import Bytes, PiecedArray, as_bytes

Array = NDArray[Any]
BLOCK = 2**23
"""Bytes that are sent at once."""


class Share:
    """What another process than the first has of an array, along an axis. It has the array's kind
    alone, and can be sent."""

    def __init__(self, part: Array, axis: int) -> None:
        self.shape, self.dtype, self.ndim = part.shape, part.dtype, part.ndim
        self.nbytes = part.nbytes
        self._part, self._axis = part, axis

    def send(self, ranks: Ranks) -> None:
        """To the first process."""
        for block in _blocks(self._part, self._axis):
            ranks.send(block, 0)


def joined(ranks: Ranks, part: Array, axis: int, lengths: Sequence[int]) -> Any:
    """An array of which each process has a part, so many long along an axis, in the order of ranks:
    in the first process a PiecedArray, in the others their share of it."""
    if not ranks.first:
        return Share(part, axis)
    shape = (*part.shape[:axis], sum(lengths), *part.shape[axis + 1 :])
    return PiecedArray(shape, part.dtype, _received(ranks, part, axis, lengths))


def _received(ranks: Ranks, part: Array, axis: int, lengths: Sequence[int]) -> Iterator[Array]:
    for lead in np.ndindex(part.shape[:axis]):
        yield part[lead]
        for rank, length in enumerate(lengths[1:], 1):
            left = length * _row_bytes(part, axis)
            while left:
                piece = np.empty(min(left, BLOCK), np.uint8)
                ranks.receive(piece, rank)
                left -= piece.size
                yield piece


def _row_bytes(part: Array, axis: int) -> int:
    return int(np.prod(part.shape[axis + 1 :], dtype=int)) * part.itemsize


def _blocks(part: Array, axis: int) -> Iterator[Bytes]:
    for lead in np.ndindex(part.shape[:axis]):
        whole = as_bytes(part[lead])
        for at in range(0, whole.size, BLOCK):
            yield whole[at : at + BLOCK]
