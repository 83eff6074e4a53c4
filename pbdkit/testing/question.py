"""A question: one call of a component with arrays that are kept; and all that can be asked.

Inputs and answers are trees: arrays and numbers in vectors, tuples, lists and dicts; answers also
in dataclasses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, is_dataclass
from functools import partial, singledispatch
from typing import Any

import numpy as np

from pbdkit.interfaces import (
    CellStress,
    Component,
    Components,
    Diagnostic,
    Draws,
    FollowerRule,
    FractureModel,
    FramePolicy,
    Here,
    Lattice,
    Loadable,
    NeighbourMetric,
    RenewsBonds,
    RenewsParticles,
    Softens,
)
from pbdkit.interfaces.component import as_vector
from pbdkit.interfaces.rule import material_of
from pbdkit.scene.frame_points import sites_of_frame
from pbdkit.scene.scene import Scene
from pbdkit.stepping.evaluator import Evaluator, summed
from pbdkit.stepping.state import generator_for
from pbdkit.testing.states import (
    SEED,
    SHAPE,
    Shown,
    applied,
    differences,
    frame_showing,
    gathered,
    here,
    measured_by,
    moment_of,
    owners,
    remembers,
    shared,
    standing,
    stressed,
)

Arrays = dict[str, Any]
"""Arrays and numbers by name: `d0.x`, `own1`."""


def flat(tree: Any, name: str = "") -> Arrays:
    """The arrays and numbers of a tree by name."""
    if isinstance(tree, Components):
        parts = {f"{name}.{c}".lstrip("."): v for c, v in zip("xyz", tree, strict=False)}
    elif isinstance(tree, dict) or is_dataclass(tree):
        named = tree if isinstance(tree, dict) else vars(tree)
        parts = {f"{name}.{key}".lstrip("."): part for key, part in named.items()}
    elif isinstance(tree, (tuple, list)):
        parts = {f"{name}{n}": v for n, v in enumerate(tree)}
    else:
        return {name: tree}
    return {n: value for key, part in parts.items() for n, value in flat(part, key).items()}


def each(change: Callable[[Any], Any], tree: Any) -> Any:
    """The tree of what a function makes of every array and number."""
    if isinstance(tree, Components):
        return tree.each(change)
    if isinstance(tree, dict):
        return {name: each(change, part) for name, part in tree.items()}
    if isinstance(tree, (tuple, list)):
        return type(tree)(each(change, part) for part in tree)
    return change(tree)


@dataclass(frozen=True)
class Question:
    """One call: `what` is called, with which inputs by name, and how.

    An `elementwise` one is asked with arrays of one shape, a value a particle or bond.
    """

    what: str
    inputs: dict[str, Any]
    ask: Callable[..., Any]
    elementwise: bool = False

    def asked(self, change: Callable[[Any], Any] = np.array) -> Any:
        """The answer as it comes, to inputs that are copied, or changed."""
        with np.errstate(all="ignore"):
            return self.ask(**each(change, self.inputs))

    def answer(self, change: Callable[[Any], Any] = np.array) -> Arrays:
        """The answer by name, as it was at that moment."""
        return {name: np.array(value) for name, value in flat(self.asked(change)).items()}


@singledispatch
def questions_of(component: Component, scene: Scene, seed: int) -> list[Question]:
    """Those that its interface allows."""
    raise TypeError(f"{type(component).__name__} is of no interface")


@questions_of.register
def _to_rule(rule: FollowerRule, scene: Scene, seed: int) -> list[Question]:
    """`gather` and `apply`, also where r + d = 0 along every slot; `remember`, `force`, `loaded`
    and `draw` where it has them."""
    d, at, evaluator = differences(scene, seed), here(scene, seed), Evaluator(scene)
    contributions = gathered(scene, each(np.array, d))
    given = {"d": d, "shared": shared(scene, at["own"])}
    gather = Question("gather", given, partial(gathered, scene), elementwise=True)
    if len({len(flat(parts)) for parts in contributions}) > 1:
        return [gather]  # they cannot be summed, which is found elsewhere
    sums = summed((c, None) for c in contributions)
    total = each(lambda t: np.broadcast_to(t, SHAPE).copy(), sums)
    asks: dict[str, Callable[[Any, Here], Any]] = {"apply": evaluator.move}
    if isinstance(rule, RenewsParticles):
        asks["remember"] = evaluator.remember
    if material_of(rule) is not None:
        asks["force"] = evaluator.force

    def question(what: str) -> Question:
        def ask(total: Any, **to: Any) -> Any:
            return asks[what](total, standing(scene, **to))

        return Question(what, {"total": total} | at, ask, elementwise=True)

    loads: list[Question] = []
    if isinstance(rule, Loadable) and material_of(rule) is not None:
        given = {"total": total, "load": here(scene, seed + 1)["u"]}
        loads.append(Question("loaded", given, partial(rule.loaded, p=scene.constants.rule), True))
    slots = zip(d, scene.neighbourhood.slots[0], strict=True)
    meeting = {"d": [v.each(lambda x, r: np.full_like(x, -r), slot.rest) for v, slot in slots]}
    what = "apply, where all neighbours meet in the particle,"
    met = Question(what, meeting | at, lambda d, **to: applied(scene, gathered(scene, d), **to))
    return [gather, *map(question, asks), *loads, met, *_to_draw(rule, scene)]


@questions_of.register
def _to_fracture_model(model: FractureModel, scene: Scene, seed: int) -> list[Question]:
    """`breaks` and `fictitious`; `update`, `seen` and `draw` where it has them."""
    slots, evaluator = scene.neighbourhood.slots[0], Evaluator(scene)
    p, limits = scene.constants.fracture, scene.constants.limits

    def question(what: str, ask: Callable[..., Any], **inputs: Any) -> Question:
        """One that is asked along every slot, with the difference along it where there are `d`."""

        def along(d: Any = slots, **given: Any) -> Any:
            return [ask(v, s.rest, limits[s], **given) for v, s in zip(d, slots, strict=True)]

        return Question(what, inputs, along, elementwise=True)

    def fictitious(_: Any, r: Any, __: Any, u: Any) -> Any:
        return as_vector(model.fictitious(u, r, p), "fictitious", u)

    def seen(d: Any, r: Any, limits: Any, own: Any, lost: Any) -> Any:
        assert isinstance(model, Softens)
        c = scene.constants.of_bond(*limits, *own)
        return as_vector(model.seen(d, lost, r, c, p), "seen", lost)

    def update(d: Any, r: Any, limits: Any, own: Any, cells: Any) -> Any:
        return evaluator.update(d, r, limits, own, tuple(CellStress(*cell) for cell in cells))

    bonds = {"d": differences(scene, seed, share=2.0), "own": remembers(model, scene, seed)}
    u, lost = here(scene, seed)["u"], here(scene, seed + 3)["u"]
    questions = [
        question("breaks", evaluator.breaks, **bonds),
        question("fictitious", fictitious, u=u),
    ]
    if isinstance(model, RenewsBonds):
        questions.append(question("update", update, **bonds, cells=stressed(model, seed)))
    if isinstance(model, Softens):
        questions.append(question("seen", seen, **bonds, lost=lost))
    return [*questions, *_to_draw(model, scene)]


def _to_draw(part: Component, scene: Scene) -> list[Question]:
    if not isinstance(part, Draws):
        return []
    rows = owners(part, scene)

    def draw(**given: Any) -> Any:
        return part.draw(type(rows)(**given), generator_for(SEED, "fracture"))

    return [Question("draw", dict(vars(rows)), draw)]


@questions_of.register
def _to_frame(policy: FramePolicy, scene: Scene, _: int) -> list[Question]:
    sites = sites_of_frame(scene.raster, scene.experiment.rule)
    if sites is None:
        return []
    point, body = sites.nearest()

    def follow(**tables: Any) -> Any:
        return policy.follow(frame_showing(sites, **tables))

    return [Question("follow", {"site": sites.site, "point": point, "body": body}, follow)]


@questions_of.register
def _to_diagnostic(diagnostic: Diagnostic, scene: Scene, seed: int) -> list[Question]:
    moment = moment_of(scene, seed)

    def measure(**tables: Any) -> Any:
        found = measured_by(diagnostic, Shown(moment, tables=tables))
        for variable in diagnostic.variables():
            values = np.asarray(found[variable.name])
            sizes = dict(zip(variable.dims, values.shape, strict=False))
            if values.dtype.kind == "f" and sizes.get("particle") == len(moment.body):
                # NaN may stand at frame points, and beyond the outline.
                allowed = np.isnan(values) & variable.is_recordable(values, moment.inside)
                found[variable.name] = np.where(allowed, 0.0, values)
        return found

    return [Question("measure", Shown(moment).tables, measure)]


@questions_of.register
def _to_lattice(lattice: Lattice, _: Scene, __: int) -> list[Question]:
    return [Question("cell", {}, lattice.cell)]


@questions_of.register
def _to_metric(metric: NeighbourMetric, scene: Scene, _: int) -> list[Question]:
    cell = scene.experiment.lattice.cell()

    def shells() -> Any:
        return [metric.shells_around(cell, s) for s in range(len(cell.sites))]

    return [Question("shells_around", {}, shells)]
