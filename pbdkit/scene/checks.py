"""What a user is warned of where a scene can be built and may not be what was meant."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import compress, islice
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import AccuracyWarning, WarningText
from pbdkit.lattice.fill import has_narrow_slot
from pbdkit.lattice.neighbourhood import Neighbourhood, body_box, flatness
from pbdkit.lattice.raster import FOLLOWER, LeftOut, Raster, cells_of_sites, positions
from pbdkit.model.experiment import Experiment
from pbdkit.model.motions import Newton, Oscillation, Rotation
from pbdkit.plugin import Lattice, MixesCells
from pbdkit.plugin.fields import ByRegion
from pbdkit.plugin.rule import material_of
from pbdkit.scene.constants import signed_distance
from pbdkit.scene.selection import Selecting

if TYPE_CHECKING:
    from pbdkit.scene.leaders import Leading
    from pbdkit.scene.loads import Loads
    from pbdkit.scene.obstacles import Barrier


MANY = 1000
"""Equilibria of one run beyond which it is likely that fewer are wanted."""
FLAT = 0.05
"""Cells flatter than this are warned of."""
FAR, SHOWN = 2.0, 5
"""So many spacings from the body a point is warned of, and so many of them are named."""
ANGLE, ROUNDING, DECIMALS = math.pi / 12, 1e-3, 2
"""Of this multiples are written as radians, to that many digits; degrees are written with fewer."""

LOCKING, NOTICED = 0.07, 0.05
"""A body of n cells across is too stiff by about this share of the shear stiffness over the least
stiffness of its cells, over n, where that is of a stretch along one axis with a squeeze along the
other; from what share on it is warned of."""


def doubts_of(
    experiment: Experiment, neighbourhood: Neighbourhood, raster: Raster, layers: int
) -> list[str]:
    """A line each, on the lattice, who is whose neighbour, and the frame of a body."""
    doubts, frame, rule = [], experiment.frame, experiment.rule
    if (flat := flatness(neighbourhood.cell)) < FLAT:
        doubts.append(
            f"lattice: nearly degenerate, sites lie {1 / flat:.3g} times closer along one line "
            "than its longer cell vector is long, so that neighbours by distance lie along that "
            "line; take chebyshev neighbours, or open the angle between the vectors"
        )
    if not neighbourhood.spans_space():
        doubts.append(
            "neighbours: they lie along one line only, so that rows do not feel each other; "
            "more shells, or chebyshev neighbours, connect them"
        )
    if layers and raster.communicator.any(has_narrow_slot(raster.sites == FOLLOWER, layers)):
        doubts.append(
            f"body: a slot is narrower than {2 * layers + 1} sites, so that frame points in it "
            "belong to both faces; widen it, or take fewer layers"
        )
    if not frame.edges_are_free and material_of(rule) is not None:
        doubts.append(
            WarningText(
                f"frame: under '{frame.type}' edges are not free of stress, and with the "
                f"calibrated rule '{rule.type}' the result does not converge to elasticity, "
                "however fine the lattice (copying frames err by 6.7 % on a bar in tension, "
                "14.5 % on a cantilever); take {type: natural}",
                AccuracyWarning,
            )
        )
    return doubts


def narrow_voids(lattice: Lattice, left_out: LeftOut) -> Iterator[str]:
    """A line where cells are left out because they would connect the two sides of a void."""
    if left_out.first is not None:
        cell = lattice.cell()
        at = positions(cell, *cells_of_sites(cell, *(np.array([n]) for n in left_out.first)))
        x, y = (float(c[0]) + origin for c, origin in zip(at, lattice.origin, strict=True))
        cells = "a cell is" if left_out.count == 1 else f"{left_out.count} cells are"
        yield (
            f"body: {cells} left out, near ({x:.6g}, {y:.6g}) first, where a void is less than two "
            "cells wide: they would connect both of its sides; take a finer lattice, so that two "
            "cells lie across the void, or for a crack without width `cuts`"
        )


def locking(experiment: Experiment, raster: Raster) -> Iterator[str]:
    """A line on materials that hardly stretch along the diagonals of the lattice: shear and the sum
    of both stretches are stiff, their difference is soft, and cells, which resist hourglassing by
    their shear stiffness, cannot bend without the former."""
    rule = experiment.rule
    if not isinstance(rule, MixesCells) or (c := rule.elasticity()) is None:
        return
    values, vectors = np.linalg.eigh([[c.xx, c.xy], [c.xy, c.yy]])
    if vectors[0, 0] * vectors[1, 0] > -0.25:  # no stretch with a squeeze
        return
    sides = [math.hypot(*vector) for vector in raster.lattice.cell().vectors]
    ends = zip(*body_box(raster), sides, strict=True)
    across = max(1.0, min((high - low) / side for low, high, side in ends))
    error = LOCKING * float(c.shear / values[0]) / across
    if error > NOTICED:
        yield WarningText(
            f"rule: '{rule.type}' hardly stretches along the diagonals of the lattice with these "
            f"ratios, so that cells lock: with {across:.3g} of them across the body it may be too "
            f"stiff by some {100 * error:.2g} %; turn the body onto the lattice, so that the stiff "
            "directions of the material lie along its axes, or refine it",
            AccuracyWarning,
        )


def without_effect(experiment: Experiment, raster: Raster) -> Iterator[str]:
    """A line each on what is said and changes nothing: regions, courses, records."""
    fields = [*experiment.rule.varying.values(), *experiment.fracture.varying.values()]
    named = {name for f in fields if isinstance(f, ByRegion) for name, _ in f.values}
    named |= {group.select.region or "" for group in experiment.leaders}
    named |= {load.select.region or "" for load in experiment.loads}
    for name, region in experiment.regions.items():
        cell = experiment.lattice.cell()
        x, y = raster.reference(raster.body_rows).T
        near = max(float(np.hypot(v.x, v.y)) for v in cell.vectors)
        if name not in named:
            yield f"regions.{name}: nothing names it, so that it changes nothing"
        elif not raster.communicator.any((signed_distance(region, cell, x, y) <= near).any()):
            yield f"regions.{name}: lies outside of the body, so that it changes nothing"
    for place, course in experiment.courses.items():
        if course.bends and course.bends[-1] > experiment.steps:
            yield (
                f"{'.'.join(place)}: changes until step {course.bends[-1]}, and the run ends with "
                f"step {experiment.steps}"
            )
    if not experiment.solver.makes_steps and experiment.record_count > MANY:
        yield (
            f"record: {experiment.record_count} equilibria are found and recorded; `every` or `at` "
            "names fewer steps"
        )


def carried_by_leaders(
    raster: Raster, leading: Sequence[Leading], loads: Loads | None, steps: int
) -> Iterator[str]:
    """A line for each load all of whose particles lead along it whenever it acts."""
    for n, loading in enumerate(loads.each if loads else ()):
        load = loading.load
        along = np.flatnonzero(load.force_at(max(load.from_, 1))).tolist()
        free = dict.fromkeys(along, np.ones(len(loading.rows), bool))
        for group in leading:
            if group.group.from_ <= load.from_ and group.group.last(steps) >= load.last(steps):
                for axis in free.keys() & {*group.axes}:
                    free[axis] = free[axis] & ~np.isin(loading.rows, group.rows)
        if along and not raster.communicator.any(any(each.any() for each in free.values())):
            yield f"loads.{n}: acts on leaders alone, which carry it, so that it moves nothing"


def never_near(
    raster: Raster, barriers: Sequence[Barrier], leading: Sequence[Leading], steps: int
) -> Iterator[str]:
    """A line for each obstacle that stays farther from the body than leaders could turn and move
    it."""
    driven: list[Leading | Barrier] = [*barriers, *leading]
    if any(isinstance(one.group.motion, Newton | Rotation) for one in driven):
        return
    box = np.array(body_box(raster)) + raster.lattice.origin if barriers else np.zeros((2, 2))
    ways = [np.abs(way).max(initial=0.0) for one in leading for way in _ways(one, steps)]
    reach = 2.0 * max(ways, default=0.0) + float(np.hypot(*(box[1] - box[0])))
    for n, barrier in enumerate(barriers):
        moves = np.concatenate(_ways(barrier, steps))
        low, high = barrier.start.box[:2], barrier.start.box[2:]
        gaps = [low + moves.min(axis=0) - box[1], box[0] - high - moves.max(axis=0)]
        if np.max(gaps) > reach:
            yield (
                f"obstacles.{n}: stays farther from the body than that is large, so that it "
                "changes nothing"
            )


def _ways(driven: Leading | Barrier, steps: int) -> list[NDArray[Any]]:
    """(particle or 1, axis) by which a motion is away from its start, at the moments between which
    it changes as one formula."""
    motion, last = driven.group.motion, driven.group.last(steps) - driven.group.from_ + 1
    if isinstance(motion, Oscillation):
        return [np.array([motion.amplitude]), -np.array([motion.amplitude])]
    moments = [n for n in (*motion.knots(), last) if 1 <= n <= last]
    offsets = [np.zeros((1, driven.reference.shape[1]))]
    return [*offsets, *(np.atleast_2d(motion.offset(n, driven.reference)) for n in moments)]


def far_from_the_body(experiment: Experiment, raster: Raster) -> Iterator[str]:
    """A line each, for the first few, on points of `nearest` that no particle is near."""
    selections = {f"leaders.{n}": group.select for n, group in enumerate(experiment.leaders)}
    selections |= {f"loads.{n}": load.select for n, load in enumerate(experiment.loads)}
    points = [(name, at) for name, select in selections.items() for at in select.nearest or ()]
    body = Selecting(raster)
    limit = FAR * max(math.hypot(*vector) for vector in raster.lattice.cell().vectors)
    far = body.least_distances(at for _, at in points) > limit
    for name, (x, y) in islice(compress(points, far), SHOWN):
        rows = body.nearest([(x, y)])
        own = (raster.before + rows[0] + 1, *raster.reference(rows)[0]) if len(rows) else None
        number, at_x, at_y = raster.communicator.first(own)
        yield (
            f"{name}.select.nearest: ({x:g}, {y:g}) lies {math.hypot(x - at_x, y - at_y):.4g} away "
            f"from the body; the particle nearest to it is {number}, at ({at_x:.6g}, {at_y:.6g})"
        )


def angles_in_radians(experiment: Experiment) -> Iterator[str]:
    """A line each on angles, or turns in all, that are round in radians; degrees are asked for."""
    found = {}
    if (angle := getattr(experiment.lattice, "angle", None)) is not None:
        found["lattice.angle"] = angle, angle
    for part, driven in (("leaders", experiment.leaders), ("obstacles", experiment.obstacles)):
        for n, one in enumerate(driven):
            if isinstance(one.motion, Rotation):
                whole = one.motion.angle * one.motion.steps
                found[f"{part}.{n}.motion.angle"] = one.motion.angle, whole
    for name, (angle, whole) in found.items():
        if round_in_radians(angle) or round_in_radians(whole):
            yield (
                f"{name}: {angle:g} degrees look like radians, which would be "
                f"{math.degrees(angle):.6g} degrees; angles are in degrees"
            )


def round_in_radians(angle: float) -> bool:
    """Whether it is a multiple of 15°, up to a full turn, written in radians: 0.7854, not 2.88."""
    turns = round(abs(angle) / ANGLE)
    near = abs(abs(angle) - turns * ANGLE) <= ROUNDING
    return 0 < turns <= 24 and near and round(angle, DECIMALS) != round(angle, 9)
