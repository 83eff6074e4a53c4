"""Run shipped experiments, each once, and evaluate the quantities of the page."""

from functools import cache
from typing import Any

import numpy as np
import xarray
from numpy.typing import NDArray

import pbdkit
from pbdkit.model.reading import read_text

Floats = NDArray[np.float64]
LEADER, BODY = 0, 0
"""Values of `kind` and `role` in datasets."""
COLUMNS = ROWS = 10
"""Every case is a grid of this size; its marked particles are named by column and row from 0."""


class Sheet:
    """A run of a body that is a grid of sites (0, 0) to (columns - 1, rows - 1)."""

    def __init__(self, dataset: xarray.Dataset) -> None:
        self.ds = dataset
        self.body = dataset["role"].values == BODY
        self.site = dataset["site"].values
        self.columns, self.rows = (int(n) + 1 for n in self.site[self.body].max(axis=0))

    def on_grid(self, values: Floats) -> Floats:
        """Return (time, particle, ...) as (time, column, row, ...); the body counts by columns."""
        shape = (len(values), self.columns, self.rows, *values.shape[2:])
        return values[:, self.body].reshape(shape)

    @property
    def position(self) -> Floats:
        """Positions of all particles, (time, particle, axis)."""
        return self.ds["position"].transpose("time", "particle", "axis").values

    @property
    def u(self) -> Floats:
        """Displacements of the body, (time, column, row, axis)."""
        return self.on_grid(self.position - self.ds["reference"].values)

    def of(self, variable: str) -> Floats:
        """Return a diagnostic of the body, (time, column, row)."""
        return self.on_grid(self.ds[variable].transpose("time", "particle").values)

    def number(self, column: int, row: int) -> int:
        """Return the number of a body particle."""
        return int(self.ds["number"].values[(self.site == (column, row)).all(axis=1)][0])

    def spread(self) -> float:
        """Return the largest difference of u_x between rows of one column, at any step."""
        return float(np.ptp(self.u[..., 0], axis=2).max())

    def residual(self) -> float:
        """Return the largest |u| of the piece left of the torn column, at the last step."""
        return float(np.linalg.norm(self.u[-1, :-1], axis=-1).max())

    def longest_bond(self) -> tuple[float, int]:
        """Return the length of the longest bond in an intermediate configuration, and its step: the
        leaders have their new positions, all other particles the previous ones."""
        place, leads = self.position, self.ds["kind"].values[1:, :, None] == LEADER
        judged = np.where(leads, place[1:], place[:-1])
        across = judged[:, self.ds["bond_ends"].values - 1]
        length = np.linalg.norm(across[:, :, 1] - across[:, :, 0], axis=-1).max(axis=1)
        return float(length.max()), int(length.argmax()) + 1


@cache
def run(name: str, *settings: str) -> Sheet:
    """Run a shipped experiment with settings, as at the command line; each is run once."""
    experiment = pbdkit.load(name, settings=list(settings))
    return Sheet(pbdkit.run(experiment, progress=False))


def run_parts(**parts: Any) -> Sheet:
    """Run an experiment made of its parts, by default the barycentre on the square lattice."""
    usual = {"name": "parts", "lattice": {"type": "square", "a": 1.0}}
    parts = usual | {"rule": {"type": "barycentre"}} | parts
    return Sheet(pbdkit.run(pbdkit.Experiment(**parts), progress=False))


@cache
def run_text(text: str) -> Sheet:
    """Run an experiment in YAML, as printed on a page; each is run once."""
    experiment = pbdkit.Experiment.build(read_text(text, "page"))
    return Sheet(pbdkit.run(experiment, progress=False))


def parted(sheet: Sheet) -> list[int | None]:
    """Return, for each row, the step at which its leader lost its last bond to the next column."""
    ends, steps = sheet.ds["bond_ends"].values - 1, sheet.ds["broken_step"].values
    last = sheet.columns - 1
    first, second = sheet.site[ends[:, 0]], sheet.site[ends[:, 1]]
    inside = sheet.body[ends].all(axis=1)
    across = inside & (np.minimum(first[:, 0], second[:, 0]) == last - 1)
    across &= np.maximum(first[:, 0], second[:, 0]) == last
    torn_row = np.where(first[:, 0] == last, first[:, 1], second[:, 1])
    rows: list[int | None] = []
    for row in range(sheet.rows):
        broken = steps[across & (torn_row == row)]
        rows.append(int(broken.max()) if (broken > 0).all() else None)
    return rows


def edges_first(rows: list[int | None]) -> bool:
    """Return whether both outermost rows part before every other row."""
    late = [10**6 if step is None else step for step in rows]
    return max(late[0], late[-1]) < min(late[1:-1])


def rebound(x: Floats, least: float = 0.01) -> tuple[int, float, float] | None:
    """Return step and value of the first minimum of a series, and the largest value after it, if
    that is at least `least` more; None if there is no such minimum."""
    change = np.diff(x)
    for low in np.flatnonzero((change[:-1] < -1e-9) & (change[1:] > 1e-9)) + 1:
        if x[low:].max() - x[low] >= least:
            return int(low), float(x[low]), float(x[low:].max())
    return None


def in_the_gap(sheet: Sheet) -> int:
    """Return the number of frame points more than 1.5 from both sides of the gap at the end."""
    x, torn = sheet.position[-1, :, 0], sheet.site[:, 0] == sheet.columns - 1
    low, high = x[sheet.body & ~torn].max(), x[sheet.body & torn].min()
    frame = x[~sheet.body]
    return int(((frame > low + 1.5) & (frame < high - 1.5)).sum())


def sweep(name: str, thresholds: Floats, *settings: str) -> dict[float, Sheet]:
    """A case of fracture for 80 steps at several thresholds, those at which every row parts."""
    shells = len(pbdkit.load(name, settings=list(settings)).fracture.thresholds)
    sheets = {
        float(t): run(name, "steps=80", f"fracture.thresholds={[float(t)] * shells}", *settings)
        for t in thresholds
    }
    return {t: sheet for t, sheet in sheets.items() if None not in parted(sheet)}


def steps_text(rows: list[int | None]) -> str:
    """The steps of the rows, bottom to top, in one short text."""
    return " ".join("–" if step is None else str(step) for step in rows)
