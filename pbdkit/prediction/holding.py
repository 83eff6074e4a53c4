"""Whether supports hold a body against its loads: what they leave of its motions as a rigid body.

A part of the body that moves as a rigid body resists nothing. Where leaders leave it such a motion
and the loads do work along it, there is no equilibrium, and steps push it on for ever.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from pbdkit.interfaces import Anchors, Calibrated
from pbdkit.interfaces.frame import Indices
from pbdkit.scene.places import Floats, Mask
from pbdkit.scene.scene import Scene

MOST_PARTICLES = 20_000
"""Larger bodies are looked at as one part."""
IS_ZERO, DOES_WORK = 1e-13, 1e-9
"""Shares of the largest eigenvalue of the supports, and of the forces and their levers."""


@dataclass(frozen=True)
class PushedPart:
    """A part of the body that loads push on for ever: how many of its particles follow, and the
    number of the first of these."""

    particles: int
    first: int


def pushed_parts(scene: Scene) -> list[PushedPart]:
    """Return the parts that loads push on for ever at the last step, as far as supports tell:
    nothing is told of obstacles, and of frames and rules that resist rigid motions."""
    rule, frame = scene.experiment.rule, scene.experiment.frame
    if not scene.loads or scene.axes != 2 or scene.barriers:
        return []
    if not isinstance(rule, Calibrated) or isinstance(frame, Anchors):
        return []
    raster = scene.raster
    place = raster.place_of(raster.body_rows)
    x = raster.reference(raster.body_rows)
    step = scene.experiment.steps
    forces = scene.loads.at(step, np.float64).reshape(2, -1)[:, place].T.astype(np.float64)
    held = np.zeros((2, int(np.prod(raster.shape))), bool)
    for leading in scene.leading:
        for axis in leading.axes if leading.group.leads(step) else ():
            held[axis, leading.place] = True
    # Only linear rules turn without resistance, however far; frames that copy the body resist it.
    modes = 3 if rule.linear and (scene.frame is None or frame.weighs_cells) else 2
    return [
        PushedPart(len(following), raster.before + int(raster.body_rows[following[0]]) + 1)
        for rows in _parts(scene)
        if _is_pushed(x[rows], held[:, place[rows]].T, forces[rows], modes)
        and len(following := rows[~held[:, place[rows]].all(axis=0)])
    ]


def _parts(scene: Scene) -> Iterator[Indices]:
    """The body's particles, as rows of the body, of each part that bonds connect."""
    rows = scene.raster.body_rows
    if len(rows) > MOST_PARTICLES:
        yield np.arange(len(rows))
        return
    of_body = np.full(scene.raster.count, -1)
    of_body[rows] = np.arange(len(rows))
    ends = of_body[scene.bonds.ends]
    ends = ends[(ends >= 0).all(axis=1)]
    graph = csr_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(rows), len(rows)))
    count, label = connected_components(graph, directed=False)
    for n in range(count):
        yield np.flatnonzero(label == n)


def _is_pushed(x: Floats, held: Mask, forces: Floats, modes: int) -> bool:
    """Whether forces (particle, axis) do work along a rigid motion that is not `held` (particle,
    axis) at any particle."""
    middle, size = x.mean(axis=0), float(np.ptp(x, axis=0).max()) or 1.0
    lever = (x - middle) / size
    motions = np.zeros((len(x), 2, 3))
    motions[:, 0, 0] = motions[:, 1, 1] = 1.0
    motions[:, 0, 2], motions[:, 1, 2] = -lever[:, 1], lever[:, 0]
    motions = motions[:, :, :modes]
    rows = motions[held]
    eigenvalues, vectors = np.linalg.eigh(rows.T @ rows)
    left = vectors[:, eigenvalues <= IS_ZERO * max(1.0, float(eigenvalues[-1]))]
    work = np.einsum("pa,pam->m", forces, motions) @ left
    return bool((np.abs(work) > DOES_WORK * np.abs(forces).sum()).any())
