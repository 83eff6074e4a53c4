"""Where a fit begins: the parameters that leave the least gap to equilibrium.

Measured displacements, put on the particles, would not move on by the right rule: m(u, θ) = 0 where
all neighbours are known. m is nearly straight in θ, so that a few linear problems find θ without
one equilibrium (Claire, Hild, Roux 2004). Noise makes them wrong, wide bounds do not: the
middle of wide bounds is far off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pbdkit.equilibrium.moves import Moves
from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.resting_field import FieldObservation
from pbdkit.fitting.sensitivity import scene_like
from pbdkit.stepping.state import Floats, initial_state

TURNS, INSET = 3, 1e-3
"""Linear problems; the share of the way between bounds by which a start keeps away from them."""
PLANE, NEAREST, FAR = 3, 12, 2.0
"""How few points tell a plane, and how many it goes through; farther than so many times their
spacing none is known."""


def least_gap(
    field: FieldObservation, parameters: Sequence[Parameter], low: Floats, high: Floats
) -> Floats:
    """The parameters between bounds, (parameter,); their middle where too little is known."""
    middle, inset = (low + high) / 2.0, INSET * (high - low)
    values = middle
    if len(field.evidence.points) < PLANE:
        return middle
    state = initial_state(field.scene)
    u = _on_particles(field)

    def moves(experiment: Experiment) -> Floats:
        scene = scene_like(field.scene, experiment).at(experiment.steps)
        with np.errstate(invalid="ignore"):
            found = Moves(scene, compiles=False).at(replace(state, u=u.copy()), experiment.steps)
        return np.asarray(found)

    try:
        for _ in range(TURNS):
            experiment = field.experiment
            for parameter, value in zip(parameters, values, strict=True):
                experiment = parameter.put(experiment, float(value))
            gap = moves(experiment)
            known = np.isfinite(gap)
            if known.sum() < 2 * len(values):
                return middle
            slopes = [p.derivative(experiment, moves)[known] for p in parameters]
            step, *_ = np.linalg.lstsq(np.stack(slopes, axis=1), -gap[known], rcond=1e-9)
            values = np.clip(values + step, low + inset, high - inset)
    except ExperimentError:
        return middle
    return np.asarray(values)


def _on_particles(field: FieldObservation) -> Floats:
    """What was measured as planes: at each particle, by a plane through the nearest points. NaN
    where there are none near."""
    from scipy.spatial import KDTree

    scene, raster = field.scene, field.scene.raster
    rows, at = raster.body_rows, field.evidence.points
    places, measured = raster.reference(rows), field.measured.reshape(2, -1).T
    tree = KDTree(at)
    between, _ = tree.query(at, 2)
    distance, near = tree.query(places, min(NEAREST, len(at)))
    ways = at[near] - places[:, None]
    basis = np.concatenate([np.ones((*near.shape, 1)), ways], axis=2)
    products = np.einsum("pki,pkj->pij", basis, basis)
    products += 1e-9 * np.trace(products, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    right = np.einsum("pki,pka->pia", basis, measured[near])
    known = np.linalg.solve(products, right)[:, 0]
    known[distance[:, 0] > FAR * np.median(between[:, 1])] = np.nan
    u = np.full((scene.axes, *raster.shape), np.nan)
    flat = u.reshape(scene.axes, -1)
    flat[:, raster.place_of(rows)] = known.T
    if frame := scene.at(scene.experiment.steps).frame:
        frame.follow(flat, flat)
    return u
