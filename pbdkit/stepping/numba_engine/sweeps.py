"""Lines of the sweeps that move particles, and of the pass that updates and breaks bonds.

For particles that have all their neighbours the code is written slot by slot. Rest offsets, index
offsets and weights are literals in it, so that the compiler removes terms that cancel. For all
other particles the code is a loop over slots. These are the few particles with missing neighbours
or cut cells; they are computed one after the other. There may be thousands of slots, too many to
write code for each of them. Then the loop over slots is used for all particles, and all particles
of a row are computed slot after slot.

If the rule computes the forces of torn cells, the few particles next to damaged cells are marked in
an array. The sweep moves all other particles as if no bond could break, and then computes the
marked ones in short chunks. Both computations give the same numbers if nothing is damaged. Marks
may therefore be set too early, and are never removed.

Bonds with state variables that change are updated and broken in a pass before the sweep. Other
bonds are tested in the sweep, which records the bonds that break.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbdkit.lattice.cells import CellBond
from pbdkit.lattice.raster import EMPTY, FOLLOWER, Block, slot_step
from pbdkit.plugin import RenewsBonds, RenewsParticles, Slot, Softens, SoftensCells, Stiffness
from pbdkit.scene.constants import Owner, bond_numbers
from pbdkit.scene.scene import Scene
from pbdkit.stepping.cell_stress import CellStresses
from pbdkit.stepping.kernel import Function
from pbdkit.stepping.numba_engine.plan import Level, Plan, listed, values
from pbdkit.stepping.state import State

CHUNK = 64
"""Number of particles in a chunk of a row. If one of them is marked, the chunk is computed with
damage."""
Marks = NDArray[np.uint8]


def damage_word(plan: Plan, broken: str, n: str, bond: str, limit: str, side: int = 0) -> str:
    """Return an expression for the fraction of the force of a bond of plane n that is lost in the
    cell on one side. It is built from the expression for the step at which the bond broke, and from
    patterns with `{n}` for its state variables and limits."""
    softened = plan.number(0.0)
    if plan.softens_cells:
        softened = bond.format(n=_numbers_of_damage(plan)[side])
    if isinstance(plan.model, Softens):
        owners = {Owner.SLOT: f"end_limits[{n}, {{n}}]", Owner.BOND: bond, Owner.FIXED_BOND: limit}
        c = f"Constants({values(plan.levels[-1].seen.bond, owners)})"
        ahead, nothing = (plan.literal([x, *[0.0] * (len(plan.axes) - 1)]) for x in (1.0, 0.0))
        r = plan.vector(f"end_rests[{n}, #]")
        softened = f"{plan.number(1.0)} - seen({ahead}, {nothing}, {r}, {c}, q).x"
    return f"({plan.number(1.0)} if {broken} >= 0 else {softened})"


def _numbers_of_damage(plan: Plan) -> list[int]:
    """Return the indices of the state variables of a bond that are the damage on its left and
    right."""
    names = [number.name for number in bond_numbers(plan.scene.experiment)]
    return [names.index(f"damage_{side}") for side in ("left", "right")]


def _raised(name: str, other: str) -> str:
    """Return a line that assigns the larger of two values. It uses a conditional expression
    because, unlike `max`, it is vectorised."""
    return f"{name} = {name} if {name} > {other} else {other}"


def _damage_at(plan: Plan, owner: str, n: str, side: int = 0) -> str:
    """Return an expression for the damage of the bond at a flat place."""
    words = f"flat_bond{{n}}[{owner}]", f"flat_limit{{n}}[{owner}]"
    return damage_word(plan, f"flat_broken[{owner}]", n, *words, side)


def _chosen(plan: Plan, owner: str, n: str, on_right: str) -> str:
    """Return an expression for the damage of a bond on the side that a variable selects."""
    left_damage, right_damage = (_damage_at(plan, owner, n, side) for side in (0, 1))
    return (
        f"({right_damage} if {on_right} else {left_damage})" if plan.softens_cells else left_damage
    )


def damage_lines(plan: Plan) -> list[str]:
    """Return lines that compute the damage of the cells around the particle of sublattice s at the
    flat place `at_j`."""
    cells, _ = _table_shape(plan.scene)
    lines = []
    for cell in range(cells):
        at = f"[s, {cell}, b]"
        damage = _chosen(plan, "owner", f"cell_planes{at}", f"cell_sides{at}")
        lines += [f"m{cell} = {plan.real}(-np.inf)", "for b in range(cell_bonds.shape[2]):"]
        lines += [f"    owner = at_j + cell_bonds{at}", f"    own = {damage}"]
        lines.append(f"    {_raised(f'm{cell}', 'own')}")
    return [*lines, f"around = ({', '.join(f'm{cell}' for cell in range(cells))},)"]


def torn_at_slot(plan: Plan) -> list[str]:
    """Return lines of code that compute t for the bond along slot k of the particle. The variable t
    contains the damage of the cells on both sides of this bond and of the bond itself."""
    sides = (f"around[slot_cells[s, k, {side}]]" for side in (0, 1))
    plane = "slot_planes[s, k]"
    lines = [f"own = {_damage_at(plan, 'owner', plane)}", "other = own"]
    if plan.softens_cells:
        left_damage, right_damage = (_damage_at(plan, "owner", plane, side) for side in (0, 1))
        lines = [
            f"own, other = {left_damage}, {right_damage}",
            "if signs[s, k] < 0:",
            "    own, other = other, own",
        ]
    return ["owner = at_j + bonds_away[s, k]", *lines, f"t = Torn({', '.join(sides)}, own, other)"]


class RowDamage:
    """Damage of the cells and bonds around particles j0 to j1 of a row of sublattice s, which have
    all their neighbours. The lines of code `lines` compute the damage in several loops, because a
    single loop over so large a number of arrays is not vectorised."""

    def __init__(self, plan: Plan, s: int) -> None:
        self._around = plan.scene.neighbourhood.cells_around[s]
        self._owner = plan.scene.neighbourhood.owner
        self._number: dict[tuple[int, Slot | None, int], int] = {}
        self._sides = (0, 1) if plan.softens_cells else (0,)
        rows, loops = list[str](), list[str]()
        for cell in self._around.cells:
            for bond in cell:
                self._add(plan, bond, rows, loops)
        count, cells = len(self._number), self._around.cells
        loops.append("for j in range(j1 - j0):")
        for n, cell in enumerate(cells):
            first, *rest = (
                self._number[bond.plane, bond.owner, self._side(bond.side)] for bond in cell
            )
            loops.append(f"    m = damage[{first}, j]")
            loops += [f"    {_raised('m', f'damage[{other}, j]')}" for other in rest]
            loops.append(f"    damage[{count + n}, j] = m")
        allocation = f"damage = np.empty(({count + len(cells)}, j1 - j0), {plan.real})"
        self.lines = [allocation, *rows, *loops]

    def _side(self, side: int) -> int:
        """Return the index of a side of the damage; it is 0 for both sides if their damage is
        equal."""
        return side if len(self._sides) == 2 else 0

    def _add(self, plan: Plan, bond: CellBond, rows: list[str], loops: list[str]) -> None:
        if (bond.plane, bond.owner, 0) in self._number:
            return
        n = len(self._number)
        step = bond.owner.cell if bond.owner else None
        arrays = {f"y{n}": "broken"}
        if isinstance(plan.model, (Softens, SoftensCells)):
            arrays |= {f"y{n}_b{m}": f"bond{m}" for m in range(plan.bonds)}
            arrays |= {f"y{n}_x{m}": f"limit{m}" for m in range(plan.limits)}
        rows += [f"{name} = {plan.row(of, bond.plane, step)}" for name, of in arrays.items()]
        words = f"y{n}[j]", str(bond.plane), f"y{n}_b{{n}}[j]", f"y{n}_x{{n}}[j]"
        for side in self._sides:
            m = self._number[bond.plane, bond.owner, side] = len(self._number)
            loops.append("for j in range(j1 - j0):")
            loops.append(f"    damage[{m}, j] = {damage_word(plan, *words, side)}")

    def beside(self, slot: Slot) -> str:
        """Return a line that computes t for the bond along a slot of particle j. The variable t
        contains the damage of the cells on both sides of this bond and of the bond itself."""
        plane, at_this_end = self._owner[slot]
        ends = (0, 1) if at_this_end else (1, 0)
        owner = None if at_this_end else slot
        damage = (self._number[plane, owner, self._side(side)] for side in ends)
        sides = (len(self._number) + cell for cell in self._around.beside[slot])
        return f"t = Torn({', '.join(f'damage[{n}, j]' for n in (*sides, *damage))})"


def marking_lines(plan: Plan, owner: str, there: str) -> list[str]:
    """Return lines that mark the particles around a damaged bond of plane n. `owner` is the index
    of the bond in flat arrays of bonds. `there` is the index in flat arrays of particles of the end
    of the bond at which the bond is stored."""
    if not plan.tears:
        return []
    words = (_damage_at(plan, owner, "n", side) for side in range(1 + plan.softens_cells))
    return [
        f"if {' or '.join(f'{word} > {plan.number(0.0)}' for word in words)}:",
        "    for e in range(mark_steps.shape[1]):",
        f"        flat_torn[{there} + mark_steps[n, e]] = 1",
    ]


def write_cell_stress(plan: Plan) -> Function:
    """Return the function that computes the stress of the cell on one side of a bond d, r of plane
    n. `owner` is the flat place of the end at which the bond is stored."""
    corners = len(plan.scene.neighbourhood.tiling.polygons[0].corners)
    count = len(Stiffness._fields)
    out = Function(plan.shared, "cell_stress", "n", "side", "owner", "d", "r", *_cell_arrays(plan))
    out.add(0, "cell = owner + body_steps[n, side]", "origin = owner + corner_steps[n, side, 0]")
    for k in range(1, corners):
        out.add(0, f"corner = owner + corner_steps[n, side, {k}]")
        out.add(0, *plan.each(f"e{k}_@ = flat_u_@[corner] - flat_u_@[origin]"))
    for a in plan.axes:
        for b, axis in enumerate(plan.axes):
            rates = ((k, f"corner_rates[n, side, {k - 1}, {b}]") for k in range(1, corners))
            out.add(0, f"g_{a}{axis} = {' + '.join(f'e{k}_{a} * {rate}' for k, rate in rates)}")
    ratios = f"flat_ratios[{count} * cell + #]" if plan.mixed else "cell_ratios[#]"
    stiffness = ", ".join(ratios.replace("#", str(m)) for m in range(count))
    more = f"Stiffness({stiffness}), d, r, flat_body[cell]"
    out.add(0, f"return CellStress(*stress(g_xx, g_xy, g_yx, g_yy, {more}))")
    return out


def _cell_arrays(plan: Plan) -> list[str]:
    """Return the names of the flat arrays that the function of `write_cell_stress` receives."""
    return ["flat_body", *(["flat_ratios"] if plan.mixed else []), *plan.each("flat_u_@")]


def stress_arrays(scene: Scene, real: np.dtype[Any]) -> dict[str, NDArray[Any]]:
    """Return the tables that the function of `write_cell_stress` reads. They have an entry for the
    left and the right side of the bonds along each slot. A bond is stored at one of its ends.
    `corner_steps` are index offsets in flat arrays from this end to the corners of the cell, and
    `body_steps` is the offset to the place of the area fraction of the cell. `corner_rates`
    contains the weights of the corners in the displacement gradient."""
    assert scene.cells is not None
    stresses, shape = CellStresses(scene), scene.raster.shape
    steps, rates, shares = [], [], []
    for plane in scene.neighbourhood.planes:
        cells = stresses.beside(plane.slot)
        steps.append(
            [
                [cell.flat_offset(corner, plane.slot, shape) for corner in cell.corners]
                for cell in cells
            ]
        )
        rates.append([cell.rates for cell in cells])
        shares.append([cell.step(shape) for cell in cells])
    return {
        "corner_steps": np.array(steps, np.int64),
        "corner_rates": np.array(rates, real),
        "body_steps": np.array(shares, np.int64),
        "body": np.array(scene.cells.share, real),
    }


def tearing_arrays(scene: Scene) -> dict[str, Any]:
    """Return the tables with which the damage around a particle is looked up. The tables `cell_...`
    have entries for each sublattice and each bond of a cell around a particle: the index offset in
    flat arrays from the particle to the bond, the plane of the bond, and the side of the bond on
    which the cell lies. The tables `slot_...` have entries for each sublattice and slot: the plane
    of the bond and the cells beside it. `mark_steps` contains for each plane the index offsets from
    a bond to the particles around it."""
    around = scene.neighbourhood
    cells, bonds = _table_shape(scene)
    width, sublattices = max(map(len, around.slots)), len(around.slots)
    offsets, planes, side = np.zeros((3, sublattices, cells, bonds), np.int64)
    slot_planes = np.zeros((sublattices, width), np.int64)
    slot_cells = np.zeros((sublattices, width, 2), np.int64)
    for s, of in enumerate(around.cells_around):
        for n in range(cells):
            bonds_of = of.cells[min(n, len(of.cells) - 1)]
            for b in range(bonds):
                bond = bonds_of[min(b, len(bonds_of) - 1)]
                offsets[s, n, b], planes[s, n, b] = _flat_offset(scene, s, bond), bond.plane
                side[s, n, b] = bond.side
        for k, slot in enumerate(around.slots[s]):
            slot_planes[s, k], slot_cells[s, k] = around.owner[slot][0], of.beside[slot]
    return {
        "cell_bonds": offsets,
        "cell_planes": planes,
        "cell_sides": side,
        "slot_planes": slot_planes,
        "slot_cells": slot_cells,
        "mark_steps": _mark_steps(scene),
    }


def _table_shape(scene: Scene) -> tuple[int, int]:
    """Return the largest number of cells around a particle, and the largest number of bonds of such
    a cell."""
    around = scene.neighbourhood.cells_around
    return (
        max(len(of.cells) for of in around),
        max(len(cell) for of in around for cell in of.cells),
    )


def _flat_offset(scene: Scene, s: int, bond: CellBond) -> int:
    """Return the index offset in flat arrays from a particle of sublattice s to a bond."""
    shape, owner = scene.raster.shape, bond.owner
    step, sublattice = (slot_step(shape, owner), owner.target) if owner else (0, s)
    return step + (bond.plane - sublattice) * math.prod(shape[1:])


def _mark_steps(scene: Scene) -> NDArray[np.int64]:
    """Return the index offsets in flat arrays from the end at which a bond is stored to all corners
    of the cells beside the bond, (plane, offset). Some offsets are repeated, so that all planes
    have the same number of them."""
    around, shape = scene.neighbourhood, scene.raster.shape
    rows = []
    for plane in around.planes:
        owner = around.cells_around[plane.slot.source]
        ends: set[Slot | None] = {None}
        for cell in {*owner.beside[plane.slot]}:
            ends |= {slot for slot, cells in owner.beside.items() if cell in cells}
        rows.append(sorted(slot_step(shape, slot) if slot else 0 for slot in ends))
    width = max(map(len, rows))
    return np.array([steps + steps[:1] * (width - len(steps)) for steps in rows], np.int64)


def torn_marks(scene: Scene, state: State) -> Marks:
    """Return 1 at particles around which a bond is broken or softened."""
    marks = np.zeros(scene.raster.shape, np.uint8)
    renew_torn_marks(marks, scene, state, slice(0, marks.shape[1]))
    return marks


def renew_torn_marks(marks: Marks, scene: Scene, state: State, rows: slice) -> None:
    """Update the marks of particles near bonds in some rows of cells."""
    assert state.broken_step is not None
    around, (height, *across) = scene.neighbourhood, scene.raster.shape[1:]
    margin, *margins = around.reach_in_cells  # No neighbour of a particle lies beyond this margin.
    first, last = max(rows.start - margin, margin), min(rows.stop + margin, height - margin)
    stop = tuple(size - n for size, n in zip(across, margins, strict=True))
    softened = isinstance(scene.experiment.fracture, (Softens, SoftensCells))
    for s, of in enumerate(around.cells_around):
        block = Block(s, (first, *margins), (max(first, last), *stop))
        damaged = np.zeros(block.of(marks).shape, bool)
        for bond in {bond for cell in of.cells for bond in cell}:
            owner = block.seen_through(bond.owner) if bond.owner else block
            damaged |= owner.within(state.broken_step[bond.plane]) >= 0
            if softened:
                for value, initial in _changed(scene, state):
                    damaged |= owner.within(value[bond.plane]) != initial
        block.of(marks)[...] = damaged


def _changed(scene: Scene, state: State) -> list[tuple[NDArray[Any], Any]]:
    """Return those state variables of bonds that change, and their initial values."""
    numbers = zip(bond_numbers(scene.experiment), state.bond_values, strict=True)
    return [(value, number.initial) for number, value in numbers if number.changes]


RUNS = ("first_run", "last_run", "first_row", "last_row")
"""Arguments of functions that process rows: a range of runs, and a range of rows of the first
axis."""


def parameters(plan: Plan, level: Level) -> list[str]:
    """Return lines that assign the parameters p of the rule and q of the fracture model. The
    parameters of the fracture model are literals, because they determine the code."""
    rule = [] if level.fields else [_rule(level)]
    literal = listed(map(plan.number, plan.scene.constants.fracture))
    return [*rule, f"q = Fracture({literal})"] if plan.model else rule


def _rule(level: Level) -> str:
    """Return a line that assigns p, the parameters of the rule at a particle."""
    n = level.number
    owners = {
        Owner.SCENE: f"rule{n}[{{n}}]",
        Owner.FIXED_PARTICLE: "g{n}[j]",
        Owner.CHOICE: f"Word{n}_{{n}}",
        Owner.TABLE: f"table{n}_{{n}}",
    }
    return f"p = Rule{n}({values(level.seen.rule, owners)})"


def write_row_loop(out: Function, plan: Plan, level: Level, s: str) -> None:
    """Write a loop over the rows of runs, limited to the part of the lattice that motion has
    reached. Its first lines define the arrays of the values at the particles of the row and of
    their moves. Lines that are added later are inside the loop."""
    out.add(0, *parameters(plan, level), "for n in range(first_run, last_run):")
    *lead, name = plan.lead
    a = len(lead)
    out.add(1, *(f"{outer} = runs[n, {m}]" for m, outer in enumerate(lead)))
    out.add(1, f"j0 = max(runs[n, {a + 2}], box[{2 * a + 2}])")
    out.add(1, f"j1 = min(runs[n, {a + 3}], box[{2 * a + 3}])", "if j0 >= j1:", "    continue")
    low, high = (f"box[{2 * a}]", f"box[{2 * a + 1}]") if a else ("first_row", "last_row")
    out.add(1, f"for {name} in range(max(runs[n, {a}], {low}), min(runs[n, {a + 1}], {high})):")
    out.depth += 2
    write_rows(out, plan, level, s)


def write_rows(out: Function, plan: Plan, level: Level, s: str) -> None:
    """Write lines that define the arrays for particles j0 to j1 of a row. These arrays contain
    their displacements and their moves."""
    n = level.number
    rows = {"h@": "u_@", "o@": "v_@" if level is plan.levels[-1] else f"z{n}_@"}
    if n:
        rows["z@"] = f"{level.source}_@"
    if plan.is_loaded(level):
        rows["g@"] = "load_@"
    for row, of in rows.items():
        out.add(0, *plan.each(f"{row} = {plan.row(of, s)}"))
    for m in range(len(level.seen.own)):
        old, new = (plan.row(array, s) for array in (plan.read[m], f"own{m}"))
        out.add(0, f"a{m}, w{m} = {old}, {new}")
    out.add(0, *(f"g{m} = {plan.row(f'field{m}', s)}" for m in range(level.fields)))


def displacements(plan: Plan, level: Level) -> list[str]:
    """Return lines that assign u, the displacement of the particle. They also assign z, the move of
    the inner rule, if the rule has one, and the parameters p if they vary in space."""
    u, z = (f"{name} = {plan.vector(f'{row}@[j]')}" for name, row in ("uh", "zz"))
    return [u, *([z] if level.number else []), *([_rule(level)] if level.fields else [])]


def difference(plan: Plan, level: Level, there: str) -> str:
    """Return the line of code that computes the difference d from the displacement of the
    neighbour. `there` is the pattern of the components of this displacement."""
    return f"d = {plan.vector(f'{there} - {level.source[0]}.@')}"


def bond_lines(plan: Plan, k: object, r: str, c: str, breaks: str, since: str) -> list[str]:
    """Return lines that replace d by the difference that the rule receives at slot k. If the bond
    breaks in this step (`breaks`) or broke in an earlier one (`since`), it is the difference to the
    fictitious point. If the bond is softened, it is a combination of both differences."""
    if plan.model is None or plan.tears:
        return []
    lines = [f"is_lost = {since} >= 0"]
    if plan.judged:
        lines = [
            f"breaks_now = 1 if {breaks} else 0",
            f"is_lost = ((bits >> {k}) & 1) | breaks_now",
            f"now = now | (is_lost << {k})",
        ]
    lines.append(f"f = fictitious(u, {r}, q)")
    if isinstance(plan.model, Softens):
        lines.append(f"d = seen(d, f, {r}, {c}, q)")
    return [*lines, f"d = {plan.vector('f.@ if is_lost else d.@')}"]


def contributions(
    plan: Plan, level: Level, r: str, weights: str, there: Iterable[str] = (), torn: bool = False
) -> str:
    """Return a line that computes the contribution of a neighbour. The function receives the state
    variables of the neighbour if the rule uses them, and the damage t beside the bond if cells are
    `torn`."""
    return _gathered(plan, level, r, weights, there, "c", torn)


def more_contributions(
    plan: Plan, level: Level, r: str, weights: Sequence[str], there: Iterable[str] = ()
) -> list[str]:
    """Return lines that compute the contributions of cells with a stiffness other than that of the
    rule, with the given weights."""
    lines = list[str]()
    for w in weights:
        lines.append(_gathered(plan, level, r, w, there, "e", plan.tears))
        lines += [f"c{n} = c{n} + {plan.rounded(f'e{n}')}" for n in range(len(level.totals))]
    return lines


def _gathered(
    plan: Plan, level: Level, r: str, weights: str, there: Iterable[str], into: str, torn: bool
) -> str:
    n = level.number
    names = _pattern(level.parts, [f"{into}{total[1:]}" for total in level.totals], "")
    arguments = ["d", r, f"Weights{n}({weights})", *(["t"] if torn else []), "p"]
    if plan.shares:
        arguments += [f"Own{n}({_own(level)})", f"Own{n}({listed(there)})"]
    return f"{names}, = {'torn' if torn else 'gather'}{n}({', '.join(arguments)})"


def _pair_contributions(plan: Plan, level: Level, ends: Sequence[tuple[str, str, str]]) -> str:
    """Return a line that computes the contributions of a pair of neighbours. For each end, `ends`
    contains the expressions for d, r and the weights."""
    n = level.number
    names = _pattern(level.pair_parts, [f"c{total[1:]}" for total in level.pair_totals], "")
    (d, r, w), (e, s, v) = ends
    return f"{names}, = gather_pair{n}({d}, {e}, {r}, {s}, Weights{n}({w}), Weights{n}({v}), p)"


def _own(level: Level) -> str:
    """Return an expression for the state variables of the particle."""
    return values(level.seen.own, {Owner.PARTICLE: "a{n}[j]"})


def target_lines(
    plan: Plan,
    level: Level,
    local: Sequence[str],
    totals: list[str],
    movable: str = "",
    otherwise: str = "u.@",
) -> list[str]:
    """Return lines that set the displacement and the state variables of the particle after the
    step. `movable` is the condition under which the particle moves; if it is empty, the particle
    always moves. `otherwise` is the displacement of a particle that does not move. `local` are the
    components of X relative to site (0, 0)."""
    n, solver = level.number, plan.scene.experiment.stepping
    sums = _pattern(level.parts + level.pair_parts, totals, "Vector")
    lines = list[str]()
    X = centred = plan.literal([0.0] * len(plan.axes))
    if level.scene.experiment.rule.uses_reference:
        lines = [f"X{c} = {value}" for c, value in zip(plan.axes, local, strict=True)]
        X = _shifted(plan, "+", plan.scene.raster.lattice.origin)
        centred = _shifted(plan, "-", plan.scene.middle)
    lines.append(f"here = Here({level.source[0]}, {X}, {centred}, Own{n}({_own(level)}))")
    total = f"({sums},)"
    if plan.is_loaded(level):
        total = f"loaded{n}({total}, {plan.vector('g@[j]')}, p)"
    lines.append(f"move = apply{n}({total}, here, p)")
    changing: list[int] = []
    if isinstance(level.scene.experiment.rule, RenewsParticles):
        changing = [m for m, number in enumerate(level.seen.own) if number.changes]
        lines.append(f"new = remember{n}(({sums},), here, p)")
    if level is not plan.levels[-1]:
        lines += plan.each(f"o@[j] = {_chosen_target('move.@', movable, plan.number(0.0))}")
    else:
        plain = solver.relaxation == 1.0 and "relaxation" not in solver.time_dependent
        relaxed = "move.@" if plain else "solver[0] * move.@"
        with_momentum = "new_@ = new_@ + solver[1] * (u.@ - o@[j])"
        momentum = [with_momentum] if solver.memory != 0.0 else []
        if "memory" in solver.time_dependent:
            momentum = [f"{with_momentum} if solver[1] != 0.0 else new_@"]
        out = f"o@[j] = {_chosen_target('new_@', movable, otherwise)}"
        for pattern in (f"new_@ = u.@ + {relaxed}", *momentum, out):
            lines += plan.each(pattern)
    return lines + [
        f"w{n}[j] = {_chosen_target(f'new[{m}]', movable, f'a{n}[j]')}"
        for m, n in enumerate(changing)
    ]


def _shifted(plan: Plan, sign: str, by: Iterable[Any]) -> str:
    parts = (f"X{c} {sign} {plan.number(v)}" for c, v in zip(plan.axes, by, strict=True))
    return f"Vector({', '.join(parts)})"


def _chosen_target(value: str, where: str, otherwise: str) -> str:
    return f"{value} if {where} else {otherwise}" if where else value


def _pattern(parts: Sequence[int], names: list[str], kind: str) -> str:
    """Return the names of components; the names of the components of a vector are combined. `parts`
    contains the number of components of each contribution."""
    components, rest = [], iter(names)
    for size in parts:
        group = list(islice(rest, size))
        components.append(group[0] if size == 1 else f"{kind}({', '.join(group)})")
    return ", ".join(components)


def write_bond_pass(plan: Plan) -> list[Function]:
    """Return the functions that update and break the bonds in a range of rows and columns. The last
    function calls the others."""
    rows, columns = ("first_row", "last_row"), ("first_column", "last_column")
    out = Function(plan.shared, "judge_bonds", *rows, *columns)
    axes = range(len(plan.axes))
    low, high = ([f"end_blocks[n, {2 * a + b}]" for a in axes] for b in (0, 1))
    out.add(0, parameters(plan, plan.levels[-1])[-1], "for n in range(len(ends)):")
    out.add(1, f"r = {plan.vector('end_rests[n, #]')}")
    out.add(1, f"for i in range(max({low[0]}, first_row), min({high[0]}, last_row)):")
    for depth, name in enumerate(plan.lead[1:], 2):
        out.add(depth, f"for {name} in range({low[depth - 1]}, {high[depth - 1]}):")
    out.depth = len(plan.axes)
    step = [f"ends[n, {a + 2}]" for a in axes]
    out.add(0, f"j0, j1 = max({low[-1]}, first_column), min({high[-1]}, last_column)")
    out.add(0, "if j0 >= j1:", "    continue")
    out.add(0, *plan.each(f"h@ = {plan.row('u_@', 'ends[n, 0]')}"))
    out.add(0, *plan.each(f"n@ = {plan.row('u_@', 'ends[n, 1]', step)}"))
    out.add(0, f"one = {plan.row('kind', 'ends[n, 0]')}")
    out.add(0, f"other = {plan.row('kind', 'ends[n, 1]', step)}")
    out.add(0, f"since = {plan.row('broken', 'n')}", f"broken_lengths = {plan.row('lengths', 'n')}")
    out.add(0, *(f"b{m} = {plan.row(f'bond{m}', 'n')}" for m in range(plan.bonds)))
    out.add(0, *(f"x{m} = {plan.row(f'limit{m}', 'n')}" for m in range(plan.limits)))
    if plan.tears:
        out.add(0, f"bond_base, base = {plan.flat('n')}, {plan.flat('ends[n, 0]')}")
    _write_judging(out, plan)
    return [*bond_functions(plan), out]


def bond_functions(plan: Plan) -> list[Function]:
    """Return the functions that the lines of `bond_update` call."""
    return [write_cell_stress(plan)] if plan.softens_cells else []


class BondUpdate(NamedTuple):
    """Code for bond j of plane n. `look` are lines that evaluate the bond. `breaks` is an
    expression that is true if the bond breaks, and `differ` an expression that is added to it and
    is true if a state variable changes. `write` are lines that store the result."""

    look: list[str]
    breaks: str
    differ: str
    write: list[str]


def bond_update(plan: Plan, d: str, owner: str) -> BondUpdate:
    """Return the code for a bond. `d` is the pattern of the components of the difference, and
    `owner` the flat place of the end at which the bond is stored."""
    numbers = plan.levels[-1].seen.bond
    owners = {Owner.SLOT: "end_limits[n, {n}]", Owner.BOND: "b{n}[j]", Owner.FIXED_BOND: "x{n}[j]"}
    c = values(numbers, owners)
    look = [f"d = {plan.vector(d)}"]
    changes_of = [number.changes for number in numbers if number.owner is Owner.BOND]
    renews = isinstance(plan.model, RenewsBonds)
    changing = [m for m, changes in enumerate(changes_of) if changes and renews]
    if changing:
        cells = ""
        if plan.softens_cells:
            stress = write_cell_stress(plan)
            for side in (0, 1):
                arguments = f"{side}", owner, "d", "r", *_cell_arrays(plan)
                cells += f", {stress.call('n', *arguments)}"
        look.append(f"new = update(d, r, Constants({c}), q{cells})")
    for position, m in enumerate(changing):
        look.append(f"new{m} = new[{position}]")
        c = c.replace(f"b{m}[j]", f"new{m}")
    breaks = f"breaks(d, r, Constants({c}), q)"
    differ = "".join(f" | (new{m} != b{m}[j])" for m in changing)
    renewed = [f"b{m}[j] = new{m}" for m in changing]
    broken = [f"if {breaks}:", "    since[j] = step", "    broken_lengths[j] = length(r + d)"]
    return BondUpdate(look, breaks, differ, [*look, *renewed, *broken])


def _write_judging(out: Function, plan: Plan) -> None:
    """Write the lines for one row of bonds."""
    can = f"((one[j] == {FOLLOWER}) & (other[j] == {FOLLOWER}))"
    if plan.model.breaks_frame_bonds():
        can = (
            f"((one[j] == {FOLLOWER}) & (other[j] != {EMPTY}) | "
            f"(one[j] != {EMPTY}) & (other[j] == {FOLLOWER}))"
        )
    lines = bond_update(plan, "n@[j] - h@[j]", "base + j")
    # Loops that only read are vectorised. The first loop does not test whether bonds can break, and
    # takes half the time of the second; mostly it finds nothing, and the second is skipped. The
    # last loop writes, and runs only if there is anything to write.
    out.add(0, "some = 0", "for j in range(j1 - j0):")
    out.add(1, *lines.look, f"some = some | (1 if {lines.breaks}{lines.differ} else 0)")
    out.add(0, "if some:", "    some = 0", "    for j in range(j1 - j0):")
    out.add(2, *lines.look, f"fresh = (since[j] < 0) & {can} & ({lines.breaks}{lines.differ})")
    out.add(2, "some = some | (1 if fresh else 0)")
    out.add(0, "if some:", "    for j in range(j1 - j0):")
    write = [*lines.write, *marking_lines(plan, "bond_base + j", "base + j")]
    out.add(2, f"if (since[j] < 0) & {can}:", *("    " + line for line in write))


def write_events(plan: Plan) -> Function:
    """Return the function that records the step and the length of the bonds that the sweep has just
    broken in a row. The length is computed from the end at which a bond is stored. `base` is the
    first flat place of the row."""
    out = Function(plan.shared, "note_broken", "s", "base", "width")
    out.add(0, "for here in range(base, base + width):")
    out.add(1, "bits = int64(flat_lost[here])", "for k in range(counts[s]):")
    out.add(2, "there, owner = here + away[s, k], here + bonds_away[s, k]")
    # A bond is recorded by the particle at which it is stored, or by the particle at the other end
    # if the first is not a particle of the body.
    out.add(2, f"ours = signs[s, k] > 0 or flat_kind[there] != {FOLLOWER}")
    out.add(2, "if (bits >> k) & 1 and ours and flat_broken[owner] < 0:")
    out.add(3, "flat_broken[owner] = step")
    d, r = plan.vector("flat_u_@[there] - flat_u_@[here]"), plan.vector("rests[s, k, #]")
    out.add(3, f"flat_lengths[owner] = length(signs[s, k] * {r} + signs[s, k] * {d})")
    return out


NOBODY = 0
"""Kind of row without followers."""
GENERAL = 1
"""Kind of row for particles that may lack neighbours."""
PLAIN = 2
"""Kind of row for particles that have all their neighbours and no cut cells."""
WITH_CELLS = 3
"""Kind of row for particles that have all their neighbours, and cut cells."""


class Words(NamedTuple):
    """Expressions for one neighbour and its bond.

    `pattern` is the displacement of the neighbour, with `@` for the axis. `numbers` are the state
    variables of the neighbour. `shares` are the area fractions of the cells beside the slot; there
    are none if no cell is cut. `bond` and `limit` are patterns for the state variables and the
    limits of the bond, with `{n}` for the index. `since` is the step at which the bond broke.
    """

    pattern: str
    numbers: Sequence[str]
    shares: Sequence[str]
    bond: str
    limit: str
    since: str


def write_row(
    plan: Plan, level: Level, s: int, kind: int, events: Function | None
) -> list[Function]:
    """Return the functions that move the particles of one kind of row. The last function calls the
    others."""
    out = Function(plan.shared, f"row{level.number}_{s}_{kind}", *RUNS)
    write_row_loop(out, plan, level, str(s))
    words = _write_neighbours(out, plan, level, s, kind)
    if plan.judged:
        out.add(0, f"gone = {plan.row('lost', s)}", "changed = 0")
    if plan.tears:
        out.add(0, f"marks = {plan.row('torn', s)}", "marked = 0")
    out.add(0, "for j in range(j1 - j0):")
    write_whole(out, plan, level, s, words, "gone[j]", "marks[j]" if plan.tears else "")
    if events:
        out.add(0, "if changed:")
        out.add(1, events.call(str(s), plan.flat(str(s)), "j1 - j0"))
    if not plan.tears:
        return [out]
    torn = write_torn_row(plan, level, s, kind)
    out.add(1, "marked = marked | marks[j]")
    _write_marked(out, torn)
    return [torn, out]


def _write_neighbours(out: Function, plan: Plan, level: Level, s: int, kind: int) -> list[Words]:
    """Write lines that define the arrays of the neighbours of a row, and return the expressions for
    each neighbour."""
    slots = plan.scene.neighbourhood.slots[s]
    for k, slot in enumerate(slots):
        pattern = plan.row(f"{level.source}_@", slot.target, slot.cell)
        out.add(0, *plan.each(f"n{k}@ = {pattern}"), *_bond_rows(plan, k, slot))
        rows_of = (plan.row(array, slot.target, slot.cell) for array in plan.shown)
        out.add(0, *(f"e{k}_{m} = {row}" for m, row in enumerate(rows_of)))
    shares: dict[str, str] = {}
    if kind == WITH_CELLS:
        rows = dict.fromkeys(row for slot in slots for row in _beside(plan, slot))
        shares = {row: f"s{n}" for n, row in enumerate(rows)}
    out.add(0, *(f"{name} = {row}" for row, name in shares.items()))
    words = []
    for k, slot in enumerate(slots):
        numbers = [f"e{k}_{m}[j]" for m in range(len(plan.shown))]
        shares_of = [f"{shares[row]}[j]" for row in _beside(plan, slot)] if shares else []
        bond = f"b{k}_{{n}}[j]", f"x{k}_{{n}}[j]", f"f{k}[j]"
        words.append(Words(f"n{k}@[j]", numbers, shares_of, *bond))
    return words


def write_whole(
    out: Function,
    plan: Plan,
    level: Level,
    s: int,
    words: Sequence[Words],
    lost: str,
    mark: str = "",
    damage: RowDamage | None = None,
) -> None:
    """Write the lines that move a particle with all its neighbours, inside a loop over particles.
    `words` are the expressions for each neighbour, and `lost` is the expression for the mask of
    broken bonds. If cells can be torn, particles with a `mark` are not moved; if `damage` is given,
    only particles with a mark are moved."""
    out.add(1, *displacements(plan, level))
    if plan.judged:
        out.add(1, f"bits = int64({lost})", "now = bits")
    slots = plan.scene.neighbourhood.slots[s]
    for k, slot in enumerate(slots):
        out.add(1, *_slot_lines(plan, level, k, slot, words[k], damage))
    for e, pair in enumerate(level.pairs[s] if level.pairs else ()):
        ends = (
            (f"d{k}", plan.literal(slots[k].rest), _weights(plan, level, slots[k], words[k]))
            for k in pair
        )
        out.add(1, _pair_contributions(plan, level, list(ends)))
        out.add(1, *_added(plan, level.pair_totals, is_first=e == 0))
    chosen: tuple[str, ...] = ()
    if mark:
        chosen = f"{mark} {'!=' if damage else '=='} 0", "o@[j]"
    sums = level.totals + level.pair_totals
    out.add(1, *target_lines(plan, level, plan.local_places(str(s)), sums, *chosen))
    if plan.judged:
        out.add(1, "changed = changed | (now ^ bits)", f"{lost} = now")


def write_torn_row(plan: Plan, level: Level, s: int, kind: int) -> Function:
    """Return the function that moves those of the particles j0 to j1 that are marked, in a row of a
    given kind. All arrays begin at j0, so that the loops are vectorised."""
    out = Function(plan.shared, f"torn{level.number}_{s}_{kind}", *plan.lead, "j0", "j1")
    damage = RowDamage(plan, s)
    out.add(0, *parameters(plan, level))
    write_rows(out, plan, level, str(s))
    words = _write_neighbours(out, plan, level, s, kind)
    out.add(0, f"marks = {plan.row('torn', s)}", *damage.lines, "for j in range(j1 - j0):")
    write_whole(out, plan, level, s, words, "", "marks[j]", damage)
    return out


def _write_marked(out: Function, torn: Function) -> None:
    """Write a call for each chunk of a row in which particles are marked."""
    *lead, _, _ = torn.own
    out.add(0, "if marked:", f"    for begin in range(0, j1 - j0, {CHUNK}):")
    out.add(2, f"end, marked = min(begin + {CHUNK}, j1 - j0), 0", "for j in range(begin, end):")
    out.add(3, "marked = marked | marks[j]")
    out.add(2, "if marked:", "    " + torn.call(*lead, "j0 + begin", "j0 + end"))


def _slot_lines(
    plan: Plan, level: Level, k: int, slot: Slot, words: Words, damage: RowDamage | None
) -> list[str]:
    """Return lines that compute the contributions of one neighbour and add them."""
    bond = {
        Owner.SLOT: f"limits[{slot.source}, {k}, {{n}}]",
        Owner.BOND: words.bond,
        Owner.FIXED_BOND: words.limit,
    }
    c = f"Constants({values(level.seen.bond, bond)})"
    # At both ends of a bond, d and r are used with the signs that they have at the end at which the
    # bond is stored. The results at both ends then agree to the last bit.
    _, is_owner = plan.scene.neighbourhood.owner[slot]
    arguments = f"d, {plan.literal(slot.rest)}" if is_owner else f"-d, {plan.literal(-slot.rest)}"
    weights, r = _weights(plan, level, slot, words), plan.literal(slot.rest)
    return [
        difference(plan, level, words.pattern),
        *bond_lines(plan, k, r, c, f"breaks({arguments}, {c}, q)", words.since),
        *([damage.beside(slot)] if damage else []),
        contributions(plan, level, r, weights, words.numbers, damage is not None),
        *_added(plan, level.totals, is_first=k == 0),
        *([f"d{k} = d"] if level.pairs else []),
    ]


def _weights(plan: Plan, level: Level, slot: Slot, words: Words) -> str:
    """Return the weights of a slot as arguments of a named tuple."""
    literal = level.scene.constants.weights[slot]._asdict()
    weights = {name: plan.number(value) for name, value in literal.items()}
    if words.shares:
        weights["left"], weights["right"] = words.shares
    return listed(weights.values())


def _added(plan: Plan, totals: Sequence[str], *, is_first: bool) -> list[str]:
    """Return lines that add contributions to sums; the first contributions are assigned."""
    return [
        f"{total} = {'' if is_first else f'{total} + '}{plan.rounded(f'c{total[1:]}')}"
        for total in totals
    ]


def _bond_rows(plan: Plan, k: int, slot: Slot) -> list[str]:
    """Return lines that define the arrays of the bonds along a slot."""
    if plan.model is None or plan.tears:
        return []
    plane, is_owner = plan.scene.neighbourhood.owner[slot]
    rows = {f"b{k}_{n}": f"bond{n}" for n in range(plan.bonds)}
    rows |= {f"x{k}_{n}": f"limit{n}" for n in range(plan.limits)}
    if not plan.judged:
        rows[f"f{k}"] = "broken"
    step = None if is_owner else slot.cell
    return [f"{name} = {plan.row(array, plane, step)}" for name, array in rows.items()]


def _beside(plan: Plan, slot: Slot) -> list[str]:
    """Return expressions for the area fractions of the cells on both sides of a slot."""
    assert plan.scene.cells
    rows = []
    for side in plan.scene.cells.tiling.beside[slot]:
        target, step = (side.first.target, side.first.cell) if side.first else (slot.source, None)
        rows.append(plan.row("share", f"{side.kind}, {target}", step))
    return rows


def write_general(plan: Plan, level: Level, events: Function | None) -> Function:
    """Return the function that moves particles of sublattice s that may lack neighbours."""
    out = Function(plan.shared, f"general{level.number}", "s", *RUNS)
    write_row_loop(out, plan, level, "s")
    out.add(0, f"base = {plan.flat('s')}", "width = j1 - j0")
    if level.pairs:
        slots = max(map(len, plan.scene.neighbourhood.slots))
        size = f"({slots}, {'width' if _is_slot_after_slot(plan) else 1})"
        out.add(0, *plan.each(f"seen_@ = np.empty({size}, {plan.real})"))
        out.add(0, f"exists = np.empty({size}, np.uint8)")
    if _is_slot_after_slot(plan):
        _write_slot_after_slot(out, plan, level)
    else:
        out.add(0, "changed = 0", "for j in range(width):")
        write_one(out, plan, level)
    if events:
        out.add(0, "if changed:", "    " + events.call("s", "base", "width"))
    return out


def write_one(out: Function, plan: Plan, level: Level) -> None:
    """Write the lines that move one particle of sublattice s, inside a loop over particles."""
    # Sums start from -0.0, because adding it changes neither +0.0 nor -0.0.
    sums = level.totals + level.pair_totals
    out.add(1, *(f"{t} = {plan.real}(-0.0)" for t in sums), "near, at_j = 0, base + j")
    if plan.judged:
        out.add(1, "bits = int64(flat_lost[at_j])", "now = bits")
    if plan.tears:
        out.add(1, *damage_lines(plan))
    out.add(1, *displacements(plan, level), "for k in range(counts[s]):")
    _write_slot(out, plan, level, level.totals, "near")
    _write_pairs(out, plan, level, level.pair_totals)
    out.add(1, f"moves = (flat_kind[at_j] == {FOLLOWER}) & (near > 0)")
    out.add(1, *target_lines(plan, level, plan.local_places("s"), sums, "moves"))
    if plan.judged:
        out.add(1, "changed = changed | (now ^ bits)", "flat_lost[at_j] = now")


def _write_slot_after_slot(out: Function, plan: Plan, level: Level) -> None:
    totals = level.totals + level.pair_totals
    sums, of_pairs = [f"{t}[j]" for t in totals], [f"{t}[j]" for t in level.pair_totals]
    out.add(0, f"t = np.full(({len(sums)}, width), {plan.number(-0.0)})")
    out.add(0, *(f"{t} = t[{n}]" for n, t in enumerate(totals)))
    out.add(0, "near = np.zeros(width, np.int64)", f"kinds = {plan.row('kind', 's')}")
    out.add(0, "for k in range(counts[s]):")
    _write_slot(out, plan, level, sums[: len(level.totals)], "near[j]")
    _write_pairs(out, plan, level, of_pairs)
    out.add(0, "for j in range(width):")
    out.add(1, *displacements(plan, level), f"moves = (kinds[j] == {FOLLOWER}) & (near[j] > 0)")
    out.add(1, *target_lines(plan, level, plan.local_places("s"), sums, "moves"))


def _is_slot_after_slot(plan: Plan) -> bool:
    """Return whether all particles of a row are evaluated slot after slot."""
    return plan.long and not plan.gpu


def _seen(out: Function, plan: Plan, array: str, away: str) -> str:
    """Return an expression for the value of an array at the index offset `away` from the flat place
    of the particle. It is an element of the flat array or, if all particles of a row are computed
    slot after slot, an element of a row of values. `@` in the name stands for each axis."""
    if not _is_slot_after_slot(plan):
        return f"flat_{array}[at_j + {away}]"
    row = f"row_{array} = flat_{array}[base + {away}:base + {away} + width]"
    out.add(1, *dict.fromkeys(plan.each(row)))
    return f"row_{array}[j]"


def _write_slot(out: Function, plan: Plan, level: Level, sums: Sequence[str], near: str) -> None:
    pattern = _seen(out, plan, f"{level.source}_@", "away[s, k]")
    kind = _seen(out, plan, "kind", "away[s, k]")
    named = {Owner.SLOT: f"weights{level.number}[s, k, {{n}}]", Owner.CELL: "share_{n}"}
    depth = 1 if _is_slot_after_slot(plan) else 2
    if any(number.owner is Owner.CELL for number in level.seen.weights):
        for side in (0, 1):  # No row is computed slot after slot.
            out.add(depth, f"share_{side} = flat_share[at_j + cells_away[s, k, {side}]]")
    numbers = [_seen(out, plan, array, "away[s, k]") for array in plan.shown]
    bonds, limits_ = (0, 0) if plan.tears else (plan.bonds, plan.limits)
    bond = [_seen(out, plan, f"bond{n}", "bonds_away[s, k]") for n in range(bonds)]
    fixed = [_seen(out, plan, f"limit{n}", "bonds_away[s, k]") for n in range(limits_)]
    first = plan.bonds_first and not plan.tears
    since = _seen(out, plan, "broken", "bonds_away[s, k]") if first else ""
    out.add(depth, f"r = {plan.vector('rests[s, k, #]')}")
    if _is_slot_after_slot(plan):
        out.add(1, "for j in range(width):")
        out.add(2, *displacements(plan, level))
    out.add(2, f"is_there = {kind} != {EMPTY}", difference(plan, level, pattern))
    out.add(2, *(f"b{n} = {value}" for n, value in enumerate(bond)))
    out.add(2, *(f"x{n} = {value}" for n, value in enumerate(fixed)))
    limits = {Owner.SLOT: "limits[s, k, {n}]", Owner.BOND: "b{n}", Owner.FIXED_BOND: "x{n}"}
    c = f"Constants({values(level.seen.bond, limits)})"
    spares = plan.model and not plan.model.breaks_frame_bonds()
    can = f"({kind} == {FOLLOWER})" if spares else "is_there"
    breaks = f"breaks(signs[s, k] * d, signs[s, k] * r, {c}, q) and {can}"
    out.add(2, *bond_lines(plan, "k", "r", c, breaks, since))
    if plan.tears:
        out.add(2, *torn_at_slot(plan))
    weights = values(level.seen.weights, named)
    out.add(2, contributions(plan, level, "r", weights, numbers, torn=plan.tears))
    if plan.mixed:
        _write_mixed(out, plan, level, numbers)
    for n, t in enumerate(sums):
        out.add(2, f"{t} = {t} + ({plan.rounded(f'c{n}')} if is_there else {plan.number(0.0)})")
    out.add(2, f"{near} = {near} + (1 if is_there else 0)")
    if level.pairs:
        at = "j" if _is_slot_after_slot(plan) else "0"
        out.add(2, *plan.each(f"seen_@[k, {at}] = d.@"), f"exists[k, {at}] = is_there")


def _write_pairs(out: Function, plan: Plan, level: Level, sums: Sequence[str]) -> None:
    """Write a loop over the pairs of neighbours, if the rule uses angles. `seen_@` are the
    differences that the rule receives along each slot."""
    if not level.pairs:
        return
    n, is_row = level.number, _is_slot_after_slot(plan)
    depth, at = (0, "j") if is_row else (1, "0")
    out.add(depth, f"for e in range(pair_counts{n}[s]):")
    out.add(depth + 1, f"one, other = pair_slots{n}[s, e, 0], pair_slots{n}[s, e, 1]")
    if is_row:
        out.add(1, "for j in range(width):")
        out.add(2, *([_rule(level)] if level.fields else []))
    ends = []
    for k in ("one", "other"):
        owners = {
            Owner.SLOT: f"weights{n}[s, {k}, {{n}}]",
            Owner.CELL: f"flat_share[at_j + cells_away[s, {k}, {{n}}]]",
        }
        d, r = (plan.vector(v) for v in (f"seen_@[{k}, {at}]", f"rests[s, {k}, #]"))
        ends.append((d, r, values(level.seen.weights, owners)))
    out.add(2, f"both = (exists[one, {at}] != 0) & (exists[other, {at}] != 0)")
    out.add(2, _pair_contributions(plan, level, ends))
    for total, t in zip(level.pair_totals, sums, strict=True):
        c = plan.rounded(f"c{total[1:]}")
        out.add(2, f"{t} = {t} + ({c} if both else {plan.number(0.0)})")


def _write_mixed(out: Function, plan: Plan, level: Level, shown: Sequence[str]) -> None:
    """Write lines for the contributions of cells with a stiffness other than that of the rule. Few
    particles have such cells."""
    nothing = plan.number(0.0)
    out.add(2, f"if share_0 == {nothing} or share_1 == {nothing}:")
    weights = []
    for side in (0, 1):
        out.add(3, f"cell_{side} = {plan.mixed} * (at_j + cells_away[s, k, {side}])")
    for m in range(plan.mixed):
        owners = {Owner.SLOT: f"more{m}[s, k, {{n}}]", Owner.CELL: f"flat_mixed[cell_{{n}} + {m}]"}
        weights.append(values(level.seen.weights, owners))
    out.add(3, *more_contributions(plan, level, "r", weights, shown))
