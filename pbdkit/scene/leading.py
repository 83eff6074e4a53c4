"""Leader groups on a raster: who leads when, and where to."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.experiment.leaders import LeaderGroup, Selection
from pbdkit.experiment.motions import Rotation
from pbdkit.interfaces.frame import Indices
from pbdkit.scene.raster import FOLLOWER, LEADER, Raster

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Leading:
    """A leader group with the rows, places and reference positions (particle, axis) of its
    particles."""

    group: LeaderGroup
    rows: Indices
    place: Indices
    reference: Floats


def build_leading(
    raster: Raster, groups: Iterable[LeaderGroup], steps: int, *, at_rest: bool = True
) -> tuple[Leading, ...]:
    """Every group with its particles.

    Raises ExperimentError for a group that selects nobody or a frame point, and for groups that
    move one particle differently in the same step.
    """
    found = []
    for n, group in enumerate(groups):
        rows = select(raster, group.select, ("leaders", n, "select"))
        _refuse_infinite(group, raster.reference(rows), steps, ("leaders", n, "motion"))
        found.append(Leading(group, rows, raster.place_of(rows), raster.reference(rows)))
    for n, later in enumerate(found):
        for k, earlier in enumerate(found[:n]):
            if _known_beforehand(earlier.group, later.group, at_rest):
                _refuse_contradiction(raster, (k, earlier), (n, later), steps)
    return tuple(found)


def kinds_at(raster: Raster, leading: Iterable[Leading], step: int) -> NDArray[np.int8]:
    """(particle,): the kind of every particle during a step; at time 0 that of step 1."""
    kinds = raster.table_kind.copy()
    for leaders in leading:
        if leaders.group.leads(max(step, 1)):
            kinds[leaders.rows] = LEADER
    return kinds


def select(raster: Raster, selection: Selection, where: tuple[str | int, ...]) -> Indices:
    """The rows of the selected body particles, sorted."""
    if selection.edge is not None:
        rows = _edge(raster, selection.edge)
    elif selection.box is not None:
        rows = _box(raster, selection.box)
    elif selection.numbers is not None:
        rows = _numbers(raster, selection.numbers, (*where, "numbers"))
    else:
        rows = _nearest(raster, selection.nearest or ())
    if not len(rows):
        low, high = (np.round(f(raster.reference(raster.body_rows), axis=0), 6).tolist()
                     for f in (np.min, np.max))  # fmt: skip
        raise ExperimentError(f"selects no particle; the body reaches from {low} to {high}", where)
    return np.unique(rows)


def _edge(raster: Raster, edge: str) -> Indices:
    """The body particle of smallest or largest i in every row j, or j in every column i."""
    body = raster.body_rows
    site, axis = raster.site_of(body), 0 if edge in ("left", "right") else 1
    along, line = site[:, axis], np.delete(site, axis, axis=1)
    if edge in ("right", "top"):
        along = -along
    order = np.lexsort((along, *line.T))
    _, first = np.unique(line[order], axis=0, return_index=True)
    return body[order[first]]


def _box(raster: Raster, box: tuple[float, float, float, float]) -> Indices:
    slack = 1e-9 * math.hypot(*raster.lattice.cell().vectors[0])
    low, high = np.array(box[:2]) - slack, np.array(box[2:]) + slack
    body = raster.body_rows
    x = raster.reference(body)
    return body[((x >= low) & (x <= high)).all(axis=1)]


def _numbers(raster: Raster, numbers: tuple[int, ...], where: tuple[str | int, ...]) -> Indices:
    for n, number in enumerate(numbers):
        if number > raster.count:
            raise ExperimentError(
                f"there is no particle {number}; they are numbered 1 to {raster.count}", (*where, n)
            )
        if raster.table_kind[number - 1] != FOLLOWER:
            raise ExperimentError(
                f"particle {number} is a frame point: only body particles can lead", (*where, n)
            )
    return np.array(numbers, np.intp) - 1


def _nearest(raster: Raster, points: Iterable[tuple[float, float]]) -> Indices:
    body = raster.body_rows
    x = raster.reference(body)
    found = []
    for point in points:
        distance = np.hypot(x[:, 0] - point[0], x[:, 1] - point[1])
        ties = distance <= distance.min() * (1 + 1e-9) + 1e-12
        found.append(body[np.argmax(ties)])
    return np.array(found, np.intp)


def _refuse_contradiction(
    raster: Raster, first: tuple[int, Leading], second: tuple[int, Leading], steps: int
) -> None:
    """Compares what two groups prescribe in every step in which both lead one particle."""
    (k, a), (n, b) = first, second
    if b.group.from_ < a.group.from_:
        a, b = b, a
    shared = np.intersect1d(a.rows, b.rows)
    begin, end = b.group.from_, min(a.group.last(steps), b.group.last(steps))
    if not len(shared) or begin > end:
        return
    # b starts where a, which led the particles just before unless both begin together, left them.
    at = raster.reference(shared)
    start = _offset(a.group, begin - 1, at)
    knots = {g.from_ - 1 + n for g in (a.group, b.group) for n in g.motion.knots()}
    near = {step + d for step in (begin, end, *knots) for d in (-1, 0, 1, 2)}
    for step in sorted(step for step in near if begin <= step <= end):
        one, other = _offset(a.group, step, at), start + _offset(b.group, step, at + start)
        differs = np.abs(one - other).max(axis=1) > 1e-12 * max(1.0, np.abs(one).max())
        if differs.any():
            number = shared[np.argmax(differs)] + 1
            raise ExperimentError(
                f"moves particle {number} in step {step} otherwise than leaders.{k} does; "
                "select it in one of them only, or let one end before the other begins",
                ("leaders", n),
            )


def _refuse_infinite(
    group: LeaderGroup, at: Floats, steps: int, where: tuple[str | int, ...]
) -> None:
    last = group.last(steps) - group.from_ + 1
    for n in sorted({1, last, *(k for k in group.motion.knots() if k <= last)}):
        with np.errstate(all="ignore"):  # that it overflows is said below
            finite = n < 1 or np.isfinite(at + group.motion.offset(n, at)).all()
        if not finite:
            raise ExperimentError(f"leaves the finite numbers at its step {n}", where)


def _known_beforehand(a: LeaderGroup, b: LeaderGroup, at_rest: bool) -> bool:
    """Whether it is known where both motions start, or does not matter: it does to rotations."""
    turns = any(isinstance(group.motion, Rotation) for group in (a, b))
    return not turns or (at_rest and min(a.from_, b.from_) == 1)


def _offset(group: LeaderGroup, step: int, start: Floats) -> Floats:
    n = step - group.from_ + 1
    return np.zeros_like(start) + (group.motion.offset(n, start) if n >= 1 else 0.0)
