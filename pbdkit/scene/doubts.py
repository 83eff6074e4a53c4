"""What a user is warned of where a scene can be built and may not be what was meant."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pbdkit.experiment.model import Experiment
from pbdkit.experiment.record import Record
from pbdkit.interfaces.rule import material_of
from pbdkit.interfaces.varying import ByRegion
from pbdkit.scene.field_values import signed_distance
from pbdkit.scene.neighbourhood import Neighbourhood, flatness
from pbdkit.scene.places import Mask
from pbdkit.scene.raster import Raster
from pbdkit.scene.sites import has_narrow_slot

FLAT = 0.05
"""Cells flatter than this are warned of."""


def doubts_of(
    experiment: Experiment, neighbourhood: Neighbourhood, body: Mask, layers: int
) -> list[str]:
    """A line each, on the lattice, who is whose neighbour, and the frame of a body."""
    doubts, frame, rule = [], experiment.frame, experiment.rule
    if (flat := flatness(neighbourhood.cell)) < FLAT:
        doubts.append(
            f"lattice: nearly degenerate, sites lie {1 / flat:.3g} times closer along one line "
            "than its longer cell vector is long, so that neighbours by distance lie along that "
            "line; take chebyshev neighbours, or open the angle between the vectors"
        )
    if not neighbourhood.spans_space():
        doubts.append(
            "neighbours: they lie along one line only, so that rows do not feel each other; "
            "more shells, or chebyshev neighbours, connect them"
        )
    if layers and has_narrow_slot(body, layers):
        doubts.append(
            f"body: a slot is narrower than {2 * layers + 1} sites, so that frame points in it "
            "belong to both faces; widen it, or take fewer layers"
        )
    if not frame.edges_are_free and material_of(rule) is not None:
        doubts.append(
            f"frame: under '{frame.type}' edges are not free of stress, and with the calibrated "
            f"rule '{rule.type}' the result does not converge to elasticity, however fine the "
            "lattice (copying frames err by 6.7 % on a bar in tension, 14.5 % on a cantilever); "
            "take {type: natural} or {type: traction-free}"
        )
    return doubts


def without_effect(experiment: Experiment, raster: Raster) -> Iterator[str]:
    """A line each on what is said and changes nothing: regions, courses, records."""
    fields = [*experiment.rule.varying.values(), *experiment.fracture.varying.values()]
    named = {name for f in fields if isinstance(f, ByRegion) for name, _ in f.values}
    named |= {group.select.region or "" for group in experiment.leaders}
    named |= {load.select.region or "" for load in experiment.loads}
    for name, region in experiment.regions.items():
        cell = experiment.lattice.cell()
        x, y = raster.reference(raster.body_rows).T
        near = max(float(np.hypot(*vector)) for vector in cell.vectors)
        if name not in named:
            yield f"regions.{name}: nothing names it, so that it changes nothing"
        elif not (signed_distance(region, cell, x, y) <= near).any():
            yield f"regions.{name}: lies outside of the body, so that it changes nothing"
    for place, course in experiment.courses.items():
        if course.bends and course.bends[-1] > experiment.steps:
            yield (
                f"{'.'.join(place)}: changes until step {course.bends[-1]}, and the run ends with "
                f"step {experiment.steps}"
            )
    if not experiment.solver.makes_steps and experiment.record != Record():
        yield (
            "record: of an equilibrium the start and the end are recorded, whatever stands here; "
            "for states between run it to fewer steps, as by a sweep over `steps`"
        )
