"""Times at which the sheets of d, f and g separate, and thresholds that fit all figures."""

from collections.abc import Sequence

import numpy as np
from claims import Claim
from runs import parted, run, steps_text

FIGURES = {"d1": (5, 7), "d2": (5, 8), "f1": (7, 10), "f2": (7, 10), "g": (8, 9)}
"""The first and last of the consecutive times about the tearing that figures 14, 15, 18, 20 and 22
show."""
TRIED = np.arange(4.4, 6.41, 0.1).round(2)
SHIPPED = 5.2


def limits(case: str, threshold: float) -> str:
    """Return the setting of one threshold for all shells of a case."""
    return f"fracture.thresholds={[threshold] * (1 if case.endswith('1') else 2)}"


def times(case: str, threshold: float = SHIPPED) -> tuple[int, int] | None:
    """Return the paper's times at which the first and last row separate; None if some do not."""
    rows = parted(run(f"paper/{case}", limits(case, threshold), "steps=15", "diagnostics=[]"))
    steps = [step for step in rows if step is not None]
    return (min(steps) + 1, max(steps) + 1) if len(steps) == len(rows) else None


def fits(case: str, threshold: float) -> bool:
    """Return whether the last row separates after the first and not after the last time shown."""
    torn, (first, last) = times(case, threshold), FIGURES[case]
    return torn is not None and first < torn[1] <= last


def fitting(*cases: str) -> list[float]:
    """Return the thresholds, among those tried, that fit the figures of all these cases."""
    return [float(t) for t in TRIED if all(fits(case, float(t)) for case in cases)]


def span(case: str) -> str:
    """Return the times at which the rows of a case part at the shipped threshold."""
    torn = times(case)
    assert torn is not None
    return f"{torn[0]} to {torn[1]}" if torn[0] < torn[1] else f"{torn[0]}"


def which(thresholds: Sequence[float]) -> str:
    """Return a list of thresholds as text."""
    return ", ".join(f"{t:g}" for t in thresholds) or "none"


def same_parameters() -> Claim:
    """Return the claim of case f on its parameters."""
    one, two = run("paper/d1"), run("paper/d1", "frame.layers=2", "diagnostics=[]")
    shift = float(np.abs(one.u - two.u).max())
    high = steps_text(parted(run("paper/f1", limits("f1", 6.0), "steps=15", "diagnostics=[]")))
    found = fitting(*FIGURES)
    return Claim(
        "all parameters are the same as the square lattice fracture case",
        f"Speed and threshold can be the same in all cases. At {SHIPPED:g}, the threshold of the "
        "shipped cases d, f and g, rows separate at times "
        f"{', '.join(f'{span(case)} ({case})' for case in FIGURES)}. A threshold "
        "agrees with figures 14, 15, 18, 20 and 22 if the last row separates after the first and "
        "not after the last of the consecutive times that a figure shows. "
        f"{len(TRIED)} thresholds from {TRIED[0]:g} to {TRIED[-1]:g} were tried. The ones that "
        f"agree are {which(found)}. At a threshold of 6 the rows of f1 separate at steps {high}. "
        "The frame cannot be the same in all cases, because the numbers of particles depend on it: "
        "the particle that the paper describes has the number 103 "
        f"in d with one layer ({two.number(7, 5)} with two) and 133 in f with two layers. On the "
        f"square lattice a second layer changes the displacements by {shift:.1g}.",
        False,
        "one threshold of 5.2 or 5.3 for all cases, and another frame",
        found == [5.2, 5.3] and one.number(7, 5) == 103 != two.number(7, 5),
    )
