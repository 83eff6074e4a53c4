"""Moves of followers in a step: the move of the rule, relaxation and momentum. Neighbours are
constant, or re-evaluated by distance in every step."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from pbdkit.array_types import Floats, Indices, Mask
from pbdkit.model.solver import Stepping
from pbdkit.plugin import FollowerRule, Here, StoresEnergy, Vector
from pbdkit.plugin.discovery import errors_attributed_to
from pbdkit.plugin.rule import shares_particles
from pbdkit.plugin.vector import vector
from pbdkit.scene.scene import Scene
from pbdkit.stepping.frame_following import FollowFrame
from pbdkit.stepping.kernel import KernelWriter
from pbdkit.stepping.neighbour_search import NeighbourSearch
from pbdkit.stepping.rule_evaluation import (
    Contributions,
    Evaluator,
    Neighbour,
    Surroundings,
    blocks,
)
from pbdkit.stepping.state import State, shown
from pbdkit.stepping.step import Call, Cells, Hindrance, Mode, Operation, Reach, Step

REAL = "fiub"
"""Kinds of numpy data types for real numbers."""


class Followers(ABC):
    """Followers of a scene with their neighbours."""

    @abstractmethod
    def move(self, m: Floats, new: Floats, state: State) -> None:
        """Write the displacements of all body particles into `new`, from the intermediate
        configuration m.

        On entry, `new` contains the displacements at the beginning of the previous step, from which
        the momentum is computed. Particles without neighbours stay. The values of leaders are
        overwritten later. `state` is the state at the end of the previous step; its state variables
        of particles are updated in place.
        """


def target(u: Any, move: Any, before: Any, solver: Stepping) -> Any:
    """Return u + relaxation · move + momentum · (u - before) of one component, elementwise.

    Raises ValueError if the move is not one real number for each particle.
    """
    if np.shape(move) not in ((), np.shape(u)):
        raise ValueError(
            f"it returned the shape {np.shape(move)} for particles of the shape {np.shape(u)}: "
            "it is not elementwise"
        )
    if not isinstance(move, float) and np.asarray(move).dtype.kind not in REAL:
        raise ValueError(
            f"it returned values of {np.asarray(move).dtype}, not real numbers; return numbers of "
            "type float"
        )
    place = u + (move if solver.relaxation == 1.0 else solver.relaxation * move)
    return place + solver.memory * (u - before) if solver.memory != 0.0 else place


Summed = tuple[Surroundings, Evaluator, Contributions, Here]


class SlotFollowers(Followers):
    """Followers of a scene with constant neighbours."""

    def __init__(self, scene: Scene, solver: Stepping | None = None) -> None:
        self._scene = scene
        self._solver = solver or scene.experiment.stepping
        self._inner = SlotFollowers(scene.inner, Stepping()) if scene.inner else None
        self._blocks = blocks(scene)
        evaluator = Evaluator(scene)
        varies = scene.constants.by_particle
        self._evaluators = [
            evaluator.given(b.parameters) if varies else evaluator for b in self._blocks
        ]

    def move(self, m: Floats, new: Floats, state: State) -> None:
        """Move the particles block by block. No block reads displacements that another block
        writes, so that the order of the blocks does not matter."""
        loads = self._scene.loads
        acting = loads.at(state.step + 1, m.dtype) if loads else None
        for around, evaluator, total, values in self._summed(m, state):
            load = None if acting is None else vector(shown(around.where.of(acting)))
            moved = evaluator.move(total, values, load)
            planes = around.where.of(m), moved, around.where.of(new)
            for u, move, plane in zip(*planes, strict=True):
                _write(plane, target(u, move, plane, self._solver), around.movable, u)
            evaluator.renew_particles(total, values, around.own(state), around.movable)

    def moves(self, m: Floats, state: State) -> Floats:
        """Return the moves of body particles by the rule, including leaders; zero for particles
        without neighbours."""
        return self._of_all(Evaluator.move, m, state)

    def load_moves(self, m: Floats, state: State, step: int) -> Floats:
        """Return what the loads of a step add to the moves of body particles."""
        assert self._scene.loads
        acting, out = self._scene.loads.at(step, m.dtype), np.zeros_like(m)
        for around, evaluator, total, values in self._summed(m, state):
            load = vector(shown(around.where.of(acting)))
            moves = evaluator.move(total, values, load), evaluator.move(total, values)
            for loaded, unloaded, plane in zip(*moves, around.where.of(out), strict=True):
                _write(plane, loaded - unloaded, around.movable, 0.0)
        return out

    def forces(self, m: Floats, state: State) -> Floats:
        """Return the forces of the rule on body particles, including leaders, divided by Young's
        modulus and thickness; zero for particles without neighbours."""
        return self._of_all(Evaluator.force, m, state)

    def _of_all(self, function: Callable[..., Any], m: Floats, state: State) -> Floats:
        """Evaluate a function of the summed contributions at all particles. Its value is zero at
        particles without neighbours."""
        out = np.zeros_like(m)
        for around, evaluator, total, arguments in self._summed(m, state):
            values = function(evaluator, total, arguments)
            for value, plane in zip(values, around.where.of(out), strict=True):
                _write(plane, value, around.movable, 0.0)
        return out

    def energy(self, m: Floats, state: State) -> float:
        """Return the strain energy divided by Young's modulus and thickness: the energy that the
        rule defines or, if it defines none, -½ Σ u·force."""
        if not isinstance(self._scene.experiment.rule, StoresEnergy):
            return self._work(m, self.forces(m, state))
        planes, out = self._seen(m, state), np.zeros_like(m[0])
        for around, evaluator in zip(self._blocks, self._evaluators, strict=True):
            (value,) = around.sums(evaluator.energy, planes, state)
            _write(around.where.of(out), value, around.movable, 0.0)
        return float(out.sum())

    def _work(self, u: Floats, forces: Floats) -> float:
        """Return -½ Σ u·force over the body. If the forces have no resultant, the mean of u is
        subtracted, so that rigid translations do not change the result."""
        place = self._scene.raster.place_of(self._scene.raster.body_rows)
        u, forces = u.reshape(len(u), -1)[:, place], forces.reshape(len(u), -1)[:, place]
        if self._scene.frame is None:
            u = u - u.mean(axis=1, keepdims=True)
        return -0.5 * float((u * forces).sum())

    def _seen(self, m: Floats, state: State) -> Floats:
        """Return the vectors that enter the rule by their differences between neighbours. They are
        the displacements or, if the rule has an inner rule, the moves of the inner rule."""
        if self._inner is None:
            return m
        z = self._inner.moves(m, state)
        if self._scene.frame:
            flat = z.reshape(len(z), -1)
            self._scene.frame.follow(flat, flat)
        return z

    def _summed(self, m: Floats, state: State) -> Iterator[Summed]:
        """Generate every block with its summed contributions and the values at its particles."""
        planes, previous = self._seen(m, state), state
        if shares_particles(self._scene.experiment.rule):
            # Neighbours have the state variables from before the step, also in blocks that are
            # already updated.
            previous = replace(
                state, particle_values=tuple(v.copy() for v in state.particle_values)
            )
        for around, evaluator in zip(self._blocks, self._evaluators, strict=True):
            total = around.total(evaluator, planes, previous)
            yield around, evaluator, total, around.here(planes, state)


def _write(plane: Floats, value: Any, where_: Mask | None, otherwise: Any) -> None:
    plane[...] = value if where_ is None else np.where(where_, value, otherwise)


class GatheringFollowers(Followers):
    """Followers of a scene with re-evaluated neighbours.

    `gather` is called with a table that has a row for each pair of neighbours, and `apply` with a
    table that has a row for each particle. Particles that are neighbours in the reference
    configuration are summed first, in the order of their slots and with the rest offsets of the
    slots. For this reason a body at rest stays exactly at rest.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene, self._evaluator = scene, Evaluator(scene)
        self._none = next(iter(scene.constants.weights.values()))
        self._search = NeighbourSearch(scene)
        self._place, self._body = self._search.place, self._search.body
        X = vector(self._search.X)
        self._at = X.each(np.add, scene.raster.lattice.origin)
        self._centred = X.each(np.subtract, scene.middle)

    def move(self, m: Floats, new: Floats, state: State) -> None:
        """Move all particles from the intermediate configuration m. In scenes with re-evaluated
        neighbours, bonds do not break."""
        flat, count = new.reshape(len(new), -1), len(self._place)
        u, previous = m.reshape(len(m), -1)[:, self._place], flat[:, self._place]
        j, k, rest = self._search.pairs(m)
        numbers = [value.ravel()[self._place] for value in state.particle_values]
        of_particle = self._scene.constants.of_particle
        shared: tuple[Any, ...] = ()
        if shares_particles(self._evaluator.rule):
            shared = tuple(of_particle(*(value[rows] for value in numbers)) for rows in (j, k))
        to = Neighbour(vector(rest), self._none, shared=shared)
        d = vector(u[:, k] - u[:, j])
        parts = self._evaluator.contribution(d, vector(u[:, j]), to)
        total = tuple(_summed(part, j, count) for part in parts)
        arguments = Here(vector(u), self._at, self._centred, of_particle(*numbers))
        move = self._evaluator.move(total, arguments)
        movable = self._body[np.bincount(j, minlength=count)[self._body] > 0]
        place = self._place[movable]
        self._evaluator.renew_particles(total, arguments, numbers, None)
        for values, renewed in zip(state.particle_values, numbers, strict=True):
            values.reshape(-1)[place] = renewed[movable]
        flat[:, self._place[self._body]] = u[:, self._body]
        solver = self._scene.experiment.stepping
        for plane, here_, step, was in zip(flat, u, move, previous, strict=True):
            plane[place] = target(here_, step, was, solver)[movable]


def _summed(part: Any, owner: Indices, count: int) -> Any:
    """Return the sum over the pairs of each owner, in the order of the pairs."""
    if isinstance(part, Vector):
        return part.each(lambda values: _summed(values, owner, count))
    return np.bincount(owner, np.broadcast_to(part, owner.shape), count)


class MoveFollowers(Operation):
    """Move all particles of the body by the rule. Leaders and guided particles are moved too; other
    operations then correct their displacements."""

    makes_moves = True

    def __init__(self, scene: Scene, followers: Followers | None = None) -> None:
        super().__init__(scene)
        self._known = followers
        self._last_load: Floats | None = None
        self._loads: dict[str, Any] = {}

    @cached_property
    def _followers(self) -> Followers:
        nearness = self.scene.experiment.neighbours.nearness()
        return self._known or (GatheringFollowers if nearness else SlotFollowers)(self.scene)

    def apply(self, step: Step) -> None:
        """Move the particles from the intermediate configuration. Values that are not finite are
        not reported here, but when they are recorded."""
        quiet = np.errstate(all="ignore", invalid=step.invalid)
        with quiet, errors_attributed_to(self.scene.experiment.rule, f"at step {step.number}"):
            self._followers.move(step.u, step.new, step.state)

    def emit(self, kernel: KernelWriter) -> None:
        """Write a sweep over the particles for each rule. The sweep of the innermost rule is
        written first."""
        for level in range(self.sweeps() - 1):
            kernel.sweep(level)
            for frame in FollowFrame.of(self.scene):
                frame.emit_for(kernel, f"flat_z{level}")
        kernel.sweep(self.sweeps() - 1)

    def sweeps(self) -> int:
        """Return the number of rules, including inner rules."""
        return len(list(_levels(self.scene)))

    def reach(self, axis: int) -> Reach:
        """Return the largest distance of neighbours. If the rule has an inner rule, the result also
        contains the distances up to which the moves of the inner rule are computed before particles
        move."""
        reach = self.scene.neighbourhood.reach_in_cells[axis]
        if not self.scene.inner:
            return Reach(reach)
        far = reach + max(
            (each.reach(axis).apart for each in FollowFrame.of(self.scene)), default=0
        )
        return Reach(reach, far, far, reach, reach)

    def carries(self) -> Indices:
        """Return the differences between the cells of two neighbours, for all slots."""
        return np.array([slot.cell for slots in self.scene.neighbourhood.slots for slot in slots])

    def arrays(self, call: Call) -> dict[str, Any]:
        """Return the load on particles, axis by axis."""
        load = self._load(call)
        if load is not self._last_load:
            self._last_load = load
            self._loads = {} if load is None else {f"load_{c}": load[a] for a, c in self._axes}
        return self._loads

    @property
    def _axes(self) -> Iterator[tuple[int, str]]:
        return enumerate("xyz"[: self.scene.axes])

    def disturbances(self, call: Call) -> Iterator[Cells]:
        """Generate the cells of particles under a load."""
        load = self._load(call)
        if load is not None:
            yield np.nonzero((load != 0.0).any(axis=(0, 1)))

    def _load(self, call: Call) -> Floats | None:
        """Return the forces in the steps of a call."""
        loads = self.scene.loads
        return loads.at(call.step, call.state.u.dtype) if loads else None

    def next_change(self, step: int, precomputable: bool = False) -> float:
        """Return the next step in which a load or a parameter changes."""
        time_dependent = self.scene.experiment.time_dependent.values()
        changes = [number.next_change(step) for number in time_dependent]
        changes += [self.scene.loads.next_change(step)] if self.scene.loads else []
        return min(changes, default=math.inf)

    def events(self, steps: int) -> list[int]:
        """Return the steps in which loads begin and cease to act."""
        return self.scene.loads.changes(steps) if self.scene.loads else []

    def breakpoints(self, steps: int) -> list[int]:
        """Return the moments at which the slope changes of a time-dependent parameter or of a load
        that acts."""
        time_dependent = self.scene.experiment.time_dependent.values()
        spans = [(number, 0, steps) for number in time_dependent]
        for loading in self.scene.loads.each if self.scene.loads else ():
            load = loading.load
            spans += [(number, load.from_, load.last(steps)) for number in load.time_dependent]
        return [knot for number, *span in spans for knot in number.breakpoints_within(*span)]

    def hindrance(self, mode: Mode) -> Hindrance | None:
        """Return a reason if neighbours are re-evaluated, because lists of neighbours are computed
        on the host in every step. Also return a reason if parameters depend on time in a way that
        kernels do not support."""
        if self.scene.experiment.neighbours.nearness():
            changing = "parameters are time-dependent, and neighbours are re-evaluated"
            reasons = {
                Mode.RANKS: "neighbours that are re-evaluated",
                Mode.TIME_DEPENDENT: changing,
                Mode.TIME_DEPENDENT_SOLVER: changing,
            }
            return Hindrance(reasons.get(mode, "neighbours are re-evaluated"), "neighbours")
        if mode is Mode.GPU and any(each.constants.pairs for each in _levels(self.scene)):
            return Hindrance("the rule sums over pairs of neighbours", "rule")
        if mode is Mode.GPU and any(
            each.constants.choices or each.constants.tables for each in _levels(self.scene)
        ):
            return Hindrance("parameters of the rule are tables or chosen by name", "rule")
        if mode is Mode.PASSES and self.sweeps() > 2:
            return Hindrance("the rule applies another rule more than twice", "rule")
        if mode is Mode.RANKS_AT_REST and (self.scene.inner or not self._rule.linear):
            reason = "applies twice" if self._rule.linear else "is not linear"
            text = f"the equilibrium of rule '{self._rule.type}', which {reason}"
            return Hindrance(text, "rule")
        return self._hindrance_of_time_dependence() if mode is Mode.TIME_DEPENDENT else None

    def _hindrance_of_time_dependence(self) -> Hindrance | None:
        """Return a reason if time-dependent parameters are not the same for all particles, because
        kernels read them from arrays that have one value for all particles."""
        scene = self.scene
        time_dependent = scene.experiment.time_dependent
        fields = [field for field, _ in time_dependent if field != "solver"]
        if not fields:
            return None
        if scene.constants.by_particle or scene.constants.by_bond or _is_mixed(scene):
            reason = "some parameters vary in space and others in time"
            return Hindrance(reason, str(fields[0]))
        for moment in sorted(
            {knot for number in time_dependent.values() for knot in number.breakpoints}
        ):
            if _differ_in_kernels(scene, scene.at(moment)):
                reason = "constants of kernels are time-dependent"
                return Hindrance(reason, str(fields[0]))
        return None

    @property
    def _rule(self) -> FollowerRule:
        return self.scene.experiment.rule


def _is_mixed(scene: Scene) -> bool:
    return scene.cells is not None and bool(scene.cells.mixed)


def _levels(scene: Scene) -> Iterator[Scene]:
    """Generate the scene, then the scene of its inner rule, and so on to the innermost rule."""
    yield scene
    if scene.inner:
        yield from _levels(scene.inner)


def _differ_in_kernels(scene: Scene, changed: Scene) -> bool:
    """Return whether the change of parameters between two scenes changes constants that kernels
    contain as literals."""
    return any(
        (old.constants.weights, old.constants.fracture)
        != (new.constants.weights, new.constants.fracture)
        for old, new in zip(_levels(scene), _levels(changed), strict=False)
    )
