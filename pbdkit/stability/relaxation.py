"""Optimal relaxation w and memory b: the values with which the slowest mode of a rule decays
fastest, and the choice of `auto` for a scene.

A mode with the eigenvalue λ of the rule's own step becomes two, μ² - (1 + b - wz) μ + b = 0 with z
= 1 - λ: the heavy ball (Polyak 1964). For real z from m to M the optimum is where the moduli at
both ends are equal, and both roots meet at an end.

The modes are those of the rule's own step at rest, with the roles of the last step. Where a group
of unknowns is small, all are computed. Else the ends of the spectrum are found by iteration: the
slowest mode by repeated equilibrium solutions, the fastest by moves alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.lattice.raster import FOLLOWER
from pbdkit.linear.operator import step_operator
from pbdkit.linear.spectrum import (
    DENSE,
    NEUTRAL,
    STRAIGHT,
    Complex,
    Entries,
    connected,
    excess,
    has_symmetric_rows,
    modes,
    spectrum,
)
from pbdkit.linear.stencil import LITTLE_MEMORY
from pbdkit.model.solver import Stepping
from pbdkit.plugin import Calibrated
from pbdkit.progress import Watch
from pbdkit.scene.leaders import kinds_at
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import State, initial_state

BELOW, FINEST = 1e-6, 1e-4
"""How near to 1 - √b and its bound w a search comes, and how fine it is."""


class Weights(NamedTuple):
    """What a move is multiplied with, and the last step."""

    relaxation: float
    memory: float

    def rate(self, eigenvalues: Complex) -> float:
        """max |μ| over modes λ, those with λ = 1 apart; 0 where there is none."""
        moving = eigenvalues[np.abs(1.0 - eigenvalues) > NEUTRAL]
        return float(np.abs(modes(moving, *self)).max(initial=0.0))


class HopelessError(ValueError):
    """With no such numbers do all modes shrink; says why."""


def best_weights(
    eigenvalues: Complex, relaxation: float | None = None, memory: float | None = None
) -> Weights:
    """The best w and b for modes λ, those with λ = 1 apart; a number that is given stays.

    Raises HopelessError where there are none.
    """
    z = 1.0 - eigenvalues[np.abs(1.0 - eigenvalues) > NEUTRAL]
    if not len(z):
        return Weights(relaxation or 1.0, memory or 0.0)
    if z.real.min() <= 0.0:
        raise HopelessError(f"the rule has a mode with the eigenvalue {1 - z.real.min():.6g}")
    if memory is not None and abs(memory) >= 1.0:
        raise HopelessError(f"memory {memory:g} lets every mode go on, or grow")
    found = _of_real(float(z.real.min()), float(z.real.max()), relaxation, memory)
    if np.abs(z.imag).max() > STRAIGHT:
        found = _of_complex(eigenvalues, relaxation, memory)
    if not found.rate(eigenvalues) < 1.0:
        raise HopelessError(f"no memory lets all modes shrink with relaxation {found[0]:g}")
    return found


def _of_real(m: float, M: float, w: float | None, b: float | None) -> Weights:
    """Both roots are real up to (1 - √b)² / w, complex to (1 + √b)² / w and real beyond."""
    if b is None and w is None:
        b = ((math.sqrt(M) - math.sqrt(m)) / (math.sqrt(M) + math.sqrt(m))) ** 2
    if w is None:
        assert b is not None
        return Weights(2.0 * (1.0 + b) / (m + M), b)
    if b is None:
        b = max((1.0 - math.sqrt(w * m)) ** 2, (1.0 - math.sqrt(w * M)) ** 2)
    return Weights(w, b)


def _of_complex(eigenvalues: Complex, w: float | None, b: float | None) -> Weights:
    """By search: over 1 - √b in factors, over w for each below its bound."""
    from pbdkit.linear.spectrum import largest_stable_relaxation

    def at(memory: float) -> Weights:
        if w is not None:
            return Weights(w, memory)
        bound = largest_stable_relaxation(eigenvalues, memory)
        assert bound is not None
        found = _least(lambda x: Weights(x, memory).rate(eigenvalues), BELOW * bound, bound)
        return Weights(found, memory)

    def kept(logarithm: float) -> Weights:
        return at((1.0 - math.exp(logarithm)) ** 2)

    if b is not None:
        return at(b)
    starts = np.linspace(math.log(FINEST), 0.0, 20)
    rates = [kept(start).rate(eigenvalues) for start in starts]
    n = int(np.argmin(rates))
    low, high = starts[max(0, n - 1)], starts[min(len(starts) - 1, n + 1)]
    return kept(_least(lambda x: kept(x).rate(eigenvalues), low, high))


def _least(function: Any, low: float, high: float) -> float:
    """Where a function of one number with one minimum is least."""
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(function, bounds=(low, high), method="bounded")
    return float(found.x)


Floats = NDArray[np.floating[Any]]
MARGIN = 0.02
"""By this share an iteration may take the ends of a spectrum for too near to each other."""
ROUGH = 1e-3
"""The relative accuracy of solutions."""
MOVES, SOLUTIONS = 24, 10
"""From so many the ends of a spectrum are told."""
NUDGE = 1e-6
"""Rules that are not linear are asked about displacements of this share of the spacing."""
REMEDY = "give numbers, or leave them out (relaxation 1, memory 0)"


def tuned(scene: Scene) -> Scene:
    """The scene with numbers in place of `auto`; itself where there is none. Raises ExperimentError
    where no spectrum is to be had, or where no such numbers let all modes shrink."""
    asked = scene.experiment.stepping
    if not asked.is_open:
        return scene
    try:
        return with_solver(scene, asked.with_weights(*chosen_weights(scene)))
    except ExperimentError as error:
        raise scene.experiment.located(error) from None


def chosen_weights(scene: Scene) -> Weights:
    """What stands for `auto`, beside what is given."""
    _refuse(scene)
    asked = scene.experiment.stepping
    both = ("relaxation", asked.asked_relaxation), ("memory", asked.asked_memory)
    given = [None if number == "auto" else getattr(asked, name) for name, number in both]
    plain = with_solver(scene.bare, Stepping())
    rest = initial_state(scene)
    rest.u[...] = 0.0
    try:
        known, is_sure = _eigenvalues(plain, rest)
        found = best_weights(known, *given)
        if given[1] is None and not is_sure and found.memory > LITTLE_MEMORY:
            found = best_weights(known, given[0], LITTLE_MEMORY)
    except HopelessError as error:
        raise _refusal(f"{error}; {REMEDY}") from None
    return found


def _refuse(scene: Scene) -> None:
    if scene.experiment.courses:
        raise _refusal(f"'auto' needs numbers that stay, and some change in time; {REMEDY}")
    if scene.experiment.neighbours.nearness():
        raise _refusal(
            "'auto' needs a spectrum, and neighbours that are found anew have none; set "
            f"neighbours.reevaluate: false, or {REMEDY}"
        )
    if scene.lag:
        raise _refusal(
            "'auto' is for steps that follow from the last one alone, and a frame with lag looks "
            f"back farther; set frame.lag: 0, or {REMEDY}"
        )


def _refusal(text: str) -> ExperimentError:
    return ExperimentError(text, ("solver",))


def with_solver(scene: Scene, solver: Stepping) -> Scene:
    """The scene stepped otherwise."""
    experiment = scene.experiment.model_copy(update={"solver": solver})
    inner = scene.inner and with_solver(scene.inner, solver)
    return replace(scene, experiment=experiment, inner=inner)


def _eigenvalues(scene: Scene, rest: State) -> tuple[Complex, bool]:
    """Those of the rule's own step that matter, and whether the others surely lie between."""
    kinds = kinds_at(scene.raster, scene.leading, scene.experiment.steps)
    followers = np.flatnonzero(kinds == FOLLOWER)
    if len(followers) <= scene.axes * DENSE:
        operator = step_operator(scene, rest)
        own = operator.couplings_now.entries().without(operator.held)
        if _largest_group(own) <= DENSE:
            return spectrum(own.matrix()).eigenvalues, True
    return _ends(scene, rest, scene.raster.place_of(followers))


def _largest_group(own: Entries) -> int:
    _, label = connected(own.sparse(), strongly=True)
    return int(np.bincount(label).max(initial=0))


def _ends(scene: Scene, rest: State, place: NDArray[np.intp]) -> tuple[Complex, bool]:
    """The largest and the smallest 1 - λ, a little farther apart than they were found; sure where
    the stiffness is symmetric, so that all λ are real."""
    from pbdkit.equilibrium.linearise import linearised
    from pbdkit.equilibrium.system import PUSH, Moves, one_thread

    system = linearised(scene, rest, scene.experiment.steps, "auto", Watch())
    moves, linear = Moves(scene), scene.experiment.rule.linear
    nudge = 1.0 if linear else NUDGE * min(min(s) for s in scene.neighbourhood.shells())
    longest = 1.0

    def planes(v: Floats) -> Floats:
        out = np.zeros(rest.u.shape)
        out.reshape(len(out), -1)[:, place] = v.reshape(len(out), -1)
        return out

    def of_followers(found: Floats) -> Floats:
        here: Floats = found.reshape(len(found), -1)[:, place].ravel()
        return here

    def pulled(v: Floats) -> Floats:
        """(1 - P) v; by a central difference where the rule is not linear."""
        size, signs = nudge / np.abs(v).max(), (1.0,) if linear else (1.0, -1.0)
        there = (replace(rest, u=planes(sign * size * v)) for sign in signs)
        back = [of_followers(moves.at(state, scene.experiment.steps)) for state in there]
        change: Floats = back[0] - back[1] if len(back) > 1 else 2 * back[0]
        change /= -2 * size
        return change

    def settled(v: Floats) -> Floats:
        """(1 - P)⁻¹ v."""
        nonlocal longest
        size = np.abs(v).max()
        found = system.solve(planes(v / size), ROUGH * longest, rounding=PUSH)
        longest = float(np.abs(found).max())
        return of_followers(size * found)

    with one_thread():
        start = np.random.default_rng(0).uniform(-1.0, 1.0, scene.axes * len(place))
        fastest = _largest(pulled, start, MOVES) * (1.0 + MARGIN)
        slowest = 1.0 / _largest(settled, pulled(start), SOLUTIONS) / (1.0 + MARGIN)
    is_sure = system.how == "energy" or _is_reciprocal(scene, rest)
    return np.array([1.0 - fastest, 1.0 - slowest]), is_sure


def _is_reciprocal(scene: Scene, rest: State) -> bool:
    """Whether what particles do to each other is known to come from a symmetric stiffness."""
    if isinstance(scene.experiment.rule, Calibrated) and scene.frame is None:
        return True
    return not excess(scene) and has_symmetric_rows(step_operator(scene, rest).now)


def _largest(product: Callable[[Floats], Floats], start: Floats, turns: int) -> complex:
    """The eigenvalue of the largest modulus, as some turns of Arnoldi's iteration see it."""
    basis, seen = [start / np.linalg.norm(start)], np.zeros((turns + 1, turns))
    for n in range(turns):
        v = product(basis[-1])
        for _ in range(2):  # twice, so that rounding leaves no share of the others
            shares = np.array([one @ v for one in basis])
            seen[: n + 1, n] += shares
            v = v - shares @ np.array(basis)
        seen[n + 1, n] = np.linalg.norm(v)
        basis.append(v / seen[n + 1, n])
    values = np.linalg.eigvals(seen[:turns])
    return complex(values[np.argmax(np.abs(values))])
