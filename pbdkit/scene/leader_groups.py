"""Leader groups on a raster: who leads when, and where to."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.experiment.leaders import LeaderGroup, Rotation, Selection
from pbdkit.interfaces.frame import Indices
from pbdkit.scene.raster import FOLLOWER, LEADER, Raster

Floats = NDArray[np.floating[Any]]

SHOWN = 5
"""So many warnings of one kind are given."""


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
    found, body = [], Selecting(raster)
    for n, group in enumerate(groups):
        rows = body.select(group.select, ("leaders", n, "select"))
        at = raster.reference(rows)
        _refuse_infinite(group, at, steps, ("leaders", n, "motion"))
        found.append(Leading(group, rows, raster.place_of(rows), at))
    for k, n in _meeting(found, steps):
        if _known_beforehand(found[k].group, found[n].group, at_rest):
            _refuse_contradiction(raster, (k, found[k]), (n, found[n]), steps)
    return tuple(found)


def _meeting(found: list[Leading], steps: int) -> Iterator[tuple[int, int]]:
    """The pairs of groups that lead a particle in the same step, and not by the same motion."""
    motions: dict[tuple[Any, int], int] = {}
    table = np.array(
        [
            (
                min(g.group.from_, steps + 1),
                g.group.last(steps),
                g.rows[0],
                g.rows[-1],
                motions.setdefault((g.group.motion, g.group.from_), len(motions)),
            )
            for g in found
        ]
    ).reshape(-1, 5)
    rows = [set(g.rows.tolist()) for g in found] if len(found) > 1 else []
    for n, (begin, end, low, high, motion) in enumerate(table):
        others = table[:n]
        near = (others[:, 0] <= end) & (begin <= others[:, 1]) & (others[:, 4] != motion)
        near &= (others[:, 2] <= high) & (low <= others[:, 3])
        yield from (
            (k, n) for k in np.flatnonzero(near).tolist() if not rows[k].isdisjoint(rows[n])
        )


def doubts(raster: Raster, groups: Iterable[LeaderGroup]) -> list[str]:
    """Warnings about groups that lead others than was meant."""
    body, found = Selecting(raster), []
    for n, group in enumerate(groups):
        for point in body.far(group.select.nearest or ()):
            x, y = raster.reference(body.nearest([point]))[0]
            found.append(
                f"leaders.{n}.select.nearest: ({point[0]:g}, {point[1]:g}) lies far from the body; "
                f"the particle that leads is at ({x:.6g}, {y:.6g})"
            )
    return found[:SHOWN]


def kinds_at(raster: Raster, leading: Iterable[Leading], step: int) -> NDArray[np.int8]:
    """(particle,): the kind of every particle during a step; at time 0 that of step 1."""
    kinds = raster.table_kind.copy()
    for leaders in leading:
        if leaders.group.leads(max(step, 1)):
            kinds[leaders.rows] = LEADER
    return kinds


@dataclass(frozen=True)
class Selecting:
    """Chooses body particles of a raster; what it looks at is made once."""

    raster: Raster

    @cached_property
    def _body(self) -> Indices:
        return self.raster.body_rows

    def far(self, points: Iterable[tuple[float, float]]) -> Iterator[tuple[float, float]]:
        """The points that lie outside the body by more than the cell is wide."""
        width = max(math.hypot(*v) for v in self.raster.lattice.cell().vectors)
        return (p for p in points if not np.hypot(*(self._x - p).T).min() <= width)

    @cached_property
    def _x(self) -> Floats:
        return self.raster.reference(self._body)

    def select(self, selection: Selection, where: tuple[str | int, ...]) -> Indices:
        """The rows of the selected body particles, sorted."""
        if selection.edge is not None:
            rows = self._edge(selection.edge)
        elif selection.box is not None:
            rows = self._box(selection.box)
        elif selection.numbers is not None:
            rows = _numbers(self.raster, selection.numbers, (*where, "numbers"))
        else:
            rows = self.nearest(selection.nearest or ())
        if not len(rows):
            low, high = (np.round(f(self._x, axis=0), 6).tolist() for f in (np.min, np.max))
            text = f"selects no particle; the body reaches from {low} to {high}"
            raise ExperimentError(text, where)
        return np.unique(rows)

    def _edge(self, edge: str) -> Indices:
        """The body particle of smallest or largest i in every row j, or j in every column i."""
        site, axis = self.raster.site_of(self._body), 0 if edge in ("left", "right") else 1
        along, line = site[:, axis], np.delete(site, axis, axis=1)
        if edge in ("right", "top"):
            along = -along
        order = np.lexsort((along, *line.T))
        _, first = np.unique(line[order], axis=0, return_index=True)
        return self._body[order[first]]

    def _box(self, box: tuple[float, float, float, float]) -> Indices:
        slack = 1e-9 * _spacing(self.raster)
        low, high = np.array(box[:2]) - slack, np.array(box[2:]) + slack
        return self._body[((self._x >= low) & (self._x <= high)).all(axis=1)]

    def nearest(self, points: Iterable[tuple[float, float]]) -> Indices:
        """The row of the particle nearest to each point, the lowest number on ties."""
        found = []
        for point in points:
            distance = np.hypot(*(self._x - point).T)
            ties = distance <= distance.min() * (1 + 1e-9) + 1e-12 * _spacing(self.raster)
            found.append(self._body[np.argmax(ties)])
        return np.array(found, np.intp)


def _spacing(raster: Raster) -> float:
    return math.hypot(*raster.lattice.cell().vectors[0])


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
        differs = np.abs(one - other).max(axis=1) > 1e-12 * max(_spacing(raster), np.abs(one).max())
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
