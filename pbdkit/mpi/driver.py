"""Drivers for the part of a lattice that one rank owns. They make steps with halo exchange, or
compute an equilibrium, and take decisions together with the drivers of all other ranks.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats
from pbdkit.equilibrium.error_bound import ErrorBound, SteadyStateMonitor
from pbdkit.equilibrium.load_stepping import EquilibriumPath
from pbdkit.equilibrium.system import Rows, StagnationError, Strip
from pbdkit.errors import NotSharedError
from pbdkit.model.solver import SteadyStateCriterion
from pbdkit.mpi import partition
from pbdkit.mpi.communicator import MPICommunicator
from pbdkit.plugin import Draws
from pbdkit.progress import StoppedError, Watch
from pbdkit.scene.memory_estimate import asks_for_grids
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.simulation import SECONDS_A_VALUE, Driver, EquilibriumDriver, SteppingDriver
from pbdkit.stepping.divergence import EVERY, Guard, largest_displacement, size_of
from pbdkit.stepping.engine_choice import Choice, choose, make_engine
from pbdkit.stepping.numpy_engine import Engine
from pbdkit.stepping.program import hindrance, program_of, reach_of, steady_steps
from pbdkit.stepping.state import State, initial_state
from pbdkit.stepping.step import Mode


class DistributedStepper(Engine):
    """Engine that makes as many steps in a call as the halo permits. A call ends before a motion
    begins, since the motion starts from an updated state."""

    def __init__(
        self, ranks: MPICommunicator, scene: Scene, engine: Engine, halo: partition.Halo, steps: int
    ) -> None:
        self.name, self.threads = engine.name, engine.threads
        self._ranks, self._engine, self._program = ranks, engine, program_of(scene)
        self._halo, self._steps = halo, steps

    def advance(self, state: State, steps: int = 1) -> State:
        """Return the state after `steps` steps. An error in one process is raised in all
        processes."""
        end = state.step + steps
        while state.step < end:
            limit = min(self._steps, end - state.step)
            count = steady_steps(self._program, state.step + 1, limit, precomputable=True)
            error: Exception | None = None
            try:
                state = self._engine.advance(state, count)
            except Exception as raised:
                error = raised
            self._ranks.raise_first(error)
            self._halo.renew(state)
            for rows in self._halo.received.values():
                self._engine.renewed(state, rows)
        return state


def whole_of(ranks: MPICommunicator, scene: Scene) -> Scene | None:
    """Return the whole scene in the first process, and None in the other processes."""
    if not ranks.is_root:
        return None
    return build_scene(scene.experiment) if scene.raster.extent else scene


class Division:
    """Scene that is divided among processes. It contains the part of this process, and methods that
    gather and distribute states.

    The first process stores the `whole` scene if diagnostics or the steady state need it.
    """

    def __init__(
        self, ranks: MPICommunicator, scene: Scene, parts: list[partition.Subdomain]
    ) -> None:
        self.ranks, self.count, self.subdomains = ranks, scene.raster.total, parts
        self.part = partition.part_of(scene, self.subdomains[ranks.rank])
        self.scene, experiment = self.part.scene, scene.experiment
        self.halo = partition.Halo(ranks, self.subdomains, self.part)
        self.whole: Scene | None = None
        measured = any(not each.local for each in experiment.diagnostics)
        with ranks.raise_together():
            if measured or experiment.stepping.settle:
                self.whole = self.whole_of(scene)

    def whole_of(self, scene: Scene) -> Scene | None:
        """Return the whole scene in the first process."""
        return self.whole or whole_of(self.ranks, scene)

    def initial_part(self, scene: Scene) -> tuple[State, bool]:
        """Return this process's part of the state at time 0, and whether it can be computed again
        without data of other processes. Random numbers are drawn by the first process for the whole
        lattice."""
        experiment, whole = scene.experiment, None
        draws = any(isinstance(part, Draws) for part in (experiment.rule, experiment.fracture))
        if not (experiment.initial.is_drawn or draws):
            state, at_rest = initial_state(self.scene), experiment.initial.at_rest
            if not at_rest:
                self.halo.renew(state)
            return state, at_rest
        with self.ranks.raise_together():
            if scene_of_all := self.whole_of(scene):
                whole = initial_state(scene_of_all)
        return self.local_part(whole), False

    def local_part(self, whole: State | None) -> State:
        """Return this process's part of a whole state. Only the first process has the whole
        state."""
        members = self.ranks.allgather(self.halo.members)
        if whole is None or not self.ranks.is_root:
            return self._state(None)
        axes = self.scene.axes
        parts = zip(self.subdomains, members, strict=True)
        return self._state(
            partition.part_of_state(whole, axes, subdomain, rows) for subdomain, rows in parts
        )

    def _state(self, each: Iterable[State] | None) -> State:
        state: State = self.ranks.scatter(each)
        return state

    def gathered(self, state: State) -> State | None:
        """Return the whole state in the first process."""
        return self.halo.gathered(state)

    def state_dict(self, own: dict[str, Any]) -> dict[str, Any]:
        """Return the dictionary with the state of a driver. The entry for the state of the scene is
        replaced by the state of the whole lattice, the arrays of which are joined when they are
        accessed."""
        return own | {"state": self.halo.joined(own["state"])}

    def scattered(self, parts: Mapping[str, Any]) -> dict[str, Any]:
        """Return the dictionary with the state of the driver of this part. `parts` is the
        dictionary of the whole lattice in the first process, and is not used in the others."""
        rest = self.ranks.bcast({key: part for key, part in parts.items() if key != "state"})
        state = self.local_part(parts.get("state") if self.ranks.is_root else None)
        return {**rest, "state": state}

    def stepper(self, choice: Choice) -> tuple[Engine, Choice]:
        """Return the engine for the part of the scene in this process. By default it uses one
        thread in each process."""
        if self.scene.experiment.stepping.threads == "auto":
            choice = replace(choice, threads=1)
        with self.ranks.raise_together():
            engine, choice = make_engine(self.scene, choice)
        steps = self.part.subdomain.steps
        return DistributedStepper(self.ranks, self.scene, engine, self.halo, steps), choice


class DistributedWatch(Watch):
    """Watch that interrupts all processes if the user interrupts one of them. The first process
    shows the progress."""

    def __init__(self, ranks: MPICommunicator, watch: Watch) -> None:
        super().__init__(lambda: ranks.any(watch.stopping()), watch.show)


@dataclass
class DistributedGuard(Guard):
    """Check for divergence over all parts of the lattice."""

    ranks: MPICommunicator

    def largest_displacement(self, state: State) -> float:
        """Return the largest displacement of all parts."""
        return self.ranks.largest(super().largest_displacement(state))

    def worst(self, scene: Scene, state: State) -> int:
        """Return the number of the particle with the largest displacement. If the displacements of
        several particles are equal, the particle of the lowest rank is chosen."""
        values = self.ranks.allgather(
            (super().largest_displacement(state), super().worst(scene, state))
        )
        # NaN counts as largest.
        return int(values[int(np.argmax([largest for largest, _ in values]))][1])


class DistributedMonitor(SteadyStateMonitor):
    """Steady-state monitor of the whole scene, which runs in the first process."""

    def __init__(self, division: Division, criterion: SteadyStateCriterion) -> None:
        self._division, self._monitor = division, None
        if whole := division.whole:
            self._monitor = SteadyStateMonitor(whole, criterion, initial_state(whole), Watch())
        self._agree(None)

    def _agree(self, found: ErrorBound | None) -> ErrorBound | None:
        """Send the result of the first process to all processes, and return it."""
        monitor = self._monitor
        values = self._division.ranks.bcast(monitor and (found, monitor.pace, monitor.obstacle))
        error_bound: ErrorBound | None = values[0]
        self.pace, self.obstacle = values[1:]
        return error_bound

    def look(self, state: State) -> ErrorBound | None:
        """Return the error bound of a steady state, as in a run with a single process. Raises
        StoppedError in all processes."""
        whole, error_bound, ranks = self._division.gathered(state), None, self._division.ranks
        error: Exception | None = None
        if self._monitor and whole is not None:
            self._monitor.pace, self._monitor.obstacle = self.pace, self.obstacle
            try:
                error_bound = self._monitor.look(whole)
            except StoppedError as stopped:
                error = stopped
        ranks.raise_first(error)
        return self._agree(error_bound)


class DistributedSteppingDriver(SteppingDriver):
    """Stepping driver of a part, with decisions that all processes make together."""

    def __init__(self, division: Division, scene: Scene, watch: Watch) -> None:
        ranks, self._division = division.ranks, division
        refuse_operations(ranks, scene, Mode.RANKS)
        start, can_recompute = division.initial_part(scene)
        Driver.__init__(self, division.scene, start, DistributedWatch(ranks, watch))
        self._engine, self.choice = division.stepper(ranks.bcast(choose(scene)))
        self._steps_per_call = self._steps_in(SECONDS_A_VALUE * scene.raster.total / ranks.size)
        size = size_of(scene) + ranks.largest(largest_displacement(start))
        self.guard = DistributedGuard(
            size, 0, EVERY, None if can_recompute else start.copy(), ranks
        )
        self.monitor, self.recorded_step = None, -1
        if criterion := scene.experiment.stepping.settle:
            self.monitor = DistributedMonitor(division, criterion)

    def _steps_in(self, seconds_a_step: float) -> int:
        """Return the number of steps that the first process estimates."""
        return int(self._division.ranks.bcast(super()._steps_in(seconds_a_step)))

    def state_dict(self) -> dict[str, Any]:
        """Return the dictionary with the state of the driver. Its entry for the state of the scene
        is the state of the whole lattice, the arrays of which are joined when they are accessed."""
        return self._division.state_dict(super().state_dict())

    def load_state_dict(self, parts: Mapping[str, Any]) -> None:
        """Restore the driver. `parts` contains the state of the whole lattice in the first process,
        and is not used in the others."""
        super().load_state_dict(self._division.scattered(parts))


def refuse_operations(ranks: MPICommunicator, scene: Scene, mode: Mode) -> None:
    """Raise NotSharedError in all processes if some process has an operation that does not support
    ranks."""
    reasons = [reason for reason in ranks.allgather(hindrance(scene, mode)) if reason]
    refuse(scene, [(True, (reason.field,), reason.reason) for reason in reasons])


def refuse(scene: Scene, unfit: Iterable[tuple[bool, tuple[str, ...], str]]) -> None:
    """Raise NotSharedError for the first feature in `unfit` that is present. The features are not
    supported on several ranks; the error names the field of the feature."""
    for clash, field, text in unfit:
        if clash:
            refusal = f"{text}, which is not supported on several processes; run it in one process"
            raise scene.experiment.located(NotSharedError(refusal, field))


SHARE = 4
"""Ratio of the number of rows of a part to the number of rows of the finest grid that is not
divided."""
A_CYCLE = 6
"""Number of rows of the finest undivided grid by which a process extends its own rows for a cycle.
In a cycle the number of valid rows decreases by 4 on the way to coarser grids, and by 2 on the way
back."""


class DistributedRows(Rows):
    """Rows of one process on a shared grid."""

    def __init__(self, ranks: MPICommunicator, halo: partition.Halo, strip: Strip) -> None:
        super().__init__(ranks)
        self._halo, self.strip = halo, strip

    def exchange_halo(self, field: NDArray[Any]) -> None:
        """Update the halo of a field, in place, with data from the other parts."""
        self._halo.meet(field)

    def whole(self, numbers: NDArray[Any]) -> NDArray[Any]:
        """Gather an array of shape (..., row) from each process, and return the array for all
        rows."""
        return np.concatenate(self.communicator.allgather(numbers[..., self.own]), axis=-1)

    def random(self, shape: tuple[int, ...]) -> Floats:
        """Return the random numbers that a single process would draw for the rows of this process.
        The generator is advanced by one for each number of the other rows."""
        assert self.strip
        planes, (rows, places) = shape[:-2], shape[-2:]
        numbers: Floats = np.empty((math.prod(planes), rows, places))
        for n, plane in enumerate(numbers):
            turned = np.random.PCG64(0).advance((n * self.strip.count + self.strip.low) * places)
            plane[...] = np.random.Generator(turned).uniform(-1.0, 1.0, (rows, places))
        return numbers.reshape(shape)


def deep_subdomains(scene: Scene, parts: int) -> list[partition.Subdomain]:
    """Return parts with halos that are wide enough for a multigrid cycle. The arrays of a part
    begin at a row that exists on all divided grids.

    Raises ExperimentError if rows are too few.
    """
    spread = 2 ** _depth(parts)
    each, edge = partition.reaches(scene)
    halo, rows = _margin(scene) + A_CYCLE * spread, len(scene.raster.row_counts)
    deep = []
    for part in partition.subdomains(scene, parts):
        low = max(0, part.begin - halo) // spread * spread
        high = min(rows, part.end + halo)
        steps = max(1, min(partition.MAX_STEPS_PER_EXCHANGE, (halo - edge) // max(1, each)))
        deep.append(partition.Subdomain(part.begin, part.end, low, high, edge, steps))
    return deep


def deep_halo(each: int, edge: int, least: int, parts: int) -> int:
    """Return an upper bound of the halos of `deep_subdomains`. The arguments are the same as those
    of `widest_halo`."""
    return 3 * edge + each + (A_CYCLE + 1) * int(2 ** _depth(parts))


def strip_of(scene: Scene, own: partition.Subdomain, parts: int) -> Strip:
    """Return the rows of a part, as a `Strip` of the grid of a scene."""
    count, margin = scene.raster.whole_shape[1], _margin(scene)
    first = own.low + margin if own.low else 0
    last = own.high - margin if own.high < count else count
    return Strip(count, own.low, own.begin, own.end, first, last, _depth(parts))


def _depth(parts: int) -> int:
    """Return the number of grids that are divided among the processes."""
    return math.ceil(math.log(SHARE * parts, 4))


def _margin(scene: Scene) -> int:
    """Return the number of outermost rows of a part that cannot be used in the system. Some of
    these rows are empty or do not move. In the others, a particle has a neighbour that lies in such
    a row or that is a frame point following such a row."""
    return 3 * reach_of(scene, 0).reach + partition.farthest_apart(scene)


STUCK = "the distributed iteration does not converge; run it in one process"
"""Message for an iteration that makes no progress."""


class DistributedEquilibriumDriver(EquilibriumDriver):
    """Driver of an equilibrium that several processes compute together. It supports linear rules on
    a lattice with one site in a repeat cell. Obstacles and bonds that break are not supported."""

    def __init__(self, division: Division, scene: Scene, watch: Watch) -> None:
        ranks, self._division = division.ranks, division
        for mode in (Mode.RANKS, Mode.RANKS_AT_REST):
            refuse_operations(ranks, scene, mode)
        _refuse_solver(scene)
        start, can_recompute = division.initial_part(scene)
        super().__init__(division.scene, start, DistributedWatch(ranks, watch))
        self._start = None if can_recompute else start.copy()
        strip = strip_of(scene, division.part.subdomain, ranks.size)
        self._rows = DistributedRows(ranks, division.halo, strip)

    def state_dict(self) -> dict[str, Any]:
        """Return the dictionary with the state of the driver. Its entry for the state of the scene
        is the state of the whole lattice, the arrays of which are joined when they are accessed."""
        return self._division.state_dict(super().state_dict())

    def load_state_dict(self, parts: Mapping[str, Any]) -> None:
        """Restore the driver. `parts` contains the state of the whole lattice in the first process,
        and is not used in the others."""
        super().load_state_dict(self._division.scattered(parts))

    def _path(self, state: State) -> EquilibriumPath:
        from pbdkit.equilibrium.load_stepping import finder_of, increments

        scene, start = self.scene, self._start or initial_state(self.scene)
        try:
            finder = finder_of(scene, start, self.watch, rows=self._rows)
            path = increments(scene, state, self.watch, self.moment, finder, self._stops)
            error_bound = yield from self._renewed(path)
        except StagnationError:
            raise NotSharedError(STUCK, ("solver",)) from None
        self._division.halo.renew(state)
        return error_bound

    def _renewed(self, path: EquilibriumPath) -> EquilibriumPath:
        """Update the frame points at each equilibrium on the path of the load."""
        while True:
            try:
                reached = next(path)
            except StopIteration as end:
                error_bound: ErrorBound = end.value
                return error_bound
            if reached.at_rest:
                self._division.halo.renew(reached.state)
            yield reached


def _refuse_solver(scene: Scene) -> None:
    from pbdkit.equilibrium.stencil_matrix import PrimitiveRaster

    experiment, grid = scene.experiment, PrimitiveRaster.of(scene)
    method = experiment.solver.equilibrium.method
    refuse(
        scene,
        [
            (
                experiment.solver.equilibrium.control is not None,
                ("solver", "control"),
                "a branch of equilibria",
            ),
            (
                grid is None,
                ("neighbours",),
                "an equilibrium with neighbours beyond adjacent cells",
            ),
            (
                grid is None or not grid.is_the_scenes,
                ("lattice",),
                "an equilibrium on a lattice with several sites per cell",
            ),
            (
                method not in ("auto", "multigrid"),
                ("solver", "method"),
                f"an equilibrium by method '{method}'",
            ),
            (not find_spec("numba"), ("solver",), "an equilibrium without numba"),
            (
                not asks_for_grids(experiment, method, scene.raster.total),
                ("solver", "method"),
                "an equilibrium of so few particles",
            ),
        ],
    )
