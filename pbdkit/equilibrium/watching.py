"""What is looked at while an equilibrium is sought: how far it is, and whether to stop."""

from __future__ import annotations

from collections.abc import Callable


class StoppedError(Exception):
    """The search was asked to stop."""


def _never() -> bool:
    return False


def _nothing(what: str, share: float) -> None:
    pass


class Watch:
    """Tells `show` what is being done and which share of it is, and asks `stopping` whether to go
    on. `load` names the increment of load, where there are several."""

    def __init__(
        self,
        stopping: Callable[[], bool] = _never,
        show: Callable[[str, float], None] = _nothing,
    ) -> None:
        self.load = ""
        self._stopping, self._show = stopping, show
        self._what = ""

    def begin(self, what: str) -> None:
        """Something else is done from now on. Raises StoppedError."""
        self._what = what
        self.look(0.0)

    def look(self, share: float) -> None:
        """So much of it is done. Raises StoppedError."""
        if self._stopping():
            raise StoppedError
        self._show(self.load + self._what, min(1.0, max(0.0, share)))
