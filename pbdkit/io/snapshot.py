"""One time step as the dataset and the diagnostics see it: a row a particle, with strain, stress
and materials computed on request.

The displacement gradient at a particle is the mean over the cells that meet there, weighted by
area. A polygon's mean gradient is Σ_k u_k ⊗ ½ (y_k+1 - y_k-1, x_k-1 - x_k+1) over its area (Green),
on a rectangle that of the bilinear displacement, on a triangle that of the linear one. The mean
belongs to the mean of the cells' centres, which on an edge is not the particle, and is extrapolated
from there with the gradient's own slope, found in the same way. Quadratic displacements of
rectangular cells are exact, edges included.
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
from pbdkit.plugin.diagnostic import BondHistory, CellValues, ForceValues
from pbdkit.plugin.discovery import blaming
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


def lost_stress(scene: Scene, state: State, u: Floats, cells: list[tuple[Patch, Floats]]) -> Floats:
    """The first Piola-Kirchhoff stress that damage takes away, over Young's modulus: planes
    (component × axis, sublattice, cell, cell), at each particle the mean over the given cells
    around it by their share.

    Of a cell it is -Σ ΔF ⊗ X over its corners and its area, with the forces ΔF that the damage
    changes: the mean stress of a body under forces on its surface.
    """
    total, area = np.zeros((4, *scene.raster.shape)), np.zeros(scene.raster.shape)
    for patch, share in cells:
        used = np.flatnonzero(np.broadcast_to(share, patch.whole.shape) > 0.0)
        corners = [_places(scene, patch, n, used) for n in range(len(patch.corners))]
        weight = np.broadcast_to(share, patch.whole.shape).ravel()[used]
        size = abs(float(signed_area(patch.polygon.rest)))
        lost = np.zeros((4, len(used)))
        for n, (place, rest) in enumerate(zip(corners, patch.polygon.rest, strict=True)):
            for force in _lost_forces(scene, state, u, patch, n, place):
                lost += np.array([f * x for f in force for x in rest]) / size
        for place in corners:
            flat = place.place
            np.add.at(area.reshape(-1), flat, weight)
            for plane, value in zip(total.reshape(4, -1), lost, strict=True):
                np.add.at(plane, flat, value)
    return total / np.where(area > 0.0, area, 1.0)


def _places(scene: Scene, patch: Patch, corner: int, cells: NDArray[np.intp]) -> Places:
    """Where the corners of some cells of a patch lie, counted in it."""
    block, shape = patch.corners[corner], scene.raster.shape
    at = np.unravel_index(cells, patch.whole.shape)
    index = [n + start for n, start in zip(at, block.start, strict=True)]
    flat = np.ravel_multi_index((np.full(len(cells), block.sublattice), *index), shape)
    return Places(shape, flat.astype(np.intp))


def _lost_forces(
    scene: Scene, state: State, u: Floats, patch: Patch, corner: int, place: Places
) -> Iterator[Any]:
    """The forces of each other corner on one in these cells, without damage less with it."""
    around = Surroundings(scene, place, patch.corners[corner].sublattice)
    evaluator = Evaluator(scene)
    here = around.here(u, state)
    beside = scene.neighbourhood.tiling.beside
    parts = zip(around.slots, around.differences(u), around.neighbours(state), strict=True)
    for slot, d, to in parts:
        sides = [_is_of(side, patch, corner) for side in beside[slot]]
        if to.torn is None or not any(sides):
            continue
        own = replace(
            to,
            w=_of_sides(to.w, sides),
            more=tuple(_of_sides(w, sides) for w in to.more),
        )
        whole, torn = (
            evaluator.force(_total(evaluator, d, here, one), here)
            for one in (replace(own, torn=None), own)
        )
        yield torn - whole


def _total(evaluator: Evaluator, d: Any, here: Here, to: Neighbour) -> Any:
    return summed([(evaluator.contribution(d, here.u, to), None)])


def _is_of(side: Side, patch: Patch, corner: int) -> bool:
    """Whether a cell beside a bond that starts at a corner is the patch's."""
    source = patch.polygon.source if side.first is None else side.first.target
    return (side.kind, source, side.start) == (patch.polygon.kind, patch.polygon.source, corner)


def _of_sides(w: Any, sides: list[bool]) -> Any:
    left, right = (
        share if own else 0.0 for own, share in zip(sides, (w.left, w.right), strict=True)
    )
    return w._replace(left=left, right=right)


def stiffness_of_particles(experiment: Experiment, raster: Raster) -> Stiffness | None:
    """The stiffness over Young's modulus at each particle, (particle,) a component; that of the
    rule where it is one."""
    rule = experiment.rule
    if not (rule.varying and rule.uses_cells):
        return material_of(rule)
    x, y = raster.reference().T
    values = values_at(experiment, "rule", x, y, raster.table_kind == FOLLOWER)
    matrices = stiffness_at(experiment, values)
    return Stiffness(**{name: matrices[(slice(None), *at)] for name, at in PLACES.items()})


def through_thickness_of_particles(experiment: Experiment, raster: Raster) -> Floats | float:
    """σ_zz over σ_xx + σ_yy at each particle, (particle,); that of the rule where it is one."""
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
    """(particle,): which regions of the rule's hold each, a bit a region."""
    x, y = raster.reference().T
    found, cell = np.zeros(len(x), np.int64), experiment.lattice.cell()
    for bit, region in enumerate(regions_of(experiment).values()):
        found |= (signed_distance(region, cell, x, y) <= 0.0).astype(np.int64) << bit
    return found


Array = TypeVar("Array", bound=NDArray[Any])


def read_only(values: Array) -> Array:
    """The same values, as diagnostics see them: nobody writes to what others read."""
    view: Array = values.view()
    view.flags.writeable = False
    return view


class Tables:
    """What every moment of a scene shares: the reference, and who is around whom."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    def at(self, moment: float) -> Tables:
        """The same with the numbers of a moment."""
        if (now := self.scene.at(moment)) is self.scene:
            return self
        found = Tables(now)
        vars(found).update(reference=self.reference, body=self.body, inside=self.inside)
        return found

    def add_reference(self, u: Floats) -> Floats:
        """X + u, (particle, axis), in place; X is kept where it is wanted more than twice."""
        experiment = self.scene.experiment
        if experiment.record_count > 2:
            u += self.reference
            return u
        for rows in self.scene.raster.chunks():
            u[rows[0] : rows[-1] + 1] += self.scene.raster.reference(rows)
        return u

    def of_body(self, planes: Floats) -> Floats:
        """The values of planes by particle, (particle, ...); NaN at frame points."""
        table = self.scene.raster.table(planes)
        table[~self.body] = np.nan
        return read_only(table)

    @cached_property
    def reference(self) -> Floats:
        """X, (particle, axis)."""
        return read_only(self.scene.raster.reference())

    @cached_property
    def body(self) -> NDArray[np.bool_]:
        """(particle,): which are leaders or followers."""
        return read_only(self.scene.raster.table_kind == FOLLOWER)

    @cached_property
    def inside(self) -> NDArray[np.bool_]:
        """(particle,): which particles of the body lie inside or on its outline: all but some
        corners of cells that it cuts."""
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
        found = self.body.copy()
        found[rows] = body.distance(sites) <= tolerance_of(body, lattice)
        return read_only(found)

    @cached_property
    def followers(self) -> SlotFollowers:
        """The rule on the scene, which knows forces and energy."""
        return SlotFollowers(self.scene)

    @cached_property
    def stiffness(self) -> Stiffness | None:
        """The rule's, of each particle where fields make it differ."""
        return stiffness_of_particles(self.scene.experiment, self.scene.raster)

    @cached_property
    def through_thickness(self) -> Floats | float:
        """σ_zz over σ_xx + σ_yy, of each particle where fields make it differ."""
        return through_thickness_of_particles(self.scene.experiment, self.scene.raster)

    @cached_property
    def phase(self) -> NDArray[np.int64]:
        """(particle,): of which material each is, by a number."""
        return phases_of_particles(self.scene.experiment, self.scene.raster)

    @cached_property
    def surroundings(self) -> list[Surroundings]:
        """Who is around the body's particles."""
        return blocks(self.scene)


FLAT = 0.1
"""Where the centres around the corners of a cell span less than this of its area they lie in line,
as in a body of one row of cells, and tell of no slope."""


def displacement_gradient(u: NDArray[Any], cells: Iterable[tuple[Patch, Floats]]) -> Floats:
    """∂u_a/∂X_b as planes (2a + b, sublattice, cell, cell), from planes u and the cells with their
    shares; 0 where no cell is."""
    cells = list(cells)
    shape = u.shape[1:]
    area, offset, gradient = np.zeros(shape), np.zeros((2, *shape)), np.zeros((2, 2, *shape))
    for patch, share in cells:
        rest = patch.polygon.rest
        whole, slopes = _around([np.array(d) for d in patch.differences(u)], rest)
        centre = [sum(r[axis] for r in rest) / len(rest) for axis in (0, 1)]
        for corner, r in zip(patch.corners, rest, strict=True):
            corner.of(area)[...] += whole * share
            for plane, middle, place in zip(offset, centre, r, strict=True):
                corner.of(plane)[...] += (middle - place) * whole * share
            for plane, slope in zip(gradient, slopes, strict=True):
                corner.of(plane)[...] += slope * share
    some = np.where(area > 0.0, area, 1.0)
    gradient /= some
    offset /= some
    planes = gradient.reshape(4, *shape)
    return planes - _beyond(planes, offset, cells)


def _beyond(gradient: Floats, offset: Floats, cells: list[tuple[Patch, Floats]]) -> Floats:
    """What a gradient changes from the particles to the centres, (4, ...)."""
    area, slope = np.zeros(gradient.shape[1:]), np.zeros((4, 2, *gradient.shape[1:]))
    for patch, share in cells:
        rest, away = patch.polygon.rest, [corner.of(offset) for corner in patch.corners]
        at = [r + Vector(*(own - away[0])) for r, own in zip(rest, away, strict=True)]
        values = [corner.of(gradient) for corner in patch.corners]
        whole, slopes = _around([value - values[0] for value in values], at)
        usable = np.where(whole > FLAT * signed_area(rest), share, 0.0)
        for corner in patch.corners:
            corner.of(area)[...] += whole * usable
            for plane, part in zip(slope, slopes, strict=True):
                corner.of(plane)[...] += part * usable
    slope /= np.where(area > 0.0, area, 1.0)
    beyond: Floats = slope[:, 0] * offset[0] + slope[:, 1] * offset[1]
    return beyond


def _around(d: Sequence[Floats], r: Sequence[Any]) -> tuple[Any, Any]:
    """The area of a polygon with corners r, and area times the mean gradient of d, (component of d,
    axis, ...)."""
    slopes = np.zeros((len(d[0]), 2, *d[0].shape[1:]))
    for k, value in enumerate(d):
        ahead, behind = r[(k + 1) % len(r)], r[k - 1]
        slopes[:, 0] += value * ((ahead.y - behind.y) / 2)
        slopes[:, 1] += value * ((behind.x - ahead.x) / 2)
    return signed_area(r), slopes


def _known_beside(
    gradient: Floats, alike: list[tuple[Patch, Floats]], cells: list[tuple[Patch, Floats]]
) -> Floats:
    """A gradient found from some cells alone, (4, ...): where none of these is, the mean of the
    particles that share any cell with the place; NaN where they have none either."""
    shape = gradient.shape[1:]
    met, total, count = np.zeros(shape), np.zeros_like(gradient), np.zeros(shape)
    for patch, share in alike:
        for corner in patch.corners:
            corner.of(met)[...] += share
    known = met > 0.0
    for patch, share in cells:
        there_is = share > 0.0
        for here, there in product(patch.corners, repeat=2):
            here.of(count)[...] += there.of(known) & there_is
            for plane, value in zip(total, gradient * known, strict=True):
                here.of(plane)[...] += there.of(value) * there_is
    mean = np.where(count > 0.0, total, np.nan) / np.where(count > 0.0, count, 1.0)
    return np.where(known, gradient, mean)


TURNED = -1e-6
"""A share of the area at rest; nearer to zero it is rounding, of single precision too."""


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
        """Patch by patch, each with the cells of one shape."""
        found = [np.empty(0)]
        for patch in self._scene.patches:
            counted = self._intact(patch) if intact_only else patch.whole
            values = function(patch.differences(self._state.u), patch.polygon.rest)
            found.append(np.broadcast_to(values, counted.shape)[counted])
        return np.concatenate(found)

    def gradient(self) -> Floats:
        """Once a moment, whoever asks."""
        return self._gradient

    @cached_property
    def _gradient(self) -> Floats:
        weighed, u = self._scene.cells, self._state.u.astype(float, copy=False)
        cells = self._weighed
        whole = self._tables.of_body(displacement_gradient(u, cells))
        if weighed is not None and weighed.phase is not None:
            whole = self._by_phase(weighed.phase, u, cells, whole)
        return read_only(whole.reshape(-1, 2, 2))

    def lost_stress(self) -> Floats | None:
        """Found anew whenever it is called: one diagnostic does."""
        scene, state = self._scene, self._state
        if not (scene.tears and isinstance(scene.experiment.fracture, (Softens, SoftensCells))):
            return None
        u = state.u.astype(float, copy=False)
        planes = lost_stress(scene, state, u, self._weighed)
        return self._tables.of_body(planes).reshape(-1, 2, 2)

    @cached_property
    def _weighed(self) -> list[tuple[Patch, Floats]]:
        """The cells that count with their shares."""
        weighed = self._scene.cells
        return [
            (patch, (weighed.of(patch) if weighed else 1.0) * self._intact(patch))
            for patch in self._scene.patches
        ]

    def _by_phase(
        self, phase: NDArray[Any], u: Floats, cells: list[tuple[Patch, Floats]], whole: Floats
    ) -> Floats:
        """The gradient from the cells of a particle's own material alone: at a border it jumps.
        Who has no such cell takes the mean of those beside it that have, if there is any."""
        found, own = whole.copy(), self._tables.phase
        for number in np.unique(own).tolist():
            alike = [
                (patch, share * (patch.corners[0].of(phase[patch.polygon.kind]) == number))
                for patch, share in cells
            ]
            planes = _known_beside(displacement_gradient(u, alike), alike, cells)
            within = self._tables.of_body(planes)
            some = (own == number) & np.isfinite(within).all(axis=1)
            found[some] = within[some]
        return found

    def inside_out(self) -> str | None:
        """A warning where cells have turned over or, if none has, corners of cells; None where none
        has: a rule of positions does not mind, a body does. Torn cells do not count: the parts of a
        broken body go their own ways."""
        remedy = "let the leaders go less far, or weaken the rule where it couples x and y"
        if found := self._turned(area_share, "cells have turned over"):
            return f"the last state is inside out: {found}; {remedy}"
        if found := self._turned(corner_share, "cells have a corner that has turned over"):
            return f"the last state is folded: {found}; {remedy}"
        return None

    def _turned(self, share: Callable[..., Any], what: str) -> str | None:
        """Of how many cells the share of the area at rest is negative, and where it is worst."""
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
            f"{turned} of {total} {what}, the worst, at particle {number}, to {worst:.3g} of its "
            "area at rest"
        )

    def _intact(self, patch: Patch) -> NDArray[np.bool_]:
        """Which cells of a patch have no broken bond between their corners."""
        intact = patch.whole
        if self._state.broken_step is None:
            return intact
        for block, slot in patch.bonds(self._scene.neighbourhood.slots):
            plane, at_this_end = self._scene.neighbourhood.home[slot]
            home = block if at_this_end else block.seen_through(slot)
            intact = intact & (home.within(self._state.broken_step[plane]) < 0)
        return intact


class StateMoment(Moment):
    """A state as a table; bonds that broke later than asked for count as they were before.

    An equilibrium `within` a step, at an increment of load, has the roles of that step, and the
    numbers and loads of that moment.
    """

    def __init__(
        self,
        state: State,
        tables: Tables,
        no_later_than: int | None = None,
        within: float | None = None,
    ) -> None:
        self._now: float = state.step if within is None else within
        self.step, self._within = math.ceil(self._now), within
        self._no_later_than = self.step if no_later_than is None else no_later_than
        self._state, self._tables = state, tables.at(self._now)
        self._scene, self._raster = tables.scene, tables.scene.raster

    def of(self, state: State, tables: Tables) -> StateMoment:
        """The same moment of another state."""
        return StateMoment(state, tables, self._no_later_than, self._within)

    @property
    def body(self) -> NDArray[np.bool_]:
        """The same at every moment."""
        return self._tables.body

    @property
    def inside(self) -> NDArray[np.bool_]:
        """The same at every moment."""
        return self._tables.inside

    @cached_property
    def cells(self) -> StateCells:
        """Made where somebody asks."""
        return StateCells(self._state, self._tables)

    @cached_property
    def forces(self) -> ForceValues:
        """Made where somebody asks."""
        return StateForces(self._state, self._tables)

    def rows(self, numbers: tuple[int, ...]) -> Indices:
        """Numbers count from 1 in the order of the rows."""
        return np.array(numbers, np.intp) - 1

    def nearest(self, points: tuple[Pair, ...]) -> Indices:
        """As leaders are selected."""
        return Selecting(self._raster).nearest(points)

    @cached_property
    def _u(self) -> Floats:
        return read_only(self._raster.table(self._state.u))

    def displacement(self, rows: Indices | None = None) -> Floats:
        """The whole table is made once a moment; a few rows are made without it."""
        if rows is None:
            return self._u
        place = self._raster.place_of(rows)
        return read_only(np.stack([plane.ravel()[place] for plane in self._state.u], axis=1))

    def previous_displacement(self) -> Floats:
        """From the buffer of the step before."""
        return read_only(self._raster.table(self._state.previous))

    def reference(self, rows: Indices | None = None) -> Floats:
        """X."""
        if rows is None:
            return self._tables.reference
        return read_only(self._raster.reference(rows))

    def position(self) -> Floats:
        """x = X + u, (particle, axis), in float64 whatever the run's precision."""
        return self._tables.add_reference(
            self._raster.table(self._state.u).astype(float, copy=False)
        )

    def kind(self) -> NDArray[np.int8]:
        """(particle,): the role during this step."""
        return kinds_at(self._raster, self._scene.leading, self.step)

    def sum_over_neighbours(
        self, function: Callable[[Any, Any], Any], *, intact_only: bool = False
    ) -> Floats:
        """The loop of the stepper, on the body's particles."""

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
        """At time 0 those of step 1 lead."""
        step = max(self.step, 1)
        return tuple(
            LeaderRows(read_only(each.rows), each.group.leads(step), each.axes)
            for each in self._scene.leading
        )

    def loads(self) -> tuple[LoadRows, ...]:
        """As they act in this step."""
        loads = self._scene.loads
        return tuple(
            LoadRows(read_only(each.rows), read_only(each.share), each.load.force_at(self._now))
            for each in (loads.each if loads else ())
        )

    def touching(self) -> tuple[TouchingRows, ...]:
        """Found once a moment."""
        return self._touching

    @cached_property
    def _touching(self) -> tuple[TouchingRows, ...]:
        if not self._scene.barriers:
            return ()
        found = Contact(self._scene).touching(self._state, self._now)
        return tuple(TouchingRows(read_only(rows), read_only(n)) for rows, n in found)

    def broken_bonds(self) -> int:
        """Every bond that breaks is marked on one plane, once."""
        broken = self._state.broken_step
        return 0 if broken is None else int((broken >= 0).sum())

    def bonds(self) -> BondHistory:
        """Made anew: seldom wanted."""
        parts = vars(describe_bonds(self._scene)).values()
        values = (*parts, self.broken_step(), self.broken_strain())
        return BondHistory(*(read_only(value) for value in values))

    def broken_step(self) -> NDArray[np.int32]:
        """From the planes; none has where none can."""
        bonds, broken = self._scene.bonds, self._state.broken_step
        if broken is None:
            return np.full(len(bonds.ends), -1, np.int32)
        steps: NDArray[np.int32] = self._of_bonds(broken)
        return np.where(steps > self._no_later_than, np.int32(-1), steps)

    def broken_strain(self) -> Floats:
        """From the lengths, in float64 whatever the run's precision; what was cut has none."""
        scene, lengths, steps = self._scene, self._state.broken_length, self.broken_step()
        if lengths is None:
            return np.full(len(steps), np.nan)
        rests = np.array([length(plane.slot.rest) for plane in scene.neighbourhood.planes])
        strains = self._of_bonds(lengths) / rests[scene.bonds.plane] - 1
        return np.where((steps > 0) & (strains > -1.0), strains, np.nan)

    def remembered(self, name: str) -> NDArray[Any]:
        """In the order of the bonds' table, or of the particles' numbers."""
        experiment, state = self._scene.experiment, self._state
        names = [number.name for number in bond_numbers(experiment)]
        of_bonds = dict(zip(names, state.bond_values, strict=True))
        names = [number.name for number in particle_numbers(experiment)]
        of_particles = dict(zip(names, state.particle_values, strict=True))
        if name in of_bonds:
            return read_only(self._of_bonds(of_bonds[name]))
        if name in of_particles:
            return read_only(self._raster.table(of_particles[name][None])[:, 0])
        known = [*of_bonds, *of_particles]
        raise ValueError(f"no part remembers '{name}'{did_you_mean(name, known)}")

    def _of_bonds(self, planes: NDArray[Any]) -> NDArray[Any]:
        """Values on the planes of bonds, (bond,)."""
        bonds = self._scene.bonds
        return np.asarray(planes.reshape(len(planes), -1)[bonds.plane, bonds.place])


class StateForces(ForceValues):
    """What the scene's rule makes of a state."""

    def __init__(self, state: State, tables: Tables) -> None:
        self._state, self._tables = state, tables
        self._rule = tables.scene.experiment.rule

    @property
    def stiffness(self) -> Stiffness:
        """The rule's, of each particle where fields make it differ."""
        stiffness = self._tables.stiffness
        if stiffness is None:
            raise ValueError(
                f"the rule '{self._rule.type}' is not calibrated to a material: declare "
                '"material" or "forces" among the `needs`'
            )
        return stiffness

    @property
    def through_thickness(self) -> Any:
        """The rule's, of each particle where fields make it differ."""
        return self._tables.through_thickness

    def on_particles(self) -> Floats:
        """Once a moment, whoever asks."""
        return self._on_particles

    @cached_property
    def _on_particles(self) -> Floats:
        with self._blaming_rule():
            forces = self._tables.followers.forces(self._u, self._state)
        return self._tables.of_body(forces)

    def energy(self) -> float:
        """The rule's."""
        with self._blaming_rule():
            return self._tables.followers.energy(self._u, self._state)

    @property
    def _u(self) -> Floats:
        return self._state.u.astype(float, copy=False)

    def _blaming_rule(self) -> AbstractContextManager[None]:
        return blaming(self._rule, f"to return forces at step {self._state.step}", "rule")
