"""The linear system of an equilibrium, A c = move with A = 1 - (step operator), taken apart.

Where x and y do not move each other there are two systems, often equal; where one moves the other
only (mixed coordinates), it is solved first. Parts of the body that nothing holds are told apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.couplings import DENSE, Couplings, connected
from pbdkit.analysis.operator import StepOperator
from pbdkit.equilibrium.floating_parts import Floating
from pbdkit.equilibrium.system_parts import DriftingError, Held, Part
from pbdkit.equilibrium.watch import Watch
from pbdkit.errors import ExperimentError

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass
class _Stage:
    """The unknowns of one axis, or of both where they move each other, with their parts: who
    belongs to each, None for all. `into` is what the axis solved before adds to the moves."""

    axes: tuple[int, ...]
    parts: list[tuple[Indices | None, Part]]
    into: Any = None


class System:
    """A c = move for the followers of an operator, by one of the solver's methods.

    `X` are their reference positions (follower, axis), which solvers for both axes go by."""

    def __init__(self, operator: StepOperator, method: str, X: Floats, watch: Watch) -> None:
        self._operator, self._method, self._X = operator, method, X
        self._watch = watch
        now, before = operator.couplings_now, operator.couplings_before
        both = Couplings(now.shape, now.axes, now.parts + before.parts)
        self._both = both
        self.amplification = 1.0
        """How much larger moves are, in rounding too, than the displacements that make them."""
        first = 1 if both.couples(0, 1) else 0
        self._stages = [] if both.couples(first, 1 - first) else [self._stage((first,))]
        # One axis has a share in the invariants of the other, where it moves it.
        coupled = both.couples(1 - first, first)
        if not self._stages or (coupled and self._has_floating(self._stages[0])):
            self._stages = [self._stage((0, 1))]
        else:
            self._stages.append(self._following(first))

    @staticmethod
    def _has_floating(stage: _Stage) -> bool:
        return any(isinstance(part, Floating) for _, part in stage.parts)

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
            r = np.abs(moves[:, list(stage.axes)].ravel())
            for unknowns, part in stage.parts:
                some = slice(None) if unknowns is None else unknowns
                if isinstance(part, Floating) and r[some].max(initial=0.0) > rounding:
                    numbers = self._numbers(stage, unknowns)
                    raise ExperimentError(
                        f"there is no unique equilibrium: leaders do not hold a part of "
                        f"{len(numbers)} particles (with number {numbers[0]}); let one hold it, "
                        "or take solver: {type: stepping}",
                        ("leaders",),
                    )

    def solve(self, moves: Floats, accuracy: float, owed: Floats | None = None) -> Floats:
        """The correction c, (follower, axis). `owed` is what the invariants of parts that nothing
        holds have to gain, by follower, where the step looks back.

        Raises ExperimentError where a part is pushed on for ever.
        """
        found = np.zeros_like(moves)
        for stage in self._stages:
            axes = list(stage.axes)
            r = moves[:, axes].ravel()
            if stage.into is not None:
                r = r + stage.into @ found[:, 1 - axes[0]]
            x = np.zeros_like(r)
            for unknowns, part in stage.parts:
                some = slice(None) if unknowns is None else unknowns
                if isinstance(part, Floating):
                    back = None if owed is None else owed[:, axes].ravel()[some]
                    x[some] = self._floated(stage, unknowns, part, r[some], back)
                elif r[some].any():
                    x[some] = part.solve(r[some], accuracy)
            found[:, axes] = x.reshape(-1, len(axes))
        return found

    def times(self, c: Floats) -> Floats:
        """A c, (follower, axis)."""
        return c - self._both.times(c)

    def distance(self, moves: Floats, rounding: float) -> float:
        """A bound on the distance of any follower from the solution, given its moves and what
        rounding may have done to them."""
        bounds = np.zeros(2)
        for stage in self._stages:
            axes = list(stage.axes)
            r = np.abs(moves[:, axes].ravel()) + rounding
            if stage.into is not None:
                r = r + abs(stage.into).sum(axis=1) * bounds[1 - axes[0]]
            for unknowns, part in stage.parts:
                some = slice(None) if unknowns is None else unknowns
                bounds[axes] = np.maximum(bounds[axes], part.farthest(r[some]))
        return math.hypot(*bounds)

    def _floated(
        self,
        stage: _Stage,
        unknowns: Indices | None,
        part: Floating,
        r: Floats,
        owed: Floats | None,
    ) -> Floats:
        try:
            return part.solve(r, 0.0, owed)
        except DriftingError:
            numbers = self._numbers(stage, unknowns)
            raise ExperimentError(
                f"there is no equilibrium: nothing holds a part of {len(numbers)} particles (with "
                f"number {numbers[0]}), and it is pushed on for ever; let a leader hold it",
                ("leaders",),
            ) from None

    def _numbers(self, stage: _Stage, unknowns: Indices | None) -> Indices:
        size = len(self._operator.followers) * len(stage.axes)
        every = np.arange(size) if unknowns is None else unknowns
        return np.unique(self._operator.followers[every // len(stage.axes)]) + 1

    def _following(self, first: int) -> _Stage:
        """The stage of the other axis; it shares the solvers of the first where both are alike."""
        other, led = 1 - first, self._operator.couplings_led
        coupled = self._both.couples(other, first)
        into = _sparse_or_dense(self._both.between(other, first)) if coupled else None
        if self._both.is_isotropic() and led.is_isotropic():
            return _Stage((other,), self._stages[0].parts, into)
        stage = self._stage((other,))
        stage.into = into
        return stage

    def _stage(self, axes: tuple[int, ...]) -> _Stage:
        matrix = _one_minus(self._of(self._both, axes))
        largest = float(np.abs(matrix.diagonal()).max(initial=0.0))
        self.amplification = max(self.amplification, largest)
        held = self._held(axes)
        count, label = connected(matrix, strongly=False)
        led = np.zeros(count, bool)
        led[label[held]] = True
        if count and led.all():
            return _Stage(axes, [(None, self._part(matrix, axes, None))])
        stage = _Stage(axes, [])
        together = np.flatnonzero(led[label])
        if len(together):
            part = self._part(_within(matrix, together), axes, together)
            stage.parts.append((together, part))
        for n in np.flatnonzero(~led):
            unknowns = np.flatnonzero(label == n)
            stage.parts.append((unknowns, self._floating(matrix, axes, unknowns)))
        return stage

    def _part(self, matrix: Any, axes: tuple[int, ...], unknowns: Indices | None) -> Part:
        """Held parts have an inverse, unless leaders leave them some freedom: then they float."""
        kernel = places = None
        if len(axes) == 2:
            some = slice(None) if unknowns is None else unknowns
            kernel, places = (v[some] for v in (self._rigid_modes(), self._X.repeat(2, axis=0)))
        try:
            part = Held(matrix, self._method, kernel, self._watch, places)
            if part.conditioned:
                return part
        except np.linalg.LinAlgError:
            pass
        every = np.arange(matrix.shape[0]) if unknowns is None else unknowns
        return Floating(matrix, self._looking_back(axes, every))

    def _floating(self, matrix: Any, axes: tuple[int, ...], unknowns: Indices) -> Part:
        return Floating(_within(matrix, unknowns), self._looking_back(axes, unknowns))

    def _looking_back(self, axes: tuple[int, ...], unknowns: Indices) -> Any:
        before = self._operator.couplings_before
        if not before.parts:
            return None
        return _within(self._of(before, axes), unknowns)

    def _of(self, couplings: Couplings, axes: tuple[int, ...]) -> Any:
        entries = couplings.entries() if len(axes) == 2 else couplings.between(axes[0], axes[0])
        return _sparse_or_dense(entries)

    def _held(self, axes: tuple[int, ...]) -> Indices:
        """The unknowns that a leader moves directly."""
        led = self._operator.couplings_led
        entries = led.entries() if len(axes) == 2 else led.between(axes[0], axes[0])
        return np.unique(entries.rows[entries.values != 0.0])

    def _rigid_modes(self) -> Floats:
        """(unknown, mode): two translations and a rotation."""
        modes = np.zeros((2 * len(self._X), 3))
        modes[0::2, 0] = modes[1::2, 1] = 1.0
        centred = self._X - self._X.mean(axis=0)
        modes[0::2, 2], modes[1::2, 2] = -centred[:, 1], centred[:, 0]
        return modes / max(1.0, float(np.abs(centred).max()))


def _sparse_or_dense(entries: Any) -> Any:
    return entries.matrix() if entries.shape[1] <= DENSE else entries.sparse()


def _one_minus(matrix: Any) -> Any:
    if isinstance(matrix, np.ndarray):
        return np.eye(len(matrix)) - matrix
    from scipy.sparse import eye_array

    return (eye_array(matrix.shape[0], format="csr") - matrix).tocsr()


def _within(matrix: Any, unknowns: Indices) -> Any:
    return matrix[unknowns][:, unknowns]
