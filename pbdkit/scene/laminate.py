"""The stiffness of a cell that a border of two materials cuts: of layers along the border."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
ACROSS, ALONG = [0, 2], [1]
"""Which of the components (normal, tangential, shear) the layers share as stress, and as strain."""

ROUND = 1e-6
"""A border whose directions are as evenly spread as this has none: a square within a cell."""
DIRECTIONS = 12
"""Over so many the stiffness is then averaged: as many as turn every lattice into itself."""


def layered(outer: Floats, inner: Floats, share: Floats, facing: Floats) -> Floats:
    """(cell, 3, 3): the stiffness of cells of which the border faces so, (cell, 2, 2), the sum of
    n nᵀ over its length: a laminate along its main direction, or where it has none the mean of
    laminates of all directions."""
    whole = facing[:, 0, 0] + facing[:, 1, 1]
    spread = np.array([facing[:, 0, 0] - facing[:, 1, 1], 2 * facing[:, 0, 1]])
    # Borders along an axis are along it to the last bit.
    spread[np.abs(spread) <= 1e-9 * whole] = 0.0
    angle = np.arctan2(spread[1], spread[0]) / 2
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    normal[(spread[1] == 0.0) & (spread[0] < 0.0)] = [0.0, 1.0]
    found = laminate(outer, inner, share, normal)
    even = np.hypot(*spread) <= ROUND * whole
    if even.any():
        parts = outer[even], inner[even], share[even]
        angles = np.pi / DIRECTIONS * np.arange(DIRECTIONS)
        turned = [
            laminate(*parts, np.tile([np.cos(a), np.sin(a)], (len(parts[0]), 1))) for a in angles
        ]
        found[even] = sum(turned) / DIRECTIONS
    return found


def laminate(outer: Floats, inner: Floats, share: Floats, normal: Floats) -> Floats:
    """(cell, 3, 3): the stiffness of layers, `share` (cell,) of them of the material `inner` and
    the rest of `outer`, (cell, 3, 3) in the components xx, yy, xy with the angle of shear, under
    the `normal` (cell, 2).

    The tractions across the layers and the strain along them are the same in both (Backus 1962):
    harmonic means across, arithmetic along.
    """
    turn = _to_layers(normal)
    back = _to_layers(normal * [1.0, -1.0])
    of, one = (np.swapaxes(back, 1, 2) @ c @ back for c in (outer, inner))
    f = share[:, None, None]

    def mean(value: Floats, other: Floats) -> Floats:
        return (1.0 - f) * value + f * other

    pieces = [_pieces(c) for c in (of, one)]
    soft, follows, own = (mean(a, b) for a, b in zip(*pieces, strict=True))
    found = np.empty_like(outer)
    across = np.linalg.inv(soft)
    both = across @ follows
    found[:, ACROSS[0], ACROSS[0]], found[:, 0, 2] = across[:, 0, 0], across[:, 0, 1]
    found[:, 2, 0], found[:, 2, 2] = across[:, 1, 0], across[:, 1, 1]
    found[:, ACROSS, 1], found[:, 1, ACROSS] = both[:, :, 0], both[:, :, 0]
    found[:, 1, 1] = (own + np.swapaxes(follows, 1, 2) @ both)[:, 0, 0]
    return np.asarray(np.swapaxes(turn, 1, 2) @ found @ turn)


def _pieces(c: Floats) -> tuple[Any, Any, Any]:
    """Of one material in the layers' axes: compliance across, C_nn⁻¹; C_nn⁻¹ C_nt; and what stands
    along for itself, C_tt - C_tn C_nn⁻¹ C_nt."""
    across, to = c[:, ACROSS][:, :, ACROSS], c[:, ACROSS][:, :, ALONG]
    soft = np.linalg.inv(across)
    follows = soft @ to
    return soft, follows, c[:, ALONG][:, :, ALONG] - np.swapaxes(to, 1, 2) @ follows


def _to_layers(normal: Floats) -> Floats:
    """(cell, 3, 3): from strains (x, y, angle) to (normal, tangential, angle)."""
    c, s = normal.T
    return np.moveaxis(
        np.array(
            [[c * c, s * s, c * s], [s * s, c * c, -c * s], [-2 * c * s, 2 * c * s, c * c - s * s]]
        ),
        -1,
        0,
    )
