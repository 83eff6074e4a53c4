"""How a force in all is shared by those on whom it acts."""

from __future__ import annotations

import numpy as np

from pbdkit.scene.places import Floats

STRAIGHT = 1e-9
"""Particles that lie off a line by less than this share of its length are on it."""


def shares(at: Floats) -> Floats:
    """(particle,): the part of a force that falls to each of some places, (particle, axis): half
    the way to the next one on both sides where all lie on a line, else all alike."""
    order = np.lexsort(at.T)
    way = at - at[order[0]]
    x, y = along = way[order[-1]]
    squared = along @ along
    if len(at) == 1 or (np.abs(way @ [-y, x]) > STRAIGHT * squared).any():
        return np.full(len(at), 1.0 / len(at))
    half = np.diff((way @ along)[order]) / (2 * squared)
    share = np.empty(len(at))
    share[order] = np.append(half, 0.0) + np.append(0.0, half)
    return share
