"""What a strength fit answers with."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from pbdkit.fitting.least_squares import TELLS
from pbdkit.fitting.strength_laws import Draws, StrengthLaw
from pbdkit.fitting.strength_specification import StrengthFit
from pbdkit.stepping.state import Floats

LIMITS = (0.025, 0.975)
MIDDLE = (0.15865525393145707, 0.8413447460685429)
CUT = 1.02
"""An interval ends at a bound that is no farther away, as a ratio."""
SHIFT = 0.25
"""The share of the standard error of the mean of ln peak by which peaks may lie above first breaks:
an interval of 95 % that is so far off holds 94.3 %."""


@dataclass(frozen=True)
class StrengthEstimate:
    """A median with its standard error, half of the interval that holds 68.3 %, and the ends of
    that of 95 %. `told` is False where the data cannot tell it; `cut` is True where a bound ends
    the interval, beyond which it might go on."""

    value: float
    error: float
    low: float
    high: float
    told: bool = True
    cut: bool = False

    def __str__(self) -> str:
        if not self.told:
            return "the data cannot tell it"
        digits = max(0, 1 - int(np.floor(np.log10(max(self.error, 1e-12)))))
        value, error, low, high = (
            f"{each:.{digits}f}" for each in (self.value, self.error, self.low, self.high)
        )
        text = f"{value} ± {error}, 95 % from {low} to {high}"
        return text + (", cut off by its bounds" if self.cut else "")


@dataclass(frozen=True)
class Checked:
    """How far above the load of their first break specimens were borne: the mean of ln peak/first
    over `count` torn ones, and how many bore more; `limit` is what does no harm."""

    excess: float
    bore_more: int
    count: int
    limit: float

    @classmethod
    def of(cls, excess: Sequence[float], peaks: Floats) -> Checked:
        """From that of each, against the spread of what was measured."""
        limit = SHIFT * float(np.log(peaks).std(ddof=1)) / len(peaks) ** 0.5
        more = sum(each > 1e-6 for each in excess)
        return cls(float(np.mean(excess)), more, len(excess), limit)

    @property
    def holds(self) -> bool:
        """Whether the first break counts as the failure of the specimen."""
        return self.excess <= self.limit

    def __str__(self) -> str:
        how = f"{self.bore_more} of {self.count} torn specimens bore more than at their first break"
        if self.holds:
            return f"the first break is the failure: {how}"
        return (
            f"the first break is not the failure: {how}, on average {np.expm1(self.excess):.1%} "
            f"more; no harm does {np.expm1(self.limit):.2%}"
        )


@dataclass(frozen=True)
class FittedStrength:
    """The answer of a strength fit.

    `values` by path, `correlations` (parameter, parameter), `variation`, the coefficient of
    variation of bonds, where their law is known. `method` is how they were found; `checked` whether
    specimens fail at their first break, None where that was not looked at. `draws` are parameters
    as the measurement leaves them open.
    """

    values: Mapping[str, StrengthEstimate]
    correlations: Floats
    variation: StrengthEstimate | None
    method: str
    specimens: int
    failed: int
    checked: Checked | None = None
    draws: Draws = field(kw_only=True, repr=False)

    def with_check(self, checked: Checked | None) -> FittedStrength:
        """The same with what was seen of torn specimens."""
        return replace(self, checked=checked)

    def as_dict(self) -> dict[str, Any]:
        """All of it in plain values, as the JSON file holds it."""
        checked = self.checked
        return {
            "values": {path: _plain(each) for path, each in self.values.items()},
            "correlations": {
                one: {other: float(self.correlations[n, m]) for m, other in enumerate(self.values)}
                for n, one in enumerate(self.values)
            },
            "coefficient_of_variation": self.variation and _plain(self.variation),
            "method": self.method,
            "specimens": self.specimens,
            "broke": self.failed,
            "first_break_is_failure": None if checked is None else checked.holds,
            "excess": None if checked is None else checked.excess,
        }

    def lines(self) -> Iterator[str]:
        """What to tell first."""
        for path, estimate in self.values.items():
            yield f"{path}: {estimate}"
        if self.variation and all(each.told for each in self.values.values()):
            yield f"coefficient of variation of strengths: {self.variation}"
        for n, one in enumerate(self.values):
            for m, other in list(enumerate(self.values))[n + 1 :]:
                if abs(self.correlations[n, m]) > 0.5:
                    yield f"correlation of {one} and {other}: {self.correlations[n, m]:.2f}"
        kept = self.specimens - self.failed
        yield f"by {self.method}, of {self.specimens} specimens" + (
            f", {kept} of which did not break" if kept else ""
        )
        if self.checked:
            yield str(self.checked)
        elif self.method == "likelihood":
            yield "taken for granted: a specimen fails as its first bond breaks"


def fitted_strength(
    fit: StrengthFit, paths: Sequence[str], draws: Draws, method: str, law: StrengthLaw | None
) -> FittedStrength:
    """The answer in words of the fit file."""
    values = {}
    for n, path in enumerate(paths):
        low, high = fit.unknown[path]
        found = _estimate(draws.values[:, n], draws.weights)
        cut = min(found.low / low, high / found.high) < CUT
        values[path] = replace(found, told=found.error <= TELLS * (high - low), cut=cut)
    variation = None
    if law is not None:
        each = draws.values[:, [list(paths).index(path) for path in law.paths]]
        variation = _estimate(law.variation(each[:, 0], each[:, 1]), draws.weights)
    spread = np.cov(np.log(draws.values).T, aweights=draws.weights).reshape((len(paths),) * 2)
    errors = np.sqrt(np.diag(spread))
    failed = fit.measured.failed
    correlations = spread / np.outer(errors, errors)
    count = len(failed), int(failed.sum())
    return FittedStrength(values, correlations, variation, method, *count, draws=draws)


def _estimate(values: Floats, weights: Floats) -> StrengthEstimate:
    order = np.argsort(values)
    below = np.cumsum(weights[order]) - weights[order] / 2
    low, minus, middle, plus, high = np.interp(
        [LIMITS[0], MIDDLE[0], 0.5, MIDDLE[1], LIMITS[1]], below, values[order]
    )
    return StrengthEstimate(float(middle), float(plus - minus) / 2, float(low), float(high))


def _plain(estimate: StrengthEstimate) -> dict[str, Any]:
    if not estimate.told:
        return dict.fromkeys(("value", "error", "low", "high", "cut")) | {"told": False}
    return asdict(estimate)
