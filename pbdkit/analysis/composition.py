"""Rules that work on the moves of another: response and stencil, one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from operator import add

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.couplings import Couplings, frame_matrices
from pbdkit.analysis.linear_response import has_neighbours, respond
from pbdkit.analysis.stencil import NOWHERE, Stencil, stencil_of
from pbdkit.interfaces import Here, Slot
from pbdkit.interfaces.frame import Indices
from pbdkit.interfaces.lattice import Index
from pbdkit.interfaces.vector import vector
from pbdkit.scene.raster import EMPTY
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

Floats = NDArray[np.float64]


def linearised(scene: Scene, at: Here = NOWHERE) -> Stencil:
    """The stencil of the scene's rule, of all its rules together where it works on the moves of
    another; `at` says where for rules that ask."""
    stencil = stencil_of(scene, at)
    return _composed(stencil, linearised(scene.inner, at)) if scene.inner else stencil


def moves_and_couplings(scene: Scene, state: State, place: Indices) -> tuple[Floats, Couplings]:
    """The moves (particle, axis) of the particles at some flat places, and ∂move/∂u: rows in the
    order of the places, columns by row of the particle table."""
    if scene.inner is None:
        return _directly(scene, state, place)
    body = scene.raster.place_of(scene.raster.body_rows)
    z, inner = moves_and_couplings(scene.inner, state, body)
    field = np.zeros(state.u.shape)
    flat = field.reshape(len(field), -1)
    flat[:, body] = z.T
    if scene.frame:
        scene.frame.follow(flat, flat)
    moves, outer = _directly(scene, replace(state, u=field), place)
    seen = _followed(scene).entries().sparse() @ inner.entries().sparse()
    product = (outer.entries().sparse() @ seen).tobsr((scene.axes, scene.axes))
    product.sum_duplicates()
    rows = np.repeat(np.arange(len(place)), np.diff(product.indptr))
    couplings = Couplings((len(place), scene.raster.count), scene.axes)
    couplings.add(rows, product.indices, product.data)
    return moves, couplings


def _followed(scene: Scene) -> Couplings:
    """What body and frame show of the body: rows by the particle table, columns in the order of the
    body's particles."""
    body, count = scene.raster.body_rows, scene.raster.count
    followed = Couplings((count, len(body)), scene.axes)
    identity = np.broadcast_to(np.eye(scene.axes), (len(body), scene.axes, scene.axes))
    followed.add(body, np.arange(len(body)), identity)
    if scene.frame:
        point = np.setdiff1d(np.arange(count), body)[scene.frame.map.point]
        column = np.searchsorted(body, scene.frame.map.body)
        followed.add(point, column, frame_matrices(scene.frame.map.weight, scene.axes))
    return followed


def _directly(scene: Scene, state: State, place: Indices) -> tuple[Floats, Couplings]:
    raster = scene.raster
    row = np.full(raster.kind.size, -1)
    row[raster.place_of(np.arange(raster.count))] = np.arange(raster.count)
    moves = np.zeros((len(place), scene.axes))
    couplings = Couplings((len(place), raster.count), scene.axes)
    sublattice = place // (raster.kind.size // raster.shape[0])
    for s in range(raster.shape[0]):
        some = np.flatnonzero(sublattice == s)
        some = some[has_neighbours(scene, s, place[some])]
        if not len(some):
            continue
        response = respond(scene, state, s, place[some])
        moves[some] = response.of_each(response.move)
        couplings.add(some, row[place[some]], response.of_each(response.own))
        for slot, derivative in response.neighbours.items():
            there = place[some] + response.steps[slot]
            has = raster.kind.ravel()[there] != EMPTY
            couplings.add(some[has], row[there[has]], response.of_each(derivative)[has])
    return moves, couplings


def _composed(outer: Stencil, inner: Stencil) -> Stencil:
    """The stencil of a rule that works on the moves of another."""
    own = np.zeros_like(outer.own)
    neighbours: dict[Slot, Floats] = {}
    known: dict[tuple[int, int, Index], Slot] = {}
    for first, W in _with_itself(outer):
        for second, V in _with_itself(inner):
            if first.target != second.source:
                continue
            slot = _after(first, second)
            key = slot.source, slot.target, slot.cell
            if slot.source == slot.target and not any(slot.cell):
                own[slot.source] += W @ V
            else:
                slot = known.setdefault(key, slot)
                neighbours[slot] = neighbours.get(slot, 0.0) + W @ V
    return Stencil(own, neighbours)


def _with_itself(stencil: Stencil) -> Iterator[tuple[Slot, Floats]]:
    for s, own in enumerate(stencil.own):
        nowhere = (0,) * len(own)
        yield Slot(s, s, nowhere, nowhere, vector(np.zeros(len(own))), 0), own
    yield from stencil.neighbours.items()


def _after(first: Slot, second: Slot) -> Slot:
    """Where two slots lead, one after the other."""
    return Slot(
        first.source,
        second.target,
        tuple(map(add, first.cell, second.cell)),
        tuple(map(add, first.site, second.site)),
        first.rest + second.rest,
        first.shell + second.shell,
    )
