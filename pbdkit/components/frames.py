"""Frames that copy or mirror the body particles next to them (model.md, section 7)."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from pbdkit.errors import ExperimentError
from pbdkit.interfaces import Anchors, FrameMap, FramePolicy, FrameSites


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


class LayeredFrame(FramePolicy):
    """Common to all frames; `layers` defaults to what the neighbour metric reaches."""

    layers: Annotated[int, Field(ge=1, le=64)] | None = Field(
        None, description="Layers of points; by default what the neighbours reach.", examples=[3]
    )

    def depth(self, reach: int) -> int:
        """`layers`, or the reach of the neighbours."""
        return reach if self.layers is None else self.layers


class CopyingFrame(LayeredFrame):
    """Common to the frames that copy the body particles nearest to them.

    With `lag` 1 they copy the displacements of the step before.
    """

    lag: Annotated[int, Field(ge=0, le=1)] = Field(
        0, description="1 copies the displacements of the step before.", examples=[1]
    )


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


class MirrorFrame(Anchors, LayeredFrame):
    """u_f = R u_b, b the site reflected in the outermost body row or column and R flipping the
    component normal to it, both at corners: the paper's mirroring to obtain an infinite sample.

    The planes of reflection stand in space. For bodies that fill a rectangle of a square or
    rectangular lattice.
    """

    type: Literal["mirror"] = "mirror"

    def follow(self, frame: FrameSites) -> FrameMap:
        """One entry a point, with the matrix R."""
        a, b = frame.cell.vectors
        if frame.cell.period != (1, 1) or a.y != 0.0 or b.x != 0.0:
            raise ExperimentError("a mirror frame needs a square or rectangular lattice")
        low, high = np.array(frame.low), np.array(frame.high)
        outside = (frame.site < low) | (frame.site > high)
        mirrored = np.where(frame.site < low, 2 * low - frame.site, frame.site)
        mirrored = np.where(frame.site > high, 2 * high - frame.site, mirrored)
        body = frame.body_at(mirrored)
        if (body < 0).any() or not outside.any(axis=1).all():
            raise ExperimentError(
                "a mirror frame needs a body that fills a rectangle of sites wider than the frame"
            )
        flips = np.where(outside, -1.0, 1.0)
        return FrameMap(np.arange(len(body)), body, flips[:, :, None] * np.eye(2))
