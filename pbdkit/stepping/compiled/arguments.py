"""The arrays that kernels are given, by name: what stays the same for a scene, and lost bonds."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Slot
from pbdkit.scene.bonds import plane_block
from pbdkit.scene.places import slot_step
from pbdkit.scene.scene import Scene
from pbdkit.stepping.compiled.plan import Level, Plan
from pbdkit.stepping.state import Floats, State

Arrays = dict[str, Any]


def constant_arrays(scene: Scene, levels: Sequence[Level]) -> Arrays:
    """What does not change from step to step."""
    cell, real = scene.raster.lattice.cell(), np.dtype(scene.experiment.stepping.precision)
    arrays = {
        "kind": scene.raster.kind,
        "first": np.array(scene.raster.first, np.int64),
        "at": np.array([site.at for site in cell.sites]),
        **rule_arrays(scene, levels),
        **_by_slot(scene, levels, real),
        **_by_plane(scene, real),
    }
    if scene.cells:
        arrays["share"] = np.array(scene.cells.share, real)
    if frame := scene.frame:
        counts = np.bincount(frame.map.point, minlength=len(frame.place))
        arrays |= {
            "points": frame.place,
            "entries": np.concatenate([[0], np.cumsum(counts)]),
            "bodies": frame.body_place,
            "mapped": frame.map.weight.astype(real),
        }
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
    around, shape = scene.neighbourhood, scene.raster.shape
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

    numbers: dict[str, tuple[Callable[[Slot], Any], Any]] = {
        "rests": (lambda slot: slot.rest, real),
        "limits": (scene.constants.limits.__getitem__, real),
        "signs": (lambda slot: 1.0 if around.home[slot][1] else -1.0, real),
        "away": (lambda slot: slot_step(shape, slot), np.int64),
        "bonds_away": (bonds_away, np.int64),
        "cells_away": (cells_away, np.int64),
    }
    for level in levels:
        numbers[f"weights{level.number}"] = (level.scene.constants.weights.__getitem__, real)
    most = max(map(len, around.slots))
    padded = [[*own, *own[:1] * (most - len(own))] for own in around.slots]
    return {"counts": np.array([len(own) for own in around.slots])} | {
        name: np.array([[value(slot) for slot in own] for own in padded], dtype)
        for name, (value, dtype) in numbers.items()
    }


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
        "end_limits": np.array([limits[p.slot] for p in planes], real),
        "end_blocks": blocks,
    }


def bits_for(scene: Scene) -> np.dtype[Any]:
    """The smallest unsigned integer with a bit for every slot."""
    return np.min_scalar_type(2 ** max(map(len, scene.neighbourhood.slots)) - 1)


def lost_bits(scene: Scene, state: State) -> NDArray[np.unsignedinteger[Any]]:
    """Bit k of a particle: the bond along its slot k is broken; both ends know."""
    assert state.broken_step is not None
    lost = np.zeros(scene.raster.shape, bits_for(scene))
    for n, plane in enumerate(scene.neighbourhood.planes):
        if block := plane_block(scene.raster, plane):
            broken = (block.within(state.broken_step[n]) >= 0).astype(lost.dtype)
            ends = (plane.slot, block), (plane.opposite, block.seen_through(plane.slot))
            for slot, seen in ends:
                bit = scene.neighbourhood.slots[slot.source].index(slot)
                seen.of(lost)[...] |= broken << lost.dtype.type(bit)
    return lost
