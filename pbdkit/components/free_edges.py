"""Edges that are free of stress, for rules that are calibrated to a material."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from pbdkit.interfaces import FrameMap, FramePolicy, FrameSites


class Natural(FramePolicy):
    """No frame: the body is the lattice's cells, and what is not there is dropped.

    Cells that the outline cuts count with the share of their area inside, and all their corners are
    particles of the body, so that curved bodies converge at second order. Edges are free of stress.
    """

    type: Literal["natural"] = "natural"

    weighs_cells: ClassVar[bool] = True
    edges_are_free: ClassVar[bool] = True

    def depth(self, reach: int) -> int:
        """No layer."""
        return 0

    def follow(self, frame: FrameSites) -> FrameMap:
        """Nothing follows."""
        nothing = np.empty(0, np.intp)
        return FrameMap(nothing, nothing, np.empty(0))
