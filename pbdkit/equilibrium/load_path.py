"""The way of the load, cut into increments: moments, in steps, at which a body is settled."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from pbdkit.scene.scene import Scene
from pbdkit.stepping.prescription import last_event

SAMPLES = 16
"""Parts of an interval in which the way of a leader counts as straight."""


def events(scene: Scene) -> list[int]:
    """The moments, from 0 on, between which each leader moves by one formula and all keep their
    roles: the ends of steps, up to the last of the load."""
    steps, last = scene.experiment.steps, last_event(scene)
    found = {0, last}
    for leading in scene.driven:
        group = leading.group
        end = group.last(steps)
        knots = (group.from_ - 1 + n for n in group.motion.knots())
        found |= {group.from_ - 1, end, *(knot for knot in knots if knot <= end)}
    return sorted(moment for moment in found if 0 <= moment <= last)


def moments(scene: Scene, count: int) -> list[float]:
    """The ends of about `count` increments, equal parts of the way that the leaders go, and every
    event. An increment is some whole steps, or a step some whole increments; where nobody moves
    there is one."""
    ends = events(scene)
    intervals = list(pairwise(ends)) or [(0, ends[-1])]
    ways = [_way(scene, *interval) for interval in intervals]
    whole, found = sum(ways), list[float]()
    for (begin, end), way in zip(intervals, ways, strict=True):
        parts = count * way / whole if whole > 0.0 else 1.0
        a_step = round(parts / (end - begin))
        if a_step > 0:
            found += [begin + (n + 1) / a_step for n in range(a_step * (end - begin))]
        else:
            marks = np.linspace(begin, end, max(1, round(parts)) + 1).round().astype(int)
            found += np.unique(marks)[1:].tolist()
    return found


def _way(scene: Scene, begin: int, end: int) -> float:
    """How far the leader that goes farthest goes between two events."""
    most = 0.0
    for leading in scene.driven:
        group = leading.group
        if not (group.from_ - 1 <= begin and group.leads(end)):
            continue
        times = np.linspace(begin, end, SAMPLES + 1) - group.from_ + 1
        at = [np.atleast_2d(group.motion.offset(n, leading.reference)) for n in times.tolist()]
        ways = sum(np.hypot(*(b - a).T) for a, b in pairwise(at))
        most = max(most, float(np.max(ways)))
    return most if math.isfinite(most) else 0.0
