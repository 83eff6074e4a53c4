"""What came out of an examination: what ran, what failed, what was skipped and why."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Literal

State = Literal["held", "failed", "skipped"]


@dataclass(frozen=True)
class Outcome:
    """How one property came out for one component; `reason` is the fault, or why it was skipped."""

    property: str
    state: State
    reason: str = ""


@dataclass(frozen=True)
class Report:
    """All outcomes of one component; `component` names it with its parameters."""

    component: str
    outcomes: tuple[Outcome, ...]

    @property
    def ran(self) -> list[Outcome]:
        """Those that were judged, held or failed."""
        return [o for o in self.outcomes if o.state != "skipped"]

    @property
    def failed(self) -> list[Outcome]:
        """Those that do not hold."""
        return [o for o in self.outcomes if o.state == "failed"]

    @property
    def skipped(self) -> list[Outcome]:
        """Those that were not judged, with the reason."""
        return [o for o in self.outcomes if o.state == "skipped"]

    @property
    def holds(self) -> bool:
        """Whether nothing failed, and something ran."""
        return bool(self.ran) and not self.failed

    def summary(self) -> str:
        """One line: how many ran and failed, and why others were skipped."""
        reasons = Counter(o.reason for o in self.skipped)
        skipped = "; ".join(f"{n} skipped: {reason}" for reason, n in reasons.items())
        counts = f"{len(self.ran)} properties ran, {len(self.failed)} failed"
        return f"{self.component}: {counts}" + (f"; {skipped}" if skipped else "")

    def __str__(self) -> str:
        wide = max((len(o.property) for o in self.outcomes), default=0)
        rows = [f"  {o.state:7}  {o.property:{wide}}  {o.reason}".rstrip() for o in self.outcomes]
        return "\n".join([self.summary(), *rows])
