"""Stiffness of an equilibrium as stencils on the primitive cells of a lattice.

K is -∂force/∂u, or -∂move/∂u, of the followers. A stencil has 3 × 3 places with a 2 × 2 matrix
each. Most followers have the same stencil, which is stored once. Frame points are eliminated: their
displacements are replaced by those of the body particles that they follow. The rows and columns of
prescribed components of guided particles are empty. Rows are scaled if this makes K symmetric.
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
"""Number of stencils that each process proposes, its most frequent ones; the most frequent stencil
of the whole lattice is selected from them."""
SAME = 1e-12
"""Relative difference up to which two stencils are regarded as equal."""


@cache
def kernels() -> SimpleNamespace:
    """Return the compiled functions of grid_kernels.py, loaded when first used."""
    # Imported here because numba is an optional dependency, and equilibria can be computed without
    # it.
    from pbdkit.stepping.numba_engine.cache import load_kernel

    source = files("pbdkit.equilibrium").joinpath("grid_kernels.py").read_text(encoding="utf-8")
    return SimpleNamespace(**load_kernel(source, {}, ()).__globals__)


def most_first(
    code: Integers, stencils: Floats, scale: Floats, rows: Rows
) -> tuple[NDArray[np.int32], Floats, Floats]:
    """Return code, stencils and scales, renumbered such that the most frequent stencil is number 0.
    All places with an equal stencil get the number 0 too."""
    tables = stencils, scale
    frequent = _most_frequent(code[..., rows.own, :], tables, rows)
    differences = [
        np.abs(table - entry).max(axis=tuple(range(1, table.ndim)))
        for table, entry in zip(tables, frequent, strict=True)
    ]
    is_frequent = sum(differences) <= SAME * np.abs(frequent[0]).max()
    is_distinct = (np.bincount(code[code >= 0], minlength=len(stencils)) > 0) & ~is_frequent
    number = np.zeros(len(stencils) + 1, np.int32)
    number[:-1][is_distinct] = 1 + np.arange(np.count_nonzero(is_distinct))
    number[-1] = -1
    first, second = (
        np.concatenate([entry[None], table[is_distinct]])
        for table, entry in zip(tables, frequent, strict=True)
    )
    return number[code], first, second


def _most_frequent(
    own: Integers, tables: tuple[Floats, Floats], rows: Rows
) -> tuple[Floats, Floats]:
    """Return the stencil that is most frequent over all processes, and its scale. Only the most
    frequent stencils of each process are considered."""
    counts = np.bincount(own[own >= 0], minlength=len(tables[0]))
    candidates = np.argsort(-counts, kind="stable")[:CANDIDATES].tolist()
    votes: dict[bytes, int] = {}
    candidate_tables: dict[bytes, tuple[Floats, Floats]] = {}
    own_votes = [(int(counts[n]), *(table[n] for table in tables)) for n in candidates]
    for each in rows.communicator.allgather(own_votes):
        for count, stencil, scale in each:
            key = stencil.tobytes() + scale.tobytes()
            votes[key] = votes.get(key, 0) + count
            candidate_tables.setdefault(key, (stencil, scale))
    return candidate_tables[max(votes, key=votes.__getitem__)]


@dataclass(frozen=True)
class PrimitiveRaster:
    """Raster of primitive cells, surrounded by a ring of empty cells; `shape` is (row, place)."""

    shape: Index
    low: Index
    scene: Scene

    @classmethod
    def of(cls, scene: Scene) -> PrimitiveRaster | None:
        """Return the raster of a scene; None if bonds extend beyond adjacent primitive cells."""
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
        """True if the places of this raster are the same as those of the scene's raster."""
        return len(self.scene.raster.cell.sites) == 1

    def places(self, place: Indices) -> Indices:
        """Convert flat places of particles on the scene's raster to flat places on the raster of
        the stencils."""
        if self.is_the_scenes:
            return place
        places: Indices = np.ravel_multi_index(tuple(self.index(place).T), self.shape)
        return places

    def index(self, place: Indices) -> Indices:
        """Convert flat places of particles on the scene's raster to places (row, place) on the
        raster of the stencils."""
        if self.is_the_scenes:
            return np.stack(np.unravel_index(place, self.shape), axis=-1)
        raster = self.scene.raster
        cell = raster.cell
        s, *cells = np.unravel_index(place, raster.shape)
        whole = np.stack(cells, axis=-1) + raster.first
        sites = np.array([site.primitive for site in cell.sites])
        index: Indices = whole @ np.array(cell.primitive) + sites[s] - self.low
        return index


def primitive_step(scene: Scene, slot: Slot) -> Index:
    """Return the difference of the site indices of a neighbour and the particle, in the primitive
    basis."""
    return scene.neighbourhood.cell.primitive_step(slot.source, slot.target, slot.cell)


WINDOW = 9
"""Number of places of a stencil."""
OWN = 4
"""Index of the central place of a stencil."""
OUTSIDE = 0
"""Kind of a place without a particle of the body."""
FREE = 1
"""Kind of a place with a follower."""
LED = 2
"""Kind of a place with a leader."""
NUDGE = 1e-7
"""Displacement for difference quotients, in lattice spacings. The quotients have errors of about
1e-7, which are caused by rounding and curvature, if the displacements of the body are at most a
hundred spacings."""
NOISE = 1e-5
"""An entry counts as zero if its ratio to the largest entry is smaller than this number."""
SINGULAR = 1e-14
"""Relative size below which a determinant counts as zero."""


@dataclass(frozen=True)
class StencilMatrix:
    """Matrix of stencils. `stencils` is an array (number, place, 4) with the entries xx, xy, yx,
    yy. `code` (row, place) is the number of the stencil of a place: 0 for the most frequent
    stencil, and -1 where no particle is free. `kind` distinguishes free places and leaders. `scale`
    (number, 4) contains for each stencil the 2 × 2 matrix that maps moves to K c. `at` are the flat
    places of the followers on this raster, and `place` those on the scene's raster; they are None
    if both rasters have the same places. `held` (axis, row, place) marks constrained components,
    and is None if there are none."""

    code: NDArray[np.int32]
    kind: NDArray[np.int8]
    stencils: Floats
    scale: Floats
    at: Indices | None
    place: Indices | None
    held: NDArray[np.bool_] | None = None

    def within(self, rows: slice) -> StencilMatrix:
        """Return the matrix with empty places outside some rows."""
        if rows == slice(None):
            return self
        code, kind = self.code.copy(), self.kind.copy()
        for unknown in outside(rows, len(code)):
            code[unknown], kind[unknown] = -1, OUTSIDE
        return replace(self, code=code, kind=kind)


def stencil_matrix(scene: Scene, state: State, step: int, rows: Rows = ALL) -> StencilMatrix | None:
    """Assemble the matrix at a state with the roles of a step.

    Returns None if the matrix cannot be stored as stencils. This is so in space, and on lattices
    with several sites in a primitive cell. It is also so if bonds extend beyond adjacent primitive
    cells, if rules are nested, or if frame points follow distant particles.
    """
    grid = PrimitiveRaster.of(scene)
    if grid is None or scene.inner or scene.experiment.neighbours.nearness():
        return None
    return _Assembly(scene, state, step, grid).matrix(rows)


def differenced_matrix(scene: Scene, state: State, step: int, moves: Moves) -> StencilMatrix | None:
    """Assemble the matrix by differences of the moves. The particles are divided into nine groups,
    each with one particle in every 3 × 3 places, so that no stencil contains two particles of a
    group. All particles of a group are displaced simultaneously. Each follower has a separate
    stencil.

    The stencil of a particle is wrong if its move depends on particles outside the stencil. The
    caller therefore has to compare products with moves.
    """
    grid = PrimitiveRaster.of(scene)
    kind = kinds_of_places(scene.raster, scene.leading, step)
    if grid is None:
        return None
    place = np.flatnonzero(kind == FOLLOWER)
    body = np.flatnonzero((kind == FOLLOWER) | (kind == LEADER))
    code = np.full(kind.size, -1, np.int32)
    group, groups = (_number(grid.index(particles).T % 3 - 1) for particles in (place, body))
    # numbers[n, g] is the index in a stencil at which the stencils of particles of group g contain
    # a particle of group n.
    offsets = np.stack(np.unravel_index(np.arange(WINDOW), (3, 3)))
    numbers = _number((offsets[:, :, None] - offsets[:, None] + 1) % 3 - 1)
    stencils, every = np.empty((len(place), WINDOW, 2, 2)), np.arange(len(place))
    nudged, nudge = replace(state, u=state.u.copy()), NUDGE * scene.neighbourhood.nudge_unit
    still, largest = moves.at(nudged, step).reshape(2, -1).copy(), 0.0
    for n in range(WINDOW):
        particles, number = body[groups == n], numbers[n][group]
        for axis in range(2):
            nudged.u[...] = state.u
            nudged.u.reshape(2, -1)[axis, particles] += nudge
            moved = moves.at(nudged, step).reshape(2, -1)
            maximum = kernels().differences(still, moved, place, number, 1 / nudge, axis, stencils)
            largest = max(largest, maximum)
    kernels().clear_noise(stencils, NOISE * largest)
    code[place] = np.where(stencils[:, OWN].any(axis=(1, 2)), every, -1)
    scale = np.broadcast_to(np.eye(2).ravel(), (len(place), 4))
    return _on(grid, code, kind == LEADER, stencils.reshape(-1, WINDOW, 4), scale.copy())


def _on(
    grid: PrimitiveRaster, code: Integers, led: Any, stencils: Floats, scale: Floats
) -> StencilMatrix:
    """Return the matrix on a raster of primitive cells. The data are given by flat place of the
    scene's raster."""
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
    """Assembly of the stencils. Particles are looked up by their flat place on the scene's
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
        """Return the matrix; None if a frame point depends on a particle outside the stencils of
        its neighbours."""
        is_calibrated = material_of(self._scene.experiment.rule) is not None
        answers = ("move", "force") if is_calibrated else ("move",)
        fits, every = True, by_sublattice(self._scene, self._followers)
        with rows.communicator.raise_together():
            for s, members in every:
                place = self._followers[members]
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
        """Add the stencils of one sublattice. Return False if an entry lies outside the 3 × 3
        places of a stencil."""
        moves, answers = responses[0], responses[-1]
        stencils = np.zeros((len(answers.centre), WINDOW, 2, 2))
        stencils[:, OWN] = -answers.centre
        for slot, derivative in answers.neighbours.items():
            stencils[:, _number(primitive_step(self._scene, slot))] -= derivative
        relaxation = self._scene.experiment.stepping.relaxation
        scale = np.matmul(answers.centre, inverses(relaxation * moves.centre))
        frame_rows = self._shown(place, answers, stencils)
        if frame_rows is None:
            return False
        numbers, rows = frame_rows
        kind = answers.kind.astype(np.int32)
        kind[numbers] = len(stencils) + np.arange(len(numbers))
        is_empty = (stencils[:, OWN] == 0.0).all(axis=(1, 2))
        kind[is_empty[answers.kind]] = -1
        self._code[place] = np.where(kind >= 0, self._count + kind, -1)
        self._stencils += [stencils, rows]
        self._scale += [scale, scale[answers.kind[numbers]]]
        self._count += len(stencils) + len(numbers)
        return True

    def _shown(
        self, place: Indices, answers: LinearResponse, own: Floats
    ) -> tuple[Indices, Floats] | None:
        """Return the indices of the particles that have frame points as neighbours, and the
        stencils of these particles with the contributions of the frame points. Return None if a
        contribution lies outside the 3 × 3 places of a stencil."""
        frame, raster = self._scene.frame, self._scene.raster
        steps = [(slot, slot_step(raster.shape, slot)) for slot in answers.neighbours]
        sees = np.zeros(len(place), bool)
        for _, step in steps if frame else ():
            sees |= self._kind[place + step] == FRAME
        numbers = np.flatnonzero(sees)
        rows = own[answers.kind[numbers]]
        if frame is None or not len(numbers):
            return numbers, rows
        index = np.stack(np.unravel_index(self._grid.places(place[numbers]), self._grid.shape))
        number = np.full(self._kind.size, -1)
        number[frame.place] = np.arange(len(frame.place))
        for slot, step in steps:
            neighbours = place[numbers] + step
            through = np.flatnonzero(self._kind[neighbours] == FRAME)
            derivative = answers.neighbours[slot][answers.kind[numbers[through]]]
            rows[through, _number(primitive_step(self._scene, slot))] += derivative
            point = number[neighbours[through]]
            first = np.searchsorted(frame.map.point, point)
            last = np.searchsorted(frame.map.point, point + 1)
            for e in range(int((last - first).max(initial=0))):
                has = first + e < last
                entry = (first + e)[has]
                body = frame.body_place[entry]
                free = self._kind[body] == FOLLOWER
                entry, body, row_numbers = entry[free], body[free], through[has][free]
                at = np.stack(np.unravel_index(self._grid.places(body), self._grid.shape))
                offset = at - index[:, row_numbers]
                if np.abs(offset).max(initial=0) > 1:
                    return None
                weight = frame_matrices(frame.map.weight[entry], 2)
                product = np.matmul(derivative[has][free], weight)
                np.subtract.at(rows, (row_numbers, _number(offset)), product)
        return numbers, rows


def _number(offset: Any) -> Any:
    """Return the index in a stencil of the place at the offset (row, place) from its centre."""
    return 3 * (offset[0] + 1) + offset[1] + 1


def inverses(matrices: Floats) -> Floats:
    """Return the inverses of matrices, (..., 2, 2); zero for singular ones."""
    (a, b), (c, d) = np.moveaxis(matrices, (-2, -1), (0, 1))
    determinant = a * d - b * c
    is_regular = np.abs(determinant) > SINGULAR * np.abs(matrices).max(axis=(-2, -1)) ** 2
    adjugate = np.moveaxis(np.array([[d, -b], [-c, a]]), (0, 1), (-2, -1))
    factor = np.where(is_regular, 1.0 / np.where(is_regular, determinant, 1.0), 0.0)
    return np.asarray(factor[..., None, None] * adjugate)


Held = NDArray[np.bool_]
"""Mask of constrained components, (axis, row, place)."""


def held_components(scene: Scene, step: int, rows: Rows = ALL) -> Held | None:
    """Return the components constrained in a step; None if no particle is guided."""
    guided, grid = guided_at(scene.raster, scene.leading, step), PrimitiveRaster.of(scene)
    if grid is None or not rows.communicator.any(len(guided.place) > 0):
        return None
    components = np.zeros((2, *grid.shape), bool)
    components.reshape(2, -1)[:, grid.places(guided.place)] = guided.lead_axes
    for unknown in outside(rows.known, grid.shape[0]):
        components[:, unknown] = False
    return components


def constrained(matrix: StencilMatrix, held: Held | None) -> StencilMatrix:
    """Return the matrix with constrained components."""
    if held is None:
        return matrix
    code, stencils, of = with_held(matrix.code, matrix.stencils, held)
    scale = matrix.scale[of].copy()
    is_affected = code >= len(matrix.stencils)
    held_rows = held[:, is_affected]
    blocks = scale[code[is_affected]].reshape(-1, 2, 2)
    for axis, alone in enumerate(held_rows):
        blocks[alone, axis] = blocks[alone, :, axis] = 0.0
    scale[code[is_affected]] = blocks.reshape(-1, 4)
    return replace(matrix, code=code, stencils=stencils, scale=scale, held=held)


def with_held(
    code: NDArray[np.int32], stencils: Floats, held: Held
) -> tuple[NDArray[np.int32], Floats, NDArray[np.intp]]:
    """Return code and stencils, and for each stencil the index of the stencil that it replaces.
    Places adjacent to constrained components get separate stencils, in which the columns of those
    components are empty. The row of a constrained component has only a diagonal entry."""
    from scipy.ndimage import binary_dilation

    is_adjacent = binary_dilation(held.any(axis=0), structure=np.ones((3, 3))) & (code >= 0)
    row, place = np.nonzero(is_adjacent)
    rows = stencils[code[is_adjacent]].reshape(-1, 9, 2, 2).copy()
    magnitude = np.abs(rows[:, OWN]).max(axis=(1, 2))
    for s in range(9):
        held_neighbours = held[:, row + s // 3 - 1, place + s % 3 - 1]
        rows[:, s] *= ~held_neighbours.T[:, None, :]
    held_here = held[:, row, place].T
    rows *= ~held_here[:, None, :, None]
    rows[:, OWN] += (held_here * magnitude[:, None])[:, :, None] * np.eye(2)
    codes = code.copy()
    codes[is_adjacent] = len(stencils) + np.arange(len(row))
    of = np.concatenate([np.arange(len(stencils)), code[is_adjacent]])
    return codes, np.concatenate([stencils, rows.reshape(-1, 9, 4)]), of


def without_held(code: NDArray[np.int32], stencils: Floats, held: Held) -> Floats:
    """Return the stencils with empty rows for constrained components."""
    free_stencils = stencils.copy()
    for axis, component in enumerate(held):
        free_stencils[code[component], OWN, 3 * axis] = 0.0
    return free_stencils


def coarser_held(kind: NDArray[np.int8], held: Held, halved: tuple[int, int], below: Any) -> Held:
    """Return the constrained components on the next coarser grid. `below` contains the kinds of the
    places of the coarser grid. Each of these places coincides with a place of this grid, and the
    same components are constrained at both."""
    coarse = np.zeros((2, *below.shape), bool)
    for axis, component in enumerate(held):
        kinds, out = np.where(component, LED, kind).astype(np.int8), np.zeros_like(below)
        kernels().coarse_kinds(kinds, halved, out)
        coarse[axis] = (out == LED) & (below == FREE)
    return coarse


EXACT = 1e-9
"""Relative difference up to which a matrix that is computed from derivatives counts as
symmetric."""
DIFFERENCED = 1e-5
"""Relative difference up to which a matrix that is computed by differences of moves counts as
symmetric."""
DIGITS = 13
"""Number of digits of row factors; further digits are rounding errors."""


def is_symmetric(matrix: StencilMatrix, alike: float = EXACT, rows: Rows = ALL) -> bool:
    """Return whether a matrix is symmetric, up to a tolerance relative to its largest entry."""
    magnitude = max(float(matrix.stencils.max()), -float(matrix.stencils.min()))
    largest = rows.communicator.largest(magnitude)
    asymmetry = kernels().asymmetry(matrix.code, matrix.stencils)
    return rows.communicator.largest(asymmetry) <= alike * largest


def balanced(
    matrix: StencilMatrix, alike: float = EXACT, rows: Rows = ALL
) -> tuple[StencilMatrix, bool]:
    """Return the matrix with rows scaled such that it is symmetric, and whether that is possible.

    A particle with fewer neighbours has larger weights, so that its row has to be scaled. If K was
    computed by differences, it is then replaced by the mean of K and Kᵀ.
    """
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
    symmetric = replace(matrix, code=code, stencils=stencils, scale=scale)
    if not is_symmetric(symmetric, alike, rows):
        return matrix, False
    if alike > EXACT:
        kernels().symmetrise(code, stencils)
    return symmetric, True


def _factors(matrix: StencilMatrix, rows: Rows) -> Floats | None:
    """Return the factors of rows, 1 for the most frequent stencil; None if a row has no factor."""
    factor = (matrix.code == 0).astype(float)
    while True:
        missing, missing_before = kernels().balance(matrix.code, matrix.stencils, factor)
        if not rows.communicator.any(missing < missing_before):
            return None if rows.communicator.any(missing > 0) else factor
        exchanged = factor.copy()
        rows.exchange_halo(exchanged)
        np.copyto(factor, exchanged, where=exchanged > 0.0)


def transposed(matrix: StencilMatrix) -> StencilMatrix:
    """Return Kᵀ. A place keeps the most frequent stencil only if it and all its neighbours have it;
    all other places get separate stencils. `scale` is the scale of K."""
    code, (row, place) = matrix.code, np.nonzero(matrix.code >= 0)
    neighbours = np.stack(
        [code[row + s // 3 - 1, place + s % 3 - 1] for s in range(WINDOW)], axis=1
    )
    is_uniform = (neighbours == 0).all(axis=1)
    codes = code.copy()
    codes[row, place] = np.where(is_uniform, 0, np.cumsum(~is_uniform))
    distinct = np.concatenate([np.zeros((1, WINDOW), neighbours.dtype), neighbours[~is_uniform]])
    stencils = matrix.stencils[np.maximum(distinct, 0), WINDOW - 1 - np.arange(WINDOW)][
        ..., [0, 2, 1, 3]
    ]
    stencils *= (distinct >= 0)[..., None]
    scale = matrix.scale[np.maximum(distinct[:, OWN], 0)]
    return replace(matrix, code=codes, stencils=np.ascontiguousarray(stencils), scale=scale)


def leads_one_way(matrix: StencilMatrix, rows: Rows = ALL) -> bool:
    """Return whether one axis depends on the other but not the reverse. It is then better to solve
    for the axes one after the other."""
    couplings = matrix.stencils[..., 1], matrix.stencils[..., 2]
    return len({rows.communicator.any(bool(coupling.any())) for coupling in couplings}) > 1


def is_held(matrix: StencilMatrix, held: NDArray[np.bool_] | None = None, rows: Rows = ALL) -> bool:
    """Return whether the body is held and has no crack. The body is held if, along each axis, every
    connected part is adjacent to a leader or contains `held` components. It has no crack if any two
    adjacent particles are bonded or have a common neighbour."""
    from scipy.ndimage import binary_dilation, label

    bonds = np.logical_or.reduce([matrix.stencils[..., e] != 0.0 for e in range(4)])
    pattern_entries = np.logical_or.reduce(rows.communicator.allgather(bonds.any(axis=0)))
    entries, places = np.flatnonzero(pattern_entries).tolist(), np.nonzero(matrix.code > 0)
    if rows.communicator.any(any(_apart(matrix, bonds, places, s) for s in entries)):
        return False
    pattern = (pattern_entries | pattern_entries[::-1]).reshape(3, 3)
    parts, count = label(matrix.kind == FREE, structure=pattern)
    near_leader = binary_dilation(matrix.kind == LED, structure=pattern)
    supports = [near_leader] if held is None else [near_leader | component for component in held]
    return all(_reached(parts, count, is_support, rows) for is_support in supports)


def _reached(parts: Any, count: int, led: Any, rows: Rows) -> bool:
    """Return whether all parts contain leaders. Parts are connected across the rows of all
    processes."""
    while True:
        reached = np.zeros(count + 1, bool)
        reached[parts[led]] = True
        reached[0] = False
        if not rows.communicator.any(not reached[1:].all()):
            return True
        reached_places = reached[parts]
        extended = reached_places.copy()
        rows.exchange_halo(extended)
        if not rows.communicator.any(bool((extended > reached_places).any())):
            return not rows.communicator.any(bool((reached_places < (parts > 0))[rows.own].any()))
        led = reached_places | extended


def _apart(
    matrix: StencilMatrix, bonds: NDArray[np.bool_], places: tuple[Indices, ...], s: int
) -> bool:
    """Return whether some particle with a separate stencil is separated from its neighbour at place
    s of the stencil. Two particles are separated if they are neither bonded nor bonded to a common
    neighbour."""
    row, place = places
    down, along = s // 3 - 1, s % 3 - 1
    is_present = matrix.kind[row + down, place + along] != OUTSIDE
    pairs = np.flatnonzero(is_present & ~bonds[matrix.code[row, place], s])
    if not len(pairs):
        return False
    first = matrix.code[row[pairs], place[pairs]]
    second = matrix.code[row[pairs] + down, place[pairs] + along]
    linked = second < 0  # A leader cannot be separated, as its position is prescribed.
    for t in range(9):
        a, b = t // 3 - 1 - down, t % 3 - 1 - along
        if max(abs(a), abs(b)) <= 1:
            linked |= bonds[first, t] & bonds[second, 3 * (a + 1) + b + 1]
    return not linked.all()
