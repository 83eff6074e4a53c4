"""Arrays of kernels: constants of a scene, bit masks of broken bonds, and runs. A run is a range of
adjacent particles of a row that are computed by the same code, for instance because all their
neighbours are present."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats, Indices
from pbdkit.lattice.neighbourhood import BondPlane, plane_block
from pbdkit.lattice.raster import FOLLOWER, Block, slot_step
from pbdkit.plugin import Slot
from pbdkit.scene.frame import Frame
from pbdkit.scene.scene import Scene
from pbdkit.stepping.cell_stress import CellStresses
from pbdkit.stepping.frame_following import FollowFrame
from pbdkit.stepping.numba_engine import sweeps
from pbdkit.stepping.numba_engine.plan import Plan, banded, frame_order
from pbdkit.stepping.program import Program, program_of
from pbdkit.stepping.rule_evaluation import presence
from pbdkit.stepping.state import State
from pbdkit.stepping.step import Call, Entries

Arrays = dict[str, Any]
Bits = NDArray[np.unsignedinteger[Any]]


def constant_arrays(plan: Plan) -> Arrays:
    """Return the arrays that do not change from step to step."""
    scene, slots = plan.scene, plan.scene.neighbourhood.slots
    constants = scene.constants
    width, real = max(map(len, slots)), np.dtype(scene.experiment.stepping.precision)
    by_slot = _stacked([_of_slot(plan, slot) for slot in padded(slots)], real)
    arrays = {
        "kind": scene.raster.kind,
        "first": np.array(scene.raster.first, np.int64),
        "at": scene.raster.cell.basis,
        "counts": np.array([len(each) for each in slots]),
        **changing_arrays(plan),
        **{name: v.reshape(len(slots), width, *v.shape[1:]) for name, v in by_slot.items()},
        **_stacked([_of_plane(plan, plane) for plane in scene.neighbourhood.planes], real),
    }
    if scene.cells:
        arrays["share"] = np.array(scene.cells.weight, real)
        if mixed := scene.cells.mixed:  # The values of a cell are contiguous.
            arrays["mixed"] = np.stack(mixed, axis=-1).astype(real)
    for name, planes in (("field", constants.by_particle), ("limit", constants.by_bond)):
        arrays |= {f"{name}{n}": np.array(v, real) for n, v in enumerate(planes.values())}
    for level in plan.levels:
        if level.pairs:
            n, count = level.number, max(map(len, level.pairs))
            padded_pairs = [[*pairs, *[pairs[0]] * (count - len(pairs))] for pairs in level.pairs]
            arrays[f"pair_counts{n}"] = np.array([len(pairs) for pairs in level.pairs])
            arrays[f"pair_slots{n}"] = np.array(padded_pairs, np.int64)
    if scene.tears:
        arrays |= sweeps.tearing_arrays(scene)
    if plan.softens_cells:
        arrays |= sweeps.stress_arrays(scene, real)
    for operation in program_of(scene):
        for name, values in operation.constants().items():
            # One value is added, so that no array is empty.
            arrays[name] = np.array([*values, 0.0], real)
        for name, place in operation.lists().items():
            arrays |= list_arrays(plan, name, Entries(place, {}), by_rows=True)
    for following in FollowFrame.of(scene):
        assert scene.frame
        arrays |= _of_frame(scene.frame, frame_order(following), real)
    return arrays


def list_arrays(plan: Plan, name: str, entries: Entries, *, by_rows: bool) -> Arrays:
    """Return a list of particles with its values.

    Passes of several steps require `by_rows`. The list is then sorted by rows, and the index at
    which each row begins and the columns of the particles are returned too.
    """
    if not by_rows:
        return {name: entries.place, **entries.values}
    order, rows = banded(plan, name, entries.place)
    values = {key: np.ascontiguousarray(v[..., order]) for key, v in entries.values.items()}
    return {name: entries.place[order], **values, **rows}


def call_arrays(plan: Plan, program: Program, call: Call, *, by_rows: bool) -> Arrays:
    """Return the lists and arrays that operations read in a call."""
    arrays: Arrays = {}
    for operation in program:
        arrays |= operation.arrays(call)
        for name, entries in operation.entries(call).items():
            arrays |= list_arrays(plan, name, entries, by_rows=by_rows)
    return arrays


def state_arrays(plan: Plan, u: Floats, v: Floats, state: State) -> Arrays:
    """Return the displacements of a state, those of the previous step, and the state variables."""
    return {
        **dict(zip([*plan.each("u_@"), *plan.each("v_@")], [*u, *v], strict=True)),
        **{f"bond{n}": value for n, value in enumerate(state.bond_values)},
        **{f"own{n}": value for n, value in enumerate(state.particle_values)},
        "broken": state.broken_step,
        "lengths": state.broken_length,
    }


def _of_frame(frame: Frame, order: Indices, real: np.dtype[Any]) -> Arrays:
    """Return the frame points in a given order, and their entries in the frame's map, point after
    point."""
    counts = np.bincount(frame.map.point, minlength=len(frame.place))
    entry = np.argsort(np.argsort(order)[frame.map.point], kind="stable")
    return {
        "points": frame.place[order],
        "bodies": frame.body_place[entry],
        "entries": np.concatenate([[0], np.cumsum(counts[order])]),
        "frame_weights": frame.map.weight[entry].astype(real),
    }


def changing_arrays(plan: Plan) -> Arrays:
    """Return the arrays of time-dependent parameters of the rule, and of the limits of bonds."""
    scene, real = plan.scene, plan.scene.experiment.stepping.precision
    slots = scene.neighbourhood.slots
    limits = np.array([scene.constants.limits_of(slot) for slot in padded(slots)], real)
    ends = [scene.constants.limits_of(plane.slot) for plane in scene.neighbourhood.planes]
    return {
        **rule_arrays(plan),
        "limits": limits.reshape(len(slots), max(map(len, slots)), limits.shape[-1]),
        "end_limits": np.array(ends, real),
        **(_ratios(plan) if plan.softens_cells else {}),
    }


def _ratios(plan: Plan) -> Arrays:
    """Return the stiffness of cells divided by Young's modulus; the values of a cell are
    contiguous."""
    stresses, real = CellStresses(plan.scene), plan.scene.experiment.stepping.precision
    if plan.mixed:
        return {"ratios": np.stack(stresses.ratios_by_cell, axis=-1).astype(real)}
    return {"cell_ratios": np.array(stresses.ratios, real)}


def padded(slots: Sequence[tuple[Slot, ...]]) -> list[Slot]:
    """Return the slots of all sublattices in one list. It contains the same number of slots for
    each sublattice: if a sublattice has fewer slots, copies of its first slot are appended, which
    are not used."""
    width = max(map(len, slots))
    return [slot for each in slots for slot in (*each, *each[:1] * (width - len(each)))]


def rule_arrays(plan: Plan) -> Arrays:
    """Return the parameters of rules and solver."""
    solver = plan.scene.experiment.stepping
    # One value is added, so that no array is empty.
    rules = {
        f"rule{n}": [*level.scene.constants.shared, 0.0] for n, level in enumerate(plan.levels)
    }
    tables = {
        f"table{n}_{m}": table
        for n, level in enumerate(plan.levels)
        for m, table in enumerate(level.scene.constants.tables)
    }
    numbers = {"solver": [solver.relaxation, solver.memory], **rules, **tables}
    return {name: np.array(values, solver.precision) for name, values in numbers.items()}


def _stacked(rows: Sequence[dict[str, Any]], real: np.dtype[Any]) -> Arrays:
    """Return by name the values of all rows in one array, (row, ...)."""
    stacked = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return {name: v.astype(real if v.dtype.kind == "f" else int) for name, v in stacked.items()}


def _of_slot(plan: Plan, slot: Slot) -> dict[str, Any]:
    """Return the data of a slot by name: its rest offset and weights (`rests`, `weights...`), a
    sign (`signs`), and index offsets in flat arrays. The owner of a bond is the end at which it is
    stored; the sign is the factor of d there. There is an offset from a particle to its neighbour
    (`away`), to the entry of their bond (`bonds_away`), and to the area fractions of the cells
    beside the slot (`cells_away`)."""
    scene, shape = plan.scene, plan.scene.raster.shape
    away, (plane, is_owner) = slot_step(shape, slot), scene.neighbourhood.owner[slot]
    owner = plane - (slot.source if is_owner else slot.target)
    sides = scene.cells.tiling.beside[slot] if scene.cells else ()
    extra = scene.cells.weights if scene.cells else ()
    cells = [(side.kind, slot_step(shape, side.first) if side.first else 0) for side in sides]
    return {
        "rests": slot.rest,
        "signs": 1.0 if is_owner else -1.0,
        "away": away,
        "bonds_away": owner * math.prod(shape[1:]) + (0 if is_owner else away),
        "cells_away": [kind * math.prod(shape) + step for kind, step in cells],
        **{f"more{m}": by_slot[slot] for m, by_slot in enumerate(extra)},
        **{
            f"weights{n}": level.scene.constants.weights[slot]
            for n, level in enumerate(plan.levels)
        },
    }


def _of_plane(plan: Plan, plane: BondPlane) -> dict[str, Any]:
    """Return the data of a plane of bonds: the sublattices of both ends and the step of cells
    between them, the rest offset, and the block of cells that contains bonds."""
    scene, slot = plan.scene, plane.slot
    block = plane_block(scene.raster, plane, inside=plan.softens_cells)
    spans = zip(block.start, block.stop, strict=True) if block else [(0, 0)] * scene.axes
    return {
        "ends": (slot.source, slot.target, *slot.cell),
        "end_rests": slot.rest,
        "end_blocks": list(chain(*spans)),
    }


def bits_for(scene: Scene) -> np.dtype[Any]:
    """Return the smallest unsigned integer with a bit for every slot."""
    return np.min_scalar_type(2 ** max(map(len, scene.neighbourhood.slots)) - 1)


def lost_bits(scene: Scene, state: State) -> Bits:
    """Return a bit mask for each particle. Bit k of the mask is set if the bond along slot k of the
    particle is broken."""
    lost = np.zeros(scene.raster.shape, bits_for(scene))
    renew_lost_bits(lost, scene, state, slice(0, lost.shape[1]))
    return lost


def renew_lost_bits(lost: Bits, scene: Scene, state: State, rows: slice) -> None:
    """Update the bit masks of some rows of cells."""
    assert state.broken_step is not None
    around, (height, *across) = scene.neighbourhood, scene.raster.shape[1:]
    margin, *margins = around.reach_in_cells  # No neighbour of a particle lies beyond this margin.
    first, last = max(rows.start, margin), min(rows.stop, height - margin)
    stop = tuple(size - n for size, n in zip(across, margins, strict=True))
    for s, slots in enumerate(around.slots):
        block = Block(s, (first, *margins), (max(first, last), *stop))
        bits = np.zeros_like(block.of(lost))
        for bit, slot in enumerate(slots):
            plane, at_this_end = around.owner[slot]
            owner = block if at_this_end else block.seen_through(slot)
            broken = owner.within(state.broken_step[plane]) >= 0
            bits |= broken.astype(lost.dtype) << lost.dtype.type(bit)
        block.of(lost)[...] = bits


SHORT = 4
"""A run of fewer particles is merged into an adjacent run with more general code."""
Ints = NDArray[np.integer[Any]]


def find_runs(scene: Scene, all_general: bool) -> tuple[Ints, Ints, tuple[tuple[int, int], ...]]:
    """Return the runs, sorted by sublattice, kind of row and place. A run extends over consecutive
    rows if it has the same kind and the same columns in all of them.

    The first array is (run, (leading cells, first row, last row + 1, begin, end)). The second is
    (group, row, 2). It contains for each row of the first axis the index of the first run that
    includes the row or lies behind it, and the index of the first run that begins in the row or
    later. The tuple contains the sublattice and the kind of each group.
    """
    runs, starts, groups = list[Ints](), list[Ints](), list[tuple[int, int]]()
    rows = np.arange(scene.raster.shape[1] + 1)
    for s in range(scene.raster.shape[0]):
        if block := scene.raster.body_block(s):
            lines = _lines_of(kinds_of(scene, block, all_general))
            lines[:, :-1] += [*block.start, block.start[-1]]
            for kind in np.unique(lines[:, -1]).tolist():
                joined = _joined(lines[lines[:, -1] == kind, :-1])
                last = joined[:, 1] if scene.axes == 2 else joined[:, 0] + 1
                reach = np.searchsorted(np.maximum.accumulate(last), rows, side="right")
                begin = np.searchsorted(joined[:, 0], rows)
                starts.append(sum(map(len, runs)) + np.stack([reach, begin], axis=1))
                runs.append(joined)
                groups.append((s, kind))
    return np.concatenate(runs), np.stack(starts), tuple(groups)


def _joined(lines: Ints) -> Ints:
    """Merge runs of particles that lie in consecutive rows and span the same columns."""
    *lead, row, begin, end = lines.T
    lines = lines[np.lexsort((row, end, begin, *reversed(lead)))]
    step = np.diff(lines, axis=0)
    goes_on = (np.delete(step, -3, axis=1) == 0).all(axis=1) & (step[:, -3] == 1)
    first = np.flatnonzero(np.concatenate([[True], ~goes_on]))
    last = np.append(first[1:], len(row)) - 1
    runs = np.insert(lines[first], -2, lines[last, -3] + 1, axis=1)
    return np.take(runs, np.lexsort(tuple(runs.T[::-1])), axis=0)


def kinds_of(scene: Scene, block: Block, all_general: bool) -> Ints:
    """Return the kind of row, which selects the code, for each place of a block."""
    raster, slots = scene.raster, scene.neighbourhood.slots[block.sublattice]
    follows = block.of(raster.kind) == FOLLOWER
    kinds = np.where(follows, sweeps.GENERAL, sweeps.NOBODY)
    fits = follows & (not all_general)
    for present in presence(raster, block, slots):
        fits &= True if present is None else present
    if scene.has_fracture and not scene.experiment.fracture.breaks_frame_bonds():
        for slot in slots:
            fits &= block.seen_through(slot).of(raster.kind) == FOLLOWER
    kinds[fits] = sweeps.PLAIN
    if scene.cells:
        precision = scene.experiment.stepping.precision
        for slot in slots:
            for share in scene.cells.beside(slot, block, precision):
                kinds[fits & (share != 1.0) & (kinds == sweeps.PLAIN)] = sweeps.WITH_CELLS
            for mixed in scene.cells.mixed:
                for share in scene.cells.beside(slot, block, precision, mixed):
                    kinds[fits & (share != 0.0)] = sweeps.GENERAL
    return kinds


def _lines_of(kinds: Ints) -> Ints:
    """Return the maximal runs of places of the same kind in each row along the last axis."""
    padding = [*[(0, 0)] * (kinds.ndim - 1), (0, 1)]
    closed = np.pad(kinds, padding, constant_values=sweeps.NOBODY)
    flat = closed.ravel()
    for kinds_of_short, neighbour in (
        ([sweeps.PLAIN], sweeps.WITH_CELLS),
        ([sweeps.PLAIN, sweeps.WITH_CELLS], sweeps.GENERAL),
    ):
        begin, end, kind = _stretches(flat)
        # The last column is empty, so that the runs of one row do not merge with those of the next.
        touches = (np.roll(kind, 1) == neighbour) | (np.roll(kind, -1) == neighbour)
        short = np.isin(kind, kinds_of_short) & (end - begin < SHORT) & touches
        flat = np.repeat(np.where(short, neighbour, kind), end - begin)
    begin, end, kind = _stretches(flat)
    *lead, first = np.unravel_index(begin, closed.shape)
    lines = np.stack([*lead, first, first + end - begin, kind], axis=1)
    return np.compress(kind != sweeps.NOBODY, lines, axis=0).astype(np.int64)


def _stretches(flat: Ints) -> tuple[Ints, Ints, Ints]:
    """Return (begin, end, value) of the runs of equal values."""
    begin = np.flatnonzero(np.diff(flat, prepend=-1))
    return begin, np.append(begin[1:], len(flat)), flat[begin]
