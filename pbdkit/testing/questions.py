"""All questions to a component of any interface."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.interfaces import (
    Component,
    Diagnostic,
    FollowerRule,
    FractureModel,
    FramePolicy,
    Lattice,
    Moment,
    NeighbourMetric,
    Variable,
)
from pbdkit.results.moment import StateMoment
from pbdkit.results.tables import Tables
from pbdkit.scene.frame_points import sites_of_frame
from pbdkit.scene.scene import Scene
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.testing.calls import ask_fracture_model, ask_rule
from pbdkit.testing.property import Arrays, Question
from pbdkit.testing.sight import SeenFrame, SeenMoment
from pbdkit.testing.states import displacements, state_with


def questions_of(component: Component, scene: Scene, seed: int) -> list[Question]:
    """Those that its interface allows."""
    makers: dict[type[Component], Callable[..., list[Question]]] = {
        FollowerRule: ask_rule,
        FractureModel: ask_fracture_model,
        FramePolicy: _to_frame,
        Diagnostic: _to_diagnostic,
        Lattice: _to_lattice,
        NeighbourMetric: _to_metric,
    }
    make = next(m for interface, m in makers.items() if isinstance(component, interface))
    return make(component, scene, seed)


def _to_frame(policy: FramePolicy, scene: Scene, seed: int) -> list[Question]:
    sites = sites_of_frame(scene.raster, scene.experiment.rule)
    if sites is None:
        return []
    point, body = sites.nearest()

    def follow(arrays: Arrays) -> Arrays:
        found = policy.follow(SeenFrame.showing(sites, **arrays))
        return {"point": found.point, "body": found.body, "weight": found.weight}

    return [Question("follow", {"site": sites.site, "point": point, "body": body}, follow)]


def _to_diagnostic(diagnostic: Diagnostic, scene: Scene, seed: int) -> list[Question]:
    moment = moment_of(scene, seed)
    variables = diagnostic.variables()
    tables = {
        "displacement": moment.displacement(),
        "previous_displacement": moment.previous_displacement(),
        "reference": moment.reference(),
    }

    def measure(arrays: Arrays) -> Arrays:
        measured = diagnostic.measure(SeenMoment(moment, tables=arrays))
        return {
            variable.name: _where_recordable(variable, np.asarray(value), moment)
            for variable, value in zip(variables, measured, strict=True)
        }

    return [Question("measure", tables, measure)]


def _where_recordable(variable: Variable, values: NDArray[Any], moment: Moment) -> NDArray[Any]:
    """0 in place of the NaN that may stand at frame points."""
    sizes = dict(zip(variable.dims, values.shape, strict=False))
    if values.dtype.kind != "f" or sizes.get("particle") != len(moment.body):
        return values
    allowed = np.isnan(values) & variable.is_recordable(values, moment.body)
    return np.where(allowed, 0.0, values)


def moment_of(scene: Scene, seed: int) -> StateMoment:
    """The scene two steps after a random start; bonds may have broken."""
    state = state_with(scene, displacements(scene, seed, share=0.6))
    return StateMoment(Stepper(scene).advance(state, 2), Tables(scene))


def _to_lattice(lattice: Lattice, scene: Scene, seed: int) -> list[Question]:
    def cell(_: Arrays) -> Arrays:
        found = lattice.cell()
        sites = [(*s.at, *s.index, *s.primitive) for s in found.sites]
        rest = {"period": found.period, "primitive": found.primitive}
        return {"vectors": found.vectors, "sites": sites} | rest

    return [Question("cell", {}, cell)]


def _to_metric(metric: NeighbourMetric, scene: Scene, seed: int) -> list[Question]:
    cell = scene.experiment.lattice.cell()

    def shells(_: Arrays) -> Arrays:
        return {
            f"sublattice {s}": [
                (n, o.target, *o.cell, *o.rest)
                for n, shell in enumerate(metric.shells_around(cell, s), 1)
                for o in shell
            ]
            for s in range(len(cell.sites))
        }

    return [Question("shells_around", {}, shells)]
