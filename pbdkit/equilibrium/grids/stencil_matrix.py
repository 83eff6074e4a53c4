"""The matrix of an equilibrium as stencils on the primitive cells of a lattice.

K = -∂force/∂u, or -∂move/∂u, of the followers: most have the same stencil, of 3 × 3 places with a
2 × 2 matrix each; it is kept once. What frame points show is what their body particles do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.couplings import frame_matrices
from pbdkit.analysis.linear_response import Response, by_sublattice, respond
from pbdkit.equilibrium.grids.commonest import most_first
from pbdkit.equilibrium.grids.grid_functions import kernels
from pbdkit.equilibrium.grids.primitive_raster import PrimitiveRaster, primitive_step
from pbdkit.equilibrium.moves import Moves
from pbdkit.equilibrium.rows import ALL, Rows
from pbdkit.equilibrium.strip import outside
from pbdkit.interfaces.frame import Indices
from pbdkit.interfaces.rule import material_of
from pbdkit.scene.guides import kinds_of_places
from pbdkit.scene.places import slot_step
from pbdkit.scene.raster import FOLLOWER, FRAME, LEADER
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

Floats = NDArray[np.floating[Any]]
Integers = NDArray[np.signedinteger[Any]]
WINDOW, OWN = 9, 4
"""Places of a stencil, and the one of the particle itself among them."""
OUTSIDE, FREE, LED = 0, 1, 2
NUDGE = 1e-7
"""By which differences are taken, in lattice spacings: rounding and curvature do some 1e-7 to them,
for displacements of up to a hundred."""
NOISE = 1e-5
"""The share of the largest entry below which there is no bond."""
SINGULAR = 1e-14
"""Relative size below which a determinant counts as zero."""


@dataclass(frozen=True)
class StencilMatrix:
    """`code` (row, place) is -1 where nobody is free, else the number of the stencil in `stencils`
    (number, place, 4), numbers xx, xy, yx, yy; 0 is that of most. `kind` tells who is free and who
    leads. `scale` (number, 4) takes moves to what K c equals. `at` and `place` are where the
    followers are here and on the scene's raster, flat; None where both rasters are one. `held`
    (axis, row, place) are the components of guided particles that lead; None where nobody is."""

    code: NDArray[np.int32]
    kind: NDArray[np.int8]
    stencils: Floats
    scale: Floats
    at: Indices | None
    place: Indices | None
    held: NDArray[np.bool_] | None = None

    def within(self, rows: slice) -> StencilMatrix:
        """With nobody outside some rows."""
        if rows == slice(None):
            return self
        code, kind = self.code.copy(), self.kind.copy()
        for unknown in outside(rows, len(code)):
            code[unknown], kind[unknown] = -1, OUTSIDE
        return replace(self, code=code, kind=kind)


def stencil_matrix(scene: Scene, state: State, step: int, rows: Rows = ALL) -> StencilMatrix | None:
    """The matrix at a state with the roles of a step; None where it has no such form: in space, on
    lattices of several sites a primitive cell, for longer bonds, rules that apply twice and frames
    whose points show particles far away."""
    grid = PrimitiveRaster.of(scene)
    if grid is None or scene.inner or scene.experiment.neighbours.nearness():
        return None
    return _Assembly(scene, state, step, grid).matrix(rows)


def differenced_matrix(scene: Scene, state: State, step: int, moves: Moves) -> StencilMatrix | None:
    """The same by differences of the moves, many particles at once: nine groups, of particles three
    places apart, do not meet in anybody's stencil. Followers have stencils of their own.

    Who is moved by others farther away has a wrong one: to be compared with moves.
    """
    grid = PrimitiveRaster.of(scene)
    kind = kinds_of_places(scene.raster, scene.leading, step)
    if grid is None:
        return None
    place = np.flatnonzero(kind == FOLLOWER)
    body = np.flatnonzero((kind == FOLLOWER) | (kind == LEADER))
    code = np.full(kind.size, -1, np.int32)
    group, groups = (_number(grid.index(some).T % 3 - 1) for some in (place, body))
    # Where in a stencil the particles of one group lie, seen from those of another.
    ways = np.stack(np.unravel_index(np.arange(WINDOW), (3, 3)))
    numbers = _number((ways[:, :, None] - ways[:, None] + 1) % 3 - 1)
    stencils, every = np.empty((len(place), WINDOW, 2, 2)), np.arange(len(place))
    nudged, nudge = replace(state, u=state.u.copy()), NUDGE * scene.neighbourhood.nudge_unit
    still, largest = moves.at(nudged, step).reshape(2, -1).copy(), 0.0
    for n in range(WINDOW):
        some, number = body[groups == n], numbers[n][group]
        for axis in range(2):
            nudged.u[...] = state.u
            nudged.u.reshape(2, -1)[axis, some] += nudge
            moved = moves.at(nudged, step).reshape(2, -1)
            found = kernels().differences(still, moved, place, number, 1 / nudge, axis, stencils)
            largest = max(largest, found)
    kernels().clear_noise(stencils, NOISE * largest)
    code[place] = np.where(stencils[:, OWN].any(axis=(1, 2)), every, -1)
    scale = np.broadcast_to(np.eye(2).ravel(), (len(place), 4))
    return _on(grid, code, kind == LEADER, stencils.reshape(-1, WINDOW, 4), scale.copy())


def _on(
    grid: PrimitiveRaster, code: Integers, led: Any, stencils: Floats, scale: Floats
) -> StencilMatrix:
    """The matrix on a raster, of what is known by flat places of the scene's."""
    kind = np.select([code >= 0, led], [FREE, LED], OUTSIDE).astype(np.int8)
    if grid.is_the_scenes:
        shape = grid.shape
        return StencilMatrix(code.reshape(shape), kind.reshape(shape), stencils, scale, None, None)
    place = np.flatnonzero(kind != OUTSIDE)
    at = grid.places(place)
    codes, kinds = np.full(grid.shape, -1, np.int32), np.zeros(grid.shape, np.int8)
    codes.ravel()[at], kinds.ravel()[at] = code[place], kind[place]
    free = kind[place] == FREE
    return StencilMatrix(codes, kinds, stencils, scale, at[free], place[free])


class _Assembly:
    """Puts the stencils together; particles are looked up by their flat place on the scene's
    raster."""

    def __init__(self, scene: Scene, state: State, step: int, grid: PrimitiveRaster) -> None:
        self._scene, self._state, self._grid = scene, state, grid
        self._kind = kinds_of_places(scene.raster, scene.leading, step)
        self._followers = np.flatnonzero(self._kind == FOLLOWER)
        self._code = np.full(self._kind.size, -1, np.int32)
        self._stencils = list[Floats]([np.empty((0, WINDOW, 2, 2))])
        self._scale = list[Floats]([np.empty((0, 2, 2))])
        self._count = 0

    def matrix(self, rows: Rows) -> StencilMatrix | None:
        """None where a frame point shows a particle that lies outside the window."""
        known = material_of(self._scene.experiment.rule) is not None
        answers = ("move", "force") if known else ("move",)
        fits, every = True, by_sublattice(self._scene, self._followers)
        with rows.agreeing():
            for s, some in every:
                place = self._followers[some]
                responses = respond(self._scene, self._state, s, place, answers)
                fits = fits and self._add(place, responses)
        if rows.any(not fits) or not rows.any(len(self._followers) > 0):
            return None
        code, stencils, scale = most_first(
            self._code.reshape(self._scene.raster.shape),
            np.concatenate(self._stencils),
            np.concatenate(self._scale),
            rows,
        )
        stencils, scale = (v.reshape(*v.shape[:-2], 4) for v in (stencils, scale))
        return _on(self._grid, code.ravel(), self._kind == LEADER, stencils, scale)

    def _add(self, place: Indices, responses: list[Response]) -> bool:
        """Takes the stencils of one sublattice in; False where they do not fit."""
        moves, answers = responses[0], responses[-1]
        own = np.zeros((len(answers.own), WINDOW, 2, 2))
        own[:, OWN] = -answers.own
        for slot, derivative in answers.neighbours.items():
            own[:, _number(primitive_step(self._scene, slot))] -= derivative
        relaxation = self._scene.experiment.stepping.relaxation
        scale = np.matmul(answers.own, inverses(relaxation * moves.own))
        shown = self._shown(place, answers, own)
        if shown is None:
            return False
        some, rows = shown
        kind = answers.kind.astype(np.int32)
        kind[some] = len(own) + np.arange(len(some))
        kind[(own[answers.kind, OWN] == 0.0).all(axis=(1, 2))] = -1
        self._code[place] = np.where(kind >= 0, self._count + kind, -1)
        self._stencils += [own, rows]
        self._scale += [scale, scale[answers.kind[some]]]
        self._count += len(own) + len(some)
        return True

    def _shown(
        self, place: Indices, answers: Response, own: Floats
    ) -> tuple[Indices, Floats] | None:
        """Who sees frame points, and their stencils, with what these show in their places; None
        where that is too far away."""
        frame, raster = self._scene.frame, self._scene.raster
        steps = [(slot, slot_step(raster.shape, slot)) for slot in answers.neighbours]
        sees = np.zeros(len(place), bool)
        for _, step in steps if frame else ():
            sees |= self._kind[place + step] == FRAME
        some = np.flatnonzero(sees)
        rows = own[answers.kind[some]]
        if frame is None or not len(some):
            return some, rows
        here = np.stack(np.unravel_index(self._grid.places(place[some]), self._grid.shape))
        number = np.full(self._kind.size, -1)
        number[frame.place] = np.arange(len(frame.place))
        for slot, step in steps:
            there = place[some] + step
            through = np.flatnonzero(self._kind[there] == FRAME)
            derivative = answers.neighbours[slot][answers.kind[some[through]]]
            rows[through, _number(primitive_step(self._scene, slot))] += derivative
            point = number[there[through]]
            first = np.searchsorted(frame.map.point, point)
            last = np.searchsorted(frame.map.point, point + 1)
            for e in range(int((last - first).max(initial=0))):
                has = first + e < last
                entry = (first + e)[has]
                body = frame.body_place[entry]
                free = self._kind[body] == FOLLOWER
                entry, body, who = entry[free], body[free], through[has][free]
                at = np.stack(np.unravel_index(self._grid.places(body), self._grid.shape))
                way = at - here[:, who]
                if np.abs(way).max(initial=0) > 1:
                    return None
                weight = frame_matrices(frame.map.weight[entry], 2)
                product = np.matmul(derivative[has][free], weight)
                np.subtract.at(rows, (who, _number(way)), product)
        return some, rows


def _number(way: Any) -> Any:
    """Of the place of a stencil that lies so far away."""
    return 3 * (way[0] + 1) + way[1] + 1


def inverses(matrices: Floats) -> Floats:
    """Of matrices (..., 2, 2); zero where there is none."""
    (a, b), (c, d) = np.moveaxis(matrices, (-2, -1), (0, 1))
    determinant = a * d - b * c
    some = np.abs(determinant) > SINGULAR * np.abs(matrices).max(axis=(-2, -1)) ** 2
    adjugate = np.moveaxis(np.array([[d, -b], [-c, a]]), (0, 1), (-2, -1))
    factor = np.where(some, 1.0 / np.where(some, determinant, 1.0), 0.0)
    return np.asarray(factor[..., None, None] * adjugate)
