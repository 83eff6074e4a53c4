"""How particles give way along different directions: on edges and at corners not alike.

A calibrated rule moves a particle by S⁻¹ · force for some matrix S of the particle: of elastic
rules that is the stiffness with which its neighbours hold it, of springs a multiple of 1.
"""

from __future__ import annotations

import numpy as np

from pbdkit.interfaces.frame import Indices
from pbdkit.interfaces.rule import material_of
from pbdkit.interfaces.vector import length, vector
from pbdkit.scene.places import Places
from pbdkit.scene.scene import Scene
from pbdkit.stepping.evaluator import Evaluator, summed
from pbdkit.stepping.state import Floats, unmoved_state
from pbdkit.stepping.surroundings import Surroundings

NUDGE = 0.01
"""Distance by which a particle is moved to measure what pulls it back, in lattice constants."""
SAME = 1e-9
"""Relative difference of two entries of a matrix below which they count as equal."""
PARTICLES = 16384
"""Number of particles that are evaluated at once."""


def stiffnesses(scene: Scene, place: Indices) -> Floats:
    """Return S of the particles at some flat places, (particle, axis, axis), with no bond broken;
    zero where a particle does not move."""
    each = scene.raster.kind.size // len(scene.raster.kind)
    found = np.zeros((len(place), scene.axes, scene.axes))
    for s in np.unique(place // each).tolist():
        rows = np.flatnonzero(place // each == s)
        for first in range(0, len(rows), PARTICLES):
            some = rows[first : first + PARTICLES]
            found[some] = _stiffnesses(scene, place[some], s)
    return found


def _stiffnesses(scene: Scene, place: Indices, sublattice: int) -> Floats:
    """The same of particles of one sublattice: the mean of nudges to both sides, so that mirrored
    scenes have mirrored matrices."""
    rest, evaluator = unmoved_state(scene, scene.raster.shape[1:]), Evaluator(scene)
    around = Surroundings(scene, Places(scene.raster.shape, place), sublattice)
    if scene.constants.by_particle:
        evaluator = evaluator.given(around.parameters)
    neighbours, here = around.neighbours(rest), around.here(rest.u, rest)
    size = NUDGE * length(scene.raster.lattice.cell().vectors[0])
    sizes = (size,) if scene.experiment.rule.linear else (size, -size)
    found = np.zeros((len(place), scene.axes, scene.axes))
    for nudge in sizes:
        answers = []
        for e in np.eye(scene.axes):
            u = vector(np.full(len(place), nudge * c) for c in e)
            parts = [(evaluator.contribution(-u, u, to), to.present) for to in neighbours]
            total, at = summed(parts), here._replace(u=u)
            both = evaluator.move(total, at), evaluator.force(total, at)
            answers.append([[np.broadcast_to(c, len(place)) for c in one] for one in both])
        move, force = np.array(answers).transpose(1, 3, 2, 0)
        found += force @ np.linalg.pinv(move) / len(sizes)
    return found


def compliance(scene: Scene) -> Floats | None:
    """Return C = S⁻¹ of every particle, up to a factor of each: (xx xy yy, sublattice, cell, cell).

    None where C is 1 everywhere: for rules that know no forces, whose particles count as giving way
    alike along all directions, and for those of which S is a multiple of 1.
    """
    if material_of(scene.experiment.rule) is None:
        return None
    place = scene.raster.place_of(scene.raster.body_rows)
    S = stiffnesses(scene, place)
    xx, xy, yy = S[:, 0, 0], (S[:, 0, 1] + S[:, 1, 0]) / 2, S[:, 1, 1]
    mean = (xx + yy) / 2
    differs = np.maximum(abs(xx - yy), abs(xy)) > SAME * mean
    some = np.flatnonzero(differs & (xx * yy > xy * xy))
    if not len(some):
        return None
    found = np.ones((3, *scene.raster.shape))
    found[1] = 0.0
    found.reshape(3, -1)[:, place[some]] = np.stack([yy, -xy, xx])[:, some] / mean[some]
    return found
