"""States made by hand and what a few steps make of them; the numbers that a part remembers, and
moments shown in another order."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from itertools import accumulate
from types import SimpleNamespace
from typing import Any

import numpy as np

from pbdkit.array_types import Floats
from pbdkit.errors import PluginError
from pbdkit.io.snapshot import StateMoment, Tables
from pbdkit.plugin import (
    Bonds,
    Component,
    Diagnostic,
    FollowerRule,
    Here,
    Particles,
    Remembered,
    SoftensCells,
    TouchingRows,
    Vector,
)
from pbdkit.plugin.rule import shares_particles
from pbdkit.scene.constants import bond_numbers, particle_numbers
from pbdkit.scene.scene import Scene
from pbdkit.stepping.numpy_engine import Stepper
from pbdkit.stepping.rule_evaluation import Evaluator, summed
from pbdkit.stepping.state import State, describe_bonds, describe_particles, initial_state


def spacing(scene: Scene) -> float:
    """The smallest rest length."""
    return min(math.hypot(*slot.rest) for own in scene.neighbourhood.slots for slot in own)


def displacements(scene: Scene, seed: int, share: float = 0.2) -> Floats:
    """u of the body at random, (body particle, axis), up to a share of the spacing."""
    size = share * spacing(scene)
    return np.random.default_rng(seed).uniform(-size, size, (len(scene.raster.body_rows), 2))


def state_with(scene: Scene, u: Any) -> State:
    """The state whose body has displacements u, (body particle, axis), and stands still; the frame
    follows by its map. It is that of step 1: what an engine knows of step 0 is the experiment's own
    start."""
    state = initial_state(scene)
    raster, flat = scene.raster, state.u.reshape(2, -1)
    flat[:, raster.place_of(raster.body_rows)] = np.asarray(u).T
    if scene.frame:
        scene.frame.follow(flat, flat)
    state.previous[...] = state.u
    state.step = 1
    return state


def advanced(scene: Scene, u: Any, steps: int) -> Floats:
    """The body's displacements some steps after those given, (step, body particle, axis)."""
    stepper, raster = Stepper(scene), scene.raster
    states = accumulate(
        range(steps), lambda state, _: stepper.advance(state), initial=state_with(scene, u)
    )
    return np.array([raster.table(state.u)[raster.body_rows] for state in states])


SHAPE = (4, 3)
"""The shape of the arrays with which elementwise functions are called."""
SEED = 7
"""Of the generators that parts are given to draw from."""


def numbers_of(part: Component, scene: Scene) -> tuple[Remembered, ...]:
    """What a fracture model remembers of each bond, or a rule of each particle."""
    declared = particle_numbers if isinstance(part, FollowerRule) else bond_numbers
    return declared(scene.experiment)


def owners(part: Component, scene: Scene) -> Bonds | Particles:
    """Those of whom it remembers numbers, as `draw` is shown them."""
    return (describe_particles if isinstance(part, FollowerRule) else describe_bonds)(scene)


def _vector(size: float, rng: np.random.Generator) -> Vector:
    return Vector(*rng.uniform(-size, size, (2, *SHAPE)))


def differences(scene: Scene, seed: int, share: float = 0.3) -> list[Vector]:
    """A difference along each slot of the first sublattice, at random."""
    rng = np.random.default_rng(seed)
    return [_vector(share * spacing(scene), rng) for _ in scene.neighbourhood.slots[0]]


def stressed(model: Component, seed: int) -> tuple[Any, ...]:
    """The cells to the left and right of some bonds, by the numbers of their stress, where a
    fracture model softens cells by it."""
    rng, count = np.random.default_rng(seed), 2 * isinstance(model, SoftensCells)
    return tuple(
        (*rng.uniform(-0.2, 0.5, (3, *SHAPE)), rng.integers(0, 2, SHAPE).astype(float))
        for _ in range(count)
    )


def here(scene: Scene, seed: int) -> dict[str, Any]:
    """u and X of some particles, at random, and what the rule remembers of some, as `own`."""
    rng, size = np.random.default_rng(seed + 1), spacing(scene)
    own = remembers(scene.experiment.rule, scene, seed)
    return {"u": _vector(0.3 * size, rng), "X": _vector(5 * size, rng), "own": own}


def gathered(scene: Scene, d: list[Any], shared: Any = ()) -> list[tuple[Any, ...]]:
    """The contributions of every slot; `shared` is what is remembered of the particle and of the
    neighbour there, by slot, unless it is as at the start."""
    evaluator, named = Evaluator(scene), scene.constants.of_particle
    neighbours = evaluator.everywhere(scene.neighbourhood.slots[0])
    if shared:
        ends = [tuple(named(*values) for values in pair) for pair in shared]
        neighbours = [replace(to, shared=e) for to, e in zip(neighbours, ends, strict=True)]
    return [evaluator.contribution(v, v, to) for v, to in zip(d, neighbours, strict=True)]


def applied(scene: Scene, contributions: list[tuple[Any, ...]], **at: Any) -> Any:
    """The move that the sums of contributions make."""
    return Evaluator(scene).move(summed((c, None) for c in contributions), standing(scene, **at))


def standing(scene: Scene, u: Any, X: Any, own: Any) -> Here:
    """What stands at a particle."""
    place: Any = X if scene.experiment.rule.uses_reference else None
    return Here(u, place, place, scene.constants.of_particle(*own))


def remembers(part: Component, scene: Scene, seed: int) -> tuple[Any, ...]:
    """Numbers that it remembers of some particles, or of some bonds that have not broken, as they
    are at the start or two steps later; those of one owner stand together."""
    numbers = numbers_of(part, scene)
    if not numbers:
        return ()
    states = [initial_state(scene)]
    with suppress(PluginError):  # what fails is asked about directly, and named there
        start = state_with(scene, displacements(scene, seed, share=0.1))
        states.append(Stepper(scene).advance(start, 2))
    pools = []
    for moment in (StateMoment(state, Tables(scene)) for state in states):
        whose = moment.body if isinstance(part, FollowerRule) else moment.broken_step() < 0
        pools.append([moment.remembered(number.name)[whose] for number in numbers])
    columns = [np.concatenate(values) for values in zip(*pools, strict=True)]
    rows = np.random.default_rng(seed + 2).integers(0, len(columns[0]), SHAPE)
    return tuple(column[rows] for column in columns)


def shared(scene: Scene, own: tuple[Any, ...]) -> list[Any]:
    """Along each slot of the first sublattice what is remembered of particles and of neighbours,
    for rules that see it: each neighbour is another of the particles."""
    if not shares_particles(scene.experiment.rule):
        return []
    slots = range(1, len(scene.neighbourhood.slots[0]) + 1)
    return [(own, tuple(np.roll(value, n) for value in own)) for n in slots]


def moment_of(scene: Scene, seed: int) -> StateMoment:
    """The scene two steps after a random start; bonds may have broken."""
    state = state_with(scene, displacements(scene, seed, share=0.6))
    return StateMoment(Stepper(scene).advance(state, 2), Tables(scene))


def measured_by(diagnostic: Diagnostic, now: Any) -> dict[str, Any]:
    """What a diagnostic measures of a moment, by variable."""
    names = [variable.name for variable in diagnostic.variables()]
    return dict(zip(names, diagnostic.measure(now), strict=True))


class Shown:
    """A moment, its cells or its forces with other tables in the place of its own, or with its
    particles in another order: row n shows what stands in row order[n]. What is in no order of
    particles is as it is."""

    OWN = ("displacement", "previous_displacement", "reference")
    OF_PARTICLES = (
        "body", "inside", "sum_over_neighbours", "gradient", "on_particles", "remembered",
    )  # fmt: skip

    def __init__(self, inner: Any, order: Any = None, tables: Any = None) -> None:
        self._inner, self._tables = inner, tables
        self._order = np.arange(len(inner.body)) if order is None else order

    @property
    def tables(self) -> dict[str, Any]:
        """Those that particles have in every moment, by name, in this order."""
        return self._tables or {n: getattr(self._inner, n)()[self._order] for n in self.OWN}

    def __getattr__(self, name: str) -> Any:
        if name in self.OWN:
            table = self.tables[name]
            return lambda rows=None: table if rows is None else table[rows]
        found = getattr(self._inner, name)
        if name in ("cells", "forces"):
            return Shown(found, self._order)
        if not callable(found):
            return self._shown(name, found)
        return lambda *given, **named: self._shown(name, found(*given, **named))

    def _shown(self, name: str, found: Any) -> Any:
        place = np.argsort(self._order)
        if name in ("rows", "nearest"):
            return place[found]
        if name == "leader_groups":
            return tuple(group._replace(rows=place[group.rows]) for group in found)
        if name == "loads":
            return tuple(load._replace(rows=place[load.rows]) for load in found)
        if name == "touching":
            return tuple(TouchingRows(place[one.rows], one.normals) for one in found)
        in_order = name in self.OF_PARTICLES and len(found) == len(place)
        return found[self._order] if in_order else found


def frame_showing(frame: Any, site: Any, point: Any, body: Any) -> Any:
    """The frame with other sites, and with these pairs for those that are nearest."""
    same = {name: getattr(frame, name) for name in ("cell", "low", "high", "rule", "body_at")}
    return SimpleNamespace(**same, site=site, nearest=lambda: (point, body))
