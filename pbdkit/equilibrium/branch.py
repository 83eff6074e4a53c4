"""Equilibrium branch of a body with the load as an unknown.

Prescribed displacements and loads are multiplied by a load factor λ. A control prescribes another
quantity, which grows along the branch although the load and the displacements of leaders may
decrease: the relative displacement of two points, or the dissipated energy (Gutiérrez 2004,
Verhoosel, Remmers and Gutiérrez 2009).

Rules are linear. With the damage of the start, the displacements are λ û, where û belongs to λ = 1.
Damage changes the forces in some cells, and these changes are loads on the undamaged body: u = λ û
+ G Δf(u). It is sufficient to solve this equation at the corners of these cells. Newton's method
with the equation of the control as the additional equation,

    [1 - G T   -û ] [δu]     [u - λ û - G Δf]
    [  hᵀ       k ] [δλ] = - [ control      ],

solves two systems with the same matrix, for the residual and for û. T is the derivative of Δf.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats, Indices
from pbdkit.equilibrium.cell_forces import CellShape, DamagingCells, changed_cells, shapes_of
from pbdkit.equilibrium.error_bound import UNKNOWN, ErrorBound, UnconvergedError
from pbdkit.equilibrium.load_stepping import (
    EquilibriumPath,
    Reached,
    SeparatedError,
    finder_of,
)
from pbdkit.equilibrium.newton import Finder
from pbdkit.equilibrium.system import System, one_thread
from pbdkit.errors import ExperimentError
from pbdkit.lattice.raster import FOLLOWER
from pbdkit.linear.operator import Guiding
from pbdkit.model.solver import DissipationControl, OpeningControl
from pbdkit.plugin import RenewsBonds, SoftensCells
from pbdkit.plugin.units import in_lengths
from pbdkit.progress import Watch
from pbdkit.scene.constants import bond_numbers
from pbdkit.scene.leader_groups import guided_at, kinds_at
from pbdkit.scene.opening import Opening
from pbdkit.scene.scene import Scene
from pbdkit.stepping.bond_breaking import Fracturing
from pbdkit.stepping.contact import stiffnesses
from pbdkit.stepping.leaders import place, prescribe
from pbdkit.stepping.state import State, initial_state

MAX_ITERATIONS = 20
"""Maximum number of Newton iterations."""
CONVERGED = 1e-7
"""The iteration ends when the correction, relative to the largest displacement, is below this
number. The error that remains is smaller, because the iteration converges quadratically."""
AHEAD = 1e-4
"""Newton's method starts from the last equilibrium with displacements that are larger by this
relative amount, so that derivatives are those of growing damage."""
MAX_CHANGES = 500
"""Maximum number of times that further cells begin to soften, or bonds break, in an increment."""
SMALLEST_PART = 2.0**-10
"""Smallest part into which a step is divided, as a fraction of the step."""
Complexes = NDArray[np.complexfloating[Any, Any]]
"""Type of an array of complex numbers."""
NONE: Indices = np.zeros(0, np.intp)
"""Places of no cell at all, where a list of cells is required."""
RESPONSE_RTOL = 1e-12
"""Relative accuracy of responses to unit forces."""
SEPARATED = 1e-3
"""A branch that ends where the stiffness of some motion is below this fraction of that at the start
has ended because the body has come apart."""
MAX_REFINEMENTS = 4
"""Maximum number of corrections of an equilibrium of which the error exceeds the tolerance."""
NEGATIVE = -1e-6
"""Eigenvalues of the tangent, which are 1 without damage, count as negative below this number."""
NEARLY_SINGULAR = 1e-2
"""Eigenvalue of the tangent below which a limit of the control or a bifurcation is near."""
LIMIT_RTOL = 1e-9
"""Relative increase of the load by which it is tested whether damage grows."""
BISECTIONS = 45
"""Number of bisections for the load at which damage begins to grow."""
MAX_DOUBLINGS = 60
"""Maximum number of doublings of the load factor before the bisection."""


@dataclass(frozen=True)
class Constraint:
    """Equation `value` = 0 that determines the load factor, linearised.

    Parameters
    ----------
    value
        Left side of the equation.
    by_forces : (unknown,)
        Derivatives with respect to the changes of the forces.
    by_load
        Derivative with respect to the load factor.
    """

    value: float
    by_forces: Floats
    by_load: float


class Target(NamedTuple):
    """Value that is prescribed: that of the controlled quantity or, with `of_load`, the load
    factor."""

    value: float
    of_load: bool = False


class Corners(NamedTuple):
    """Corners of the cells in which damage may change.

    Parameters
    ----------
    place : (corner,)
        Their flat places, in the order of the responses.
    cells
        The cells, and for each the unknowns of its corners, (cell, unknown).
    response : (unknown, unknown)
        Displacements that unit forces cause.
    unit : (unknown,)
        Displacements for the load factor 1.
    """

    place: Indices
    cells: list[tuple[DamagingCells, Indices]]
    response: Floats
    unit: Floats


class Solution(NamedTuple):
    """Solution of Newton's method: the load factor, the displacements of corners, the changes of
    forces there and their derivatives, all (unknown, …)."""

    load_factor: float
    u: Floats
    forces: Floats
    tangent: Floats


class Branch:
    """Equilibria of a scene for given values of the controlled quantity.

    Parameters
    ----------
    scene, finder
        The scene, and the search that computes its equilibrium for the load factor 1.
    order
        Flat places of corners in the order in which their responses were computed in an earlier
        part of the run.

    Attributes
    ----------
    order
        Places of which the responses are known, in the order of their computation.
    smallest
        Smallest real part of the eigenvalues of the tangent at the last equilibrium; they are 1
        without damage.

    Raises
    ------
    ExperimentError
        If the scene has no equilibrium, or the control does not determine the load.
    """

    def __init__(self, scene: Scene, finder: Finder, order: Sequence[int] = ()) -> None:
        self._scene, self._finder, self._steps = scene, finder, scene.experiment.steps
        self._start = initial_state(scene)
        self._shapes: tuple[CellShape, ...] = shapes_of(scene) if scene.tears else ()
        self._fracturing = Fracturing.of(scene)
        self._unit = self._start.copy()
        placed, self.starts = prescribe(scene, self._unit, self._steps)
        place(self._unit.u, placed)
        finder.find(self._unit, self._steps)
        self._system: System = finder.at_rest[0]
        self.smallest = 1.0
        self.order: list[int] = []
        self._columns: list[Floats] = []
        self._compliance: dict[int, Floats] = {}
        control = scene.experiment.solver.equilibrium.control
        self._opening = Opening.of(scene) if isinstance(control, OpeningControl) else None
        if self._opening:
            self._opening_by_forces = self._response_to(
                self._opening.place.tolist(), self._opening.weights
            )
            self._opening_by_load = self._opening.at(self._unit.u)
            if not abs(self._opening_by_load) > 1e-9 * float(np.abs(self._unit.u).max()):
                raise ExperimentError(
                    "the loads and prescribed displacements do not change the opening; choose "
                    "other points or another direction",
                    ("solver", "control"),
                )
        self._include(order)

    def _response_to(self, places: Sequence[int], forces: Floats) -> Floats:
        """Return the displacements, as planes, that forces (place, axis) cause."""
        moves = np.zeros(self._unit.u.shape)
        flat = moves.reshape(len(moves), -1)
        for n, at in enumerate(places):
            flat[:, at] += self._compliance_at([at])[0] @ forces[n]
        return self._system.answer(moves, RESPONSE_RTOL)

    def _compliance_at(self, places: Sequence[int]) -> list[Floats]:
        """Return for each place the moves of its particle that unit forces cause, (axis, axis)."""
        new = np.array([at for at in places if at not in self._compliance], np.intp)
        if len(new):
            scene, raster = self._scene, self._scene.raster
            moves = np.linalg.pinv(stiffnesses(scene, new))
            moves = Guiding(scene, self._steps).turned(new, moves)
            kinds = kinds_at(raster, scene.leading, self._steps)
            free = raster.place_of(np.flatnonzero(kinds == FOLLOWER))
            guided = guided_at(raster, scene.leading, self._steps).place
            moves[~np.isin(new, np.concatenate([free, guided]))] = 0.0
            self._compliance |= dict(zip(new.tolist(), moves, strict=True))
        return [self._compliance[at] for at in places]

    def _include(self, places: Sequence[int]) -> None:
        """Compute the responses to unit forces at further places.

        A response is stored at the places that are known so far. Its values at places that are
        added later follow from the symmetry of the stiffness (Maxwell and Betti).
        """
        known = set(self.order)
        new = [at for at in places if at not in known]
        self._compliance_at(new)
        for at in new:
            self.order.append(at)
            for force in np.eye(self._scene.axes):
                field = self._response_to([at], force[None])
                self._columns.append(self._at(field, self.order))

    @staticmethod
    def _at(field: Floats, places: Sequence[int] | Indices) -> Floats:
        """Return the displacements at places, (unknown,)."""
        displacements: Floats = field.reshape(len(field), -1)[:, places].T.ravel()
        return displacements

    def _corners(self, base: State, more: list[Indices]) -> Corners:
        """Return the corners of the cells of which the damage changed since the start, and of some
        more cells."""
        scene, parts = self._scene, []
        changed = changed_cells(scene, self._shapes, base, self._start)
        for shape, at, others in zip(self._shapes, changed, more, strict=True):
            cells = np.union1d(at, others)
            if len(cells):
                parts.append(DamagingCells(scene, shape, cells, base, self._start))
        used = np.unique(np.concatenate([NONE, *(part.corners.ravel() for part in parts)]))
        self._include(used.tolist())
        position = {at: n for n, at in enumerate(self.order)}
        place = np.array(sorted(used.tolist(), key=position.__getitem__), np.intp)
        rank = np.array([position[at] for at in place.tolist()], np.intp)
        axes = np.arange(scene.axes)
        rows = (scene.axes * rank[:, None] + axes).ravel()
        response = np.zeros((len(rows), len(rows)))
        for n, row in enumerate(rows.tolist()):
            response[: n + 1, n] = self._columns[row][rows[: n + 1]]
        response = np.triu(response) + np.triu(response, 1).T
        index = {at: n for n, at in enumerate(place.tolist())}
        cells_with_unknowns = []
        for part in parts:
            corner = np.vectorize(index.__getitem__, otypes=[np.intp])(part.corners)
            unknowns = scene.axes * corner[:, :, None] + axes
            cells_with_unknowns.append((part, unknowns.reshape(len(corner), -1)))
        return Corners(place, cells_with_unknowns, response, self._at(self._unit.u, place))

    @staticmethod
    def _forces(corners: Corners, u: Floats) -> tuple[Floats, Floats]:
        """Return the changes of the forces at displacements of corners, and their derivatives."""
        forces, tangent = np.zeros(len(u)), np.zeros((len(u), len(u)))
        for cells, unknowns in corners.cells:
            shape = (*cells.corners.shape, -1)
            change, derivatives = cells.tangent(u[unknowns].reshape(shape))
            np.add.at(forces, unknowns, change.reshape(unknowns.shape))
            np.add.at(tangent, (unknowns[:, :, None], unknowns[:, None, :]), derivatives)
        return forces, tangent

    def _constraint(
        self, corners: Corners, last: State, target: Target, λ: float, forces: Floats, begin: float
    ) -> Constraint:
        """Return the equation of the control for the load factor λ and the changes of forces.

        With the increment's first load factor λ₀, the dissipated energy is ½ (λ₀ û·Δf - λ û·Δf₀).
        It is the work of all external forces, by the trapezoidal rule, minus the change of the
        elastic energy. `begin` is û·Δf₀.
        """
        if target.of_load:
            return Constraint(λ - target.value, np.zeros(len(forces)), 1.0)
        if self._opening:
            by_forces = self._at(self._opening_by_forces, corners.place)
            value = self._opening_by_load * λ + by_forces @ forces - target.value
            return Constraint(float(value), by_forces, self._opening_by_load)
        by_forces = 0.5 * last.load_factor * corners.unit
        value = by_forces @ forces - 0.5 * λ * begin - (target.value - last.dissipated)
        return Constraint(float(value), by_forces, -0.5 * begin)

    def _solve(
        self, corners: Corners, last: State, guess: State, target: Target, begin: float
    ) -> Solution:
        """Solve by Newton's method.

        Raises UnconvergedError if the iteration does not converge.
        """
        λ, u = guess.load_factor, self._at(guess.u, corners.place)
        for _ in range(MAX_ITERATIONS):
            with np.errstate(all="ignore"):
                forces, tangent = self._forces(corners, u)
            equation = self._constraint(corners, last, target, λ, forces, begin)
            residual = u - λ * corners.unit - corners.response @ forces
            matrix = np.eye(len(u)) - corners.response @ tangent
            if not (np.isfinite(matrix).all() and np.isfinite(residual).all()):
                break
            sides = np.column_stack([-residual, corners.unit])
            try:
                by_residual, by_load = np.linalg.solve(matrix, sides).T
            except np.linalg.LinAlgError:
                break
            row = equation.by_forces @ tangent
            slope = equation.by_load + row @ by_load
            if slope == 0.0:
                break
            change = -(equation.value + row @ by_residual) / slope
            step = by_residual + change * by_load
            u, λ = u + step, λ + change
            scale = max(float(np.abs(u).max(initial=0.0)), abs(λ) * self._finder.scale * 1e-6)
            size = float(np.abs(step).max(initial=0.0)) / scale
            if size <= CONVERGED:
                return Solution(λ, u, forces + tangent @ step, tangent)
        raise UnconvergedError("Newton's method does not converge")

    def _field(self, corners: Corners, solution: Solution) -> Floats:
        """Return the displacements of all particles."""
        u = solution.load_factor * self._unit.u
        if len(corners.place):
            forces = solution.forces.reshape(-1, self._scene.axes)
            u = u + self._response_to(corners.place.tolist(), forces)
        frame = self._scene.frame
        if frame:
            flat = u.reshape(len(u), -1)
            frame.follow(flat, flat)
        return u

    def advance(self, last: State, target: Target | None, step: int) -> tuple[State, ErrorBound]:
        """Return the equilibrium for a value of the control, and its error bound.

        Parameters
        ----------
        last
            The equilibrium before it.
        target
            Value of the controlled quantity; None for the load at which damage begins.
        step
            Step with which bonds that break are recorded.

        Raises
        ------
        UnconvergedError
            If no equilibrium is found, or the branch splits.
        """
        if not self._opening:
            last = self.at_limit(last, step)
            target = target or Target(last.load_factor, of_load=True)
        assert target
        with one_thread():
            return self._advance(last, target, step)

    def _advance(self, last: State, target: Target, step: int) -> tuple[State, ErrorBound]:
        base, guess = last.copy(), last.copy()
        guess.u *= 1.0 + AHEAD
        more = [NONE for _ in self._shapes]
        corners = self._corners(base, more)
        forces, _ = self._forces(corners, self._at(last.u, corners.place))
        begin = float(corners.unit @ forces)
        for _ in range(MAX_CHANGES):
            self._finder.watch.look(step / self._steps, f"step {step} of {self._steps}")
            try:
                solution = self._solve(corners, last, guess, target, begin)
            except UnconvergedError:
                _, tangent = self._forces(corners, self._at(guess.u, corners.place))
                self._eigenvalues(corners, tangent)
                raise
            guess = base.copy()
            guess.u, guess.load_factor = self._field(corners, solution), solution.load_factor
            if not self._changes_more(base, guess, more, step):
                break
            corners = self._corners(base, more)
        else:
            raise UnconvergedError(f"bonds still change after {MAX_CHANGES} equilibria")
        state, error_bound = self._refined(corners, solution, target, base, guess, step)
        by_unit = float(corners.unit @ solution.forces)
        gain = 0.5 * (last.load_factor * by_unit - state.load_factor * begin)
        state.dissipated = last.dissipated + gain
        state.step, state.starts = step, self.starts
        state.previous[...] = state.u
        self._refuse_splitting(corners, solution)
        return state, error_bound

    def _changes_more(self, base: State, trial: State, more: list[Indices], step: int) -> bool:
        """Update the state variables of all bonds in `trial`, and return whether cells change that
        the solution treats as constant. These are then added to `more`, or their state variables to
        `base`."""
        if self._fracturing is None:
            return False
        model, scene = self._scene.experiment.fracture, self._scene
        if not isinstance(model, RenewsBonds):
            if self._fracturing.break_most_strained(trial.u, trial, step):
                base.broken_step, base.broken_length = trial.broken_step, trial.broken_length
                return True
            return False
        before = changed_cells(scene, self._shapes, base, self._start)
        in_turn = isinstance(model, SoftensCells)
        self._renew(trial, step)
        after = changed_cells(scene, self._shapes, trial, self._start)
        known = [np.union1d(a, b) for a, b in zip(before, more, strict=True)]
        fresh = list(map(np.setdiff1d, after, known))
        if not any(map(len, fresh)):
            return False
        if in_turn:
            self._begin(base, trial)
        else:
            more[:] = [np.union1d(a, b) for a, b in zip(more, fresh, strict=True)]
        return True

    def _renew(self, state: State, step: int) -> None:
        """Update the state variables of all bonds, and break bonds. Cells begin to soften in turn,
        after the damage of cells that soften already has become constant."""
        assert self._fracturing
        if isinstance(self._scene.experiment.fracture, RenewsBonds):
            in_turn = isinstance(self._scene.experiment.fracture, SoftensCells)
            while self._fracturing.break_bonds(state.u, state, step, in_turn=in_turn):
                pass

    def _begin(self, base: State, trial: State) -> None:
        """Let cells begin to soften: state variables other than the damage become those of `trial`
        on those sides of bonds on which they have the values of the start in `base`."""
        names = [number.name for number in bond_numbers(self._scene.experiment)]
        values = list(zip(names, base.bond_values, self._start.bond_values, strict=True))
        for side in ("_left", "_right"):
            own = [(name, now, start) for name, now, start in values if name.endswith(side)]
            rests = np.all([now == start for _, now, start in own], axis=0)
            for name, new in zip(names, trial.bond_values, strict=True):
                if name.endswith(side) and not name.startswith("damage"):
                    now = base.bond_values[names.index(name)]
                    np.copyto(now, new, where=rests)

    def _refuse_splitting(self, corners: Corners, solution: Solution) -> None:
        """Raise UnconvergedError if the branch splits into several.

        At a prescribed opening the equilibrium has to be stable: the tangent has no negative
        eigenvalue. With a prescribed dissipation one eigenvalue is negative while the load
        decreases.
        """
        eigenvalues, allowed = self._eigenvalues(corners, solution.tangent), not self._opening
        count = int(np.count_nonzero((eigenvalues.real < NEGATIVE) & (eigenvalues.imag == 0.0)))
        if count > allowed:
            number = f"{count} negative eigenvalue{'s' * (count > 1)}"
            raise SplitError(
                f"the tangent stiffness has {number} at a prescribed opening: the branch splits "
                "into several, or the opening has its largest value on the branch"
                if self._opening
                else f"the tangent stiffness has {number}: the branch splits into several, and the "
                "damage can continue in different places"
            )

    def _eigenvalues(self, corners: Corners, tangent: Floats) -> Complexes:
        """Return the eigenvalues of the tangent at a prescribed opening or, without one, at a
        prescribed load, and store the smallest real part."""
        compliance = corners.response
        if self._opening:
            by_forces = self._at(self._opening_by_forces, corners.place)
            compliance = compliance - np.outer(corners.unit, by_forces) / self._opening_by_load
        matrix = np.eye(len(compliance)) - compliance @ tangent
        eigenvalues = np.linalg.eigvals(matrix).astype(complex)
        self.smallest = float(eigenvalues.real.min(initial=1.0))
        return eigenvalues

    def _refined(
        self,
        corners: Corners,
        solution: Solution,
        target: Target,
        base: State,
        state: State,
        step: int,
    ) -> tuple[State, ErrorBound]:
        """Return the state with its error bound. As long as the error exceeds the tolerance, it is
        corrected by the solution for the moves that remain.

        Raises UnconvergedError if the tolerance is not reached.
        """
        tolerance = self._scene.experiment.solver.equilibrium.tolerance
        for _ in range(MAX_REFINEMENTS):
            correction, of_load, residual = self._correction(corners, solution, target, state)
            distance = 2.0 * float(np.abs(correction).max())
            error_bound = ErrorBound(
                method=self._system.methods,
                iterations=1,
                inner_iterations=self._system.iterations,
                residual=residual,
                distance=distance,
                share=distance / (float(np.abs(state.u).max()) or 1.0),
                bound=self._system.bound_kind,
                linearised=True,
            )
            if error_bound.share <= tolerance:
                return state, error_bound
            corrected = base.copy()
            corrected.u = state.u + correction
            corrected.load_factor = state.load_factor + of_load
            if self._fracturing:
                self._renew(corrected, step)
            state = corrected
        raise UnconvergedError(
            f"the remaining error, {error_bound.share:.1g} of the largest displacement, exceeds "
            "the tolerance",
            error_bound,
        )

    def _correction(
        self, corners: Corners, solution: Solution, target: Target, state: State
    ) -> tuple[Floats, float, float]:
        """Return the correction of the displacements, that of the load factor, and the largest
        move that remains. The value of the control does not change."""
        finder, axes = self._finder, self._scene.axes
        finder.moves.scale_loads(state.load_factor)
        moves = finder.moves.at(state, self._steps)
        correction, of_load = self._system.answer(moves, RESPONSE_RTOL), 0.0
        if len(solution.u):
            equation = self._constraint(corners, state, target, 0.0, solution.forces, 0.0)
            matrix = np.eye(len(solution.u)) - corners.response @ solution.tangent
            sides = np.column_stack([self._at(correction, corners.place), corners.unit])
            by_moves, by_load = np.linalg.solve(matrix, sides).T
            row = equation.by_forces @ solution.tangent
            value = self._opening.at(correction) if self._opening else 0.0
            slope = equation.by_load + row @ by_load
            of_load = -(value + row @ by_moves) / slope if slope else 0.0
            u = by_moves + of_load * by_load
            forces = (solution.tangent @ u).reshape(-1, axes)
            correction = correction + of_load * self._unit.u
            correction += self._response_to(corners.place.tolist(), forces)
        return correction, of_load, float(np.abs(moves).max())

    def softness(self, state: State) -> float:
        """Return the smallest stiffness of a motion, for the damage of a state, relative to the
        stiffness at the start."""
        with one_thread():
            corners = self._corners(state, [NONE for _ in self._shapes])
            if not len(corners.place):
                return 1.0
            change = np.zeros(corners.response.shape)
            for cells, unknowns in corners.cells:
                of_each = cells.with_damage_of(state) - cells.stiffness
                np.add.at(change, (unknowns[:, :, None], unknowns[:, None, :]), of_each)
            eigenvalues = np.linalg.eigvals(np.eye(len(change)) - corners.response @ change)
            return float(np.abs(eigenvalues).min())

    def at_limit(self, last: State, step: int) -> State:
        """Return the equilibrium at the largest load at which the damage is still that of `last`,
        with the cells or bonds that change there.

        Raises UnconvergedError if the load can grow without limit.
        """
        λ = last.load_factor
        if λ and self._changes_at(last, (1.0 + LIMIT_RTOL) * last.u):
            return last
        with one_thread():
            unit = last.u / λ if λ else self._unit.u
            low, high = λ, 2.0 * λ or 1.0
            for _ in range(MAX_DOUBLINGS):
                if self._changes_at(last, high * unit):
                    break
                low, high = high, 2.0 * high
            else:
                raise UnconvergedError("no bond softens, however large the load is")
            while not low and self._changes_at(last, 0.5 * high * unit):
                high *= 0.5
            for _ in range(BISECTIONS):
                middle = 0.5 * (low + high)
                changes = self._changes_at(last, middle * unit)
                low, high = (low, middle) if changes else (middle, high)
            state = last.copy()
            high *= 1.0 + LIMIT_RTOL  # Equally loaded cells begin together, in spite of rounding.
            state.u, state.load_factor, state.starts = high * unit, high, self.starts
            self._renew(state, step)
        return state

    def _changes_at(self, last: State, u: Floats) -> bool:
        """Return whether at displacements u the damage of a bond would exceed that of an
        equilibrium."""
        assert self._fracturing
        trial = last.copy()
        self._fracturing.break_bonds(u, trial, 1)
        names = [number.name for number in bond_numbers(self._scene.experiment)]
        values = zip(names, trial.bond_values, last.bond_values, strict=True)
        damage = [(new, old) for name, new, old in values if name.startswith("damage")]
        return any(bool((new > old).any()) for new, old in damage)


class SplitError(UnconvergedError):
    """The branch splits into several."""


def follow(
    scene: Scene,
    state: State,
    watch: Watch,
    since: float = 0.0,
    part: float = 1.0,
    order: Sequence[int] = (),
) -> EquilibriumPath:
    """Follow the branch of a scene from a state, in place, to the last step, and yield the
    equilibria on the way.

    Parameters
    ----------
    scene, state, watch
        The scene; its state, which is the equilibrium at the moment `since`; progress.
    since, part, order
        Point from which the branch continues, as in `Reached`.

    Raises
    ------
    ExperimentError
        If the control does not determine the load.
    UnconvergedError
        If the branch cannot be followed. `state` is then the last equilibrium.
    StoppedError
        On interruption. `state` is then the last equilibrium.
    """
    with one_thread():
        branch = Branch(scene, finder_of(scene, initial_state(scene), watch), order)
    steps, error_bound = scene.experiment.steps, UNKNOWN
    while True:
        end = math.floor(since) + 1
        part = min(part, end - since)
        moment = since + part  # Exact, since each part is a power of two.
        try:
            reached, error_bound = branch.advance(state, _target(scene, moment), end)
        except UnconvergedError as error:
            part /= 2.0
            if part >= SMALLEST_PART:
                continue
            if branch.softness(state) < SEPARATED:
                raise SeparatedError(_parted(scene, state, since)) from None
            text = _where(state, since, moment, error, branch.smallest)
            raise type(error)(text, error_bound) from None
        reached.step = math.floor(moment)
        vars(state).update(vars(reached))
        if moment >= steps:
            return error_bound
        since, part = moment, min(2.0 * part, 1.0)
        yield Reached(moment, state, at_rest=True, part=part, order=tuple(branch.order))


def _target(scene: Scene, moment: float) -> Target | None:
    """Return the value of the control at a moment; None for the load at which damage begins."""
    control, steps = scene.experiment.solver.equilibrium.control, scene.experiment.steps
    if isinstance(control, OpeningControl):
        return Target(control.to * (moment / steps))
    assert isinstance(control, DissipationControl)
    return Target(control.to * ((moment - 1.0) / (steps - 1))) if moment > 1.0 else None


def _parted(scene: Scene, state: State, moment: float) -> str:
    """Return the message for a body that has come apart."""
    experiment = scene.experiment
    control, target = experiment.solver.equilibrium.control, _target(scene, moment)
    length, unit = in_lengths(experiment.units)
    where, remedy = "", "use fewer steps"
    if target is not None and isinstance(control, OpeningControl):
        value = f"{length * target.value:.4g}"
        where = f" and the opening {value} of {length * control.to:.4g} {unit}"
        remedy = f"set solver.control.to to {value} {unit}"
    elif target is not None and isinstance(control, DissipationControl):
        share = target.value / control.to
        where = f" and {100.0 * share:.4g} % of the dissipated energy `to`"
        remedy = f"multiply solver.control.to by {share:.4g}"
    return (
        f"the body has come apart after step {moment:.6g}, at the load factor "
        f"{state.load_factor:.6g}{where}: its parts are held together with less than {SEPARATED:g} "
        "of the stiffness at the start; the records up to there are valid; to end the run there, "
        f"{remedy}"
    )


def _where(
    state: State, moment: float, aim: float, error: UnconvergedError, smallest: float
) -> str:
    """Return the message for a branch that cannot be followed. `smallest` is the smallest
    eigenvalue of the tangent at the last equilibrium."""
    turns = ""
    if not isinstance(error, SplitError) and smallest < NEARLY_SINGULAR:
        turns = (
            f", and an eigenvalue of the tangent stiffness decreases to {smallest:.2g}: the "
            "controlled quantity has its largest value on the branch, or the branch splits"
        )
    remedy = (
        "make one place weaker (a region, a notch, a random field) or the load asymmetric, hold a "
        "body that can bend or slide at the crack, or control the opening of the crack"
        if isinstance(error, SplitError)
        else "use more steps, a control that grows on the branch (another pair of points, or the "
        "dissipated energy), or a finer lattice"
    )
    return (
        f"the branch ends between step {moment:.6g} and step {aim:.6g}, at the load factor "
        f"{state.load_factor:.6g}: {error}{turns}; {remedy}"
    )
