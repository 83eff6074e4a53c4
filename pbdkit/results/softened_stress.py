"""The part of the stress that softened bonds no longer carry, cell by cell."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import Here
from pbdkit.interfaces.polygons import Side, signed_area
from pbdkit.scene.cells import Patch
from pbdkit.scene.places import Places
from pbdkit.scene.scene import Scene
from pbdkit.stepping.evaluator import Evaluator, Neighbour, summed
from pbdkit.stepping.state import State
from pbdkit.stepping.surroundings import Surroundings

Floats = NDArray[np.floating[Any]]


def lost_stress(scene: Scene, state: State, u: Floats, cells: list[tuple[Patch, Floats]]) -> Floats:
    """The first Piola-Kirchhoff stress that damage takes away, over Young's modulus: planes
    (component × axis, sublattice, cell, cell), at each particle the mean over the given cells
    around it by their share.

    Of a cell it is -Σ ΔF ⊗ X over its corners and its area, with the forces ΔF that the damage
    changes: the mean stress of a body under forces on its surface.
    """
    total, area = np.zeros((4, *scene.raster.shape)), np.zeros(scene.raster.shape)
    for patch, share in cells:
        used = np.flatnonzero(np.broadcast_to(share, patch.whole.shape) > 0.0)
        corners = [_places(scene, patch, n, used) for n in range(len(patch.corners))]
        weight = np.broadcast_to(share, patch.whole.shape).ravel()[used]
        size = abs(float(signed_area(patch.polygon.rest)))
        lost = np.zeros((4, len(used)))
        for n, (place, rest) in enumerate(zip(corners, patch.polygon.rest, strict=True)):
            for force in _lost_forces(scene, state, u, patch, n, place):
                lost += np.array([f * x for f in force for x in rest]) / size
        for place in corners:
            flat = place.place
            np.add.at(area.reshape(-1), flat, weight)
            for plane, value in zip(total.reshape(4, -1), lost, strict=True):
                np.add.at(plane, flat, value)
    return total / np.where(area > 0.0, area, 1.0)


def _places(scene: Scene, patch: Patch, corner: int, cells: NDArray[np.intp]) -> Places:
    """Where the corners of some cells of a patch lie, counted in it."""
    block, shape = patch.corners[corner], scene.raster.shape
    at = np.unravel_index(cells, patch.whole.shape)
    index = [n + start for n, start in zip(at, block.start, strict=True)]
    flat = np.ravel_multi_index((np.full(len(cells), block.sublattice), *index), shape)
    return Places(shape, flat.astype(np.intp))


def _lost_forces(
    scene: Scene, state: State, u: Floats, patch: Patch, corner: int, place: Places
) -> Iterator[Any]:
    """The forces of each other corner on one in these cells, without damage less with it."""
    around = Surroundings(scene, place, patch.corners[corner].sublattice)
    evaluator = Evaluator(scene)
    here = around.here(u, state)
    beside = scene.neighbourhood.tiling.beside
    parts = zip(around.slots, around.differences(u), around.neighbours(state), strict=True)
    for slot, d, to in parts:
        sides = [_is_of(side, patch, corner) for side in beside[slot]]
        if to.torn is None or not any(sides):
            continue
        own = replace(
            to,
            w=_of_sides(to.w, sides),
            more=tuple(_of_sides(w, sides) for w in to.more),
        )
        whole, torn = (
            evaluator.force(_total(evaluator, d, here, one), here)
            for one in (replace(own, torn=None), own)
        )
        yield torn - whole


def _total(evaluator: Evaluator, d: Any, here: Here, to: Neighbour) -> Any:
    return summed([(evaluator.contribution(d, here.u, to), None)])


def _is_of(side: Side, patch: Patch, corner: int) -> bool:
    """Whether a cell beside a bond that starts at a corner is the patch's."""
    source = patch.polygon.source if side.first is None else side.first.target
    return (side.kind, source, side.start) == (patch.polygon.kind, patch.polygon.source, corner)


def _of_sides(w: Any, sides: list[bool]) -> Any:
    left, right = (
        share if own else 0.0 for own, share in zip(sides, (w.left, w.right), strict=True)
    )
    return w._replace(left=left, right=right)
