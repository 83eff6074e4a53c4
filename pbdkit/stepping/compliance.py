"""How particles give way along different directions: on edges and at corners not alike."""

from __future__ import annotations

import numpy as np

from pbdkit.interfaces.rule import material_of
from pbdkit.interfaces.vector import vector
from pbdkit.scene.scene import Scene
from pbdkit.stepping.evaluator import Evaluator, summed
from pbdkit.stepping.state import Floats, unmoved_state
from pbdkit.stepping.surroundings import blocks

NUDGE = 1e-4
"""Of a lattice constant: by so much particles are moved, each alone."""


def compliance(scene: Scene) -> Floats | None:
    """C = D⁻¹ up to a factor, (xx xy yy, sublattice, cell, cell): D is the stiffness with which
    the neighbours of a particle hold it, at rest and with all bonds. None for rules that know no
    forces, whose particles count as giving way alike along all directions."""
    if material_of(scene.experiment.rule) is None or scene.inner:
        return None
    state, evaluator = unmoved_state(scene, scene.raster.shape[1:]), Evaluator(scene)
    size = NUDGE * float(np.hypot(*scene.raster.lattice.cell().vectors[0]))
    found = np.ones((3, *scene.raster.shape))
    found[1] = 0.0
    for around in blocks(scene):
        columns = []
        for axis in range(2):
            u = np.zeros(state.u.shape)
            u[axis] = size
            own = vector(around.where.of(u))
            parts = ((evaluator.contribution(-own, own, to), to.present)
                     for to in around.neighbours(state))  # fmt: skip
            columns.append(evaluator.force(summed(parts), around.here(u, state)))
        (xx, yx), (xy, yy) = columns
        adjoint = np.stack([-yy, (xy + yx) / 2, -xx]) / size
        stiff = adjoint[0] * adjoint[2] > adjoint[1] ** 2
        mean = np.where(stiff, (adjoint[0] + adjoint[2]) / 2, 1.0)
        here = around.where.of(found)
        here[...] = np.where(stiff, adjoint / mean, here)
    return found
