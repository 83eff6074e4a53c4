"""Linear system of an equilibrium in contact with obstacles, by an active set.

A step displaces followers to y = u + move. A follower with y inside an obstacle is projected onto
x, the nearest point outside in the metric S of the particle (stepping/contact.py). The derivative T
= ∂x/∂y is 1 for a free particle, 0 for a particle at a corner where faces meet, and

    T = t tᵀ S / (t·S t - κ n·S (x - y))

for a particle on a single face with the normal n, the tangent t and the curvature κ. The
linearisation is

    Ã = 1 - T (1 - A), with the matrix A of the body alone,

so that a correction moves a particle in contact only along the outline of the obstacle. This is a
semi-smooth Newton iteration (Hintermüller, Ito and Kunisch, SIAM J. Optim. 13, 2002). It ends when
the active set, the set of particles in contact, no longer changes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats, Indices
from pbdkit.equilibrium.linear_solver import Coordinates
from pbdkit.equilibrium.sparse import (
    ConstrainedSubsystem,
    SingularSubsystem,
    Subsystem,
    UnbalancedLoadError,
)
from pbdkit.equilibrium.system import PUSH, Moves, NoEquilibriumError, System
from pbdkit.linear.block_matrix import connected, one_minus
from pbdkit.linear.operator import step_operator
from pbdkit.progress import Watch
from pbdkit.scene.obstacles import FLAT, ROUNDING, STRAIGHTEST, Face, outlines_at
from pbdkit.scene.scene import Scene
from pbdkit.stepping.contact import Contact
from pbdkit.stepping.state import State

WEAK = 1e-6
"""Stiffness of the weak springs that hold particles at their current positions, relative to the
stiffness of the bonds of a particle."""
NO_FACE = -1
"""Index of a missing face."""
REMEDY = "constrain it with a leader group, or use solver: {type: stepping}"
"""Remedy for a part that no leader holds."""


class ContactSystem(System):
    """Linear system at a state. Particles that the next step would move into an obstacle are
    constrained."""

    def __init__(
        self, scene: Scene, state: State, moment: float, method: str, watch: Watch, moves: Moves
    ) -> None:
        operator = step_operator(scene, state, math.ceil(moment))
        self._shape, self._followers = state.u.shape, operator.followers
        self._place = scene.raster.place_of(operator.followers)
        self._method, self._watch = method, watch
        self._X = scene.raster.reference(operator.followers)
        self._led = scene.raster.reference(operator.leaders)
        free = one_minus(operator.couplings_steady.entries().matrix())
        self._amplification = float(np.abs(free.diagonal()).max(initial=1.0))
        assert moves.contact
        targets = state.u + moves.free(state, moment)
        self.held, turned = hold(moves.contact, scene, targets, self._place, moment)
        self._matrix = matrix = _contacting(free, turned)
        leader_entries = operator.couplings_leader.entries()
        is_fixed = np.repeat(self.held[:, 0] != NO_FACE, scene.axes)
        self._on_outlines, self._spreads = is_fixed.copy(), dict[int, float]()
        size = float(np.abs(state.u).max())
        self._share_of_places = size / max(size, moves.contact.reach)
        is_fixed[leader_entries.rows[leader_entries.values != 0.0]] = True
        is_fixed[operator.prescribed_unknowns] = True
        self._parts = self._split(matrix, is_fixed)

    def _split(self, matrix: Any, held: NDArray[np.bool_]) -> list[tuple[Indices, Subsystem]]:
        """Divide the unknowns into those that leaders or obstacles hold, and the floating parts."""
        count, label = connected(matrix, strongly=False)
        is_held = np.bincount(label, held, count) > 0.0
        groups = [np.flatnonzero(is_held[label])] if held.any() else []
        groups += [np.flatnonzero(label == n) for n in np.flatnonzero(~is_held)]
        return [
            (members, self._part(matrix, members, bool(is_held[label[members[0]]])))
            for members in groups
        ]

    def _part(self, matrix: Any, members: Indices, held: bool) -> Subsystem:
        """Return the system of a part. The matrix of a held part can be inverted. A part that is
        held but nevertheless has a free motion is treated like a floating part."""
        part_matrix = matrix if len(members) == matrix.shape[0] else matrix[members][:, members]
        if held:
            coordinates = Coordinates(2, self._X[members[::2] // 2], self._led)
            with suppress(np.linalg.LinAlgError):
                return ConstrainedSubsystem(part_matrix, self._method, coordinates, self._watch)
        return SingularSubsystem(part_matrix, None, self._watch)

    @property
    def methods(self) -> str:
        """Names of the methods used."""
        return ", ".join(sorted({part.name for _, part in self._parts})) or "nothing to solve"

    @property
    def bound_kind(self) -> str:
        """Kind of the bound: computed from the inverse matrices or, if the inverse of some part is
        not available, from a solution."""
        kinds = {part.bound_kind for _, part in self._parts}
        return next((kind for kind in ("solution", "inverse") if kind in kinds), "nothing to solve")

    @property
    def iterations(self) -> int:
        """Number of iterations of all linear solvers."""
        return sum(part.iterations for _, part in self._parts)

    @property
    def amplification(self) -> float:
        """Largest entry of the diagonal."""
        return self._amplification

    def _table(self, planes: Floats) -> Floats:
        """Return planes as a vector, (unknown,)."""
        return planes.reshape(len(planes), -1)[:, self._place].T.ravel()

    def _planes(self, table: Floats) -> Floats:
        """Return a vector of shape (unknown,) as planes."""
        planes = np.zeros(self._shape)
        planes.reshape(len(planes), -1)[:, self._place] = table.reshape(-1, len(planes)).T
        return planes

    def solve(
        self,
        moves: Floats,
        tolerance: float,
        invariant_state: State | None = None,
        rounding: float = 0.0,
    ) -> Floats:
        """Return the solution, computed part by part."""
        r = self._table(moves)
        x = np.zeros_like(r)
        for members, part in self._parts:
            try:
                x[members] = part.solve(r[members], None, rounding)
            except UnbalancedLoadError:
                raise NoEquilibriumError(
                    f"there is no equilibrium: a part of {self._named(members)} is loaded, but not "
                    f"constrained by leaders or obstacles; {REMEDY}",
                    ("obstacles",),
                ) from None
        return self._planes(x)

    def answer(self, moves: Floats, share: float, near: Sequence[Floats] = ()) -> Floats:
        """Return the solution of `solve`, which does not use a tolerance."""
        return self.solve(moves, 0.0, rounding=PUSH * float(np.abs(moves).max(initial=0.0)))

    def pushed_by(self, led: Floats) -> None:
        """Return None: leaders are not part of the matrix."""

    def solve_transposed(self, weights: Floats, share: float) -> Floats:
        """Solve the transposed system part by part."""
        b = self._table(weights)
        solution = np.zeros_like(b)
        for members, part in self._parts:
            solution[members] = part.solve_transposed(b[members])
        return self._planes(solution)

    def mismatch(self, c: Floats, before: Floats, after: Floats) -> float:
        """Return infinity: contact is not linear."""
        return math.inf

    def distance(self, moves: Floats, rounding: float) -> float:
        """Return the bound on the distance from equilibrium: the size of the solution with the
        remaining moves as right-hand side, plus the effect of rounding. Rounding affects the
        displacements of all followers, and also the positions of the followers in contact."""
        r, far = self._table(moves), [0.0]
        for n, (members, part) in enumerate(self._parts):
            far.append(part.farthest(r[members], rounding * self._share_of_places))
            if rounding and self._on_outlines[members].any():
                far[-1] += self._spread(n) * rounding
        return math.sqrt(2.0) * max(far)

    def _spread(self, n: int) -> float:
        """Return the displacement of a part caused by a rounding error of 1 in the positions of the
        particles in contact."""
        if n not in self._spreads:
            members, part = self._parts[n]
            self._spreads[n] = part.spread_of(self._on_outlines[members])
        return self._spreads[n]

    def refuse_moving_floats(self, moves: Floats, rounding: float) -> None:
        """Raise ExperimentError if the moves of a floating part exceed their rounding error."""
        r = self._table(moves)
        for members in self._floats:
            if np.abs(r[members]).max(initial=0.0) > 8 * rounding:
                raise self._not_unique(members)

    def refuse_floats(self) -> None:
        """Raise ExperimentError if a part floats."""
        for members in self._floats:
            raise self._not_unique(members)

    def is_loose(self, moves: Floats, rounding: float) -> bool:
        """Return whether particles of a floating part, which no leader or obstacle holds yet, still
        move."""
        r = self._table(moves)
        return any(np.abs(r[members]).max(initial=0.0) > 8 * rounding for members in self._floats)

    def of_held(self, moves: Floats) -> Floats:
        """Return the moves of followers in contact, zero elsewhere."""
        return self._planes(np.where(self._on_outlines, self._table(moves), 0.0))

    def solve_loose(self, moves: Floats, max_move: float) -> Floats:
        """Return a correction of at most `max_move`, computed with weak springs on all parts. It
        moves floating parts towards obstacles."""
        matrix = self._matrix + WEAK * _one(self._matrix)
        coordinates = Coordinates(2, self._X, self._led)
        correction = ConstrainedSubsystem(matrix, "lu", coordinates, self._watch).solve(
            self._table(moves)
        )
        correction *= min(1.0, max_move / np.abs(correction).max())
        return self._planes(correction)

    @property
    def _floats(self) -> list[Indices]:
        return [members for members, part in self._parts if isinstance(part, SingularSubsystem)]

    def _not_unique(self, members: Indices) -> NoEquilibriumError:
        return NoEquilibriumError(
            "there is no unique equilibrium: leaders and obstacles do not constrain the rigid-body "
            f"modes of a part of {self._named(members)}; {REMEDY}",
            ("obstacles",),
        )

    def is_stable(self) -> bool:
        """Return whether all parts are stable."""
        return all(part.is_stable() for _, part in self._parts)

    def _named(self, unknowns: Indices) -> str:
        numbers = np.unique(self._followers[unknowns // 2]) + 1
        return f"{len(numbers)} particles (with number {numbers[0]})"


def hold(
    contact: Contact, scene: Scene, u: Floats, place: Indices, moment: float
) -> tuple[Indices, Floats]:
    """Return the faces on which followers at flat places rest, and T of each follower.

    The followers rest at the positions to which a step moves them from the displacements u. The
    faces are an array (follower, 2) with NO_FACE for a missing face; if a follower rests on more
    than two faces, the first two are returned. T, the derivative ∂x/∂y of the projection, is
    (follower, axis, axis).
    """
    y, codes = contact.positions(u, place), contact.led(math.ceil(moment))
    roles = np.zeros(len(place), np.int8) if codes is None else codes.ravel()[place]
    x = y + contact.corrections(u, place, moment)
    C = contact.compliance_at(place)
    S = np.array([[C[2], -C[1]], [-C[1], C[0]]])
    count, faces = np.zeros(len(place), np.intp), np.full((len(place), 2), NO_FACE)
    turned, number = np.tile(np.eye(2), (len(place), 1, 1)), 0
    free = np.array([(roles & 1) == 0, (roles & 2) == 0])
    for _, outline in outlines_at(scene.barriers, moment):
        digits = ROUNDING * (np.abs(x).sum(axis=0) + outline.size)
        for face in outline.faces(*x):
            on = face.distance <= digits
            stops = on & (np.where(free, np.abs(face.normal), 0.0).max(axis=0) > math.sqrt(FLAT))
            first = stops & (count == 0)
            turned[first] = _along(face, S, x - y)[first]
            turned[stops & ((count > 0) | (roles > 0))] = 0.0
            for n in range(2):
                faces[stops & (count == n), n] = number
            count, number = count + stops, number + 1
    return faces, np.where(free.T[:, :, None], turned, 0.0)


def _along(face: Face, S: Floats, displacement: Floats) -> Floats:
    """Return T of particles on a face, (follower, axis, axis)."""
    n = face.normal
    t = np.stack([-n[1], n[0]])
    along = np.einsum("abe,be->ae", S, t)
    straight = (t * along).sum(axis=0)
    bent = straight - face.curvature * np.einsum("ae,abe,be->e", n, S, displacement)
    bent = np.where(bent > STRAIGHTEST * straight, bent, straight)
    return np.asarray(np.einsum("ae,be->eab", t, along / bent))


def _contacting(free: Any, turned: Floats) -> Any:
    """Return 1 - T (1 - A), the matrix of a body in contact."""
    from scipy.sparse import bsr_array

    rows = np.arange(len(turned) + 1)
    T, identity = bsr_array((turned, rows[:-1], rows), shape=free.shape).tocsr(), _one(free)
    return identity - T @ (identity - free)


def _one(like: Any) -> Any:
    """Return the identity of the same type and size as a matrix."""
    from scipy.sparse import eye_array

    size = like.shape[0]
    return np.eye(size) if isinstance(like, np.ndarray) else eye_array(size, format="csr")
