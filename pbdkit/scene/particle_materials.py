"""Of what material each particle is, for those who measure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import Calibrated, Stiffness
from pbdkit.interfaces.rule import material_of
from pbdkit.scene.cell_materials import PLACES, regions_of, stiffness_at
from pbdkit.scene.field_values import kinds_of, signed_distance, values_at
from pbdkit.scene.places import Floats
from pbdkit.scene.raster import FOLLOWER, Raster


def stiffness_of_particles(experiment: Experiment, raster: Raster) -> Stiffness | None:
    """The stiffness over Young's modulus at each particle, (particle,) a component; that of the
    rule where it is one."""
    rule = experiment.rule
    if not (rule.varying and rule.uses_cells):
        return material_of(rule)
    x, y = raster.reference().T
    values = values_at(experiment, "rule", x, y, raster.table_kind == FOLLOWER)
    matrices = stiffness_at(experiment, values)
    return Stiffness(**{name: matrices[(slice(None), *at)] for name, at in PLACES.items()})


def through_thickness_of_particles(experiment: Experiment, raster: Raster) -> Floats | float:
    """σ_zz over σ_xx + σ_yy at each particle, (particle,); that of the rule where it is one."""
    rule = experiment.rule
    if not isinstance(rule, Calibrated):
        return 0.0
    if not (rule.varying and rule.uses_cells):
        return rule.through_thickness()
    x, y = raster.reference().T
    values = values_at(experiment, "rule", x, y, raster.table_kind == FOLLOWER)
    parts, kind = kinds_of(rule, values)
    return np.array([part.through_thickness() for part in parts])[kind]


def phases_of_particles(experiment: Experiment, raster: Raster) -> NDArray[np.int64]:
    """(particle,): which regions of the rule's hold each, a bit a region."""
    x, y = raster.reference().T
    found, cell = np.zeros(len(x), np.int64), experiment.lattice.cell()
    for bit, region in enumerate(regions_of(experiment).values()):
        found |= (signed_distance(region, cell, x, y) <= 0.0).astype(np.int64) << bit
    return found
