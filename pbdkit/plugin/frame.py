"""The FramePolicy interface: how the frame follows the body, as a linear map."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pbdkit.plugin.component import Component
from pbdkit.plugin.lattice import Cell, Index
from pbdkit.plugin.rule import FollowerRule

Indices = NDArray[np.intp]


@dataclass(frozen=True)
class FrameMap:
    """u of frame point `point[e]` is the sum over its entries e of weight[e] · u[body[e]].

    `point` counts the frame points from 0 in the order of their numbers, sorted; `body` are
    rows of the particle table. `weight` is a number an entry, (entry,), or a matrix an entry,
    (entry, axis, axis). With `lag` 1 the body's displacements of the step before count.
    """

    point: Indices
    body: Indices
    weight: NDArray[np.float64]
    lag: int = 0


@dataclass(frozen=True)
class FrameSites(ABC):
    """The frame of a scene, as a policy sees it: the lattice's `cell`, the `site` index (i, j)
    of every frame point in the order of the numbers, (point, 2), the smallest and largest
    site index of the body, `low` and `high`, and the `rule` of the followers."""

    cell: Cell
    site: NDArray[np.int32]
    low: Index
    high: Index

    @property
    @abstractmethod
    def rule(self) -> FollowerRule:
        """The rule of the followers, with the numbers that it has in a step. A map that was made
        with it is made again wherever these numbers change."""

    @abstractmethod
    def nearest(self) -> tuple[Indices, Indices]:
        """(point, body): each frame point with every body particle that is nearest to it in the
        reference configuration, distance ≤ d_min(1 + 1e-9); sorted by both."""

    @abstractmethod
    def body_at(self, site: NDArray[np.int32]) -> Indices:
        """The row of the body particle at each site (i, j), (entry, 2); -1 where there is none."""


class FramePolicy(Component):
    """The points around the body that remove the edge effect, and how they follow it.

    To add a policy, write `depth` and `follow`. The map is linear and has no memory.
    """

    weighs_cells: ClassVar[bool] = False
    """Whether the body is made of the lattice's cells, each weighted by the share of it that lies
    inside the outline; for rules that declare `uses_cells`. The corners of cut cells are then
    particles of the body, on whichever side of the outline they lie."""
    local: ClassVar[bool] = False
    """Whether each point is told of by itself, and follows particles that are nearest to it, or no
    farther off than twice the layers in site index. Several processes then build the frame in
    parts; else each of them builds the whole."""
    has_axes: ClassVar[bool] = False
    """Whether directions, or the order of the sites, count: mirrored, or turned by a right angle, a
    body may then move otherwise."""
    edges_are_free: ClassVar[bool] = False
    """Whether edges are free of stress under a calibrated rule; where not, a warning says so."""

    @abstractmethod
    def depth(self, reach: int) -> int:
        """How many layers the frame has; `reach` is what the neighbours reach, in site index."""

    @abstractmethod
    def follow(self, frame: FrameSites) -> FrameMap:
        """The map from body displacements to the frame's; every frame point needs an entry."""


class Anchors:
    """A frame that ties the body to its place: a translated body then moves otherwise. Of other
    frames the weights of each point sum to 1."""
