"""What leaders and frame points do to the followers beside them, from the rule's own functions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.analysis.couplings import Couplings
from pbdkit.analysis.guiding import Guiding
from pbdkit.analysis.operator import moves_and_couplings
from pbdkit.interfaces.frame import Indices
from pbdkit.scene.guides import kinds_of_places
from pbdkit.scene.places import slot_step
from pbdkit.scene.raster import FOLLOWER, FRAME, LEADER
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Edge:
    """The followers at flat places `place`, with ∂move/∂u of their moves, columns by flat
    place."""

    scene: Scene
    place: Indices
    couplings: Couplings

    def moves(self, u: Floats) -> Floats:
        """Planes: what these followers do, relaxed, where others stand at u, planes too."""
        found = np.zeros(u.shape)
        table = self.couplings.times(u.reshape(len(u), -1).T)
        relaxation = self.scene.experiment.stepping.relaxation
        found.reshape(len(u), -1)[:, self.place] = relaxation * table.T
        return found

    def shown(self, u: Floats) -> Floats:
        """Planes: what frame points show of u, nothing elsewhere."""
        found = np.zeros(u.shape)
        if frame := self.scene.frame:
            frame.follow(u.reshape(len(u), -1), found.reshape(len(u), -1))
        return found


def edge_of(scene: Scene, state: State, step: int) -> Edge:
    """At a state, with the roles of a step; of all followers where a rule works on the moves of
    another."""
    raster, guiding = scene.raster, Guiding(scene, step)
    kind = kinds_of_places(raster, scene.leading, step)
    place = np.flatnonzero(kind == FOLLOWER)
    if not scene.inner:
        seen = np.flatnonzero((kind == LEADER) | (kind == FRAME))
        seen = np.concatenate([seen, guiding.guided.place])
        beside = [seen - slot_step(raster.shape, slot) for slot in scene.neighbourhood.every]
        some = np.unique(np.concatenate([*beside, seen])).clip(0, kind.size - 1)
        place = some[kind[some] == FOLLOWER]
    _, couplings = moves_and_couplings(scene, state, place)
    couplings.parts = [
        (rows, there, guiding.turned(place[rows], blocks))
        for rows, there, blocks in couplings.parts
    ]
    return Edge(scene, place, couplings)
