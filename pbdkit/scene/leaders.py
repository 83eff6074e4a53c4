"""Leader groups on a raster: who leads when and along which axes, guided particles (rollers) that
lead along some axes and follow along the others, and prescribed directions.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError, PluginError
from pbdkit.lattice.raster import FOLLOWER, LEADER, Floats, Mask, Raster, distinct
from pbdkit.model.boundary_conditions import LeaderGroup
from pbdkit.model.experiment import Experiment
from pbdkit.model.motions import Measured, Newton, Rotation
from pbdkit.plugin import TurnsParticles
from pbdkit.plugin.discovery import blaming
from pbdkit.plugin.frame import Indices
from pbdkit.plugin.rule import shares_particles
from pbdkit.scene.constants import particle_numbers
from pbdkit.scene.selection import Selecting, shares_of, spacing


def rotations_of(experiment: Experiment) -> tuple[tuple[int, int], ...]:
    """Of each rotation that the rule remembers, the places of cosine and sine among its numbers.

    Raises PluginError for a name that is not remembered, or of a number that does not change.
    """
    rule = experiment.rule
    if not isinstance(rule, TurnsParticles):
        return ()
    with blaming(rule, "when asked for its rotations", "rule"):
        pairs = rule.rotations()
    changing = {n.name: m for m, n in enumerate(particle_numbers(experiment)) if n.changes}
    for name in (name for pair in pairs for name in pair):
        if name not in changing:
            raise PluginError(
                f"'{rule.type}' names '{name}' in `rotations`, which it does not remember as a "
                "number that changes"
            )
    return tuple((changing[cosine], changing[sine]) for cosine, sine in pairs)


def check_directions(experiment: Experiment, *, has_frame: bool) -> None:
    """Raises ExperimentError where neighbours would have to show what they do not remember, and
    where leaders are clamped that have no directions."""
    rule = experiment.rule
    if shares_particles(rule):
        for unfit, part, who in (
            (has_frame, "frame", "frame points do"),
            (experiment.fracture.can_break, "fracture", "the points in place of broken bonds do"),
        ):
            if unfit:
                raise ExperimentError(
                    f"with '{rule.type}' neighbours see what is remembered of each other, and "
                    f"{who} not remember; take {part}: {{type: none}}",
                    (part,),
                )
    for n, group in enumerate(experiment.leaders):
        if group.clamped and not rotations_of(experiment):
            raise ExperimentError(
                f"with '{rule.type}' particles have no directions that could be clamped; leave "
                "clamped out",
                ("leaders", n, "clamped"),
            )


@dataclass(frozen=True)
class Leading:
    """A leader group with the rows, places and reference positions (particle, axis) of its
    particles, the numbers of the axes along which it leads and, where it moves by Newton's law, the
    `share` of the force in all that falls to each particle."""

    group: LeaderGroup
    rows: Indices
    place: Indices
    reference: Floats
    axes: tuple[int, ...]
    share: Floats | None = None

    def offset(self, n: float) -> Floats:
        """Of the motion from rest, (particle or 1, axis along which the group leads)."""
        offset = np.atleast_2d(self.group.motion.offset(n, self.reference))
        return np.asarray(offset[:, list(self.axes)])


def build_leading(raster: Raster, experiment: Experiment) -> tuple[Leading, ...]:
    """Every group with its particles.

    Raises ExperimentError for a group that selects nobody or a frame point, and for groups that
    move one particle differently in the same step.
    """
    found: list[Leading] = []
    body, steps = Selecting(raster, experiment.regions), experiment.steps
    for n, group in enumerate(experiment.leaders):
        rows = body.select(group.select, ("leaders", n, "select"))
        at = raster.reference(rows)
        _refuse_unmeasured(group, at, rows, ("leaders", n, "motion"))
        _refuse_infinite(group, at, steps, ("leaders", n, "motion"))
        axes = tuple("xy".index(axis) for axis in group.axes or ()) or range(at.shape[1])
        share = shares_of(raster, rows) if isinstance(group.motion, Newton) else None
        found.append(Leading(group, rows, raster.place_of(rows), at, tuple(sorted(axes)), share))
    for k, n in _meeting(found, steps):
        if _known_beforehand(found[k].group, found[n].group, experiment.initial.at_rest):
            _refuse_contradiction(raster, found, k, n, steps)
    return tuple(found)


def _meeting(found: list[Leading], steps: int) -> Iterator[tuple[int, int]]:
    """The pairs of groups that lead a particle in the same step, and not by the same motion."""
    groups, rows = [leading.group for leading in found], [leading.rows for leading in found]
    kinds = {(group.motion, group.from_): n for n, group in enumerate(groups)}
    kind = np.array([kinds[group.motion, group.from_] for group in groups])
    begin = np.array([min(group.from_, steps + 1) for group in groups])
    end = np.array([group.last(steps) for group in groups])
    low, high = (np.array([some[edge] if len(some) else -1 for some in rows]) for edge in (0, -1))
    sets = [set(some.tolist()) for some in rows] if len(rows) > 1 else []
    for n in range(1, len(found)):
        near = (begin[:n] <= end[n]) & (begin[n] <= end[:n]) & (kind[:n] != kind[n])
        near &= (low[:n] <= high[n]) & (low[n] <= high[:n])
        for k in np.flatnonzero(near).tolist():
            alike = not {*found[k].axes}.isdisjoint(found[n].axes)
            if alike and not sets[k].isdisjoint(sets[n]):
                yield k, n


def kinds_at(raster: Raster, leading: Iterable[Leading], step: int) -> NDArray[np.int8]:
    """(particle,): the kind of every particle during a step; at time 0 that of step 1."""
    kinds = raster.table_kind.copy()
    for leaders in leading:
        if leaders.group.leads(max(step, 1)):
            kinds[leaders.rows] = LEADER
    return kinds


def _refuse_contradiction(raster: Raster, found: list[Leading], k: int, n: int, steps: int) -> None:
    """Compares what groups k and n prescribe in every step in which both lead one particle."""
    a, b = sorted((found[k], found[n]), key=lambda leading: leading.group.from_)
    shared = np.intersect1d(a.rows, b.rows)
    begin, end = b.group.from_, min(a.group.last(steps), b.group.last(steps))
    # b starts where a, which led the particles just before unless both begin together, left them.
    at = raster.reference(shared)
    start = _offset(a.group, begin - 1, at)
    knots = {g.from_ - 1 + n for g in (a.group, b.group) for n in g.motion.knots()}
    near = {step + d for step in (begin, end, *knots) for d in (-1, 0, 1, 2)}
    axes = sorted({*a.axes} & {*b.axes})
    for step in sorted(step for step in near if begin <= step <= end):
        moved = at if b.group.motion.of_reference else at + start
        one, other = _offset(a.group, step, at), start + _offset(b.group, step, moved)
        differs = np.abs(one - other)[:, axes].max(axis=1) > 1e-12 * max(
            spacing(raster), np.abs(one).max()
        )
        if differs.any():
            number = shared[np.argmax(differs)] + 1
            raise ExperimentError(
                f"moves particle {number} in step {step} otherwise than leaders.{k} does; "
                "select it in one of them only, or let one end before the other begins",
                ("leaders", n),
            )


def _refuse_unmeasured(
    group: LeaderGroup, at: Floats, rows: Indices, where: tuple[str | int, ...]
) -> None:
    if not isinstance(group.motion, Measured):
        return
    try:
        outside = np.flatnonzero(np.isnan(group.motion.at(at)).any(axis=1))
    except RuntimeError as error:  # of Qhull
        text = f"no triangles can be put between the points: {str(error).strip().splitlines()[0]}"
        raise ExperimentError(text, where) from None
    if len(outside):
        x, y = at[outside[0]]
        raise ExperimentError(
            f"{len(outside)} of {len(rows)} particles lie outside the measured points, the first "
            f"is number {rows[outside[0]] + 1} at ({x:.6g}, {y:.6g}); measure farther out, or "
            "select fewer",
            where,
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
    """Whether it is known where both motions start, or does not matter: it does to rotations; and
    of masses nothing is known."""
    if any(isinstance(group.motion, Newton) for group in (a, b)):
        return False
    turns = any(isinstance(group.motion, Rotation) for group in (a, b))
    latest = max if a.axes or b.axes else min  # where a particle follows along an axis is not known
    return not turns or (at_rest and latest(a.from_, b.from_) == 1)


def _offset(group: LeaderGroup, step: int, start: Floats) -> Floats:
    n = step - group.from_ + 1
    return np.zeros_like(start) + (group.motion.offset(n, start) if n >= 1 else 0.0)


@dataclass(frozen=True)
class Guided:
    """The guided particles of a step by row and flat place, sorted by row; `led` (axis, particle)
    tells along which axes they lead: some, not all."""

    rows: Indices
    place: Indices
    led: Mask

    def is_led(self, raster: Raster) -> Mask:
        """(axis, flat place): the components that they lead; no others' are."""
        found = np.zeros((len(self.led), raster.kind.size), bool)
        found[:, self.place] = self.led
        return found


def has_guides(leading: Iterable[Leading]) -> bool:
    """Whether anybody may be guided."""
    return any(len(each.axes) < each.reference.shape[1] for each in leading)


def guided_at(raster: Raster, leading: Iterable[Leading], step: int) -> Guided:
    """Those of a step; groups on different axes of one particle go together."""
    now = [each for each in leading if each.group.leads(step)]
    axes = len(raster.lattice.cell().vectors)
    some = [each.rows for each in now if len(each.axes) < axes]
    rows = distinct(np.concatenate(some)) if some else np.empty(0, np.intp)
    led = np.zeros((axes, len(rows)), bool)
    for each in now if some else ():
        led[list(each.axes)] |= np.isin(rows, each.rows)
    free = ~led.all(axis=0)
    return Guided(rows[free], raster.place_of(rows[free]), led[:, free])


def kinds_of_places(raster: Raster, leading: Iterable[Leading], step: int) -> NDArray[np.int8]:
    """The kinds of flat places with the roles of a step; who is guided counts as a follower."""
    kind = raster.kind.ravel().copy()
    every = tuple(leading)
    for each in every:
        if each.group.leads(step):
            kind[each.place] = LEADER
    if has_guides(every):
        kind[guided_at(raster, every, step).place] = FOLLOWER
    return kind
