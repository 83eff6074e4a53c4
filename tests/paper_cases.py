"""The paper's cases as shipped, each run once for all tests that look at it."""

from functools import cache

import pytest

import pbdkit

CASES = ["a", "a-text", "b", "c", "d1", "d2", "e", "f1", "f2", "g"]
TORN = ["d1", "d2", "f1", "f2", "g"]
every_case = pytest.mark.parametrize("case", CASES)
LEADER, FOLLOWER, FRAME = 0, 1, 2


@cache
def run(case):
    """The dataset of a shipped experiment; one run serves all tests, none changes it."""
    return pbdkit.run(f"paper/{case}", progress=False)


def moved(case):
    """u, (time, particle, axis)."""
    ds = run(case)
    return (ds.position - ds.reference).transpose("time", "particle", "axis")


def track_x(case, number):
    """The x displacement of one particle at every step."""
    return moved(case).sel(particle=number, axis="x").values
