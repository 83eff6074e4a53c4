"""Which stretches of which rows have all their neighbours and whole cells, and which have not."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.scene.raster import FOLLOWER, Block
from pbdkit.scene.scene import Scene
from pbdkit.stepping.compiled.rows import GENERAL, NOBODY, plain
from pbdkit.stepping.evaluator import presence

SHORT = 4
"""Stretches of fewer particles are taken together with a more general one beside them."""
Ints = NDArray[np.integer[Any]]


def find_runs(scene: Scene, all_general: bool) -> tuple[Ints, Ints]:
    """(run, (leading cells of the row, begin, end, kind)), sorted by sublattice and row, and
    (sublattice, row): the first run of each row of the first axis, with one row more at the end."""
    found = []
    sublattices, rows, *_ = scene.raster.shape
    starts = np.zeros((sublattices, rows + 1), np.int64)
    total = 0
    for s in range(sublattices):
        if block := scene.raster.body_block(s):
            kinds = _kinds(scene, block, all_general)
            own = _runs_of(kinds, plain(s, False)) + [*block.start, block.start[-1], 0]
            found.append(own)
            starts[s] = total + np.searchsorted(own[:, 0], np.arange(rows + 1))
            total += len(own)
    axes = scene.axes
    return np.concatenate([*found, np.empty((0, axes + 2), np.int64)]), starts


def _kinds(scene: Scene, block: Block, all_general: bool) -> Ints:
    """The kind of row that serves each place of a block."""
    raster, s = scene.raster, block.sublattice
    slots = scene.neighbourhood.slots[s]
    follows = block.of(raster.kind) == FOLLOWER
    kinds = np.where(follows, GENERAL, NOBODY)
    fits = follows & (not all_general)
    for there in presence(raster, block, slots):
        fits &= True if there is None else there
    if scene.has_fracture and not scene.experiment.fracture.breaks_frame_bonds():
        for slot in slots:
            fits &= block.seen_through(slot).of(raster.kind) == FOLLOWER
    kinds[fits] = plain(s, False)
    if scene.cells:
        precision = scene.experiment.solver.precision
        for slot in slots:
            for share in scene.cells.beside(slot, block, precision):
                kinds[fits & (share != 1.0)] = plain(s, True)
    return kinds


def _runs_of(kinds: Ints, whole: int) -> Ints:
    """The stretches of one kind, in each row along the last axis."""
    closed = np.full((*kinds.shape[:-1], kinds.shape[-1] + 1), NOBODY)
    closed[..., :-1] = kinds
    flat = closed.ravel()
    for these, beside in (([whole], whole + 1), ([whole, whole + 1], GENERAL)):
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
