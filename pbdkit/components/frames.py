"""Frame policies: frames that copy or mirror the body, and bodies without a frame."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from pbdkit.errors import ExperimentError
from pbdkit.plugin import Anchors, Cell, FrameMap, FramePolicy, FrameSites


class Frameless(FramePolicy):
    """Base class of the frame policies without frame points."""

    local: ClassVar[bool] = True

    def depth(self, reach: int) -> int:
        """Return 0, the number of frame layers."""
        return 0

    def follow(self, frame: FrameSites) -> FrameMap:
        """Return an empty map."""
        empty = np.empty(0, np.intp)
        return FrameMap(empty, empty, np.empty(0))


class NoFrame(Frameless):
    """No frame: neighbours outside the body are missing."""

    type: Literal["none"] = "none"


class LayeredFrame(FramePolicy):
    """Base class of the frame policies with frame points in layers around the body.

    `layers` defaults to the reach of the neighbour metric.
    """

    local: ClassVar[bool] = True
    layers: Annotated[int, Field(ge=1, le=64)] | None = Field(
        None, description="Number of layers; by default the reach of the neighbours.", examples=[3]
    )

    def depth(self, reach: int) -> int:
        """Return `layers`, or the reach of the neighbours if `layers` is not set."""
        return reach if self.layers is None else self.layers


class CopyingFrame(LayeredFrame):
    """Base class of the frame policies in which points copy the nearest body particles."""

    lag: Annotated[int, Field(ge=0, le=1)] = Field(
        0, description="Delay in steps; 1 uses displacements of the last step.", examples=[1]
    )


class MeanFrame(CopyingFrame):
    """Frame points move by the mean displacement of the nearest body particles.

    If several particles are equally near, it is the mean of all of them.
    """

    type: Literal["mean"] = "mean"

    def follow(self, frame: FrameSites) -> FrameMap:
        """Return a map with the weight 1/n for each of n nearest particles."""
        point, body = frame.nearest()
        return FrameMap(point, body, 1.0 / np.bincount(point)[point], self.lag)


class FirstFrame(CopyingFrame):
    """Frame points have the displacement of the nearest body particle.

    If several particles are equally near, it is the one with the lowest number.

    The paper uses this frame in case g.
    """

    type: Literal["first"] = "first"

    def follow(self, frame: FrameSites) -> FrameMap:
        """Return a map from each frame point to the nearest particle with the lowest number."""
        point, body = frame.nearest()
        points, first = np.unique(point, return_index=True)
        return FrameMap(points, body[first], np.ones(len(points)), self.lag)


class MirrorFrame(Anchors, LayeredFrame):
    """Frame points mirror the displacement of body particles: u_f = R u_b.

    The site of b is the site of the frame point f, reflected in the outermost row or column of the
    body. R changes the sign of the component normal to that row or column, and at corners the signs
    of both components. In the paper such a frame represents an infinite sample. The lines of
    reflection are fixed in space. The frame requires a body that fills a rectangle of a square or
    rectangular lattice.
    """

    type: Literal["mirror"] = "mirror"

    def follow(self, frame: FrameSites) -> FrameMap:
        """Return a map with one particle and one matrix R for each frame point."""
        if not is_upright(frame.cell):
            raise ExperimentError("a mirror frame requires a square or rectangular lattice")
        edge = np.clip(frame.site, frame.low, frame.high)
        outside, body = frame.site != edge, frame.body_at(2 * edge - frame.site)
        if (body < 0).any() or not outside.any(axis=1).all():
            raise ExperimentError(
                "a mirror frame requires a rectangular body of more rows and columns than the "
                "frame has layers"
            )
        flips = np.where(outside, -1.0, 1.0)
        return FrameMap(np.arange(len(body)), body, flips[:, :, None] * np.eye(2))


class Natural(Frameless):
    """No frame points; the body consists of the cells of the lattice.

    A cell that the outline cuts is weighted by the fraction of its area inside the outline, and all
    its corners are particles of the body. The error for curved bodies is therefore of second order
    in the lattice constant. Free edges have no traction.
    """

    type: Literal["natural"] = "natural"

    weighs_cells: ClassVar[bool] = True
    edges_are_free: ClassVar[bool] = True


def is_upright(cell: Cell) -> bool:
    """Return whether the cell is the repeat cell of a square or rectangular lattice along the
    axes."""
    a, b = cell.vectors
    return cell.period == (1, 1) and a.y == b.x == 0.0
