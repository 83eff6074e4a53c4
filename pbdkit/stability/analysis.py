"""Stability analysis of an experiment. It computes the spectrum of the step operator, the rate of
convergence, and the reasons why steps do not converge.

The step operator may be too large to be stored as a matrix. Then the slowest mode is computed by
inverse iteration on finer and finer grids, with multigrid on the lattice's stencils. The result 1 -
λ has an accuracy of 1 %. The smallest eigenvalue is then taken from plane waves, although edges
without a frame may cause smaller eigenvalues.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.equilibrium.lattice_system import SlowMode
from pbdkit.equilibrium.system import StagnationError, System, one_thread
from pbdkit.lattice.raster import distinct
from pbdkit.linear.block_matrix import CoordinateMatrix, connected
from pbdkit.linear.operator import StepOperator, step_operator
from pbdkit.linear.spectrum import (
    NEUTRAL,
    OscillatingMode,
    Spectrum,
    excess,
    just_below,
    largest_stable_relaxation,
    modes,
    oscillation_limit,
    slowest_oscillation,
    spectrum,
    spectrum_of,
)
from pbdkit.linear.stencil import bounds_the_body, stability_remedy, wave_bound
from pbdkit.memory import machine_memory
from pbdkit.plugin import Anchors
from pbdkit.progress import Watch
from pbdkit.scene.memory_estimate import LARGEST_REPEATED
from pbdkit.scene.scene import Scene
from pbdkit.stability.distance import LeaderDistance, distance_from_equilibrium, fastest
from pbdkit.stepping.state import State, initial_state

if TYPE_CHECKING:
    from pbdkit.equilibrium.lattice_system import LatticeSystem


@dataclass(frozen=True)
class Spectra:
    """Eigenvalues of one scene, linearised at the start, with the roles of the last step.

    Parameters
    ----------
    scene
        Scene without fracture and obstacles.
    """

    scene: Scene

    @cached_property
    def operator(self) -> StepOperator:
        """Return the step operator, with two unknowns for each follower."""
        return step_operator(self.scene)

    @cached_property
    def estimate(self) -> StabilityEstimate:
        """Return the estimator, which is used for scenes that have no step operator, or one that is
        too large for a matrix."""

        return StabilityEstimate(self.scene)

    @cached_property
    def spectrum(self) -> Spectrum | None:
        """Return the spectrum of the solver's step, with relaxation, momentum and frame delay.

        It is None if the spectrum is unknown; `left_out` gives the reason.
        """
        rule_spectrum, solver = self.of_rule, self.scene.experiment.stepping
        if rule_spectrum is None:
            return self._spectrum_of(
                lambda: self.operator.augmented().matrix(), self.scene.frame_delay > 0
            )
        if solver.relaxation == 1.0 and solver.memory == 0.0:
            return rule_spectrum
        # The map from λ to μ maps the ends of a real spectrum to the extreme values of μ.
        eigenvalues = modes(rule_spectrum.eigenvalues, solver.relaxation, solver.memory)
        return spectrum_of(eigenvalues, rule_spectrum.symmetric and solver.memory == 0.0)

    @property
    def has_matrix(self) -> bool:
        """Return whether the step operator exists and is small enough for a matrix."""
        return not (self.scene.experiment.neighbours.nearness() or excess(self.scene))

    @property
    def left_out(self) -> list[str]:
        """Return a message about results that are not computed because they would take too long. It
        contains the reason."""
        if self.spectrum:
            return []
        reason, excess_size = self.estimate.obstacle, excess(self.scene)
        if excess_size and not reason:
            reason = f"{excess_size} for a matrix, and {self.estimate.NEEDS}"
        elif not reason:
            reason = "eigenvalues lie too close together, as in long bodies; analyse a shorter one"
        prefix = "as are parts that no leader reaches: " if excess_size else ""
        return [
            (
                "analysis: the spectrum and the distance from equilibrium are omitted, "
                f"{prefix}{reason}"
            )
        ]

    @property
    def of_rule(self) -> Spectrum | None:
        """Return the spectrum of the rule's own step, without relaxation and momentum.

        It is None if the frame has a delay, or if the spectrum is unknown.
        """
        return self._rule_spectrum[0]

    @property
    def estimated(self) -> bool:
        """Return whether `of_rule` is an estimate."""
        return self._rule_spectrum[1]

    @cached_property
    def _rule_spectrum(self) -> tuple[Spectrum | None, bool]:
        """Compute or estimate the spectrum of the rule's step.

        For large bodies an estimate by multigrid is tried first.
        """
        is_large = self.scene.raster.count > LARGEST_REPEATED
        if is_large and (result := self.estimate.spectrum):
            return result, True
        if result := self._spectrum_of(self.rule_matrix, self.scene.frame_delay == 0):
            return result, False
        result = None if is_large else self.estimate.spectrum
        return result, result is not None

    def _spectrum_of(self, matrix: Callable[[], Any], wanted: bool) -> Spectrum | None:
        """Compute a spectrum; None if it is not required, does not exist or takes too long."""
        if not wanted or not self.has_matrix:
            return None
        try:
            with one_thread():
                return spectrum(matrix())
        except RuntimeError:  # Too expensive, or ARPACK did not converge.
            return None

    def rule_matrix(self) -> Any:
        """Return the matrix of the rule's own step, without relaxation and momentum.

        The momentum b adds b to the coupling of each follower to the current state, and -b to its
        coupling to the previous state. Without frame delay, the sum of both couplings therefore
        does not depend on the momentum.
        """
        steady = self.operator.couplings_steady.entries()
        scale, unknowns = (
            1.0 / self.scene.experiment.stepping.relaxation,
            np.arange(steady.shape[0]),
        )
        rest = CoordinateMatrix(
            unknowns, unknowns, np.full(len(unknowns), 1.0 - scale), steady.shape
        )
        return rest.plus(steady, scale).without(self.operator.prescribed_unknowns).matrix()


TOLERANCES = ("1e-3", "1e-6", "1e-10")
"""Fractions to which the slowest mode decays in `Analysis.steps_to`."""
NEAR = 0.9
"""If edges have no frame, a warning is issued for a relaxation of more than this fraction of the
bound of plane waves."""


@dataclass(frozen=True)
class Analysis:
    """Stability of a scene before its first step, linearised at the start, with the roles of the
    last step.

    The analysis is exact for linear rules. A result is None if it does not exist or would take too
    long to compute.

    Parameters
    ----------
    scene
        Scene with numbers in place of `auto`.

    Examples
    --------
    >>> analysis = pbdkit.analyse("paper/a")
    >>> f"{analysis.spectral_radius:.4f}", analysis.steps_to["1e-3"]
    ('0.9932', 1010)
    """

    scene: Scene

    def __repr__(self) -> str:
        """Return only the name of the experiment, because all other results take time to compute or
        much space."""
        return f"<pbdkit.Analysis of {self.scene.experiment.name}>"

    def __str__(self) -> str:
        """A summary: stability, steps to a tolerance, eigenvalues, distance from equilibrium and
        warnings."""
        rows = [*self.rows(), *(("warning", text) for text in self.warnings())]
        width = max(len(name) for name, _ in rows)
        title = f"analysis of {self.scene.experiment.name}"
        return "\n".join([title, *(f"  {name:<{width}}  {text}" for name, text in rows)])

    def rows(self) -> list[tuple[str, str]]:
        """Return the summary as names and texts."""
        rows = verdict_of(self)
        if (spectrum := self.spectrum) is not None:
            if (smallest := self.smallest_eigenvalue) is not None:
                rows.append(("smallest eigenvalue", f"{smallest:.6g}"))
            values = spectrum.eigenvalues
            turning = int((abs(values.imag) > 1e-12).sum())
            which = "estimated" if self.estimated else "known"
            kinds = f", {turning} of them complex" if turning else ", all real"
            rows.append((f"eigenvalues {which}", f"{len(values)}{kinds}"))
        if self.distance is not None:
            rows.append(("distance", f"{self.distance:.4g} lattice units from equilibrium"))
        return rows

    def _repr_html_(self) -> str:
        """Return the verdict and the eigenvalues for notebooks."""
        return str(import_module("pbdkit.plotting.notebook").analysis_html(self))

    @property
    def exact(self) -> bool:
        """Return whether the results hold for the whole run.

        They do if the rule is declared linear, and bonds, neighbours, contacts and parameters do
        not change.
        """
        experiment = self.scene.experiment
        scene = self.scene
        changes = (
            scene.has_fracture or scene.barriers or scene.operations or experiment.time_dependent
        )
        return experiment.rule.linear and not changes and not experiment.neighbours.nearness()

    @cached_property
    def spectra(self) -> Spectra:
        """Return the eigenvalues from which the results are computed."""
        return Spectra(self.scene.bare)

    @property
    def operator(self) -> StepOperator:
        """Return the step operator, with two unknowns for each follower."""
        return self.spectra.operator

    @property
    def spectrum(self) -> Spectrum | None:
        """Return the spectrum of the solver's step, with relaxation, momentum and frame delay."""
        return self.spectra.spectrum

    @property
    def estimated(self) -> bool:
        """Return whether the spectrum is an estimate, as for large bodies. The accuracy of 1 - ρ is
        then 1 %."""
        return self.spectra.estimated

    @property
    def left_out(self) -> list[str]:
        """Return messages about results that are not computed because they would take too long.
        They contain the reason."""
        messages, solver = self.spectra.left_out, self.scene.experiment.stepping
        if types := dict.fromkeys(f"'{part.operation.type}'" for part in self.scene.operations):
            messages.append(
                f"operations: the analysis does not include {', '.join(types)}; eigenvalues, steps "
                "and distance are those of the rule alone"
            )
        if not self.estimated:
            return messages
        if solver.memory > 0.0 and self.oscillation(solver.relaxation, solver.memory) is None:
            messages.append(
                "analysis: the period is omitted, because a body of this size has many modes "
                "between those that decay without oscillating and those that oscillate"
            )
        moves = self.scene.experiment.solver.makes_steps and fastest(self.scene).speed > 0.0
        if moves and self.stable and self.leader_distance is None:
            messages.append(
                "analysis: the distance from equilibrium is omitted, because the leaders do not "
                "constrain the body in their fastest steps"
            )
        return messages

    @property
    def spectral_radius(self) -> float | None:
        """Return max |λ| of the solver's step."""
        return self.spectrum.radius if self.spectrum else None

    @property
    def smallest_eigenvalue(self) -> float | None:
        """Return min Re λ of the rule's own step."""
        return self.spectra.of_rule.smallest if self.spectra.of_rule else None

    @property
    def largest_stable_relaxation(self) -> float | None:
        """Return the relaxation below which all modes decay, with the momentum of the experiment.

        With the momentum b, it is 2 (1 + b) / (1 - λ_min) if the eigenvalues are real.
        """
        rule_spectrum, memory = self.spectra.of_rule, self.scene.experiment.stepping.memory
        return (
            largest_stable_relaxation(rule_spectrum.eigenvalues, memory) if rule_spectrum else None
        )

    @property
    def best_memory(self) -> float | None:
        """Momentum with which steps without relaxation converge fastest. It is (1 - √(1 - ρ))² for
        0 ≤ ρ < 1."""
        rule_spectrum = self.spectra.of_rule
        if (
            rule_spectrum is None
            or not rule_spectrum.symmetric
            or not 0.0 <= rule_spectrum.largest < 1.0
        ):
            return None
        return (1.0 - math.sqrt(1.0 - rule_spectrum.largest)) ** 2

    @property
    def stable(self) -> bool | None:
        """Return whether no mode grows."""
        return self.spectrum.radius <= 1.0 + NEUTRAL if self.spectrum else None

    def stable_at(self, relaxation: float, memory: float) -> bool | None:
        """Return whether no mode grows with another relaxation and momentum.

        Parameters
        ----------
        relaxation : float
            Factor of the move in a step.
        memory : float
            Factor of the last step, the momentum.

        Returns
        -------
        bool or None
            It is None if the eigenvalues of the rule are unknown, because the frame has a delay,
            neighbours are searched at every step, or the body is too large.
        """
        rule_spectrum = self.spectra.of_rule
        if rule_spectrum is None:
            return None
        mu = modes(rule_spectrum.eigenvalues, relaxation, memory)
        return bool(np.abs(mu).max(initial=0.0) <= 1.0 + NEUTRAL)

    def oscillation(self, relaxation: float, memory: float) -> OscillatingMode | None:
        """Return the oscillating mode with the longest period for a given relaxation and momentum.

        Parameters
        ----------
        relaxation : float
            Factor of the move in a step.
        memory : float
            Factor of the last step, the momentum.

        Returns
        -------
        `OscillatingMode` or None
            Period 2π / arg μ in steps, and decay per step |μ|, which is √memory if the eigenvalues
            of the rule are real. It is None if no mode oscillates, or if the eigenvalues of the
            rule are unknown.
        """
        rule_spectrum = self.spectra.of_rule
        if rule_spectrum is None:
            return None
        eigenvalues = rule_spectrum.eigenvalues
        if self.estimated and rule_spectrum.largest > oscillation_limit(relaxation, memory):
            return None
        if 0.0 < memory < 1.0 and rule_spectrum.largest > (
            edge := oscillation_limit(relaxation, memory)
        ):
            # The slowest modes do not oscillate, and the modes near the limit of oscillation may
            # not have been computed yet.
            try:
                eigenvalues = np.append(eigenvalues, just_below(self.spectra.rule_matrix(), edge))
            except RuntimeError:  # Too expensive, or ARPACK did not converge.
                return None
        return slowest_oscillation(modes(eigenvalues, relaxation, memory))

    @property
    def steps_to(self) -> dict[str, int | None]:
        """Return the number of steps in which the slowest mode decays to each tolerance,
        ln(tolerance) / ln ρ."""
        radius = self.spectral_radius
        if radius is None or radius >= 1.0 - 1e-14 or radius == 0.0:
            return dict.fromkeys(TOLERANCES, 1 if radius == 0.0 else None)
        return {
            tolerance: math.ceil(math.log(float(tolerance)) / math.log(radius))
            for tolerance in TOLERANCES
        }

    @cached_property
    def leader_distance(self) -> LeaderDistance | None:
        """Return the distance of the body from its equilibrium in the steps in which its leaders
        move fastest.

        The result is None if no leader moves steadily, if steps diverge, if the solver makes no
        steps, or if the computation would take too long.
        """
        if not (self.scene.experiment.solver.makes_steps and self.stable):
            return None
        if self.estimated:
            estimate = self.spectra.estimate
            return distance_from_equilibrium(
                self.scene, estimate.at_rest, estimate.system, self._slowness
            )
        state = initial_state(self.scene)

        def system_at(step: int) -> System:
            from pbdkit.equilibrium.linearise import linearised

            return linearised(self.scene.bare, state, step, "auto", Watch())

        return distance_from_equilibrium(self.scene, state, system_at, self._slowness)

    @property
    def _slowness(self) -> float:
        """Return 1 / (1 - λ) of the slowest decaying mode, without momentum."""
        assert self.spectrum
        rule_spectrum = self.spectra.of_rule or self.spectrum
        decays = 1.0 - rule_spectrum.eigenvalues.real
        relaxation = self.scene.experiment.stepping.relaxation
        return float(1.0 / (relaxation * decays[decays > NEUTRAL].min(initial=1.0)))

    @property
    def distance(self) -> float | None:
        """Return the largest distance of a follower from its equilibrium, in lattice units.

        It is the constant distance that is reached after long motion at the largest speed of the
        leaders.
        """
        return self.leader_distance.steady if self.leader_distance else None

    @cached_property
    def parts_without_leader(self) -> list[Any]:
        """Return the numbers of the particles of each part that is not connected to a leader."""
        if not self.spectra.has_matrix:
            return []
        operator = self.operator
        steady = operator.couplings_steady.entries()
        graph = CoordinateMatrix(
            steady.rows, steady.columns, np.ones(len(steady.rows)), steady.shape
        )
        count, label = connected(graph.matrix(), strongly=False)
        is_led = np.zeros(count, bool)
        leader_rows = operator.couplings_leader.entries().rows
        is_led[label[np.append(leader_rows, operator.prescribed_unknowns)]] = True
        numbers = operator.followers[np.arange(len(label)) // self.scene.axes] + 1
        parts = {tuple(distinct(numbers[label == n]).tolist()) for n in np.flatnonzero(~is_led)}
        return sorted(parts)

    def warnings(self) -> list[str]:
        """Return the reasons why steps do not converge, with remedies. Also return messages about
        results that were not computed.

        Returns
        -------
        list of str
            Warnings, one sentence each.
        """
        return [*self.obstructions(), *self.left_out]

    def obstructions(self) -> list[str]:
        """Return the reasons why steps do not converge, with remedies."""
        anchored = self.scene.frame is not None and isinstance(self.scene.experiment.frame, Anchors)
        parts = [] if anchored or self.scene.barriers else self.parts_without_leader
        message = "leaders: a part of {} particles (with number {}) is not constrained by any"
        warnings = [message.format(len(part), part[0]) for part in parts]
        if len(parts) > 3:
            warnings = [f"leaders: {len(parts)} parts of the body are not constrained by any"]
        bond = min(min(lengths) for lengths in self.scene.neighbourhood.shells())
        distance_warnings = (
            self.leader_distance.late(bond, self.scene.experiment.units)
            if self.leader_distance
            else []
        )
        return [*warnings, *self._growth(), *self._edges_near_the_bound(), *distance_warnings]

    def _growth(self) -> list[str]:
        """Warn of modes that grow, or never decay."""
        if not self.scene.experiment.solver.makes_steps and self.largest_stable_relaxation:
            return []  # Steps with that relaxation would also converge to equilibrium.
        if self.stable is False:
            bound = self.largest_stable_relaxation
            remedy = stability_remedy(bound, self.scene.experiment.stepping.memory)
            return [
                f"solver.relaxation: {self.scene.experiment.stepping.relaxation:g} diverges, the "
                f"spectral radius is {self.spectral_radius:.6g}{remedy}"
            ]
        if self.spectrum and self.spectrum.smallest <= -1.0 + NEUTRAL:
            return [
                "solver.relaxation: a mode that changes its sign in every step never decays; use "
                "a relaxation below 1"
            ]
        return []

    def _edges_near_the_bound(self) -> list[str]:
        """Warn if the largest stable relaxation is taken from plane waves, and free edges may
        require a smaller one."""
        frame, bound = self.scene.experiment.frame, self.largest_stable_relaxation
        has_free_edges = not bounds_the_body(self.scene) and not frame.weighs_cells
        relaxation = self.scene.experiment.stepping.relaxation
        if not (self.estimated and has_free_edges and bound and NEAR * bound < relaxation < bound):
            return []
        message = f"solver.relaxation: {relaxation:g} is near the bound of plane waves, {bound:.4g}"
        return [f"{message}, and at edges without a frame the bound can be up to 10 % lower"]


ACCURACY = 1e-2
"""Relative accuracy of solutions."""
CLOSE = 1e-3
"""Inverse iteration ends if the relative change of the slowness 1 / (1 - λ) is smaller than this
number."""

MAX_ITERATIONS = 8
"""Largest number of inverse iterations."""
LARGE_BODY = 200_000
"""Number of particles above which the slowest mode on coarse grids is accurate enough."""
BYTES_PER_PARTICLE = 500
"""Number of bytes of memory per particle that the estimate requires, measured for 1000 × 1000
particles."""


class StabilityEstimate:
    """Estimate the spectrum of one scene at rest, on the grids of a multigrid solver."""

    NEEDS = (
        "multigrid requires leaders that constrain the whole body, bonds to adjacent cells only "
        "and a frame without delay"
    )
    """Conditions of the estimate."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._systems: dict[tuple[bool, ...], LatticeSystem | None] = {}

    def system(self, step: int) -> LatticeSystem | None:
        """Return the equilibrium system with the roles of a step.

        It is None if leaders do not constrain the body, or if its lattice, bonds or rule need a
        matrix.
        """
        roles = tuple(leading.group.leads(step) for leading in self._scene.leading)
        if roles not in self._systems:
            self._systems[roles] = self._build(step)
        return self._systems[roles]

    def _build(self, step: int) -> LatticeSystem | None:
        if self.obstacle:
            return None
        from pbdkit.equilibrium.lattice_system import lattice_system

        return lattice_system(self._scene, self.at_rest, step, Watch())

    @cached_property
    def at_rest(self) -> State:
        """Return the initial state with all displacements set to zero. In this state, particles
        with equal neighbourhoods have the same response."""
        state = initial_state(self._scene)
        return replace(state, u=np.zeros_like(state.u))

    @property
    def obstacle(self) -> str:
        """Return the reason why no estimate is possible, or an empty string."""
        if self._scene.experiment.neighbours.nearness():
            return "neighbours are re-evaluated at every step"
        if not find_spec("numba"):
            return "a body of this size requires numba: pip install 'pbdkit[fast]'"
        if self._scene.raster.count * BYTES_PER_PARTICLE > machine_memory():
            return "there is too little memory for a body of this size"
        return ""

    def slowest(self) -> SlowMode | None:
        """Compute the slowest mode of the steps, with the roles of the last step."""
        system = self.system(self._scene.experiment.steps)
        if system is None:
            return None
        mode = system.slowest()
        if self._scene.raster.count > LARGE_BODY:
            return mode
        for _ in range(MAX_ITERATIONS):
            slowness = mode.slowness
            try:
                mode = mode.improved(system, ACCURACY)
            except StagnationError:
                return None
            if abs(mode.slowness - slowness) <= CLOSE * slowness:
                break
        return mode

    @cached_property
    def spectrum(self) -> Spectrum | None:
        """Estimate both ends of the spectrum of the rule's own step, if it is real."""
        if self._scene.frame_delay:
            return None
        waves = wave_bound(self._scene)
        if waves is None or waves.imaginary > 1e-9:
            return None
        mode, system = self.slowest(), self.system(self._scene.experiment.steps)
        if mode is None or system is None:
            return None
        relative_slowness = self._scene.experiment.stepping.relaxation * mode.slowness
        largest = 1.0 - 1.0 / relative_slowness
        # A constrained body has no modes that change their sign in every step.
        smallest = (
            max(waves.smallest, -largest) if waves.smallest >= -1.0 - NEUTRAL else waves.smallest
        )
        return spectrum_of(np.array([smallest, largest], complex), system.bound_kind == "energy")


def verdict_of(found: Any) -> list[tuple[str, str]]:
    """Return the results of an Analysis or a Forecast about stability, as pairs of name and
    text."""
    if found.spectral_radius is None:
        return [("stability", "not known for this scene")]
    near = "" if found.exact else ", linearised at the start"
    near += ", estimated" if found.estimated else ""
    verdict = "stable" if found.stable else "not stable"
    rows = [("stability", f"{verdict}: spectral radius {found.spectral_radius:.9g}{near}")]
    steps = ", ".join(f"to {t} in {n}" for t, n in found.steps_to.items() if n is not None)
    if steps:
        rows.append(("converges", f"{steps} steps"))
    if (bound := found.largest_stable_relaxation) is not None:
        rows.append(("relaxation", f"stable below {bound:.6g}"))
    return rows
