"""Compiled engine. One call makes many steps, on the part of the lattice that motion has reached.

If the rule's moves are exactly zero in the reference configuration, a step can only move particles
that bear a load or have a neighbour that has moved. If the scene guarantees this in advance (see
`_rests_by_construction`), the box of moved particles is empty at the beginning. Otherwise the first
step computes every particle and detects those that are not at rest. The box includes the leaders.
In each step it grows by the reach of a bond times the number of nested rules. If state variables
change, all particles are computed in every step.

If neighbours are re-evaluated, the kernel is a sweep over the list of neighbours.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats
from pbdkit.plugin import RenewsBonds, RenewsParticles, StartsCracked
from pbdkit.plugin.discovery import errors_attributed_to
from pbdkit.plugin.vector import vector
from pbdkit.scene.constants import bond_numbers, particle_numbers
from pbdkit.scene.scene import Scene
from pbdkit.stepping.followers import Followers, MoveFollowers
from pbdkit.stepping.kernel import Function
from pbdkit.stepping.neighbour_search import NeighbourSearch
from pbdkit.stepping.numba_engine import sweeps
from pbdkit.stepping.numba_engine.arrays import (
    Arrays,
    bits_for,
    call_arrays,
    changing_arrays,
    constant_arrays,
    find_runs,
    lost_bits,
    renew_lost_bits,
    rule_arrays,
    state_arrays,
)
from pbdkit.stepping.numba_engine.emitter import write_kernel, write_module, write_pass
from pbdkit.stepping.numba_engine.plan import (
    Level,
    Plan,
    goes_deep,
    levels_of,
    load_plugin_kernel,
    pass_arrays,
)
from pbdkit.stepping.numpy_engine import Engine, Stepper
from pbdkit.stepping.program import Program, precompute_steps, prepare, program_of
from pbdkit.stepping.rule_evaluation import Evaluator, presence
from pbdkit.stepping.state import State, unmoved_state
from pbdkit.stepping.step import Call, Cells


class PairFollowers(Followers):
    """Followers of a scene with re-evaluated neighbours, moved by a kernel."""

    def __init__(self, scene: Scene, threads: int) -> None:
        self._search = search = NeighbourSearch(scene)
        self._chunks = 4 * threads
        self._plan = Plan(scene, levels_of(scene), threads > 1)
        self._arrays = rule_arrays(self._plan) | {
            "place": search.place,
            "body": search.body,
            "local": search.X,
        }
        start, none = unmoved_state(scene, (1,) * scene.axes), np.zeros(0, np.intp)
        pairs = {"first_pair": none, "partner": none, "rests": np.zeros((scene.axes, 0))}
        arrays = self._named(start.u, start.previous, start, **pairs)
        source, self._names = _write_kernel(replace(self._plan, shared=tuple(arrays)))
        arguments = tuple(arrays[name] for name in self._names), 0, 0, self._chunks
        self._run = load_plugin_kernel(self._plan.levels, source, arguments)

    def move(self, m: Floats, new: Floats, state: State) -> None:
        """Move the particles. Neighbours are summed in the same order as by the numpy engine."""
        j, other, rest = self._search.pairs(m)
        first = np.searchsorted(j, np.append(self._search.body, len(self._search.place)))
        rest = np.ascontiguousarray(rest)
        arrays = self._named(m, new, state, first_pair=first, partner=other, rests=rest)
        arguments = tuple(arrays[name] for name in self._names)
        self._run(arguments, 0, len(self._search.body), self._chunks)

    def _named(self, m: Floats, new: Floats, state: State, **pairs: Any) -> Arrays:
        """Return the arrays of the kernel by name. `first_pair` has an entry for each particle of
        the body, `partner` and `rests` for each pair of neighbours, and `place` and `local` for
        each row of the table of particles."""
        was = {f"was{n}": state.particle_values[n].copy() for n in self._plan.copied_values}
        return self._arrays | state_arrays(self._plan, m, new, state) | was | pairs


def _write_kernel(plan: Plan) -> tuple[str, list[str]]:
    """Return a module with ``run(arrays, first, last, chunks)`` for the particles of the body from
    `first` to `last`, and the names of the arrays."""
    (level,) = plan.levels
    sweep = Function(plan.shared, "sweep", "first_body", "last_body")
    sweep.add(0, *sweeps.parameters(plan, level), *plan.each("o@ = flat_v_@"))
    sweep.add(0, *(f"a{n} = w{n} = flat_own{n}" for n in range(len(level.seen.own))))
    sweep.add(0, "for e in range(first_body, last_body):")
    sweep.add(1, "row = body[e]", "j = place[row]", f"u = {plan.vector('flat_u_@[j]')}")
    sweep.add(1, *(f"{t} = double(0.0)" for t in level.totals))
    sweep.add(1, "for n in range(first_pair[e], first_pair[e + 1]):")
    sweep.add(2, "there = place[partner[n]]", sweeps.difference(plan, level, "flat_u_@[there]"))
    partner_numbers = [f"flat_{array}[there]" for array in plan.shown]
    sweep.add(2, f"r = {plan.vector('rests[#, n]')}")
    sweep.add(2, sweeps.contributions(plan, level, "r", "", partner_numbers))
    sweep.add(2, *(f"{t} = {t} + c{n}" for n, t in enumerate(level.totals)))
    sweep.add(1, "moves = first_pair[e + 1] > first_pair[e]")
    sweep.add(
        1, *sweeps.target_lines(plan, level, plan.each("local[#, row]"), level.totals, "moves")
    )
    run = Function(plan.shared, "run", "arrays", "first_body", "last_body", "chunks")
    write_pass(run, plan, 0, sweep, "first_body", "last_body")
    return write_module(plan, [sweep], run)


Box = NDArray[np.int64]
"""Type of ranges of repeat cells, (first, last + 1) along each axis, one after the other."""


class MotionExtent:
    """Part of the lattice that motion has reached.

    Attributes
    ----------
    box
        Range of cells that have been reached, as `Box`.
    growth
        Change of the bounds of the box in a step, (2 · axes,).
    """

    def __init__(self, levels: Sequence[Level], program: Program) -> None:
        scene = levels[-1].scene
        experiment, shape = scene.experiment, scene.raster.shape
        self._program = program
        self._whole = _interleaved(np.zeros(scene.axes), np.array(shape[1:]))
        self._renews = isinstance(experiment.rule, RenewsParticles) or (
            scene.has_fracture and isinstance(experiment.fracture, RenewsBonds)
        )
        # A body that is at rest with the current parameters may move when they change.
        self._renews |= any(field != "solver" for field, _ in experiment.time_dependent)
        self._rests = not self._renews and _rests_by_construction(levels)
        self._bond = len(levels) * _growth(program)
        fixed = np.concatenate([operation.fixed_places() for operation in program])
        self._fixed = np.unravel_index(fixed, shape)[1:]
        self._is_known = False
        self._reset(self._whole)

    def begin(self, state: State) -> None:
        """Start from a state that this engine has not computed: the box is the whole lattice unless
        the body is at rest."""
        self._is_known = self._rests and state.step == 0 and not state.u.any()
        self._reset(np.zeros_like(self._bond) if self._is_known else self._whole)

    def take_in_call(self, call: Call, count: int) -> int:
        """Extend the box by the particles at rest that operations move in a call. Return how many
        of the `count` steps the call can make."""
        if not self._is_known:
            return count if self._renews else 1
        for operation in self._program:
            for cells in operation.disturbances(call):
                self._join(cells)
        return count

    def take_in_rows(self, state: State, rows: slice) -> None:
        """Extend the box by the moved particles in `rows`, which are rows of cells that other ranks
        have written."""
        if self._is_known:
            moves = (u[:, :, rows] != 0.0 for u in (state.u, state.previous))
            first, *cells = np.nonzero(np.logical_or(*moves).any(axis=(0, 1)))
            self._join((first + rows.start, *cells))

    def take_in_moves(self, after: Floats, before: Floats) -> None:
        """Extend the box by the particles that the first step has moved."""
        if self._is_known:
            np.clip(self.box, 0, self._whole.max(), out=self.box)
        elif not self._renews:
            self._is_known = True
            moved = (after != 0.0).any(axis=(0, 1)) | (before != 0.0).any(axis=(0, 1))
            moved[self._fixed] = True
            self._reset(np.zeros_like(self._bond))
            self._join(np.nonzero(moved))

    def _reset(self, box: Box) -> None:
        self.box, self.growth = box.copy(), np.zeros_like(box)

    def _join(self, cells: Cells) -> None:
        """Extend the box by cells that have moved."""
        if not len(cells[0]):
            return
        box = _interleaved([n.min() for n in cells], [n.max() + 1 for n in cells])
        if not self.box.any():  # The box is empty.
            self.box, self.growth = box, self._bond
        self.box[::2] = np.minimum(self.box[::2], box[::2])
        self.box[1::2] = np.maximum(self.box[1::2], box[1::2])


def _rests_by_construction(levels: Sequence[Level]) -> bool:
    """Return whether the reference configuration is certainly an equilibrium. This requires that
    every neighbour is present and all initial displacements are zero, that no bond is broken or
    breaks at rest, and that the moves of the rules at rest are zero. Neither particles nor bonds
    may have state variables."""
    scene = levels[-1].scene
    experiment, raster, fracture = scene.experiment, scene.raster, scene.experiment.fracture
    cracked = (isinstance(fracture, StartsCracked) and fracture.segments()) or experiment.cuts
    fields = scene.constants.by_particle or scene.constants.by_bond
    remembered = particle_numbers(experiment) or bond_numbers(experiment) or fields
    if not experiment.initial.at_rest or experiment.rule.uses_reference or cracked or remembered:
        return False
    for s, slots in enumerate(scene.neighbourhood.slots):
        block = raster.body_block(s)
        if block and any(present is not None for present in presence(raster, block, slots)):
            return False
    return all(_stays(level.scene) for level in levels)


def _stays(scene: Scene) -> bool:
    """Return whether, at rest, a particle with all its neighbours does not move and no bond
    breaks."""
    experiment, evaluator = scene.experiment, Evaluator(scene)
    still, slots = vector(np.zeros(scene.axes)), scene.neighbourhood.slots
    with errors_attributed_to(experiment.rule, "to move at rest"):
        if any(component != 0.0 for each in slots for component in evaluator.at_rest(each)):
            return False
    if not scene.has_fracture:
        return True
    with errors_attributed_to(experiment.fracture, "to test bonds at rest"):
        limits = scene.constants.limits
        return not any(evaluator.breaks(still, k.rest, limits[k], ()) for k in chain(*slots))


def _interleaved(low: Any, high: Any) -> Box:
    return np.stack([low, high], axis=1).astype(np.int64).ravel()


def _growth(program: Program) -> Box:
    """Return by how many cells one step extends the box, along each direction."""
    steps = np.concatenate([operation.carries() for operation in program])
    return _interleaved(np.minimum(steps.min(axis=0), 0), np.maximum(steps.max(axis=0), 0))


BAND = 16384
"""Number of places in a band. Bonds are updated in one band and then the sweep moves the particles
of the band, so that the data stay in the cache. On several threads, bands are larger, because
starting threads takes time."""


class CompiledStepper(Engine):
    """Engine that steps a scene with its own kernel.

    Broken bonds are stored in bit masks of the particles. The masks are recomputed for states that
    were not computed by this engine. All other arrays are the same as in the numpy engine. If
    neighbours are re-evaluated, the kernel is a sweep over the list of neighbours.
    """

    name = "compiled"

    def __init__(self, scene: Scene, threads: int = 1) -> None:
        self.threads = min(threads, int(vars(numba.config)["NUMBA_NUM_THREADS"]))
        self._scene = scene
        self._pairs: Stepper | None = None
        if scene.experiment.neighbours.nearness():
            self._pairs = Stepper(scene, MoveFollowers(scene, PairFollowers(scene, self.threads)))
            return
        self._program = program_of(scene)
        self._last: State | None = None
        self._numbered = scene
        """Scene with the values of the parameters that are in the arrays."""
        levels = levels_of(scene)
        self._extent = MotionExtent(levels, self._program)
        self._plan = plan = Plan(scene, levels, self.threads > 1)
        runs, starts, groups = find_runs(scene, plan.long)
        self._arrays = constant_arrays(plan) | {"runs": runs, "starts": starts}
        self._deep = goes_deep(plan)
        """True if several steps may be made in a pass."""
        self._arrays |= pass_arrays(plan, self.threads) if self._deep else {}
        start = unmoved_state(scene, (1,) * scene.axes)
        inner = [name for n in range(len(levels) - 1) for name in plan.each(f"z{n}_@")]
        self._moves = np.zeros((len(inner), *scene.raster.shape), start.u.dtype)
        self._arrays |= dict(zip(inner, self._moves, strict=True))
        remembered = start.particle_values
        self._arrays |= {
            f"was{m}": np.zeros(scene.raster.shape, remembered[m].dtype) for m in plan.copied_values
        }
        if plan.judged:
            self._arrays["lost"] = np.zeros(start.u.shape[1:], bits_for(scene))
        if plan.tears:
            self._arrays["torn"] = np.zeros(start.u.shape[1:], np.uint8)
        shared = (*plan.shared, *self._named(Call(start)))
        plan = replace(plan, shared=shared)
        source, self._names = write_kernel(plan, self._program, groups)
        # A call without steps compiles the kernel, so that errors of the compiler occur here.
        self._run = load_plugin_kernel(levels, source, self._arguments(Call(start), 0))

    def advance(self, state: State, steps: int = 1) -> State:
        """Return the state after `steps` steps, in as few calls as the operations permit."""
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
        """Update the bit masks of broken bonds, the marks of damage and the box of motion."""
        if self._pairs is None and state is self._last:
            if self._plan.judged:
                renew_lost_bits(self._arrays["lost"], self._scene, state, rows)
            if self._plan.tears:
                sweeps.renew_torn_marks(self._arrays["torn"], self._scene, state, rows)
            self._extent.take_in_rows(state, rows)

    def _begin(self, state: State) -> None:
        self._moves[...] = 0.0
        if self._plan.judged:
            self._arrays["lost"] = lost_bits(self._scene, state)
        if self._plan.tears:
            self._arrays["torn"] = sweeps.torn_marks(self._scene, state)
        self._extent.begin(state)

    def _some_steps(self, state: State, end: int) -> State:
        self._renumber(self._scene.at(state.step + 1))
        call = prepare(self._program, state)
        if call.has_cuts:
            self._begin(state)
        count = precompute_steps(self._program, call, end)
        count = self._extent.take_in_call(call, count)
        with errors_attributed_to(self._scene.experiment.rule, f"at step {call.step}"):
            self._run(*self._arguments(call, count))
        u, new = state.u, state.previous
        final, previous = (new, u) if count % 2 else (u, new)
        self._extent.take_in_moves(final, previous)
        return replace(
            state,
            step=state.step + count,
            u=final,
            previous=previous,
            starts=call.starts or state.starts,
        )

    def _renumber(self, scene: Scene) -> None:
        if scene is not self._numbered:
            self._arrays |= changing_arrays(self._plan.renumbered(scene))
            self._numbered = scene

    def _named(self, call: Call) -> Arrays:
        """Return by name the arrays of a kernel. Steps are written into the arrays of the state."""
        state = call.state
        return {
            **self._arrays,
            **state_arrays(self._plan, state.u, state.previous, state),
            **call_arrays(self._plan, self._program, call, by_rows=self._deep),
            "box": self._extent.box,
            "growth": self._extent.growth,
        }

    def _arguments(self, call: Call, count: int) -> tuple[Any, ...]:
        """Return the arguments of the kernel that makes `count` steps."""
        if self.threads > 1:
            numba.set_num_threads(self.threads)
        named = self._named(call)
        arrays = tuple(named[name] for name in self._names)
        chunks, row = 4 * self.threads, math.prod(self._scene.raster.shape[2:])
        return arrays, call.state.step, count, chunks, max(1, BAND * self.threads**2 // row)
