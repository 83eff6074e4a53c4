"""Specimens of one experiment, torn one after the other: each has a seed of its own."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import chain

from pbdkit.equilibrium.increments import increments
from pbdkit.equilibrium.load_path import moments
from pbdkit.experiment.given import given_classes
from pbdkit.experiment.model import Experiment
from pbdkit.experiment.settings import with_value
from pbdkit.experiment.solvers import Equilibrium
from pbdkit.fitting.first_break import Elastic, Pull, Seen, bond_strains, strengths
from pbdkit.fitting.sensitivity import scene_like
from pbdkit.fitting.strength_specification import Peaks
from pbdkit.interfaces import BreaksAtStrain, Softens
from pbdkit.results.progress import Watch
from pbdkit.results.tables import Tables
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stepping.prescription import place, prescribe
from pbdkit.stepping.state import Floats, State, initial_state, unmoved_state

LOST = 0.5
"""The share of its peak below which a specimen that bears no more has failed."""


@dataclass(frozen=True)
class Specimen:
    """What was seen of one at its peak, and when its first bond broke (None where one equilibrium
    does not tell), and whether it failed."""

    peak: Seen
    first: Seen | None
    failed: bool

    def peak_of(self, of: str) -> float:
        """Force or displacement at the peak."""
        return self.peak.force if of == "force" else self.peak.displacement

    def first_of(self, of: str) -> float:
        """Force or displacement at the first break."""
        assert self.first is not None
        return self.first.force if of == "force" else self.first.displacement


@dataclass(frozen=True)
class Specimens:
    """Where they come from: the scene of an experiment, and its equilibrium before anything breaks,
    if it is known."""

    scene: Scene
    peaks: Peaks
    elastic: Elastic | None

    @classmethod
    def of(cls, experiment: Experiment, peaks: Peaks, elastic: Elastic | None) -> Specimens:
        """Torn by the experiment's solver, or in increments. Raises ExperimentError."""
        if experiment.solver.makes_steps:
            experiment = experiment.model_copy(update={"solver": Equilibrium()})
        return cls(build_scene(experiment), peaks, elastic)

    def torn(self, experiment: Experiment) -> Specimen:
        """One of an experiment that is like that of the scene but for its numbers and its seed,
        until it has lost half of what it bore. Between two increments its load grows in proportion
        until the next bond breaks."""
        scene = scene_like(self.scene, experiment)
        state, tables = initial_state(scene), Tables(scene)
        limits = strengths(scene, state) if self._tells_breaks else None
        first = None if limits is None else self._first(limits)
        since = self._whole_until(state, first) if first else 0.0
        pull = self.elastic.pull if self.elastic else None
        top, before, grows = first or Seen(0.0, 0.0), Seen(0.0, 0.0), 1.0
        for _ in chain(increments(scene, state, Watch(), since), [None]):
            pull = pull or Pull.of(scene, state, self.peaks)
            seen = pull.seen(tables, state)
            if grows > 1.0 and before.displacement > 0.0:
                share = min(grows, seen.displacement / before.displacement)
                top = max(top, Seen(share * before.force, share * before.displacement))
            top = max(top, seen) if seen.displacement > (first or seen).displacement else top
            if seen.force < LOST * top.force and seen.displacement >= top.displacement:
                return Specimen(top, first, True)
            before = seen
            if limits is not None:
                grows = float(bond_strains(scene, state).load_at(limits).min())
        return Specimen(top, first, first is not None and top.displacement < before.displacement)

    @property
    def _tells_breaks(self) -> bool:
        model = self.scene.experiment.fracture
        tells = isinstance(model, BreaksAtStrain) and not isinstance(model, Softens)
        return tells and self.elastic is not None

    def _whole_until(self, state: State, first: Seen) -> float:
        """Takes a state to the last increment before its first bond breaks, and returns its moment:
        on the way there nothing but the load changes."""
        assert self.elastic is not None
        before = [(m, share) for m, share in self._way if share * self.elastic.full.displacement
                  < first.displacement]  # fmt: skip
        if not before:
            return 0.0
        moment, share = before[-1]
        _, state.starts = prescribe(self.scene, state, moment)
        state.u[...] = state.previous[...] = share * self.elastic.u
        state.step = math.floor(moment)
        return moment

    @cached_property
    def _way(self) -> list[tuple[float, float]]:
        """The ends of increments but the last, and the share of the load there."""
        assert self.elastic is not None
        assert self.elastic.pull is not None
        count, found = self.scene.experiment.solver.sought.increments, []
        for moment in moments(self.scene, count)[:-1]:
            state = unmoved_state(self.scene, self.scene.raster.shape[1:])
            led, _ = prescribe(self.scene, state, moment)
            place(state.u, led)
            moved = self.elastic.pull.moved(self.scene, state)
            found.append((moment, moved / self.elastic.full.displacement))
        return found

    def _first(self, limits: Floats) -> Seen:
        """Bond by bond, in their order: exact."""
        assert self.elastic is not None
        share = float(self.elastic.strains.load_at(limits).min())
        return Seen(share * self.elastic.full.force, share * self.elastic.full.displacement)


def seeded(experiment: Experiment, seed: int) -> Experiment:
    """The experiment with another seed: strengths and random fields are drawn anew."""
    varies = any(getattr(part, "varying", None) for part in (experiment.rule, experiment.fracture))
    if not varies:
        return experiment.model_copy(update={"seed": seed})
    source = experiment.as_written()
    source = with_value(source, "seed", seed, "the seed of a specimen", Experiment.defaults())
    return Experiment.build(source, given_classes(experiment))
