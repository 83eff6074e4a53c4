"""Calls of the elementwise functions of rules and fracture models, with arrays by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from pbdkit.interfaces import FollowerRule, FractureModel, Here, Slot, Vector
from pbdkit.scene.scene import Scene
from pbdkit.testing.numbers import (
    SHAPE,
    draws,
    own_of,
    remembered_of_bonds,
    remembered_of_particles,
)
from pbdkit.testing.question import Arrays, Question
from pbdkit.testing.states import spacing


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
    x, y = rule.apply(tuple(totals), _standing(rule, arrays), scene.constants.rule)
    return {"move.x": x, "move.y": y}


def _standing(rule: FollowerRule, arrays: Arrays) -> Here:
    X = vector(arrays, "X") if rule.uses_reference else Vector(None, None)
    return Here(vector(arrays, "u"), X, own_of(arrays))


def ask_rule(rule: FollowerRule, scene: Scene, seed: int) -> list[Question]:
    """`gather` and `apply`; `remember`, `force` and `draw` where it has them."""
    d, standing, p = differences(scene, seed), here(scene, seed), scene.constants.rule

    def gather(arrays: Arrays) -> Arrays:
        found = gathered(rule, scene, arrays)
        return {f"{n} of slot {k}": c for k, parts in enumerate(found) for n, c in enumerate(parts)}

    contributions = gathered(rule, scene, {k: v.copy() for k, v in d.items()})
    if len({len(parts) for parts in contributions}) > 1:
        return [_each("gather", d, gather)]  # they cannot be summed, which is found elsewhere
    totals = summed(contributions)
    named = {f"total[{n}]": np.broadcast_to(t, SHAPE).copy() for n, t in enumerate(totals)}

    def apply(arrays: Arrays) -> Arrays:
        return applied(rule, scene, [arrays[name] for name in named], arrays)

    def remember(arrays: Arrays) -> Arrays:
        total = tuple(arrays[name] for name in named)
        return _counted(rule.remember(total, _standing(rule, arrays), p))

    def force(arrays: Arrays) -> Arrays:
        total = tuple(arrays[name] for name in named)
        return dict(zip("xy", rule.force(total, _standing(rule, arrays), p), strict=True))

    questions = [
        _each("gather", d, gather),
        _each("apply", named | standing, apply),
    ]
    if rule.remembers():
        questions.append(_each("remember", named | standing, remember))
    if rule.stiffness() is not None:
        questions.append(_each("force", named | standing, force))
    return [*questions, *draws(rule, scene)]


def constants(model: FractureModel, slot: Slot, arrays: Arrays) -> tuple[Any, ...]:
    """The constants of a slot with the numbers of bonds behind them."""
    return *model.constants(slot), *own_of(arrays)


def breaking(
    model: FractureModel, scene: Scene, slot: Slot, d: Vector, own: Any, r: Vector | None = None
) -> Any:
    """Whether bonds break that remember these numbers."""
    return model.breaks(d, r or slot.rest, (*model.constants(slot), *own), scene.constants.fracture)


def updated(
    model: FractureModel, scene: Scene, slot: Slot, d: Vector, own: Any, r: Vector | None = None
) -> tuple[Any, ...]:
    """The new values of the numbers that change."""
    c, p = (*model.constants(slot), *own), scene.constants.fracture
    return tuple(model.update(d, r or slot.rest, c, p))


def ask_fracture_model(model: FractureModel, scene: Scene, seed: int) -> list[Question]:
    """`breaks` and `fictitious`; `update`, `seen` and `draw` where it has them."""
    slots, p = scene.neighbourhood.slots[0], scene.constants.fracture
    u = {k: v for k, v in here(scene, seed).items() if k.startswith("u.")}
    lost = {k.replace("u", "lost"): v for k, v in here(scene, seed + 3).items() if k in u}

    def breaks(arrays: Arrays) -> Arrays:
        return {
            f"slot {k}": breaking(model, scene, slot, vector(arrays, f"d{k}"), own_of(arrays))
            for k, slot in enumerate(slots)
        }

    def update(arrays: Arrays) -> Arrays:
        found = (
            updated(model, scene, slot, vector(arrays, f"d{k}"), own_of(arrays))
            for k, slot in enumerate(slots)
        )
        return {
            f"slot {k}: {n}": v for k, new in enumerate(found) for n, v in _counted(new).items()
        }

    def fictitious(arrays: Arrays) -> Arrays:
        return _at_slots(model.fictitious(vector(arrays, "u"), slot.rest, p) for slot in slots)

    def seen(arrays: Arrays) -> Arrays:
        lost = vector(arrays, "lost")
        return _at_slots(
            model.seen(vector(arrays, f"d{k}"), lost, s.rest, constants(model, s, arrays), p)
            for k, s in enumerate(slots)
        )

    bonds = differences(scene, seed, share=2.0) | remembered_of_bonds(scene, seed)
    questions = [
        _each("breaks", bonds, breaks),
        _each("fictitious", u, fictitious),
    ]
    if model.updates():
        questions.append(_each("update", bonds, update))
    if model.softens():
        questions.append(_each("seen", bonds | lost, seen))
    return [*questions, *draws(model, scene)]


def _each(what: str, inputs: Arrays, ask: Callable[[Arrays], Arrays]) -> Question:
    return Question(what, inputs, ask, elementwise=True)


def _at_slots(found: Iterable[Vector]) -> Arrays:
    return {
        f"{c} at slot {k}": value
        for k, answer in enumerate(found)
        for c, value in zip("xy", answer, strict=True)
    }


def _counted(values: tuple[Any, ...]) -> Arrays:
    return {f"value {n}": value for n, value in enumerate(values)}
