"""Writes how kernels find the damage of the cells around a particle, and which particles have any.

Few particles have any. A plane of marks records which: the sweep moves all others as if no bond
could break, and then computes the marked ones in short chunks. A mark stays, and is set too early
rather than too late: without damage both ways give the same numbers.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Slot, Softens, SoftensCells, Stiffness
from pbdkit.scene.cell_bonds import CellBond
from pbdkit.scene.declarations import bond_numbers
from pbdkit.scene.homes import Home
from pbdkit.scene.places import Block, slot_step
from pbdkit.scene.scene import Scene
from pbdkit.stepping.cell_stress import CellStresses
from pbdkit.stepping.compiled.plan import Plan, values
from pbdkit.stepping.state import State

CHUNK = 64
"""Particles of a row among which one that is marked makes all be computed as torn."""
Marks = NDArray[np.uint8]


def damage_word(plan: Plan, broken: str, n: str, bond: str, limit: str, side: int = 0) -> str:
    """The share of its pull that a bond of plane n has lost in the cell on a side of it, from the
    words for the step at which it broke and, with `{n}` for their numbers, for what is remembered
    of it and its limits."""
    softened = plan.number(0.0)
    if plan.softens_cells:
        softened = bond.format(n=_numbers_of_damage(plan)[side])
    if isinstance(plan.model, Softens):
        homes = {Home.SLOT: f"end_limits[{n}, {{n}}]", Home.BOND: bond, Home.FIXED_BOND: limit}
        c = f"Constants({values(plan.levels[-1].seen.bond, homes)})"
        ahead, nothing = (plan.literal([x, *[0.0] * (len(plan.axes) - 1)]) for x in (1.0, 0.0))
        r = plan.vector(f"end_rests[{n}, #]")
        softened = f"{plan.number(1.0)} - seen({ahead}, {nothing}, {r}, {c}, q).x"
    return f"({plan.number(1.0)} if {broken} >= 0 else {softened})"


def _numbers_of_damage(plan: Plan) -> list[int]:
    """Which of the numbers that are remembered of a bond are its damage on its left and right."""
    names = [number.name for number in bond_numbers(plan.scene.experiment)]
    return [names.index(f"damage_{side}") for side in ("left", "right")]


def _raised(name: str, other: str) -> str:
    """The larger of two as a choice, which vectorises: `max` does not."""
    return f"{name} = {name} if {name} > {other} else {other}"


def _damage_at(plan: Plan, home: str, n: str, side: int = 0) -> str:
    """The same of the bond at a flat place."""
    words = f"flat_bond{{n}}[{home}]", f"flat_limit{{n}}[{home}]"
    return damage_word(plan, f"flat_broken[{home}]", n, *words, side)


def _chosen(plan: Plan, home: str, n: str, on_right: str) -> str:
    """That of a bond on the side that a word tells."""
    one, other = (_damage_at(plan, home, n, side) for side in (0, 1))
    return f"({other} if {on_right} else {one})" if plan.softens_cells else one


def damage_lines(plan: Plan) -> list[str]:
    """The damage of the cells around the particle at the flat place at_j of sublattice s."""
    cells, bonds = _table_shape(plan.scene)
    lines = []
    for cell in range(cells):
        for b in range(bonds):
            lines.append(f"home = at_j + cell_bonds[s, {cell}, {b}]")
            at = f"[s, {cell}, {b}]"
            own = _chosen(plan, "home", f"cell_planes{at}", f"cell_sides{at}")
            lines += [f"own = {own}", _raised(f"m{cell}", "own")] if b else [f"m{cell} = {own}"]
    return [*lines, f"around = ({', '.join(f'm{cell}' for cell in range(cells))},)"]


def torn_at_slot(plan: Plan) -> list[str]:
    """The damage t beside slot k of that particle."""
    sides = (f"around[slot_cells[s, k, {side}]]" for side in (0, 1))
    plane = "slot_planes[s, k]"
    own = [f"own = {_damage_at(plan, 'home', plane)}", "other = own"]
    if plan.softens_cells:
        one, other = (_damage_at(plan, "home", plane, side) for side in (0, 1))
        own = [f"own, other = {one}, {other}", "if signs[s, k] < 0:", "    own, other = other, own"]
    return ["home = at_j + bonds_away[s, k]", *own, f"t = Torn({', '.join(sides)}, own, other)"]


class RowDamage:
    """The damage of the cells and bonds around the particles of a row of sublattice s that have all
    their neighbours, from j0 to j1. `lines` compute it, kind by kind in loops of their own: one
    loop with as many arrays would not vectorise."""

    def __init__(self, plan: Plan, s: int) -> None:
        self._around = plan.scene.neighbourhood.cells_around[s]
        self._home = plan.scene.neighbourhood.home
        self._number: dict[tuple[int, Slot | None, int], int] = {}
        self._sides = (0, 1) if plan.softens_cells else (0,)
        rows, loops = list[str](), list[str]()
        for cell in self._around.cells:
            for bond in cell:
                self._add(plan, bond, rows, loops)
        count, cells = len(self._number), self._around.cells
        loops.append("for j in range(j1 - j0):")
        for n, cell in enumerate(cells):
            first, *others = (
                self._number[bond.plane, bond.home, self._side(bond.side)] for bond in cell
            )
            loops.append(f"    m = damage[{first}, j]")
            loops += [f"    {_raised('m', f'damage[{other}, j]')}" for other in others]
            loops.append(f"    damage[{count + n}, j] = m")
        made = f"damage = np.empty(({count + len(cells)}, j1 - j0), {plan.real})"
        self.lines = [made, *rows, *loops]

    def _side(self, side: int) -> int:
        """The side by which damage is known: one for both where they are alike."""
        return side if len(self._sides) == 2 else 0

    def _add(self, plan: Plan, bond: CellBond, rows: list[str], loops: list[str]) -> None:
        if (bond.plane, bond.home, 0) in self._number:
            return
        n = len(self._number)
        step = bond.home.cell if bond.home else None
        arrays = {f"y{n}": "broken"}
        if isinstance(plan.model, (Softens, SoftensCells)):
            arrays |= {f"y{n}_b{m}": f"bond{m}" for m in range(plan.bonds)}
            arrays |= {f"y{n}_x{m}": f"limit{m}" for m in range(plan.limits)}
        rows += [f"{name} = {plan.row(of, bond.plane, step)}" for name, of in arrays.items()]
        words = f"y{n}[j]", str(bond.plane), f"y{n}_b{{n}}[j]", f"y{n}_x{{n}}[j]"
        for side in self._sides:
            m = self._number[bond.plane, bond.home, side] = len(self._number)
            loops.append("for j in range(j1 - j0):")
            loops.append(f"    damage[{m}, j] = {damage_word(plan, *words, side)}")

    def beside(self, slot: Slot) -> str:
        """The damage t beside a slot of the particle j of the row."""
        plane, at_this_end = self._home[slot]
        ends = (0, 1) if at_this_end else (1, 0)
        home = None if at_this_end else slot
        own = (self._number[plane, home, self._side(side)] for side in ends)
        sides = (len(self._number) + cell for cell in self._around.beside[slot])
        return f"t = Torn({', '.join(f'damage[{n}, j]' for n in (*sides, *own))})"


def marking_lines(plan: Plan, home: str, there: str) -> list[str]:
    """Marks the particles around a bond of plane n that has any damage: its flat place among the
    bonds, and that of its home among the particles."""
    if not plan.tears:
        return []
    words = (_damage_at(plan, home, "n", side) for side in range(1 + plan.softens_cells))
    return [
        f"if {' or '.join(f'{word} > {plan.number(0.0)}' for word in words)}:",
        "    for e in range(mark_steps.shape[1]):",
        f"        flat_torn[{there} + mark_steps[n, e]] = 1",
    ]


def stress_lines(plan: Plan, home: str) -> list[str]:
    """The stress of the cells to the `left` and `right` of a bond of plane n whose end where it is
    kept has this flat place."""
    corners = len(plan.scene.neighbourhood.tiling.polygons[0].corners)
    count = len(Stiffness._fields)
    known = [f"cell_ratios[{m}]" for m in range(count)]
    lines = list[str]()
    for side, name in enumerate(("left", "right")):
        lines.append(f"cell = {home} + body_steps[n, {side}]")
        if plan.mixed:
            known = [f"flat_ratios[{count} * cell + {m}]" for m in range(count)]
        lines.append(f"origin = {home} + corner_steps[n, {side}, 0]")
        for k in range(1, corners):
            lines.append(f"corner = {home} + corner_steps[n, {side}, {k}]")
            lines += plan.each(f"e{k}_@ = flat_u_@[corner] - flat_u_@[origin]")
        for a in plan.axes:
            for b, axis in enumerate(plan.axes):
                rates = ((k, f"corner_rates[n, {side}, {k - 1}, {b}]") for k in range(1, corners))
                terms = (f"e{k}_{a} * {rate}" for k, rate in rates)
                lines.append(f"g_{a}{axis} = {' + '.join(terms)}")
        ratios = f"Stiffness({', '.join(known)})"
        lines.append(f"xx, yy, xy = stress(g_xx, g_xy, g_yx, g_yy, {ratios})")
        lines.append(f"{name} = CellStress(xx, yy, xy, flat_body[cell])")
    return lines


def stress_arrays(scene: Scene, real: np.dtype[Any]) -> dict[str, NDArray[Any]]:
    """The tables that these lines read: by plane and side the ways from a bond's home to the
    corners of the cell, their rates, and the way to its share, with these."""
    assert scene.cells is not None
    stresses, shape = CellStresses(scene), scene.raster.shape
    steps, rates, shares = [], [], []
    for plane in scene.neighbourhood.planes:
        beside = stresses.beside(plane.slot)
        steps.append(
            [[one.way(corner, plane.slot, shape) for corner in one.corners] for one in beside]
        )
        rates.append([one.rates for one in beside])
        shares.append(
            [
                one.side.kind * math.prod(shape)
                + (slot_step(shape, one.side.first) if one.side.first else 0)
                for one in beside
            ]
        )
    return {
        "corner_steps": np.array(steps, np.int64),
        "corner_rates": np.array(rates, real),
        "body_steps": np.array(shares, np.int64),
        "body": np.array(scene.cells.share, real),
    }


def tearing_arrays(scene: Scene) -> dict[str, Any]:
    """The tables that these functions read: by sublattice and cell around a particle the way to
    each bond, its plane, and the side of it on which the cell lies; by sublattice and slot the
    plane of its bond and the cells beside it; by plane the ways to the particles around a bond."""
    around = scene.neighbourhood
    cells, bonds = _table_shape(scene)
    most, sublattices = max(map(len, around.slots)), len(around.slots)
    ways, planes, side = np.zeros((3, sublattices, cells, bonds), np.int64)
    slot_planes = np.zeros((sublattices, most), np.int64)
    slot_cells = np.zeros((sublattices, most, 2), np.int64)
    for s, of in enumerate(around.cells_around):
        for n in range(cells):
            own = of.cells[min(n, len(of.cells) - 1)]
            for b in range(bonds):
                bond = own[min(b, len(own) - 1)]
                ways[s, n, b], planes[s, n, b] = _way(scene, s, bond), bond.plane
                side[s, n, b] = bond.side
        for k, slot in enumerate(around.slots[s]):
            slot_planes[s, k], slot_cells[s, k] = around.home[slot][0], of.beside[slot]
    return {
        "cell_bonds": ways,
        "cell_planes": planes,
        "cell_sides": side,
        "slot_planes": slot_planes,
        "slot_cells": slot_cells,
        "mark_steps": _mark_steps(scene),
    }


def _table_shape(scene: Scene) -> tuple[int, int]:
    """The most cells around a particle, and the most bonds of one."""
    around = scene.neighbourhood.cells_around
    return (
        max(len(of.cells) for of in around),
        max(len(cell) for of in around for cell in of.cells),
    )


def _way(scene: Scene, s: int, bond: CellBond) -> int:
    """From the flat place of a particle of sublattice s to that of a bond."""
    shape, home = scene.raster.shape, bond.home
    step, sublattice = (slot_step(shape, home), home.target) if home else (0, s)
    return step + (bond.plane - sublattice) * math.prod(shape[1:])


def _mark_steps(scene: Scene) -> NDArray[np.int64]:
    """(plane, step): from the flat place of a bond's home to those of all corners of the cells
    beside it; some twice, so that all planes have as many."""
    around, shape = scene.neighbourhood, scene.raster.shape
    found = []
    for plane in around.planes:
        home = around.cells_around[plane.slot.source]
        ends: set[Slot | None] = {None}
        for cell in {*home.beside[plane.slot]}:
            ends |= {slot for slot, beside in home.beside.items() if cell in beside}
        found.append(sorted(slot_step(shape, slot) if slot else 0 for slot in ends))
    most = max(map(len, found))
    return np.array([steps + steps[:1] * (most - len(steps)) for steps in found], np.int64)


def torn_marks(scene: Scene, state: State) -> Marks:
    """1 at particles around which a bond is broken or softened."""
    marks = np.zeros(scene.raster.shape, np.uint8)
    renew_torn_marks(marks, scene, state, slice(0, marks.shape[1]))
    return marks


def renew_torn_marks(marks: Marks, scene: Scene, state: State, rows: slice) -> None:
    """Writes those of the particles that have bonds in some rows of cells around them."""
    assert state.broken_step is not None
    around, (height, *across) = scene.neighbourhood, scene.raster.shape[1:]
    margin, *beside = around.reach_in_cells  # beyond it nobody is
    first, last = max(rows.start - margin, margin), min(rows.stop + margin, height - margin)
    stop = tuple(size - n for size, n in zip(across, beside, strict=True))
    softened = isinstance(scene.experiment.fracture, (Softens, SoftensCells))
    for s, of in enumerate(around.cells_around):
        block = Block(s, (first, *beside), (max(first, last), *stop))
        found = np.zeros(block.of(marks).shape, bool)
        for bond in {bond for cell in of.cells for bond in cell}:
            home = block.seen_through(bond.home) if bond.home else block
            found |= home.within(state.broken_step[bond.plane]) >= 0
            if softened:
                for value, initial in _changed(scene, state):
                    found |= home.within(value[bond.plane]) != initial
        block.of(marks)[...] = found


def _changed(scene: Scene, state: State) -> list[tuple[NDArray[Any], Any]]:
    """The numbers that are remembered of bonds and change, with where they start."""
    numbers = zip(bond_numbers(scene.experiment), state.bond_values, strict=True)
    return [(value, number.initial) for number, value in numbers if number.changes]
