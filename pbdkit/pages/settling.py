"""How a run came to rest after its last event, beside what was known before its first step."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.pages.lattice import read
from pbdkit.pages.packing import packed
from pbdkit.pages.thinning import Rows
from pbdkit.prediction.analysis import Analysis
from pbdkit.results.carried import carried
from pbdkit.runs.tuning import tuned
from pbdkit.scene.raster import LEADER
from pbdkit.scene.scene import Scene

if TYPE_CHECKING:
    import xarray

Array = NDArray[Any]
LARGEST = 20_000
"""Particles above which nothing is predicted for a page: it would take longer than the page."""
FEWEST, MOST = 8, 800
"""Moves that a decay is measured of, at least and at most."""
FADED = 1e-11
"""Moves smaller than this share of the largest one are of rounding."""


@dataclass(frozen=True)
class Moves:
    """The largest move a step of any follower, `move`, up to each of the `steps`; `free` is the
    first of these rows after the last event: a leader that moves, begins or ends, a bond that
    breaks."""

    steps: Array
    move: Array
    free: int

    @property
    def fitted(self) -> Rows:
        """The rows that the decay is measured of: the second half of those after the last event
        that are no rounding."""
        rows = np.arange(self.free, len(self.move))
        rows = rows[self.move[rows] > FADED * self.move.max(initial=0.0)]
        return np.asarray(rows[len(rows) // 2 :])

    @property
    def decay(self) -> float | None:
        """By what the moves shrink a step, in the end."""
        rows = self.fitted
        if len(rows) < FEWEST:
            return None
        return float(np.exp(np.polyfit(self.steps[rows], np.log(self.move[rows]), 1)[0]))

    def steps_to(self, share: float) -> int | None:
        """The steps from the last event until moves were smaller than a share of the first one."""
        free = self.move[self.free :]
        below = np.flatnonzero(free <= share * free[:1].max(initial=0.0))
        return int(self.steps[self.free + below[0]] - self.steps[self.free]) if len(below) else None


def moves_of(dataset: xarray.Dataset) -> Moves | None:
    """Between recorded steps that lie equally far apart, MOST at most; None where there are too
    few of them, or no kinds."""
    recorded = dataset.sizes["time"]
    steps = np.arange(0, recorded, -(-recorded // MOST))
    times = dataset["time"].values[steps]
    apart = np.diff(times)
    if len(apart) and apart[-1] != apart[0]:
        steps, times, apart = steps[:-1], times[:-1], apart[:-1]
    if len(times) < FEWEST or "kind" not in dataset or (apart != apart[0]).any():
        return None
    name = "u" if "u" in dataset else "position"
    move, event = [], 0
    both = zip(read(dataset[name], steps), read(dataset["kind"], steps), strict=True)
    for n, ((before, kinds_before), (now, kinds)) in enumerate(pairwise(both), 1):
        lengths, leads = np.linalg.norm(now - before, axis=1), kinds == LEADER
        move.append(float(lengths[~leads].max(initial=0.0)) / apart[0])
        led = lengths[leads].max(initial=0.0) > FADED * max(move)
        if led or not np.array_equal(kinds, kinds_before):
            event = n
    if "broken_step" in dataset and dataset["broken_step"].size:
        last = int(dataset["broken_step"].max())
        event = max(event, int(np.searchsorted(times, last)))
    return Moves(times[1:], np.array(move), min(event, len(move) - 1))


def settling(dataset: xarray.Dataset, scene: Scene | None) -> dict[str, Any]:
    """Rows of what was predicted and what happened, sentences beside them, and the curve of the
    moves; why there is none where it cannot be had cheaply."""
    if scene is None:
        return {"notes": ["Nothing is predicted: the experiment cannot be built here."]}
    if not scene.experiment.solver.makes_steps:
        return _found(dataset)
    if scene.raster.count > LARGEST:
        return {
            "notes": [
                f"Nothing is predicted here of more than {LARGEST} particles; `pbdkit check` does, "
                "and takes longer."
            ]
        }
    analysis, moves = Analysis(tuned(scene)), moves_of(dataset)
    rest = moves if moves and len(moves.move) - moves.free >= FEWEST else None
    found: dict[str, Any] = {"rows": _rows(dataset, analysis, rest), "notes": _notes(analysis)}
    if rest is None:
        why = (
            "too few steps are recorded, or they are not equally far apart"
            if moves is None
            else "leaders move or bonds break until the end, or nearly"
        )
        found["notes"].append(f"How the body came to rest is not measured: {why}.")
    return found | ({"moves": _curve(analysis, moves)} if moves else {})


def _found(dataset: xarray.Dataset) -> dict[str, Any]:
    """Of an equilibrium: what its certificate says."""
    certificate = carried(dataset, "certificate")
    told = [[name.replace("_", " "), value] for name, value in certificate.items()]
    note = "The solver makes no steps: it finds the equilibrium, and says how far from it the "
    return {"certificate": told, "notes": [f"{note}last state can be at most."]}


def _rows(dataset: xarray.Dataset, analysis: Analysis, moves: Moves | None) -> list[list[Any]]:
    to = analysis.steps_to["1e-3"]
    measured: Any = moves.steps_to(1e-3) if moves else None
    if moves and measured is None:
        measured = "not by the end"
    decay = moves.decay if moves else None
    rows: list[list[Any]] = [
        ["stable", _yes(analysis.stable), _ended(dataset, moves)],
        ["factor a step: spectral radius; of moves, in the end", analysis.spectral_radius, decay],
        ["steps until it has shrunk to 1/1000; moves, since the last event", to, measured],
        ["smallest eigenvalue of the rule", analysis.smallest_eigenvalue, None],
        ["largest stable relaxation", analysis.largest_stable_relaxation, None],
    ]  # fmt: skip
    return rows


def _yes(stable: bool | None) -> str:
    return "not known" if stable is None else "yes" if stable else "no"


def _ended(dataset: xarray.Dataset, moves: Moves | None) -> str:
    status = str(dataset.attrs.get("status", ""))
    if status not in ("complete", "settled") or moves is None:
        return status
    last = moves.move[-1] / (moves.move.max() or 1.0)
    return f"{status}, the last move was {last:.2g} of the largest"


def _notes(analysis: Analysis) -> list[str]:
    notes = []
    if not analysis.exact:
        notes.append(
            "The prediction is of the start, made linear: the rule is not linear, or bonds, "
            "neighbours, contacts or numbers change on the way."
        )
    if analysis.estimated:
        notes.append("The spectrum is estimated: 1 - radius is within 1 %.")
    return [*notes, *analysis.warnings()]


def _curve(analysis: Analysis, moves: Moves) -> dict[str, Any]:
    """The logarithm of the moves, and the slope that was predicted through the middle of those
    that the decay is measured of."""
    with np.errstate(divide="ignore"):
        logs = np.log10(moves.move)
    logs[~np.isfinite(logs)] = np.nan
    series = [{"name": "what happened", "values": packed(logs, "f8")}]
    radius, rows = analysis.spectral_radius, moves.fitted
    if radius and len(rows) >= FEWEST:
        middle = rows[len(rows) // 2]
        line = logs[middle] + (moves.steps - moves.steps[middle]) * np.log10(radius)
        line[: moves.free] = np.nan
        line[(line < np.nanmin(logs) - 1) | (line > np.nanmax(logs) + 0.5)] = np.nan
        series.append({"name": "predicted slope", "values": packed(line, "f8")})
    return {
        "title": "largest move of a follower, a step",
        "x": packed(moves.steps, "f8"),
        "x_label": "step",
        "y_label": "log10 of the move",
        "series": series,
    }
