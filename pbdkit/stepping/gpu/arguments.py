"""The arrays that kernels for a GPU are given, by name: planes flat, tables as they are."""

from __future__ import annotations

import re

import numpy as np

from pbdkit.scene.places import slot_step
from pbdkit.stepping.compiled.arguments import Arrays, constant_arrays
from pbdkit.stepping.compiled.plan import Plan
from pbdkit.stepping.gpu.places import Whole, breakable_bonds, find_groups
from pbdkit.stepping.prescription import Led

PLANES = re.compile(
    r"kind|share|body|ratios|mixed|broken|lengths|lost|torn|groups|breakable"
    r"|(u|v|z\d+|load)_[xyz]|(bond|own|was|field|limit)\d+"
)
"""Names of arrays that have a value for every place."""


def steady_arrays(plan: Plan) -> tuple[Arrays, Whole]:
    """What does not change from step to step, and which groups of places have all neighbours."""
    shape, planes = plan.scene.raster.shape, plan.scene.neighbourhood.planes
    groups, whole = find_groups(plan)
    found = constant_arrays(plan) | {"groups": groups, "extent": np.array(shape, np.int64)}
    found["end_steps"] = np.array([slot_step(shape, plane.slot) for plane in planes], np.int64)
    if plan.bonds_first:
        found["breakable"] = breakable_bonds(plan)
    return found, whole


def flattened(arrays: Arrays) -> Arrays:
    """The same as kernels know them; what they write into planes is written into these."""
    return {
        f"flat_{name}" if PLANES.fullmatch(name) else name: (
            array.reshape(-1) if PLANES.fullmatch(name) else array
        )
        for name, array in arrays.items()
    }


def without_doubles(led: Led) -> Led:
    """Every leader once, where the last group puts it: threads place them all at once."""
    found: Led = []
    later = np.empty(0, np.intp)
    for each in reversed(led):
        fresh = ~np.isin(each.place, later)
        found.insert(0, each._replace(place=each.place[fresh], u=each.u[:, fresh]))
        later = np.concatenate([later, each.place])
    return found
