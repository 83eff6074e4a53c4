"""Optimal relaxation w and momentum b, for which the slowest mode of a rule decays fastest. The
values replace `auto` in a scene.

With relaxation and momentum, a mode with the eigenvalue λ of the rule's own step becomes two modes.
Their eigenvalues μ are the roots of μ² - (1 + b - wz) μ + b = 0 with z = 1 - λ (heavy-ball method,
Polyak 1964). If the values of z are real and lie between m and M, two conditions determine the
optimum: |μ| has the same value at z = m and at z = M, and at each of these ends the two roots
coincide.

The modes are the modes of the rule's own step at rest, with the roles of the last step. If the
groups of coupled unknowns are small, all modes are computed. Otherwise only the ends of the
spectrum are computed, by iteration. The slowest mode requires repeated equilibrium solutions, and
the fastest mode only evaluations of moves.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbdkit.array_types import Floats
from pbdkit.errors import ExperimentError
from pbdkit.lattice.raster import FOLLOWER
from pbdkit.linear.block_matrix import DENSE, CoordinateMatrix, connected
from pbdkit.linear.operator import step_operator
from pbdkit.linear.spectrum import (
    NEUTRAL,
    STRAIGHT,
    Complex,
    excess,
    has_symmetric_rows,
    largest_stable_relaxation,
    modes,
    spectrum,
)
from pbdkit.linear.stencil import LITTLE_MEMORY, wave_bound
from pbdkit.model.solver import Stepping
from pbdkit.plugin import Calibrated
from pbdkit.progress import Watch
from pbdkit.scene.leader_groups import kinds_at
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State, initial_state

SEARCH_START = 1e-6
"""Lower end of the interval in which the relaxation is searched, as a fraction of its upper
bound."""

MIN_GAP = 1e-4
"""Lower end of the interval in which 1 - √b is searched."""


class StepWeights(NamedTuple):
    """Parameters of the solver: relaxation w and momentum b."""

    relaxation: float
    memory: float

    def rate(self, eigenvalues: Complex) -> float:
        """Return max |μ| over the modes λ. Modes with λ = 1 are ignored; if there are no other
        modes, the result is 0."""
        moving = eigenvalues[np.abs(1.0 - eigenvalues) > NEUTRAL]
        return float(np.abs(modes(moving, *self)).max(initial=0.0))


class NoStableWeightsError(ValueError):
    """No relaxation and momentum exist with which all modes decay. The message contains the
    reason."""


def best_weights(
    eigenvalues: Complex, relaxation: float | None = None, memory: float | None = None
) -> StepWeights:
    """Return the w and b with which the modes λ decay fastest. Modes with λ = 1 are ignored.

    Parameters
    ----------
    eigenvalues : (n,)
        Eigenvalues λ of the rule's own step.
    relaxation, memory
        Prescribed values; None for values that are to be chosen.

    Raises
    ------
    NoStableWeightsError
        If there are no values with which all modes decay.
    """
    z = 1.0 - eigenvalues[np.abs(1.0 - eigenvalues) > NEUTRAL]
    if not len(z):
        return StepWeights(relaxation or 1.0, memory or 0.0)
    if z.real.min() <= 0.0:
        raise NoStableWeightsError(
            f"the rule has a mode with the eigenvalue {1 - z.real.min():.6g}"
        )
    if memory is not None and abs(memory) >= 1.0:
        raise NoStableWeightsError(f"with memory {memory:g} no mode decays")
    weights = _best_for_real(float(z.real.min()), float(z.real.max()), relaxation, memory)
    if np.abs(z.imag).max() > STRAIGHT:
        weights = _best_for_complex(eigenvalues, relaxation, memory)
    if not weights.rate(eigenvalues) < 1.0:
        raise NoStableWeightsError(
            f"no value of memory makes all modes decay with relaxation {weights[0]:g}"
        )
    return weights


def _best_for_real(m: float, M: float, w: float | None, b: float | None) -> StepWeights:
    """Return the optimum for modes with real z between m and M.

    Both roots μ are real for z up to (1 - √b)² / w, complex for z from there to (1 + √b)² / w, and
    real for larger z.
    """
    if b is None and w is None:
        b = ((math.sqrt(M) - math.sqrt(m)) / (math.sqrt(M) + math.sqrt(m))) ** 2
    if w is None:
        assert b is not None
        return StepWeights(2.0 * (1.0 + b) / (m + M), b)
    if b is None:
        b = max((1.0 - math.sqrt(w * m)) ** 2, (1.0 - math.sqrt(w * M)) ** 2)
    return StepWeights(w, b)


def _best_for_complex(eigenvalues: Complex, w: float | None, b: float | None) -> StepWeights:
    """Search for the optimum. 1 - √b is varied on a logarithmic scale and, for each b, w is varied
    below its bound."""

    def weights_for(memory: float) -> StepWeights:
        if w is not None:
            return StepWeights(w, memory)
        bound = largest_stable_relaxation(eigenvalues, memory)
        assert bound is not None
        relaxation = _minimise(
            lambda x: StepWeights(x, memory).rate(eigenvalues), SEARCH_START * bound, bound
        )
        return StepWeights(relaxation, memory)

    def weights_at(logarithm: float) -> StepWeights:
        return weights_for((1.0 - math.exp(logarithm)) ** 2)

    if b is not None:
        return weights_for(b)
    starts = np.linspace(math.log(MIN_GAP), 0.0, 20)
    rates = [weights_at(start).rate(eigenvalues) for start in starts]
    n = int(np.argmin(rates))
    low, high = starts[max(0, n - 1)], starts[min(len(starts) - 1, n + 1)]
    return weights_at(_minimise(lambda x: weights_at(x).rate(eigenvalues), low, high))


def _minimise(function: Any, low: float, high: float) -> float:
    """Return the argument that minimises a function with a single minimum."""
    from scipy.optimize import minimize_scalar

    result = minimize_scalar(function, bounds=(low, high), method="bounded")
    return float(result.x)


MARGIN = 0.02
"""Relative margin that is added at the ends of a spectrum that is computed by iteration, because
iteration may underestimate its width."""
NONLINEAR_MARGIN = 0.25
"""Relative margin of the fastest mode of nonlinear rules, which are linearised at rest."""
MAX_PRODUCT = 4.0
"""Product of relaxation and largest 1 - λ at which no momentum below 1 is stable."""
ROUGH = 1e-3
"""Relative accuracy of solutions."""
MOVES = 24
"""Number of moves from which the fastest mode is computed."""

SOLUTIONS = 10
"""Number of solutions from which the slowest mode is computed."""
NUDGE = 1e-6
"""Displacement at which nonlinear rules are linearised, as a fraction of the spacing."""
REMEDY = "give numbers, or omit them (relaxation 1, memory 0)"
"""Remedy in messages about `auto`."""


def tuned(scene: Scene) -> Scene:
    """Return the scene with numbers in place of `auto`. If the experiment does not contain `auto`,
    return the scene itself.

    Raises
    ------
    ExperimentError
        If there is no spectrum, or if no numbers exist with which all modes decay.
    """
    solver = scene.experiment.stepping
    if not solver.is_open:
        return scene
    try:
        return with_solver(scene, solver.with_weights(*chosen_weights(scene)))
    except ExperimentError as error:
        raise scene.experiment.located(error) from None


def chosen_weights(scene: Scene) -> StepWeights:
    """Choose numbers in place of `auto`. Prescribed numbers are not changed."""
    _refuse(scene)
    solver = scene.experiment.stepping
    both = ("relaxation", solver.relaxation_setting), ("memory", solver.memory_setting)
    prescribed = [None if number == "auto" else getattr(solver, name) for name, number in both]
    plain = with_solver(scene.bare, Stepping())
    rest = initial_state(scene)
    rest.u[...] = 0.0
    try:
        eigenvalues, is_sure = _eigenvalues(plain, rest)
        if not scene.experiment.rule.linear:
            eigenvalues = _with_margin(plain, eigenvalues, prescribed[0])
        weights = best_weights(eigenvalues, *prescribed)
        if prescribed[1] is None and not is_sure and weights.memory > LITTLE_MEMORY:
            weights = best_weights(eigenvalues, prescribed[0], LITTLE_MEMORY)
    except NoStableWeightsError as error:
        raise _refusal(f"{error}; {REMEDY}") from None
    return weights


def _with_margin(scene: Scene, eigenvalues: Complex, relaxation: float | None) -> Complex:
    """Return the eigenvalues with one more, which is smaller than those of the body and of plane
    waves at rest by a margin, because a deformation changes the eigenvalues of nonlinear rules.

    If a prescribed relaxation leaves less room, the eigenvalues are returned unchanged.
    """
    bound = wave_bound(scene)
    largest = max(float((1.0 - eigenvalues).real.max()), 1.0 - bound.smallest if bound else 0.0)
    largest *= 1.0 + NONLINEAR_MARGIN
    if relaxation is not None and relaxation * largest >= MAX_PRODUCT:
        return eigenvalues
    return np.append(eigenvalues, 1.0 - largest)


def _refuse(scene: Scene) -> None:
    if scene.experiment.time_dependent:
        raise _refusal(f"'auto' requires constant parameters, but some depend on time; {REMEDY}")
    if scene.experiment.neighbours.nearness():
        raise _refusal(
            "'auto' requires a spectrum, which does not exist if neighbours are re-evaluated; "
            f"set neighbours.reevaluate: false, or {REMEDY}"
        )
    if scene.frame_delay:
        raise _refusal(
            "'auto' requires steps that depend on the last one only, but a frame with delay "
            f"depends on earlier ones; set frame.lag: 0, or {REMEDY}"
        )


def _refusal(text: str) -> ExperimentError:
    return ExperimentError(text, ("solver",))


def with_solver(scene: Scene, solver: Stepping) -> Scene:
    """Return the scene with the given solver settings."""
    experiment = scene.experiment.model_copy(update={"solver": solver})
    inner = scene.inner and with_solver(scene.inner, solver)
    return replace(scene, experiment=experiment, inner=inner)


def _eigenvalues(scene: Scene, rest: State) -> tuple[Complex, bool]:
    """Return eigenvalues of the rule's own step, and whether all other eigenvalues are known to lie
    between them."""
    kinds = kinds_at(scene.raster, scene.leading, scene.experiment.steps)
    followers = np.flatnonzero(kinds == FOLLOWER)
    if len(followers) <= scene.axes * DENSE:
        operator = step_operator(scene, rest)
        rule_entries = operator.couplings_current.entries().without(operator.prescribed_unknowns)
        if _largest_block_size(rule_entries) <= DENSE:
            return spectrum(rule_entries.matrix()).eigenvalues, True
    return _ends(scene, rest, scene.raster.place_of(followers))


def _largest_block_size(entries: CoordinateMatrix) -> int:
    _, label = connected(entries.sparse(), strongly=True)
    return int(np.bincount(label).max(initial=0))


def _ends(scene: Scene, rest: State, place: NDArray[np.intp]) -> tuple[Complex, bool]:
    """Return the largest and the smallest value of 1 - λ, moved apart by a margin. Also return
    whether all λ are known to be real."""
    from pbdkit.equilibrium.linearise import linearised
    from pbdkit.equilibrium.system import PUSH, Moves, one_thread

    system = linearised(scene, rest, scene.experiment.steps, "auto", Watch())
    moves, linear = Moves(scene), scene.experiment.rule.linear
    nudge = 1.0 if linear else NUDGE * min(min(s) for s in scene.neighbourhood.shells())
    largest = 1.0

    def planes(v: Floats) -> Floats:
        out = np.zeros(rest.u.shape)
        out.reshape(len(out), -1)[:, place] = v.reshape(len(out), -1)
        return out

    def at_followers(field: Floats) -> Floats:
        values: Floats = field.reshape(len(field), -1)[:, place].ravel()
        return values

    def rule_operator(v: Floats) -> Floats:
        """Apply 1 - P, where P is the rule's own step. If the rule is nonlinear, a central
        difference is used."""
        size, signs = nudge / np.abs(v).max(), (1.0,) if linear else (1.0, -1.0)
        states = (replace(rest, u=planes(sign * size * v)) for sign in signs)
        responses = [at_followers(moves.at(state, scene.experiment.steps)) for state in states]
        change: Floats = responses[0] - responses[1] if len(responses) > 1 else 2 * responses[0]
        change /= -2 * size
        return change

    def inverse(v: Floats) -> Floats:
        """Apply (1 - P)⁻¹."""
        nonlocal largest
        size = np.abs(v).max()
        solution = system.solve(planes(v / size), ROUGH * largest, rounding=PUSH)
        largest = float(np.abs(solution).max())
        return at_followers(size * solution)

    with one_thread():
        start = np.random.default_rng(0).uniform(-1.0, 1.0, scene.axes * len(place))
        fastest = _largest(rule_operator, start, MOVES) * (1.0 + MARGIN)
        slowest = 1.0 / _largest(inverse, rule_operator(start), SOLUTIONS) / (1.0 + MARGIN)
    is_sure = system.bound_kind == "energy" or _is_reciprocal(scene, rest)
    return np.array([1.0 - fastest, 1.0 - slowest]), is_sure


def _is_reciprocal(scene: Scene, rest: State) -> bool:
    """Return whether the interactions are known to have a symmetric stiffness matrix."""
    if isinstance(scene.experiment.rule, Calibrated) and scene.frame is None:
        return True
    return not excess(scene) and has_symmetric_rows(step_operator(scene, rest).current)


def _largest(product: Callable[[Floats], Floats], start: Floats, iterations: int) -> complex:
    """Estimate the eigenvalue with the largest modulus by some iterations of Arnoldi's method."""
    basis, hessenberg = [start / np.linalg.norm(start)], np.zeros((iterations + 1, iterations))
    for n in range(iterations):
        v = product(basis[-1])
        for _ in range(2):  # The second pass removes rounding errors.
            coefficients = np.array([vector @ v for vector in basis])
            hessenberg[: n + 1, n] += coefficients
            v = v - coefficients @ np.array(basis)
        hessenberg[n + 1, n] = np.linalg.norm(v)
        basis.append(v / hessenberg[n + 1, n])
    values = np.linalg.eigvals(hessenberg[:iterations])
    return complex(values[np.argmax(np.abs(values))])
