"""Ways in which the bytes of a file get damaged."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

BLOCK = 512


def flip(draw: random.Random, data: bytearray) -> None:
    for _ in range(draw.choice([1, 1, 3, 50])):
        data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)


def cut(draw: random.Random, data: bytearray) -> None:
    del data[draw.randrange(len(data)) :]


def zero(draw: random.Random, data: bytearray) -> None:
    at = draw.randrange(0, len(data), BLOCK)
    length = min(len(data) - at, BLOCK * draw.choice([1, 8, 64]))
    data[at : at + length] = bytes(length)


def swap(draw: random.Random, data: bytearray) -> None:
    size = draw.choice([BLOCK, 4096])
    one, two = (draw.randrange(0, max(1, len(data) - size), size) for _ in range(2))
    data[one : one + size], data[two : two + size] = (
        data[two : two + size],
        data[one : one + size],
    )


def lengthen(draw: random.Random, data: bytearray) -> None:
    data += draw.randbytes(draw.choice([1, 4096]))


HOW: list[Callable[[random.Random, bytearray], None]] = [flip, flip, cut, zero, swap, lengthen]


def damage(draw: random.Random, path: Path) -> str:
    """Damages a file, which is not empty; the name of the way."""
    how, data = draw.choice(HOW), bytearray(path.read_bytes())
    how(draw, data)
    path.write_bytes(data)
    return how.__name__
