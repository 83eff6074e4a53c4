"""Cuts as they are drawn, across the body as it stands, put back to where they are at rest."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces.fracture_model import Segment

Floats = NDArray[np.float64]
SAMPLES = 64
NEAR = 0.25
"""By so many spacings a line may be straightened."""
ALONG, WIDTH = 0.29, 1e-3
"""Where a bond is cut, and how wide: bonds cross each other in the middle."""


def at_rest(line: Segment, positions: Floats, reference: Floats, spacing: float) -> list[Segment]:
    """A line across the body as straight segments at rest, each place moved back as the particle
    next to it."""
    from scipy.spatial import cKDTree

    a, b = np.array(line[0]), np.array(line[1])
    count = min(SAMPLES, 2 + int(2 * math.dist(*line) / spacing))
    places = a + np.linspace(0.0, 1.0, count)[:, None] * (b - a)
    margin = 2 * spacing
    low, high = np.minimum(a, b) - margin, np.maximum(a, b) + margin
    near = ((positions >= low) & (positions <= high)).all(axis=1)
    if not near.any():
        return []
    _, nearest = cKDTree(positions[near]).query(places)
    places = places + (reference[near] - positions[near])[nearest]
    corners = _straightened(places, NEAR * spacing)
    points = [(float(x), float(y)) for x, y in places[corners]]
    return [(a, b) for a, b in pairwise(points) if a != b]


def across(ends: Floats) -> Segment:
    """A short segment at rest that crosses a bond and, of those that cross it, no other."""
    (x, y), way = ends[0], ends[1] - ends[0]
    middle = np.array([x, y]) + ALONG * way
    aside = WIDTH * np.array([-way[1], way[0]])
    (ax, ay), (bx, by) = middle - aside, middle + aside
    return (float(ax), float(ay)), (float(bx), float(by))


def _straightened(places: Floats, tolerance: float) -> list[int]:
    """The corners of a line that nowhere lies farther than that from these places."""
    first, last = places[0], places[-1]
    way, apart = last - first, places - first
    length = math.hypot(*way)
    if length == 0.0:
        distance = np.hypot(*apart.T)
    else:
        share = np.clip(apart @ way / length**2, 0.0, 1.0)
        distance = np.hypot(*(apart - share[:, None] * way).T)
    worst = int(np.argmax(distance))
    if len(places) < 3 or distance[worst] <= tolerance:
        return [0, len(places) - 1]
    before = _straightened(places[: worst + 1], tolerance)
    return before[:-1] + [worst + n for n in _straightened(places[worst:], tolerance)]
