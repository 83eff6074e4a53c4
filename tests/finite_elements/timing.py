"""Wall and processor time of work that is done several times: the least of each."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple


class Seconds(NamedTuple):
    wall: float
    processor: float

    def plus(self, other: Seconds) -> Seconds:
        return Seconds(self.wall + other.wall, self.processor + other.processor)


ENOUGH_S = 1.0
"""Work that has taken this long is not done again."""


def best(repeats: int, work: Callable):
    """Return the least seconds, and the last result."""
    walls, processors, begun = [], [], time.perf_counter()
    for n in range(repeats):
        if n and time.perf_counter() - begun > ENOUGH_S:
            break
        wall, processor = time.perf_counter(), time.process_time()
        result = work()
        walls.append(time.perf_counter() - wall)
        processors.append(time.process_time() - processor)
    return Seconds(min(walls), min(processors)), result
