"""What whoever waits for a run is told, and whether they want it to stop."""

from __future__ import annotations

from collections.abc import Callable


class StoppedError(Exception):
    """The run, or the search for an equilibrium, was asked to stop."""


class Watch:
    """Tells `show` what is being done and which share of it is, and asks `stopping` whether to go
    on. `load` names the increment of load, where there are several."""

    def __init__(
        self,
        stopping: Callable[[], bool] = lambda: False,
        show: Callable[[str, float], None] = lambda what, share: None,
    ) -> None:
        self.load, self._what = "", ""
        self.stopping, self._show = stopping, show

    def begin(self, what: str) -> None:
        """Something else is done from now on. Raises StoppedError."""
        self.look(0.0, what)

    def look(self, share: float, what: str = "") -> None:
        """So much is done, of `what` or of what was begun last. Raises StoppedError."""
        self._what = what or self._what
        if self.stopping():
            raise StoppedError
        self._show(self.load + self._what, min(1.0, max(0.0, share)))
