"""Which stretches of which rows have all their neighbours and whole cells, and which have not."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.scene.places import Block
from pbdkit.scene.raster import FOLLOWER
from pbdkit.scene.scene import Scene
from pbdkit.stepping.compiled.rows import GENERAL, NOBODY, PLAIN, WITH_CELLS
from pbdkit.stepping.surroundings import presence

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
