"""What an experiment will do: stable or not, how fast it settles, what stands in its way."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pbdkit.analysis.couplings import Entries, connected
from pbdkit.analysis.lag import Lag, lag_of
from pbdkit.analysis.operator import StepOperator, step_operator
from pbdkit.analysis.spectrum import (
    NEUTRAL,
    Spectrum,
    Swing,
    excess,
    just_below,
    largest_stable_relaxation,
    modes,
    slowest_swing,
    spectrum,
    spectrum_of,
    swings_below,
)
from pbdkit.interfaces import Anchors
from pbdkit.scene.scene import Scene

TOLERANCES = ("1e-3", "1e-6", "1e-10")
NO_REMEDY = "; no relaxation helps: look at the rule, and keep |memory| below 1"


@dataclass(frozen=True)
class Analysis:
    """What is known before the first step, of the roles of the last step and linearised at the
    start: exact for linear rules. Numbers are None where they do not exist or cost too much."""

    scene: Scene

    @property
    def exact(self) -> bool:
        """Whether the numbers hold for the whole run, and not near its start alone: the rule
        declares itself linear, and neither bonds nor neighbours change."""
        experiment = self.scene.experiment
        lasting = not self.scene.has_fracture and experiment.neighbours.nearness() is None
        return experiment.rule.linear and lasting

    @cached_property
    def operator(self) -> StepOperator:
        """The step operator, two unknowns a follower."""
        return step_operator(self.scene)

    @cached_property
    def spectrum(self) -> Spectrum | None:
        """Of the step as the solver makes it, with relaxation, memory and lag."""
        own, solver = self._rule_spectrum, self.scene.experiment.stepping
        if own is None:
            return self._spectrum_of(lambda: self.operator.augmented().matrix(), self.scene.lag > 0)
        if solver.relaxation == 1.0 and solver.memory == 0.0:
            return own
        # Radius and ends of what it is taken to are met at the ends of a real spectrum.
        found = modes(own.eigenvalues, solver.relaxation, solver.memory)
        return spectrum_of(found, own.symmetric and solver.memory == 0.0)

    @property
    def _within_reach(self) -> bool:
        """Whether there is an operator, and it is small enough to be looked at."""
        return not (self.scene.experiment.neighbours.nearness() or excess(self.scene))

    @property
    def left_out(self) -> list[str]:
        """What is not known because it would take too long."""
        why = ""
        if too_many := excess(self.scene):
            why = f"parts that no leader reaches too: the body is too large, {too_many}"
        elif self._within_reach and self.spectrum is None:
            why = "eigenvalues lie too close together, as in long bodies; a shorter one shows more"
        return [f"analysis: the spectrum and the lag are left out, {why}"] if why else []

    @cached_property
    def _rule_spectrum(self) -> Spectrum | None:
        """Of the rule's own step, with neither relaxation nor memory; None where the frame lags."""
        return self._spectrum_of(self._rule_matrix, self.scene.lag == 0)

    def _spectrum_of(self, matrix: Callable[[], Any], asked: bool) -> Spectrum | None:
        """None where it is not asked for, cannot be had, or not soon."""
        if not asked or not self._within_reach:
            return None
        try:
            return spectrum(matrix())
        except RuntimeError:  # too dear, or not found by ARPACK
            return None

    def _rule_matrix(self) -> Any:
        """The rule's own step. With no lag `before` is -b where particles move, so that the sum has
        no memory left."""
        both = self.operator.couplings_both.entries()
        share, every = 1.0 / self.scene.experiment.stepping.relaxation, np.arange(both.shape[0])
        rest = Entries(every, every, np.full(len(every), 1.0 - share), both.shape)
        return rest.plus(both, share).matrix()

    @property
    def spectral_radius(self) -> float | None:
        """max |λ|."""
        return self.spectrum.radius if self.spectrum else None

    @property
    def smallest_eigenvalue(self) -> float | None:
        """min Re λ of the rule's own step."""
        return self._rule_spectrum.smallest if self._rule_spectrum else None

    @property
    def largest_stable_relaxation(self) -> float | None:
        """The relaxation below which all modes shrink, with the memory as it is:
        2 (1 + b) / (1 - λ_min) for real eigenvalues."""
        own, memory = self._rule_spectrum, self.scene.experiment.stepping.memory
        return largest_stable_relaxation(own.eigenvalues, memory) if own else None

    @property
    def best_memory(self) -> float | None:
        """(1 - √(1 - ρ))², the memory that settles fastest without relaxation, for 0 ≤ ρ < 1."""
        own = self._rule_spectrum
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
        own = self._rule_spectrum
        if own is None:
            return None
        found = modes(own.eigenvalues, relaxation, memory)
        return bool(np.abs(found).max(initial=0.0) <= 1.0 + NEUTRAL)

    def swing(self, relaxation: float, memory: float) -> Swing | None:
        """The slowest swinging mode with that relaxation and memory: 2π / arg μ in steps, and |μ|,
        √memory for real eigenvalues. None where no mode swings, or as for `stable_at`."""
        own = self._rule_spectrum
        if own is None:
            return None
        known = own.eigenvalues
        if 0.0 < memory < 1.0 and own.largest > (edge := swings_below(relaxation, memory)):
            # The slowest modes creep back. Of large groups, those that just swing are not known.
            try:
                known = np.append(known, just_below(self._rule_matrix(), edge))
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
        makes_steps = self.scene.experiment.solver.makes_steps
        return lag_of(self.scene) if makes_steps and self._within_reach and self.stable else None

    @property
    def lag(self) -> float | None:
        """By how much the follower farthest behind trails its equilibrium in the fastest steps of
        the leaders, once that has become steady, in lattice units."""
        return self.trailing.steady if self.trailing else None

    @cached_property
    def parts_without_leader(self) -> list[Any]:
        """The numbers of the particles of each part that no leader reaches."""
        if not self._within_reach:
            return []
        operator = self.operator
        both = operator.couplings_both.entries()
        graph = Entries(both.rows, both.columns, np.ones(len(both.rows)), both.shape)
        count, label = connected(graph.matrix(), strongly=False)
        led = np.zeros(count, bool)
        led[label[operator.couplings_led.entries().rows]] = True
        numbers = operator.followers[np.arange(len(label)) // self.scene.axes] + 1
        parts = {tuple(np.unique(numbers[label == n]).tolist()) for n in np.flatnonzero(~led)}
        return sorted(parts)

    def warnings(self) -> list[str]:
        """What stands in the way of settling, with the remedy."""
        anchored = self.scene.frame is not None and isinstance(self.scene.experiment.frame, Anchors)
        parts = [] if anchored else self.parts_without_leader
        found = [
            f"leaders: none reaches a part of {len(part)} particles (with number {part[0]}): "
            "nothing holds it"
            for part in parts
        ]
        if len(parts) > 3:
            found = [f"leaders: none reaches {len(parts)} parts of the body; nothing holds them"]
        if not self.scene.experiment.solver.makes_steps and self.largest_stable_relaxation:
            pass  # it makes no steps, and steps with that relaxation would lead there too
        elif self.stable is False:
            bound = self.largest_stable_relaxation
            remedy = f"; it is stable below {bound:.4g}" if bound else NO_REMEDY
            found.append(
                f"solver.relaxation: {self.scene.experiment.stepping.relaxation:g} diverges, the "
                f"spectral radius is {self.spectral_radius:.6g}{remedy}"
            )
        elif self.spectrum and self.spectrum.smallest <= -1.0 + NEUTRAL:
            found.append(
                "solver.relaxation: a mode that changes its sign in every step never decays; take "
                "a relaxation below 1"
            )
        bond = min(min(lengths) for lengths in self.scene.neighbourhood.shells())
        late = self.trailing.late(bond) if self.trailing else []
        return [*found, *late, *self.left_out]
