"""A dataset as one page of HTML that needs no network: ``pbdkit.report`` and `pbdkit report`."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pbdkit.pages.page import page
from pbdkit.pages.run_content import RunContent
from pbdkit.pages.speed import speed
from pbdkit.pages.sweep_content import SweepContent
from pbdkit.results.members import SWEEP
from pbdkit.results.older_layout import in_this_layout
from pbdkit.results.result_file import reading
from pbdkit.storage.destination import write

if TYPE_CHECKING:
    import xarray

BUDGET = 4_900_000
"""Bytes of a page, at most."""
FIRST, MOST = 20_000_000, 80_000_000
"""Bytes of the lattice before it is packed: in the first attempt, and what a browser still moves
well. How much smaller they become depends on the motion, and is known only then."""
ATTEMPTS, SMALL = 4, 0.6
"""A page that is thinned and smaller than that share of the budget is made again with more."""


def report(
    dataset: xarray.Dataset | str | Path,
    path: str | Path,
    *,
    bench: str | Path | None = None,
    replace: bool = True,
) -> Path:
    """Writes the page of a run or of a sweep, and returns its path. The page appears whole or not
    at all, with `replace` in the place of an earlier one.

    The page has the moving lattice, the histories of particles and bonds, curves, what was
    predicted, what broke, and how to run it again. It takes 5 MB at most: of more steps or
    particles some are left out, and the page says which. `bench` is a file that
    ``pbdkit bench --json`` wrote.

    Raises ExperimentError for a dataset without positions, and StorageError for files that cannot
    be read or written.
    """
    measured = speed(Path(bench)) if bench is not None else None
    with _reading(dataset) as read:
        text = report_text(read, measured)
    write(Path(path), text, replace=replace)
    return Path(path)


def report_text(dataset: xarray.Dataset, measured: dict[str, Any] | None = None) -> str:
    """The page, with the figures of `speed` where there are any."""
    content = (SweepContent if SWEEP in dataset.attrs else RunContent)(dataset)
    budget, best = FIRST, ""
    for _ in range(ATTEMPTS):
        held = content.within(budget)
        text = page(held | {"speed": measured})
        fits = len(text) <= BUDGET
        if not best or (fits and len(text) > len(best)) or len(best) > BUDGET:
            best = text
        enough = not held["thinned"] or len(text) > SMALL * BUDGET or budget == MOST
        if fits and enough:
            break
        budget = min(int(0.9 * budget * BUDGET / len(text)), MOST)
    return best


def _reading(dataset: xarray.Dataset | str | Path) -> AbstractContextManager[xarray.Dataset]:
    if isinstance(dataset, str | Path):
        return reading(dataset, sweeps=True)
    return nullcontext(in_this_layout(dataset))
