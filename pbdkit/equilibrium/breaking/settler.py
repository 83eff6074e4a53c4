"""Settles a scene whose bonds break, by a kernel of its own, one increment a call or some."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from pbdkit.equilibrium.breaking import band
from pbdkit.equilibrium.breaking.pattern import Pattern, pattern_at
from pbdkit.equilibrium.breaking.settling_kernel import GOES_ON, SETTLED, write_settling
from pbdkit.equilibrium.certificate import LINEAR
from pbdkit.equilibrium.moves import ROUNDING
from pbdkit.equilibrium.system_parts import SOFT
from pbdkit.experiment.solvers import Stepping
from pbdkit.registry.blame import blaming
from pbdkit.results.progress import Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.compiled.arguments import Arrays, constant_arrays, state_arrays
from pbdkit.stepping.compiled.levels import levels_of, load_blamed
from pbdkit.stepping.compiled.plan import Plan
from pbdkit.stepping.compiled.stretches import find_runs
from pbdkit.stepping.prescription import place, prescribe
from pbdkit.stepping.state import State, unmoved_state

FUNCTIONS = (band.refactor, band.correct, band.largest, band.norm)
MOST_CORRECTIONS = 8
LARGEST_BAND = 10_000_000
"""Numbers in a band: 80 MB."""
OPERATIONS_A_CALL = 100_000_000
"""In calls of so many, some tenths of a second, interruptions are heard."""


class Settler:
    """For linear rules, with all that the band needs. What it holds is decided by the bonds as
    they are, to the bit: it remembers nothing else from one increment to the next.

    Raises PluginError for parts that do not compile.
    """

    def __init__(self, scene: Scene, tolerance: float, watch: Watch) -> None:
        solver = scene.experiment.solver.sought
        self._scene, self._watch, self._tolerance = scene, watch, tolerance
        self._share = solver.tolerance
        stepping = Stepping(relaxation=scene.experiment.stepping.relaxation, threads=1)
        stepped = replace(
            scene, experiment=scene.experiment.model_copy(update={"solver": stepping})
        )
        levels = levels_of(stepped)
        self._plan = plan = Plan(stepped, levels, False, apart=True)
        self._runs, starts, groups = find_runs(stepped, all_general=True)
        self._body = [
            [s, span[0, 0], span[-1, 1]] for (s, _), span in zip(groups, starts, strict=True)
        ]
        size = np.array(scene.raster.shape[1:])
        box = np.stack([np.zeros_like(size), size], axis=1).ravel().astype(np.int64)
        self._constant = constant_arrays(plan) | {"box": box}
        if plan.tears:  # every follower is taken as torn, and marks are written but not read
            self._constant["torn"] = np.zeros(scene.raster.shape, np.uint8)
        self._roles: tuple[bool, ...] = ()
        self._of_roles: Arrays = {}
        self._work = 1
        start = unmoved_state(scene, scene.raster.shape[1:])
        self._take_roles(scene.experiment.steps, start)
        shared = ("step", *self._named(start))
        source, self._names = write_settling(replace(plan, shared=shared))
        functions = {function.__name__: function for function in FUNCTIONS}
        self._run = load_blamed(levels, source, self._given(start, 0.0, 0), functions)

    @property
    def is_small(self) -> bool:
        """Whether a band serves a body of this size and shape."""
        return bool(self._of_roles["band"].size <= LARGEST_BAND)

    def settle(self, state: State, moment: float, most: int) -> tuple[bool, int]:
        """Goes on, in place, from an equilibrium to that of a moment, until no bond changes any
        more, `most` times at most. Returns whether that is so, and how often bonds have changed;
        where the band does not serve the state is as the last settling left it.

        Raises ExperimentError for contradicting leaders, and StoppedError.
        """
        led, state.starts = prescribe(self._scene, state, moment)
        place(state.u, led)
        self._take_roles(math.ceil(moment), state)
        changes, became = 0, GOES_ON
        while became == GOES_ON and changes < most:
            self._watch.begin("settling and breaking")
            a_call = max(1, min(most - changes, OPERATIONS_A_CALL // self._work))
            with blaming(self._scene.experiment.rule, f"at step {moment:.6g}"):
                more, became = self._run(*self._given(state, moment, a_call))
            changes += more
        state.step = math.floor(moment)
        state.previous[...] = state.u
        return became == SETTLED, changes

    def _take_roles(self, step: int, state: State) -> None:
        """Makes ready for the roles of a step, where they are others."""
        roles = tuple(leading.group.leads(step) for leading in self._scene.leading)
        if self._of_roles and roles == self._roles:
            return
        pattern = pattern_at(self._scene, step)
        reach, axes, count = pattern.reach, self._scene.axes, len(pattern.place)
        most = count * axes * (2 * ((reach + 1) * axes - 1) + 1)
        self._work = 1 + most * (reach + 1) * axes
        self._roles, self._of_roles = roles, self._arrays_of(pattern, most)
        # Unlike any bond's, so that all rows are found anew.
        known = {"known_broken": np.full_like(state.broken_step, -2)}
        known |= {f"known{n}": value.copy() for n, value in enumerate(state.bond_values)}
        self._of_roles |= known

    def _arrays_of(self, pattern: Pattern, most: int) -> Arrays:
        """By name what the kernel holds as long as the roles stay."""
        raster, axes, count = self._scene.raster, self._scene.axes, len(pattern.place)
        s, *cells = np.unravel_index(pattern.place, raster.shape)
        alone = np.stack([cells[0], cells[0] + 1, cells[1], cells[1] + 1], axis=1)
        equation = np.full(raster.kind.size, -1)
        equation[pattern.place] = np.arange(count)
        slots = max(map(len, self._scene.neighbourhood.slots)) + 1
        facts = [0.0, 0.0, 1.0, pattern.reach, SOFT, ROUNDING, LINEAR]
        planes = [f"{name}_{c}" for name in ("v", "still") for c in self._plan.axes]
        signs = np.random.default_rng(0).choice([-1.0, 1.0], count * axes)
        return {
            # First a run of each follower by itself.
            "runs": np.concatenate([alone, self._runs]).astype(np.int64),
            "body": np.array(self._body, np.int64) + np.array([0, count, count]),
            "place": pattern.place,
            "sublattice": s.astype(np.int64),
            "equation": equation.astype(np.int64),
            "first_entry": pattern.first.astype(np.int64),
            "entry_slot": pattern.slot.astype(np.int64),
            "entry_column": pattern.column.astype(np.int64),
            "entry_weight": pattern.weight,
            "alike": np.array([pattern.alike]),
            "stale": np.ones(count, np.uint8),
            "blocks": np.zeros((count, slots, axes, axes)),
            "band": np.empty(most),
            "diagonal": np.zeros(count * axes),
            "inverse": np.zeros(count * axes),
            "randoms": signs,
            "facts": np.array(facts, float),
            "corrections": np.array([MOST_CORRECTIONS + 1]),
            **{name: np.zeros((count, axes)) for name in ("residual", "correction", "kept")},
            **{name: np.zeros(raster.shape) for name in planes},
        }

    def _named(self, state: State) -> Arrays:
        """The arrays of the kernel by name."""
        nobody = np.zeros_like(state.u)
        return self._constant | state_arrays(self._plan, state.u, nobody, state) | self._of_roles

    def _given(self, state: State, moment: float, most: int) -> tuple[Any, ...]:
        arrays = self._named(state)
        given = tuple(arrays[name] for name in self._names)
        return given, math.ceil(moment), self._tolerance, self._share, most
