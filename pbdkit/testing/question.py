"""A question: one call of a component with arrays that are kept; and all that can be asked.

Inputs and answers are trees: arrays and numbers in vectors, tuples, lists and dicts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pbdkit.interfaces import (
    Component,
    Components,
    Diagnostic,
    Draws,
    FollowerRule,
    FractureModel,
    FramePolicy,
    Here,
    Lattice,
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
    differences,
    frame_showing,
    here,
    moment_of,
    owners,
    remembers,
    shown,
)

Arrays = dict[str, Any]
"""Arrays and numbers by name: `d0.x`, `own1`."""


def flat(tree: Any, name: str = "") -> Arrays:
    """The arrays and numbers of a tree by name."""
    if isinstance(tree, Components):
        parts = {f"{name}.{c}".lstrip("."): v for c, v in zip("xyz", tree, strict=False)}
    elif isinstance(tree, dict):
        parts = tree
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


def questions_of(component: Component, scene: Scene, seed: int) -> list[Question]:
    """Those that its interface allows."""
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


def gathered(scene: Scene, d: list[Any]) -> list[tuple[Any, ...]]:
    """The contributions of every slot."""
    evaluator = Evaluator(scene)
    neighbours = zip(d, evaluator.everywhere(scene.neighbourhood.slots[0]), strict=True)
    return [evaluator.contribution(one, one, to) for one, to in neighbours]


def applied(scene: Scene, contributions: list[tuple[Any, ...]], **at: Any) -> Any:
    """The move that the sums of contributions make."""
    return Evaluator(scene).move(summed((c, None) for c in contributions), _standing(scene, **at))


def _standing(scene: Scene, u: Any, X: Any, own: Any) -> Here:
    place = X if scene.experiment.rule.uses_reference else None
    return Here(u, place, place, scene.constants.of_particle(*own))


def _to_rule(rule: FollowerRule, scene: Scene, seed: int) -> list[Question]:
    """`gather` and `apply`; `remember`, `force` and `draw` where it has them."""
    d, evaluator = differences(scene, seed), Evaluator(scene)
    contributions = gathered(scene, each(np.array, d))
    gather = Question("gather", {"d": d}, lambda d: gathered(scene, d), elementwise=True)
    if len({len(flat(parts)) for parts in contributions}) > 1:
        return [gather]  # they cannot be summed, which is found elsewhere
    total = each(
        lambda t: np.broadcast_to(t, SHAPE).copy(), summed((c, None) for c in contributions)
    )
    asks: dict[str, Callable[[Any, Here], Any]] = {"apply": evaluator.move}
    if isinstance(rule, RenewsParticles):
        asks["remember"] = evaluator.remember
    if material_of(rule) is not None:
        asks["force"] = evaluator.force

    def question(what: str) -> Question:
        def ask(total: Any, **at: Any) -> Any:
            return asks[what](total, _standing(scene, **at))

        return Question(what, {"total": total} | here(scene, seed), ask, elementwise=True)

    return [gather, *map(question, asks), *_to_draw(rule, scene)]


def _to_fracture_model(model: FractureModel, scene: Scene, seed: int) -> list[Question]:
    """`breaks` and `fictitious`; `update`, `seen` and `draw` where it has them."""
    slots, p, limits = (
        scene.neighbourhood.slots[0],
        scene.constants.fracture,
        scene.constants.limits,
    )
    evaluator = Evaluator(scene)

    def breaks(d: Any, own: Any) -> Any:
        return [evaluator.breaks(v, s.rest, limits[s], own) for v, s in zip(d, slots, strict=True)]

    def update(d: Any, own: Any) -> Any:
        return [evaluator.update(v, s.rest, limits[s], own) for v, s in zip(d, slots, strict=True)]

    def fictitious(u: Any) -> Any:
        return [as_vector(model.fictitious(u, s.rest, p), "fictitious", u) for s in slots]

    def seen(d: Any, own: Any, lost: Any) -> Any:
        assert isinstance(model, Softens)
        c = [scene.constants.of_bond(*limits[s], *own) for s in slots]
        found = [model.seen(v, lost, s.rest, k, p) for v, s, k in zip(d, slots, c, strict=True)]
        return [as_vector(one, "seen", lost) for one in found]

    bonds = {"d": differences(scene, seed, share=2.0), "own": remembers(model, scene, seed)}
    u, lost = here(scene, seed)["u"], here(scene, seed + 3)["u"]
    questions = [
        Question("breaks", bonds, breaks, elementwise=True),
        Question("fictitious", {"u": u}, fictitious, elementwise=True),
    ]
    if isinstance(model, RenewsBonds):
        questions.append(Question("update", bonds, update, elementwise=True))
    if isinstance(model, Softens):
        questions.append(Question("seen", bonds | {"lost": lost}, seen, elementwise=True))
    return [*questions, *_to_draw(model, scene)]


def _to_draw(part: Component, scene: Scene) -> list[Question]:
    if not isinstance(part, Draws):
        return []
    rows = owners(part, scene)

    def draw(**given: Any) -> Any:
        return dict(part.draw(type(rows)(**given), generator_for(SEED, "fracture")))

    return [Question("draw", dict(vars(rows)), draw)]


def _to_frame(policy: FramePolicy, scene: Scene, _: int) -> list[Question]:
    sites = sites_of_frame(scene.raster, scene.experiment.rule)
    if sites is None:
        return []
    point, body = sites.nearest()

    def follow(**tables: Any) -> Any:
        return dict(vars(policy.follow(frame_showing(sites, **tables))))

    return [Question("follow", {"site": sites.site, "point": point, "body": body}, follow)]


def _to_diagnostic(diagnostic: Diagnostic, scene: Scene, seed: int) -> list[Question]:
    moment = moment_of(scene, seed)

    def measure(**tables: Any) -> Any:
        found: dict[str, Any] = {}
        measured = diagnostic.measure(shown(moment, tables=tables))
        for variable, value in zip(diagnostic.variables(), measured, strict=True):
            values = found[variable.name] = np.asarray(value)
            sizes = dict(zip(variable.dims, values.shape, strict=False))
            if values.dtype.kind == "f" and sizes.get("particle") == len(moment.body):
                # NaN may stand at frame points.
                allowed = np.isnan(values) & variable.is_recordable(values, moment.body)
                found[variable.name] = np.where(allowed, 0.0, values)
        return found

    return [Question("measure", shown(moment).tables, measure)]


def _to_lattice(lattice: Lattice, _: Scene, __: int) -> list[Question]:
    def cell() -> Any:
        found = lattice.cell()
        sites = [(*s.at, *s.index, *s.primitive) for s in found.sites]
        return {"vectors": found.vectors, "sites": sites} | {
            name: getattr(found, name) for name in ("period", "primitive")
        }

    return [Question("cell", {}, cell)]


def _to_metric(metric: NeighbourMetric, scene: Scene, _: int) -> list[Question]:
    cell = scene.experiment.lattice.cell()

    def shells() -> Any:
        around = [metric.shells_around(cell, s) for s in range(len(cell.sites))]
        return [[[(o.target, *o.cell, *o.rest) for o in s] for s in shells] for shells in around]

    return [Question("shells_around", {}, shells)]
