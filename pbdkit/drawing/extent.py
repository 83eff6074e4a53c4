"""What several steps of a body cover: the place that they take, and the values that they have."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.drawing.look import Look
from pbdkit.drawing.recording import Recording, Snapshot
from pbdkit.errors import ExperimentError

Array = NDArray[Any]
Box = tuple[float, float, float, float]
MARGIN = 0.015
"""So much of the longer side is left free around a body, and the distance of particles at least."""
THINNEST = 40.0
"""A body so many times as long as broad is not drawn thinner."""


@dataclass(frozen=True)
class Extent:
    """What several steps cover: the `box` (left, right, bottom, top) that holds them, the lowest
    and the highest value of the body and of all, frame and all, and the kinds, and classes of the
    quantity, that are there."""

    box: Box
    of_body: tuple[float, float]
    of_all: tuple[float, float]
    kinds: frozenset[int]
    classes: frozenset[int]


def extent_of(recording: Recording, shown: Iterable[Snapshot], look: Look) -> Extent:
    """What steps of a recording cover, looked at one after another. Raises
    ExperimentError where no particle has a place in them."""
    body, quantity = recording.body, recording.quantity
    reference = body.reference if look.outline else np.empty((0, 2))
    low, high = [reference.min(axis=0, initial=np.inf)], [reference.max(axis=0, initial=-np.inf)]
    inner, outer, kinds, classes = [], [], set[int](), set[int]()
    inside = body.inside if quantity is None or quantity.owner == "particle" else slice(None)
    for now in shown:
        place = now.position[np.isfinite(now.position).all(axis=1)]
        low.append(place.min(axis=0, initial=np.inf))
        high.append(place.max(axis=0, initial=-np.inf))
        kinds |= _numbers(now.kind)
        if now.values is not None:
            inner.append(_range(now.values[inside]))
            outer.append(_range(now.values))
            if quantity and quantity.words:
                classes |= _numbers(now.values)
    lowest, highest = np.min(low, axis=0), np.max(high, axis=0)
    if not (lowest <= highest).all():
        raise ExperimentError("no particle has a place in what is to be drawn: positions are NaN")
    margin = max(body.spacing, MARGIN * float(np.max(highest - lowest)))
    (left, bottom), (right, top) = lowest - margin, highest + margin
    box = _no_thinner(left, right, bottom, top)
    return Extent(box, _joined(inner), _joined(outer), frozenset(kinds), frozenset(classes))


def joined(extents: Sequence[Extent]) -> Extent:
    """What several cover together."""
    boxes = np.array([e.box for e in extents])
    (left, _, bottom, _), (_, right, _, top) = boxes.min(axis=0), boxes.max(axis=0)
    return Extent(
        _no_thinner(left, right, bottom, top),
        _joined([e.of_body for e in extents]),
        _joined([e.of_all for e in extents]),
        frozenset().union(*(e.kinds for e in extents)),
        frozenset().union(*(e.classes for e in extents)),
    )


def _no_thinner(left: float, right: float, bottom: float, top: float) -> Box:
    least = max(right - left, top - bottom) / THINNEST
    across, up = (max(0.0, least - side) / 2 for side in (right - left, top - bottom))
    return (float(left - across), float(right + across), float(bottom - up), float(top + up))


def _numbers(of: Array) -> set[int]:
    """Which small whole numbers there are."""
    found = of[np.isfinite(of)].astype(int)
    return {int(low) for low in np.flatnonzero(np.bincount(found))}


def _range(values: Array) -> tuple[float, float]:
    """The lowest and the highest; NaN twice where there is none."""
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if len(finite) else (np.nan, np.nan)


def _joined(ranges: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """That of all of them; 0 to 1 where there are none."""
    found = [r for r in ranges if np.isfinite(r[0])]
    return (min(r[0] for r in found), max(r[1] for r in found)) if found else (0.0, 1.0)
