"""Keeps particles out of obstacles: whoever lies inside one is put on its outline after the step,
as position-based dynamics does it, without friction.

That is the nearest point. Where the rule knows forces, and a particle gives way more easily along
some directions than others, as at corners, it goes C n / (n·C n) times the gap first, the way on
which a push along the normal n sends it: what is left of the forces at rest is then along n.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces.frame import Indices
from pbdkit.scene.leader_groups import kinds_at
from pbdkit.scene.obstacles import SLACK, outlines_at
from pbdkit.scene.outlines import Outline, slide
from pbdkit.scene.places import Block, Mask, Places
from pbdkit.scene.raster import FOLLOWER
from pbdkit.scene.scene import Scene
from pbdkit.stepping.compliance import compliance
from pbdkit.stepping.state import Floats, State

Touching = list[tuple[Indices, NDArray[np.float64]]]
"""Of each obstacle some rows, and the normals there, (row, axis)."""


class Contact:
    """The obstacles of a scene and the particles of its body.

    Only those are looked at that can be in an obstacle's box, as far as displacements reach. One
    obstacle comes after the other, in the order of the experiment.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._vectors: Floats = np.array(scene.raster.lattice.cell().vectors)
        self._inverse = np.linalg.inv(self._vectors)
        ends = [end for block in self._blocks() for end in self._ends(block)]
        self.reach = float(np.abs(ends).max())
        """How far any particle rests from the lattice's site (0, 0), along an axis."""

    @cached_property
    def compliance(self) -> Floats | None:
        """How particles give way along different directions."""
        return compliance(self._scene)

    def push_out(self, u: Floats, moment: float) -> None:
        """Puts the body's particles, leaders too, out of the obstacles as they are at the end of a
        step, or at a moment within it; `u` are planes."""
        for _, outline in outlines_at(self._scene.barriers, moment):
            for block in self._blocks():
                near = self._near(block, block.of(u), outline.box)
                if near is not None:
                    self._push_block(near, u, outline)

    def touched_at_rest(self, moment: float) -> Iterator[tuple[NDArray[np.intp], ...]]:
        """The cells of particles that would be pushed where they rest, index by index."""
        still = np.zeros((2, *self._scene.raster.shape))
        for _, outline in outlines_at(self._scene.barriers, moment):
            for block in self._blocks():
                near = self._near(block, block.of(still), outline.box)
                if near is not None:
                    inside, *_ = self._inside(near, still, outline)
                    yield tuple(n + a for n, a in zip(np.nonzero(inside), near.start, strict=True))

    def touching(self, state: State, moment: float) -> Touching:
        """The rows of the followers on each obstacle's outline, as the state has them at a moment,
        and the normals there, (row, axis): within what rounding allows, and 1e-9 of a lattice
        constant."""
        scene, raster = self._scene, self._scene.raster
        rows = np.flatnonzero(kinds_at(raster, scene.leading, math.ceil(moment)) == FOLLOWER)
        places = Places(raster.shape, raster.place_of(rows))
        at = [np.asarray(a) for a in raster.reference_planes(places)]
        digits = 16.0 * float(np.finfo(state.u.dtype).eps) * self.reach
        u = state.u.reshape(2, -1)[:, places.place]
        x, y = (a + b for a, b in zip(at, u, strict=True))
        slack = SLACK * math.hypot(*self._vectors[0]) + digits
        found: Touching = [(rows[:0], np.zeros((0, 2)))] * len(scene.barriers)
        for n, outline in outlines_at(scene.barriers, moment):
            gap, nx, ny, _ = outline.facing(x, y)
            on = np.abs(gap) <= slack
            found[n] = rows[on], np.stack([nx[on], ny[on]], axis=1)
        return found

    def _blocks(self) -> list[Block]:
        blocks = (self._scene.raster.body_block(s) for s in range(self._scene.raster.shape[0]))
        return [block for block in blocks if block]

    def _near(self, block: Block, u: Floats, box: Floats) -> Block | None:
        """The part of a block whose particles can be in the box; u are its displacements."""
        raster = self._scene.raster
        low, high = np.array([[np.fmin.reduce(p, axis=None) for p in u],
                              [np.fmax.reduce(p, axis=None) for p in u]])  # fmt: skip
        corner = np.array([box[:2] - high, box[2:] - low])
        if np.isnan(corner).any():
            return None
        at = np.array(raster.lattice.cell().sites[block.sublattice].at)
        low, high = self._ends(block)
        # Boxes that do not end are those of the body here, and a little more.
        corner = np.clip(corner, low - 1.0, high + 1.0)
        corners = np.array([[corner[i, 0], corner[j, 1]] for i, j in product((0, 1), repeat=2)])
        cells = (corners - at) @ self._inverse - raster.first
        first = np.maximum(np.floor(cells.min(axis=0) - 1e-6).astype(int), block.start)
        last = np.minimum(np.ceil(cells.max(axis=0) + 1e-6).astype(int) + 1, block.stop)
        if (first >= last).any():
            return None
        return Block(block.sublattice, tuple(first.tolist()), tuple(last.tolist()))

    def _push_block(self, block: Block, u: Floats, outline: Outline) -> None:
        inside, *facing = self._inside(block, u, outline)
        gap, *normal = (value[inside] for value in facing)
        if self.compliance is not None:
            own = [c[inside] for c in block.of(self.compliance)]
            for plane, way in zip(block.of(u), slide(gap, *normal, *own), strict=True):
                plane[inside] = plane[inside] - way
            X = np.broadcast_arrays(*self._scene.raster.reference_planes(block))
            at = [a[inside] + plane[inside] for a, plane in zip(X, block.of(u), strict=True)]
            gap, *normal, _ = outline.facing(*at)
        for plane, n in zip(block.of(u), normal, strict=True):
            plane[inside] = plane[inside] - gap * n

    def _inside(
        self, block: Block, u: Floats, outline: Outline
    ) -> tuple[Mask, Floats, Floats, Floats]:
        """Which of the body's particles in a block are inside; the gap and the normal of all."""
        X, low = self._scene.raster.reference_planes(block), outline.box
        x, y = (a + b for a, b in zip(X, block.of(u), strict=True))
        near = (x >= low[0]) & (y >= low[1]) & (x <= low[2]) & (y <= low[3])
        near &= block.of(self._scene.raster.kind) == FOLLOWER
        gap, *normal = (np.zeros(x.shape) for _ in range(3))
        gap[near], normal[0][near], normal[1][near], _ = outline.facing(x[near], y[near])
        return near & (gap < 0.0), gap, normal[0], normal[1]

    def _ends(self, block: Block) -> tuple[Floats, Floats]:
        """(low, high) of the places of a block's sites, from site (0, 0)."""
        corners = product(*((a, b - 1) for a, b in zip(block.start, block.stop, strict=True)))
        sites = np.array(list(corners)) + self._scene.raster.first
        at = np.array(self._scene.raster.lattice.cell().sites[block.sublattice].at)
        places = sites @ self._vectors + at
        return places.min(axis=0), places.max(axis=0)
