"""Stiffness of each cell where fields make the material of a rule differ; a cell that a border of
two materials cuts is a laminate of layers along the border.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.lattice.cells import WeighedCells
from pbdkit.lattice.fill import CELLS_AT_ONCE, NEAREST, cut_by_border
from pbdkit.lattice.raster import FOLLOWER, Block, Mask, Raster
from pbdkit.model.bodies import Body
from pbdkit.model.experiment import Experiment
from pbdkit.plugin import MixesCells, Setting, Slot, Stiffness, TearsCells
from pbdkit.plugin.fields import ByRegion
from pbdkit.plugin.lattice import CellPolygon
from pbdkit.plugin.rule import material_of
from pbdkit.scene.constants import Values, kinds_of, named_weights, signed_distance, values_at

Floats = NDArray[np.float64]
ACROSS, ALONG = [0, 2], [1]
"""Which of the components (normal, tangential, shear) the layers share as stress, and as strain."""

ROUND = 1e-6
"""A border whose directions are as evenly spread as this has none: a square within a cell."""
DIRECTIONS = 12
"""Over so many the stiffness is then averaged: as many as turn every lattice into itself."""


def layered(outer: Floats, inner: Floats, share: Floats, facing: Floats) -> Floats:
    """(cell, 3, 3): the stiffness of cells of which the border faces so, (cell, 2, 2), the sum of
    n nᵀ over its length: a laminate along its main direction, or where it has none the mean of
    laminates of all directions."""
    whole = facing[:, 0, 0] + facing[:, 1, 1]
    spread = np.array([facing[:, 0, 0] - facing[:, 1, 1], 2 * facing[:, 0, 1]])
    # Borders along an axis are along it to the last bit.
    spread[np.abs(spread) <= 1e-9 * whole] = 0.0
    angle = np.arctan2(spread[1], spread[0]) / 2
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    normal[(spread[1] == 0.0) & (spread[0] < 0.0)] = [0.0, 1.0]
    found = laminate(outer, inner, share, normal)
    even = np.hypot(*spread) <= ROUND * whole
    if even.any():
        parts = outer[even], inner[even], share[even]
        angles = np.pi / DIRECTIONS * np.arange(DIRECTIONS)
        turned = [
            laminate(*parts, np.tile([np.cos(a), np.sin(a)], (len(parts[0]), 1))) for a in angles
        ]
        found[even] = sum(turned) / DIRECTIONS
    return found


def laminate(outer: Floats, inner: Floats, share: Floats, normal: Floats) -> Floats:
    """(cell, 3, 3): the stiffness of layers, `share` (cell,) of them of the material `inner` and
    the rest of `outer`, (cell, 3, 3) in the components xx, yy, xy with the angle of shear, under
    the `normal` (cell, 2).

    The tractions across the layers and the strain along them are the same in both (Backus 1962):
    harmonic means across, arithmetic along.
    """
    turn = _to_layers(normal)
    back = _to_layers(normal * [1.0, -1.0])
    of, one = (np.swapaxes(back, 1, 2) @ c @ back for c in (outer, inner))
    f = share[:, None, None]

    def mean(value: Floats, other: Floats) -> Floats:
        return (1.0 - f) * value + f * other

    pieces = [_pieces(c) for c in (of, one)]
    soft, follows, own = (mean(a, b) for a, b in zip(*pieces, strict=True))
    found = np.empty_like(outer)
    across = np.linalg.inv(soft)
    both = across @ follows
    found[:, ACROSS[0], ACROSS[0]], found[:, 0, 2] = across[:, 0, 0], across[:, 0, 1]
    found[:, 2, 0], found[:, 2, 2] = across[:, 1, 0], across[:, 1, 1]
    found[:, ACROSS, 1], found[:, 1, ACROSS] = both[:, :, 0], both[:, :, 0]
    found[:, 1, 1] = (own + np.swapaxes(follows, 1, 2) @ both)[:, 0, 0]
    return np.asarray(np.swapaxes(turn, 1, 2) @ found @ turn)


def _pieces(c: Floats) -> tuple[Any, Any, Any]:
    """Of one material in the layers' axes: compliance across, C_nn⁻¹; C_nn⁻¹ C_nt; and what stands
    along for itself, C_tt - C_tn C_nn⁻¹ C_nt."""
    across, to = c[:, ACROSS][:, :, ACROSS], c[:, ACROSS][:, :, ALONG]
    soft = np.linalg.inv(across)
    follows = soft @ to
    return soft, follows, c[:, ALONG][:, :, ALONG] - np.swapaxes(to, 1, 2) @ follows


def _to_layers(normal: Floats) -> Floats:
    """(cell, 3, 3): from strains (x, y, angle) to (normal, tangential, angle)."""
    c, s = normal.T
    return np.moveaxis(
        np.array(
            [[c * c, s * s, c * s], [s * s, c * c, -c * s], [-2 * c * s, 2 * c * s, c * c - s * s]]
        ),
        -1,
        0,
    )


STIFFNESS = "stiffness"
"""The parameter that multiplies a cell's stiffness, whatever the rule."""
PLACES = {"xx": (0, 0), "yy": (1, 1), "xy": (0, 1), "x_shear": (0, 2), "y_shear": (1, 2)}
PLACES["shear"] = (2, 2)
"""Where the components of a stiffness stand in a matrix."""


def weighed(
    experiment: Experiment, raster: Raster, setting: Setting, cells: WeighedCells | None
) -> WeighedCells | None:
    """The cells with the weights that fields give them; the same where the rule has none.

    Raises ExperimentError where the rule does not say what other materials are for it.
    """
    rule = experiment.rule
    if not (rule.varying and rule.uses_cells):
        return cells
    _refuse_unmixable(experiment)
    shape = (1 + max(p.kind for p in setting.cells.polygons), *raster.shape)
    torn = experiment.parts_bonds and isinstance(rule, TearsCells) and isinstance(rule, MixesCells)
    names = (*PLACES, SPRINGS) if torn else (*PLACES,)
    weight, mixed = np.ones(shape), {name: np.zeros(shape) for name in names}
    phase = np.zeros(shape, np.int64) if regions_of(experiment) else None
    for polygon in setting.cells.polygons:
        if some := _Cells.of(experiment, raster, polygon):
            factor, stiffness = some.materials()
            there = (polygon.kind, *some.place)
            weight[there] = factor
            if phase is not None:
                phase[there] = some.phases()
            for name, at in PLACES.items():
                mixed[name][there] = np.where(factor == 0.0, stiffness[(slice(None), *at)], 0.0)
            if SPRINGS in mixed:
                mixed[SPRINGS][there] = _springs(rule, setting, factor == 0.0, stiffness)
    share = cells.share if cells else None
    if share is not None:
        weight *= share
        for of_name in mixed.values():
            of_name *= share
    used = [name for name, planes in mixed.items() if raster.communicator.any(planes.any())]
    slots = [slot for own in setting.slots for slot in own]
    weights = tuple(_weights(experiment, setting, slots, name) for name in used)
    planes = tuple(mixed[name] for name in used)
    return WeighedCells(setting.cells, share, weight, planes, weights, phase, tuple(used))


def _springs(rule: Any, setting: Setting, mixed: Mask, stiffness: Floats) -> Floats:
    """How many times the rule's springs cells have that are torn, 0 where they are not mixed."""
    found = np.zeros(len(mixed))
    found[mixed] = rule.spring_share(stiffness[mixed], setting)
    return found


def regions_of(experiment: Experiment) -> dict[str, Body]:
    """The regions that fields of the rule name, in the experiment's order."""
    fields = experiment.rule.varying.values()
    named = {n for field in fields if isinstance(field, ByRegion) for n, _ in field.values}
    return {name: body for name, body in experiment.regions.items() if name in named}


def _refuse_unmixable(experiment: Experiment) -> None:
    rule = experiment.rule
    others = sorted(rule.varying.keys() - {STIFFNESS})
    if others and not isinstance(rule, MixesCells):
        raise ExperimentError(
            f"'{rule.type}' works cell by cell and does not say what cells of another "
            f"{others[0]} do: one number for all is needed",
            ("rule", others[0]),
        )


def _weights(
    experiment: Experiment, setting: Setting, slots: list[Slot], name: str
) -> dict[Slot, Any]:
    """The rule's weights for cells that have one component of stiffness alone."""
    rule = experiment.rule
    assert isinstance(rule, MixesCells)
    if name == SPRINGS:
        return {s: named_weights(rule.spring_weights(s, setting), rule) for s in slots}
    one = Stiffness(**{n: float(n == name) for n in PLACES})
    return {s: named_weights(rule.cell_weights(s, setting, one), rule) for s in slots}


def stiffness_at(experiment: Experiment, values: Values) -> Floats:
    """(place, 3, 3) over Young's modulus, for parameters at places; NaN where there is none."""
    rule, size = experiment.rule, len(next(iter(values.values())))
    others = {name: value for name, value in values.items() if name != STIFFNESS}
    parts, kind = kinds_of(rule, others) if others else ([rule], np.zeros(size, np.intp))
    table = np.full((len(parts), 3, 3), np.nan)
    for matrix, part in zip(table, parts, strict=True):
        if (c := material_of(part)) is not None:
            for name, (row, column) in PLACES.items():
                matrix[row, column] = matrix[column, row] = getattr(c, name)
    found = table[kind]
    if STIFFNESS in values:
        found *= (values[STIFFNESS] / getattr(rule, STIFFNESS))[:, None, None]
    return found


SPRINGS = "springs"
"""The name of what remains of cells of a stiffness of their own where they are torn."""


@dataclass(frozen=True)
class _Cells:
    """Cells of one shape that have a corner in the body: `place` (sublattice, cell, cell) of their
    first corners on the raster, x and y of all corners, (corner, cell)."""

    experiment: Experiment
    polygon: CellPolygon
    place: Any
    x: Floats
    y: Floats
    inside: Mask
    """(cell,): whether all corners are of the body."""

    @classmethod
    def of(cls, experiment: Experiment, raster: Raster, polygon: CellPolygon) -> _Cells | None:
        """Those of the raster; None where there is none."""
        steps = np.array([corner.cell for corner in polygon.corners])
        start, stop = np.maximum(0, -steps.min(axis=0)), raster.shape[1:] - steps.max(axis=0)
        block = Block(polygon.source, tuple(start.tolist()), tuple(stop.tolist()))
        corners = [block.seen_through(corner) for corner in polygon.corners]
        body = np.array([corner.of(raster.kind) == FOLLOWER for corner in corners])
        found = np.nonzero(body.any(axis=0))
        if not len(found[0]):
            return None
        first = raster.reference_planes(block)
        x, y = (np.broadcast_to(c, body.shape[1:])[found] for c in first)
        at = np.array([(x + r.x, y + r.y) for r in polygon.rest])
        at += np.array(raster.lattice.origin)[:, None]
        place = (polygon.source, *(n + a for n, a in zip(found, start, strict=True)))
        inside = np.all([own[found] for own in body], axis=0)
        return cls(experiment, polygon, place, at[:, 0], at[:, 1], inside)

    def materials(self) -> tuple[Floats, Floats]:
        """(factor, stiffness): how many times the stiffness of the rule each cell has, 0 where that
        is no such multiple, and its stiffness there, (cell, 3, 3)."""
        rule, x, y = self.experiment.rule, self.x.mean(axis=0), self.y.mean(axis=0)
        values = dict(values_at(self.experiment, "rule", x, y, self.inside))
        if all(name == STIFFNESS for name in values) and not isinstance(rule, MixesCells):
            return self._factors(values[STIFFNESS]), np.zeros((len(x), 3, 3))
        mixed = self.phases() < 0
        factor = np.ones(len(x))
        if STIFFNESS in values:
            factor = values[STIFFNESS] / getattr(rule, STIFFNESS)
        others = [values[name] != getattr(rule, name) for name in values if name != STIFFNESS]
        apart = np.logical_or.reduce([mixed, *others])
        stiffness = np.zeros((len(x), 3, 3))
        some = np.flatnonzero(apart)
        if len(some):
            stiffness[some] = self._mixed(values, some)
        return np.where(apart, 0.0, factor), stiffness

    def phases(self) -> NDArray[np.int64]:
        """(cell,): the regions that hold each, a bit a region; -1 where a border cuts it."""
        found = np.zeros(self.x.shape[1], np.int64)
        for bit, (_, share, _) in enumerate(self._borders):
            found |= (share == 1.0).astype(np.int64) << bit
        for _, share, _ in self._borders:
            found[(share > 0.0) & (share < 1.0)] = -1
        return found

    def _mixed(self, values: Values, some: Any) -> Floats:
        """The stiffness of some cells: region after region, as layers along its border."""
        here = {name: value[some] for name, value in values.items()}
        fields = self.experiment.rule.varying
        for name, field in fields.items():
            if isinstance(field, ByRegion):
                here[name] = np.full(len(some), field.otherwise)
        found = stiffness_at(self.experiment, here)
        for region, share, facing in self._borders:
            f, within = share[some], dict(here)
            for name, field in fields.items():
                if isinstance(field, ByRegion) and region in dict(field.values):
                    within[name] = np.full(len(some), dict(field.values)[region])
            inner = stiffness_at(self.experiment, within)
            part = (f > 0.0) & (f < 1.0)
            found[part] = layered(found[part], inner[part], f[part], facing[some][part])
            found[f == 1.0] = inner[f == 1.0]
            here = {name: np.where(f >= 0.5, within[name], value) for name, value in here.items()}
        if not np.isfinite(found).all():
            raise ExperimentError(
                f"'{self.experiment.rule.type}' has no finite stiffness for some cells, as at "
                "poisson_ratio -1: a body of several materials needs one",
                ("rule",),
            )
        return found

    def _factors(self, otherwise: Floats) -> Floats:
        """Where a cell is only as stiff as its parts on the average."""
        rule = self.experiment.rule
        field, base = rule.varying[STIFFNESS], getattr(rule, STIFFNESS)
        if not isinstance(field, ByRegion):
            return np.asarray(otherwise / base)
        found = np.full(len(otherwise), field.otherwise)
        for region, share, _ in self._borders:
            found += share * (dict(field.values)[region] - found)
        return np.asarray(found / base)

    @cached_property
    def _borders(self) -> list[tuple[str, Floats, Floats]]:
        """The regions that some field names, each with the share of every cell inside and where
        its border faces there."""
        return [
            (name, *self._shares(region)) for name, region in regions_of(self.experiment).items()
        ]

    def _shares(self, region: Body) -> tuple[Floats, Floats]:
        signed = partial(signed_distance, region, self.experiment.lattice.cell())
        at_corners = signed(self.x, self.y)
        share = (at_corners <= 0.0).all(axis=0).astype(float)
        facing = np.zeros((len(share), 2, 2))
        width = max(math.dist(a, b) for a in self.polygon.rest for b in self.polygon.rest)
        exaggerates = region.exaggerates()
        reach = width if exaggerates else NEAREST * width
        near = np.flatnonzero(np.abs(at_corners).min(axis=0) <= reach)
        for some in np.split(near, range(CELLS_AT_ONCE, len(near), CELLS_AT_ONCE)):
            corners = self.x[:, some], self.y[:, some]
            share[some], facing[some] = cut_by_border(signed, *corners, exaggerates=exaggerates)
        return share, facing
