"""The compiled engine: whole intervals of steps in one call, on what the motion has reached.

At rest a rule moves nothing, exactly; so a step can only move particles that bear a load or adjoin
one that has moved. Where that is plain from the scene nothing has moved before the leaders do;
elsewhere the first step looks at every particle and finds those that are not at rest. From then on
the box around what has moved, and around leaders that are not at home, grows by one bond a step,
and by as many as rules work on each other's moves. Where something is remembered that changes,
everything is looked at in every step.

Where neighbours are found anew at every step, the kernel is a sweep over their list.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats
from pbdkit.lattice.raster import FOLLOWER
from pbdkit.plugin import RenewsBonds, RenewsParticles, StartsCracked
from pbdkit.plugin.discovery import blaming
from pbdkit.plugin.vector import vector
from pbdkit.scene.constants import bond_numbers, particle_numbers
from pbdkit.scene.scene import Scene
from pbdkit.stepping.contact import Contact
from pbdkit.stepping.followers import Followers, GatheringFollowers, MoveFollowers
from pbdkit.stepping.kernel import Function
from pbdkit.stepping.leaders import Clamps, Guidance, NewtonForces, prescribe, steady_steps
from pbdkit.stepping.numba_engine.arrays import (
    Arrays,
    bits_for,
    changing_arrays,
    constant_arrays,
    find_runs,
    lost_bits,
    renew_lost_bits,
    rule_arrays,
    state_arrays,
)
from pbdkit.stepping.numba_engine.boundary import foreseen, leading_arrays, wall_arrays
from pbdkit.stepping.numba_engine.emitter import write_kernel, write_module, write_pass
from pbdkit.stepping.numba_engine.plan import (
    Level,
    Plan,
    banded,
    goes_deep,
    levels_of,
    load_blamed,
    pass_arrays,
)
from pbdkit.stepping.numba_engine.sweeps import (
    contributions,
    difference,
    parameters,
    renew_torn_marks,
    target_lines,
    torn_marks,
)
from pbdkit.stepping.numpy_engine import Engine, Stepper
from pbdkit.stepping.particle_operation import OperateOnParticles
from pbdkit.stepping.program import program_of
from pbdkit.stepping.rule_evaluation import Evaluator, presence
from pbdkit.stepping.state import State, cut_bonds, unmoved_state
from pbdkit.stepping.step import Led


class PairFollowers(Followers):
    """Moves the followers of a scene in which neighbours come and go."""

    def __init__(self, scene: Scene, threads: int) -> None:
        self._finder = finder = GatheringFollowers(scene)
        self._chunks = 4 * threads
        self._plan = Plan(scene, levels_of(scene), threads > 1)
        self._arrays = rule_arrays(self._plan) | {
            "place": finder.place,
            "body": finder.body,
            "local": finder.X,
        }
        start, none = unmoved_state(scene, (1,) * scene.axes), np.zeros(0, np.intp)
        pairs = {"first_pair": none, "partner": none, "rests": np.zeros((scene.axes, 0))}
        arrays = self._named(start.u, start.previous, start, **pairs)
        source, self._names = _write_kernel(replace(self._plan, shared=tuple(arrays)))
        arguments = tuple(arrays[name] for name in self._names), 0, 0, self._chunks
        self._run = load_blamed(self._plan.levels, source, arguments)

    def move(self, m: Floats, new: Floats, state: State) -> None:
        """Neighbours in the order in which the numpy engine sums them."""
        j, other, rest = self._finder.pairs(m)
        first = np.searchsorted(j, np.append(self._finder.body, len(self._finder.place)))
        rest = np.ascontiguousarray(rest)
        arrays = self._named(m, new, state, first_pair=first, partner=other, rests=rest)
        given = tuple(arrays[name] for name in self._names)
        self._run(given, 0, len(self._finder.body), self._chunks)

    def _named(self, m: Floats, new: Floats, state: State, **pairs: Any) -> Arrays:
        """By name the arrays of the kernel: `first_pair` is by particle of the body, `partner` and
        `rests` by pair, `place` and `local` by row of the table."""
        was = {f"was{n}": state.particle_values[n].copy() for n in self._plan.kept}
        return self._arrays | state_arrays(self._plan, m, new, state) | was | pairs


def _write_kernel(plan: Plan) -> tuple[str, list[str]]:
    """A module with ``run(given, first, last, chunks)`` for the particles of the body from `first`
    to `last`, and the names of the arrays that it is given."""
    (level,) = plan.levels
    sweep = Function(plan.shared, "sweep", "first_body", "last_body")
    sweep.add(0, *parameters(plan, level), *plan.each("o@ = flat_v_@"))
    sweep.add(0, *(f"a{n} = w{n} = flat_own{n}" for n in range(len(level.seen.own))))
    sweep.add(0, "for e in range(first_body, last_body):")
    sweep.add(1, "row = body[e]", "j = place[row]", f"u = {plan.vector('flat_u_@[j]')}")
    sweep.add(1, *(f"{t} = double(0.0)" for t in level.totals))
    sweep.add(1, "for n in range(first_pair[e], first_pair[e + 1]):")
    sweep.add(2, "there = place[partner[n]]", difference(plan, level, "flat_u_@[there]"))
    shown = [f"flat_{array}[there]" for array in plan.shown]
    sweep.add(2, f"r = {plan.vector('rests[#, n]')}")
    sweep.add(2, contributions(plan, level, "r", "", shown))
    sweep.add(2, *(f"{t} = {t} + c{n}" for n, t in enumerate(level.totals)))
    sweep.add(1, "moves = first_pair[e + 1] > first_pair[e]")
    sweep.add(1, *target_lines(plan, level, plan.each("local[#, row]"), level.totals, "moves"))
    run = Function(plan.shared, "run", "given", "first_body", "last_body", "chunks")
    write_pass(run, plan, 0, sweep, "first_body", "last_body")
    return write_module(plan, [sweep], run)


Box = NDArray[np.int64]
"""(first, last + 1) of repeat cells along each axis, one after the other."""


class Reach:
    """`box` is what has been reached, `growth` how it grows in a step, (2 axes,)."""

    def __init__(self, levels: Sequence[Level]) -> None:
        scene = levels[-1].scene
        experiment, self._shape = scene.experiment, scene.raster.shape
        self._everything = _interleaved(np.zeros(scene.axes), np.array(self._shape[1:]))
        self._renews = isinstance(experiment.rule, RenewsParticles) or (
            scene.has_fracture and isinstance(experiment.fracture, RenewsBonds)
        )
        # What rests with some numbers may not with others.
        self._renews |= any(field != "solver" for field, _ in experiment.courses)
        self._rests = not self._renews and _rests_by_construction(levels)
        self._bond = len(levels) * _growth(scene)
        self._leaders = [np.unravel_index(led.place, self._shape)[1:] for led in scene.leading]
        self._known = False
        self._keep_to(self._everything)

    def begin(self, state: State) -> None:
        """A state that did not come from here: what has moved is known only where nothing has."""
        self._known = self._rests and state.step == 0 and not state.u.any()
        self._keep_to(np.zeros_like(self._bond) if self._known else self._everything)

    def before(self, led: Led, load: Floats | None, count: int) -> int:
        """Takes the leaders and the load of the coming steps in; returns how many of `count` can be
        made in one go."""
        if not self._known:
            return count if self._renews else 1
        for place, values, _ in led:
            self._join(np.unravel_index(place[(values != 0.0).any(axis=0)], self._shape)[1:])
        if load is not None:
            self._join(np.nonzero((load != 0.0).any(axis=(0, 1))))
        return count

    def take_in(self, state: State, rows: slice) -> None:
        """Takes in what has moved in some rows of cells that somebody else has written."""
        if self._known:
            some = (u[:, :, rows] != 0.0 for u in (state.u, state.previous))
            first, *cells = np.nonzero(np.logical_or(*some).any(axis=(0, 1)))
            self._join((first + rows.start, *cells))

    def touch(self, touched: Iterable[tuple[NDArray[np.intp], ...]]) -> None:
        """Takes in the cells that obstacles push from where they rest."""
        for cells in touched if self._known else ():
            self._join(cells)

    def after(self, now: Floats, before: Floats) -> None:
        """Looks once at what the first step has moved."""
        if self._known:
            np.clip(self.box, 0, self._everything.max(), out=self.box)
        elif not self._renews:
            self._known = True
            moved = (now != 0.0).any(axis=(0, 1)) | (before != 0.0).any(axis=(0, 1))
            for cells in self._leaders:  # who is held where it would not rest moves once released
                moved[cells] = True
            self._keep_to(np.zeros_like(self._bond))
            self._join(np.nonzero(moved))

    def _keep_to(self, box: Box) -> None:
        self.box, self.growth = box.copy(), np.zeros_like(box)

    def _join(self, cells: tuple[NDArray[np.intp], ...]) -> None:
        """Takes in cells that have moved."""
        if not len(cells[0]):
            return
        box = _interleaved([n.min() for n in cells], [n.max() + 1 for n in cells])
        if not self.box.any():  # nothing has been reached yet
            self.box, self.growth = box, self._bond
        self.box[::2] = np.minimum(self.box[::2], box[::2])
        self.box[1::2] = np.maximum(self.box[1::2], box[1::2])


def _rests_by_construction(levels: Sequence[Level]) -> bool:
    """Whether the reference configuration stays as it is: every neighbour is there, all start at
    rest, no bond is broken or breaks at rest, and the rules' moves from there are zero. Where
    particles or bonds have numbers of their own it is looked at instead."""
    scene = levels[-1].scene
    experiment, raster, fracture = scene.experiment, scene.raster, scene.experiment.fracture
    cracked = (isinstance(fracture, StartsCracked) and fracture.segments()) or experiment.cuts
    fields = scene.constants.by_particle or scene.constants.by_bond
    remembered = particle_numbers(experiment) or bond_numbers(experiment) or fields
    if not experiment.initial.at_rest or experiment.rule.uses_reference or cracked or remembered:
        return False
    for s, slots in enumerate(scene.neighbourhood.slots):
        block = raster.body_block(s)
        if block and any(there is not None for there in presence(raster, block, slots)):
            return False
    return all(_stays(level.scene) for level in levels)


def _stays(scene: Scene) -> bool:
    """Whether a particle with all its neighbours moves nowhere at rest, and no bond breaks."""
    experiment, evaluator = scene.experiment, Evaluator(scene)
    still, slots = vector(np.zeros(scene.axes)), scene.neighbourhood.slots
    with blaming(experiment.rule, "to move at rest"):
        if any(component != 0.0 for own in slots for component in evaluator.at_rest(own)):
            return False
    if not scene.has_fracture:
        return True
    with blaming(experiment.fracture, "to test bonds at rest"):
        limits = scene.constants.limits
        return not any(evaluator.breaks(still, k.rest, limits[k], ()) for k in chain(*slots))


def _interleaved(low: Any, high: Any) -> Box:
    return np.stack([low, high], axis=1).astype(np.int64).ravel()


def _growth(scene: Scene) -> Box:
    """How far, in cells, a step of a rule carries a motion along each direction: by a bond, or
    by a frame point that follows one particle and is a neighbour of another."""
    slots = list(chain(*scene.neighbourhood.slots))
    carried = [np.array([slot.cell for slot in slots])]
    if scene.frame:
        kinds = scene.raster.kind
        places = scene.frame.place[scene.frame.map.point], scene.frame.body_place
        at, body = (np.stack(np.unravel_index(p, kinds.shape)[1:], axis=1) for p in places)
        for slot in slots:
            # The particle at `seeing` sees the frame point through this slot.
            seeing = at - slot.cell
            inside = ((seeing >= 0) & (seeing < kinds.shape[1:])).all(axis=1)
            follows = kinds[(slot.source, *seeing[inside].T)] == FOLLOWER
            carried.append((seeing - body)[inside][follows])
    most = np.concatenate(carried)
    return _interleaved(np.minimum(most.min(axis=0), 0), np.maximum(most.max(axis=0), 0))


BAND = 16384
"""Places that bonds are judged on before they are swept, on one thread: what they take stays in the
cache. On more threads starting them counts too."""


class CompiledStepper(Engine):
    """Steps a scene with a kernel made for it.

    Lost bonds are one bit a bond and end, made anew from a state that did not come from here; all
    else of the state is the same arrays that the numpy engine uses. Where neighbours are found anew
    at every step, the kernel sweeps over their list.
    """

    name = "compiled"

    def __init__(self, scene: Scene, threads: int = 1) -> None:
        self.threads = min(threads, int(vars(numba.config)["NUMBA_NUM_THREADS"]))
        self._scene = scene
        self._pairs: Stepper | None = None
        if scene.experiment.neighbours.nearness():
            self._pairs = Stepper(scene, MoveFollowers(scene, PairFollowers(scene, self.threads)))
            return
        self._last: State | None = None
        self._numbered = scene
        """With the numbers that the arrays hold."""
        self._guidance, self._newton = Guidance(scene), NewtonForces(scene)
        self._contact = contact = Contact(scene) if scene.barriers else None
        levels = levels_of(scene)
        self._reach = Reach(levels)
        self._plan = plan = Plan(scene, levels, self.threads > 1)
        runs, starts, groups = find_runs(scene, plan.long)
        self._arrays = constant_arrays(plan) | {"runs": runs, "starts": starts}
        self._deep = goes_deep(plan)
        """Whether several steps may go in a pass."""
        self._arrays |= pass_arrays(plan, self.threads) if self._deep else {}
        if contact and contact.compliance is not None:
            self._arrays["compliance"] = contact.compliance
        start = unmoved_state(scene, (1,) * scene.axes)
        inner = [name for n in range(len(levels) - 1) for name in plan.each(f"z{n}_@")]
        self._moves = np.zeros((len(inner), *scene.raster.shape), start.u.dtype)
        self._arrays |= dict(zip(inner, self._moves, strict=True))
        self._moved_at_rest = [
            np.unravel_index(operation.moved_at_rest, scene.raster.shape)[1:]
            for operation in OperateOnParticles.of(scene)
        ]
        self._clamps, self._clamped = Clamps(scene), np.zeros(0, np.intp)
        own = start.particle_values
        self._arrays |= {f"was{m}": np.zeros(scene.raster.shape, own[m].dtype) for m in plan.kept}
        if plan.judged:
            self._arrays["lost"] = np.zeros(start.u.shape[1:], bits_for(scene))
        if plan.tears:
            self._arrays["torn"] = np.zeros(start.u.shape[1:], np.uint8)
        shared = (*plan.shared, *self._named(start, [[]]))
        plan = replace(plan, shared=shared)
        source, self._names = write_kernel(plan, program_of(scene), groups)
        # No step is made, so that what does not compile is known before the first.
        self._run = load_blamed(levels, source, self._given(start, [[]], 0))

    def advance(self, state: State, steps: int = 1) -> State:
        """As many steps a call as the leaders stay where they are."""
        if self._pairs:
            return self._pairs.advance(state, steps)
        if state is not self._last:
            self._begin(state)
        end = state.step + steps
        while state.step < end:
            state = self._some_steps(state, end)
        self._last = state
        return state

    def renewed(self, state: State, rows: slice) -> None:
        """Lost bonds are bits here, and what has moved is in a box."""
        if self._pairs is None and state is self._last:
            if self._plan.judged:
                renew_lost_bits(self._arrays["lost"], self._scene, state, rows)
            if self._plan.tears:
                renew_torn_marks(self._arrays["torn"], self._scene, state, rows)
            self._reach.take_in(state, rows)

    def _begin(self, state: State) -> None:
        self._moves[...] = 0.0
        if self._plan.judged:
            self._arrays["lost"] = lost_bits(self._scene, state)
        if self._plan.tears:
            self._arrays["torn"] = torn_marks(self._scene, state)
        self._reach.begin(state)

    def _some_steps(self, state: State, end: int) -> State:
        step = state.step + 1
        if cut_bonds(self._scene, state.broken_step, step):
            self._begin(state)
        self._renumber(self._scene.at(step))
        led, starts = prescribe(self._scene, state, step, self._newton)
        self._clamped = self._clamps.turn(state, step)
        load = self._load(state)
        steady = steady_steps(self._scene, step, end - state.step)
        ways = [led]
        if steady == 1:
            begun = replace(state, starts=starts)
            ways += foreseen(self._scene, begun, led, end, self._clamps.turning)
        placed = [each for way in ways for each in way]
        if self._contact:
            for later in range(step, step + len(ways)):
                self._reach.touch(self._contact.touched_at_rest(later))
        self._reach.touch(self._moved_at_rest)
        count = self._reach.before(placed, load, max(steady, len(ways)))
        with blaming(self._scene.experiment.rule, f"at step {step}"):
            self._run(*self._given(state, ways, count))
        u, new = state.u, state.previous
        now, before = (new, u) if count % 2 else (u, new)
        self._reach.after(now, before)
        return replace(state, step=state.step + count, u=now, previous=before, starts=starts)

    def _renumber(self, scene: Scene) -> None:
        if scene is not self._numbered:
            self._arrays |= changing_arrays(self._plan.renumbered(scene))
            self._numbered = scene

    def _named(self, state: State, ways: list[Led]) -> Arrays:
        """The arrays of a kernel that steps in those of the state, by name."""
        slants = self._guidance.slants(state.step + 1) if ways[0] and self._guidance.slanted else {}
        leaders = leading_arrays(self._plan, ways, slants, state.u.dtype, self._deep)
        reached = {"box": self._reach.box, "growth": self._reach.growth}
        if self._plan.rotations:
            reached |= self._clamped_arrays()
        moved = state_arrays(self._plan, state.u, state.previous, state)
        load = self._load(state)
        loads = {} if load is None else dict(zip(self._plan.each("load_@"), load, strict=True))
        first = state.step + 1
        walls = wall_arrays(self._scene, range(first, first + len(ways)))
        if self._contact and (codes := self._contact.led(first)) is not None:
            walls["led_axes"] = codes
        return self._arrays | moved | leaders | reached | loads | walls

    def _clamped_arrays(self) -> Arrays:
        if not self._deep:
            return {"clamped": self._clamped}
        order, rows = banded(self._plan, "clamped", self._clamped)
        return {"clamped": self._clamped[order]} | rows

    def _load(self, state: State) -> Floats | None:
        """What acts in the step after a state."""
        loads = self._scene.loads
        return loads.at(state.step + 1, state.u.dtype) if loads else None

    def _given(self, state: State, ways: list[Led], count: int) -> tuple[Any, ...]:
        """The arguments of the kernel that makes `count` steps."""
        if self.threads > 1:
            numba.set_num_threads(self.threads)
        arrays = self._named(state, ways)
        given = tuple(arrays[name] for name in self._names)
        chunks, row = 4 * self.threads, math.prod(self._scene.raster.shape[2:])
        return given, state.step, count, chunks, max(1, BAND * self.threads**2 // row)
