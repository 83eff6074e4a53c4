"""States for tests, and quantities that are computed from them.

These are the results of a few steps, values of state variables, and the input of diagnostics with
permuted rows.
"""

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
    """Return the smallest rest length."""
    return min(math.hypot(*slot.rest) for slots in scene.neighbourhood.slots for slot in slots)


def displacements(scene: Scene, seed: int, share: float = 0.2) -> Floats:
    """Return random displacements of the body, (particle, axis).

    They are at most a fraction `share` of the lattice constant.
    """
    size = share * spacing(scene)
    return np.random.default_rng(seed).uniform(-size, size, (len(scene.raster.body_rows), 2))


def state_with(scene: Scene, u: Any) -> State:
    """Return a state with the displacements u of the body and no velocity. The shape of u is
    (particle, axis).

    The frame follows by its map. The step of the state is 1 and not 0, because engines may replace
    the state of step 0 by the initial state of the experiment.
    """
    state = initial_state(scene)
    raster, flat = scene.raster, state.u.reshape(2, -1)
    flat[:, raster.place_of(raster.body_rows)] = np.asarray(u).T
    if scene.frame:
        scene.frame.follow(flat, flat)
    state.previous[...] = state.u
    state.step = 1
    return state


class DivergenceError(Exception):
    """The steps of a scene diverge with the component that is tested.

    Parameters
    ----------
    scene : Scene
        Scene.
    step : int
        Step in which the displacements are not finite or too large.
    """

    def __init__(self, scene: Scene, step: int) -> None:
        experiment = scene.experiment
        super().__init__(
            f"a run from random displacements diverges at step {step} with the rule "
            f"'{experiment.rule.type}' on the {experiment.lattice.type} lattice; scale the move "
            "that `apply` returns, so that steps with relaxation 1 are stable: divide the force "
            "by the largest stiffness of the bonds at their strain"
        )


def advanced(scene: Scene, u: Any, steps: int) -> Floats:
    """Return the displacements of the body in the steps that follow u, (step, particle, axis).

    Raises
    ------
    DivergenceError
        If a displacement is not finite.
    """
    stepper, raster = Stepper(scene), scene.raster
    states = accumulate(
        range(steps), lambda state, _: stepper.advance(state), initial=state_with(scene, u)
    )
    with np.errstate(all="ignore"):
        u_of_steps = np.array([raster.table(state.u)[raster.body_rows] for state in states])
    is_finite = np.isfinite(u_of_steps).all(axis=(1, 2))
    if not is_finite.all():
        raise DivergenceError(scene, int(np.argmin(is_finite)))
    return u_of_steps


SHAPE = (4, 3)
"""Shape of the arrays with which elementwise functions are called."""
SEED = 7
"""Seed of the generators that components draw from."""


def numbers_of(part: Component, scene: Scene) -> tuple[Remembered, ...]:
    """Return the state variables of a fracture model or of a rule."""
    declared = particle_numbers if isinstance(part, FollowerRule) else bond_numbers
    return declared(scene.experiment)


def owners(part: Component, scene: Scene) -> Bonds | Particles:
    """Return the bonds or particles that have the state variables of a component.

    The form is that in which `draw` receives them.
    """
    return (describe_particles if isinstance(part, FollowerRule) else describe_bonds)(scene)


def _vector(size: float, rng: np.random.Generator) -> Vector:
    return Vector(*rng.uniform(-size, size, (2, *SHAPE)))


def differences(scene: Scene, seed: int, share: float = 0.3) -> list[Vector]:
    """Return a random difference along each slot of the first sublattice."""
    rng = np.random.default_rng(seed)
    return [_vector(share * spacing(scene), rng) for _ in scene.neighbourhood.slots[0]]


def stressed(model: Component, seed: int) -> tuple[Any, ...]:
    """Return the stress of the cells to the left and right of some bonds, and state variables.

    They are arguments of a model that softens cells.
    """
    rng, count = np.random.default_rng(seed), 2 * isinstance(model, SoftensCells)
    return tuple(
        (
            *rng.uniform(-0.2, 0.5, (3, *SHAPE)),
            rng.integers(0, 2, SHAPE).astype(float),
            *rng.uniform(-0.2, 0.5, (4, *SHAPE)),
        )
        for _ in range(count)
    )


def here(scene: Scene, seed: int) -> dict[str, Any]:
    """Return random u and X of some particles, and state variables of the rule as `own`."""
    rng, size = np.random.default_rng(seed + 1), spacing(scene)
    remembered = remembers(scene.experiment.rule, scene, seed)
    return {"u": _vector(0.3 * size, rng), "X": _vector(5 * size, rng), "own": remembered}


def gathered(scene: Scene, d: list[Any], shared: Any = ()) -> list[tuple[Any, ...]]:
    """Return the contributions of every slot.

    Parameters
    ----------
    scene, d
        Scene, and the difference along each slot.
    shared
        State variables of the particle and its neighbour, by slot; by default initial ones.
    """
    evaluator, named = Evaluator(scene), scene.constants.of_particle
    neighbours = evaluator.everywhere(scene.neighbourhood.slots[0])
    if shared:
        ends = [tuple(named(*values) for values in pair) for pair in shared]
        neighbours = [replace(to, shared=e) for to, e in zip(neighbours, ends, strict=True)]
    return [evaluator.contribution(v, v, to) for v, to in zip(d, neighbours, strict=True)]


def paired(scene: Scene, d: list[Any]) -> list[tuple[Any, ...]]:
    """Return the contributions of every pair of slots; none if the rule does not use angles."""
    evaluator = Evaluator(scene)
    neighbours = evaluator.everywhere(scene.neighbourhood.slots[0])
    return [part for part, _ in evaluator.pair_contributions(d, d[0], neighbours)]


def totals(scene: Scene, d: list[Any], order: int = 1) -> tuple[Any, ...]:
    """Return the sums of the contributions that the rule receives. With `order` -1, neighbours and
    pairs are summed in the reverse order."""
    one, other = (
        summed((part, None) for part in parts[::order])
        for parts in (gathered(scene, d), paired(scene, d))
    )
    return one + other


def applied(scene: Scene, total: tuple[Any, ...], **at: Any) -> Any:
    """Return the move that the rule computes from the sums of contributions."""
    return Evaluator(scene).move(total, here_of(scene, **at))


def here_of(scene: Scene, u: Any, X: Any, own: Any) -> Here:
    """Return the values at particles that the rule uses."""
    place: Any = X if scene.experiment.rule.uses_reference else None
    return Here(u, place, place, scene.constants.of_particle(*own))


def remembers(part: Component, scene: Scene, seed: int) -> tuple[Any, ...]:
    """Return state variables of a component for some particles or intact bonds.

    They are initial values or values after two steps. All variables of a particle or bond belong to
    the same time.
    """
    numbers = numbers_of(part, scene)
    if not numbers:
        return ()
    states = [initial_state(scene)]
    with suppress(PluginError):  # Another property reports the failure.
        start = state_with(scene, displacements(scene, seed, share=0.1))
        states.append(Stepper(scene).advance(start, 2))
    pools = []
    for moment in (StateMoment(state, Tables(scene)) for state in states):
        rows = moment.body if isinstance(part, FollowerRule) else moment.broken_step() < 0
        pools.append([moment.remembered(number.name)[rows] for number in numbers])
    columns = [np.concatenate(values) for values in zip(*pools, strict=True)]
    sample = np.random.default_rng(seed + 2).integers(0, len(columns[0]), SHAPE)
    return tuple(column[sample] for column in columns)


def shared(scene: Scene, own: tuple[Any, ...]) -> list[Any]:
    """Return the state variables of particle and neighbour along each slot of the first sublattice.

    The result is empty unless the rule reads both. For slot n the variables of the neighbour are
    those of the particle that is n places away in the arrays.
    """
    if not shares_particles(scene.experiment.rule):
        return []
    slots = range(1, len(scene.neighbourhood.slots[0]) + 1)
    return [(own, tuple(np.roll(value, n) for value in own)) for n in slots]


def moment_of(scene: Scene, seed: int) -> StateMoment:
    """Return the input of diagnostics two steps after a random state. Bonds may have broken."""
    state = state_with(scene, displacements(scene, seed, share=0.6))
    return StateMoment(Stepper(scene).advance(state, 2), Tables(scene))


def measured_by(diagnostic: Diagnostic, now: Any) -> dict[str, Any]:
    """Return the values that a diagnostic measures at a moment, by variable."""
    names = [variable.name for variable in diagnostic.variables()]
    return dict(zip(names, diagnostic.measure(now), strict=True))


class Shown:
    """A moment, its cells or its forces with replaced tables or permuted particles.

    Row n contains row order[n] of the original object. Values that do not belong to particles are
    unchanged.
    """

    OWN = ("displacement", "previous_displacement", "reference")
    """Methods that return values of particles."""
    OF_PARTICLES = (
        "body", "inside", "sum_over_neighbours", "gradient", "on_particles", "remembered",
    )  # fmt: skip
    """Attributes with values of particles, of a moment, its cells or its forces."""

    def __init__(self, inner: Any, order: Any = None, tables: Any = None) -> None:
        self._inner, self._tables = inner, tables
        self._order = np.arange(len(inner.body)) if order is None else order

    @property
    def tables(self) -> dict[str, Any]:
        """Tables that particles have in every moment, by name, in this order."""
        return self._tables or {n: getattr(self._inner, n)()[self._order] for n in self.OWN}

    def __getattr__(self, name: str) -> Any:
        if name in self.OWN:
            table = self.tables[name]
            return lambda rows=None: table if rows is None else table[rows]
        attribute = getattr(self._inner, name)
        if name in ("cells", "forces"):
            return Shown(attribute, self._order)
        if not callable(attribute):
            return self._shown(name, attribute)
        return lambda *given, **named: self._shown(name, attribute(*given, **named))

    def _shown(self, name: str, value: Any) -> Any:
        place = np.argsort(self._order)
        if name in ("rows", "nearest"):
            return place[value]
        if name == "leader_groups":
            return tuple(group._replace(rows=place[group.rows]) for group in value)
        if name == "loads":
            return tuple(load._replace(rows=place[load.rows]) for load in value)
        if name == "table":
            return tuple(replace(part, corners=place[part.corners]) for part in value)
        if name == "touching":
            return tuple(TouchingRows(place[contact.rows], contact.normals) for contact in value)
        in_order = name in self.OF_PARTICLES and len(value) == len(place)
        return value[self._order] if in_order else value


def frame_showing(frame: Any, site: Any, point: Any, body: Any) -> Any:
    """Return the frame with other sites; its `nearest` returns these pairs."""
    same = {name: getattr(frame, name) for name in ("cell", "low", "high", "rule", "body_at")}
    return SimpleNamespace(**same, site=site, nearest=lambda: (point, body))
