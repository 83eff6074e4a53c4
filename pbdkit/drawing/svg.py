"""A small writer of SVG: shapes in lattice coordinates, text that is escaped."""

from __future__ import annotations

import math
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]
HEAD = 7.0
"""The length of an arrow's head, pixels."""


class Svg:
    """A picture of the coordinates from `low` to `high` within so many pixels, `margin` around
    them: with it the picture reaches from `self.low` to `self.high`. y goes up. Shapes stand in the
    order in which they are added."""

    def __init__(
        self, low: Floats, high: Floats, within: tuple[float, float], margin: float
    ) -> None:
        size = np.maximum(high - low, 1e-9 * max(1.0, *np.abs(high), *np.abs(low)))
        self.scale = float(((np.array(within) - 2.0 * margin) / size).min())
        self.width, self.height = (float(s) for s in size * self.scale + 2.0 * margin)
        self._origin = np.array([margin - low[0] * self.scale, margin + high[1] * self.scale])
        self.low: Floats = self._origin * (-1.0, 1.0) / self.scale - (0.0, self.height / self.scale)
        self.high: Floats = self.low + np.array([self.width, self.height]) / self.scale
        self._shapes: list[str] = []

    def at(self, places: Floats) -> Floats:
        """The pixels of places, (..., axis)."""
        return np.asarray(self._origin + np.asarray(places) * (self.scale, -self.scale))

    def dots(
        self,
        places: Floats,
        size: float,
        colour: str,
        *,
        square: bool = False,
        opacity: float = 1.0,
    ) -> None:
        """Dots of one size, pixels: one path for all, as many elements are slow to show."""
        path = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in self.at(places))
        cap = "square" if square else "round"
        style = f'stroke="{colour}" stroke-width="{size:.2f}" stroke-linecap="{cap}"'
        self._add(f'<path d="{path}" {style} stroke-opacity="{opacity:g}"/>' if path else "")

    def line(self, places: Floats, colour: str, width: float, dashes: str = "") -> None:
        """A line from place to place; `dashes` as SVG writes them."""
        path = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in self.at(places))
        dashed = f' stroke-dasharray="{dashes}"' if dashes else ""
        style = f'fill="none" stroke="{colour}" stroke-width="{width:g}" stroke-linecap="round"'
        self._add(f'<path d="{path}" {style}{dashed}/>')

    def filled(self, outlines: list[Floats], fill: str, edge: str) -> None:
        """What lies between closed outlines: an inner one is a hole."""
        parts = ("M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in self.at(o)) + "Z" for o in outlines)
        style = f'fill="{fill}" stroke="{edge}" fill-rule="evenodd"'
        self._add(f'<path d="{"".join(parts)}" {style}/>')

    def arrow(self, tail: Floats, way: Floats, colour: str) -> None:
        """An arrow from a place, by so many pixels, y up."""
        (x, y), (dx, dy) = self.at(tail), (float(way[0]), -float(way[1]))
        length = math.hypot(dx, dy)
        if length < 1e-9:
            return
        ux, uy = dx / length, dy / length
        tip, neck = (x + dx, y + dy), max(length - HEAD, 0.0)
        a, b = (
            (tip[0] - HEAD * ux + s * 0.5 * HEAD * uy, tip[1] - HEAD * uy - s * 0.5 * HEAD * ux)
            for s in (1.0, -1.0)
        )
        shaft = f"M{x:.1f} {y:.1f}L{x + neck * ux:.1f} {y + neck * uy:.1f}"
        head = "".join(f"{c}{p:.1f} {q:.1f}" for c, (p, q) in zip("MLL", (tip, a, b), strict=True))
        self._add(
            f'<path d="{shaft}" stroke="{colour}" stroke-width="1.6" fill="none"/>'
            f'<path d="{head}Z" fill="{colour}"/>'
        )

    def text(self, title: str) -> str:
        """The whole as an element of HTML, with what it says to those who do not see it."""
        w, h = f"{self.width:.0f}", f"{self.height:.0f}"
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{w}" height="{h}" '
            f'viewBox="0 0 {w} {h}" role="img" aria-label="{escape(title)}">'
            f'<rect width="{w}" height="{h}" fill="#FFFFFF"/>{"".join(self._shapes)}</svg>'
        )

    def _add(self, shape: str) -> None:
        self._shapes.append(shape)
