"""The way of the load, cut into increments: moments, in steps, at which a body is settled."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from pbdkit.equilibrium.certificate import spacing_of
from pbdkit.scene.scene import Scene
from pbdkit.stepping.guard import way_of
from pbdkit.stepping.prescription import bends_of, last_event

SAMPLES = 16
"""Parts of an interval in which the way of a leader counts as straight."""


def events(scene: Scene) -> list[int]:
    """The moments, from 0 on, between which each leader moves by one formula, all keep their roles
    and bonds that are not torn, and loads and numbers change evenly: the ends of steps, up to the
    last of the load."""
    steps, last = scene.experiment.steps, last_event(scene)
    found = {0, last, *bends_of(scene), *(cut.at - 1 for cut in scene.experiment.cuts)}
    for change in scene.loads.changes(steps) if scene.loads else ():
        found |= {change - 1, change}
    for leading in scene.driven:
        group = leading.group
        end = group.last(steps)
        knots = (group.from_ - 1 + n for n in group.motion.knots())
        found |= {group.from_ - 1, end, *(knot for knot in knots if knot <= end)}
    return sorted(moment for moment in found if 0 <= moment <= last)


def moments(scene: Scene, count: int) -> list[float]:
    """The ends of about `count` increments, equal parts of the way that the leaders go, as many of
    what loads and numbers do, and every event. An increment is some whole steps, or a step some
    whole increments; where nobody moves there is one."""
    ends = events(scene)
    intervals = list(pairwise(ends)) or [(0, ends[-1])]
    shares, found = _in_parts(count, [_way(scene, *i) for i in intervals]), list[float]()
    ways = [course.way for course in scene.experiment.courses.values()]
    for way in [*ways, *([scene.loads.way] if scene.loads else [])]:
        shares = list(map(max, shares, _in_parts(count, [way(*i) for i in intervals])))
    for (begin, end), parts in zip(intervals, shares, strict=True):
        a_step = round(parts / (end - begin))
        if a_step > 0:
            found += [begin + (n + 1) / a_step for n in range(a_step * (end - begin))]
        else:
            marks = np.linspace(begin, end, max(1, round(parts)) + 1).round().astype(int)
            found += np.unique(marks)[1:].tolist()
    return found


def _in_parts(count: int, ways: list[float]) -> list[float]:
    """So many increments over intervals of these ways; one each where there is no way at all."""
    whole = sum(ways)
    return [count * way / whole if whole > 0.0 else 1.0 for way in ways]


def _way(scene: Scene, begin: int, end: int) -> float:
    """How far the leader that goes farthest goes between two events."""
    most = 0.0
    for leading in scene.driven:
        group = leading.group
        if not (group.from_ - 1 <= begin and group.leads(end)):
            continue
        times = np.linspace(begin, end, SAMPLES + 1) - group.from_ + 1
        at = [leading.offset(n) for n in times.tolist()]
        ways = sum(np.hypot.reduce(abs(b - a), axis=1) for a, b in pairwise(at))
        most = max(most, float(np.max(ways)))
    return most if math.isfinite(most) else 0.0


def spacings(scene: Scene) -> int:
    """By how many lattice spacings the obstacle that goes farthest goes, at least 1."""
    ways = [way_of(barrier, scene.experiment.steps) for barrier in scene.barriers]
    return max(1, math.ceil(max(ways, default=0.0) / spacing_of(scene)))


def changes(scene: Scene, steps: int) -> list[int]:
    """The steps after which roles or loads change, within so many."""
    found = {step - 1 for step in scene.loads.changes(steps)} if scene.loads else set()
    for leading in scene.leading:
        found |= {leading.group.from_ - 1, leading.group.last(steps)}
    return sorted(step for step in found if 0 < step < steps)
