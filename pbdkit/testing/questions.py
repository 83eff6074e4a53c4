"""Questions to a component: calls of its functions with arrays that are kept, so that the answers
can be compared and the arrays looked at afterwards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pbdkit.interfaces import (
    Component,
    Diagnostic,
    FollowerRule,
    FractureModel,
    FramePolicy,
    Here,
    Lattice,
    NeighbourMetric,
    Slot,
    Vector,
)
from pbdkit.results.moment import StateMoment
from pbdkit.results.tables import Tables
from pbdkit.scene.framing import sites_of_frame
from pbdkit.scene.scene import Scene
from pbdkit.stepping.stepper import Stepper
from pbdkit.testing.sight import SeenFrame, SeenMoment
from pbdkit.testing.states import displacements, spacing, state_with

Arrays = dict[str, Any]
SHAPE = (4, 3)
"""The shape of the arrays with which elementwise functions are called."""


@dataclass(frozen=True)
class Question:
    """One call: `what` is called, with which arrays, and how; answers are values by name."""

    what: str
    inputs: Arrays
    ask: Callable[[Arrays], Arrays]

    def answer(self) -> Arrays:
        """The answer to fresh copies of the inputs, as it was at that moment."""
        with np.errstate(all="ignore"):
            found = self.ask({name: np.array(value) for name, value in self.inputs.items()})
        return {name: np.array(value) for name, value in found.items()}

    def larger(self) -> Question:
        """The same with all that is no index ten times as large."""
        return replace(
            self,
            inputs={n: 10.0 * v if v.dtype.kind == "f" else v for n, v in self.inputs.items()},
        )


def questions_of(component: Component, scene: Scene, seed: int) -> list[Question]:
    """All questions to a component of any interface."""
    makers: dict[type[Component], Callable[..., list[Question]]] = {
        FollowerRule: _to_rule,
        FractureModel: _to_fracture_model,
        FramePolicy: _to_frame,
        Diagnostic: _to_diagnostic,
        Lattice: _to_lattice,
        NeighbourMetric: _to_metric,
    }
    make = next(m for interface, m in makers.items() if isinstance(component, interface))
    return make(component, scene, seed)


def vector(arrays: Arrays, name: str) -> Vector:
    """The vector whose components stand under `name.x` and `name.y`."""
    return Vector(arrays[f"{name}.x"], arrays[f"{name}.y"])


def differences(scene: Scene, seed: int, share: float = 0.3) -> Arrays:
    """A difference along each slot of the first sublattice, at random."""
    rng, size = np.random.default_rng(seed), share * spacing(scene)
    slots = range(len(scene.neighbourhood.slots[0]))
    return {f"d{k}.{c}": rng.uniform(-size, size, SHAPE) for k in slots for c in "xy"}


def own(scene: Scene, seed: int) -> Arrays:
    """u and X of some particles, at random."""
    rng, size = np.random.default_rng(seed + 1), spacing(scene)
    u = {f"u.{c}": rng.uniform(-0.3 * size, 0.3 * size, SHAPE) for c in "xy"}
    return u | {f"X.{c}": rng.uniform(-5 * size, 5 * size, SHAPE) for c in "xy"}


def gathered(rule: FollowerRule, scene: Scene, arrays: Arrays) -> list[tuple[Any, ...]]:
    """The contributions of every slot."""
    constants = scene.constants
    return [
        tuple(rule.gather(vector(arrays, f"d{k}"), s.rest, constants.weights[s], constants.rule))
        for k, s in enumerate(scene.neighbourhood.slots[0])
    ]


def summed(contributions: list[tuple[Any, ...]]) -> list[Any]:
    """Their sums, in the order of the slots."""
    totals = list(contributions[0])
    for parts in contributions[1:]:
        totals = [a + b for a, b in zip(totals, parts, strict=True)]
    return totals


def applied(rule: FollowerRule, scene: Scene, totals: list[Any], arrays: Arrays) -> Arrays:
    """The move."""
    X = vector(arrays, "X") if rule.uses_reference else Vector(None, None)
    x, y = rule.apply(tuple(totals), Here(vector(arrays, "u"), X), scene.constants.rule)
    return {"move.x": x, "move.y": y}


def _to_rule(rule: FollowerRule, scene: Scene, seed: int) -> list[Question]:
    d, here = differences(scene, seed), own(scene, seed)

    def gather(arrays: Arrays) -> Arrays:
        found = gathered(rule, scene, arrays)
        return {f"{n} of slot {k}": c for k, parts in enumerate(found) for n, c in enumerate(parts)}

    contributions = gathered(rule, scene, {k: v.copy() for k, v in d.items()})
    if len({len(parts) for parts in contributions}) > 1:
        return [Question("gather", d, gather)]  # they cannot be summed, which is found elsewhere
    totals = summed(contributions)
    named = {f"total[{n}]": np.broadcast_to(t, SHAPE).copy() for n, t in enumerate(totals)}

    def apply(arrays: Arrays) -> Arrays:
        return applied(rule, scene, [arrays[name] for name in named], arrays)

    return [Question("gather", d, gather), Question("apply", named | here, apply)]


def _to_fracture_model(model: FractureModel, scene: Scene, seed: int) -> list[Question]:
    slots, p = scene.neighbourhood.slots[0], scene.constants.fracture
    here = {k: v for k, v in own(scene, seed).items() if k.startswith("u")}

    def breaks(arrays: Arrays) -> Arrays:
        def one(k: int, slot: Slot) -> Any:
            return model.breaks(vector(arrays, f"d{k}"), slot.rest, model.constants(slot), p)

        return {f"slot {k}": one(k, slot) for k, slot in enumerate(slots)}

    def fictitious(arrays: Arrays) -> Arrays:
        found = [model.fictitious(vector(arrays, "u"), slot.rest, p) for slot in slots]
        return {
            f"{c} at slot {k}": v
            for k, lost in enumerate(found)
            for c, v in zip("xy", lost, strict=True)
        }

    wide = differences(scene, seed, share=2.0)
    return [Question("breaks", wide, breaks), Question("fictitious", here, fictitious)]


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
    names = [variable.name for variable in diagnostic.variables()]
    tables = {
        "displacement": moment.displacement(),
        "previous_displacement": moment.previous_displacement(),
        "reference": moment.reference(),
    }

    def measure(arrays: Arrays) -> Arrays:
        measured = diagnostic.measure(SeenMoment(moment, tables=arrays))
        return dict(zip(names, measured, strict=True))

    return [Question("measure", tables, measure)]


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
