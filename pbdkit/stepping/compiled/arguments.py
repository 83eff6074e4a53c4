"""The arrays that kernels are given, by name: what stays the same for a scene, and lost bonds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Slot
from pbdkit.scene.bonds import plane_block
from pbdkit.scene.places import slot_step
from pbdkit.scene.scene import Scene
from pbdkit.stepping.compiled.plan import Level
from pbdkit.stepping.state import State

Arrays = dict[str, NDArray[Any]]


def constant_arrays(scene: Scene, levels: Sequence[Level]) -> Arrays:
    """What does not change from step to step."""
    frame, cell = scene.frame, scene.raster.lattice.cell()
    real = np.dtype(scene.experiment.stepping.precision)
    none = np.empty(0, np.intp)
    entries, mapped = none, np.empty(0)
    if frame:
        counts = np.bincount(frame.map.point, minlength=len(frame.place))
        entries, mapped = np.concatenate([[0], np.cumsum(counts)]), frame.map.weight
    return {
        "kind": scene.raster.kind,
        "share": np.array(scene.cells.share if scene.cells else np.empty(0), real),
        "first": np.array(scene.raster.first, np.int64),
        "at": np.array([site.at for site in cell.sites]),
        "points": frame.place if frame else none,
        "entries": entries,
        "bodies": frame.body_place if frame else none,
        "mapped": mapped.astype(real),
        **rule_arrays(scene, levels),
        **_by_slot(scene, levels, real),
        **_by_plane(scene, real),
    }


def rule_arrays(scene: Scene, levels: Sequence[Level]) -> Arrays:
    """The parameters of rules and solver."""
    solver = scene.experiment.stepping
    real = np.dtype(solver.precision)
    # One more, so that no array is empty.
    rules = {level.number: [*level.scene.constants.rule, 0.0] for level in levels}
    return {
        "solver": np.array([solver.relaxation, solver.memory], real),
        **{f"rule{n}": np.array(values, real) for n, values in rules.items()},
    }


def _by_slot(scene: Scene, levels: Sequence[Level], real: np.dtype[Any]) -> Arrays:
    """Numbers of each slot, (sublattice, slot, ...): rest offset, limits, weights, the sign of d at
    the home of its bonds, and from a particle's place in flat arrays the way to the neighbour, to
    the home of the bond in planes of bonds, and to the shares of the cells beside it."""
    around, shape, limits = scene.neighbourhood, scene.raster.shape, scene.constants.limits
    beside = scene.cells.tiling.beside if scene.cells else {}
    plane_size, size = math.prod(shape[1:]), math.prod(shape)

    def bonds_away(slot: Slot) -> int:
        plane, here = around.home[slot]
        source = slot.source if here else slot.target
        return (plane - source) * plane_size + (0 if here else slot_step(shape, slot))

    def cells_away(slot: Slot) -> list[int]:
        return [
            side.kind * size + (slot_step(shape, side.first) if side.first else 0)
            for side in beside.get(slot, ())
        ]

    numbers: dict[str, tuple[Any, Any]] = {
        "rests": (lambda slot: slot.rest, real),
        "limits": (lambda slot: limits.get(slot, ()), real),
        "signs": (lambda slot: 1.0 if around.home[slot][1] else -1.0, real),
        "away": (lambda slot: slot_step(shape, slot), np.int64),
        "bonds_away": (bonds_away, np.int64),
        "cells_away": (cells_away, np.int64),
    }
    for level in levels:
        weights = level.scene.constants.weights
        numbers[f"weights{level.number}"] = (weights.__getitem__, real)
    most = max(map(len, around.slots))
    found: Arrays = {"counts": np.array([len(own) for own in around.slots])}
    for name, (value, dtype) in numbers.items():
        one = np.array(value(around.slots[0][0]), dtype)
        found[name] = np.zeros((shape[0], most, *one.shape), dtype)
        for s, own in enumerate(around.slots):
            for k, slot in enumerate(own):
                found[name][s, k] = np.array(value(slot), dtype)
    return found


def _by_plane(scene: Scene, real: np.dtype[Any]) -> Arrays:
    """Numbers of each plane of bonds: source, target and step, rest offset, limits, block."""
    planes, limits = scene.neighbourhood.planes, scene.constants.limits
    blocks = np.zeros((len(planes), 2 * scene.axes), np.int64)
    for n, plane in enumerate(planes):
        if block := plane_block(scene.raster, plane):
            blocks[n, ::2], blocks[n, 1::2] = block.start, block.stop
    return {
        "ends": np.array([(p.slot.source, p.slot.target, *p.slot.cell) for p in planes]),
        "end_rests": np.array([p.slot.rest for p in planes], real),
        "end_limits": np.array([limits.get(p.slot, ()) for p in planes], real),
        "end_blocks": blocks,
    }


def bits_for(scene: Scene) -> Any:
    """The smallest unsigned integer with a bit for every slot."""
    most = max(map(len, scene.neighbourhood.slots))
    return next(t for t, bits in ((np.uint8, 8), (np.uint16, 16), (np.uint32, 32)) if most <= bits)


def lost_bits(scene: Scene, state: State) -> NDArray[np.unsignedinteger[Any]]:
    """Bit k of a particle: the bond along its slot k is broken; both ends know."""
    assert state.broken_step is not None
    dtype = bits_for(scene)
    lost = np.zeros(scene.raster.shape, dtype)
    for n, plane in enumerate(scene.neighbourhood.planes):
        block = plane_block(scene.raster, plane)
        if block is None:
            continue
        broken = (block.within(state.broken_step[n]) >= 0).astype(dtype)
        for slot, seen in ((plane.slot, block), (plane.opposite, block.seen_through(plane.slot))):
            seen.of(lost)[...] |= broken << dtype(_place_of(scene, slot))
    return lost


def _place_of(scene: Scene, slot: Slot) -> int:
    return scene.neighbourhood.slots[slot.source].index(slot)
