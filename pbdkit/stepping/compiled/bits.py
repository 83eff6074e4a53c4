"""What kernels know of neighbours as bits: bit k of a particle speaks of its slot k."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Slot
from pbdkit.scene.bonds import bonds_in, plane_block
from pbdkit.scene.raster import FOLLOWER
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State
from pbdkit.stepping.surroundings import presence

Bits = NDArray[np.unsignedinteger[Any]]


def bits_for(scene: Scene) -> Any:
    """The smallest unsigned integer with a bit for every slot and one more."""
    most = max(map(len, scene.neighbourhood.slots))
    for dtype, bits in ((np.uint8, 8), (np.uint16, 16), (np.uint32, 32)):
        if most < bits:
            return dtype
    raise ValueError(f"{most} neighbours are too many to compile; the numpy engine takes them")


def presence_bits(scene: Scene, dtype: Any) -> Bits:
    """Bit k: neighbour k is there; the bit after the last slot: the particle can move. A single
    place where every neighbour of every particle is there and blocks hold followers alone."""
    raster = scene.raster
    masks, trivial = np.zeros(raster.shape, dtype), True
    for s, slots in enumerate(scene.neighbourhood.slots):
        block = raster.body_block(s)
        if block is None:
            continue
        mask = np.zeros(raster.kind[block.slices()].shape, dtype)
        for k, there in enumerate(presence(raster, block, slots)):
            mask |= dtype(1 << k) if there is None else there.astype(dtype) << dtype(k)
            trivial &= there is None
        movable = (raster.kind[block.slices()] == FOLLOWER) & (mask > 0)
        masks[block.slices()] = mask | movable.astype(dtype) << dtype(len(slots))
        trivial &= bool(movable.all())
    return np.zeros((1, 1, 1), dtype) if trivial else masks


def spared_bits(scene: Scene, dtype: Any) -> Bits:
    """Bit k: the bond along slot k cannot break. A single place where every bond can."""
    spared = np.zeros((1, 1, 1), dtype)
    if not scene.has_fracture:
        return spared
    every = scene.experiment.fracture.breaks_frame_bonds()
    spared = np.full(scene.raster.shape, np.iinfo(dtype).max, dtype)
    for plane in scene.neighbourhood.planes:
        block = plane_block(scene.raster, plane)
        if block is None:
            continue
        can = bonds_in(scene.raster, block, plane, frame_too=every)
        for slot, seen in ((plane.slot, block), (plane.opposite, block.seen_through(plane.slot))):
            clear = dtype(np.iinfo(dtype).max ^ (1 << _place_of(scene, slot)))
            spared[seen.slices()] &= np.where(can, clear, np.iinfo(dtype).max).astype(dtype)
    swept = [(s, scene.raster.body_block(s)) for s in range(len(scene.neighbourhood.slots))]
    some_last = any(
        (spared[block.slices()] & dtype((1 << len(scene.neighbourhood.slots[s])) - 1)).any()
        for s, block in swept
        if block
    )
    return spared if some_last else np.zeros((1, 1, 1), dtype)


def lost_bits(scene: Scene, state: State, dtype: Any) -> Bits:
    """Bit k: the bond along slot k is broken; both ends know."""
    if state.broken_step is None:
        return np.zeros((1, 1, 1), dtype)
    lost = np.zeros(scene.raster.shape, dtype)
    for n, plane in enumerate(scene.neighbourhood.planes):
        block = plane_block(scene.raster, plane)
        if block is None:
            continue
        _, rows, columns = block.slices()
        broken = (state.broken_step[n, rows, columns] >= 0).astype(dtype)
        for slot, seen in ((plane.slot, block), (plane.opposite, block.seen_through(plane.slot))):
            lost[seen.slices()] |= broken << dtype(_place_of(scene, slot))
    return lost


def _place_of(scene: Scene, slot: Slot) -> int:
    return scene.neighbourhood.slots[slot.source].index(slot)
