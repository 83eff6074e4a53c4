"""How a force in all is shared by those on whom it acts."""

from __future__ import annotations

import numpy as np

from pbdkit.interfaces.frame import Indices
from pbdkit.scene.places import Floats
from pbdkit.scene.raster import Raster

STRAIGHT = 1e-9
"""Particles that lie off a line by less than this share of its length are on it."""


def shares_of(raster: Raster, rows: Indices) -> Floats:
    """(particle,): the parts of a force on all that are selected, of those that a raster has."""
    own = raster.others.is_own(raster.site_of(rows)[:, 0])
    every = raster.others.every((raster.before + rows[own], raster.reference(rows[own])))
    numbers, at = (np.concatenate(part) for part in zip(*every, strict=True))
    return np.asarray(shares(at)[np.searchsorted(numbers, raster.before + rows)])


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
