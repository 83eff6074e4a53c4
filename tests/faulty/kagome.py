"""A lattice of three sites a cell, and a rule that works nowhere else; neither has a fault."""

from __future__ import annotations

import math
from typing import Literal

from faulty.rules import Sound

import pbdkit
from pbdkit.plugin import (
    BasisSite,
    Cell,
    Vector,
)


class Kagome(pbdkit.Lattice):
    """The kagome lattice: corners of triangles that share them."""

    type: Literal["kagome"] = "kagome"

    def cell(self):
        half, height = 1.0, math.sqrt(3.0)
        right = BasisSite(Vector(half, 0.0), (1, 0), (1, 0))
        above = BasisSite(Vector(half / 2, height / 2), (0, 1), (0, 1))
        return Cell(
            (Vector(2 * half, 0.0), Vector(half, height)),
            (BasisSite(), right, above),
            period=(2, 2),
            primitive=((2, 0), (0, 2)),
        )


class OnKagome(Sound):
    """The mean displacement of the four neighbours of a kagome lattice."""

    type: Literal["on-kagome"] = "on-kagome"

    def parameters(self, setting):
        if len(setting.cell.sites) != 3:
            raise pbdkit.ExperimentError("'on-kagome' works on the kagome lattice alone")
        return {}
