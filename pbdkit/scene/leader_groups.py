"""Leader groups on a raster.

A group prescribes the motion of its particles along all axes or along some of them. Particles with
prescribed motion along some axes and free motion along the others (rollers) are called guided.
Leaders can also have prescribed directions.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats, Indices, Mask
from pbdkit.errors import ExperimentError, PluginError
from pbdkit.lattice.raster import FOLLOWER, LEADER, Raster, Restriction, distinct
from pbdkit.model.boundary_conditions import LeaderGroup
from pbdkit.model.experiment import Experiment
from pbdkit.model.motions import Measured, Newton, Rotation
from pbdkit.plugin import TurnsParticles
from pbdkit.plugin.discovery import errors_attributed_to
from pbdkit.plugin.rule import shares_particles
from pbdkit.scene.constants import particle_numbers
from pbdkit.scene.selection import Selecting, shares_of, spacing


def rotations_of(experiment: Experiment) -> tuple[tuple[int, int], ...]:
    """Return, for each rotation, the indices of its cosine and its sine among the state variables
    of the rule.

    Raises
    ------
    PluginError
        If the rule has no state variable of that name, or the variable is constant.
    """
    rule = experiment.rule
    if not isinstance(rule, TurnsParticles):
        return ()
    with errors_attributed_to(rule, "to return its rotations", "rule"):
        pairs = rule.rotations()
    changing = {n.name: m for m, n in enumerate(particle_numbers(experiment)) if n.changes}
    for name in (name for pair in pairs for name in pair):
        if name not in changing:
            raise PluginError(
                f"'{rule.type}' has '{name}' in `rotations`, but `remembered` declares no variable "
                "number of that name"
            )
    return tuple((changing[cosine], changing[sine]) for cosine, sine in pairs)


def check_directions(experiment: Experiment, *, has_frame: bool) -> None:
    """Check that the rule has the state variables that the experiment requires.

    Raises
    ------
    ExperimentError
        If a rule that reads the state variables of neighbours is combined with frame points or
        broken bonds, because frame points and fictitious points have no state variables. Also if
        leaders are clamped under a rule without directions.
    """
    rule = experiment.rule
    if shares_particles(rule):
        for clash, part, points in (
            (has_frame, "frame", "frame points"),
            (experiment.fracture.can_break, "fracture", "fictitious points of broken bonds"),
        ):
            if clash:
                raise ExperimentError(
                    f"'{rule.type}' uses the state variables of neighbours, which {points} do "
                    f"not have; use {part}: {{type: none}}",
                    (part,),
                )
    for n, group in enumerate(experiment.leaders):
        if group.clamped and not rotations_of(experiment):
            raise ExperimentError(
                f"with '{rule.type}' particles have no directions that can be clamped; remove "
                "`clamped`",
                ("leaders", n, "clamped"),
            )


@dataclass(frozen=True)
class Leading:
    """Leader group with its particles.

    Parameters
    ----------
    group
        The group in the experiment.
    rows, place
        Rows and flat places of its particles.
    reference
        Reference positions, (particle, axis).
    axes
        Indices of the axes along which the group prescribes the motion.
    share
        Fraction of the force on the group that acts on each particle. It is used if the group moves
        by Newton's law.
    """

    group: LeaderGroup
    rows: Indices
    place: Indices
    reference: Floats
    axes: tuple[int, ...]
    share: Floats | None = None

    def is_in(self, to: Restriction) -> Mask:
        """Return a mask of the particles that lie in a part of the lattice. If the group moves by
        Newton's law, only particles with all their neighbours are included, since the forces of the
        neighbours are needed."""
        return (to.is_present if self.share is None else to.is_moving)(self.place)

    def restrict(self, to: Restriction) -> Leading:
        """Return the group restricted to the particles of some rows."""
        is_in = self.is_in(to)
        return replace(
            self,
            rows=to.rows(self.rows[is_in]),
            place=to.places(self.place[is_in]),
            reference=self.reference[is_in],
            share=None if self.share is None else self.share[is_in],
        )

    def offset(self, n: float) -> Floats:
        """Return the displacement of the motion along the prescribed axes, (particle or 1,
        axis)."""
        offset = np.atleast_2d(self.group.motion.offset(n, self.reference))
        return np.asarray(offset[:, list(self.axes)])


def build_leading(raster: Raster, experiment: Experiment) -> tuple[Leading, ...]:
    """Find the particles of every leader group.

    Raises
    ------
    ExperimentError
        If a group selects no particle or a frame point, or if two groups prescribe different
        motions of one particle in the same step.
    """
    groups: list[Leading] = []
    body, steps = Selecting(raster, experiment.regions), experiment.steps
    for n, group in enumerate(experiment.leaders):
        rows = body.select(group.select, ("leaders", n, "select"))
        at = raster.reference(rows)
        _refuse_unmeasured(group, at, rows, ("leaders", n, "motion"))
        _refuse_infinite(group, at, steps, ("leaders", n, "motion"))
        axes = tuple("xy".index(axis) for axis in group.axes or ()) or range(at.shape[1])
        share = shares_of(raster, rows) if isinstance(group.motion, Newton) else None
        groups.append(Leading(group, rows, raster.place_of(rows), at, tuple(sorted(axes)), share))
    for k, n in _meeting(groups, steps):
        if _is_comparable(groups[k].group, groups[n].group, experiment.initial.at_rest):
            _refuse_contradiction(raster, groups, k, n, steps)
    return tuple(groups)


def _meeting(leading: list[Leading], steps: int) -> Iterator[tuple[int, int]]:
    """Generate the pairs of groups that prescribe different motions of one particle in the same
    step."""
    groups, rows = [part.group for part in leading], [part.rows for part in leading]
    kinds = {(group.motion, group.from_): n for n, group in enumerate(groups)}
    kind = np.array([kinds[group.motion, group.from_] for group in groups])
    begin = np.array([min(group.from_, steps + 1) for group in groups])
    end = np.array([group.last(steps) for group in groups])
    low, high = (
        np.array([selection[edge] if len(selection) else -1 for selection in rows])
        for edge in (0, -1)
    )
    sets = [set(selection.tolist()) for selection in rows] if len(rows) > 1 else []
    for n in range(1, len(leading)):
        overlaps = (begin[:n] <= end[n]) & (begin[n] <= end[:n]) & (kind[:n] != kind[n])
        overlaps &= (low[:n] <= high[n]) & (low[n] <= high[:n])
        for k in np.flatnonzero(overlaps).tolist():
            shares_axis = not {*leading[k].axes}.isdisjoint(leading[n].axes)
            if shares_axis and not sets[k].isdisjoint(sets[n]):
                yield k, n


def kinds_at(raster: Raster, leading: Iterable[Leading], step: int) -> NDArray[np.int8]:
    """Return the kind of every particle during a step, (particle,). At time 0, it is the kind
    during step 1."""
    kinds = raster.table_kind.copy()
    for leaders in leading:
        if leaders.group.leads(max(step, 1)):
            kinds[leaders.rows] = LEADER
    return kinds


def _refuse_contradiction(
    raster: Raster, groups: list[Leading], k: int, n: int, steps: int
) -> None:
    """Compare the motions of groups k and n in every step in which both prescribe the motion of a
    common particle."""
    a, b = sorted((groups[k], groups[n]), key=lambda leading: leading.group.from_)
    shared = np.intersect1d(a.rows, b.rows)
    begin, end = b.group.from_, min(a.group.last(steps), b.group.last(steps))
    # Motion b starts from the positions at the end of motion a, unless both motions start at the
    # same time.
    at = raster.reference(shared)
    start = _offset(a.group, begin - 1, at)
    knots = {g.from_ - 1 + n for g in (a.group, b.group) for n in g.motion.knots()}
    candidates = {step + d for step in (begin, end, *knots) for d in (-1, 0, 1, 2)}
    axes = sorted({*a.axes} & {*b.axes})
    for step in sorted(step for step in candidates if begin <= step <= end):
        origin = at if b.group.motion.of_reference else at + start
        first, second = _offset(a.group, step, at), start + _offset(b.group, step, origin)
        differs = np.abs(first - second)[:, axes].max(axis=1) > 1e-12 * max(
            spacing(raster), np.abs(first).max()
        )
        if differs.any():
            number = shared[np.argmax(differs)] + 1
            raise ExperimentError(
                f"moves particle {number} in step {step} differently from leaders.{k}; "
                "select it in one group only, or end one motion before the other begins",
                ("leaders", n),
            )


def _refuse_unmeasured(
    group: LeaderGroup, at: Floats, rows: Indices, where: tuple[str | int, ...]
) -> None:
    if not isinstance(group.motion, Measured):
        return
    try:
        outside = np.flatnonzero(np.isnan(group.motion.at(at)).any(axis=1))
    except RuntimeError as error:  # Raised by Qhull.
        text = f"the points cannot be triangulated: {str(error).strip().splitlines()[0]}"
        raise ExperimentError(text, where) from None
    if len(outside):
        x, y = at[outside[0]]
        raise ExperimentError(
            f"{len(outside)} of {len(rows)} particles lie outside the measured points, the first "
            f"is number {rows[outside[0]] + 1} at ({x:.6g}, {y:.6g}); extend the measurement, or "
            "select fewer particles",
            where,
        )


def _refuse_infinite(
    group: LeaderGroup, at: Floats, steps: int, where: tuple[str | int, ...]
) -> None:
    last = group.last(steps) - group.from_ + 1
    for n in sorted({1, last, *(k for k in group.motion.knots() if k <= last)}):
        with np.errstate(all="ignore"):  # Overflow is reported below.
            finite = n < 1 or np.isfinite(at + group.motion.offset(n, at)).all()
        if not finite:
            raise ExperimentError(
                f"the displacement at step {n} of the motion is not finite; reduce it", where
            )


def _is_comparable(a: LeaderGroup, b: LeaderGroup, at_rest: bool) -> bool:
    """Return whether two motions can be compared before the run.

    Rotations depend on the positions at their start, which must be known before the run. Motions by
    Newton's law are never known before the run.
    """
    if any(isinstance(group.motion, Newton) for group in (a, b)):
        return False
    turns = any(isinstance(group.motion, Rotation) for group in (a, b))
    latest = max if a.axes or b.axes else min  # Positions along the free axes of a are unknown.
    return not turns or (at_rest and latest(a.from_, b.from_) == 1)


def _offset(group: LeaderGroup, step: int, start: Floats) -> Floats:
    n = step - group.from_ + 1
    return np.zeros_like(start) + (group.motion.offset(n, start) if n >= 1 else 0.0)


@dataclass(frozen=True)
class Guided:
    """Guided particles of a step. They have prescribed motion along some axes and free motion along
    the others.

    Parameters
    ----------
    rows, place
        Rows, sorted, and flat places of the particles.
    lead_axes
        Mask of the axes along which the motion of each particle is prescribed, (axis, particle).
    """

    rows: Indices
    place: Indices
    lead_axes: Mask

    def is_led(self, raster: Raster) -> Mask:
        """Return a mask of the prescribed components of guided particles, (axis, flat place)."""
        mask = np.zeros((len(self.lead_axes), raster.kind.size), bool)
        mask[:, self.place] = self.lead_axes
        return mask


def has_guides(leading: Iterable[Leading]) -> bool:
    """Return whether some group prescribes the motion along some axes only, so that particles can
    be guided."""
    return any(len(group.axes) < group.reference.shape[1] for group in leading)


def guided_at(raster: Raster, leading: Iterable[Leading], step: int) -> Guided:
    """Return the guided particles of a step. If several groups prescribe the motion of a particle
    along different axes, all these axes are included."""
    active = [group for group in leading if group.group.leads(step)]
    axes = len(raster.cell.vectors)
    parts = [group.rows for group in active if len(group.axes) < axes]
    if not parts:
        empty = np.empty(0, np.intp)
        return Guided(empty, empty, np.empty((axes, 0), bool))
    rows = distinct(np.concatenate(parts))
    lead_axes = np.zeros((axes, len(rows)), bool)
    for group in active:
        lead_axes[list(group.axes)] |= np.isin(rows, group.rows)
    free = ~lead_axes.all(axis=0)
    return Guided(rows[free], raster.place_of(rows[free]), lead_axes[:, free])


def kinds_of_places(raster: Raster, leading: Iterable[Leading], step: int) -> NDArray[np.int8]:
    """Return the kinds of flat places during a step; guided particles count as followers."""
    kind = raster.kind.ravel().copy()
    groups = tuple(leading)
    for group in groups:
        if group.group.leads(step):
            kind[group.place] = LEADER
    if has_guides(groups):
        kind[guided_at(raster, groups, step).place] = FOLLOWER
    return kind
