"""One state as a table for the dataset and the diagnostics. The table has a row for each particle;
strain, stress and materials are computed on request. A moment is the time of a state: a step, or a
fraction of steps for an equilibrium within a step.

The displacement gradient at a particle is the mean over the cells that meet at the particle,
weighted by area. The mean gradient of a polygon is Σ_k u_k ⊗ ½ (y_k+1 - y_k-1, x_k-1 - x_k+1),
divided by its area (Green's theorem). This is the mean gradient of a bilinear displacement on a
rectangle, and of a linear displacement on a triangle. The mean over cells is the gradient at the
mean of the centres of the cells. At an edge this point differs from the position of the particle.
The gradient is therefore extrapolated to the particle; its slope is computed in the same way. The
result is exact for quadratic displacements of rectangular cells, also at edges.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cached_property
from itertools import product
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats, Indices
from pbdkit.errors import did_you_mean
from pbdkit.lattice.cells import Patch
from pbdkit.lattice.fill import tolerance_of
from pbdkit.lattice.raster import FOLLOWER, Places, Raster
from pbdkit.model.bodies import Sites
from pbdkit.model.experiment import Experiment
from pbdkit.plugin import (
    Calibrated,
    Here,
    LeaderRows,
    LoadRows,
    Moment,
    Pair,
    Softens,
    SoftensCells,
    Stiffness,
    TouchingRows,
    Vector,
    length,
)
from pbdkit.plugin.diagnostic import BondHistory, CellTable, CellValues, ForceValues
from pbdkit.plugin.discovery import errors_attributed_to
from pbdkit.plugin.lattice import Side, area_share, corner_share, signed_area
from pbdkit.plugin.rule import material_of
from pbdkit.scene.constants import (
    bond_numbers,
    kinds_of,
    particle_numbers,
    signed_distance,
    values_at,
)
from pbdkit.scene.leader_groups import kinds_at
from pbdkit.scene.materials import PLACES, regions_of, stiffness_at
from pbdkit.scene.scene import Scene
from pbdkit.scene.selection import Selecting
from pbdkit.stepping.contact import Contact
from pbdkit.stepping.followers import SlotFollowers
from pbdkit.stepping.rule_evaluation import Evaluator, Neighbour, Surroundings, blocks, summed
from pbdkit.stepping.state import State, describe_bonds


def lost_stress(
    scene: Scene, state: State, u: Floats, cells: list[tuple[Patch, Floats]]
) -> list[Floats]:
    """Return the part of the first Piola-Kirchhoff stress that is lost in each cell because of
    damage, divided by Young's modulus and multiplied by the area of the cell in the body.

    It is an array (component × axis, cell, cell) for each patch, -Σ ΔF ⊗ X over the corners of a
    cell, where ΔF is the change of the force on a corner because of damage. This is the formula for
    the mean stress of a body with forces on its surface.
    """
    result: list[Floats] = []
    for patch, share in cells:
        used = np.flatnonzero(np.broadcast_to(share, patch.whole.shape) > 0.0)
        lost = np.zeros((4, patch.whole.size))
        for n, rest in enumerate(patch.polygon.rest):
            place = _places(scene, patch, n, used)
            for force in _lost_forces(scene, state, u, patch, n, place):
                lost[:, used] += np.array([f * x for f in force for x in rest])
        result.append(lost.reshape(4, *patch.whole.shape))
    return result


def _places(scene: Scene, patch: Patch, corner: int, cells: NDArray[np.intp]) -> Places:
    """Return the places of one corner, for the cells of a patch with the given indices."""
    block, shape = patch.corners[corner], scene.raster.shape
    at = np.unravel_index(cells, patch.whole.shape)
    index = [n + start for n, start in zip(at, block.start, strict=True)]
    flat = np.ravel_multi_index((np.full(len(cells), block.sublattice), *index), shape)
    return Places(shape, flat.astype(np.intp))


def _lost_forces(
    scene: Scene, state: State, u: Floats, patch: Patch, corner: int, place: Places
) -> Iterator[Any]:
    """Generate, for one corner of cells, the change of the force that each other corner exerts on
    it: the force without damage minus the force with damage."""
    around = Surroundings(scene, place, patch.corners[corner].sublattice)
    evaluator = Evaluator(scene)
    particle = around.here(u, state)
    neighbours = scene.neighbourhood.tiling.beside
    parts = zip(around.slots, around.differences(u), around.neighbours(state), strict=True)
    for slot, d, to in parts:
        sides = [_belongs_to(side, patch, corner) for side in neighbours[slot]]
        if to.torn is None or not any(sides):
            continue
        damaged = replace(
            to,
            w=_of_sides(to.w, sides),
            more=tuple(_of_sides(w, sides) for w in to.more),
        )
        whole, torn = (
            evaluator.force(_total(evaluator, d, particle, neighbour), particle)
            for neighbour in (replace(damaged, torn=None), damaged)
        )
        yield torn - whole


def _total(evaluator: Evaluator, d: Any, particle: Here, neighbour: Neighbour) -> Any:
    return summed([(evaluator.contribution(d, particle.u, neighbour), None)])


def _belongs_to(side: Side, patch: Patch, corner: int) -> bool:
    """Return whether a cell beside a bond that starts at a corner belongs to the patch."""
    source = patch.polygon.source if side.first is None else side.first.target
    return (side.kind, source, side.start) == (patch.polygon.kind, patch.polygon.source, corner)


def _of_sides(w: Any, sides: list[bool]) -> Any:
    left_share, right_share = (
        share if on_side else 0.0 for on_side, share in zip(sides, (w.left, w.right), strict=True)
    )
    return w._replace(left=left_share, right=right_share)


def stiffness_of_particles(experiment: Experiment, raster: Raster) -> Stiffness | None:
    """Return the stiffness at each particle, divided by Young's modulus; each component is
    (particle,). If the stiffness is uniform, return the stiffness of the rule."""
    rule = experiment.rule
    if not (rule.varying and rule.uses_cells):
        return material_of(rule)
    x, y = raster.reference().T
    values = values_at(experiment, "rule", x, y, raster.table_kind == FOLLOWER)
    matrices = stiffness_at(experiment, values)
    return Stiffness(**{name: matrices[(slice(None), *at)] for name, at in PLACES.items()})


def through_thickness_of_particles(experiment: Experiment, raster: Raster) -> Floats | float:
    """Return the ratio of σ_zz to σ_xx + σ_yy at each particle, (particle,). If it is uniform,
    return the ratio of the rule."""
    rule = experiment.rule
    if not isinstance(rule, Calibrated):
        return 0.0
    if not (rule.varying and rule.uses_cells):
        return rule.through_thickness()
    x, y = raster.reference().T
    values = values_at(experiment, "rule", x, y, raster.table_kind == FOLLOWER)
    parts, kind = kinds_of(rule, values)
    return np.array([part.through_thickness() for part in parts])[kind]


def phases_of_particles(experiment: Experiment, raster: Raster) -> NDArray[np.int64]:
    """Return the regions of the rule that contain each particle, as a bit mask with a bit for each
    region, (particle,)."""
    x, y = raster.reference().T
    phases, cell = np.zeros(len(x), np.int64), experiment.lattice.cell()
    for bit, region in enumerate(regions_of(experiment).values()):
        phases |= (signed_distance(region, cell, x, y) <= 0.0).astype(np.int64) << bit
    return phases


Array = TypeVar("Array", bound=NDArray[Any])


def read_only(values: Array) -> Array:
    """Return a read-only view of values that several diagnostics share."""
    view: Array = values.view()
    view.flags.writeable = False
    return view


class Tables:
    """Data that all moments of a scene share: the reference configuration and the
    neighbourhoods."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    def at(self, moment: float) -> Tables:
        """Return the tables with the values that time-dependent constants have at a moment."""
        if (scene := self.scene.at(moment)) is self.scene:
            return self
        tables = Tables(scene)
        vars(tables).update(reference=self.reference, body=self.body, inside=self.inside)
        return tables

    def add_reference(self, u: Floats) -> Floats:
        """Add X to u of shape (particle, axis) in place. If more than two steps are recorded, X is
        computed once and stored; otherwise it is computed in chunks, which saves memory."""
        experiment = self.scene.experiment
        if experiment.record_count > 2:
            u += self.reference
            return u
        for rows in self.scene.raster.chunks():
            u[rows[0] : rows[-1] + 1] += self.scene.raster.reference(rows)
        return u

    def of_body(self, planes: Floats) -> Floats:
        """Convert values on rasters to a table of shape (particle, ...), with NaN at frame
        points."""
        table = self.scene.raster.table(planes)
        table[~self.body] = np.nan
        return read_only(table)

    @cached_property
    def reference(self) -> Floats:
        """Reference positions X, (particle, axis)."""
        return read_only(self.scene.raster.reference())

    @cached_property
    def body(self) -> NDArray[np.bool_]:
        """(particle,): whether the particle is a leader or follower."""
        return read_only(self.scene.raster.table_kind == FOLLOWER)

    @cached_property
    def inside(self) -> NDArray[np.bool_]:
        """(particle,): whether a particle of the body lies inside the outline or on it. Only
        corners of cut cells can lie outside."""
        scene, raster = self.scene, self.scene.raster
        if scene.cells is None or scene.cells.share is None:
            return self.body
        cut = np.zeros((1, *raster.shape), bool)
        for patch in scene.patches:
            share = scene.cells.of(patch)
            for corner in patch.corners:
                corner.of(cut[0])[...] |= (share > 0.0) & (share < 1.0)
        body, lattice = scene.experiment.body, scene.experiment.lattice
        rows = np.flatnonzero(self.body & raster.table(cut)[:, 0])
        sites = Sites(tuple(raster.site_of(rows).T), tuple(raster.reference(rows).T))
        inside = self.body.copy()
        inside[rows] = body.distance(sites) <= tolerance_of(body, lattice)
        return read_only(inside)

    @cached_property
    def followers(self) -> SlotFollowers:
        """The followers of the scene, which evaluate forces and energy with its rule."""
        return SlotFollowers(self.scene)

    @cached_property
    def stiffness(self) -> Stiffness | None:
        """Stiffness of the rule. If it varies, it is the stiffness at each particle."""
        return stiffness_of_particles(self.scene.experiment, self.scene.raster)

    @cached_property
    def through_thickness(self) -> Floats | float:
        """σ_zz over σ_xx + σ_yy, at each particle where it varies."""
        return through_thickness_of_particles(self.scene.experiment, self.scene.raster)

    @cached_property
    def phase(self) -> NDArray[np.int64]:
        """(particle,): number of the material of each particle."""
        return phases_of_particles(self.scene.experiment, self.scene.raster)

    @cached_property
    def surroundings(self) -> list[Surroundings]:
        """The neighbourhoods of the body's particles."""
        return blocks(self.scene)


Average = Callable[[list[tuple[Patch, Floats]]], Floats]
"""Function that computes a tensor at the particles from cells with their area fractions."""
FLAT = 0.1
"""Each corner of a cell is moved to the mean of the centres of the cells around it. If the area of
the cell is then smaller than this fraction of its area at rest, these points are nearly collinear
and no slope can be computed. This is so in a body with a single row of cells."""


def displacement_gradient(u: NDArray[Any], cells: Iterable[tuple[Patch, Floats]]) -> Floats:
    """Return ∂u_a/∂X_b, (2a + b, sublattice, cell, cell), from the displacements u on rasters, and
    the cells with their area fractions. The result is 0 at places without cells."""
    cells = list(cells)
    slopes = (
        _mean_gradient([np.array(d) for d in patch.differences(u)], patch.polygon.rest)[1] * share
        for patch, share in cells
    )
    return average_at_particles(u.shape[1:], cells, slopes)


def average_at_particles(
    shape: tuple[int, ...], cells: list[tuple[Patch, Floats]], weighted: Iterable[Floats]
) -> Floats:
    """Return the values of cells at the particles, (component, sublattice, cell, cell).

    They are the means over the cells around a particle. If the centre of these cells is not at the
    particle, as at an edge, the means are extrapolated linearly from there.

    Parameters
    ----------
    shape
        Shape of the rasters.
    cells
        Cells with their area fractions.
    weighted
        Four values of the cells of each patch, multiplied by their area in the body.
    """
    area, offset, total = np.zeros(shape), np.zeros((2, *shape)), np.zeros((4, *shape))
    for (patch, share), values in zip(cells, weighted, strict=True):
        rest, whole = patch.polygon.rest, signed_area(patch.polygon.rest)
        centre = [sum(r[axis] for r in rest) / len(rest) for axis in (0, 1)]
        for corner, r in zip(patch.corners, rest, strict=True):
            corner.of(area)[...] += whole * share
            for plane, middle, place in zip(offset, centre, r, strict=True):
                corner.of(plane)[...] += (middle - place) * whole * share
            parts = values.reshape(4, *values.shape[-len(patch.whole.shape) :])
            for plane, value in zip(total, parts, strict=True):
                corner.of(plane)[...] += value
    divisor = np.where(area > 0.0, area, 1.0)
    total /= divisor
    offset /= divisor
    return total - _extrapolation(total, offset, cells)


def _extrapolation(gradient: Floats, offset: Floats, cells: list[tuple[Patch, Floats]]) -> Floats:
    """Return the change of a gradient from the particles to the centres of cells, (4, ...)."""
    area, slope = np.zeros(gradient.shape[1:]), np.zeros((4, 2, *gradient.shape[1:]))
    for patch, share in cells:
        rest, away = patch.polygon.rest, [corner.of(offset) for corner in patch.corners]
        at = [r + Vector(*(position - away[0])) for r, position in zip(rest, away, strict=True)]
        values = [corner.of(gradient) for corner in patch.corners]
        whole, slopes = _mean_gradient([value - values[0] for value in values], at)
        usable = np.where(whole > FLAT * signed_area(rest), share, 0.0)
        for corner in patch.corners:
            corner.of(area)[...] += whole * usable
            for plane, part in zip(slope, slopes, strict=True):
                corner.of(plane)[...] += part * usable
    slope /= np.where(area > 0.0, area, 1.0)
    change: Floats = slope[:, 0] * offset[0] + slope[:, 1] * offset[1]
    return change


def _mean_gradient(d: Sequence[Floats], r: Sequence[Any]) -> tuple[Any, Any]:
    """Return the area of a polygon with corners r. Also return its area times the mean gradient of
    d, (component of d, axis, ...)."""
    slopes = np.zeros((len(d[0]), 2, *d[0].shape[1:]))
    for k, value in enumerate(d):
        ahead, behind = r[(k + 1) % len(r)], r[k - 1]
        slopes[:, 0] += value * ((ahead.y - behind.y) / 2)
        slopes[:, 1] += value * ((behind.x - ahead.x) / 2)
    return signed_area(r), slopes


def _extend_gradient(
    gradient: Floats, phase_cells: list[tuple[Patch, Floats]], cells: list[tuple[Patch, Floats]]
) -> Floats:
    """Extend a gradient that was computed from some cells only to particles without such cells. Its
    shape is (4, ...). Their gradient is the mean over the particles with which they share any cell,
    or NaN if none of these particles has a gradient."""
    shape = gradient.shape[1:]
    weight, total, count = np.zeros(shape), np.zeros_like(gradient), np.zeros(shape)
    for patch, share in phase_cells:
        for corner in patch.corners:
            corner.of(weight)[...] += share
    covered = weight > 0.0
    for patch, share in cells:
        exists = share > 0.0
        for corner, source in product(patch.corners, repeat=2):
            corner.of(count)[...] += source.of(covered) & exists
            for plane, value in zip(total, gradient * covered, strict=True):
                corner.of(plane)[...] += source.of(value) * exists
    mean = np.where(count > 0.0, total, np.nan) / np.where(count > 0.0, count, 1.0)
    return np.where(covered, gradient, mean)


TURNED = -1e-6
"""A cell is inverted if the ratio of its signed area to its area at rest is below this number.
Negative ratios closer to zero are rounding errors, also in single precision."""


class StateCells(CellValues):
    """The cells of a scene's body in a state."""

    def __init__(self, state: State, tables: Tables) -> None:
        self._state, self._tables, self._scene = state, tables, tables.scene

    def over(
        self,
        function: Callable[[tuple[Any, ...], tuple[Any, ...]], Any],
        *,
        intact_only: bool = False,
    ) -> Floats:
        """Evaluate the function for one patch after the other. A patch contains cells of one
        shape."""
        parts = [np.empty(0)]
        for patch in self._scene.patches:
            counted = self._intact(patch) if intact_only else patch.whole
            values = function(patch.differences(self._state.u), patch.polygon.rest)
            parts.append(np.broadcast_to(values, counted.shape)[counted])
        return np.concatenate(parts)

    def gradient(self) -> Floats:
        """Return the displacement gradient. It is computed once for each state."""
        return self._gradient

    @cached_property
    def _gradient(self) -> Floats:
        u = self._state.u.astype(float, copy=False)
        return read_only(self._at_particles(lambda cells: displacement_gradient(u, cells)))

    def _at_particles(self, average: Average) -> Floats:
        """Return a tensor at each particle, (particle, 2, 2), from the function that computes it at
        particles from given cells."""
        weighed, cells = self._scene.cells, self._weighed
        whole = self._tables.of_body(average(cells))
        if weighed is not None and weighed.phase is not None:
            whole = self._by_phase(weighed.phase, average, cells, whole)
        return whole.reshape(-1, 2, 2)

    def table(self, near: tuple[Pair, float] | None = None) -> tuple[CellTable, ...]:
        """Return the cells near a point, or the torn cells. Only their entries are created."""
        tables = []
        for patch in self._scene.patches:
            chosen = patch.whole & ~self._intact(patch) if near is None else self._near(patch, near)
            if chosen.any():
                tables.append(self._table(patch, np.nonzero(chosen)))
        return tuple(tables)

    def _near(self, patch: Patch, near: tuple[Pair, float]) -> NDArray[np.bool_]:
        (x, y), distance = near
        origin = Vector(*self._scene.raster.lattice.origin[:2])
        at = self._scene.raster.reference_planes(patch.corners[0]) + origin
        return np.asarray(patch.whole & (abs(at.x - x) <= distance) & (abs(at.y - y) <= distance))

    def _table(self, patch: Patch, at: tuple[Indices, ...]) -> CellTable:
        """Return the cells of a patch at the given places."""
        scene, state = self._scene, self._state
        starts = [(block.sublattice, block.start) for block in patch.corners]
        rows = [
            scene.raster.rows_at(s, *(n + first for n, first in zip(at, start, strict=True)))
            for s, start in starts
        ]
        share = np.broadcast_to(scene.cells.of(patch) if scene.cells else 1.0, patch.whole.shape)
        pairs, broken = [], []
        for block, slot in patch.bonds(scene.neighbourhood.slots):
            plane, at_this_end = scene.neighbourhood.owner[slot]
            owner = block if at_this_end else block.seen_through(slot)
            pairs.append([patch.corners.index(b) for b in (block, block.seen_through(slot))])
            steps = None if state.broken_step is None else owner.within(state.broken_step[plane])
            broken.append(np.zeros(len(at[0]), bool) if steps is None else steps[at] >= 0)
        bonds = np.array(pairs, np.intp).reshape(-1, 2)
        flags = np.array(broken, bool).reshape(len(bonds), len(at[0])).T
        return CellTable(np.stack(rows, axis=1), share[at], bonds, flags)

    def lost_stress(self) -> Floats | None:
        """Return the stress that is lost because of damage. It is computed at each call, because
        only one diagnostic uses it."""
        scene, state = self._scene, self._state
        if not (scene.tears and isinstance(scene.experiment.fracture, (Softens, SoftensCells))):
            return None
        u = state.u.astype(float, copy=False)
        lost = lost_stress(scene, state, u, self._weighed)

        def average(cells: list[tuple[Patch, Floats]]) -> Floats:
            parts = (part * (share > 0.0) for part, (_, share) in zip(lost, cells, strict=True))
            return average_at_particles(u.shape[1:], cells, parts)

        return self._at_particles(average)

    @cached_property
    def _weighed(self) -> list[tuple[Patch, Floats]]:
        """Area fractions of the cells that are included."""
        weighed = self._scene.cells
        return [
            (patch, (weighed.of(patch) if weighed else 1.0) * self._intact(patch))
            for patch in self._scene.patches
        ]

    def _by_phase(
        self,
        phase: NDArray[Any],
        average: Average,
        cells: list[tuple[Patch, Floats]],
        whole: Floats,
    ) -> Floats:
        """Return the tensor at each particle. It is computed only from cells of the particle's own
        material, because gradients are discontinuous at interfaces. If a particle has no such
        cells, its tensor is the mean over neighbouring particles that have such cells."""
        gradient, phases = whole.copy(), self._tables.phase
        for number in np.unique(phases).tolist():
            phase_cells = [
                (patch, share * (patch.corners[0].of(phase[patch.polygon.kind]) == number))
                for patch, share in cells
            ]
            planes = _extend_gradient(average(phase_cells), phase_cells, cells)
            values = self._tables.of_body(planes)
            rows = (phases == number) & np.isfinite(values).all(axis=1)
            gradient[rows] = values[rows]
        return gradient

    def inside_out(self) -> str | None:
        """Return a warning if cells, or corners of cells, are inverted, otherwise None. Torn cells
        are ignored, because the parts of a broken body move apart."""
        remedy = "reduce the displacement of the leaders, or the coupling of x and y in the rule"
        if description := self._turned(area_share, "cells are inverted"):
            return f"the last state has inverted cells: {description}; {remedy}"
        if description := self._turned(corner_share, "cells have an inverted corner"):
            return f"the last state is folded: {description}; {remedy}"
        return None

    def _turned(self, share: Callable[..., Any], what: str) -> str | None:
        """Describe the inverted cells. The description contains their number, the place of the most
        inverted cell, and the ratio of its area to its area at rest. Return None if no cell is
        inverted."""
        turned = total = number = 0
        worst = 0.0
        for patch in self._scene.patches:
            counted = self._intact(patch)
            with np.errstate(all="ignore"):
                area = share(patch.differences(self._state.u), patch.polygon.rest)
                area = np.where(counted & (area < TURNED), area, 0.0)
            turned += int(np.count_nonzero(area))
            total += int(np.count_nonzero(counted))
            place = int(area.argmin())
            if area.flat[place] < worst:
                worst = float(area.flat[place])
                number = int(patch.rows(self._scene.raster, place).min()) + 1
        if not turned:
            return None
        return (
            f"{turned} of {total} {what}; the worst, at particle {number}, has {worst:.3g} times "
            "its area at rest"
        )

    def _intact(self, patch: Patch) -> NDArray[np.bool_]:
        """Return the cells of a patch without a broken bond between their corners."""
        intact = patch.whole
        if self._state.broken_step is None:
            return intact
        for block, slot in patch.bonds(self._scene.neighbourhood.slots):
            plane, at_this_end = self._scene.neighbourhood.owner[slot]
            owner = block if at_this_end else block.seen_through(slot)
            intact = intact & (owner.within(self._state.broken_step[plane]) < 0)
        return intact


class StateMoment(Moment):
    """A state as a table. Bonds that broke after the step `no_later_than` count as intact.

    For an equilibrium within a step, at an increment of load, `time` is given. Particles then have
    the roles of that step, and constants and loads are evaluated at that time.
    """

    def __init__(
        self,
        state: State,
        tables: Tables,
        no_later_than: int | None = None,
        time: float | None = None,
    ) -> None:
        self._now: float = state.step if time is None else time
        self.step, self._time = math.ceil(self._now), time
        self._no_later_than = self.step if no_later_than is None else no_later_than
        self._state, self._tables = state, tables.at(self._now)
        self._scene, self._raster = tables.scene, tables.scene.raster

    def of(self, state: State, tables: Tables) -> StateMoment:
        """Return the table of another state at the same moment."""
        return StateMoment(state, tables, self._no_later_than, self._time)

    @property
    def body(self) -> NDArray[np.bool_]:
        """(particle,): whether the particle is a leader or follower; independent of the moment."""
        return self._tables.body

    @property
    def inside(self) -> NDArray[np.bool_]:
        """(particle,): whether the particle lies inside the outline; independent of the moment."""
        return self._tables.inside

    @cached_property
    def cells(self) -> StateCells:
        """Values on cells, which are computed on request."""
        return StateCells(self._state, self._tables)

    @cached_property
    def forces(self) -> ForceValues:
        """Forces and energy, which are computed on request."""
        return StateForces(self._state, self._tables)

    def rows(self, numbers: tuple[int, ...]) -> Indices:
        """Return the rows of the particles with the given numbers. Numbers begin at 1 and have the
        order of the rows."""
        return np.array(numbers, np.intp) - 1

    def nearest(self, points: tuple[Pair, ...]) -> Indices:
        """Return the rows of the particles nearest to points, by the same rule by which leaders are
        selected."""
        return Selecting(self._raster).nearest(points)

    @cached_property
    def _u(self) -> Floats:
        return read_only(self._raster.table(self._state.u))

    def displacement(self, rows: Indices | None = None) -> Floats:
        """Return the displacements of all particles or of some rows. The table of all particles is
        computed once for each state; the displacements of some rows are returned without computing
        it."""
        if rows is None:
            return self._u
        place = self._raster.place_of(rows)
        return read_only(np.stack([plane.ravel()[place] for plane in self._state.u], axis=1))

    def previous_displacement(self) -> Floats:
        """Return the displacements of the previous step."""
        return read_only(self._raster.table(self._state.previous))

    def reference(self, rows: Indices | None = None) -> Floats:
        """Return the reference positions X."""
        if rows is None:
            return self._tables.reference
        return read_only(self._raster.reference(rows))

    def position(self) -> Floats:
        """Return x = X + u of shape (particle, axis), always in float64, independent of the
        precision of the run."""
        return self._tables.add_reference(
            self._raster.table(self._state.u).astype(float, copy=False)
        )

    def kind(self) -> NDArray[np.int8]:
        """Return the role of each particle during this step, (particle,)."""
        return kinds_at(self._raster, self._scene.leading, self.step)

    def sum_over_neighbours(
        self, function: Callable[[Any, Any], Any], *, intact_only: bool = False
    ) -> Floats:
        """Sum a function over the neighbours of the body's particles, in the same way as in a
        step."""

        def contribution(d: Any, u: Any, to: Neighbour) -> tuple[Any, ...]:
            value = function(d, to.r)
            if to.broken is not None and intact_only:
                value = np.where(to.broken, 0.0, value)
            return (value,)

        sums = np.full(self._raster.shape, np.nan)
        for around in self._tables.surroundings:
            (total,) = around.sums(contribution, self._state.u, self._state)
            body = around.where.of(self._raster.kind) == FOLLOWER
            around.where.of(sums)[...] = np.where(body, total, np.nan)
        return read_only(self._raster.table(sums[None])[:, 0])

    def leader_groups(self) -> tuple[LeaderRows, ...]:
        """Return the leader groups that are active in this step. At time 0, these are the groups
        that are active in step 1."""
        step = max(self.step, 1)
        return tuple(
            LeaderRows(read_only(each.rows), each.group.leads(step), each.axes)
            for each in self._scene.leading
        )

    def loads(self) -> tuple[LoadRows, ...]:
        """Return the loads as they act in this step."""
        loads, factor = self._scene.loads, self._state.load_factor
        return tuple(
            LoadRows(
                read_only(each.rows),
                read_only(each.share),
                0.0 + factor * each.load.force_at(self._now),
            )
            for each in (loads.each if loads else ())
        )

    def touching(self) -> tuple[TouchingRows, ...]:
        """Return the contacts with obstacles. They are computed once for each state."""
        return self._touching

    @cached_property
    def _touching(self) -> tuple[TouchingRows, ...]:
        if not self._scene.barriers:
            return ()
        contacts = Contact(self._scene).touching(self._state, self._now)
        return tuple(TouchingRows(read_only(rows), read_only(n)) for rows, n in contacts)

    def broken_bonds(self) -> int:
        """Return the number of broken bonds."""
        broken = self._state.broken_step
        return 0 if broken is None else int((broken >= 0).sum())

    def bonds(self) -> BondHistory:
        """Return the table of bonds with their histories. It is computed at each call."""
        parts = vars(describe_bonds(self._scene)).values()
        values = (*parts, self.broken_step(), self.broken_strain())
        return BondHistory(*(read_only(value) for value in values))

    def broken_step(self) -> NDArray[np.int32]:
        """Return the step in which each bond broke, and -1 for intact bonds."""
        bonds, broken = self._scene.bonds, self._state.broken_step
        if broken is None:
            return np.full(len(bonds.ends), -1, np.int32)
        steps: NDArray[np.int32] = self._of_bonds(broken)
        return np.where(steps > self._no_later_than, np.int32(-1), steps)

    def broken_strain(self) -> Floats:
        """Return the strain at breaking, always in float64, independent of the precision of the
        run. It is NaN for bonds that were cut."""
        scene, lengths, steps = self._scene, self._state.broken_length, self.broken_step()
        if lengths is None:
            return np.full(len(steps), np.nan)
        rests = np.array([length(plane.slot.rest) for plane in scene.neighbourhood.planes])
        strains = self._of_bonds(lengths) / rests[scene.bonds.plane] - 1
        return np.where((steps > 0) & (strains > -1.0), strains, np.nan)

    def remembered(self, name: str) -> NDArray[Any]:
        """Return the values of a state variable of bonds, in the order of the table of bonds, or of
        a state variable of particles, in the order of the particles."""
        experiment, state = self._scene.experiment, self._state
        labels = [number.name for number in bond_numbers(experiment)]
        of_bonds = dict(zip(labels, state.bond_values, strict=True))
        labels = [number.name for number in particle_numbers(experiment)]
        of_particles = dict(zip(labels, state.particle_values, strict=True))
        if name in of_bonds:
            return read_only(self._of_bonds(of_bonds[name]))
        if name in of_particles:
            return read_only(self._raster.table(of_particles[name][None])[:, 0])
        names = [*of_bonds, *of_particles]
        raise ValueError(f"no component has a state variable '{name}'{did_you_mean(name, names)}")

    def _of_bonds(self, planes: NDArray[Any]) -> NDArray[Any]:
        """Convert values that are stored by plane and place to one value for each bond of the
        table, (bond,)."""
        bonds = self._scene.bonds
        return np.asarray(planes.reshape(len(planes), -1)[bonds.plane, bonds.place])


class StateForces(ForceValues):
    """Forces, energy and stiffness of the scene's rule in a state."""

    def __init__(self, state: State, tables: Tables) -> None:
        self._state, self._tables = state, tables
        self._rule = tables.scene.experiment.rule

    @property
    def stiffness(self) -> Stiffness:
        """Stiffness of the rule. If it varies, it is the stiffness at each particle."""
        stiffness = self._tables.stiffness
        if stiffness is None:
            raise ValueError(
                f"the rule '{self._rule.type}' is not calibrated to a material: declare "
                '"material" or "forces" among the `needs`'
            )
        return stiffness

    @property
    def through_thickness(self) -> Any:
        """σ_zz over σ_xx + σ_yy, at each particle where it varies."""
        return self._tables.through_thickness

    def on_particles(self) -> Floats:
        """Return the forces on particles. They are computed once for each state."""
        return self._on_particles

    @cached_property
    def _on_particles(self) -> Floats:
        with self._errors_attributed_to_rule():
            forces = self._tables.followers.forces(self._u, self._state)
        return self._tables.of_body(forces)

    def energy(self) -> float:
        """Return the energy of the rule."""
        with self._errors_attributed_to_rule():
            return self._tables.followers.energy(self._u, self._state)

    @property
    def _u(self) -> Floats:
        return self._state.u.astype(float, copy=False)

    def _errors_attributed_to_rule(self) -> AbstractContextManager[None]:
        return errors_attributed_to(
            self._rule, f"to return forces at step {self._state.step}", "rule"
        )
