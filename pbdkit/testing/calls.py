"""Calls of the elementwise functions of rules and fracture models, with arrays by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from pbdkit.interfaces import (
    Components,
    FollowerRule,
    FractureModel,
    Here,
    RenewsBonds,
    RenewsParticles,
    Slot,
    Softens,
    Vector,
)
from pbdkit.interfaces.component import as_vector
from pbdkit.interfaces.rule import material_of
from pbdkit.scene.scene import Scene
from pbdkit.stepping.evaluator import Evaluator, summed
from pbdkit.testing.property import Arrays, Question
from pbdkit.testing.states import (
    SHAPE,
    draws,
    own_of,
    remembered_of_bonds,
    remembered_of_particles,
    spacing,
)


def vector(arrays: Arrays, name: str) -> Vector:
    """The vector whose components stand under `name.x` and `name.y`."""
    return Vector(arrays[f"{name}.x"], arrays[f"{name}.y"])


def differences(scene: Scene, seed: int, share: float = 0.3) -> Arrays:
    """A difference along each slot of the first sublattice, at random."""
    rng, size = np.random.default_rng(seed), share * spacing(scene)
    slots = range(len(scene.neighbourhood.slots[0]))
    return {f"d{k}.{c}": rng.uniform(-size, size, SHAPE) for k in slots for c in "xy"}


def here(scene: Scene, seed: int) -> Arrays:
    """u and X of some particles, at random, and what the rule remembers of some."""
    rng, size = np.random.default_rng(seed + 1), spacing(scene)
    u = {f"u.{c}": rng.uniform(-0.3 * size, 0.3 * size, SHAPE) for c in "xy"}
    X = {f"X.{c}": rng.uniform(-5 * size, 5 * size, SHAPE) for c in "xy"}
    return u | X | remembered_of_particles(scene, seed)


def gathered(scene: Scene, arrays: Arrays) -> list[tuple[Any, ...]]:
    """The contributions of every slot."""
    evaluator, slots = Evaluator(scene), scene.neighbourhood.slots[0]
    differences = [vector(arrays, f"d{k}") for k in range(len(slots))]
    neighbours = zip(differences, evaluator.everywhere(slots), strict=True)
    return [evaluator.contribution(d, d, to) for d, to in neighbours]


def applied(scene: Scene, contributions: list[tuple[Any, ...]], arrays: Arrays) -> Arrays:
    """The move that the sums of contributions make."""
    total = summed((parts, None) for parts in contributions)
    return _parts("move", Evaluator(scene).move(total, _standing(scene, arrays)))


def _standing(scene: Scene, arrays: Arrays) -> Here:
    X = vector(arrays, "X") if scene.experiment.rule.uses_reference else None
    own = scene.constants.of_particle(*own_of(arrays))
    return Here(vector(arrays, "u"), X, X, own)


def ask_rule(rule: FollowerRule, scene: Scene, seed: int) -> list[Question]:
    """`gather` and `apply`; `remember`, `force` and `draw` where it has them."""
    d, standing, evaluator = differences(scene, seed), here(scene, seed), Evaluator(scene)

    def gather(arrays: Arrays) -> Arrays:
        found = gathered(scene, arrays)
        return {
            f"{name} of slot {k}": part
            for k, parts in enumerate(found)
            for name, part in _flat(parts).items()
        }

    contributions = gathered(scene, {k: v.copy() for k, v in d.items()})
    if len({len(_flat(parts)) for parts in contributions}) > 1:
        return [_each("gather", d, gather)]  # they cannot be summed, which is found elsewhere
    totals = summed((parts, None) for parts in contributions)
    named = {name: np.broadcast_to(t, SHAPE).copy() for name, t in _flat(totals).items()}

    def total(arrays: Arrays) -> tuple[Any, ...]:
        values = iter([arrays[name] for name in named])
        return tuple(
            t.each(lambda _: next(values)) if isinstance(t, Components) else next(values)
            for t in totals
        )

    def apply(arrays: Arrays) -> Arrays:
        return _parts("move", evaluator.move(total(arrays), _standing(scene, arrays)))

    def remember(arrays: Arrays) -> Arrays:
        return _counted(evaluator.remember(total(arrays), _standing(scene, arrays)))

    def force(arrays: Arrays) -> Arrays:
        return _parts("force", evaluator.force(total(arrays), _standing(scene, arrays)))

    questions = [
        _each("gather", d, gather),
        _each("apply", named | standing, apply),
    ]
    if isinstance(rule, RenewsParticles):
        questions.append(_each("remember", named | standing, remember))
    if material_of(rule) is not None:
        questions.append(_each("force", named | standing, force))
    return [*questions, *draws(rule, scene)]


def breaking(scene: Scene, slot: Slot, d: Any, own: Any, r: Any = None) -> Any:
    """Whether bonds break that remember these numbers."""
    limits = scene.constants.limits[slot]
    return Evaluator(scene).breaks(d, r or slot.rest, limits, own)


def updated(scene: Scene, slot: Slot, d: Any, own: Any, r: Any = None) -> tuple[Any, ...]:
    """The new values of the numbers that change."""
    return Evaluator(scene).update(d, r or slot.rest, scene.constants.limits[slot], own)


def ask_fracture_model(model: FractureModel, scene: Scene, seed: int) -> list[Question]:
    """`breaks` and `fictitious`; `update`, `seen` and `draw` where it has them."""
    slots, p = scene.neighbourhood.slots[0], scene.constants.fracture
    u = {k: v for k, v in here(scene, seed).items() if k.startswith("u.")}
    lost = {k.replace("u", "lost"): v for k, v in here(scene, seed + 3).items() if k in u}

    def breaks(arrays: Arrays) -> Arrays:
        return {
            f"slot {k}": breaking(scene, slot, vector(arrays, f"d{k}"), own_of(arrays))
            for k, slot in enumerate(slots)
        }

    def update(arrays: Arrays) -> Arrays:
        found = (
            updated(scene, slot, vector(arrays, f"d{k}"), own_of(arrays))
            for k, slot in enumerate(slots)
        )
        return {
            f"slot {k}: {n}": v for k, new in enumerate(found) for n, v in _counted(new).items()
        }

    def fictitious(arrays: Arrays) -> Arrays:
        u = vector(arrays, "u")
        return _at_slots("fictitious", (model.fictitious(u, slot.rest, p) for slot in slots))

    def seen(arrays: Arrays) -> Arrays:
        assert isinstance(model, Softens)
        lost, own, limits = vector(arrays, "lost"), own_of(arrays), scene.constants.limits
        c = {slot: scene.constants.of_bond(*limits[slot], *own) for slot in slots}
        found = (
            model.seen(vector(arrays, f"d{k}"), lost, s.rest, c[s], p) for k, s in enumerate(slots)
        )
        return _at_slots("seen", found)

    bonds = differences(scene, seed, share=2.0) | remembered_of_bonds(scene, seed)
    questions = [
        _each("breaks", bonds, breaks),
        _each("fictitious", u, fictitious),
    ]
    if isinstance(model, RenewsBonds):
        questions.append(_each("update", bonds, update))
    if isinstance(model, Softens):
        questions.append(_each("seen", bonds | lost, seen))
    return [*questions, *draws(model, scene)]


def _each(what: str, inputs: Arrays, ask: Callable[[Arrays], Arrays]) -> Question:
    return Question(what, inputs, ask, elementwise=True)


def _at_slots(what: str, found: Iterable[Any]) -> Arrays:
    like = Vector(0.0, 0.0)
    return {
        f"{c} at slot {k}": value
        for k, answer in enumerate(found)
        for c, value in zip("xy", as_vector(answer, what, like), strict=True)
    }


def _parts(name: str, v: Any) -> Arrays:
    return {f"{name}.{c}": value for c, value in v._asdict().items()}


def _flat(parts: tuple[Any, ...]) -> Arrays:
    """Contributions by name, vectors component by component."""
    found: Arrays = {}
    for n, part in enumerate(parts):
        name = f"total[{n}]"
        found |= _parts(name, part) if isinstance(part, Components) else {name: part}
    return found


def _counted(values: tuple[Any, ...]) -> Arrays:
    return {f"value {n}": value for n, value in enumerate(values)}
