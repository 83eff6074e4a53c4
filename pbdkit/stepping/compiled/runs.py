"""Which stretches of which rows have all their neighbours and whole cells, and which have not."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.scene.raster import FOLLOWER, Block
from pbdkit.scene.scene import Scene
from pbdkit.stepping.compiled.rows import GENERAL, NOBODY, PLAIN, WITH_CELLS
from pbdkit.stepping.evaluator import presence

SHORT = 4
"""Stretches of fewer particles are taken together with a more general one beside them."""
Ints = NDArray[np.integer[Any]]


def find_runs(scene: Scene, all_general: bool) -> tuple[Ints, Ints, tuple[tuple[int, int], ...]]:
    """(run, (leading cells of its row, begin, end)), sorted by sublattice, kind and row; (group,
    row): the first run of each row of the first axis, with one row more at the end; and sublattice
    and kind of each group."""
    found, starts, groups, total = [], [], [], 0
    rows = np.arange(scene.raster.shape[1] + 1)
    for s in range(scene.raster.shape[0]):
        if block := scene.raster.body_block(s):
            runs = _runs_of(_kinds(scene, block, all_general))
            runs[:, :-1] += [*block.start, block.start[-1]]
            for kind in np.unique(runs[:, -1]).tolist():
                own = runs[runs[:, -1] == kind, :-1]
                found.append(own)
                starts.append(total + np.searchsorted(own[:, 0], rows))
                groups.append((s, kind))
                total += len(own)
    return np.concatenate(found), np.stack(starts), tuple(groups)


def _kinds(scene: Scene, block: Block, all_general: bool) -> Ints:
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
        precision = scene.experiment.solver.precision
        for slot in slots:
            for share in scene.cells.beside(slot, block, precision):
                kinds[fits & (share != 1.0)] = WITH_CELLS
    return kinds


def _runs_of(kinds: Ints) -> Ints:
    """The stretches of one kind, in each row along the last axis."""
    closed = np.full((*kinds.shape[:-1], kinds.shape[-1] + 1), NOBODY)
    closed[..., :-1] = kinds
    flat = closed.ravel()
    for these, beside in (([PLAIN], WITH_CELLS), ([PLAIN, WITH_CELLS], GENERAL)):
        begin, end, kind = _stretches(flat)
        touches = np.zeros(len(kind), bool)
        touches[1:] |= kind[:-1] == beside
        touches[:-1] |= kind[1:] == beside
        short = np.isin(kind, these) & (end - begin < SHORT) & touches
        flat = np.repeat(np.where(short, beside, kind), end - begin)
    begin, end, kind = _stretches(flat)
    *lead, first = np.unravel_index(begin, closed.shape)
    runs = np.stack([*lead, first, first + end - begin, kind], axis=1)
    return runs[kind != NOBODY].astype(np.int64)


def _stretches(flat: Ints) -> tuple[Ints, Ints, Ints]:
    """(begin, end, value) of the stretches of equal values."""
    edges = np.flatnonzero(np.diff(flat)) + 1
    begin = np.concatenate([[0], edges])
    return begin, np.concatenate([edges, [len(flat)]]), flat[begin]
