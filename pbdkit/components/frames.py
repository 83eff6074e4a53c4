"""Frames that copy or mirror (model.md, section 7), and bodies without one."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from pbdkit.errors import ExperimentError
from pbdkit.plugin import Anchors, Cell, FrameMap, FramePolicy, FrameSites


class Frameless(FramePolicy):
    """Common to bodies without frame points."""

    local: ClassVar[bool] = True

    def depth(self, reach: int) -> int:
        """No layer."""
        return 0

    def follow(self, frame: FrameSites) -> FrameMap:
        """Nothing follows."""
        nothing = np.empty(0, np.intp)
        return FrameMap(nothing, nothing, np.empty(0))


class NoFrame(Frameless):
    """No frame: neighbours outside the body are missing."""

    type: Literal["none"] = "none"


class LayeredFrame(FramePolicy):
    """Common to all frames; `layers` defaults to what the neighbour metric reaches."""

    local: ClassVar[bool] = True
    layers: Annotated[int, Field(ge=1, le=64)] | None = Field(
        None, description="Layers of points; by default what the neighbours reach.", examples=[3]
    )

    def depth(self, reach: int) -> int:
        """`layers`, or the reach of the neighbours."""
        return reach if self.layers is None else self.layers


class CopyingFrame(LayeredFrame):
    """Common to the frames that copy the body particles nearest to them."""

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
        if not is_upright(frame.cell):
            raise ExperimentError("a mirror frame needs a square or rectangular lattice")
        edge = np.clip(frame.site, frame.low, frame.high)
        outside, body = frame.site != edge, frame.body_at(2 * edge - frame.site)
        if (body < 0).any() or not outside.any(axis=1).all():
            raise ExperimentError(
                "a mirror frame needs a body that fills a rectangle of sites wider than the frame"
            )
        flips = np.where(outside, -1.0, 1.0)
        return FrameMap(np.arange(len(body)), body, flips[:, :, None] * np.eye(2))


class Natural(Frameless):
    """No frame: the body is the lattice's cells, and what is not there is dropped.

    Cells that the outline cuts count with the share of their area inside, and all their corners are
    particles of the body, so that curved bodies converge at second order. Edges are free of stress.
    """

    type: Literal["natural"] = "natural"

    weighs_cells: ClassVar[bool] = True
    edges_are_free: ClassVar[bool] = True


def is_upright(cell: Cell) -> bool:
    """Whether it is that of a square or rectangular lattice along the axes."""
    a, b = cell.vectors
    return cell.period == (1, 1) and a.y == b.x == 0.0
