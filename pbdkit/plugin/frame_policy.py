"""Interface of frame policies: how frame points follow the body, as a linear map."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Indices
from pbdkit.plugin.component import Component
from pbdkit.plugin.lattice import Cell, Index
from pbdkit.plugin.rule import FollowerRule


@dataclass(frozen=True)
class FrameMap:
    """Linear map to the frame: u of frame point `point[e]` is Σ_e weight[e] · u[body[e]].

    Parameters
    ----------
    point : array of int, shape (entry,)
        Index of the frame point of each entry, in the order of their numbers, sorted.
    body : array of int, shape (entry,)
        Row of the body particle of each entry in the particle table.
    weight : array of float, shape (entry,) or (entry, axis, axis)
        Number or matrix for each entry.
    lag : int
        Delay in steps; with 1 the displacements of the previous step are used.
    """

    point: Indices
    body: Indices
    weight: NDArray[np.float64]
    lag: int = 0


@dataclass(frozen=True)
class FrameSites(ABC):
    """Frame of a scene, as input of a policy.

    Parameters
    ----------
    cell : Cell
        Repeat cell of the lattice.
    site : array of int, shape (point, 2)
        Site index (i, j) of every frame point in the order of the numbers.
    low, high : tuple of int
        Smallest and largest site index of the body.
    """

    cell: Cell
    site: NDArray[np.int32]
    low: Index
    high: Index

    @property
    @abstractmethod
    def rule(self) -> FollowerRule:
        """Rule of the followers with its parameters at a step.

        If the policy uses the rule to create the map, the map is created again whenever these
        parameters change.
        """

    @abstractmethod
    def nearest(self) -> tuple[Indices, Indices]:
        """Return the body particles nearest to each frame point in the reference configuration.

        All particles with a distance of at most d_min (1 + 1e-9) count as nearest.

        Returns
        -------
        point, body : array of int, shape (pair,)
            Frame point and row of the body particle of each pair, sorted by both.
        """

    @abstractmethod
    def body_at(self, site: NDArray[np.int32]) -> Indices:
        """Return the row of the body particle at each site; -1 if there is none.

        Parameters
        ----------
        site : array of int, shape (entry, 2)
            Site indices.

        Returns
        -------
        array of int, shape (entry,)
            Rows.
        """


class FramePolicy(Component):
    """Points around the body that remove the edge effect, and how they follow the body.

    To implement a policy, define `depth` and `follow`. The map is linear and has no memory.
    """

    weighs_cells: ClassVar[bool] = False
    """True if the body consists of cells, each weighted by its share inside the outline.

    Such frames are used with rules that declare `uses_cells`. The corners of cut cells on both
    sides of the outline are then particles of the body.
    """
    local: ClassVar[bool] = False
    """True if each frame point can be mapped independently, to particles near it.

    Particles near a frame point are the nearest particles, or those within a distance of twice the
    number of layers in site index. Several processes then build the frame in parts; otherwise each
    builds the whole frame.
    """
    has_axes: ClassVar[bool] = False
    """True if the map depends on directions or on the order of sites.

    A body that is reflected, or rotated by a right angle, may then move differently.
    """
    edges_are_free: ClassVar[bool] = False
    """True if edges are traction-free under a calibrated rule; otherwise a warning is issued."""

    @abstractmethod
    def depth(self, reach: int) -> int:
        """Return the number of layers of the frame.

        Parameters
        ----------
        reach : int
            Reach of the neighbours in site index.

        Returns
        -------
        int
            Number of layers.
        """

    @abstractmethod
    def follow(self, frame: FrameSites) -> FrameMap:
        """Return the map from displacements of the body to those of the frame.

        Parameters
        ----------
        frame : FrameSites
            Frame points and body particles.

        Returns
        -------
        FrameMap
            Map with an entry for every frame point.
        """


class Anchors:
    """Frame that fixes the body in space: moves change if the body is translated. Under all other
    frames the weights of each point sum to 1, and moves do not change.
    """
