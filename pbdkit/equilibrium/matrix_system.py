"""The linear system of an equilibrium as a sparse matrix, taken apart.

Where x and y do not move each other there are two systems, often equal; where one moves the other
only (mixed coordinates), it is solved first. Parts of the body that nothing holds are told apart.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.couplings import connected, identity_like, one_minus
from pbdkit.analysis.operator import step_operator
from pbdkit.equilibrium.linear_solver import Ground
from pbdkit.equilibrium.stage import Stage
from pbdkit.equilibrium.system import PUSH, NoEquilibriumError, System
from pbdkit.equilibrium.system_parts import DriftingError, Floating, Held, Part, TooSoftError
from pbdkit.results.progress import Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.intp]
DRIFTS = (
    "there is no equilibrium: nothing holds a part of {}, and it is pushed on for ever; let a "
    "leader hold it"
)
SOFT = (
    "double precision does not tell what holds a part of {}: it turns about a single particle, is "
    "too slender, or held by too soft a region; let leaders hold more of it, or take stiffer "
    "regions or fewer particles"
)


class MatrixSystem(System):
    """The system by one of the solver's methods, direct or iterative; with `damping` that of an
    implicit step, (A + damping) c = move."""

    def __init__(
        self,
        scene: Scene,
        state: State,
        method: str,
        watch: Watch,
        step: int | None = None,
        damping: float = 0.0,
    ) -> None:
        self._damping = damping
        self._shape, self._amplification = state.u.shape, 1.0
        self._operator = operator = step_operator(scene, state, step)
        self._method, self._watch = method, watch
        self._X = scene.raster.reference(operator.followers)
        self._led = scene.raster.reference(operator.leaders)
        self._place = scene.raster.place_of(operator.followers)
        self._guided = np.zeros((len(operator.followers), scene.axes), bool)
        self._guided.ravel()[operator.held] = True
        self._both = both = operator.couplings_both
        first = 1 if both.couples(0, 1) else 0
        self._stages = [] if both.couples(first, 1 - first) else [self._stage([first])]
        # One axis has a share in the invariants of the other, where it moves it.
        parts = [part for stage in self._stages for _, part in stage.parts]
        floats = any(isinstance(part, Floating) for part in parts)
        if not self._stages or (floats and both.couples(1 - first, first)):
            self._stages = [self._stage([0, 1])]
        else:
            self._stages.append(self._following(first))

    @property
    def amplification(self) -> float:
        """By the largest entry of the diagonal."""
        return self._amplification

    @property
    def methods(self) -> str:
        """The names of the methods used."""
        names = {part.name for stage in self._stages for _, part in stage.parts}
        return ", ".join(sorted(names)) or "nothing to solve"

    @property
    def how(self) -> str:
        """By the solution; its rounding by the inverse itself where that is at hand."""
        if self._damping:
            return "damped"
        ways = {part.how for stage in self._stages for _, part in stage.parts}
        return next((way for way in ("solution", "inverse") if way in ways), "nothing to solve")

    @property
    def iterations(self) -> int:
        """Of all linear solvers together."""
        parts = {id(part): part for stage in self._stages for _, part in stage.parts}
        return sum(part.iterations for part in parts.values())

    def _table(self, planes: Floats) -> Floats:
        """(follower, axis) of planes."""
        return planes.reshape(len(planes), -1)[:, self._place].T

    def _planes(self, table: Floats) -> Floats:
        """Planes of (follower, axis)."""
        planes = np.zeros(self._shape)
        planes.reshape(len(planes), -1)[:, self._place] = table.T
        return planes

    def refuse_moving_floats(self, moves: Floats, rounding: float) -> None:
        """Looks at each part by itself."""
        table = self._table(moves)
        for stage in self._stages:
            for unknowns, part in stage.parts:
                r = table[:, stage.axes].ravel()[unknowns]
                if isinstance(part, Floating) and np.abs(r).max(initial=0.0) > 8 * rounding:
                    raise NoEquilibriumError(
                        "there is no unique equilibrium: leaders do not hold a part of "
                        f"{self._named(stage, unknowns)}; let one hold it, or take solver: "
                        "{type: stepping}",
                        ("leaders",),
                    )

    @property
    def is_stuck(self) -> bool:
        """Part by part."""
        return any(part.is_stuck for stage in self._stages for _, part in stage.parts)

    def solve(
        self, moves: Floats, tolerance: float, owed: State | None = None, rounding: float = 0.0
    ) -> Floats:
        """Stage by stage, part by part."""
        back = None if owed is None else self._owed(owed)
        return self._planes(self._solved(self._table(moves), back, rounding))

    def _solved(self, moves: Floats, owed: Floats | None, rounding: float) -> Floats:
        found = np.zeros_like(moves)
        for stage in self._stages:
            r = moves[:, stage.axes].ravel()
            if stage.into is not None:
                r = r + stage.into @ found[:, 1 - stage.axes[0]]
            back = None if owed is None else owed[:, stage.axes].ravel()
            x = np.zeros_like(r)
            for some, part in stage.parts:
                try:
                    own = None if back is None else back[some]
                    x[some] = part.solve(r[some], own, rounding)
                except DriftingError as error:
                    soft = isinstance(error, TooSoftError) or (
                        part.is_soft and self._is_fixed(stage.axes, some)
                    )
                    text = SOFT if soft else DRIFTS
                    named = self._named(stage, some)
                    raise NoEquilibriumError(text.format(named), ("leaders",)) from None
            found[:, stage.axes] = x.reshape(-1, len(stage.axes))
        return found

    def answer(self, moves: Floats, share: float, near: Sequence[Floats] = ()) -> Floats:
        """By `solve`, which knows no tolerance."""
        return self.solve(moves, 0.0, rounding=PUSH * float(np.abs(moves).max(initial=0.0)))

    def pushed_by(self, led: Floats) -> None:
        """Unknown."""

    def solve_transposed(self, weights: Floats, share: float) -> Floats:
        """The last stage first."""
        table = self._table(weights)
        found = np.zeros_like(table)
        for stage in reversed(self._stages):
            b = table[:, stage.axes].ravel()
            x = np.zeros_like(b)
            for some, part in stage.parts:
                x[some] = part.solve_transposed(b[some])
            found[:, stage.axes] = x.reshape(-1, len(stage.axes))
            if stage.into is not None:
                table[:, 1 - stage.axes[0]] += stage.into.T @ x
        found[self._guided] = 0.0
        return self._planes(found)

    def _owed(self, state: State) -> Floats | None:
        """What followers have yet to get, (follower, axis), where the step looks back:
        before · (u(t-1) - u(t)), None elsewhere."""
        if not self._operator.couplings_before.parts:
            return None
        u, previous = self._table(state.u), self._table(state.previous)
        return self._operator.couplings_before.times((previous - u).astype(float))

    def mismatch(self, c: Floats, before: Floats, after: Floats) -> float:
        """By the operator."""
        table = self._table(c)
        with np.errstate(all="ignore"):
            pull = table - self._both.times(table)
            left = pull + self._table(after) - self._table(before)
            return float(np.linalg.norm(left) / np.linalg.norm(pull))

    def distance(self, moves: Floats, rounding: float) -> float:
        """Solves once more for what is left of the moves, and adds what rounding may make of it."""
        table, bounds = self._table(moves), np.zeros(2)
        for stage in self._stages:
            r = table[:, stage.axes].ravel()
            unsure = np.full(len(r), rounding)
            if stage.into is not None:
                unsure += abs(stage.into).sum(axis=1) * bounds[1 - stage.axes[0]]
            far = (
                part.farthest(r[some], float(unsure[some].max(initial=0.0)))
                for some, part in stage.parts
            )
            bounds[stage.axes] = max(far, default=0.0)
        return math.hypot(*bounds)

    def is_stable(self) -> bool:
        """Part by part."""
        return all(part.is_stable() for stage in self._stages for _, part in stage.parts)

    def _named(self, stage: Stage, unknowns: Indices) -> str:
        numbers = np.unique(self._operator.followers[unknowns // len(stage.axes)]) + 1
        return f"{len(numbers)} particles (with number {numbers[0]})"

    def _following(self, first: int) -> Stage:
        """The stage of the other axis; it shares the solvers of the first where both are alike."""
        other, led = 1 - first, self._operator.couplings_led
        coupled = self._both.couples(other, first)
        into = self._both.entries([other], [first]).matrix() if coupled else None
        if self._both.is_isotropic() and led.is_isotropic():
            return Stage([other], self._stages[0].parts, into)
        stage = self._stage([other])
        stage.into = into
        return stage

    def _stage(self, axes: list[int]) -> Stage:
        matrix = one_minus(self._both.entries(axes).matrix())
        if self._damping:
            matrix = matrix + self._damping * identity_like(matrix)
        largest = float(np.abs(matrix.diagonal()).max(initial=0.0))
        self._amplification = max(self._amplification, largest)
        led = self._operator.couplings_led.entries(axes)
        count, label = connected(matrix, strongly=False)
        guided, alone = self._guided[:, axes].ravel(), np.zeros(count, bool)
        # A component that leads stands alone: it goes with its particle, or is left out.
        alone[label[guided]] = True
        if len(axes) > 1:
            label = np.where(guided, label.reshape(-1, 2)[:, ::-1].ravel(), label)
        held = np.zeros(count, bool)
        held[label[led.rows[led.values != 0.0]]] = True
        # What leaders move directly or not is solved together, each part that floats by itself.
        groups = [np.flatnonzero((held & ~alone)[label])] if held.any() else []
        stage = Stage(axes, [])
        for some in groups + [np.flatnonzero(label == n) for n in np.flatnonzero(~held & ~alone)]:
            part = self._part(_within(matrix, some), axes, some, bool(held[label[some[0]]]))
            stage.parts.append((some, part))
        return stage

    def _part(self, matrix: Any, axes: list[int], some: Indices, held: bool) -> Part:
        """Held parts have an inverse, unless leaders leave them some freedom: then they float."""
        if held:
            ground = self._ground(axes, some)
            with suppress(np.linalg.LinAlgError):
                return Held(matrix, self._method, ground, self._watch)
        before = self._operator.couplings_before
        back = _within(before.entries(axes).matrix(), some) if before.parts else None
        return Floating(matrix, back, self._watch)

    def _is_fixed(self, axes: list[int], some: Indices) -> bool:
        """Whether what leads, led components and leaders beside these unknowns, leaves them no
        motion as a whole: along the axes and, of two, a turn."""
        led = self._operator.couplings_led.entries(axes)
        beside = np.isin(led.rows, some) & (led.values != 0.0)
        leaders, count = np.unique(led.columns[beside]), len(axes)
        own = some[self._guided[:, axes].ravel()[some]]
        at = np.concatenate([self._led[leaders // count], self._X[own // count]])
        along = np.concatenate([leaders, own]) % count
        if not len(at):
            return False
        motions = np.eye(count)[along]
        if count > 1:
            x, y = (at - at[0]).T / (float(np.ptp(at, axis=0).max()) or 1.0)
            motions = np.column_stack([motions, np.where(along == 0, -y, x)])
        return bool(np.linalg.matrix_rank(motions) == motions.shape[1])

    def _ground(self, axes: list[int], some: Indices) -> Ground:
        """Where these unknowns lie; who leads along the one axis asked for is a leader."""
        where, held = some[:: len(axes)] // len(axes), self._guided[:, axes]
        led = self._X[held[:, 0]] if len(axes) == 1 else self._X[:0]
        guided = held[where].ravel() if len(axes) > 1 and held.any() else None
        return Ground(len(axes), self._X[where], np.concatenate([self._led, led]), guided)


def _within(matrix: Any, unknowns: Indices) -> Any:
    return matrix if len(unknowns) == matrix.shape[0] else matrix[unknowns][:, unknowns]
