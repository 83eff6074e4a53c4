"""The run at the end of a step, as the dataset and the diagnostics see it: a row a particle."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import did_you_mean
from pbdkit.interfaces import (
    LeaderRows,
    LoadRows,
    Moment,
    Pair,
    Stiffness,
    TouchingRows,
    length,
)
from pbdkit.interfaces.diagnostic import BondHistory, ForceValues
from pbdkit.interfaces.frame import Indices
from pbdkit.registry.blame import blaming
from pbdkit.results.cell_values import StateCells
from pbdkit.results.tables import Tables, read_only
from pbdkit.scene.declarations import bond_numbers, particle_numbers
from pbdkit.scene.leader_groups import kinds_at
from pbdkit.scene.raster import FOLLOWER
from pbdkit.scene.selecting import Selecting
from pbdkit.stepping.contact import Contact
from pbdkit.stepping.evaluator import Neighbour
from pbdkit.stepping.state import Floats, State, describe_bonds


class StateMoment(Moment):
    """A state as a table; bonds that broke later than asked for count as they were before.

    An equilibrium `within` a step, at an increment of load, has the roles of that step, and the
    numbers and loads of that moment.
    """

    def __init__(
        self,
        state: State,
        tables: Tables,
        no_later_than: int | None = None,
        within: float | None = None,
    ) -> None:
        self._now: float = state.step if within is None else within
        self.step, self._within = math.ceil(self._now), within
        self._no_later_than = self.step if no_later_than is None else no_later_than
        self._state, self._tables = state, tables.at(self._now)
        self._scene, self._raster = tables.scene, tables.scene.raster

    def of(self, state: State, tables: Tables) -> StateMoment:
        """The same moment of another state."""
        return StateMoment(state, tables, self._no_later_than, self._within)

    @property
    def body(self) -> NDArray[np.bool_]:
        """The same at every moment."""
        return self._tables.body

    @property
    def inside(self) -> NDArray[np.bool_]:
        """The same at every moment."""
        return self._tables.inside

    @cached_property
    def cells(self) -> StateCells:
        """Made where somebody asks."""
        return StateCells(self._state, self._tables)

    @cached_property
    def forces(self) -> ForceValues:
        """Made where somebody asks."""
        return StateForces(self._state, self._tables)

    def rows(self, numbers: tuple[int, ...]) -> Indices:
        """Numbers count from 1 in the order of the rows."""
        return np.array(numbers, np.intp) - 1

    def nearest(self, points: tuple[Pair, ...]) -> Indices:
        """As leaders are selected."""
        return Selecting(self._raster).nearest(points)

    @cached_property
    def _u(self) -> Floats:
        return read_only(self._raster.table(self._state.u))

    def displacement(self, rows: Indices | None = None) -> Floats:
        """The whole table is made once a moment; a few rows are made without it."""
        if rows is None:
            return self._u
        place = self._raster.place_of(rows)
        return read_only(np.stack([plane.ravel()[place] for plane in self._state.u], axis=1))

    def previous_displacement(self) -> Floats:
        """From the buffer of the step before."""
        return read_only(self._raster.table(self._state.previous))

    def reference(self, rows: Indices | None = None) -> Floats:
        """X."""
        if rows is None:
            return self._tables.reference
        return read_only(self._raster.reference(rows))

    def position(self) -> Floats:
        """x = X + u, (particle, axis), in float64 whatever the run's precision."""
        return self._tables.add_reference(
            self._raster.table(self._state.u).astype(float, copy=False)
        )

    def kind(self) -> NDArray[np.int8]:
        """(particle,): the role during this step."""
        return kinds_at(self._raster, self._scene.leading, self.step)

    def sum_over_neighbours(
        self, function: Callable[[Any, Any], Any], *, intact_only: bool = False
    ) -> Floats:
        """The loop of the stepper, on the body's particles."""

        def contribution(d: Any, u: Any, to: Neighbour) -> tuple[Any, ...]:
            value = function(d, to.r)
            if to.broken is not None and intact_only:
                value = np.where(to.broken, 0.0, value)
            return (value,)

        sums = np.full(self._raster.shape, np.nan)
        for around in self._tables.surroundings:
            (total,) = around.sums(contribution, self._state.u, self._state)
            body = around.where.of(self._raster.kind) == FOLLOWER
            around.where.of(sums)[...] = np.where(body, total, np.nan)
        return read_only(self._raster.table(sums[None])[:, 0])

    def leader_groups(self) -> tuple[LeaderRows, ...]:
        """At time 0 those of step 1 lead."""
        step = max(self.step, 1)
        return tuple(
            LeaderRows(read_only(each.rows), each.group.leads(step), each.axes)
            for each in self._scene.leading
        )

    def loads(self) -> tuple[LoadRows, ...]:
        """As they act in this step."""
        loads = self._scene.loads
        return tuple(
            LoadRows(read_only(each.rows), read_only(each.share), each.load.force_at(self._now))
            for each in (loads.each if loads else ())
        )

    def touching(self) -> tuple[TouchingRows, ...]:
        """Found once a moment."""
        return self._touching

    @cached_property
    def _touching(self) -> tuple[TouchingRows, ...]:
        if not self._scene.barriers:
            return ()
        found = Contact(self._scene).touching(self._state, self._now)
        return tuple(TouchingRows(read_only(rows), read_only(n)) for rows, n in found)

    def broken_bonds(self) -> int:
        """Every bond that breaks is marked on one plane, once."""
        broken = self._state.broken_step
        return 0 if broken is None else int((broken >= 0).sum())

    def bonds(self) -> BondHistory:
        """Made anew: seldom wanted."""
        parts = vars(describe_bonds(self._scene)).values()
        values = (*parts, self.broken_step(), self.broken_strain())
        return BondHistory(*(read_only(value) for value in values))

    def broken_step(self) -> NDArray[np.int32]:
        """From the planes; none has where none can."""
        bonds, broken = self._scene.bonds, self._state.broken_step
        if broken is None:
            return np.full(len(bonds.ends), -1, np.int32)
        steps: NDArray[np.int32] = self._of_bonds(broken)
        return np.where(steps > self._no_later_than, np.int32(-1), steps)

    def broken_strain(self) -> NDArray[np.float64]:
        """From the lengths, in float64 whatever the run's precision; what was cut has none."""
        scene, lengths, steps = self._scene, self._state.broken_length, self.broken_step()
        if lengths is None:
            return np.full(len(steps), np.nan)
        rests = np.array([length(plane.slot.rest) for plane in scene.neighbourhood.planes])
        strains = self._of_bonds(lengths) / rests[scene.bonds.plane] - 1
        return np.where((steps > 0) & (strains > -1.0), strains, np.nan)

    def remembered(self, name: str) -> NDArray[Any]:
        """In the order of the bonds' table, or of the particles' numbers."""
        experiment, state = self._scene.experiment, self._state
        names = [number.name for number in bond_numbers(experiment)]
        of_bonds = dict(zip(names, state.bond_values, strict=True))
        names = [number.name for number in particle_numbers(experiment)]
        of_particles = dict(zip(names, state.particle_values, strict=True))
        if name in of_bonds:
            return read_only(self._of_bonds(of_bonds[name]))
        if name in of_particles:
            return read_only(self._raster.table(of_particles[name][None])[:, 0])
        known = [*of_bonds, *of_particles]
        raise ValueError(f"no part remembers '{name}'{did_you_mean(name, known)}")

    def _of_bonds(self, planes: NDArray[Any]) -> NDArray[Any]:
        """Values on the planes of bonds, (bond,)."""
        bonds = self._scene.bonds
        return np.asarray(planes.reshape(len(planes), -1)[bonds.plane, bonds.place])


class StateForces(ForceValues):
    """What the scene's rule makes of a state."""

    def __init__(self, state: State, tables: Tables) -> None:
        self._state, self._tables = state, tables
        self._rule = tables.scene.experiment.rule

    @property
    def stiffness(self) -> Stiffness:
        """The rule's, of each particle where fields make it differ."""
        stiffness = self._tables.stiffness
        if stiffness is None:
            raise ValueError(
                f"the rule '{self._rule.type}' is not calibrated to a material: declare "
                '"material" or "forces" among the `needs`'
            )
        return stiffness

    @property
    def through_thickness(self) -> Any:
        """The rule's, of each particle where fields make it differ."""
        return self._tables.through_thickness

    def on_particles(self) -> Floats:
        """Once a moment, whoever asks."""
        return self._on_particles

    @cached_property
    def _on_particles(self) -> Floats:
        with self._blaming_rule():
            forces = self._tables.followers.forces(self._u, self._state)
        return self._tables.of_body(forces)

    def energy(self) -> float:
        """The rule's."""
        with self._blaming_rule():
            return self._tables.followers.energy(self._u, self._state)

    @property
    def _u(self) -> Floats:
        return self._state.u.astype(float, copy=False)

    def _blaming_rule(self) -> AbstractContextManager[None]:
        return blaming(self._rule, f"when asked for forces at step {self._state.step}", "rule")
