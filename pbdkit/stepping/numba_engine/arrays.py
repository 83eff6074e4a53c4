"""The arrays that kernels are given, by name: what stays the same for a scene, lost bonds, and
which stretches of which rows have all their neighbours and whole cells.
"""

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
from pbdkit.stepping.numba_engine.plan import Plan, banded, frame_order
from pbdkit.stepping.numba_engine.sweeps import (
    GENERAL,
    NOBODY,
    PLAIN,
    WITH_CELLS,
    stress_arrays,
    tearing_arrays,
)
from pbdkit.stepping.program import program_of
from pbdkit.stepping.rule_evaluation import presence
from pbdkit.stepping.state import State

Arrays = dict[str, Any]
Bits = NDArray[np.unsignedinteger[Any]]


def constant_arrays(plan: Plan) -> Arrays:
    """What does not change from step to step."""
    scene, slots = plan.scene, plan.scene.neighbourhood.slots
    constants = scene.constants
    most, real = max(map(len, slots)), np.dtype(scene.experiment.stepping.precision)
    by_slot = _stacked([_of_slot(plan, slot) for slot in padded(slots)], real)
    arrays = {
        "kind": scene.raster.kind,
        "first": np.array(scene.raster.first, np.int64),
        "at": scene.raster.cell.basis,
        "counts": np.array([len(own) for own in slots]),
        **changing_arrays(plan),
        **{name: v.reshape(len(slots), most, *v.shape[1:]) for name, v in by_slot.items()},
        **_stacked([_of_plane(plan, plane) for plane in scene.neighbourhood.planes], real),
    }
    if scene.cells:
        arrays["share"] = np.array(scene.cells.weight, real)
        if mixed := scene.cells.mixed:  # those of a cell side by side
            arrays["mixed"] = np.stack(mixed, axis=-1).astype(real)
    for name, planes in (("field", constants.by_particle), ("limit", constants.by_bond)):
        arrays |= {f"{name}{n}": np.array(v, real) for n, v in enumerate(planes.values())}
    if scene.tears:
        arrays |= tearing_arrays(scene)
    if plan.softens_cells:
        arrays |= stress_arrays(scene, real)
    for operation in program_of(scene):
        for name, values in operation.constants().items():
            arrays[name] = np.array([*values, 0.0], real)  # one more, so that none is empty
        for name, place in operation.lists().items():
            order, rows = banded(plan, name, place)
            arrays |= {name: place[order]} | rows
    if frame := scene.frame:
        arrays |= _of_frame(frame, frame_order(plan), real)
    return arrays


def state_arrays(plan: Plan, u: Floats, v: Floats, state: State) -> Arrays:
    """Displacements u, those of the step before, and what a state remembers."""
    return {
        **dict(zip([*plan.each("u_@"), *plan.each("v_@")], [*u, *v], strict=True)),
        **{f"bond{n}": value for n, value in enumerate(state.bond_values)},
        **{f"own{n}": value for n, value in enumerate(state.particle_values)},
        "broken": state.broken_step,
        "lengths": state.broken_length,
    }


def _of_frame(frame: Frame, order: Indices, real: np.dtype[Any]) -> Arrays:
    """Its points in an order, and after each other their entries."""
    counts = np.bincount(frame.map.point, minlength=len(frame.place))
    entry = np.argsort(np.argsort(order)[frame.map.point], kind="stable")
    return {
        "points": frame.place[order],
        "bodies": frame.body_place[entry],
        "entries": np.concatenate([[0], np.cumsum(counts[order])]),
        "mapped": frame.map.weight[entry].astype(real),
    }


def changing_arrays(plan: Plan) -> Arrays:
    """What may change in the course of the steps: parameters, and limits of bonds."""
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
    """The stiffness of cells over their own Young's modulus, those of a cell side by side."""
    stresses, real = CellStresses(plan.scene), plan.scene.experiment.stepping.precision
    if plan.mixed:
        return {"ratios": np.stack(stresses.ratios_by_cell, axis=-1).astype(real)}
    return {"cell_ratios": np.array(stresses.ratios, real)}


def padded(slots: Sequence[tuple[Slot, ...]]) -> list[Slot]:
    """Sublattice after sublattice; those with fewer neighbours than others have the first once
    more, which nobody reads."""
    most = max(map(len, slots))
    return [slot for own in slots for slot in (*own, *own[:1] * (most - len(own)))]


def rule_arrays(plan: Plan) -> Arrays:
    """The parameters of rules and solver."""
    solver = plan.scene.experiment.stepping
    # One more, so that no array is empty.
    rules = {f"rule{n}": [*own.scene.constants.shared, 0.0] for n, own in enumerate(plan.levels)}
    numbers = {"solver": [solver.relaxation, solver.memory], **rules}
    return {name: np.array(values, solver.precision) for name, values in numbers.items()}


def _stacked(rows: Sequence[dict[str, Any]], real: np.dtype[Any]) -> Arrays:
    """The numbers of all rows by name, (row, ...)."""
    stacked = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return {name: v.astype(real if v.dtype.kind == "f" else int) for name, v in stacked.items()}


def _of_slot(plan: Plan, slot: Slot) -> dict[str, Any]:
    """Rest offset, weights, the sign of d at the home of its bonds, and from a particle's
    place in flat arrays the way to the neighbour, to the home of the bond in planes of bonds, and
    to the shares of the cells beside it."""
    scene, shape = plan.scene, plan.scene.raster.shape
    away, (plane, here) = slot_step(shape, slot), scene.neighbourhood.home[slot]
    home = plane - (slot.source if here else slot.target)
    beside = scene.cells.tiling.beside[slot] if scene.cells else ()
    more = scene.cells.weights if scene.cells else ()
    cells = [(side.kind, slot_step(shape, side.first) if side.first else 0) for side in beside]
    return {
        "rests": slot.rest,
        "signs": 1.0 if here else -1.0,
        "away": away,
        "bonds_away": home * math.prod(shape[1:]) + (0 if here else away),
        "cells_away": [kind * math.prod(shape) + step for kind, step in cells],
        **{f"more{m}": by_slot[slot] for m, by_slot in enumerate(more)},
        **{f"weights{n}": own.scene.constants.weights[slot] for n, own in enumerate(plan.levels)},
    }


def _of_plane(plan: Plan, plane: BondPlane) -> dict[str, Any]:
    """Of a plane of bonds source, target and step, rest offset, block."""
    scene, slot = plan.scene, plane.slot
    block = plane_block(scene.raster, plane, inside=plan.softens_cells)
    spans = zip(block.start, block.stop, strict=True) if block else [(0, 0)] * scene.axes
    return {
        "ends": (slot.source, slot.target, *slot.cell),
        "end_rests": slot.rest,
        "end_blocks": list(chain(*spans)),
    }


def bits_for(scene: Scene) -> np.dtype[Any]:
    """The smallest unsigned integer with a bit for every slot."""
    return np.min_scalar_type(2 ** max(map(len, scene.neighbourhood.slots)) - 1)


def lost_bits(scene: Scene, state: State) -> Bits:
    """Bit k of a particle: the bond along its slot k is broken; both ends know."""
    lost = np.zeros(scene.raster.shape, bits_for(scene))
    renew_lost_bits(lost, scene, state, slice(0, lost.shape[1]))
    return lost


def renew_lost_bits(lost: Bits, scene: Scene, state: State, rows: slice) -> None:
    """Writes those of some rows of cells."""
    assert state.broken_step is not None
    around, (height, *across) = scene.neighbourhood, scene.raster.shape[1:]
    margin, *beside = around.reach_in_cells  # beyond it nobody is
    first, last = max(rows.start, margin), min(rows.stop, height - margin)
    stop = tuple(size - n for size, n in zip(across, beside, strict=True))
    for s, slots in enumerate(around.slots):
        block = Block(s, (first, *beside), (max(first, last), *stop))
        found = np.zeros_like(block.of(lost))
        for bit, slot in enumerate(slots):
            plane, at_this_end = around.home[slot]
            home = block if at_this_end else block.seen_through(slot)
            broken = home.within(state.broken_step[plane]) >= 0
            found |= broken.astype(lost.dtype) << lost.dtype.type(bit)
        block.of(lost)[...] = found


SHORT = 4
"""Stretches of fewer particles are taken together with a more general one beside them."""
Ints = NDArray[np.integer[Any]]


def find_runs(scene: Scene, all_general: bool) -> tuple[Ints, Ints, tuple[tuple[int, int], ...]]:
    """(run, (leading cells, first row, last row + 1, begin, end)): stretches of one kind that rows
    beside each other share, sorted by sublattice and kind, then as they lie; (group, row, 2): the
    first run that reaches a row of the first axis, and the first that begins there or later; and
    the sublattice and kind of each group."""
    found, starts, groups = list[Ints](), list[Ints](), list[tuple[int, int]]()
    rows = np.arange(scene.raster.shape[1] + 1)
    for s in range(scene.raster.shape[0]):
        if block := scene.raster.body_block(s):
            lines = _lines_of(kinds_of(scene, block, all_general))
            lines[:, :-1] += [*block.start, block.start[-1]]
            for kind in np.unique(lines[:, -1]).tolist():
                own = _joined(lines[lines[:, -1] == kind, :-1])
                last = own[:, 1] if scene.axes == 2 else own[:, 0] + 1
                reach = np.searchsorted(np.maximum.accumulate(last), rows, side="right")
                begin = np.searchsorted(own[:, 0], rows)
                starts.append(sum(map(len, found)) + np.stack([reach, begin], axis=1))
                found.append(own)
                groups.append((s, kind))
    return np.concatenate(found), np.stack(starts), tuple(groups)


def _joined(lines: Ints) -> Ints:
    """Stretches at one place of rows that follow each other, as one."""
    *lead, row, begin, end = lines.T
    lines = lines[np.lexsort((row, end, begin, *reversed(lead)))]
    step = np.diff(lines, axis=0)
    goes_on = (np.delete(step, -3, axis=1) == 0).all(axis=1) & (step[:, -3] == 1)
    first = np.flatnonzero(np.concatenate([[True], ~goes_on]))
    last = np.append(first[1:], len(row)) - 1
    runs = np.insert(lines[first], -2, lines[last, -3] + 1, axis=1)
    return np.take(runs, np.lexsort(tuple(runs.T[::-1])), axis=0)


def kinds_of(scene: Scene, block: Block, all_general: bool) -> Ints:
    """The kind of row that serves each place of a block."""
    raster, slots = scene.raster, scene.neighbourhood.slots[block.sublattice]
    follows = block.of(raster.kind) == FOLLOWER
    kinds = np.where(follows, GENERAL, NOBODY)
    fits = follows & (not all_general)
    for there in presence(raster, block, slots):
        fits &= True if there is None else there
    if scene.has_fracture and not scene.experiment.fracture.breaks_frame_bonds():
        for slot in slots:
            fits &= block.seen_through(slot).of(raster.kind) == FOLLOWER
    kinds[fits] = PLAIN
    if scene.cells:
        precision = scene.experiment.stepping.precision
        for slot in slots:
            for share in scene.cells.beside(slot, block, precision):
                kinds[fits & (share != 1.0) & (kinds == PLAIN)] = WITH_CELLS
            for mixed in scene.cells.mixed:
                for share in scene.cells.beside(slot, block, precision, mixed):
                    kinds[fits & (share != 0.0)] = GENERAL
    return kinds


def _lines_of(kinds: Ints) -> Ints:
    """The stretches of one kind, in each row along the last axis."""
    beyond = [*[(0, 0)] * (kinds.ndim - 1), (0, 1)]
    closed = np.pad(kinds, beyond, constant_values=NOBODY)
    flat = closed.ravel()
    for these, beside in (([PLAIN], WITH_CELLS), ([PLAIN, WITH_CELLS], GENERAL)):
        begin, end, kind = _stretches(flat)
        # The last is of nobody, so that no end touches the other.
        touches = (np.roll(kind, 1) == beside) | (np.roll(kind, -1) == beside)
        short = np.isin(kind, these) & (end - begin < SHORT) & touches
        flat = np.repeat(np.where(short, beside, kind), end - begin)
    begin, end, kind = _stretches(flat)
    *lead, first = np.unravel_index(begin, closed.shape)
    lines = np.stack([*lead, first, first + end - begin, kind], axis=1)
    return np.compress(kind != NOBODY, lines, axis=0).astype(np.int64)


def _stretches(flat: Ints) -> tuple[Ints, Ints, Ints]:
    """(begin, end, value) of the stretches of equal values."""
    begin = np.flatnonzero(np.diff(flat, prepend=-1))
    return begin, np.append(begin[1:], len(flat)), flat[begin]
