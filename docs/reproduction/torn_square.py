"""Case d over thresholds and variants, and what was found of it at 6.0."""

import numpy as np
from one_threshold import limits
from runs import Floats, Sheet, parted, rebound, run, steps_text, sweep

COLUMN, ROW = 7, 5
"""Particle 103: two columns left of the leaders, just above the middle."""
THRESHOLDS = np.arange(2.25, 7.26, 0.25)
SPARED = "fracture.frame_bonds=false"
LASTING = 12
"""A rebound that begins after this step is not of the pull, which ends at step 10."""


def x_of(sheet: Sheet) -> Floats:
    """x displacement of the marked particle."""
    return sheet.u[:, COLUMN, ROW, 0]


FAMILIES = {
    "one shell": ("paper/d1",),
    "one shell and lag 1": ("paper/d1", "frame.lag=1"),
    "two shells": ("paper/d2",),
    "two shells, frame bonds spared": ("paper/d2", SPARED),
    "24 neighbours": ("paper/d2-chebyshev",),
}


def swept(label: str) -> dict[float, Sheet]:
    """A family at all thresholds at which every row parts."""
    name, *settings = FAMILIES[label]
    return sweep(name, THRESHOLDS, *settings)


def kinds(sheets: dict[float, Sheet]) -> str:
    """How many rebound at all, and how many of them after the pull."""
    lows = [low[0] for low in (rebound(x_of(s)) for s in sheets.values()) if low]
    after = sum(low > LASTING for low in lows)
    return f"{len(lows)} of {len(sheets)} ({after} of them after the pull)"


def both() -> str:
    """What was expected of the case at thresholds of 6.0, at which it was once shipped, and what
    is found at both."""
    low, high = _findings(5.2), _findings(6.0)
    expected = {
        "steps at which rows part, one shell": "not edges first",
        "the same with lag 1": "edges first",
        "the same with two shells": "edges first",
        "the same with 24 neighbours": "–",
        "x of 103 after its top, two shells": "no rebound",
        "the same with frame bonds spared": "rebound at 14 of 20 thresholds",
        "the same with 24 neighbours ": "rebound at all thresholds",
        "off at step 400, one and two shells": "–",
        "steps at which rows of `paper/f1` part": "–",
    }
    rows = "\n".join(
        f"| {name.strip()} | {words} | {one} | {two} |"
        for (name, words), one, two in zip(expected.items(), low, high, strict=True)
    )
    return (
        "Case d was once shipped at 6.0, the other cases at 5.2. What an independent "
        "implementation had found at 6.0, and what is measured at both:\n\n"
        "| | found before, at 6.0 | at 5.2 | at 6.0 |\n| --- | --- | --- | --- |\n"
        f"{rows}\n\n"
        "Over all thresholds x of 103 rebounds with frame bonds spared at "
        f"{kinds(swept('two shells, frame bonds spared'))}, with 24 neighbours at "
        f"{kinds(swept('24 neighbours'))}."
    )


def _findings(threshold: float) -> list[str]:
    one, two = limits("d1", threshold), limits("d2", threshold)
    sheets = {
        label: run(name, one if name == "paper/d1" else two, *settings)
        for label, (name, *settings) in FAMILIES.items()
    }
    turns = {
        label: f"low of {low[1]:.3f} at step {low[0]}, then {low[2]:.3f}" if low else "no rebound"
        for label, low in ((n, rebound(x_of(s))) for n, s in sheets.items())
    }
    torn = ("one shell", "one shell and lag 1", "two shells", "24 neighbours")
    back = [sheets[n].residual() for n in ("one shell", "two shells")]
    hexagonal = run("paper/f1", limits("f1", threshold), "steps=15", "diagnostics=[]")
    return [
        *(steps_text(parted(sheets[n])) for n in torn),
        *(turns[n] for n in ("two shells", "two shells, frame bonds spared", "24 neighbours")),
        f"{back[0]:.3f} and {back[1]:.3f}",
        steps_text(parted(hexagonal)),
    ]
