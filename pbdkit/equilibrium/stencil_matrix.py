"""The stiffness of an equilibrium as stencils on the primitive cells of a lattice.

K = -∂force/∂u, or -∂move/∂u, of the followers: most have the same stencil, of 3 × 3 places with a
2 × 2 matrix each, which is kept once. Frame points are replaced by the body particles that they
follow. Components of particles that lead along one axis are constrained: nothing moves them, and
they move nobody. Rows are scaled where that makes K symmetric.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats, Indices, Integers
from pbdkit.equilibrium.system import ALL, Moves, Rows, outside
from pbdkit.lattice.raster import FOLLOWER, FRAME, LEADER, slot_step
from pbdkit.linear.block_matrix import frame_matrices
from pbdkit.linear.response import LinearResponse, by_sublattice, respond
from pbdkit.plugin import Slot
from pbdkit.plugin.lattice import Index
from pbdkit.plugin.rule import material_of
from pbdkit.scene.leader_groups import guided_at, kinds_of_places
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

CANDIDATES = 16
"""Stencils among which it is chosen, each process's most frequent."""
SAME = 1e-12
"""Relative difference below which two stencils count as one."""


@cache
def kernels() -> SimpleNamespace:
    """Return the compiled functions of grid_kernels.py, loaded when first used."""
    # Only here: numba is the extra `fast`, and equilibria are found without it too.
    from pbdkit.stepping.numba_engine.cache import load_kernel

    source = files("pbdkit.equilibrium").joinpath("grid_kernels.py").read_text(encoding="utf-8")
    return SimpleNamespace(**load_kernel(source, {}, ()).__globals__)


def most_first(
    code: Integers, stencils: Floats, scale: Floats, rows: Rows
) -> tuple[NDArray[np.int32], Floats, Floats]:
    """The same with the stencil of most as number 0, and those alike with it."""
    tables = stencils, scale
    most = _most(code[..., rows.own, :], tables, rows)
    apart = [
        np.abs(table - one).max(axis=tuple(range(1, table.ndim)))
        for table, one in zip(tables, most, strict=True)
    ]
    alike = sum(apart) <= SAME * np.abs(most[0]).max()
    kept = (np.bincount(code[code >= 0], minlength=len(stencils)) > 0) & ~alike
    number = np.zeros(len(stencils) + 1, np.int32)
    number[:-1][kept] = 1 + np.arange(np.count_nonzero(kept))
    number[-1] = -1
    first, second = (
        np.concatenate([one[None], table[kept]]) for table, one in zip(tables, most, strict=True)
    )
    return number[code], first, second


def _most(own: Integers, tables: tuple[Floats, Floats], rows: Rows) -> tuple[Floats, Floats]:
    """The stencil and scale of most in all processes, as far as any of them has it among the most
    frequent of its own."""
    counts = np.bincount(own[own >= 0], minlength=len(tables[0]))
    some = np.argsort(-counts, kind="stable")[:CANDIDATES].tolist()
    votes: dict[bytes, int] = {}
    found: dict[bytes, tuple[Floats, Floats]] = {}
    own_votes = [(int(counts[n]), *(table[n] for table in tables)) for n in some]
    for each in rows.communicator.allgather(own_votes):
        for count, stencil, scale in each:
            key = stencil.tobytes() + scale.tobytes()
            votes[key] = votes.get(key, 0) + count
            found.setdefault(key, (stencil, scale))
    return found[max(votes, key=votes.__getitem__)]


@dataclass(frozen=True)
class PrimitiveRaster:
    """Primitive cells, with a ring of empty ones around: the flat place of each particle here from
    its place on the scene's raster; `shape` is (row, place)."""

    shape: Index
    low: Index
    scene: Scene

    @classmethod
    def of(cls, scene: Scene) -> PrimitiveRaster | None:
        """None where bonds lead farther than to a primitive cell beside."""
        cell = scene.raster.cell
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
        return len(self.scene.raster.cell.sites) == 1

    def places(self, place: Indices) -> Indices:
        """The flat places here of some on the scene's raster."""
        if self.is_the_scenes:
            return place
        found: Indices = np.ravel_multi_index(tuple(self.index(place).T), self.shape)
        return found

    def index(self, place: Indices) -> Indices:
        """The same as (row, place)."""
        if self.is_the_scenes:
            return np.stack(np.unravel_index(place, self.shape), axis=-1)
        raster = self.scene.raster
        cell = raster.cell
        s, *cells = np.unravel_index(place, raster.shape)
        whole = np.stack(cells, axis=-1) + raster.first
        sites = np.array([site.primitive for site in cell.sites])
        found: Indices = whole @ np.array(cell.primitive) + sites[s] - self.low
        return found


def primitive_step(scene: Scene, slot: Slot) -> Index:
    """Where a slot leads in the primitive basis."""
    return scene.neighbourhood.cell.primitive_step(slot.source, slot.target, slot.cell)


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
        with rows.communicator.raise_together():
            for s, some in every:
                place = self._followers[some]
                responses = respond(self._scene, self._state, s, place, answers)
                fits = fits and self._add(place, responses)
        if rows.communicator.any(not fits) or not rows.communicator.any(len(self._followers) > 0):
            return None
        code, stencils, scale = most_first(
            self._code.reshape(self._scene.raster.shape),
            np.concatenate(self._stencils),
            np.concatenate(self._scale),
            rows,
        )
        stencils, scale = (v.reshape(*v.shape[:-2], 4) for v in (stencils, scale))
        return _on(self._grid, code.ravel(), self._kind == LEADER, stencils, scale)

    def _add(self, place: Indices, responses: list[LinearResponse]) -> bool:
        """Takes the stencils of one sublattice in; False where they do not fit."""
        moves, answers = responses[0], responses[-1]
        own = np.zeros((len(answers.centre), WINDOW, 2, 2))
        own[:, OWN] = -answers.centre
        for slot, derivative in answers.neighbours.items():
            own[:, _number(primitive_step(self._scene, slot))] -= derivative
        relaxation = self._scene.experiment.stepping.relaxation
        scale = np.matmul(answers.centre, inverses(relaxation * moves.centre))
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
        self, place: Indices, answers: LinearResponse, own: Floats
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


Held = NDArray[np.bool_]
"""(axis, row, place)."""


def held_components(scene: Scene, step: int, rows: Rows = ALL) -> Held | None:
    """Those of a step; None where nobody is guided."""
    guided, grid = guided_at(scene.raster, scene.leading, step), PrimitiveRaster.of(scene)
    if grid is None or not rows.communicator.any(len(guided.place) > 0):
        return None
    held = np.zeros((2, *grid.shape), bool)
    held.reshape(2, -1)[:, grid.places(guided.place)] = guided.lead_axes
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


EXACT, DIFFERENCED = 1e-9, 1e-5
"""Relative difference up to which a matrix counts as symmetric: one by derivatives, one by
differences."""
DIGITS = 13
"""Of factors of rows; rounding decides the others."""


def is_symmetric(matrix: StencilMatrix, alike: float = EXACT, rows: Rows = ALL) -> bool:
    """Up to a share of its largest entry."""
    own = max(float(matrix.stencils.max()), -float(matrix.stencils.min()))
    largest = rows.communicator.largest(own)
    asymmetry = kernels().asymmetry(matrix.code, matrix.stencils)
    return rows.communicator.largest(asymmetry) <= alike * largest


def balanced(
    matrix: StencilMatrix, alike: float = EXACT, rows: Rows = ALL
) -> tuple[StencilMatrix, bool]:
    """The matrix with its rows multiplied so that it is symmetric, and whether that can be: those
    of particles with fewer neighbours, of which each has more weight. What is left of a difference
    is shared by both sides."""
    if is_symmetric(matrix, rows=rows):
        return matrix, True
    factor = _factors(matrix, rows)
    if factor is None:
        return matrix, False
    lone = np.nonzero(matrix.code > 0)
    row, times = matrix.code[lone], factor[lone].round(DIGITS)
    number = np.arange(len(row))
    if len(row) >= len(matrix.stencils):
        pairs = np.stack([row, times], axis=1)
        kinds, number = np.unique(pairs, axis=0, return_inverse=True)
        row, times = kinds[:, 0].astype(int), kinds[:, 1]
    code = matrix.code.copy()
    code[lone] = 1 + number.ravel()
    stencils, scale = (
        np.concatenate([table[:1], table[row] * times.reshape(-1, *[1] * (table.ndim - 1))])
        for table in (matrix.stencils, matrix.scale)
    )
    found = replace(matrix, code=code, stencils=stencils, scale=scale)
    if not is_symmetric(found, alike, rows):
        return matrix, False
    if alike > EXACT:
        kernels().symmetrise(code, stencils)
    return found, True


def _factors(matrix: StencilMatrix, rows: Rows) -> Floats | None:
    """By which rows are multiplied, 1 for the stencil of most; None where some have none."""
    factor = (matrix.code == 0).astype(float)
    while True:
        left, before = kernels().balance(matrix.code, matrix.stencils, factor)
        if not rows.communicator.any(left < before):
            return None if rows.communicator.any(left > 0) else factor
        told = factor.copy()
        rows.exchange_halo(told)
        np.copyto(factor, told, where=told > 0.0)


def transposed(matrix: StencilMatrix) -> StencilMatrix:
    """Kᵀ, with stencils of their own for all but those whose neighbourhood is like that of most;
    `scale` is that of K."""
    code, (row, place) = matrix.code, np.nonzero(matrix.code >= 0)
    there = np.stack([code[row + s // 3 - 1, place + s % 3 - 1] for s in range(WINDOW)], axis=1)
    alike = (there == 0).all(axis=1)
    codes = code.copy()
    codes[row, place] = np.where(alike, 0, np.cumsum(~alike))
    kept = np.concatenate([np.zeros((1, WINDOW), there.dtype), there[~alike]])
    found = matrix.stencils[np.maximum(kept, 0), WINDOW - 1 - np.arange(WINDOW)][..., [0, 2, 1, 3]]
    found *= (kept >= 0)[..., None]
    scale = matrix.scale[np.maximum(kept[:, OWN], 0)]
    return replace(matrix, code=codes, stencils=np.ascontiguousarray(found), scale=scale)


def leads_one_way(matrix: StencilMatrix, rows: Rows = ALL) -> bool:
    """Whether one axis moves the other and not the reverse: they are better solved in turn."""
    ways = matrix.stencils[..., 1], matrix.stencils[..., 2]
    return len({rows.communicator.any(bool(way.any())) for way in ways}) > 1


def is_held(matrix: StencilMatrix, held: NDArray[np.bool_] | None = None, rows: Rows = ALL) -> bool:
    """Whether every connected part of the body touches a leader, along each axis, or has `held`
    components, and no neighbours are apart, as across a crack: without a bond, and without a
    neighbour that both have one with."""
    from scipy.ndimage import binary_dilation, label

    bonds = np.logical_or.reduce([matrix.stencils[..., e] != 0.0 for e in range(4)])
    known = np.logical_or.reduce(rows.communicator.allgather(bonds.any(axis=0)))
    if rows.communicator.any(any(_apart(matrix, bonds, s) for s in np.flatnonzero(known).tolist())):
        return False
    pattern = (known | known[::-1]).reshape(3, 3)
    parts, count = label(matrix.kind == FREE, structure=pattern)
    for axis in range(2):
        led = binary_dilation(matrix.kind == LED, structure=pattern)
        if held is not None:
            led |= held[axis]
        if not _reached(parts, count, led, rows):
            return False
    return True


def _reached(parts: Any, count: int, led: Any, rows: Rows) -> bool:
    """Whether all parts have led places, each going on where other processes have rows."""
    while True:
        reached = np.zeros(count + 1, bool)
        reached[parts[led]] = True
        reached[0] = False
        if not rows.communicator.any(not reached[1:].all()):
            return True
        here = reached[parts]
        there = here.copy()
        rows.exchange_halo(there)
        if not rows.communicator.any(bool((there > here).any())):
            return not rows.communicator.any(bool((here < (parts > 0))[rows.own].any()))
        led = here | there


def _apart(matrix: StencilMatrix, bonds: NDArray[np.bool_], s: int) -> bool:
    """Whether there are such neighbours along place s of the stencils."""
    row, place = np.nonzero(matrix.code > 0)
    down, along = s // 3 - 1, s % 3 - 1
    there = matrix.kind[row + down, place + along] != OUTSIDE
    some = np.flatnonzero(there & ~bonds[matrix.code[row, place], s])
    one = matrix.code[row[some], place[some]]
    other = matrix.code[row[some] + down, place[some] + along]
    linked = other < 0  # a leader: nothing moves it
    for t in range(9):
        a, b = t // 3 - 1 - down, t % 3 - 1 - along
        if max(abs(a), abs(b)) <= 1:
            linked |= bonds[one, t] & bonds[other, 3 * (a + 1) + b + 1]
    return not linked.all()
