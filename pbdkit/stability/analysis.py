"""Stability analysis of an experiment: spectrum of its step operator, rate of convergence, and what
limits both.

Where the step operator is too large for a matrix, the slowest mode is found by inverse iteration on
ever finer grids, with multigrid on the lattice's stencils: 1 - λ is found within 1 %. The smallest
eigenvalue is that of plane waves; where no frame surrounds the body, edges may have some beyond it.
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
from pbdkit.equilibrium.system import StuckError, System, one_thread
from pbdkit.linear.operator import StepOperator, step_operator
from pbdkit.linear.spectrum import (
    NEUTRAL,
    Entries,
    Spectrum,
    Swing,
    connected,
    excess,
    just_below,
    largest_stable_relaxation,
    modes,
    slowest_swing,
    spectrum,
    spectrum_of,
    swings_below,
)
from pbdkit.linear.stencil import NO_REMEDY, bounds_the_body, wave_bound
from pbdkit.memory import machine_memory
from pbdkit.plugin import Anchors
from pbdkit.progress import Watch
from pbdkit.scene.memory_estimate import LARGEST_ANEW
from pbdkit.scene.scene import Scene
from pbdkit.stability.lag import Lag, fastest, lag_of
from pbdkit.stepping.state import State, initial_state

if TYPE_CHECKING:
    from pbdkit.equilibrium.lattice_system import LatticeSystem


@dataclass(frozen=True)
class Spectra:
    """Of one scene, with the roles of the last step, linearised at the start."""

    scene: Scene

    @cached_property
    def operator(self) -> StepOperator:
        """The step operator, two unknowns a follower."""
        return step_operator(self.scene)

    @cached_property
    def estimate(self) -> StabilityEstimate:
        """Of what has no matrix, or one that is too large."""

        return StabilityEstimate(self.scene)

    @cached_property
    def spectrum(self) -> Spectrum | None:
        """Of the step as the solver makes it, with relaxation, memory and lag."""
        own, solver = self.of_rule, self.scene.experiment.stepping
        if own is None:
            return self._spectrum_of(lambda: self.operator.augmented().matrix(), self.scene.lag > 0)
        if solver.relaxation == 1.0 and solver.memory == 0.0:
            return own
        # Radius and ends of what it is taken to are met at the ends of a real spectrum.
        found = modes(own.eigenvalues, solver.relaxation, solver.memory)
        return spectrum_of(found, own.symmetric and solver.memory == 0.0)

    @property
    def has_matrix(self) -> bool:
        """Whether there is an operator, and it is small enough to be looked at."""
        return not (self.scene.experiment.neighbours.nearness() or excess(self.scene))

    @property
    def left_out(self) -> list[str]:
        """What is not known because it would take too long, and why."""
        if self.spectrum:
            return []
        why, too_many = self.estimate.obstacle, excess(self.scene)
        if too_many and not why:
            why = f"{too_many} for a matrix, and {self.estimate.NEEDS}"
        elif not why:
            why = "eigenvalues lie too close together, as in long bodies; a shorter one shows more"
        too = "parts that no leader reaches too: " if too_many else ""
        return [f"analysis: the spectrum and the lag are left out, {too}{why}"]

    @property
    def of_rule(self) -> Spectrum | None:
        """Of the rule's own step, with neither relaxation nor memory; None where the frame lags."""
        return self._found[0]

    @property
    def estimated(self) -> bool:
        """Whether that is an estimate."""
        return self._found[1]

    @cached_property
    def _found(self) -> tuple[Spectrum | None, bool]:
        """Large bodies are estimated sooner, where that can be, as they are solved."""
        large = self.scene.raster.count > LARGEST_ANEW
        if large and (found := self.estimate.spectrum):
            return found, True
        if found := self._spectrum_of(self.rule_matrix, self.scene.lag == 0):
            return found, False
        found = None if large else self.estimate.spectrum
        return found, found is not None

    def _spectrum_of(self, matrix: Callable[[], Any], asked: bool) -> Spectrum | None:
        """None where it is not asked for, cannot be had, or not soon."""
        if not asked or not self.has_matrix:
            return None
        try:
            with one_thread():
                return spectrum(matrix())
        except RuntimeError:  # too dear, or not found by ARPACK
            return None

    def rule_matrix(self) -> Any:
        """The rule's own step. With no lag `before` is -b where particles move, so that the sum has
        no memory left."""
        both = self.operator.couplings_both.entries()
        share, every = 1.0 / self.scene.experiment.stepping.relaxation, np.arange(both.shape[0])
        rest = Entries(every, every, np.full(len(every), 1.0 - share), both.shape)
        return rest.plus(both, share).without(self.operator.held).matrix()


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
        return str(import_module("pbdkit.plotting.notebook").analysis_html(self))

    @property
    def exact(self) -> bool:
        """Whether the numbers hold for the whole run: the rule declares itself linear, and neither
        bonds nor neighbours, contacts nor numbers change."""
        experiment = self.scene.experiment
        scene = self.scene
        changes = scene.has_fracture or scene.barriers or scene.operations or experiment.courses
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
        if types := dict.fromkeys(f"'{one.operation.type}'" for one in self.scene.operations):
            found.append(
                f"operations: the analysis leaves out {', '.join(types)}; eigenvalues, steps and "
                "lag are those of the rule alone"
            )
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
            from pbdkit.equilibrium.linearise import linearised

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


ACCURACY = 1e-2
"""Of solutions, relative."""
CLOSE, MOST_TURNS = 1e-3, 8
"""Relative change of the slowness at which inverse iteration ends, and its turns at most."""
MANY = 200_000
"""Particles from which on coarser grids are fine enough for the slowest mode."""
BYTES = 500
"""Of memory a particle (measured at 1000 × 1000)."""


class StabilityEstimate:
    """Of one scene, linearised at rest."""

    NEEDS = (
        "grids serve only where leaders hold the whole body, bonds lead to the cells beside and "
        "the frame does not lag"
    )

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._systems: dict[tuple[bool, ...], LatticeSystem | None] = {}

    def system(self, step: int) -> LatticeSystem | None:
        """With the roles of a step; None where leaders do not hold the body, or its lattice, bonds
        or rule need a matrix."""
        roles = tuple(leading.group.leads(step) for leading in self._scene.leading)
        if roles not in self._systems:
            self._systems[roles] = self._made(step)
        return self._systems[roles]

    def _made(self, step: int) -> LatticeSystem | None:
        if self.obstacle:
            return None
        from pbdkit.equilibrium.lattice_system import lattice_system

        return lattice_system(self._scene, self.at_rest, step, Watch())

    @cached_property
    def at_rest(self) -> State:
        """The start with nothing displaced: all that has the same neighbours is alike."""
        state = initial_state(self._scene)
        return replace(state, u=np.zeros_like(state.u))

    @property
    def obstacle(self) -> str:
        """Why nothing is tried; empty where it is."""
        if self._scene.experiment.neighbours.nearness():
            return "neighbours are found anew in every step"
        if not find_spec("numba"):
            return "for a body of this size numba is needed: pip install 'pbdkit[fast]'"
        if self._scene.raster.count * BYTES > machine_memory():
            return "for a body of this size there is too little memory"
        return ""

    def slowest(self) -> SlowMode | None:
        """The slowest mode of the steps, with the roles of the last."""
        system = self.system(self._scene.experiment.steps)
        if system is None:
            return None
        mode = system.slowest()
        if self._scene.raster.count > MANY:
            return mode
        for _ in range(MOST_TURNS):
            before = mode.slowness
            try:
                mode = mode.improved(system, ACCURACY)
            except StuckError:
                return None
            if abs(mode.slowness - before) <= CLOSE * before:
                break
        return mode

    @cached_property
    def spectrum(self) -> Spectrum | None:
        """Both ends of that of the rule's own step, where it is real."""
        if self._scene.lag:
            return None
        waves = wave_bound(self._scene)
        if waves is None or waves.imaginary > 1e-9:
            return None
        mode, system = self.slowest(), self.system(self._scene.experiment.steps)
        if mode is None or system is None:
            return None
        share = self._scene.experiment.stepping.relaxation * mode.slowness
        largest = 1.0 - 1.0 / share
        # Of waves that change their sign in every step a held body has none.
        smallest = (
            max(waves.smallest, -largest) if waves.smallest >= -1.0 - NEUTRAL else waves.smallest
        )
        return spectrum_of(np.array([smallest, largest], complex), system.how == "energy")
