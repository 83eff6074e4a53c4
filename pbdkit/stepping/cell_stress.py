"""Stress of the cells beside bonds, for fracture models in which cells soften according to their
stress."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from operator import add
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.lattice.raster import Block, slot_step
from pbdkit.plugin import CellStress, Slot, SoftensCells, Stiffness, Vector
from pbdkit.plugin.lattice import CellPolygon, Index, Side, signed_area
from pbdkit.plugin.rule import material_of
from pbdkit.plugin.vector import vector
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import shown


@dataclass(frozen=True)
class CellBeside:
    """Cell on one side of the bonds along a slot.

    `corners` contains for each corner its sublattice and the number of repeat cells, along each
    axis, from the start of a bond to the corner. The mean gradient of the displacement is Σ_k (u_k
    - u_0) ⊗ rates_k, where k runs over all corners except the first, which is corner 0.
    """

    corners: tuple[tuple[int, Index], ...]
    rates: tuple[Vector, ...]
    side: Side

    def gradient(self, u: NDArray[Any], owner: Block) -> list[Any]:
        """Return the gradient at bonds that start at places of a block, as the components xx, xy,
        yx, yy. The first letter is the component of the displacement, the second letter the axis of
        the derivative."""
        first, *corners = (Vector(*shown(self._at(corner, owner).of(u))) for corner in self.corners)
        d = [other - first for other in corners]
        return [
            sum_in_order(
                [
                    getattr(difference, a) * getattr(g, b)
                    for difference, g in zip(d, self.rates, strict=True)
                ]
            )
            for a in "xy"
            for b in "xy"
        ]

    def flat_offset(self, corner: tuple[int, Index], slot: Slot, shape: tuple[int, ...]) -> int:
        """Return the offset in flat arrays from the start of a bond along the slot to a corner of
        the cell."""
        step = corner[0] - slot.source
        for size, cells in zip(shape[1:], corner[1], strict=True):
            step = step * size + cells
        return step

    def step(self, shape: tuple[int, ...]) -> int:
        """Return the offset from the start of a bond, in flat arrays of particles, to the cell in
        flat arrays of cells."""
        first = self.side.first
        return self.side.kind * math.prod(shape) + (slot_step(shape, first) if first else 0)

    @staticmethod
    def _at(corner: tuple[int, Index], owner: Block) -> Block:
        start, stop = (tuple(map(add, end, corner[1])) for end in (owner.start, owner.stop))
        return Block(corner[0], start, stop)


def sum_in_order(terms: list[Any]) -> Any:
    """Return the sum, added in the order that kernels use."""
    return sum(terms[1:], terms[0])


class CellStresses:
    """Cells beside the bonds of a scene with a fracture model that softens cells.

    `ratios` are the components of the stiffness divided by Young's modulus; they are constant or
    vary from cell to cell.
    """

    def __init__(self, scene: Scene) -> None:
        assert scene.cells
        self._scene, self._cells = scene, scene.cells

    @cached_property
    def ratios(self) -> Stiffness:
        """Ratios of the rule's material."""
        rule: Any = self._scene.experiment.rule
        material = material_of(rule)
        assert material is not None
        modulus = material.own_modulus(rule.through_thickness())
        return Stiffness(*(float(value / modulus) for value in material))

    @cached_property
    def ratios_by_cell(self) -> Stiffness:
        """Array of shape (kind, sublattice, cell, cell) with the ratios of each cell, if cells
        differ in stiffness. Places without a cell have the ratios of the rule."""
        rule: Any = self._scene.experiment.rule
        base: Any = material_of(rule)
        planes = {name: self._cells.weight * value for name, value in base._asdict().items()}
        for name, plane in zip(self._cells.names, self._cells.mixed, strict=True):
            if name in planes:
                planes[name] = planes[name] + plane
        has_stiffness = planes["xx"] > 0.0
        planes = {n: np.where(has_stiffness, v, getattr(base, n)) for n, v in planes.items()}
        # In plane strain the ratio of the stiffnesses xy and xx is ν / (1 - ν), and σ_zz = ν (σ_xx
        # + σ_yy).
        share = (
            planes["xy"] / planes["xx"]
            if rule.through_thickness()
            else np.zeros(has_stiffness.shape)
        )
        components = dict(planes)
        # Cells that are cut by a border between regions then have the same stiffness along both
        # axes.
        if base.xx == base.yy:
            components["xx"] = components["yy"] = (planes["xx"] + planes["yy"]) / 2.0
        modulus = Stiffness(**components).own_modulus(share / (1.0 + share))
        return Stiffness(**{name: plane / modulus for name, plane in planes.items()})

    @property
    def stress(self) -> Any:
        """The function that computes the values of a `CellStress`."""
        return linear_stress if self._scene.experiment.rule.linear else turned_stress

    def beside(self, slot: Slot) -> tuple[CellBeside, CellBeside]:
        """Return the cells to the left and to the right of the bonds along a slot."""
        first, second = (_beside(self._scene, slot, side) for side in self.tiling.beside[slot])
        return first, second

    @property
    def tiling(self) -> Any:
        """Cells of the lattice."""
        return self._scene.neighbourhood.tiling

    def of(self, u: NDArray[Any], slot: Slot, owner: Block) -> tuple[CellStress, CellStress]:
        """Return the cells to the left and to the right of bonds. The bonds lie along the slot and
        start in the block `owner`."""
        precision = self._scene.experiment.stepping.precision
        shares = self._cells.beside(slot, owner, precision, self._cells.share)
        ratios = [self.ratios] * 2
        if self._cells.mixed:
            parts = (self._cells.beside(slot, owner, precision, p) for p in self.ratios_by_cell)
            ratios = [Stiffness(*side) for side in zip(*parts, strict=True)]
        d, r = vector(owner.seen_through(slot).of(u) - owner.of(u)), slot.rest
        first, second = (
            self._stressed(cell.gradient(u, owner), c, d, r, share)
            for cell, c, share in zip(self.beside(slot), ratios, shares, strict=True)
        )
        return first, second

    @cached_property
    def shares(self) -> NDArray[Any]:
        """Area fractions of all cells inside the body, in a flat array."""
        assert self._cells.share is not None
        return self._cells.share.ravel()

    def places(self, slot: Slot, owner: Block) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the places in the flat array of cells of the cells to the left and to the right of
        bonds. If there is a cell on one side only, both are its place."""
        shape, share = self._scene.raster.shape, self.shares
        place = np.arange(math.prod(shape)).reshape(shape)[owner.slices()]
        left, right = (place + cell.step(shape) for cell in self.beside(slot))
        return np.where(share[left] > 0.0, left, right), np.where(share[right] > 0.0, right, left)

    def _stressed(
        self, gradient: list[Any], ratios: Stiffness, d: Vector, r: Vector, share: Any
    ) -> CellStress:
        return CellStress(*self.stress(*gradient, ratios, d, r, share))


def _beside(scene: Scene, slot: Slot, side: Side) -> CellBeside:
    source, step = slot.source, (0,) * scene.axes
    if side.first:
        source, step = side.first.target, side.first.cell
    polygons = scene.neighbourhood.tiling.polygons
    polygon = next(p for p in polygons if (p.source, p.kind) == (source, side.kind))
    corners = tuple((c.target, tuple(map(add, step, c.cell))) for c in polygon.corners)
    return CellBeside(corners, rates_of(polygon), side)


def rates_of(polygon: CellPolygon) -> tuple[Vector, ...]:
    """Return the rates of the mean gradient of a polygon (Green): ½ (y_k+1 - y_k-1, x_k-1 - x_k+1),
    divided by its area."""
    r, twice = polygon.rest, 2.0 * float(signed_area(polygon.rest))
    ends = [(r[(k + 1) % len(r)], r[k - 1]) for k in range(1, len(r))]
    return tuple(
        Vector(float(ahead.y - behind.y) / twice, float(behind.x - ahead.x) / twice)
        for ahead, behind in ends
    )


def linear_stress(
    xx: Any, xy: Any, yx: Any, yy: Any, c: Any, d: Any, r: Any, share: Any
) -> tuple[Any, ...]:
    """Return the values of a `CellStress` under a small gradient of the displacement, for a bond d,
    r of the cell."""
    return _elastic(xx, yy, xy + yx, r.x * d.x + r.y * d.y, c, r, share)


def turned_stress(
    xx: Any, xy: Any, yx: Any, yy: Any, c: Any, d: Any, r: Any, share: Any
) -> tuple[Any, ...]:
    """Return the same as `linear_stress` for the Green–Lagrange strain, which excludes
    rotations."""
    along_x, along_y = xx + 0.5 * (xx * xx + yx * yx), yy + 0.5 * (xy * xy + yy * yy)
    along = r.x * d.x + r.y * d.y + 0.5 * (d.x * d.x + d.y * d.y)
    return _elastic(along_x, along_y, xy + yx + (xx * xy + yx * yy), along, c, r, share)


def _elastic(
    xx: Any, yy: Any, shear: Any, along: Any, c: Any, r: Any, share: Any
) -> tuple[Any, ...]:
    return (
        c.xx * xx + c.xy * yy + c.x_shear * shear,
        c.xy * xx + c.yy * yy + c.y_shear * shear,
        c.x_shear * xx + c.y_shear * yy + c.shear * shear,
        share,
        xx,
        yy,
        0.5 * shear,
        along / (r.x * r.x + r.y * r.y),
    )


def tried(model: object, ones: Any) -> tuple[CellStress, ...]:
    """Return the cells with which a model's functions are tested, as many as the functions
    receive."""
    stress = CellStress(*np.multiply.outer([1.0, 0.5, 0.25, 1.0, 0.9, 0.4, 0.2, 0.7], ones))
    return (stress, stress) if isinstance(model, SoftensCells) else ()
