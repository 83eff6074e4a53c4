"""The motion of a group that is led by hand: a path that is still being made."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from pydantic import PrivateAttr

from pbdkit.experiment.motion import Floats, Motion
from pbdkit.experiment.motions import Path

Way = tuple[float, float]


class Hand(Motion):
    """Where the hand has led a group, knot by knot; between knots, and after the last, as `path`.

    The knots grow while it is stepped, so that no engine is made anew for a move of the mouse.
    """

    type: Literal["hand"] = "hand"
    _steps: list[int] = PrivateAttr(default_factory=list)
    _ways: list[Way] = PrivateAttr(default_factory=list)

    def offset(self, n: float, start: Floats) -> Floats:
        """That of the path which a file would say."""
        if not self._steps:
            return np.zeros(2)
        # The two lists themselves: a path of copies would cost as much as it is long.
        knots: dict[str, Any] = {"steps": self._steps, "displacements": self._ways}
        return Path.model_construct(**knots).offset(n, start)

    def knots(self) -> tuple[int, ...]:
        """The last: what came before it is over."""
        return tuple(self._steps[-1:])

    def at(self, n: int) -> Way:
        """The offset at the end of its n-th step, n ≥ 0."""
        x, y = self.offset(n, np.zeros((1, 2))) if n else (0.0, 0.0)
        return float(x), float(y)

    def lead(self, begin: int, end: int, way: Way) -> None:
        """Goes on evenly, after its step `begin`, to `way` at its step `end`."""
        if begin and (not self._steps or self._steps[-1] < begin):
            self._add(begin, self.at(begin))
        self._add(end, way)

    def cut_back(self, n: int) -> None:
        """Forgets what comes after its step n; every step until then stays to the bit."""
        known = [(step, way) for step, way in self.path if step <= n]
        if len(known) < len(self._steps):
            begin = known[-1][0] if known else 0
            known += [(step, self.at(step)) for step in range(begin + 1, n + 1)]
        self._steps[:] = [step for step, _ in known]
        self._ways[:] = [way for _, way in known]

    @property
    def path(self) -> list[tuple[int, Way]]:
        """Its knots."""
        return list(zip(self._steps, self._ways, strict=True))

    def motion(self) -> dict[str, Any]:
        """As an experiment file says it."""
        if not self._steps:
            return {"type": "hold"}
        ways = [list(way) for way in self._ways]
        return {"type": "path", "steps": list(self._steps), "displacements": ways}

    def _add(self, step: int, way: Way) -> None:
        self._steps.append(step)
        self._ways.append(way)
