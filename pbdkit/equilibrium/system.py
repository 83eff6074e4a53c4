"""The linear system of an equilibrium, A c = move with A = 1 - (step operator), taken apart.

Where x and y do not move each other there are two systems, often equal; where one moves the other
only (mixed coordinates), it is solved first. Parts of the body that nothing holds are told apart.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.couplings import connected, one_minus
from pbdkit.analysis.operator import step_operator
from pbdkit.equilibrium.system_parts import DriftingError, Floating, Held, Part
from pbdkit.errors import ExperimentError
from pbdkit.results.progress import Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass
class _Stage:
    """The unknowns of one axis, or of both where they move each other, with their parts: who
    belongs to each. `into` is what the axis solved before adds to the moves."""

    axes: list[int]
    parts: list[tuple[Indices, Part]]
    into: Any = None


class System:
    """A c = move for the followers of a scene, linearised at a state with the roles of a step
    (default: the last), by one of the solver's methods; `place` is where they are on the flat
    raster."""

    def __init__(
        self, scene: Scene, state: State, method: str, watch: Watch, step: int | None = None
    ) -> None:
        self._operator = operator = step_operator(scene, state, step)
        self._method, self._watch = method, watch
        self._X = scene.raster.reference(operator.followers)
        self.place = scene.raster.place_of(operator.followers)
        self._both = both = operator.couplings_both
        self.amplification = 1.0
        """How much larger moves are, in rounding too, than the displacements that make them."""
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
    def methods(self) -> str:
        """The names of the methods used."""
        names = {part.name for stage in self._stages for _, part in stage.parts}
        return ", ".join(sorted(names)) or "nothing to solve"

    @property
    def how(self) -> str:
        """How the bound on the distance is obtained, the weakest way of all parts."""
        ways = {part.how for stage in self._stages for _, part in stage.parts}
        order = ("estimated norm of the inverse", "barrier", "inverse")
        return next((way for way in order if way in ways), "nothing to solve")

    @property
    def iterations(self) -> int:
        """Of all linear solvers together."""
        parts = {id(part): part for stage in self._stages for _, part in stage.parts}
        return sum(part.iterations for part in parts.values())

    def refuse_moving_floats(self, moves: Floats, rounding: float) -> None:
        """Raises ExperimentError where a part that nothing holds has moves left: only linear rules
        tell where it ends."""
        for stage in self._stages:
            for unknowns, part in stage.parts:
                r = moves[:, stage.axes].ravel()[unknowns]
                if isinstance(part, Floating) and np.abs(r).max(initial=0.0) > 8 * rounding:
                    raise ExperimentError(
                        "there is no unique equilibrium: leaders do not hold a part of "
                        f"{self._named(stage, unknowns)}; let one hold it, or take solver: "
                        "{type: stepping}",
                        ("leaders",),
                    )

    def solve(self, moves: Floats, accuracy: float, owed: Floats | None = None) -> Floats:
        """The correction c, (follower, axis). `owed` is what the invariants of parts that nothing
        holds have to gain, by follower, where the step looks back.

        Raises ExperimentError where a part is pushed on for ever.
        """
        found = np.zeros_like(moves)
        for stage in self._stages:
            r = moves[:, stage.axes].ravel()
            if stage.into is not None:
                r = r + stage.into @ found[:, 1 - stage.axes[0]]
            back = None if owed is None else owed[:, stage.axes].ravel()
            x = np.empty_like(r)
            for some, part in stage.parts:
                try:
                    x[some] = part.solve(r[some], accuracy, None if back is None else back[some])
                except DriftingError:
                    raise ExperimentError(
                        "there is no equilibrium: nothing holds a part of "
                        f"{self._named(stage, some)}, and it is pushed on for ever; let a leader "
                        "hold it",
                        ("leaders",),
                    ) from None
            found[:, stage.axes] = x.reshape(-1, len(stage.axes))
        return found

    def owed(self, state: State) -> Floats | None:
        """What followers have yet to get, (follower, axis), where the step looks back:
        before · (u(t-1) - u(t)), None elsewhere."""
        if not self._operator.couplings_before.parts:
            return None
        u, previous = (p.reshape(len(p), -1)[:, self.place] for p in (state.u, state.previous))
        return self._operator.couplings_before.times((previous - u).T.astype(float))

    def times(self, c: Floats) -> Floats:
        """A c, (follower, axis)."""
        return c - self._both.times(c)

    def distance(self, moves: Floats, rounding: float) -> float:
        """A bound on the distance of any follower from the solution, given its moves and what
        rounding may have done to them."""
        bounds = np.zeros(2)
        for stage in self._stages:
            r = np.abs(moves[:, stage.axes].ravel()) + rounding
            if stage.into is not None:
                r = r + abs(stage.into).sum(axis=1) * bounds[1 - stage.axes[0]]
            bounds[stage.axes] = max((p.farthest(r[some]) for some, p in stage.parts), default=0.0)
        return math.hypot(*bounds)

    def _named(self, stage: _Stage, unknowns: Indices) -> str:
        numbers = np.unique(self._operator.followers[unknowns // len(stage.axes)]) + 1
        return f"{len(numbers)} particles (with number {numbers[0]})"

    def _following(self, first: int) -> _Stage:
        """The stage of the other axis; it shares the solvers of the first where both are alike."""
        other, led = 1 - first, self._operator.couplings_led
        coupled = self._both.couples(other, first)
        into = self._both.entries([other], [first]).matrix() if coupled else None
        if self._both.is_isotropic() and led.is_isotropic():
            return _Stage([other], self._stages[0].parts, into)
        stage = self._stage([other])
        stage.into = into
        return stage

    def _stage(self, axes: list[int]) -> _Stage:
        matrix = one_minus(self._both.entries(axes).matrix())
        largest = float(np.abs(matrix.diagonal()).max(initial=0.0))
        self.amplification = max(self.amplification, largest)
        led = self._operator.couplings_led.entries(axes)
        count, label = connected(matrix, strongly=False)
        held = np.zeros(count, bool)
        held[label[led.rows[led.values != 0.0]]] = True
        # What leaders move directly or not is solved together, each part that floats by itself.
        groups = [np.flatnonzero(held[label])] if held.any() else []
        stage = _Stage(axes, [])
        for some in groups + [np.flatnonzero(label == n) for n in np.flatnonzero(~held)]:
            part = self._part(_within(matrix, some), axes, some, bool(held[label[some[0]]]))
            stage.parts.append((some, part))
        return stage

    def _part(self, matrix: Any, axes: list[int], some: Indices, held: bool) -> Part:
        """Held parts have an inverse, unless leaders leave them some freedom: then they float."""
        if held:
            kernel = places = None
            if len(axes) == 2:
                kernel, places = self._rigid_modes()[some], self._X.repeat(2, axis=0)[some]
            with suppress(np.linalg.LinAlgError):
                return Held(matrix, self._method, kernel, self._watch, places)
        before = self._operator.couplings_before
        back = _within(before.entries(axes).matrix(), some) if before.parts else None
        return Floating(matrix, back, self._watch)

    def _rigid_modes(self) -> Floats:
        """(unknown, mode): two translations and a rotation."""
        modes = np.zeros((2 * len(self._X), 3))
        modes[0::2, 0] = modes[1::2, 1] = 1.0
        centred = self._X - self._X.mean(axis=0)
        modes[0::2, 2], modes[1::2, 2] = -centred[:, 1], centred[:, 0]
        return modes / max(1.0, float(np.abs(centred).max()))


def _within(matrix: Any, unknowns: Indices) -> Any:
    return matrix if len(unknowns) == matrix.shape[0] else matrix[unknowns][:, unknowns]
