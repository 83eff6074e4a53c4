"""Ratios that noise cannot easily upset: contestants take turns, and the best of each counts."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

Work = Callable[[], object]


@dataclass(frozen=True)
class Ratio:
    """`value` is best over best; `low` and `high` the quartiles of the ratios of single turns;
    `first_s` and `second_s` the best seconds."""

    value: float
    low: float
    high: float
    first_s: float
    second_s: float


def ratio(first: Work, second: Work, turns: int = 9) -> Ratio:
    """Seconds of the first over seconds of the second, one warm-up of each before."""
    times: list[list[float]] = [[], []]
    for turn in range(turns + 1):
        for mine, work in zip(times, (first, second), strict=True):
            begun = time.perf_counter()
            work()
            if turn:
                mine.append(time.perf_counter() - begun)
    return of_times(*times)


def of_times(first: list[float], second: list[float]) -> Ratio:
    """Return the ratio of times taken in turns."""
    single = [a / b for a, b in zip(first, second, strict=True)]
    low, _, high = statistics.quantiles(single, n=4)
    return Ratio(min(first) / min(second), low, high, min(first), min(second))


def best_in_turns(
    works: Sequence[Work], turns: int, clock: Callable[[], float] = time.perf_counter
) -> list[float]:
    """The best seconds of each, one warm-up of each before."""
    found = [float("inf")] * len(works)
    for turn in range(turns + 1):
        for n, work in enumerate(works):
            begun = clock()
            work()
            if turn:
                found[n] = min(found[n], clock() - begun)
    return found


def best(work: Work, turns: int = 5) -> float:
    """The best seconds of several turns after a warm-up."""
    found = float("inf")
    for turn in range(turns + 1):
        begun = time.perf_counter()
        work()
        if turn:
            found = min(found, time.perf_counter() - begun)
    return found


def wait_for_quiet(patience_s: float = 20.0) -> bool:
    """Wait until no other process computes, for measurements on all processors; return False if
    that took too long."""
    end = time.monotonic() + patience_s
    while _busy(0.5) > 0.1:
        if time.monotonic() > end:
            return False
    return True


def _busy(seconds: float) -> float:
    """The share of all processors' time that was taken in the coming seconds."""
    stat = Path("/proc/stat")
    if not stat.exists():
        return 0.0
    counts = []
    for pause in (seconds, 0.0):
        counts.append([int(word) for word in stat.read_text().split("\n")[0].split()[1:9]])
        time.sleep(pause)
    spent = [after - before for before, after in zip(*counts, strict=True)]
    idle = spent[3] + spent[4]
    return 1.0 - idle / max(1, sum(spent))
