"""In which order to eliminate unknowns that lie in a plane: nested dissection.

A. George, Nested dissection of a regular finite element mesh, SIAM J. Numer. Anal. 10 (1973): a
strip that the couplings cannot leap over parts the body in two, which do not fill in each other's
entries. Both are parted in the same way, the strip comes last. SuperLU has no such order of its
own: without it elastic bodies of some thousand particles take 1.4 to 1.8 times as long.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.intp]

FEWEST, LEAF = 1000, 40
"""Places from which dissection pays (measured), and so few that they are parted no further."""
TINY = 1e-300
WIDEST = 0.25
"""The share of all places that the first strip may take for dissection to be worth its while."""


def dissected(matrix: Any, places: Floats) -> Indices | None:
    """The unknowns of a sparse matrix, in the order of elimination; `places` (unknown, axis) says
    where they lie, those of one place next to each other. None where couplings reach too far, or
    where there are few places."""
    fresh = np.ones(len(places), bool)
    fresh[1:] = (places[1:] != places[:-1]).any(axis=1)
    sites, every = places[fresh], np.arange(np.count_nonzero(fresh))
    reach = _reach(matrix, places)
    first = _halves(sites, every, reach) if len(every) > FEWEST else None
    if first is None or len(first[2]) > WIDEST * len(every):
        return None
    order: list[Indices] = []
    _dissect(sites, every, reach, order)
    rank = np.empty_like(every)
    rank[np.concatenate(order)] = every
    return np.argsort(rank[np.cumsum(fresh) - 1], kind="stable")


def _reach(matrix: Any, places: Floats) -> Floats:
    """How far couplings reach along each axis; a hair more, for rounding, and never nothing."""
    row, column = matrix.tocoo().coords
    found = [float(np.abs(x[row] - x[column]).max(initial=0.0)) for x in places.T.copy()]
    return 1.001 * np.array(found) + 1e-9 * np.ptp(places) + TINY


def _dissect(places: Floats, some: Indices, reach: Floats, order: list[Indices]) -> None:
    halves = _halves(places, some, reach) if len(some) > LEAF else None
    if halves is None:
        order.append(some)
        return
    below, above, strip = halves
    _dissect(places, below, reach, order)
    _dissect(places, above, reach, order)
    order.append(strip)


def _halves(
    places: Floats, some: Indices, reach: Floats
) -> tuple[Indices, Indices, Indices] | None:
    """Those below a strip across the longer side, those above it, and the strip; None where it
    leaves nobody on one side."""
    here = places[some]
    sides = np.ptp(here, axis=0)
    axis = int(sides[1] / reach[1] > sides[0] / reach[0])
    along, width = here[:, axis], reach[axis]
    middle = np.partition(along, len(along) // 2)[len(along) // 2] - width / 2
    below, above = along <= middle, along > middle + width
    if not (below.any() and above.any()):
        return None
    return some[below], some[above], some[~(below | above)]
