"""Case d over thresholds and variants, and its results at a threshold of 6.0."""

import numpy as np
from one_threshold import limits
from runs import Floats, Sheet, parted, rebound, run, steps_text, sweep

COLUMN, ROW = 7, 5
"""Particle 103: two columns left of the leaders, just above the middle."""
THRESHOLDS = np.arange(2.25, 7.26, 0.25)
UNBREAKABLE = "fracture.frame_bonds=false"
LASTING = 12
"""A rebound that begins after this step is not of the pull, which ends at step 10."""


def x_of(sheet: Sheet) -> Floats:
    """x displacement of the marked particle."""
    return sheet.u[:, COLUMN, ROW, 0]


FAMILIES = {
    "one shell": ("paper/d1",),
    "one shell and lag 1": ("paper/d1", "frame.lag=1"),
    "two shells": ("paper/d2",),
    "two shells, unbreakable frame bonds": ("paper/d2", UNBREAKABLE),
    "24 neighbours": ("paper/d2-chebyshev",),
}


def swept(label: str) -> dict[float, Sheet]:
    """Run a family at all thresholds at which every row parts."""
    name, *settings = FAMILIES[label]
    return sweep(name, THRESHOLDS, *settings)


def kinds(sheets: dict[float, Sheet]) -> str:
    """Return the number of rebounds, and of those after the leaders have stopped."""
    lows = [low[0] for low in (rebound(x_of(s)) for s in sheets.values()) if low]
    after = sum(low > LASTING for low in lows)
    return f"{len(lows)} of {len(sheets)} ({after} of them after the leaders have stopped)"


def both() -> str:
    """Return the results of an independent implementation at a threshold of 6.0, beside those at
    5.2 and 6.0."""
    low, high = _results(5.2), _results(6.0)
    expected = {
        "steps at which rows separate, one shell": "not edges first",
        "one shell, frame delayed by one step": "edges first",
        "two shells": "edges first",
        "24 neighbours": "–",
        "x of 103 after its maximum, two shells": "no rebound",
        "two shells, unbreakable frame bonds": "rebound at 14 of 20 thresholds",
        "24 neighbours ": "rebound at all thresholds",
        "largest displacement at step 400, one and two shells": "–",
        "steps at which rows of `paper/f1` separate": "–",
    }
    rows = "\n".join(
        f"| {name.strip()} | {words} | {one} | {two} |"
        for (name, words), one, two in zip(expected.items(), low, high, strict=True)
    )
    return (
        "In an earlier version case d had a threshold of 6.0 and the other cases had thresholds of "
        "5.2. The table compares the results of an independent implementation at 6.0 with results "
        "of pbdkit at both thresholds:\n\n"
        "| | independent, 6.0 | 5.2 | 6.0 |\n| --- | --- | --- | --- |\n"
        f"{rows}\n\n"
        "The motion of particle 103 along x was also examined at all thresholds at which the sheet "
        "separates. With two shells and unbreakable bonds to the frame, it has a rebound at "
        f"{kinds(swept('two shells, unbreakable frame bonds'))}, and with 24 neighbours at "
        f"{kinds(swept('24 neighbours'))}."
    )


def _results(threshold: float) -> list[str]:
    one, two = limits("d1", threshold), limits("d2", threshold)
    sheets = {
        label: run(name, one if name == "paper/d1" else two, *settings)
        for label, (name, *settings) in FAMILIES.items()
    }
    turns = {
        label: f"{low[1]:.3f} at step {low[0]}, then {low[2]:.3f}" if low else "no rebound"
        for label, low in ((n, rebound(x_of(s))) for n, s in sheets.items())
    }
    torn = ("one shell", "one shell and lag 1", "two shells", "24 neighbours")
    back = [sheets[n].residual() for n in ("one shell", "two shells")]
    hexagonal = run("paper/f1", limits("f1", threshold), "steps=15", "diagnostics=[]")
    return [
        *(steps_text(parted(sheets[n])) for n in torn),
        *(turns[n] for n in list(FAMILIES)[2:]),
        f"{back[0]:.3f} and {back[1]:.3f}",
        steps_text(parted(hexagonal)),
    ]
