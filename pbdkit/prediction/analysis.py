"""What an experiment will do: stable or not, how fast it settles, what stands in its way."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from typing import Any

import numpy as np

from pbdkit.analysis.couplings import Entries, connected
from pbdkit.analysis.operator import StepOperator
from pbdkit.analysis.spectrum import (
    NEUTRAL,
    Spectrum,
    Swing,
    just_below,
    largest_stable_relaxation,
    modes,
    slowest_swing,
    swings_below,
)
from pbdkit.analysis.stencil import NO_REMEDY, bounds_the_body
from pbdkit.equilibrium.system import System
from pbdkit.interfaces import Anchors
from pbdkit.prediction.lag import Lag, fastest, lag_of
from pbdkit.prediction.spectra import Spectra
from pbdkit.results.progress import Watch
from pbdkit.scene.scene import Scene
from pbdkit.stepping.state import initial_state

TOLERANCES = ("1e-3", "1e-6", "1e-10")
NEAR = 0.9


@dataclass(frozen=True)
class Analysis:
    """What is known before the first step, of the roles of the last step and linearised at the
    start: exact for linear rules. Numbers are None where they do not exist or cost too much."""

    scene: Scene

    def __repr__(self) -> str:
        """Its experiment alone: the scene has more than anybody reads, the verdict takes time."""
        return f"<pbdkit.Analysis of {self.scene.experiment.name}>"

    def _repr_html_(self) -> str:
        """What a notebook shows: the verdict, and the eigenvalues in a few numbers."""
        return str(import_module("pbdkit.drawing.notebook").analysis_html(self))

    @property
    def exact(self) -> bool:
        """Whether the numbers hold for the whole run: the rule declares itself linear, and neither
        bonds nor neighbours, contacts nor numbers change."""
        experiment = self.scene.experiment
        changes = self.scene.has_fracture or self.scene.barriers or experiment.courses
        return experiment.rule.linear and not changes and not experiment.neighbours.nearness()

    @cached_property
    def spectra(self) -> Spectra:
        """Where the eigenvalues come from."""
        return Spectra(self.scene.bare)

    @property
    def operator(self) -> StepOperator:
        """The step operator, two unknowns a follower."""
        return self.spectra.operator

    @property
    def spectrum(self) -> Spectrum | None:
        """Of the step as the solver makes it, with relaxation, memory and lag."""
        return self.spectra.spectrum

    @property
    def estimated(self) -> bool:
        """Whether the spectrum is an estimate, as of large bodies: 1 - ρ within 1 %."""
        return self.spectra.estimated

    @property
    def left_out(self) -> list[str]:
        """What is not known because it would take too long, and why."""
        found, solver = self.spectra.left_out, self.scene.experiment.stepping
        if not self.estimated:
            return found
        if solver.memory > 0.0 and self.swing(solver.relaxation, solver.memory) is None:
            found.append(
                "analysis: the period is left out, a body of this size has many modes between "
                "those that creep back and those that swing"
            )
        moves = self.scene.experiment.solver.makes_steps and fastest(self.scene).speed > 0.0
        if moves and self.stable and self.trailing is None:
            found.append(
                "analysis: the lag is left out, in their fastest steps leaders do not hold the body"
            )
        return found

    @property
    def spectral_radius(self) -> float | None:
        """max |λ|."""
        return self.spectrum.radius if self.spectrum else None

    @property
    def smallest_eigenvalue(self) -> float | None:
        """min Re λ of the rule's own step."""
        return self.spectra.of_rule.smallest if self.spectra.of_rule else None

    @property
    def largest_stable_relaxation(self) -> float | None:
        """The relaxation below which all modes shrink, with the memory as it is:
        2 (1 + b) / (1 - λ_min) for real eigenvalues."""
        own, memory = self.spectra.of_rule, self.scene.experiment.stepping.memory
        return largest_stable_relaxation(own.eigenvalues, memory) if own else None

    @property
    def best_memory(self) -> float | None:
        """(1 - √(1 - ρ))², the memory that settles fastest without relaxation, for 0 ≤ ρ < 1."""
        own = self.spectra.of_rule
        if own is None or not own.symmetric or not 0.0 <= own.largest < 1.0:
            return None
        return (1.0 - math.sqrt(1.0 - own.largest)) ** 2

    @property
    def stable(self) -> bool | None:
        """Whether no mode grows."""
        return self.spectrum.radius <= 1.0 + NEUTRAL if self.spectrum else None

    def stable_at(self, relaxation: float, memory: float) -> bool | None:
        """Whether no mode grows with that relaxation and memory in place of the experiment's.

        None where the rule's own eigenvalues are not known: the frame lags, neighbours are found
        anew, the body is too large."""
        own = self.spectra.of_rule
        if own is None:
            return None
        found = modes(own.eigenvalues, relaxation, memory)
        return bool(np.abs(found).max(initial=0.0) <= 1.0 + NEUTRAL)

    def swing(self, relaxation: float, memory: float) -> Swing | None:
        """The slowest swinging mode with that relaxation and memory: 2π / arg μ in steps, and |μ|,
        √memory for real eigenvalues. None where no mode swings, or as for `stable_at`."""
        own = self.spectra.of_rule
        if own is None:
            return None
        known = own.eigenvalues
        if self.estimated and own.largest > swings_below(relaxation, memory):
            return None
        if 0.0 < memory < 1.0 and own.largest > (edge := swings_below(relaxation, memory)):
            # The slowest modes creep back. Of large groups, those that just swing are not known.
            try:
                known = np.append(known, just_below(self.spectra.rule_matrix(), edge))
            except RuntimeError:  # too dear, or not found by ARPACK
                return None
        return slowest_swing(modes(known, relaxation, memory))

    @property
    def steps_to(self) -> dict[str, int | None]:
        """ln(tolerance) / ln ρ: the steps after which the slowest mode has shrunk to that."""
        radius = self.spectral_radius
        if radius is None or radius >= 1.0 - 1e-14 or radius == 0.0:
            return dict.fromkeys(TOLERANCES, 1 if radius == 0.0 else None)
        return {t: math.ceil(math.log(float(t)) / math.log(radius)) for t in TOLERANCES}

    @cached_property
    def trailing(self) -> Lag | None:
        """How far the body trails its equilibrium in the fastest steps of its leaders.

        None where no leader moves steadily, steps do not settle or are not made, or it would cost
        too much."""
        if not (self.scene.experiment.solver.makes_steps and self.stable):
            return None
        if self.estimated:
            found = self.spectra.estimate
            return lag_of(self.scene, found.at_rest, found.system, self._slowness)
        state = initial_state(self.scene)

        def system_at(step: int) -> System:
            from pbdkit.equilibrium.linearisation import linearised

            return linearised(self.scene.bare, state, step, "auto", Watch())

        return lag_of(self.scene, state, system_at, self._slowness)

    @property
    def _slowness(self) -> float:
        """1 / (1 - λ) of the slowest mode that fades, without memory."""
        assert self.spectrum
        own = self.spectra.of_rule or self.spectrum
        fading = 1.0 - own.eigenvalues.real
        relaxation = self.scene.experiment.stepping.relaxation
        return float(1.0 / (relaxation * fading[fading > NEUTRAL].min(initial=1.0)))

    @property
    def lag(self) -> float | None:
        """By how much the follower farthest behind trails its equilibrium in the fastest steps of
        the leaders, once that has become steady, in lattice units."""
        return self.trailing.steady if self.trailing else None

    @cached_property
    def parts_without_leader(self) -> list[Any]:
        """The numbers of the particles of each part that no leader reaches."""
        if not self.spectra.has_matrix:
            return []
        operator = self.operator
        both = operator.couplings_both.entries()
        graph = Entries(both.rows, both.columns, np.ones(len(both.rows)), both.shape)
        count, label = connected(graph.matrix(), strongly=False)
        led = np.zeros(count, bool)
        led[label[np.append(operator.couplings_led.entries().rows, operator.held)]] = True
        numbers = operator.followers[np.arange(len(label)) // self.scene.axes] + 1
        parts = {tuple(np.unique(numbers[label == n]).tolist()) for n in np.flatnonzero(~led)}
        return sorted(parts)

    def warnings(self) -> list[str]:
        """What stands in the way of settling, with the remedy, and what is left out."""
        return [*self.obstructions(), *self.left_out]

    def obstructions(self) -> list[str]:
        """What stands in the way of settling, with the remedy."""
        anchored = self.scene.frame is not None and isinstance(self.scene.experiment.frame, Anchors)
        parts = [] if anchored or self.scene.barriers else self.parts_without_leader
        said = "leaders: none reaches a part of {} particles (with number {}): nothing holds it"
        found = [said.format(len(part), part[0]) for part in parts]
        if len(parts) > 3:
            found = [f"leaders: none reaches {len(parts)} parts of the body; nothing holds them"]
        bond = min(min(lengths) for lengths in self.scene.neighbourhood.shells())
        late = self.trailing.late(bond, self.scene.experiment.units) if self.trailing else []
        return [*found, *self._growth(), *self._edges_near_the_bound(), *late]

    def _growth(self) -> list[str]:
        """A warning where modes grow, or never decay."""
        if not self.scene.experiment.solver.makes_steps and self.largest_stable_relaxation:
            return []  # steps with that relaxation would lead there too
        if self.stable is False:
            bound = self.largest_stable_relaxation
            remedy = f"; it is stable below {bound:.4g}" if bound else NO_REMEDY
            return [
                f"solver.relaxation: {self.scene.experiment.stepping.relaxation:g} diverges, the "
                f"spectral radius is {self.spectral_radius:.6g}{remedy}"
            ]
        if self.spectrum and self.spectrum.smallest <= -1.0 + NEUTRAL:
            return [
                "solver.relaxation: a mode that changes its sign in every step never decays; take "
                "a relaxation below 1"
            ]
        return []

    def _edges_near_the_bound(self) -> list[str]:
        """A warning where the bound is that of waves and free edges may have a lower one."""
        frame, bound = self.scene.experiment.frame, self.largest_stable_relaxation
        bare = not bounds_the_body(self.scene) and not frame.weighs_cells
        relaxation = self.scene.experiment.stepping.relaxation
        if not (self.estimated and bare and bound and NEAR * bound < relaxation < bound):
            return []
        near = f"solver.relaxation: {relaxation:g} is near the bound of plane waves, {bound:.4g}"
        return [f"{near}, and edges without a frame may have one up to 10 % lower"]
