"""Whether a state is inside out: a rule of positions does not mind, a body does."""

from __future__ import annotations

import numpy as np

from pbdkit.components.diagnostics import smallest_corner_area
from pbdkit.results.moment import StateMoment

TURNED = -1e-6
"""A share of the area at rest; nearer to zero it is rounding, of single precision too."""


def inside_out(moment: StateMoment) -> str | None:
    """A warning where cells have turned over, with how many and a particle of the worst; None where
    none has. Torn cells do not count: the parts of a broken body go their own ways."""
    turned = total = number = 0
    worst = 0.0
    for patch, counted in moment.patches(intact_only=True):
        with np.errstate(all="ignore"):
            area = smallest_corner_area(moment.corners(patch), patch.cell.rest)
            area = np.where(counted & (area < TURNED), area, 0.0)
        turned += int(np.count_nonzero(area))
        total += int(np.count_nonzero(counted))
        place = int(area.argmin())
        if area.flat[place] < worst:
            worst, number = float(area.flat[place]), moment.number_at(patch, place)
    if not turned:
        return None
    return (
        f"the last state is inside out: {turned} of {total} cells have turned over, the worst, at "
        f"particle {number}, to {worst:.3g} of its area at rest; let the leaders go less far, or "
        "weaken the rule where it couples x and y"
    )
