"""Dots, lines or pixels: what is legible where particles lie so far apart on the page."""

from __future__ import annotations

from dataclasses import dataclass

from pbdkit.drawing.look import Look
from pbdkit.drawing.quantity import Quantity
from pbdkit.drawing.recording import Body
from pbdkit.errors import ExperimentError

ROOMY_PT, LINED_PT, CROWDED_PT = 8.0, 5.0, 2.4
"""Distances of particles on the page: from the first on a field leaves room for dots, from the
second on bonds are lines of their own, below the third particles are pixels."""
DETAILED, MANY_BONDS = 50_000, 200_000
"""More particles than that are never dots, nor more bonds lines."""


@dataclass(frozen=True)
class Manner:
    """`filled`: there is a field. `crowded`: particles are no dots, unless that is asked for.
    `lined`: whole bonds are lines. `dots` are the quantity's ("values"), its classes ("classes"),
    the kinds of particles beside something else in colour ("kinds"), or none (""). `apart` is how
    far from one another particles lie on the page, in points."""

    filled: bool
    crowded: bool
    lined: bool
    dots: str
    apart: float

    @property
    def dot(self) -> float:
        """The diameter of a dot in points."""
        share, most = {"values": (0.62, 9.0), "classes": (0.45, 7.0)}.get(self.dots, (0.3, 5.0))
        return min(share * self.apart, most)

    @property
    def alone(self) -> float:
        """That of a particle beside a field; 0 where it would be next to nothing."""
        size = min(0.62 * self.apart, 9.0)
        return size if size > 1.0 else 0.0

    @property
    def line(self) -> float:
        """The width of a bond in points."""
        return min(max(0.05 * self.apart, 0.25), 0.8)


def manner_of(body: Body, quantity: Quantity, look: Look, apart: float) -> Manner:
    """What is asked for, and else what is legible. Raises ExperimentError where what is asked for
    is not there or would be too much."""
    crowded = len(body.reference) > DETAILED or apart < CROWDED_PT
    of_bonds, filled = quantity.owner == "bond", _is_filled(body, quantity, look, apart)
    if quantity.words:
        dots = "" if crowded else "classes"
    elif filled or of_bonds:
        dots = "kinds" if apart >= ROOMY_PT and not crowded else ""
    else:
        dots = "values"
    return Manner(filled, crowded, _is_lined(body, of_bonds, filled, look, apart), dots, apart)


def _is_filled(body: Body, quantity: Quantity, look: Look, apart: float) -> bool:
    many = len(body.reference) > DETAILED
    can, asked = quantity.owner == "particle" and not quantity.words, look.contours or look.filled
    if asked and not can:
        raise ExperimentError(
            f"contours need numbers at particles as color, and '{quantity.variable}' has none; "
            "leave them out, or name another variable"
        )
    if look.filled is False and many:
        raise ExperimentError(
            f"{len(body.reference)} particles are too many for dots; at most {DETAILED}"
        )
    wanted = asked or (look.filled is None and can and (many or apart < ROOMY_PT))
    if wanted and not len(body.cells):
        if asked or many:
            raise ExperimentError("contours need a body of particles that are not in line")
        return False
    return bool(wanted)


def _is_lined(body: Body, of_bonds: bool, filled: bool, look: Look, apart: float) -> bool:
    asked, many = look.bonds or look.broken, len(body.ends) > MANY_BONDS
    if asked and not len(body.ends):
        raise ExperimentError(
            "there are no bonds to draw: a dataset has them where there is fracture, a cut, or a "
            "diagnostic that uses them"
        )
    if asked and many:
        raise ExperimentError(f"{len(body.ends)} bonds are too many to draw; at most {MANY_BONDS}")
    if look.bonds is not None:
        return look.bonds
    return not many and (of_bonds or (not filled and apart >= LINED_PT))
