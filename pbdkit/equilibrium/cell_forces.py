"""Forces of single cells, as functions of the displacements of their corners.

A body with a linear rule is linear except for the cells in which damage grows. If their number is
small, an equilibrium is computed with few unknowns: the displacements of the corners of these
cells. `DamagingCells` evaluates the forces of the cells with the functions of the
rule and of the fracture model, for all cells together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import permutations
from typing import Any

import numpy as np

from pbdkit.array_types import Floats, Indices, Mask
from pbdkit.lattice.cells import CellBond
from pbdkit.lattice.raster import Places, slot_step
from pbdkit.plugin import (
    CellStress,
    Here,
    Offset,
    RenewsBonds,
    Slot,
    SoftensCells,
    Stiffness,
    Torn,
    Vector,
)
from pbdkit.plugin.lattice import CellPolygon
from pbdkit.scene.constants import bond_numbers
from pbdkit.scene.scene import Scene
from pbdkit.stepping.cell_stress import CellStresses, rates_of, sum_in_order
from pbdkit.stepping.rule_evaluation import Evaluator, Neighbour, summed
from pbdkit.stepping.state import State

RELATIVE_NUDGE = 1e-6
"""Displacement of a corner for derivatives, relative to the largest difference between the
displacements of the corners of the cell."""


@dataclass(frozen=True)
class EdgeOfCell:
    """Connection from one corner of a cell to another.

    Parameters
    ----------
    start, end : int
        Corners.
    slot : Slot
        Slot from the start to the end.
    on_left, on_right : bool
        Whether the cell lies to the left, or to the right, of the slot.
    bond : int
        Index of the bond among the bonds of the cell.
    """

    start: int
    end: int
    slot: Slot
    on_left: bool
    on_right: bool
    bond: int


class CellShape:
    """Cells of one shape on the lattice of a scene.

    Attributes
    ----------
    polygon
        The shape.
    steps : (corner,)
        Differences between the flat places of the corners and that of the first corner.
    bonds
        Bonds of a cell. Each has the corner at which it starts, the corner at which it ends, and
        its description.
    edges
        Connections between corners; each bond occurs in both directions.
    place : (cell,)
        Flat places of the first corners of all cells of the body, in increasing order.
    """

    def __init__(self, scene: Scene, polygon: CellPolygon) -> None:
        assert scene.cells
        hood, shape = scene.neighbourhood, scene.raster.shape
        self.polygon, self._shape, self._plane_size = polygon, shape, math.prod(shape[1:])
        sublattice = [corner.target - polygon.source for corner in polygon.corners]
        within = [slot_step(shape, corner) for corner in polygon.corners]
        self.steps = np.array(sublattice) * self._plane_size + within
        self.bonds, self.edges = self._connections(scene)
        cells = scene.cells
        exists = cells.weight[polygon.kind] > 0.0
        for share in cells.mixed:
            exists = exists | (share[polygon.kind] > 0.0)
        flat = np.flatnonzero(exists)
        own = flat // self._plane_size == polygon.source
        self.place = flat[own]
        self.rates = rates_of(polygon)
        assert hood.cells_around

    def _connections(
        self, scene: Scene
    ) -> tuple[list[tuple[int, int, CellBond]], list[EdgeOfCell]]:
        hood, polygon = scene.neighbourhood, self.polygon
        slots = {(s.source, s.target, s.cell): s for s in hood.every}
        corners = [(corner.target, np.array(corner.cell)) for corner in polygon.corners]

        def slot_between(j: int, k: int) -> Slot:
            (a, start), (b, end) = corners[j], corners[k]
            return slots[a, b, tuple((end - start).tolist())]

        around = hood.cells_around[polygon.source]
        described = around.cells[around.beside[slot_between(0, 1)][0]]
        bonds, numbers = list[tuple[int, int, CellBond]](), dict[frozenset[int], int]()
        for bond in described:
            ends = [
                (j, k)
                for j, k in permutations(range(len(corners)), 2)
                if slot_between(j, k) is bond.slot
            ]
            # Parallel sides lie along the same slot; they start at different corners.
            j, k = next((j, k) for j, k in ends if _is_owner(polygon.corners[j], bond))
            numbers[frozenset((j, k))] = len(bonds)
            bonds.append((j, k, bond))
        edges = []
        for j, k in permutations(range(len(corners)), 2):
            slot = slot_between(j, k)
            sides = [
                (s.kind, s.start, s.end) == (polygon.kind, j, k)
                and (slot.source if s.first is None else s.first.target) == polygon.source
                for s in hood.tiling.beside[slot]
            ]
            on_left, on_right = sides
            edges.append(EdgeOfCell(j, k, slot, on_left, on_right, numbers[frozenset((j, k))]))
        return bonds, edges

    def bond_place(self, bond: int, place: Indices) -> Indices:
        """Return the places of a bond of each cell in arrays of bonds, (cell, cell) flattened."""
        places: Indices = (place + self.steps[self.bonds[bond][0]]) % self._plane_size
        return places

    def owner(self, bond: int, place: Indices) -> Places:
        """Return the places of the particles at which a bond of each cell starts."""
        return Places(self._shape, place + self.steps[self.bonds[bond][0]])


def _is_owner(corner: Offset, bond: CellBond) -> bool:
    """Return whether a bond is stored at a corner, which is given by its offset from the first
    corner."""
    if bond.owner is None:
        return not any(corner.rest)
    return (corner.target, corner.cell) == (bond.owner.target, bond.owner.cell)


def shapes_of(scene: Scene) -> tuple[CellShape, ...]:
    """Return the shapes of the cells of a scene that tears cells, in the order of the lattice."""
    return tuple(CellShape(scene, polygon) for polygon in scene.neighbourhood.tiling.polygons)


def changed_cells(
    scene: Scene, shapes: Sequence[CellShape], state: State, start: State
) -> list[Indices]:
    """Return for each shape the cells with bonds that have different state variables in two states.

    A model that softens cells has state variables for each side of a bond; only those of the side
    on which the cell lies are compared.
    """
    if not shapes:
        return []
    assert state.broken_step is not None
    assert start.broken_step is not None
    count = len(state.broken_step)
    broken = (state.broken_step != start.broken_step).reshape(count, -1)
    sided = isinstance(scene.experiment.fracture, SoftensCells)
    names = [number.name for number in bond_numbers(scene.experiment)]
    changed = [broken, broken.copy()]
    for name, new, old in zip(names, state.bond_values, start.bond_values, strict=True):
        differs = (new != old).reshape(count, -1)
        for side, suffix in enumerate(("_left", "_right")):
            if not sided or name.endswith(suffix):
                changed[side] |= differs
    result = []
    for shape in shapes:
        mask = np.zeros(len(shape.place), bool)
        for n, (_, _, bond) in enumerate(shape.bonds):
            mask |= changed[bond.side][bond.plane][shape.bond_place(n, shape.place)]
        result.append(shape.place[mask])
    return result


class DamagingCells:
    """Cells of one shape in which damage depends on the displacements of their corners.

    Parameters
    ----------
    scene
        The scene.
    shape
        Shape of the cells.
    place : (cell,)
        Flat places of their first corners.
    state
        State with the state variables of the bonds before the change of the displacements.
    start
        State with the damage for which the body was linearised.

    Attributes
    ----------
    corners : (cell, corner)
        Flat places of the corners.
    stiffness : (cell, force, displacement)
        Forces that unit displacements cause with the damage of the start.
    """

    def __init__(
        self, scene: Scene, shape: CellShape, place: Indices, state: State, start: State
    ) -> None:
        self._scene, self._shape, self.place = scene, shape, place
        self._model, self._evaluator = scene.experiment.fracture, Evaluator(scene)
        self._declared = bond_numbers(scene.experiment)
        self.corners = place[:, None] + shape.steps
        self._numbers, self._intact = self._of_bonds(state)
        self._limits = [
            scene.constants.limits_at(bond.slot, bond.plane, shape.owner(n, place))
            for n, (_, _, bond) in enumerate(shape.bonds)
        ]
        self._cells = CellStresses(scene) if isinstance(self._model, SoftensCells) else None
        self.stiffness = self.with_damage_of(start)

    def with_damage_of(self, state: State) -> Floats:
        """Return the forces that unit displacements cause with the damage of a state, (cell, force,
        displacement)."""
        damage = self._damage_of(*self._of_bonds(state))
        corners = len(self._shape.steps)
        units = np.eye(2 * corners).reshape(-1, 1, corners, 2)
        units = np.broadcast_to(units, (len(units), len(self.place), *units.shape[2:]))
        forces = self._forces(units, [np.broadcast_to(d, units.shape[:2]) for d in damage])
        return forces.reshape(len(units), len(self.place), -1).transpose(1, 2, 0)

    def _of_bonds(self, state: State) -> tuple[list[list[Any]], list[Mask]]:
        assert state.broken_step is not None
        numbers, intact = [], []
        for n, (_, _, bond) in enumerate(self._shape.bonds):
            at = self._shape.bond_place(n, self.place)
            numbers.append([value[bond.plane].ravel()[at] for value in state.bond_values])
            intact.append(state.broken_step[bond.plane].ravel()[at] < 0)
        return numbers, intact

    def change(self, u: Floats) -> Floats:
        """Return the change of the forces on the corners that the damage since the start causes.

        Parameters
        ----------
        u : (series, cell, corner, axis)
            Displacements of the corners, for a series of states.

        Returns
        -------
        NDArray
            Forces with the damage at these displacements minus forces with the damage at the start,
            divided by Young's modulus and thickness. The shape is that of u.
        """
        whole = np.einsum("nij,snj->sni", self.stiffness, u.reshape(*u.shape[:2], -1))
        change: Floats = self._forces(u, self._damage(u)) - whole.reshape(u.shape)
        return change

    def tangent(self, u: Floats) -> tuple[Floats, Floats]:
        """Return the change of the forces at displacements u, and its derivatives.

        Parameters
        ----------
        u : (cell, corner, axis)
            Displacements of the corners.

        Returns
        -------
        change : (cell, corner, axis)
            Change of the forces.
        derivatives : (cell, force, displacement)
            Central differences. A common translation of all corners causes no forces.
        """
        cells, corners, axes = u.shape
        size = RELATIVE_NUDGE * np.abs(u - u[:, :1]).max(axis=(1, 2), initial=0.0)
        size = np.where(size > 0.0, size, RELATIVE_NUDGE)
        unknowns = [(k, a) for k in range(1, corners) for a in range(axes)]
        series = np.repeat(u[None], 1 + 2 * len(unknowns), axis=0)
        for n, (k, a) in enumerate(unknowns):
            series[1 + 2 * n, :, k, a] += size
            series[2 + 2 * n, :, k, a] -= size
        values = self.change(series).reshape(len(series), cells, -1)
        derivatives = np.zeros((cells, corners * axes, corners, axes))
        for n, (k, a) in enumerate(unknowns):
            slope = (values[1 + 2 * n] - values[2 + 2 * n]) / (2.0 * size[:, None])
            derivatives[:, :, k, a] = slope
            derivatives[:, :, 0, a] -= slope
        return values[0].reshape(u.shape), derivatives.reshape(cells, corners * axes, -1)

    def _damage(self, u: Floats) -> list[Any]:
        """Return the damage of each bond at displacements, in these cells."""
        model, shape = self._model, self._shape
        if not isinstance(model, RenewsBonds):
            damage = self._damage_of(self._numbers, self._intact)
            return [np.broadcast_to(d, u.shape[:2]) for d in damage]
        points = [Vector(*np.moveaxis(u[:, :, k], -1, 0)) for k in range(u.shape[2])]
        gradient, numbers = self._gradient(points), []
        for n, (j, k, bond) in enumerate(shape.bonds):
            d, cells = points[k] - points[j], tuple[CellStress, ...]()
            if self._cells:
                rest = bond.slot.rest
                here = CellStress(*self._cells.stress(*gradient, self._ratios, d, rest, 1.0))
                nothing = here._replace(share=0.0)
                cells = (here if bond.on_left else nothing, here if bond.on_right else nothing)
            own = [np.broadcast_to(value, u.shape[:2]) for value in self._numbers[n]]
            limits = self._limits[n]
            with np.errstate(all="ignore"):
                new = iter(self._evaluator.update(d, bond.slot.rest, limits, own, cells))
            numbers.append(
                [
                    np.where(self._intact[n], next(new), value) if number.changes else value
                    for number, value in zip(self._declared, own, strict=True)
                ]
            )
        return self._damage_of(numbers, self._intact)

    def _damage_of(self, numbers: list[list[Any]], intact: list[Mask]) -> list[Any]:
        """Return the damage of bonds with given state variables, in these cells."""
        damage: list[Any] = []
        for n, (_, _, bond) in enumerate(self._shape.bonds):
            lost: Any = 0.0
            if isinstance(self._model, RenewsBonds):
                c = self._scene.constants.of_bond(*self._limits[n], *numbers[n])
                lost = self._evaluator.damage(bond.slot.rest, c)[bond.side]
            damage.append(np.where(intact[n], lost, 1.0))
        return damage

    def _gradient(self, points: list[Vector]) -> list[Any]:
        """Return the components xx, xy, yx and yy of the mean gradient of the displacement."""
        d = [point - points[0] for point in points[1:]]
        return [
            sum_in_order(
                [getattr(x, a) * getattr(g, b) for x, g in zip(d, self._shape.rates, strict=True)]
            )
            for a in "xy"
            for b in "xy"
        ]

    @cached_property
    def _ratios(self) -> Any:
        assert self._cells
        if not self._scene.cells or not self._scene.cells.mixed:
            return self._cells.ratios
        kind = self._shape.polygon.kind
        return Stiffness(*(plane[kind].ravel()[self.place] for plane in self._cells.ratios_by_cell))

    @cached_property
    def _weights(self) -> list[tuple[Any, tuple[Any, ...]]]:
        """Weights of each edge, and further weights for cells of another stiffness."""
        cells, kind = self._scene.cells, self._shape.polygon.kind
        assert cells

        def one_sided(w: Any, edge: EdgeOfCell, share: Floats) -> Any:
            return w._replace(
                left=share if edge.on_left else 0.0, right=share if edge.on_right else 0.0
            )

        def share_of(planes: Floats) -> Floats:
            share: Floats = planes[kind].ravel()[self.place]
            return share

        return [
            (
                one_sided(self._scene.constants.weights[edge.slot], edge, share_of(cells.weight)),
                tuple(
                    one_sided(weights[edge.slot], edge, share_of(shares))
                    for weights, shares in zip(cells.weights, cells.mixed, strict=True)
                ),
            )
            for edge in self._shape.edges
        ]

    def _forces(self, u: Floats, damage: list[Any]) -> Floats:
        """Return the forces that the cells exert on their corners, for the given damage of their
        bonds."""
        points = [Vector(*np.moveaxis(u[:, :, k], -1, 0)) for k in range(u.shape[2])]
        largest = np.max(np.broadcast_arrays(*damage), axis=0)
        parts: list[list[Any]] = [[] for _ in points]
        for edge, (w, more) in zip(self._shape.edges, self._weights, strict=True):
            lost = damage[edge.bond]
            torn = Torn(
                largest if edge.on_left else 0.0,
                largest if edge.on_right else 0.0,
                lost if edge.on_left else 0.0,
                lost if edge.on_right else 0.0,
            )
            to = Neighbour(edge.slot.rest, w, more=more, torn=torn)
            d = points[edge.end] - points[edge.start]
            part = self._evaluator.contribution(d, points[edge.start], to)
            parts[edge.start].append((part, None))
        forces = np.empty(u.shape)
        for k, point in enumerate(points):
            for axis, value in enumerate(self._evaluator.force(summed(parts[k]), Here(point))):
                forces[:, :, k, axis] = value
        return forces
