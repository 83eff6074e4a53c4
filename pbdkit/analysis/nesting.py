"""The response of rules that work on the moves of another: one sparse matrix times the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.couplings import Couplings
from pbdkit.analysis.linearising import has_neighbours, respond
from pbdkit.interfaces.frame import Indices
from pbdkit.scene.raster import EMPTY
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

Floats = NDArray[np.float64]


def moves_and_couplings(scene: Scene, state: State, place: Indices) -> tuple[Floats, Couplings]:
    """The moves (particle, axis) of the particles at some flat places of a scene without frame
    points, and ∂move/∂u: rows in the order of the places, columns by row of the particle table."""
    if scene.inner is None:
        return _directly(scene, state, place)
    everybody = scene.raster.place_of(np.arange(scene.raster.count))
    z, inner = moves_and_couplings(scene.inner, state, everybody)
    field = np.zeros(state.u.shape)
    field.reshape(len(field), -1)[:, everybody] = z.T
    moves, outer = _directly(scene, replace(state, u=field), place)
    product = (outer.entries().sparse() @ inner.entries().sparse()).tobsr((scene.axes, scene.axes))
    product.sum_duplicates()
    rows = np.repeat(np.arange(len(place)), np.diff(product.indptr))
    couplings = Couplings((len(place), scene.raster.count), scene.axes)
    couplings.add(rows, product.indices, product.data)
    return moves, couplings


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
