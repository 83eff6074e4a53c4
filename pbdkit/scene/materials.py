"""Stiffness of cells for rules with a spatially varying material.

A cell that is cut by the border of two materials is replaced by a laminate with layers along the
border.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats, Mask
from pbdkit.errors import ExperimentError
from pbdkit.lattice.cells import WeighedCells
from pbdkit.lattice.fill import CELLS_AT_ONCE, NEAREST, cut_by_border
from pbdkit.lattice.raster import FOLLOWER, Block, Raster
from pbdkit.model.bodies import Body
from pbdkit.model.experiment import Experiment
from pbdkit.plugin import Lattice, MixesCells, Setting, Slot, Stiffness, TearsCells
from pbdkit.plugin.fields import ByRegion
from pbdkit.plugin.lattice import CellPolygon
from pbdkit.plugin.rule import material_of
from pbdkit.scene.constants import Values, kinds_of, named_weights, signed_distance, values_at

ACROSS = [0, 2]
"""Indices of the components with the same stress in all layers. The components are (normal,
tangential, shear)."""
ALONG = [1]
"""Indices of the components with the same strain in all layers."""
ISOTROPY_RTOL = 1e-6
"""Relative anisotropy of the integral of n nᵀ below which a border is treated as having no main
direction. This is so, for instance, for a square inside a cell."""
DIRECTIONS = 12
"""Number of directions over which the stiffness of cells without a main direction is averaged. The
set of directions has the rotational symmetries of every lattice."""


def layered(outer: Floats, inner: Floats, share: Floats, facing: Floats) -> Floats:
    """Compute the stiffness of cells that are cut by a border between two materials.

    Parameters
    ----------
    outer, inner
        Stiffness of both materials in each cell, (cell, 3, 3).
    share
        Area fraction of the inner material, (cell,).
    facing
        Array of shape (cell, 2, 2) with the integral of n nᵀ over the border in each cell, where n
        is the normal of the border.

    Returns
    -------
    NDArray
        Stiffness of shape (cell, 3, 3) of a laminate with layers along the main direction of the
        border. If the border has no main direction, it is the mean over laminates of all
        directions.
    """
    whole = facing[:, 0, 0] + facing[:, 1, 1]
    spread = np.array([facing[:, 0, 0] - facing[:, 1, 1], 2 * facing[:, 0, 1]])
    # The direction is exact for borders along an axis.
    spread[np.abs(spread) <= 1e-9 * whole] = 0.0
    angle = np.arctan2(spread[1], spread[0]) / 2
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    normal[(spread[1] == 0.0) & (spread[0] < 0.0)] = [0.0, 1.0]
    result = laminate(outer, inner, share, normal)
    is_isotropic = np.hypot(*spread) <= ISOTROPY_RTOL * whole
    if is_isotropic.any():
        parts = outer[is_isotropic], inner[is_isotropic], share[is_isotropic]
        angles = np.pi / DIRECTIONS * np.arange(DIRECTIONS)
        rotated = [
            laminate(*parts, np.tile([np.cos(a), np.sin(a)], (len(parts[0]), 1))) for a in angles
        ]
        result[is_isotropic] = sum(rotated) / DIRECTIONS
    return result


def laminate(outer: Floats, inner: Floats, share: Floats, normal: Floats) -> Floats:
    """Compute the stiffness of a laminate of two materials.

    Parameters
    ----------
    outer, inner
        Arrays of shape (cell, 3, 3) with the stiffness of both materials, in the components xx, yy
        and xy with the engineering shear strain.
    share
        Area fraction of the inner material, (cell,).
    normal
        Normal of the layers, (cell, 2).

    Returns
    -------
    NDArray
        Stiffness, (cell, 3, 3).

    Notes
    -----
    The tractions on the layers and the strain along the layers are the same in both materials
    (Backus 1962). Therefore the stiffness across the layers is a harmonic mean, and the stiffness
    along them an arithmetic mean.
    """
    turn = _to_layers(normal)
    back = _to_layers(normal * [1.0, -1.0])
    outer_layers, inner_layers = (np.swapaxes(back, 1, 2) @ c @ back for c in (outer, inner))
    f = share[:, None, None]

    def mean(value: Floats, other: Floats) -> Floats:
        return (1.0 - f) * value + f * other

    parts = [_pieces(c) for c in (outer_layers, inner_layers)]
    soft, ratio, along = (mean(a, b) for a, b in zip(*parts, strict=True))
    result = np.empty_like(outer)
    across = np.linalg.inv(soft)
    coupling = across @ ratio
    result[:, ACROSS[0], ACROSS[0]], result[:, 0, 2] = across[:, 0, 0], across[:, 0, 1]
    result[:, 2, 0], result[:, 2, 2] = across[:, 1, 0], across[:, 1, 1]
    result[:, ACROSS, 1], result[:, 1, ACROSS] = coupling[:, :, 0], coupling[:, :, 0]
    result[:, 1, 1] = (along + np.swapaxes(ratio, 1, 2) @ coupling)[:, 0, 0]
    return np.asarray(np.swapaxes(turn, 1, 2) @ result @ turn)


def _pieces(c: Floats) -> tuple[Any, Any, Any]:
    """Return those terms of a material that are averaged over the layers. They are given
    in the axes of the layers.

    The terms are C_nn⁻¹, C_nn⁻¹ C_nt and C_tt - C_tn C_nn⁻¹ C_nt. The index n stands for the
    components across the layers, and t for the component along them.
    """
    across, coupling = c[:, ACROSS][:, :, ACROSS], c[:, ACROSS][:, :, ALONG]
    compliance = np.linalg.inv(across)
    ratio = compliance @ coupling
    return compliance, ratio, c[:, ALONG][:, :, ALONG] - np.swapaxes(coupling, 1, 2) @ ratio


def _to_layers(normal: Floats) -> Floats:
    """Return the matrices of shape (cell, 3, 3) that rotate strains (xx, yy, engineering xy) to the
    axes of the layers."""
    c, s = normal.T
    return np.moveaxis(
        np.array(
            [[c * c, s * s, c * s], [s * s, c * c, -c * s], [-2 * c * s, 2 * c * s, c * c - s * s]]
        ),
        -1,
        0,
    )


STIFFNESS = "stiffness"
"""Name of the parameter that scales the stiffness of cells for every rule."""
SPRINGS = "springs"
"""Name under which the springs of torn cells are listed, in addition to the names of the components
of stiffness."""
PLACES = {
    "xx": (0, 0),
    "yy": (1, 1),
    "xy": (0, 1),
    "x_shear": (0, 2),
    "y_shear": (1, 2),
    "shear": (2, 2),
}
"""Row and column of the components of a stiffness in its matrix."""


def weighed(
    experiment: Experiment, raster: Raster, setting: Setting, cells: WeighedCells | None
) -> WeighedCells | None:
    """Apply the spatially varying parameters of the rule to the weights of cells.

    Parameters
    ----------
    experiment
        The experiment.
    raster
        Particles of the scene.
    setting
        Lattice context of the rule.
    cells
        Weighted cells of the body; None for whole cells.

    Returns
    -------
    WeighedCells or None
        `cells` unchanged if the rule has no varying parameters.

    Raises
    ------
    ExperimentError
        If the rule does not support cells with a material other than its own.
    """
    rule = experiment.rule
    if not (rule.varying and rule.uses_cells):
        return cells
    _refuse_unmixable(experiment)
    shape = (1 + max(p.kind for p in setting.cells.polygons), *raster.shape)
    can_tear = (
        experiment.parts_bonds and isinstance(rule, TearsCells) and isinstance(rule, MixesCells)
    )
    names = (*PLACES, SPRINGS) if can_tear else (*PLACES,)
    weight, mixed = np.ones(shape), {name: np.zeros(shape) for name in names}
    phase = np.zeros(shape, np.int64) if regions_of(experiment) else None
    for polygon in setting.cells.polygons:
        if group := _Cells.of(experiment, raster, polygon):
            factor, stiffness = group.materials()
            target = (polygon.kind, *group.place)
            weight[target] = factor
            if phase is not None:
                phase[target] = group.phases()
            for name, at in PLACES.items():
                mixed[name][target] = np.where(factor == 0.0, stiffness[(slice(None), *at)], 0.0)
            if SPRINGS in mixed:
                mixed[SPRINGS][target] = _springs(rule, setting, factor == 0.0, stiffness)
    share = cells.share if cells else None
    if share is not None:
        weight *= share
        for values in mixed.values():
            values *= share
    components = [name for name, planes in mixed.items() if raster.communicator.any(planes.any())]
    slots = [slot for ends in setting.slots for slot in ends]
    weights = tuple(_weights(experiment, setting, slots, name) for name in components)
    planes = tuple(mixed[name] for name in components)
    return WeighedCells(setting.cells, share, weight, planes, weights, phase, tuple(components))


def _springs(rule: Any, setting: Setting, mixed: Mask, stiffness: Floats) -> Floats:
    """Return the factor by which the springs of the rule are multiplied in each cell. It is 0 for
    cells that are not `mixed`."""
    result = np.zeros(len(mixed))
    result[mixed] = rule.spring_share(stiffness[mixed], setting)
    return result


def regions_of(experiment: Experiment) -> dict[str, Body]:
    """Return the regions to which parameters of the rule refer, in the order of the experiment."""
    fields = experiment.rule.varying.values()
    names = {n for field in fields if isinstance(field, ByRegion) for n, _ in field.values}
    return {name: body for name, body in experiment.regions.items() if name in names}


def _refuse_unmixable(experiment: Experiment) -> None:
    rule = experiment.rule
    names = sorted(rule.varying.keys() - {STIFFNESS})
    if names and not isinstance(rule, MixesCells):
        raise ExperimentError(
            f"'{rule.type}' does not define cells with another {names[0]}; it must be a single "
            "number",
            ("rule", names[0]),
        )


def _weights(
    experiment: Experiment, setting: Setting, slots: list[Slot], name: str
) -> dict[Slot, Any]:
    """Return the weights of the rule for cells with a single component of stiffness."""
    rule = experiment.rule
    assert isinstance(rule, MixesCells)
    if name == SPRINGS:
        return {s: named_weights(rule.spring_weights(s, setting), rule) for s in slots}
    unit = Stiffness(**{n: float(n == name) for n in PLACES})
    return {s: named_weights(rule.cell_weights(s, setting, unit), rule) for s in slots}


def stiffness_at(experiment: Experiment, values: Values) -> Floats:
    """Compute the stiffness, divided by Young's modulus, for the parameters at places.

    Returns
    -------
    NDArray
        Stiffness of shape (place, 3, 3); NaN where the material has no finite stiffness.
    """
    rule, size = experiment.rule, len(next(iter(values.values())))
    parameters = {name: value for name, value in values.items() if name != STIFFNESS}
    parts, kind = kinds_of(rule, parameters) if parameters else ([rule], np.zeros(size, np.intp))
    table = np.full((len(parts), 3, 3), np.nan)
    for matrix, part in zip(table, parts, strict=True):
        if (c := material_of(part)) is not None:
            for name, (row, column) in PLACES.items():
                matrix[row, column] = matrix[column, row] = getattr(c, name)
    result = table[kind]
    if STIFFNESS in values:
        result *= (values[STIFFNESS] / getattr(rule, STIFFNESS))[:, None, None]
    return result


@dataclass(frozen=True)
class _Cells:
    """Cells of one shape with a corner in the body.

    Parameters
    ----------
    experiment
        The experiment.
    polygon
        Shape of the cells.
    place
        Places of their first corners on the raster, (sublattice, cell, cell).
    x, y
        Coordinates of the corners, (corner, cell).
    inside
        Mask of the cells with all corners in the body, (cell,).
    """

    experiment: Experiment
    polygon: CellPolygon
    place: Any
    x: Floats
    y: Floats
    inside: Mask

    @classmethod
    def of(cls, experiment: Experiment, raster: Raster, polygon: CellPolygon) -> _Cells | None:
        """Return the cells of a raster, or None if there are none."""
        steps = np.array([corner.cell for corner in polygon.corners])
        start, stop = np.maximum(0, -steps.min(axis=0)), raster.shape[1:] - steps.max(axis=0)
        block = Block(polygon.source, tuple(start.tolist()), tuple(stop.tolist()))
        corners = [block.seen_through(corner) for corner in polygon.corners]
        body = np.array([corner.of(raster.kind) == FOLLOWER for corner in corners])
        cells = np.nonzero(body.any(axis=0))
        if not len(cells[0]):
            return None
        first = raster.reference_planes(block)
        x, y = (np.broadcast_to(c, body.shape[1:])[cells] for c in first)
        at = np.array([(x + r.x, y + r.y) for r in polygon.rest])
        at += np.array(raster.lattice.origin)[:, None]
        place = (polygon.source, *(n + a for n, a in zip(cells, start, strict=True)))
        inside = np.all([mask[cells] for mask in body], axis=0)
        return cls(experiment, polygon, place, at[:, 0], at[:, 1], inside)

    def materials(self) -> tuple[Floats, Floats]:
        """Compute the stiffness of each cell.

        Returns
        -------
        tuple
            Ratio of the stiffness of each cell to the stiffness of the rule, (cell,). It is 0 if
            the stiffness of the cell is not a multiple of the stiffness of the rule. The second
            result is the stiffness of the cells with ratio 0, (cell, 3, 3).
        """
        rule, x, y = self.experiment.rule, self.x.mean(axis=0), self.y.mean(axis=0)
        values = dict(values_at(self.experiment, "rule", x, y, self.inside))
        if all(name == STIFFNESS for name in values) and not isinstance(rule, MixesCells):
            return self._factors(values[STIFFNESS]), np.zeros((len(x), 3, 3))
        mixed = self.phases() < 0
        factor = np.ones(len(x))
        if STIFFNESS in values:
            factor = values[STIFFNESS] / getattr(rule, STIFFNESS)
        differences = [values[name] != getattr(rule, name) for name in values if name != STIFFNESS]
        is_other = np.logical_or.reduce([mixed, *differences])
        stiffness = np.zeros((len(x), 3, 3))
        cells = np.flatnonzero(is_other)
        if len(cells):
            stiffness[cells] = self._mixed(values, cells)
        return np.where(is_other, 0.0, factor), stiffness

    def phases(self) -> NDArray[np.int64]:
        """Return for each cell the regions that contain it, as a bit mask, (cell,). The result is
        -1 if a border cuts the cell.
        """
        result = np.zeros(self.x.shape[1], np.int64)
        for bit, (_, share, _) in enumerate(self._borders):
            result |= (share == 1.0).astype(np.int64) << bit
        for _, share, _ in self._borders:
            result[(share > 0.0) & (share < 1.0)] = -1
        return result

    def _mixed(self, values: Values, cells: Any) -> Floats:
        """Compute the stiffness of selected cells. One region after the other is added, as a
        laminate with layers along the border of the region.
        """
        outer = {name: value[cells] for name, value in values.items()}
        fields = self.experiment.rule.varying
        for name, field in fields.items():
            if isinstance(field, ByRegion):
                outer[name] = np.full(len(cells), field.otherwise)
        result = stiffness_at(self.experiment, outer)
        for region, share, facing in self._borders:
            f, inner = share[cells], dict(outer)
            for name, field in fields.items():
                if isinstance(field, ByRegion) and region in dict(field.values):
                    inner[name] = np.full(len(cells), dict(field.values)[region])
            inner_stiffness = stiffness_at(self.experiment, inner)
            part = (f > 0.0) & (f < 1.0)
            parts = result[part], inner_stiffness[part], f[part], facing[cells][part]
            result[part] = layered(*parts)
            result[f == 1.0] = inner_stiffness[f == 1.0]
            outer = {name: np.where(f >= 0.5, inner[name], value) for name, value in outer.items()}
        if not np.isfinite(result).all():
            raise ExperimentError(
                f"'{self.experiment.rule.type}' has no finite stiffness for some cells, as at "
                "poisson_ratio -1; a body of several materials requires one",
                ("rule",),
            )
        return result

    def _factors(self, otherwise: Floats) -> Floats:
        """Return the mean stiffness over the parts of each cell, divided by the stiffness of the
        rule."""
        rule = self.experiment.rule
        field, base = rule.varying[STIFFNESS], getattr(rule, STIFFNESS)
        if not isinstance(field, ByRegion):
            return np.asarray(otherwise / base)
        result = np.full(len(otherwise), field.otherwise)
        for region, share, _ in self._borders:
            result += share * (dict(field.values)[region] - result)
        return np.asarray(result / base)

    @cached_property
    def _borders(self) -> list[tuple[str, Floats, Floats]]:
        """Regions to which parameters refer, with the fraction of each cell's area inside the
        region and the orientation of its border."""
        return [
            (name, *self._shares(region)) for name, region in regions_of(self.experiment).items()
        ]

    def _shares(self, region: Body) -> tuple[Floats, Floats]:
        signed = partial(signed_distance, region, self.experiment.lattice.cell())
        at_corners = signed(self.x, self.y)
        share = (at_corners <= 0.0).all(axis=0).astype(float)
        facing = np.zeros((len(share), 2, 2))
        width = max(math.dist(a, b) for a in self.polygon.rest for b in self.polygon.rest)
        reach = width if region.exaggerates() else NEAREST * width
        near = np.flatnonzero(np.abs(at_corners).min(axis=0) <= reach)
        for cells in np.split(near, range(CELLS_AT_ONCE, len(near), CELLS_AT_ONCE)):
            corners = np.stack([self.x[:, cells], self.y[:, cells]])
            share[cells], facing[cells] = _cut_cells(
                region, self.experiment.lattice, corners.tobytes(), corners.shape
            )
        return share, facing


@lru_cache(maxsize=64)
def _cut_cells(
    region: Body, lattice: Lattice, corners: bytes, shape: tuple[int, ...]
) -> tuple[Floats, Floats]:
    """Return the shares of cells inside a region, and the orientation of its border in them.

    The coordinates of their corners, (axis, corner, cell), are given as bytes, so that results are
    kept. The derivatives of a fit, for instance, require scenes that have the same borders and
    other values of parameters.
    """
    x, y = np.frombuffer(corners).reshape(shape)
    signed = partial(signed_distance, region, lattice.cell())
    return cut_by_border(signed, x, y, exaggerates=region.exaggerates())
