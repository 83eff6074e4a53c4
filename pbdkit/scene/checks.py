"""Warnings about scenes that can be built but may not be what the user intends."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import compress, islice
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import AccuracyWarning, WarningText
from pbdkit.lattice.fill import has_narrow_slot
from pbdkit.lattice.neighbourhood import Neighbourhood, flatness
from pbdkit.lattice.raster import FOLLOWER, OmittedCells, Raster, cells_of_sites, positions
from pbdkit.model.bodies import concave_arcs, discs
from pbdkit.model.experiment import Experiment
from pbdkit.model.motions import Newton, Oscillation, Rotation
from pbdkit.plugin import Lattice, MixesCells, Vector
from pbdkit.plugin.fields import ByRegion
from pbdkit.plugin.rule import material_of
from pbdkit.plugin.units import STRESS, Place, in_lengths
from pbdkit.scene.constants import signed_distance
from pbdkit.scene.selection import Selecting

if TYPE_CHECKING:
    from pbdkit.scene.leader_groups import Leading
    from pbdkit.scene.loads import Loads
    from pbdkit.scene.obstacles import Barrier


MAX_EQUILIBRIA = 1000
"""Number of recorded equilibria above which a warning suggests recording fewer."""
MIN_FLATNESS = 0.05
"""A warning is issued for a cell with a flatness below this number."""
MAX_DISTANCE = 2.0
"""A warning is issued if the distance of a selected point from the body exceeds this number of
lattice spacings."""
MAX_GAUGE_DISTANCE = 1.0
"""A warning is issued if the distance of a point of a diagnostic from the body exceeds this number
of lattice spacings. No point between the particles of a body exceeds it."""
MAX_EXCESS = 2.0
"""A warning is issued if a section is wider than the body by more than this number of lattice
spacings."""
MAX_LISTED = 5
"""Maximum number of distant points listed in warnings."""
ROUND_ANGLE = math.pi / 12
"""Angle in radians. If an angle in an experiment is a multiple of this number, it is assumed to be
given in radians by mistake."""
ROUND_ATOL = 1e-3
"""Tolerance with which multiples of `ROUND_ANGLE` are recognised."""
DECIMALS = 2
"""An angle with at most this number of decimals is assumed to be in degrees."""
LOCKING_FACTOR = 0.07
"""Factor k in the relative excess stiffness in bending, which is about k c_shear / (λ n) for a body
that is n cells thick. λ is the smallest stiffness of a cell, which belongs to a mode that extends
one axis and contracts the other."""
MIN_CELLS = 5
"""Number of lattice constants in a radius below which a warning is issued."""
RADIUS_RTOL = 1e-9
"""Relative tolerance of radii in this comparison."""
MAX_LOCKING = 0.05
"""Relative excess stiffness above which a warning is issued."""


def lattice_warnings(
    experiment: Experiment, neighbourhood: Neighbourhood, raster: Raster, layers: int
) -> list[str]:
    """Return warnings about the lattice, the neighbours and the frame."""
    warnings, frame, rule = [], experiment.frame, experiment.rule
    if (flat := flatness(neighbourhood.cell)) < MIN_FLATNESS:
        warnings.append(
            f"lattice: nearly degenerate, the longer cell vector is {1 / flat:.3g} times the "
            "smallest distance of sites, so that neighbours by distance lie along one line; use "
            "chebyshev neighbours, or increase the angle between the vectors"
        )
    if not neighbourhood.spans_space():
        warnings.append(
            "neighbours: all lie along one line, so that rows are not coupled; "
            "use more shells, or chebyshev neighbours"
        )
    if layers and raster.communicator.any(has_narrow_slot(raster.sites == FOLLOWER, layers)):
        warnings.append(
            f"body: a slot is narrower than {2 * layers + 1} sites, so that frame points in it "
            "belong to both faces; widen it, or use fewer layers"
        )
    if not frame.edges_are_free and material_of(rule) is not None:
        warnings.append(
            WarningText(
                f"frame: under '{frame.type}' edges are not free of stress, and with the "
                f"calibrated rule '{rule.type}' the result does not converge to elasticity under "
                "refinement (the error of copying frames is 6.7 % for a bar in tension, 14.5 % "
                "for a cantilever); use {type: natural}",
                AccuracyWarning,
            )
        )
    return warnings


def narrow_voids(lattice: Lattice, left_out: OmittedCells) -> Iterator[str]:
    """Generate a warning if cells are omitted that would connect the two sides of a void."""
    if left_out.first is not None:
        cell = lattice.cell()
        at = positions(cell, *cells_of_sites(cell, *(np.array([n]) for n in left_out.first)))
        x, y = (float(c[0]) + origin for c, origin in zip(at, lattice.origin, strict=True))
        cells = "a cell is" if left_out.count == 1 else f"{left_out.count} cells are"
        yield (
            f"body: {cells} omitted, the first near ({x:.6g}, {y:.6g}), where a void is less than "
            "two cells wide: they would connect its two sides; use a finer lattice, with two cells "
            "across the void, or `cuts` for a crack of zero width"
        )


def coarse_arcs(experiment: Experiment, raster: Raster) -> Iterator[str]:
    """Generate a warning for each hole, fillet or inclusion with fewer than `MIN_CELLS` lattice
    constants in its radius, if stress at particles is computed with a calibrated rule."""
    rule, variables = experiment.rule, [v for d in experiment.diagnostics for v in d.variables()]
    has_stress = any("particle" in v.dims and v.units == STRESS.lattice for v in variables)
    if not has_stress or material_of(rule) is None:
        return
    fields = [field for field in rule.varying.values() if isinstance(field, ByRegion)]
    names = {name for field in fields for name, _ in field.values}
    arcs = {("body", *arc) for arc in concave_arcs(experiment.body)}
    for name in names & {*experiment.regions}:
        arcs |= {(f"regions.{name}", *arc) for arc in discs(experiment.regions[name])}
    constant = max(math.hypot(*vector) for vector in raster.cell.vectors)
    length, unit = in_lengths(experiment.units)
    for place, shape, radius in sorted(arcs):
        if radius < MIN_CELLS * constant * (1 - RADIUS_RTOL):
            yield WarningText(
                f"{place}: the {shape} of radius {length * radius:.4g} {unit} has "
                f"{radius / constant:.3g} lattice constants in its radius; the stress at its rim "
                f"needs at least {MIN_CELLS}; use a finer lattice (docs/refinement.md)",
                AccuracyWarning,
            )


def locking(
    experiment: Experiment, raster: Raster, box: tuple[Vector[float], Vector[float]]
) -> Iterator[str]:
    """Generate a warning about cells that lock in bending.

    Consider a material that is almost inextensible along the diagonals of the lattice. It is stiff
    in shear and under equal biaxial strain. It is compliant if one axis is extended and the other
    contracted. Bending requires hourglass modes of the cells. The shear stiffness of the cells
    resists these modes (locking).
    """
    rule = experiment.rule
    if not isinstance(rule, MixesCells) or (c := rule.elasticity()) is None:
        return
    values, vectors = np.linalg.eigh([[c.xx, c.xy], [c.xy, c.yy]])
    if vectors[0, 0] * vectors[1, 0] > -0.25:  # The mode is another one.
        return
    sides = [math.hypot(*vector) for vector in raster.cell.vectors]
    ends = zip(*box, sides, strict=True)
    across = max(1.0, min((high - low) / side for low, high, side in ends))
    error = LOCKING_FACTOR * float(c.shear / values[0]) / across
    if error > MAX_LOCKING:
        yield WarningText(
            f"rule: '{rule.type}' hardly extends along the diagonals of the lattice with these "
            f"ratios, so that cells lock: with {across:.3g} cells across, the body may be too "
            f"stiff by about {100 * error:.2g} %; align the stiff directions of the material with "
            "the axes of the lattice, or refine the lattice",
            AccuracyWarning,
        )


def without_effect(experiment: Experiment, raster: Raster) -> Iterator[str]:
    """Generate warnings about regions, time-dependent parameters and records without effect."""
    fields = [*experiment.rule.varying.values(), *experiment.fracture.varying.values()]
    names = {name for f in fields if isinstance(f, ByRegion) for name, _ in f.values}
    names |= {group.select.region or "" for group in experiment.leaders}
    names |= {load.select.region or "" for load in experiment.loads}
    for name, region in experiment.regions.items():
        cell = experiment.lattice.cell()
        x, y = raster.reference(raster.body_rows).T
        tolerance = max(float(np.hypot(v.x, v.y)) for v in cell.vectors)
        if name not in names:
            yield f"regions.{name}: not referenced, so that it has no effect"
        elif not raster.communicator.any((signed_distance(region, cell, x, y) <= tolerance).any()):
            yield f"regions.{name}: lies outside the body, so that it has no effect"
    for place, number in experiment.time_dependent.items():
        if number.breakpoints and number.breakpoints[-1] > experiment.steps:
            yield (
                f"{'.'.join(place)}: changes until step {number.breakpoints[-1]}, but the run ends "
                f"with step {experiment.steps}"
            )
    if not experiment.solver.makes_steps and experiment.record_count > MAX_EQUILIBRIA:
        yield (
            f"record: {experiment.record_count} equilibria are computed and recorded; select fewer "
            "steps with `every` or `at`"
        )


def carried_by_leaders(
    raster: Raster, leading: Sequence[Leading], loads: Loads | None, steps: int
) -> Iterator[str]:
    """Generate a warning for each load that has no effect because all its particles have prescribed
    motion along its direction while it acts."""
    for n, loading in enumerate(loads.each if loads else ()):
        load = loading.load
        along = np.flatnonzero(load.force_at(max(load.from_, 1))).tolist()
        free = dict.fromkeys(along, np.ones(len(loading.rows), bool))
        for group in leading:
            if group.group.from_ <= load.from_ and group.group.last(steps) >= load.last(steps):
                for axis in free.keys() & {*group.axes}:
                    free[axis] = free[axis] & ~np.isin(loading.rows, group.rows)
        if along and not raster.communicator.any(any(mask.any() for mask in free.values())):
            yield f"loads.{n}: acts only on leaders, so that it has no effect on the body"


def never_near(
    raster: Raster, barriers: Sequence[Barrier], leading: Sequence[Leading], steps: int
) -> Iterator[str]:
    """Generate a warning for each obstacle that leaders cannot bring into contact with the body."""
    driven: list[Leading | Barrier] = [*barriers, *leading]
    if any(isinstance(part.group.motion, Newton | Rotation) for part in driven):
        return
    box = np.array(raster.body_box()) + raster.lattice.origin if barriers else np.zeros((2, 2))
    offsets = [offset for group in leading for offset in _offsets(group, steps)]
    largest = max((np.abs(offset).max(initial=0.0) for offset in offsets), default=0.0)
    reach = 2.0 * largest + float(np.hypot(*(box[1] - box[0])))
    for n, barrier in enumerate(barriers):
        moves = np.concatenate(_offsets(barrier, steps))
        low, high = barrier.start.box[:2], barrier.start.box[2:]
        gaps = [low + moves.min(axis=0) - box[1], box[0] - high - moves.max(axis=0)]
        if np.max(gaps) > reach:
            yield (
                f"obstacles.{n}: remains farther from the body than the size of the body, so "
                "that it "
                "has no effect"
            )


def _offsets(driven: Leading | Barrier, steps: int) -> list[NDArray[Any]]:
    """Return the displacements of a motion at its knots, as arrays (particle or 1, axis)."""
    motion, last = driven.group.motion, driven.group.last(steps) - driven.group.from_ + 1
    if isinstance(motion, Oscillation):
        return [np.array([motion.amplitude]), -np.array([motion.amplitude])]
    moments = [n for n in (*motion.knots(), last) if 1 <= n <= last]
    offsets = [np.zeros((1, driven.reference.shape[1]))]
    return [*offsets, *(np.atleast_2d(motion.offset(n, driven.reference)) for n in moments)]


def far_from_the_body(experiment: Experiment, raster: Raster) -> Iterator[str]:
    """Generate a warning for each point of a selection `nearest`, or of a diagnostic, that is far
    from all particles, for at most `MAX_LISTED` points."""
    selections = {f"leaders.{n}": group.select for n, group in enumerate(experiment.leaders)}
    selections |= {f"loads.{n}": load.select for n, load in enumerate(experiment.loads)}
    points = [
        (f"{name}.select.nearest", at, MAX_DISTANCE)
        for name, select in selections.items()
        for at in select.nearest or ()
    ]
    points += [
        (f"diagnostics.{n}.{name}", at, MAX_GAUGE_DISTANCE)
        for n, diagnostic in enumerate(experiment.diagnostics)
        for name, parameter in type(diagnostic).model_fields.items()
        if _holds_places(parameter.annotation)
        for at in getattr(diagnostic, name) or ()
    ]
    if not points:
        return
    body = Selecting(raster)
    spacing = max(math.hypot(*vector) for vector in raster.cell.vectors)
    limits = np.array([limit for *_, limit in points]) * spacing * (1 + RADIUS_RTOL)
    far = body.least_distances(at for _, at, _ in points) > limits
    length, unit = in_lengths(experiment.units)
    after = f" {unit}" if experiment.units else ""
    for name, (x, y), _ in islice(compress(points, far), MAX_LISTED):
        rows = body.nearest([(x, y)])
        nearest = None
        if len(rows):
            nearest = (raster.particle_offset + rows[0] + 1, *raster.reference(rows)[0])
        number, at_x, at_y = raster.communicator.first(nearest)
        yield (
            f"{name}: the distance of ({length * x:g}, {length * y:g}){after} from the body is "
            f"{length * math.hypot(x - at_x, y - at_y):.4g} {unit}; the nearest particle is "
            f"{number}, at ({length * at_x:.6g}, {length * at_y:.6g}){after}"
        )


def _holds_places(annotation: Any) -> bool:
    """Return whether the type of a parameter is a tuple of positions, or contains one."""
    kinds = get_args(annotation)
    return Place in kinds or any(map(_holds_places, kinds))


def wide_sections(
    experiment: Experiment, raster: Raster, box: tuple[Vector[float], Vector[float]]
) -> Iterator[str]:
    """Generate a warning for each diagnostic `stress-strain` with a section that is wider than the
    body, so that its nominal stress is too small."""
    slack = MAX_EXCESS * max(math.hypot(*vector) for vector in raster.cell.vectors)
    length, unit = in_lengths(experiment.units)
    diagnostics: tuple[Any, ...] = experiment.diagnostics
    for n, diagnostic in enumerate(diagnostics):
        if diagnostic.type != "stress-strain":
            continue
        width, across = diagnostic.width, 1 - "xy".index(diagnostic.axis)
        extent = box[1][across] - box[0][across]
        if width > extent + slack:
            yield (
                f"diagnostics.{n}.width: {length * width:.4g} {unit}, but the body extends over "
                f"{length * extent:.4g} {unit} along {'xy'[across]}, so that the nominal stress is "
                "too small; give the width of the section"
            )


def groups_without_reaction(experiment: Experiment) -> Iterator[str]:
    """Generate a warning for each diagnostic `stress-strain` with a leader group that does not
    prescribe the motion along its axis, so that its nominal stress is 0."""
    diagnostics: tuple[Any, ...] = experiment.diagnostics
    for n, diagnostic in enumerate(diagnostics):
        if diagnostic.type != "stress-strain" or diagnostic.group >= len(experiment.leaders):
            continue
        axis, index = diagnostic.axis, "xy".index(diagnostic.axis)
        axes = experiment.leaders[diagnostic.group].axes
        if axes is None or axis in axes:
            continue
        loads = [
            f"loads.{m}"
            for m, load in enumerate(experiment.loads)
            if load.force_at(load.from_)[index] or load.force_at(load.last(experiment.steps))[index]
        ]
        others = [m for m, group in enumerate(experiment.leaders) if axis in (group.axes or "xy")]
        remedy = f"choose a group that prescribes it ({', '.join(map(str, others)) or 'none does'})"
        if loads:
            remedy = f"the body is loaded by {', '.join(loads)}: use `load-displacement`"
        yield (
            f"diagnostics.{n}.group: leader group {diagnostic.group} does not prescribe the motion "
            f"along {axis}, so that it exerts no force along {axis} and the nominal stress is 0; "
            f"{remedy}"
        )


def angles_in_radians(experiment: Experiment) -> Iterator[str]:
    """Generate a warning for each angle, or total rotation, that is a multiple of `ROUND_ANGLE` and
    therefore seems to be given in radians."""
    angles = {}
    if (angle := getattr(experiment.lattice, "angle", None)) is not None:
        angles["lattice.angle"] = angle, angle
    for part, driven in (("leaders", experiment.leaders), ("obstacles", experiment.obstacles)):
        for n, group in enumerate(driven):
            if isinstance(group.motion, Rotation):
                whole = group.motion.angle * group.motion.steps
                angles[f"{part}.{n}.motion.angle"] = group.motion.angle, whole
    for name, (angle, whole) in angles.items():
        if round_in_radians(angle) or round_in_radians(whole):
            yield (
                f"{name}: {angle:g} degrees look like radians, which would be "
                f"{math.degrees(angle):.6g} degrees; angles are in degrees"
            )


def round_in_radians(angle: float) -> bool:
    """Return whether a number, read as radians, is a multiple of 15° up to a full turn. Numbers
    with at most `DECIMALS` decimals are excluded.

    0.7854 is such an angle, 2.88 is not.
    """
    multiple = round(abs(angle) / ROUND_ANGLE)
    is_multiple = abs(abs(angle) - multiple * ROUND_ANGLE) <= ROUND_ATOL
    return 0 < multiple <= 24 and is_multiple and round(angle, DECIMALS) != round(angle, 9)
