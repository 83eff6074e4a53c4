"""The matrix of an equilibrium as stencils on the primitive cells of a lattice.

K = -∂force/∂u, or -∂move/∂u, of the followers: most have the same stencil, of 3 × 3 places with a
2 × 2 matrix each; it is kept once. What frame points show is what their body particles do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.couplings import frame_matrices
from pbdkit.analysis.linear_response import Response, by_sublattice, respond
from pbdkit.interfaces import Calibrated, Slot
from pbdkit.interfaces.frame import Indices
from pbdkit.interfaces.lattice import Index
from pbdkit.scene.places import slot_step
from pbdkit.scene.raster import FOLLOWER, FRAME, LEADER
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

Floats = NDArray[np.floating[Any]]
Integers = NDArray[np.signedinteger[Any]]
WINDOW, OWN = 9, 4
"""Places of a stencil, and the one of the particle itself among them."""
OUTSIDE, FREE, LED = 0, 1, 2
SINGULAR, SAME = 1e-14, 1e-12
"""Relative sizes below which a determinant counts as zero, and two stencils as one."""


@dataclass(frozen=True)
class StencilMatrix:
    """`code` (row, place) is -1 where nobody is free, else the number of the stencil in `stencils`
    (number, place, 4), numbers xx, xy, yx, yy; 0 is that of most. `kind` tells who is free and who
    leads. `scale` (number, 4) takes moves to what K c equals. `at` and `place` are where the
    followers are here and on the scene's raster, flat; None where both rasters are one."""

    code: NDArray[np.int32]
    kind: NDArray[np.int8]
    stencils: Floats
    scale: Floats
    at: Indices | None
    place: Indices | None


def stencil_matrix(scene: Scene, state: State, step: int) -> StencilMatrix | None:
    """The matrix at a state with the roles of a step; None where it has no such form: in space, on
    lattices of several sites a primitive cell, for longer bonds, rules that apply twice and frames
    whose points show particles far away."""
    grid = _Raster.of(scene)
    if grid is None or scene.inner or scene.experiment.neighbours.nearness():
        return None
    return _Assembly(scene, state, step, grid).matrix()


@dataclass(frozen=True)
class _Raster:
    """Primitive cells, with a ring of empty ones around: the flat place of each particle here from
    its place on the scene's raster; `shape` is (row, place)."""

    shape: Index
    low: Index
    scene: Scene

    @classmethod
    def of(cls, scene: Scene) -> _Raster | None:
        """None where bonds lead farther than to a primitive cell beside."""
        cell = scene.raster.lattice.cell()
        steps = [primitive_step(scene, slot) for slot in scene.neighbourhood.every]
        if (
            scene.axes != 2
            or np.abs(steps).max() > 1
            or abs(np.linalg.det(cell.primitive)) != len(cell.sites)
        ):
            return None
        if len(cell.sites) == 1:
            return cls(scene.raster.shape[1:], scene.raster.first, scene)
        cells = np.array(scene.raster.shape[1:]) - 1
        corners = (
            np.array([(0, 0), (cells[0], 0), (0, cells[1]), tuple(cells)]) + scene.raster.first
        )
        ends = corners @ np.array(cell.primitive)
        sites = np.array([site.primitive for site in cell.sites])
        low = ends.min(axis=0) + sites.min(axis=0) - 1
        high = ends.max(axis=0) + sites.max(axis=0) + 1
        return cls(tuple((high - low + 1).tolist()), tuple(low.tolist()), scene)

    @property
    def is_the_scenes(self) -> bool:
        """Whether places here are places there."""
        return len(self.scene.raster.lattice.cell().sites) == 1

    def places(self, place: Indices) -> Indices:
        """The flat places here of some on the scene's raster."""
        if self.is_the_scenes:
            return place
        raster = self.scene.raster
        cell = raster.lattice.cell()
        s, *cells = np.unravel_index(place, raster.shape)
        whole = np.stack(cells, axis=-1) + raster.first
        sites = np.array([site.primitive for site in cell.sites])
        index = whole @ np.array(cell.primitive) + sites[s] - self.low
        found: Indices = np.ravel_multi_index(tuple(index.T), self.shape)
        return found


def primitive_step(scene: Scene, slot: Slot) -> Index:
    """Where a slot leads in the primitive basis."""
    found = scene.raster.lattice.cell().offset(slot.source, slot.target, slot.cell)
    return found.primitive


class _Assembly:
    """Puts the stencils together; particles are looked up by their flat place on the scene's
    raster."""

    def __init__(self, scene: Scene, state: State, step: int, grid: _Raster) -> None:
        self._scene, self._state, self._grid = scene, state, grid
        raster = scene.raster
        self._kind = raster.kind.ravel().copy()
        for leading in scene.leading:
            if leading.group.leads(step):
                self._kind[leading.place] = LEADER
        self._followers = np.flatnonzero(self._kind == FOLLOWER)
        self._code = np.full(self._kind.size, -1, np.int32)
        self._stencils, self._scale = list[Floats](), list[Floats]()
        self._count = 0

    def matrix(self) -> StencilMatrix | None:
        """None where a frame point shows a particle that lies outside the window."""
        known = isinstance(self._scene.experiment.rule, Calibrated)
        answers = ("move", "force") if known else ("move",)
        for s, some in by_sublattice(self._scene, self._followers):
            place = self._followers[some]
            if not self._add(place, respond(self._scene, self._state, s, place, answers)):
                return None
        code, stencils, scale = _most_first(
            self._code, np.concatenate(self._stencils), np.concatenate(self._scale)
        )
        stencils, scale = (v.reshape(*v.shape[:-2], 4) for v in (stencils, scale))
        kind = np.select([code >= 0, self._kind == LEADER], [FREE, LED], OUTSIDE).astype(np.int8)
        if self._grid.is_the_scenes:
            shape = self._grid.shape
            return StencilMatrix(
                code.reshape(shape), kind.reshape(shape), stencils, scale, None, None
            )
        place = np.flatnonzero(kind != OUTSIDE)
        at = self._grid.places(place)
        codes = np.full(self._grid.shape, -1, np.int32)
        kinds = np.zeros(self._grid.shape, np.int8)
        codes.ravel()[at], kinds.ravel()[at] = code[place], kind[place]
        free = kind[place] == FREE
        return StencilMatrix(codes, kinds, stencils, scale, at[free], place[free])

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


def _most_first(
    code: Integers, stencils: Floats, scale: Floats
) -> tuple[NDArray[np.int32], Floats, Floats]:
    """The same with the stencil of most as number 0, and those alike with it."""
    counts = np.bincount(code[code >= 0], minlength=len(stencils))
    most = int(counts.argmax())
    apart = np.abs(stencils - stencils[most]).max(axis=(1, 2, 3))
    apart += np.abs(scale - scale[most]).max(axis=(1, 2))
    alike = apart <= SAME * np.abs(stencils[most]).max()
    kept = (counts > 0) & ~alike
    order = np.concatenate([[most], np.flatnonzero(kept)])
    number = np.zeros(len(stencils) + 1, np.int32)
    number[order] = np.arange(len(order))
    number[-1] = -1
    return number[code], stencils[order], scale[order]
