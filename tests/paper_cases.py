"""The paper's cases as shipped, each run once for all tests that look at it."""

from functools import cache

import numpy as np
import pytest

import pbdkit

CASES = ["a", "a-text", "b", "c", "d1", "d2", "e", "f1", "f2", "g"]
TORN = ["d1", "d2", "f1", "f2", "g"]
every_case = pytest.mark.parametrize("case", CASES)
LEADER, FOLLOWER, FRAME = 0, 1, 2
QUIET = "diagnostics=[]"
LAST = ["record={every: 100000}", QUIET]


@cache
def run(case, *settings):
    """The dataset of a shipped experiment; one run serves all tests, none changes it."""
    experiment = pbdkit.load(f"paper/{case}", settings=list(settings))
    return pbdkit.run(experiment, progress=False)


def moved(case):
    """u, (time, particle, axis)."""
    ds = run(case)
    return (ds.position - ds.reference).transpose("time", "particle", "axis")


def track_x(case, number):
    """The x displacement of one particle at every step."""
    return moved(case).sel(particle=number, axis="x").values


def body_u(case, *settings):
    """Displacements of a 10 by 10 body, (time, column, row, axis)."""
    ds = run(case, *settings)
    u = (ds.position - ds.reference).transpose("time", "particle", "axis").values
    return u[:, (ds.kind[0] != FRAME).values].reshape(len(u), 10, 10, 2)


def low_after_top(x):
    """The first step at which a series turns from falling to rising, or None."""
    change = np.diff(x)
    lows = np.flatnonzero((change[:-1] < -1e-9) & (change[1:] > 1e-9)) + 1
    return int(lows[0]) if len(lows) else None


def parted(case, threshold=None, *settings):
    """The step in which the leader of each row loses its last bond to the column beside it."""
    if threshold is not None:
        shells = 1 if case.startswith(("d1", "f1")) else 2
        settings = (f"fracture.thresholds={[threshold] * shells}", *settings)
    ds = run(case, "steps=15", QUIET, *settings)
    ends, steps = ds.bond_ends.values - 1, ds.broken_step.values
    site, body = ds.site.values[ends], (ds.kind[0] != FRAME).values[ends].all(axis=1)
    torn = body & (np.sort(site[:, :, 0], axis=1) == (8, 9)).all(axis=1)
    row = np.where(site[:, 0, 0] == 9, site[:, 0, 1], site[:, 1, 1])
    of_row = [steps[torn & (row == n)] for n in range(10)]
    return [int(broken.max()) if (broken > 0).all() else None for broken in of_row]
