"""The run at the end of a step, as the dataset and the diagnostics see it: a row a particle."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.experiment.leaders import Selection
from pbdkit.interfaces import Bonds, LeaderRows, Moment, Pair, Slot, Stiffness, Vector, length
from pbdkit.interfaces.frame import Indices
from pbdkit.interfaces.naming import did_you_mean
from pbdkit.interfaces.rule import material_of
from pbdkit.interfaces.vector import vector
from pbdkit.registry.blame import blaming
from pbdkit.results.gradient import displacement_gradient
from pbdkit.results.tables import Tables
from pbdkit.scene.leading import kinds_at, select
from pbdkit.scene.mesh import Patch
from pbdkit.scene.places import Block
from pbdkit.scene.raster import FOLLOWER
from pbdkit.scene.remembering import bond_numbers, particle_numbers
from pbdkit.stepping.evaluator import summed
from pbdkit.stepping.remembering import describe_bonds
from pbdkit.stepping.state import Floats, State


class StateMoment(Moment):
    """A state as a table; bonds that broke later than asked for count as they were before."""

    def __init__(self, state: State, tables: Tables, no_later_than: int | None = None) -> None:
        self.step = state.step
        self._no_later_than = state.step if no_later_than is None else no_later_than
        self._state = state
        self._tables = tables

    @cached_property
    def _u(self) -> Floats:
        return self._tables.raster.table(self._state.u)

    def rows(self, numbers: tuple[int, ...]) -> Indices:
        """Numbers count from 1 in the order of the rows."""
        return np.array(numbers, np.intp) - 1

    def displacement(self, rows: Indices | None = None) -> Floats:
        """The whole table is made once a moment; a few rows are made without it."""
        if rows is None:
            return self._u
        place = self._tables.raster.place_of(rows)
        return np.stack([plane.ravel()[place] for plane in self._state.u], axis=1)

    def previous_displacement(self) -> Floats:
        """From the buffer of the step before."""
        return self._tables.raster.table(self._state.previous)

    def reference(self, rows: Indices | None = None) -> Floats:
        """X."""
        return self._tables.reference if rows is None else self._tables.raster.reference(rows)

    def position(self) -> Floats:
        """x = X + u, (particle, axis), in float64 whatever the run's precision."""
        return self._tables.add_reference(
            self._tables.raster.table(self._state.u).astype(float, copy=False)
        )

    def kind(self) -> NDArray[np.int8]:
        """(particle,): the role during this step."""
        return kinds_at(self._tables.raster, self._tables.scene.leading, self.step)

    def broken_bonds(self) -> int:
        """Every bond that breaks is marked on one plane, once."""
        broken = self._state.broken_step
        return 0 if broken is None else int((broken >= 0).sum())

    def bonds(self) -> Bonds:
        """Made anew: seldom wanted."""
        return describe_bonds(self._tables.scene)

    def broken_step(self) -> NDArray[np.int32]:
        """From the planes; none has where none can."""
        bonds, broken = self._tables.scene.bonds, self._state.broken_step
        if broken is None:
            return np.full(len(bonds.ends), -1, np.int32)
        steps: NDArray[np.int32] = broken.reshape(len(broken), -1)[bonds.plane, bonds.place]
        return np.where(steps > self._no_later_than, np.int32(-1), steps)

    def broken_strain(self) -> NDArray[np.float64]:
        """From the lengths, in float64 whatever the run's precision."""
        scene, lengths = self._tables.scene, self._state.broken_length
        steps = self.broken_step()
        strains = np.full(len(steps), np.nan)
        if lengths is not None:
            rests = np.array([length(plane.slot.rest) for plane in scene.neighbourhood.planes])
            broken = np.flatnonzero(steps > 0)
            plane, place = scene.bonds.plane[broken], scene.bonds.place[broken]
            strains[broken] = lengths.reshape(len(lengths), -1)[plane, place] / rests[plane] - 1
        return strains

    def remembered(self, name: str) -> NDArray[Any]:
        """In the order of the bonds' table, or of the particles' numbers."""
        scene, state = self._tables.scene, self._state
        for number, values in zip(bond_numbers(scene.experiment), state.bond_values, strict=True):
            if number.name == name:
                found: NDArray[Any] = values.reshape(len(values), -1)[
                    scene.bonds.plane, scene.bonds.place
                ]
                return found
        numbers = particle_numbers(scene.experiment)
        for number, values in zip(numbers, state.particle_values, strict=True):
            if number.name == name:
                return self._tables.raster.table(values[None])[:, 0]
        known = [n.name for n in (*bond_numbers(scene.experiment), *numbers)]
        raise ValueError(f"no part remembers '{name}'{did_you_mean(name, known)}")

    def sum_over_neighbours(
        self, function: Callable[[Any, Any], Any], *, intact_only: bool = False
    ) -> Floats:
        """The loop of the stepper, on the body's particles."""
        raster, state = self._tables.raster, self._state
        sums = np.zeros(raster.shape)
        for block, slots, present in self._tables.blocks:

            def contribution(slot: Slot, block: Any = block) -> tuple[Any, ...]:
                there = vector(block.seen_through(slot).of(state.u))
                value = function(there - vector(block.of(state.u)), slot.rest)
                if not intact_only or state.broken_step is None:
                    return (value,)
                return (np.where(self._broken(block, slot), 0.0, value),)

            (total,) = summed(zip(map(contribution, slots), present, strict=True))
            body = raster.kind[block.slices()] == FOLLOWER
            sums[block.slices()] = np.where(body, total, 0.0)
        return raster.table(sums[None])[:, 0]

    def over_cells(
        self,
        function: Callable[[tuple[Any, ...], tuple[Any, ...]], Any],
        *,
        intact_only: bool = False,
    ) -> Floats:
        """Patch by patch, each with the cells of one shape."""
        found = [np.empty(0)]
        for patch, counted in self.patches(intact_only=intact_only):
            values = function(self.corners(patch), patch.cell.rest)
            found.append(np.broadcast_to(values, counted.shape)[counted])
        return np.concatenate(found)

    def stiffness(self) -> Stiffness:
        """The rule's."""
        stiffness = material_of(self._tables.scene.experiment.rule)
        assert stiffness is not None, "the scene refuses such rules"
        return stiffness

    def displacement_gradient(self) -> Floats:
        """Once a moment, whoever asks."""
        return self._gradient

    @cached_property
    def _gradient(self) -> Floats:
        whole = (
            (patch, share * self._intact(patch) if self._state.broken_step is not None else share)
            for patch, share in self._tables.shares
        )
        planes = displacement_gradient(self._state.u.astype(float, copy=False), whole)
        return self._tables.raster.table(planes).reshape(-1, 2, 2)

    def forces(self) -> Floats:
        """Once a moment, whoever asks."""
        return self._forces

    @cached_property
    def _forces(self) -> Floats:
        u = self._state.u.astype(float, copy=False)
        with self._blaming_rule():
            forces = self._tables.followers.forces(u, self._state)
        return self._tables.raster.table(forces)

    def energy(self) -> float:
        """The rule's."""
        u = self._state.u.astype(float, copy=False)
        with self._blaming_rule():
            return self._tables.followers.energy(u, self._state)

    def _blaming_rule(self) -> AbstractContextManager[None]:
        rule = self._tables.scene.experiment.rule
        return blaming(rule, f"when asked for forces at step {self.step}", "rule")

    def leader_groups(self) -> tuple[LeaderRows, ...]:
        """At time 0 those of step 1 lead."""
        step = max(self.step, 1)
        return tuple(
            LeaderRows(each.rows, each.group.leads(step)) for each in self._tables.scene.leading
        )

    def nearest(self, points: tuple[Pair, ...]) -> Indices:
        """As leaders are selected."""
        rows = [select(self._tables.raster, Selection(nearest=(point,)), ()) for point in points]
        return np.concatenate(rows)

    def patches(self, *, intact_only: bool = False) -> Iterator[tuple[Patch, NDArray[np.bool_]]]:
        """The cells of the body, and which of them count."""
        for patch in self._tables.scene.patches:
            yield patch, self._intact(patch) if intact_only else patch.whole

    def corners(self, patch: Patch) -> tuple[Vector, ...]:
        """u_k - u_0 of the corners."""
        return patch.differences(self._state.u)

    def number_at(self, patch: Patch, place: int) -> int:
        """The lowest number of the corners of a cell, given by its flat place on the patch."""
        return int(patch.rows(self._tables.raster, place).min()) + 1

    def _intact(self, patch: Patch) -> NDArray[np.bool_]:
        """Which cells of a patch have no broken bond between their corners."""
        intact = patch.whole
        if self._state.broken_step is None:
            return intact
        sides = patch.cell.bonds(self._tables.scene.neighbourhood)
        for block, slot in ((patch.corners[k], slot) for k, slot in sides):
            intact = intact & ~self._broken(block, slot)
        return intact

    def _broken(self, block: Block, slot: Slot) -> NDArray[np.bool_]:
        """Where on a block the bond along a slot is broken."""
        assert self._state.broken_step is not None
        plane, at_this_end = self._tables.scene.neighbourhood.home[slot]
        home = block if at_this_end else block.seen_through(slot)
        broken: NDArray[np.bool_] = home.within(self._state.broken_step[plane]) >= 0
        return broken
