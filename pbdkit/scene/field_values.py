"""What the fields of an experiment's parts are at some places."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from pbdkit.errors import ExperimentError
from pbdkit.experiment.body import Body, Sites
from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import Cell, Vector
from pbdkit.interfaces.fields import TakesFields
from pbdkit.interfaces.varying import ByRegion
from pbdkit.scene.places import Floats, Mask
from pbdkit.scene.sites import rounding_of

Values = Mapping[str, Floats]
"""By the name of the parameter, an array over the places."""


def values_at(experiment: Experiment, field: str, x: Floats, y: Floats, needed: Mask) -> Values:
    """The parameters of the part at a field of the experiment that differ, at places where they
    are `needed`; elsewhere where there is none the number that serves for all.

    Raises ExperimentError for a place outside of what is known, and where the values at a place do
    not go together.
    """
    part: TakesFields = getattr(experiment, field)
    cell, held = experiment.lattice.cell(), dict[str, Mask]()
    # Corners of cut cells lie that far outside of a body at most.
    reach = max(math.hypot(*vector) for vector in cell.vectors)
    if any(isinstance(varying, ByRegion) for varying in part.varying.values()):
        for name, region in experiment.regions.items():
            held[name] = signed_distance(region, cell, x, y) <= 0.0
    found = {}
    for name, varying in part.varying.items():
        values = varying.at(x, y, held, reach)
        missing = np.isnan(values)
        if (missing & needed).any():
            place = int(np.argmax(missing & needed))
            raise ExperimentError(
                f"has no value at ({x.flat[place]:.6g}, {y.flat[place]:.6g}), where one is needed; "
                "its places must cover the body",
                (field, name),
            )
        found[name] = np.where(missing, getattr(part, name), values)
    if len(found) > 1 and needed.any():
        _refuse_apart(
            part, field, {name: own[needed] for name, own in found.items()}, x[needed], y[needed]
        )
    return found


def _refuse_apart(part: TakesFields, field: str, values: Values, x: Floats, y: Floats) -> None:
    """Numbers that each may be need not go together, as where one must be above another: looked at
    are the places where two are farthest apart, either way."""
    for one, other in combinations(values.values(), 2):
        for place in (int(np.argmin(one - other)), int(np.argmax(one - other))):
            try:
                part.with_values(**{name: float(own[place]) for name, own in values.items()})
            except ValidationError as error:
                fault = error.errors()[0]
                text = f"at ({x[place]:.6g}, {y[place]:.6g}): {fault['msg']}"
                raise ExperimentError(text, (field, fault.get("ctx", {}).get("key", ""))) from None


def signed_distance(body: Body, cell: Cell, x: Floats, y: Floats) -> Floats:
    """To an outline, negative inside, zero on it whatever the rounding."""
    nowhere = np.zeros(np.shape(x), int)
    distance = body.distance(Sites((nowhere, nowhere), Vector(x, y)))
    return np.where(np.abs(distance) <= rounding_of(cell, x, y), 0.0, distance)


def kinds_of(part: TakesFields, values: Values) -> tuple[list[Any], NDArray[np.intp]]:
    """(parts, kind): the part with the numbers of each kind of place, and of each place its kind,
    in the shape of the values."""
    shape = next(iter(values.values())).shape
    table = np.stack([value.ravel() for value in values.values()], axis=1)
    rows, kind = np.unique(table, axis=0, return_inverse=True)
    parts = [part.with_values(**dict(zip(values, row, strict=True))) for row in rows.tolist()]
    return parts, kind.reshape(shape)
