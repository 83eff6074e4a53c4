"""The linear system of an equilibrium before obstacles: an active set.

A step puts followers at y = u + move, and those that would enter an obstacle at the place x nearest
to y that is free, in the metric S of the particle (stepping/contact.py). T = ∂x/∂y is 1 for a
particle that is free, 0 for one that is held where faces meet, and

    T = t tᵀ S / (t·S t - κ n·S (x - y))

for one on a single face with the normal n, the tangent t and the curvature κ. The linearisation is

    Ã = 1 - T (1 - A),  A that of the body alone,

so that a correction keeps particles that are held on the outline, free along it: the step of a
semi-smooth Newton iteration (Hintermüller, Ito, Kunisch), which changes the set until it stays.
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
    DriftingError,
    SingularSubsystem,
    Subsystem,
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
"""The stiffness of springs to where particles are, as a share of that of their neighbours."""
NO_FACE = -1
"""Number of a face where a particle is on none."""
REMEDY = "let a leader hold it, or take solver: {type: stepping}"


class ContactSystem(System):
    """The system at a state, with those held who would enter an obstacle from there."""

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
        there = state.u + moves.free(state, moment)
        self.held, turned = hold(moves.contact, scene, there, self._place, moment)
        self._matrix = matrix = _contacting(free, turned)
        led = operator.couplings_leader.entries()
        held = np.repeat(self.held[:, 0] != NO_FACE, scene.axes)
        self._on_outlines, self._spreads = held.copy(), dict[int, float]()
        size = float(np.abs(state.u).max())
        self._share_of_places = size / max(size, moves.contact.reach)
        held[led.rows[led.values != 0.0]] = True
        held[operator.prescribed_unknowns] = True
        self._parts = self._split(matrix, held)

    def _split(self, matrix: Any, held: NDArray[np.bool_]) -> list[tuple[Indices, Subsystem]]:
        """What leaders or obstacles hold together, and each part that nothing holds by itself."""
        count, label = connected(matrix, strongly=False)
        is_held = np.bincount(label, held, count) > 0.0
        groups = [np.flatnonzero(is_held[label])] if held.any() else []
        groups += [np.flatnonzero(label == n) for n in np.flatnonzero(~is_held)]
        return [(some, self._part(matrix, some, bool(is_held[label[some[0]]]))) for some in groups]

    def _part(self, matrix: Any, some: Indices, held: bool) -> Subsystem:
        """Held parts have an inverse, unless they are left some freedom: then they float."""
        own = matrix if len(some) == matrix.shape[0] else matrix[some][:, some]
        if held:
            coordinates = Coordinates(2, self._X[some[::2] // 2], self._led)
            with suppress(np.linalg.LinAlgError):
                return ConstrainedSubsystem(own, self._method, coordinates, self._watch)
        return SingularSubsystem(own, None, self._watch)

    @property
    def methods(self) -> str:
        """The names of the methods used."""
        return ", ".join(sorted({part.name for _, part in self._parts})) or "nothing to solve"

    @property
    def how(self) -> str:
        """By the solution; its rounding by the inverse itself where that is at hand."""
        ways = {part.how for _, part in self._parts}
        return next((way for way in ("solution", "inverse") if way in ways), "nothing to solve")

    @property
    def iterations(self) -> int:
        """Of all linear solvers together."""
        return sum(part.iterations for _, part in self._parts)

    @property
    def amplification(self) -> float:
        """By the largest entry of the diagonal."""
        return self._amplification

    def _table(self, planes: Floats) -> Floats:
        """(unknown,) of planes."""
        return planes.reshape(len(planes), -1)[:, self._place].T.ravel()

    def _planes(self, table: Floats) -> Floats:
        """Planes of (unknown,)."""
        planes = np.zeros(self._shape)
        planes.reshape(len(planes), -1)[:, self._place] = table.reshape(-1, len(planes)).T
        return planes

    def solve(
        self, moves: Floats, tolerance: float, owed: State | None = None, rounding: float = 0.0
    ) -> Floats:
        """Subsystem by part."""
        r = self._table(moves)
        x = np.zeros_like(r)
        for some, part in self._parts:
            try:
                x[some] = part.solve(r[some], None, rounding)
            except DriftingError:
                raise NoEquilibriumError(
                    f"there is no equilibrium: neither leaders nor obstacles hold a part of "
                    f"{self._named(some)}, and it is pushed on for ever; {REMEDY}",
                    ("obstacles",),
                ) from None
        return self._planes(x)

    def answer(self, moves: Floats, share: float, near: Sequence[Floats] = ()) -> Floats:
        """By `solve`, which knows no tolerance."""
        return self.solve(moves, 0.0, rounding=PUSH * float(np.abs(moves).max(initial=0.0)))

    def pushed_by(self, led: Floats) -> None:
        """Unknown."""

    def solve_transposed(self, weights: Floats, share: float) -> Floats:
        """Subsystem by part."""
        b = self._table(weights)
        found = np.zeros_like(b)
        for some, part in self._parts:
            found[some] = part.solve_transposed(b[some])
        return self._planes(found)

    def mismatch(self, c: Floats, before: Floats, after: Floats) -> float:
        """Nothing is linear where particles come to rest on obstacles."""
        return math.inf

    def distance(self, moves: Floats, rounding: float) -> float:
        """Solves once more for what is left of the moves, and adds what rounding may make of it:
        that of displacements for all followers, that of places for those that are held."""
        r, far = self._table(moves), [0.0]
        for n, (some, part) in enumerate(self._parts):
            far.append(part.farthest(r[some], rounding * self._share_of_places))
            if rounding and self._on_outlines[some].any():
                far[-1] += self._spread(n) * rounding
        return math.sqrt(2.0) * max(far)

    def _spread(self, n: int) -> float:
        """How far rounding of the places of particles that are held takes a part."""
        if n not in self._spreads:
            some, part = self._parts[n]
            self._spreads[n] = part.spread_of(self._on_outlines[some])
        return self._spreads[n]

    def refuse_moving_floats(self, moves: Floats, rounding: float) -> None:
        """Looks at each part by itself."""
        r = self._table(moves)
        for some in self._floats:
            if np.abs(r[some]).max(initial=0.0) > 8 * rounding:
                raise self._not_unique(some)

    def refuse_floats(self) -> None:
        """Raises ExperimentError where anything floats."""
        for some in self._floats:
            raise self._not_unique(some)

    def is_loose(self, moves: Floats, rounding: float) -> bool:
        """Whether a part that nothing holds yet has moves left."""
        r = self._table(moves)
        return any(np.abs(r[some]).max(initial=0.0) > 8 * rounding for some in self._floats)

    def of_held(self, moves: Floats) -> Floats:
        """The moves of followers that obstacles hold alone."""
        return self._planes(np.where(self._on_outlines, self._table(moves), 0.0))

    def solve_loose(self, moves: Floats, most: float) -> Floats:
        """A correction, as far as `most`, where weak springs hold what nothing else does: it leads
        to where obstacles may."""
        matrix = self._matrix + WEAK * _one(self._matrix)
        coordinates = Coordinates(2, self._X, self._led)
        found = ConstrainedSubsystem(matrix, "lu", coordinates, self._watch).solve(
            self._table(moves)
        )
        found *= min(1.0, most / np.abs(found).max())
        return self._planes(found)

    @property
    def _floats(self) -> list[Indices]:
        return [some for some, part in self._parts if isinstance(part, SingularSubsystem)]

    def _not_unique(self, some: Indices) -> NoEquilibriumError:
        return NoEquilibriumError(
            "there is no unique equilibrium: leaders and obstacles leave a part of "
            f"{self._named(some)} free to slide or turn; {REMEDY}",
            ("obstacles",),
        )

    def is_stable(self) -> bool:
        """Subsystem by part."""
        return all(part.is_stable() for _, part in self._parts)

    def _named(self, unknowns: Indices) -> str:
        numbers = np.unique(self._followers[unknowns // 2]) + 1
        return f"{len(numbers)} particles (with number {numbers[0]})"


def hold(
    contact: Contact, scene: Scene, u: Floats, place: Indices, moment: float
) -> tuple[Indices, Floats]:
    """Return the faces on which obstacles put followers at some places from displacements u, or on
    which they lie, by number, (follower, 2): NO_FACE beyond those, and where there are more than
    two the first; and T of each, (follower, axis, axis)."""
    y, codes = contact.positions(u, place), contact.led(math.ceil(moment))
    led = np.zeros(len(place), np.int8) if codes is None else codes.ravel()[place]
    x = y + contact.ways(u, place, moment)
    C = contact.compliance_at(place)
    S = np.array([[C[2], -C[1]], [-C[1], C[0]]])
    count, faces = np.zeros(len(place), np.intp), np.full((len(place), 2), NO_FACE)
    turned, number = np.tile(np.eye(2), (len(place), 1, 1)), 0
    free = np.array([(led & 1) == 0, (led & 2) == 0])
    for _, outline in outlines_at(scene.barriers, moment):
        digits = ROUNDING * (np.abs(x).sum(axis=0) + outline.size)
        for face in outline.faces(*x):
            on = face.distance <= digits
            stops = on & (np.where(free, np.abs(face.normal), 0.0).max(axis=0) > math.sqrt(FLAT))
            first = stops & (count == 0)
            turned[first] = _along(face, S, x - y)[first]
            turned[stops & ((count > 0) | (led > 0))] = 0.0
            for n in range(2):
                faces[stops & (count == n), n] = number
            count, number = count + stops, number + 1
    return faces, np.where(free.T[:, :, None], turned, 0.0)


def _along(face: Face, S: Floats, way: Floats) -> Floats:
    """T of particles that are held on a face, (follower, axis, axis)."""
    n = face.normal
    t = np.stack([-n[1], n[0]])
    along = np.einsum("abe,be->ae", S, t)
    straight = (t * along).sum(axis=0)
    bent = straight - face.curvature * np.einsum("ae,abe,be->e", n, S, way)
    bent = np.where(bent > STRAIGHTEST * straight, bent, straight)
    return np.asarray(np.einsum("ae,be->eab", t, along / bent))


def _contacting(free: Any, turned: Floats) -> Any:
    """1 - T (1 - A)."""
    from scipy.sparse import bsr_array

    rows = np.arange(len(turned) + 1)
    T, one = bsr_array((turned, rows[:-1], rows), shape=free.shape).tocsr(), _one(free)
    return one - T @ (one - free)


def _one(like: Any) -> Any:
    """The identity as a matrix of the same kind and size."""
    from scipy.sparse import eye_array

    size = like.shape[0]
    return np.eye(size) if isinstance(like, np.ndarray) else eye_array(size, format="csr")
