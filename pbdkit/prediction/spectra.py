"""The spectra of a scene's step: of its matrix where that is small, else an estimate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.analysis.couplings import Entries
from pbdkit.analysis.operator import StepOperator, step_operator
from pbdkit.analysis.spectrum import Spectrum, excess, modes, spectrum, spectrum_of
from pbdkit.equilibrium.system import one_thread
from pbdkit.scene.scene import Scene
from pbdkit.scene.solver_sizes import LARGEST_ANEW

if TYPE_CHECKING:
    from pbdkit.prediction.estimate import Estimate


@dataclass(frozen=True)
class Spectra:
    """Of one scene, with the roles of the last step, linearised at the start."""

    scene: Scene

    @cached_property
    def operator(self) -> StepOperator:
        """The step operator, two unknowns a follower."""
        return step_operator(self.scene)

    @cached_property
    def estimate(self) -> Estimate:
        """Of what has no matrix, or one that is too large."""
        from pbdkit.prediction.estimate import Estimate  # of large bodies alone

        return Estimate(self.scene)

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
