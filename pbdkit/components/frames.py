"""Frames that copy the body particles nearest to them (model.md, section 7)."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from pbdkit.interfaces import FrameMap, FramePolicy, FrameSites


class NoFrame(FramePolicy):
    """No frame: neighbours outside the body are missing."""

    type: Literal["none"] = "none"

    def depth(self, reach: int) -> int:
        """No layer."""
        return 0

    def follow(self, frame: FrameSites) -> FrameMap:
        """Nothing follows."""
        nothing = np.empty(0, np.intp)
        return FrameMap(nothing, nothing, np.empty(0))


class CopyingFrame(FramePolicy):
    """Common to the frames that copy; `layers` defaults to what the neighbour metric reaches.

    With `lag` 1 the frame copies the body's displacements of the step before.
    """

    layers: Annotated[int, Field(ge=1, le=64)] | None = None
    lag: Annotated[int, Field(ge=0, le=1)] = 0

    def depth(self, reach: int) -> int:
        """`layers`, or the reach of the neighbours."""
        return reach if self.layers is None else self.layers


class MeanFrame(CopyingFrame):
    """u_f is the mean of the displacements of the nearest body particles, all that tie."""

    type: Literal["mean"] = "mean"

    def follow(self, frame: FrameSites) -> FrameMap:
        """Weight 1/n for each of n ties."""
        point, body = frame.nearest()
        return FrameMap(point, body, 1.0 / np.bincount(point)[point], self.lag)


class FirstFrame(CopyingFrame):
    """u_f is the displacement of the nearest body particle, the lowest number on ties (case g)."""

    type: Literal["first"] = "first"

    def follow(self, frame: FrameSites) -> FrameMap:
        """The first entry of each frame point."""
        point, body = frame.nearest()
        points, first = np.unique(point, return_index=True)
        return FrameMap(points, body[first], np.ones(len(points)), self.lag)
