"""Obstacles on a lattice: where their outlines are when, and who begins inside one."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.experiment.newton import Newton
from pbdkit.experiment.obstacles import Obstacle
from pbdkit.interfaces.frame import Indices
from pbdkit.scene.leader_groups import Leading
from pbdkit.scene.outlines import Floats, Outline, Walls, outline_of
from pbdkit.scene.places import Mask
from pbdkit.scene.raster import Raster

SLACK = 1e-9
"""Of a lattice constant: so far inside a particle may begin, as one on the outline does."""


@dataclass(frozen=True)
class Barrier:
    """An obstacle with the outline that it starts with, in coordinates; `origin` is where the
    lattice's site (0, 0) lies."""

    group: Obstacle
    start: Outline
    origin: Floats

    @property
    def reference(self) -> Floats:
        """The points that its motion moves, (point, axis)."""
        return self.start.points

    def offset(self, n: float) -> Floats:
        """Of the motion, (point or 1, axis)."""
        return np.atleast_2d(self.group.motion.offset(n, self.reference))

    def at(self, moment: float) -> Outline | None:
        """The outline at the end of a step, or at a moment within it, from the lattice's site
        (0, 0); None where the obstacle is not there then."""
        if not self.group.leads(math.ceil(moment)):
            return None
        offset = self.group.motion.offset(moment - self.group.from_ + 1, self.reference)
        return self.start.shifted(offset - self.origin)


def outlines_at(barriers: Sequence[Barrier], moment: float) -> list[tuple[int, Outline]]:
    """Those that are there, with their place among the experiment's obstacles."""
    found = ((n, barrier.at(moment)) for n, barrier in enumerate(barriers))
    return [(n, outline) for n, outline in found if outline is not None]


def build_obstacles(raster: Raster, experiment: Experiment) -> tuple[Barrier, ...]:
    """Every obstacle with its outline.

    Raises ExperimentError in space, for motions that leave the finite numbers, and where a body
    at rest begins inside an obstacle.
    """
    if not experiment.obstacles:
        return ()
    if len(raster.lattice.cell().vectors) != 2:
        raise ExperimentError("obstacles lie in a plane, and the lattice does not", ("obstacles",))
    origin, found = np.array(raster.lattice.origin, float), list[Barrier]()
    for n, obstacle in enumerate(experiment.obstacles):
        barrier = Barrier(obstacle, outline_of(obstacle.shape), origin)
        _refuse_infinite(barrier, experiment.steps, n)
        if obstacle.from_ == 1 and experiment.initial.at_rest:
            _refuse_body_inside(raster, barrier.start, n)
        found.append(barrier)
    return tuple(found)


def _refuse_infinite(barrier: Barrier, steps: int, n: int) -> None:
    group = barrier.group
    last = group.last(steps) - group.from_ + 1
    for k in sorted({1, last, *(k for k in group.motion.knots() if k <= last)}):
        with np.errstate(all="ignore"):  # that it overflows is said below
            finite = k < 1 or np.isfinite(group.motion.offset(k, barrier.reference)).all()
        if not finite:
            where = ("obstacles", n, "motion")
            raise ExperimentError(f"leaves the finite numbers at its step {k}", where)


def _refuse_body_inside(raster: Raster, outline: Outline, n: int) -> None:
    rows = raster.body_rows
    gap = outline.facing(*raster.reference(rows).T)[0]
    if gap.min() < -SLACK * math.hypot(*raster.lattice.cell().vectors[0]):
        worst = int(np.argmin(gap))
        x, y = raster.reference(rows[worst : worst + 1])[0]
        raise ExperimentError(
            f"particle {rows[worst] + 1} at ({x:.6g}, {y:.6g}) begins {-gap[worst]:.3g} inside of "
            "it; let the obstacle begin outside the body and move there, or begin at a later step",
            ("obstacles", n, "shape"),
        )


def collisions(
    raster: Raster, leading: Sequence[Leading], barriers: Sequence[Barrier], steps: int
) -> list[str]:
    """Warnings about leaders that are driven into an obstacle, which does not touch them: as they
    stand where motions change, from rest. Those that move by Newton's law are stopped; guided ones
    may make way along the axis along which they follow."""
    slack = SLACK * math.hypot(*raster.lattice.cell().vectors[0])
    found = []
    for k, led in enumerate(leading):
        if isinstance(led.group.motion, Newton):
            continue
        for n, barrier in enumerate(barriers):
            for step in _moments(led, barrier, steps):
                at = led.reference + led.group.motion.offset(
                    step - led.group.from_ + 1, led.reference
                )
                outline = barrier.at(step)
                assert outline
                places = (at - barrier.origin).T
                gap = outline.facing(*places)[0]
                if len(led.axes) < len(places):
                    gap = np.where(_makes_way(outline, places, led.axes[0]), np.inf, gap)
                deepest = float(raster.others.least(np.array([gap.min(initial=np.inf)]))[0])
                if deepest < -slack:
                    number = raster.others.first(_number(raster, led.rows, gap == deepest))
                    found.append(
                        f"leaders.{k}: drives particle {number} into obstacles.{n} by step {step}; "
                        "obstacles stop followers, not leaders"
                    )
                    break
    return found


def _makes_way(outline: Outline, places: Floats, axis: int) -> Mask:
    """Which places (axis, place) are in free space somewhere along the other axis."""
    walls, found = Walls.of([outline]), np.zeros(places.shape[1], bool)
    with np.errstate(all="ignore"):
        for k, at in enumerate(places.T):
            x, y = at + walls.way_between(at, np.array([1.0, 0.0, 1.0]), axis + 1)
            found[k] = walls.clearance(x, y) >= 0.0
    return found


def _moments(led: Leading, barrier: Barrier, steps: int) -> Iterator[int]:
    """The steps in which both are there, at their ends and where a motion changes."""
    groups = led.group, barrier.group
    begin = max(group.from_ for group in groups)
    end = min(group.last(steps) for group in groups)
    knots = (group.from_ - 1 + k for group in groups for k in group.motion.knots())
    yield from sorted({step for step in (begin, end, *knots) if begin <= step <= end})


def _number(raster: Raster, rows: Indices, those: Mask) -> int | None:
    """That of the first of those, if there is any."""
    return raster.before + int(rows[np.argmax(those)]) + 1 if those.any() else None
