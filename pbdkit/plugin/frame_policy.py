"""Interface of frame policies, which determine frame points by a linear map from the body."""

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
    """Linear map from the body to the frame.

    The displacement of a frame point p is Σ weight[e] · u[body[e]] over all entries e with
    `point[e]` = p.

    Parameters
    ----------
    point : array of int, shape (entry,)
        Index of the frame point of each entry, sorted. Frame points are counted in the order of
        their numbers.
    body : array of int, shape (entry,)
        Row of the body particle of each entry in the table of particles.
    weight : array of float, shape (entry,) or (entry, axis, axis)
        Number or matrix for each entry.
    delay : int
        Delay in steps: with 1 the frame is computed from the displacements of the previous step.
    """

    point: Indices
    body: Indices
    weight: NDArray[np.float64]
    delay: int = 0


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

        If `follow` reads this rule, pbdkit computes the map again whenever the parameters change.
        """

    @abstractmethod
    def nearest(self) -> tuple[Indices, Indices]:
        """Return the body particles nearest to each frame point in the reference configuration.

        If d_min is the smallest distance, all particles with a distance of at most d_min (1 + 1e-9)
        are nearest ones.

        Returns
        -------
        point, body : array of int, shape (pair,)
            Frame point and row of the body particle of each pair, sorted by frame point and then by
            row.
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
    """Points around the body that replace missing neighbours at its edges and follow its motion.

    To implement a policy, define `depth` and `follow`. The map of `follow` is linear and depends
    only on the displacements of one step.
    """

    weighs_cells: ClassVar[bool] = False
    """True if the body consists of cells that are weighted by their area fractions inside the
    outline.

    Such frames are used with rules that declare `uses_cells`. All corners of cells that the outline
    cuts are then particles of the body, inside and outside the outline.
    """
    local: ClassVar[bool] = False
    """True if each frame point can be mapped independently of the others, to particles near it.

    A particle is near a frame point if it is one of the nearest ones, or if its site index differs
    by at most twice the number of layers. Several processes then each build a part of the frame;
    otherwise each process builds the whole frame.
    """
    has_axes: ClassVar[bool] = False
    """True if the map depends on directions or on the order of sites.

    A body that is reflected, or rotated by a right angle, may then move differently.
    """
    edges_are_free: ClassVar[bool] = False
    """True if edges are traction-free with a calibrated rule.

    With other frames a calibrated rule causes a warning.
    """

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
    """Frame that fixes the body in space: moves change if the body is translated.

    With all other frames the weights of each frame point sum to 1, so that a translation does not
    change moves.
    """
