"""Components of particles that lead along one axis, among the stencils of a matrix: nothing moves
them, and they move nobody."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.equilibrium.grids.grid_functions import kernels
from pbdkit.equilibrium.grids.primitive_raster import PrimitiveRaster
from pbdkit.equilibrium.grids.stencil_matrix import FREE, LED, OWN, StencilMatrix
from pbdkit.equilibrium.rows import ALL, Rows
from pbdkit.equilibrium.strip import outside
from pbdkit.scene.guides import guided_at
from pbdkit.scene.scene import Scene

Floats = NDArray[np.floating[Any]]
Held = NDArray[np.bool_]
"""(axis, row, place)."""


def held_components(scene: Scene, step: int, rows: Rows = ALL) -> Held | None:
    """Those of a step; None where nobody is guided."""
    guided, grid = guided_at(scene.raster, scene.leading, step), PrimitiveRaster.of(scene)
    if grid is None or not rows.any(len(guided.place) > 0):
        return None
    held = np.zeros((2, *grid.shape), bool)
    held.reshape(2, -1)[:, grid.places(guided.place)] = guided.led
    for unknown in outside(rows.known, grid.shape[0]):
        held[:, unknown] = False
    return held


def constrained(matrix: StencilMatrix, held: Held | None) -> StencilMatrix:
    """The matrix with these components held."""
    if held is None:
        return matrix
    code, stencils, of = with_held(matrix.code, matrix.stencils, held)
    scale = matrix.scale[of].copy()
    here = code >= len(matrix.stencils)
    led = held[:, here]
    some = scale[code[here]].reshape(-1, 2, 2)
    for axis, alone in enumerate(led):
        some[alone, axis] = some[alone, :, axis] = 0.0
    scale[code[here]] = some.reshape(-1, 4)
    return replace(matrix, code=code, stencils=stencils, scale=scale, held=held)


def with_held(
    code: NDArray[np.int32], stencils: Floats, held: Held
) -> tuple[NDArray[np.int32], Floats, NDArray[np.intp]]:
    """(code, stencils, of): particles beside held components have stencils of their own, made `of`
    others, without what comes from these; rows of held components are a number on the diagonal."""
    from scipy.ndimage import binary_dilation

    beside = binary_dilation(held.any(axis=0), structure=np.ones((3, 3))) & (code >= 0)
    row, place = np.nonzero(beside)
    rows = stencils[code[beside]].reshape(-1, 9, 2, 2).copy()
    own = np.abs(rows[:, OWN]).max(axis=(1, 2))
    for s in range(9):
        there = held[:, row + s // 3 - 1, place + s % 3 - 1]
        rows[:, s] *= ~there.T[:, None, :]
    here = held[:, row, place].T
    rows *= ~here[:, None, :, None]
    rows[:, OWN] += (here * own[:, None])[:, :, None] * np.eye(2)
    found = code.copy()
    found[beside] = len(stencils) + np.arange(len(row))
    of = np.concatenate([np.arange(len(stencils)), code[beside]])
    return found, np.concatenate([stencils, rows.reshape(-1, 9, 4)]), of


def without_held(code: NDArray[np.int32], stencils: Floats, held: Held) -> Floats:
    """The stencils with nothing at all in the rows of held components."""
    found = stencils.copy()
    for axis, led in enumerate(held):
        found[code[led], OWN, 3 * axis] = 0.0
    return found


def coarser_held(kind: NDArray[np.int8], held: Held, halved: tuple[int, int], below: Any) -> Held:
    """Of the next grid, of a kind `below`: as its places are led that lie on leaders."""
    found = np.zeros((2, *below.shape), bool)
    for axis, led in enumerate(held):
        own, out = np.where(led, LED, kind).astype(np.int8), np.zeros_like(below)
        kernels().coarse_kinds(own, halved, out)
        found[axis] = (out == LED) & (below == FREE)
    return found
