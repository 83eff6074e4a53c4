"""Equilibria of linear rules with breaking bonds. One compiled call computes one increment or
several: it moves the body to equilibrium, updates and breaks bonds, and repeats this until no bond
changes.

The system is A c = r with a band matrix A = 1 - (step operator). It has one unknown for each
follower and axis. If the axes are independent and have equal matrices, it has one unknown for each
follower instead, and one right side for each axis. `wide` is the number of unknowns of a follower.
Row i of a band holds A[i, i - half] to A[i, i + half]. A is factorised in place into L, with ones
on the diagonal, and U, without pivoting. A row of the factors depends on earlier rows only. If
bonds have changed, it is therefore sufficient to assemble and factorise the rows from the first
affected follower on. The entries of A are computed from the moves that a unit displacement of each
neighbour causes in a body at rest; for linear rules they are exact. The same equilibria take 20
times as long without this kernel (docs/decisions/0010).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pbdkit.array_types import Floats, Indices
from pbdkit.equilibrium.error_bound import LINEAR
from pbdkit.equilibrium.sparse import SOFT
from pbdkit.equilibrium.system import ROUNDING
from pbdkit.errors import PluginError
from pbdkit.lattice.raster import FOLLOWER, slot_step
from pbdkit.linear.block_matrix import frame_matrices
from pbdkit.linear.response import by_sublattice
from pbdkit.model.solver import Stepping
from pbdkit.plugin import RenewsBonds, SoftensCells
from pbdkit.plugin.discovery import errors_attributed_to
from pbdkit.progress import Watch
from pbdkit.scene.constants import Owner
from pbdkit.scene.leader_groups import kinds_at
from pbdkit.scene.memory_estimate import LARGEST_REPEATED
from pbdkit.scene.scene import Scene
from pbdkit.stepping.engine_choice import obstacle
from pbdkit.stepping.frame_following import FollowFrame
from pbdkit.stepping.kernel import Function
from pbdkit.stepping.leaders import place, prescribe
from pbdkit.stepping.numba_engine.arrays import Arrays, constant_arrays, find_runs, state_arrays
from pbdkit.stepping.numba_engine.emitter import LatticeWriter, write_module
from pbdkit.stepping.numba_engine.plan import Passes, Plan, levels_of, load_plugin_kernel
from pbdkit.stepping.numba_engine.sweeps import write_bond_pass, write_general
from pbdkit.stepping.state import State, unmoved_state

SAME = 1e-12
"""Two entries are regarded as equal if their difference, relative to a move, is at most this
number."""
SAFETY = 3.0
"""Safety factor of the estimated norm of A⁻¹."""


def rows_of(work: Any, count: int, reach: int, wide: int) -> Any:
    """Return an empty band matrix of `count` followers, each coupled to those up to `reach` before
    and after it."""
    width = 2 * ((reach + 1) * wide - 1) + 1
    return work[: count * wide * width].reshape(count * wide, width)


def are_alike(blocks: Any) -> Any:
    """Return whether all blocks (follower, neighbour, axis, axis) are multiples of the identity."""
    count, slots, axes, _ = blocks.shape
    for e in range(count):
        for k in range(slots):
            for a in range(axes):
                for b in range(axes):
                    like = blocks[e, k, 0, 0] if a == b else 0.0
                    if not abs(blocks[e, k, a, b] - like) <= SAME:
                        return False
    return True


def assemble(band: Any, blocks: Any, pattern: Any, first: int, wide: int) -> None:
    """Assemble the rows of A from follower `first` on. The row of a follower that does not move
    would contain only zeros; its diagonal entry is set to 1."""
    first_entry, slot, column, weight = pattern
    half = band.shape[1] // 2
    for e in range(first, len(blocks)):
        for i in range(e * wide, (e + 1) * wide):
            for m in range(band.shape[1]):
                band[i, m] = 0.0
        for n in range(first_entry[e], first_entry[e + 1]):
            away = half + (column[n] - e) * wide
            for a in range(wide):
                for b in range(wide):
                    value = 0.0
                    for c in range(wide):
                        value += blocks[e, slot[n], a, c] * weight[n, c, b]
                    band[e * wide + a, away + b - a] -= value
        for i in range(e * wide, (e + 1) * wide):
            largest_entry = 0.0
            for m in range(band.shape[1]):
                largest_entry = max(largest_entry, abs(band[i, m]))
            if largest_entry == 0.0:
                band[i, half] = 1.0


def factor(band: Any, first: int, diagonal: Any, inverse: Any) -> None:
    """Factorise the rows of A from `first` on, in place; store the diagonal of A and the inverse of
    each pivot."""
    half = band.shape[1] // 2
    for i in range(first, len(band)):
        row = band[i]
        diagonal[i] = row[half]
        for k in range(max(0, i - half), i):
            at = k - i + half
            if row[at] != 0.0:
                share = row[at] * inverse[k]
                row[at] = share
                lower, upper = row[at + 1 : at + 1 + half], band[k, half + 1 :]
                for m in range(half):
                    lower[m] -= share * upper[m]
        inverse[i] = 1.0 / row[half]


def solve(band: Any, inverse: Any, x: Any) -> None:
    """Replace right-hand sides by solutions. The shape of x is (unknown, right-hand side)."""
    half, sides = band.shape[1] // 2, x.shape[1]
    for i in range(len(band)):
        for k in range(max(0, i - half), i):
            for s in range(sides):
                x[i, s] -= band[i, k - i + half] * x[k, s]
    for i in range(len(band) - 1, -1, -1):
        for k in range(i + 1, min(len(band), i + half + 1)):
            for s in range(sides):
                x[i, s] -= band[i, k - i + half] * x[k, s]
        for s in range(sides):
            x[i, s] *= inverse[i]


def refactor(
    work: Any, blocks: Any, pattern: Any, factors: Any, facts: Any, first: int, is_uniform: bool
) -> None:
    """Update the factors from follower `first` on. The entries of `facts` are, in order: the number
    of unknowns of a follower; the norm of A⁻¹, estimated from random signs and multiplied by a
    safety factor; the largest diagonal entry; and the half-bandwidth, counted in followers.
    `is_uniform` is true if frame points follow in the same way along all axes."""
    diagonal, inverse, signs = factors
    count, axes = blocks.shape[0], blocks.shape[2]
    wide = 1 if is_uniform and are_alike(blocks) else axes
    if wide != facts[0]:
        first = 0
    facts[0], facts[2] = wide, 1.0
    band, size = rows_of(work, count, int(facts[3]), wide), count * wide
    assemble(band, blocks, pattern, first, wide)
    factor(band, first * wide, diagonal, inverse)
    x = np.empty((size, 1))
    for i in range(size):
        x[i, 0] = signs[i]
        facts[2] = max(facts[2], abs(diagonal[i]))
    solve(band, inverse, x)
    facts[1] = SAFETY * largest(x)


def correct(work: Any, factors: Any, facts: Any, r: Any, c: Any) -> None:
    """Solve A c = r for c, (follower, axis)."""
    count, axes = r.shape
    wide = 1 if facts[0] == 1.0 else axes
    for e in range(count):
        for a in range(axes):
            c[e, a] = r[e, a]
    band = rows_of(work, count, int(facts[3]), wide)
    solve(band, factors[1], c.reshape(count * wide, axes // wide))


def largest(table: Any) -> Any:
    """Return the largest magnitude in a table; nan if one is nan."""
    magnitude = 0.0
    for n in range(table.shape[0]):
        for m in range(table.shape[1]):
            if not abs(table[n, m]) <= magnitude:
                magnitude = abs(table[n, m])
    return magnitude


def norm(table: Any) -> Any:
    """Return the root of the sum of squares."""
    squares = 0.0
    for n in range(table.shape[0]):
        for m in range(table.shape[1]):
            squares += table[n, m] * table[n, m]
    return math.sqrt(squares)


COMPILING_S = 10.0
"""If numpy is estimated to need more than this time, in seconds, the kernel is compiled. Compiling
takes 20 s of processor time at the first use."""
EQUILIBRIUM_S = 6e-3
"""Estimated time of one equilibrium by numpy, in seconds."""
PARTICLE_S = 1e-5
"""Estimated additional time for each particle, in seconds."""
EQUILIBRIA_IF_SOFTENING = 20
"""Estimated number of equilibria in an increment if bonds soften gradually."""
EQUILIBRIA_IF_BREAKING = 2
"""Estimated number of equilibria in an increment if bonds only break."""


def breaking_kernel_of(scene: Scene, tolerance: float, watch: Watch) -> BreakingKernel | None:
    """Return the kernel of a scene with a linear rule.

    Returns None if compiling would take longer than numpy, if nothing can be compiled, or if the
    method of the solver is not direct. The result depends only on the experiment, so that a resumed
    run continues with the same method.
    """
    solver = scene.experiment.solver.equilibrium
    direct = solver.method == "lu" or (
        solver.method == "auto" and scene.raster.count <= LARGEST_REPEATED
    )
    if not (direct and _is_plain(scene)) or _seconds(scene) < COMPILING_S or obstacle():
        return None

    try:
        kernel = BreakingKernel(scene, tolerance, watch)
    except PluginError:
        return None
    return kernel if kernel.is_small else None


def _is_plain(scene: Scene) -> bool:
    """Return whether the kernel supports all features of the scene. It does not support loads,
    cuts, spatially varying or time-dependent parameters, leaders along one axis only, and fracture
    models in which cells soften one after the other."""
    experiment, constants = scene.experiment, scene.constants
    varies = any(
        (
            experiment.cuts,
            experiment.loads,
            experiment.time_dependent,
            constants.by_bond,
            constants.by_particle,
        )
    )
    mixed = scene.cells is not None and bool(scene.cells.mixed)
    guided = any(leading.group.axes for leading in scene.leading)
    flat = scene.axes == 2 and scene.inner is None
    in_turn = isinstance(experiment.fracture, SoftensCells)
    return scene.has_fracture and flat and not (varies or mixed or guided or in_turn)


def _seconds(scene: Scene) -> float:
    """Estimate the time that the computation takes with numpy, in seconds."""
    renews = isinstance(scene.experiment.fracture, RenewsBonds)
    equilibria = scene.experiment.solver.equilibrium.increments * (
        EQUILIBRIA_IF_SOFTENING if renews else EQUILIBRIA_IF_BREAKING
    )
    return equilibria * (EQUILIBRIUM_S + PARTICLE_S * scene.raster.count)


Entry = tuple[Indices, Indices, Indices, Floats]


@dataclass(frozen=True)
class Pattern:
    """Couplings of the followers. `place` is the flat place of each follower. The entries from
    `first[e]` to `first[e + 1]` belong to follower e. An entry couples e to the follower `column`.
    Its value is the derivative of the move of e with respect to the displacement of its neighbour
    along `slot`, times `weight` (entry, axis, axis). If `slot` is the last one, the derivative is
    with respect to the displacement of e itself."""

    place: Indices
    first: Indices
    slot: Indices
    column: Indices
    weight: Floats

    @property
    def reach(self) -> int:
        """Largest distance of a column from its row, the half width of the band."""
        row = np.repeat(np.arange(len(self.place)), np.diff(self.first))
        return int(np.abs(row - self.column).max(initial=0))

    @property
    def alike(self) -> bool:
        """True if each weight is a multiple of the identity, so that all axes have the same
        couplings."""
        axes = self.weight.shape[-1]
        return bool((self.weight == self.weight[:, :1, :1] * np.eye(axes)).all())


def pattern_at(scene: Scene, step: int) -> Pattern:
    """Return the couplings with the roles of a step, with followers ordered row by row or column by
    column, whichever has the smaller reach."""
    rows = np.flatnonzero(kinds_at(scene.raster, scene.leading, step) == FOLLOWER)
    places, (x, y) = scene.raster.place_of(rows), scene.raster.reference(rows).round(6).T
    patterns = (_pattern(scene, places[np.lexsort(keys)]) for keys in ((x, y), (y, x)))
    return min(patterns, key=lambda pattern: pattern.reach)


def _pattern(scene: Scene, place: Indices) -> Pattern:
    parts = [*_entries(scene, place.astype(np.int64))]
    row, slot, column, weight = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.lexsort((slot, row))
    first = np.searchsorted(row[order], np.arange(len(place) + 1))
    return Pattern(
        place.astype(np.int64), first, slot[order], column[order], weight[order].astype(float)
    )


def _entries(scene: Scene, place: Indices) -> Iterator[Entry]:
    """Generate entries (follower, slot, column, weight), several at a time."""
    size, identity = scene.raster.kind.size, np.eye(scene.axes)
    column_at = np.full(size, -1)
    every = column_at[place] = np.arange(len(place))

    def entries(rows: Indices, slot: int, neighbours: Indices, weight: Floats) -> Entry:
        free = column_at[neighbours] >= 0
        slots = np.full(np.count_nonzero(free), slot)
        return rows[free], slots, column_at[neighbours[free]], weight[free]

    for s, members in by_sublattice(scene, place):
        ones = np.broadcast_to(identity, (len(members), *identity.shape))
        count = len(scene.neighbourhood.slots[s])
        yield entries(every[members], count, place[members], ones)
        for k, slot in enumerate(scene.neighbourhood.slots[s]):
            neighbours = place[members] + slot_step(scene.raster.shape, slot)
            yield entries(every[members], k, neighbours, ones)
            for rows, body, weight in _followed(scene, neighbours):
                yield entries(every[members][rows], k, body, weight)


def _followed(scene: Scene, places: Indices) -> Iterator[tuple[Indices, Indices, Floats]]:
    """Generate triples of arrays: the indices of those places that are frame points, a body place
    that each of these points follows, and the weight of this body place. The first triple contains
    the first body place of each point, the second triple the second one, and so on."""
    if (frame := scene.frame) is None:
        return
    point_at = np.full(scene.raster.kind.size, -1)
    point_at[frame.place] = np.arange(len(frame.place))
    numbers = np.flatnonzero(point_at[places] >= 0)
    first, last = (
        np.searchsorted(frame.map.point, point_at[places[numbers]], side)
        for side in ("left", "right")
    )
    matrices = frame_matrices(frame.map.weight, scene.axes)
    for e in range(int((last - first).max(initial=0))):
        has = first + e < last
        entry = (first + e)[has]
        yield numbers[has], frame.body_place[entry], matrices[entry]


UNFINISHED = 0
"""Result of a call: bonds may still change."""
CONVERGED = 1
"""Result of a call: no bond changes any more."""
FAILED = 2
"""Result of a call: the band matrix is not accurate enough. Followers are at the last
equilibrium."""
ROWS = "int64(0)", "int64(kind.shape[1])"
"""Arguments that stand for all rows of the lattice."""


def write_breaking_kernel(plan: Plan) -> tuple[str, list[str]]:
    """Return the source of a module with ``run(arrays, step, tolerance, slack, max_changes)``.

    The function computes at most `max_changes` equilibria. Their error is at most the length
    `tolerance`, and relative changes of state variables of at most `slack` are ignored. It returns
    the number of changes of bonds, and the result.
    """
    (level,) = plan.levels
    general = write_general(plan, level, None)
    follow = Function(plan.shared, "follow_body")
    follow.depth = -1
    for frame in FollowFrame.of(plan.scene):
        frame.emit_for(LatticeWriter(plan, follow, Passes(None, [])), "flat_u")
    moves, derive = _write_moves(plan, follow, general), _write_derivative(plan, general)
    bonds, mark, changed = write_bond_pass(plan), _write_mark(plan), _write_changed(plan)
    update, equilibrate = _write_known(plan, derive), _write_equilibrate(plan, follow, moves)
    run = Function(plan.shared, "run", "arrays", "step", "tolerance", "slack", "max_changes")
    run.add(0, "for n in range(max_changes):", f"    {mark.call()}")
    run.add(1, f"if not {update.call()} or not {equilibrate.call('tolerance')}:")
    run.add(2, f"return n, {FAILED}")
    run.add(1, bonds[-1].call(*ROWS, "0", "kind.shape[2]"), f"if not {changed.call('slack')}:")
    run.add(2, f"return n, {CONVERGED}")
    run.add(0, f"return max_changes, {UNFINISHED}")
    functions = [general, moves, derive, *bonds, mark, changed, update, equilibrate]
    return write_module(plan, [follow, *functions] if follow.lines else functions, run)


def _write_moves(plan: Plan, follow: Function, general: Function) -> Function:
    """Write the function that computes r (follower, axis), the moves, after updating the frame."""
    out = Function(plan.shared, "find_moves")
    out.add(0, *[follow.call()] * bool(follow.lines), "for n in range(len(body)):")
    out.add(1, general.call("body[n, 0]", "body[n, 1]", "body[n, 2]", *ROWS))
    out.add(0, "for e in range(place.size):")
    out.add(1, *plan.each("residual[e, #] = flat_v_@[place[e]] - flat_u_@[place[e]]"))
    return out


def _write_derivative(plan: Plan, general: Function) -> Function:
    """Write the function that computes the derivative of each follower's move with respect to each
    neighbour and itself; `u` are planes at rest."""
    axes, planes = len(plan.axes), plan.each("u_@")
    out = Function(plan.shared, "derive", "e", *planes)
    out.add(0, "spot, s, i = place[e], sublattice[e], runs[e, 0]")
    out.add(0, f"for m in range(-1, {axes} * (counts[s] + 1)):")
    out.add(1, f"k, b = m // {axes}, m % {axes}")
    out.add(1, "there = spot + away[s, k] if m >= 0 and k < counts[s] else spot")
    out.add(1, f"f = ({', '.join(f'{u}.reshape(-1)' for u in planes)})[b]")
    out.add(1, "f[there] = 0.0 if m < 0 else 1.0")
    out.add(1, general.call("s", "e", "e + 1", "i", "i + 1"))
    out.add(1, "if m < 0:", *plan.each("    none_@ = flat_v_@[spot]"), "else:")
    out.add(2, *plan.each("blocks[e, k, #, b] = flat_v_@[spot] - u_@.reshape(-1)[spot] - none_@"))
    out.add(1, "f[there] = 0.0")
    return out


def _bonds(plan: Plan, pattern: str) -> list[str]:
    """Return copies of a pattern of source text, one for each state variable of bonds, in which #
    is replaced by the number of the variable."""
    return [pattern.replace("#", str(n)) for n in range(plan.bonds)]


def _write_mark(plan: Plan) -> Function:
    """Write the function that marks followers. A follower is marked if its bonds, or bonds of the
    cells around it, have changed since the last call."""
    out = Function(plan.shared, "mark")
    differs = _bonds(plan, " or flat_bond#[owner] != flat_known#[owner]")
    out.add(0, "cells = broken.size // len(ends)", "for n in range(len(ends)):")
    out.add(1, "offset = ends[n, 2] * kind.shape[2] + ends[n, 3]", "for e in range(cells):")
    out.add(2, "owner = n * cells + e")
    out.add(2, f"if flat_broken[owner] != flat_known_broken[owner]{''.join(differs)}:")
    out.add(3, "flat_known_broken[owner] = flat_broken[owner]")
    out.add(3, *_bonds(plan, "flat_known#[owner] = flat_bond#[owner]"))
    if plan.tears:
        out.add(3, "for m in range(mark_steps.shape[1]):")
        out.add(4, "end = ends[n, 0] * cells + e + mark_steps[n, m]")
    else:
        out.add(3, "for end in (ends[n, 0] * cells + e, ends[n, 1] * cells + e + offset):")
    out.add(4, "if 0 <= end < equation.size and equation[end] >= 0:")
    out.add(5, "stale[equation[end]] = 1")
    return out


def _write_changed(plan: Plan) -> Function:
    """Write the function that returns whether bonds broke or changed; if not, it restores the state
    variables of the bonds."""
    out = Function(plan.shared, "changed", "slack")
    numbers = [n for n in plan.levels[-1].seen.bond if n.owner is Owner.BOND]
    changing = [str(n) for n, number in enumerate(numbers) if number.changes]
    out.add(0, "for owner in range(broken.size):")
    out.add(1, "if flat_broken[owner] >= 0 and flat_known_broken[owner] < 0:", "    return True")
    for n in changing:
        out.add(1, f"new, old = flat_bond{n}[owner], flat_known{n}[owner]")
        out.add(1, "if abs(new - old) > slack * max(1.0, abs(old)):", "    return True")
    if changing:
        out.add(0, "for owner in range(broken.size):")
        out.add(1, *(f"flat_bond{n}[owner] = flat_known{n}[owner]" for n in changing))
    out.add(0, "return False")
    return out


def _write_known(plan: Plan, derive: Function) -> Function:
    """Write the function that updates the factors, and returns whether they are accurate enough."""
    out = Function(plan.shared, "know")
    out.add(0, "since = place.size", "for e in range(place.size):", "    if stale[e]:")
    out.add(2, derive.call("e", *plan.each("still_@")), "stale[e], since = 0, min(since, e)")
    out.add(0, "pattern = first_entry, entry_slot, entry_column, entry_weight")
    out.add(0, "factors = diagonal, inverse, randoms", "if since < place.size:")
    out.add(1, "refactor(band, blocks, pattern, factors, facts, since, alike[0])")
    out.add(0, "return facts[1] < facts[4]")
    return out


def _write_equilibrate(plan: Plan, follow: Function, moves: Function) -> Function:
    """Write the function that moves the followers to equilibrium, and returns whether it
    succeeded."""
    out = Function(plan.shared, "equilibrate", "tolerance")
    at = plan.each("flat_u_@[place[e]]")
    out.add(0, "factors, before = (diagonal, inverse, randoms), 0.0", "for e in range(place.size):")
    out.add(1, *(f"kept[e, {a}] = {value}" for a, value in enumerate(at)))
    out.add(0, "for n in range(corrections[0]):", f"    {moves.call()}")
    out.add(1, "correct(band, factors, facts, residual, correction)")
    out.add(1, "size, left, bound = 0.0, norm(residual), 0.0")
    out.add(1, *plan.each("size = max(size, largest(u_@.reshape(-1, 1)))"))
    out.add(1, "unsure = facts[2] * facts[5] * size", "floor = unsure * residual.size**0.5")
    out.add(1, "for a in range(correction.shape[1]):")
    out.add(2, "bound += (largest(correction[:, a : a + 1]) + facts[1] * unsure) ** 2")
    out.add(1, "if n > 0 and bound <= tolerance**2:", "    return True")
    out.add(1, "before = left if n == 0 else before")
    out.add(1, "allowed = left if n == 0 else max(facts[6] * before + floor, 1e3 * floor)")
    out.add(1, "if not left <= allowed:")
    out.add(2, "break")
    out.add(1, "for e in range(place.size):")
    out.add(2, *(f"{value} += correction[e, {a}]" for a, value in enumerate(at)))
    out.add(0, "for e in range(place.size):")
    out.add(1, *(f"{value} = kept[e, {a}]" for a, value in enumerate(at)))
    out.add(0, *[follow.call()] * bool(follow.lines), "return False")
    return out


FUNCTIONS = (refactor, correct, largest, norm)
"""Functions that are part of every kernel."""
MAX_CORRECTIONS = 8
"""Maximum number of corrections until an equilibrium is reached."""
LARGEST_BAND = 10_000_000
"""Largest number of entries of a band: 80 MB."""
OPERATIONS_A_CALL = 100_000_000
"""Number of operations in a call, between two checks for interruption. A call takes a few tenths of
a second."""


class BreakingKernel:
    """Kernel for a linear rule, with its band matrix, which is all that is stored between two
    increments. All bits of the matrix are determined by the bonds, so that a resumed run has the
    same results.

    Raises PluginError if functions of the rule or the fracture model cannot be compiled.
    """

    def __init__(self, scene: Scene, tolerance: float, watch: Watch) -> None:
        solver = scene.experiment.solver.equilibrium
        self._scene, self._watch, self._tolerance = scene, watch, tolerance
        self._share = solver.tolerance
        stepping = Stepping(relaxation=scene.experiment.stepping.relaxation, threads=1)
        stepped = replace(
            scene, experiment=scene.experiment.model_copy(update={"solver": stepping})
        )
        levels = levels_of(stepped)
        self._plan = plan = Plan(stepped, levels, False, apart=True)
        self._runs, starts, groups = find_runs(stepped, all_general=True)
        self._body = [
            [s, span[0, 0], span[-1, 1]] for (s, _), span in zip(groups, starts, strict=True)
        ]
        size = np.array(scene.raster.shape[1:])
        box = np.stack([np.zeros_like(size), size], axis=1).ravel().astype(np.int64)
        self._constant = constant_arrays(plan) | {"box": box}
        if plan.tears:  # Every follower is treated as marked; marks are written but not read.
            self._constant["torn"] = np.zeros(scene.raster.shape, np.uint8)
        self._roles: tuple[bool, ...] = ()
        self._of_roles: Arrays = {}
        self._work = 1
        start = unmoved_state(scene, scene.raster.shape[1:])
        self._take_roles(scene.experiment.steps, start)
        shared = ("step", *self._named(start))
        source, self._names = write_breaking_kernel(replace(plan, shared=shared))
        functions = {function.__name__: function for function in FUNCTIONS}
        self._run = load_plugin_kernel(levels, source, self._given(start, 0.0, 0), functions)

    @property
    def is_small(self) -> bool:
        """True if the band matrix of the body is small enough to be factorised."""
        return bool(self._of_roles["band"].size <= LARGEST_BAND)

    def equilibrate(self, state: State, moment: float, max_changes: int) -> tuple[bool, int]:
        """Move a state, in place, from an equilibrium to the equilibrium at a moment, and update
        bonds, until no bond changes or `max_changes` equilibria have been computed.

        Returns whether no bond changes any more, and the number of changes of bonds. If the band
        matrix is not accurate enough, the state is that of the last equilibrium.

        Raises ExperimentError for contradicting leaders, and StoppedError.
        """
        placed, state.starts = prescribe(self._scene, state, moment)
        place(state.u, placed)
        self._take_roles(math.ceil(moment), state)
        changes, became = 0, UNFINISHED
        while became == UNFINISHED and changes < max_changes:
            self._watch.begin("equilibria and broken bonds")
            a_call = max(1, min(max_changes - changes, OPERATIONS_A_CALL // self._work))
            with errors_attributed_to(self._scene.experiment.rule, f"at step {moment:.6g}"):
                breaks, became = self._run(*self._given(state, moment, a_call))
            changes += breaks
        state.step = math.floor(moment)
        state.previous[...] = state.u
        return became == CONVERGED, changes

    def _take_roles(self, step: int, state: State) -> None:
        """Prepare the arrays for the roles of a step, if the roles have changed."""
        roles = tuple(leading.group.leads(step) for leading in self._scene.leading)
        if self._of_roles and roles == self._roles:
            return
        pattern = pattern_at(self._scene, step)
        reach, axes, count = pattern.reach, self._scene.axes, len(pattern.place)
        size = count * axes * (2 * ((reach + 1) * axes - 1) + 1)
        self._work = 1 + size * (reach + 1) * axes
        self._roles, self._of_roles = roles, self._arrays_of(pattern, size)
        # The value -2 differs from the state of any bond, so that all rows are assembled.
        stale = {"known_broken": np.full_like(state.broken_step, -2)}
        stale |= {f"known{n}": value.copy() for n, value in enumerate(state.bond_values)}
        self._of_roles |= stale

    def _arrays_of(self, pattern: Pattern, size: int) -> Arrays:
        """Return by name the arrays of the kernel that are constant while roles are constant."""
        raster, axes, count = self._scene.raster, self._scene.axes, len(pattern.place)
        s, *cells = np.unravel_index(pattern.place, raster.shape)
        alone = np.stack([cells[0], cells[0] + 1, cells[1], cells[1] + 1], axis=1)
        equation = np.full(raster.kind.size, -1)
        equation[pattern.place] = np.arange(count)
        slots = max(map(len, self._scene.neighbourhood.slots)) + 1
        facts = [0.0, 0.0, 1.0, pattern.reach, SOFT, ROUNDING, LINEAR]
        planes = [f"{name}_{c}" for name in ("v", "still") for c in self._plan.axes]
        signs = np.random.default_rng(0).choice([-1.0, 1.0], count * axes)
        return {
            # The first entries describe one run for each follower, which consists of a single
            # place.
            "runs": np.concatenate([alone, self._runs]).astype(np.int64),
            "body": np.array(self._body, np.int64) + np.array([0, count, count]),
            "place": pattern.place,
            "sublattice": s.astype(np.int64),
            "equation": equation.astype(np.int64),
            "first_entry": pattern.first.astype(np.int64),
            "entry_slot": pattern.slot.astype(np.int64),
            "entry_column": pattern.column.astype(np.int64),
            "entry_weight": pattern.weight,
            "alike": np.array([pattern.alike]),
            "stale": np.ones(count, np.uint8),
            "blocks": np.zeros((count, slots, axes, axes)),
            "band": np.empty(size),
            "diagonal": np.zeros(count * axes),
            "inverse": np.zeros(count * axes),
            "randoms": signs,
            "facts": np.array(facts, float),
            "corrections": np.array([MAX_CORRECTIONS + 1]),
            **{name: np.zeros((count, axes)) for name in ("residual", "correction", "kept")},
            **{name: np.zeros(raster.shape) for name in planes},
        }

    def _named(self, state: State) -> Arrays:
        """Return the arrays of the kernel by name."""
        nobody = np.zeros_like(state.u)
        return self._constant | state_arrays(self._plan, state.u, nobody, state) | self._of_roles

    def _given(self, state: State, moment: float, max_changes: int) -> tuple[Any, ...]:
        arrays = self._named(state)
        values = tuple(arrays[name] for name in self._names)
        return values, math.ceil(moment), self._tolerance, self._share, max_changes
