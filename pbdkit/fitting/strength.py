"""Strength of bonds and its scatter, fitted to repeated tests.

The load of the first break is computed for bodies with displacements proportional to the load. Let
d be the difference between the displacements of the ends of a bond under the full load of the
experiment. With the coefficients p = r·d/|r|² and q = |d|²/|r|² the strain of the bond at the load
factor λ is ε(λ) = |r + λ d| / |r| - 1 = √(1 + 2 λ p + λ² q) - 1. It is a convex function of λ and 0
at λ = 0, so that the strain of a stretched bond increases with λ.

A specimen survives the load λ if all its bonds survive it. The probability is Π_b (1 - F(ε_b(λ))),
where F is the distribution of strengths. The likelihood of repeated tests can therefore be computed
without a run (weakest link: W. Weibull, J. Appl. Mech. 18 (1951) 293). The parameters are
transformed to a location μ and a scale σ, of ln strength for the Weibull distribution (μ = ln s, σ
= 1/m), and of strength for the uniform distribution. They have the prior density dμ dσ/σ, and the
likelihood is integrated. If all bonds have equal strains, the strengths of specimens also belong to
a location-scale family, and intervals from the integrated likelihood are exact for any number of
specimens (J. Berger, Statistical Decision Theory, 1985, section 6.6).

If specimens do not fail when their first bond breaks, a synthetic likelihood is used. Single
specimens are simulated, first with strengths from the whole range between the bounds, and then with
strengths for which the measurement is likely. Mean and spread of ln peak as functions of the
logarithms of the parameters are obtained by regression. They are compared with the mean of the
measured ln peaks and the logarithm of their standard deviation, which are approximately normal (S.
Wood, Nature 466 (2010) 1102).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from itertools import chain, combinations_with_replacement
from typing import Any, ClassVar, NamedTuple

import numpy as np
from scipy.special import gammainc, gammaincinv, gammaln

from pbdkit.array_types import Floats, Mask
from pbdkit.components.diagnostics import reactions
from pbdkit.equilibrium.load_stepping import finder_of, increments, moments
from pbdkit.equilibrium.system import one_thread
from pbdkit.errors import ExperimentError, no_such
from pbdkit.fitting.fit_file import Peaks, StrengthFit
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.problem import IDENTIFIABLE_RATIO
from pbdkit.fitting.sensitivity import scene_like
from pbdkit.io.snapshot import StateMoment, Tables
from pbdkit.lattice.raster import FOLLOWER, Places
from pbdkit.model.experiment import Experiment, given_classes
from pbdkit.model.reading import with_value
from pbdkit.model.solver import Equilibrium
from pbdkit.plugin import BreaksAtStrain, Calibrated, Softens
from pbdkit.progress import Watch
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stepping.leaders import place, prescribe
from pbdkit.stepping.state import State, initial_state, unmoved_state

PARTS = 4
"""Number of load increments after each of which displacements must be proportional to the load."""
MAX_NONPROPORTIONALITY = 1e-6
"""Largest deviation from proportionality, relative to the largest displacement."""

ALIKE = 1e-9
"""Largest difference between the coefficients p and q of bonds that are treated as equal.

It is relative to the largest p and q.
"""

NOT_PROPORTIONAL = (
    "the load of the first break does not follow from one equilibrium; use method: simulation"
)
"""End of messages about bodies of which the displacements are not proportional to the load."""


@dataclass(frozen=True)
class BondStrains:
    """Strains of bonds as functions of the load factor.

    Parameters
    ----------
    p, q : (bond,)
        Coefficients of the strain, see the docstring of the module.
    count : (bond,)
        Number of equal bonds that a row represents.
    """

    p: Floats
    q: Floats
    count: Floats

    def at(self, load: Floats) -> Floats:
        """Return the strains ε of shape (load, bond); 0 for compressed bonds."""
        x = load[:, None] * (2.0 * self.p + load[:, None] * self.q)
        return np.asarray(np.maximum(x, 0.0) / (np.sqrt(1.0 + np.maximum(x, 0.0)) + 1.0))

    def rate(self, load: Floats) -> Floats:
        """Return dε/dλ of shape (load, bond), where ε > 0."""
        return np.asarray((self.p + load[:, None] * self.q) / (1.0 + self.at(load)))

    def load_at(self, strain: Floats) -> Floats:
        """Return an array of shape (bond,) with the load factor at which each bond reaches a
        strain. It is infinite for bonds without strain."""
        x = strain * (2.0 + strain)
        with np.errstate(divide="ignore", invalid="ignore"):
            load = x / (self.p + np.sqrt(self.p**2 + self.q * x))
        return np.asarray(np.where(self.q > 0.0, load, np.inf))

    def merged(self) -> BondStrains:
        """Return the bonds that are strained at some load, with equal bonds merged."""
        strained = self.q > 0.0
        pq = np.stack([self.p[strained], self.q[strained]], axis=1)
        steps = np.round(pq / (ALIKE * np.abs(pq).max(axis=0)))
        _, first, group = np.unique(steps, axis=0, return_index=True, return_inverse=True)
        count = np.bincount(group.ravel(), self.count[strained]).astype(float)
        return BondStrains(pq[first, 0], pq[first, 1], count)


def bond_strains(scene: Scene, state: State) -> BondStrains:
    """Return the strains of the bonds of a scene as functions of the load, from a state under load.

    The strain of a bond that is broken or cannot break is 0 for all loads.
    """
    bonds, shape = scene.bonds, scene.raster.shape
    p, q = np.zeros((2, len(bonds.ends)))
    for n, plane in enumerate(scene.neighbourhood.planes):
        rows = np.flatnonzero(bonds.plane == n)
        places = Places(shape, bonds.place[rows] + plane.slot.source * int(np.prod(shape[1:])))
        d = places.seen_through(plane.slot).of(state.u) - places.of(state.u)
        rest = np.array(plane.slot.rest)
        p[rows] = rest @ d / (rest @ rest)
        q[rows] = (d**2).sum(axis=0) / (rest @ rest)
    can_break = np.ones(len(p), bool)
    if state.broken_step is not None:
        can_break = (
            state.broken_step.reshape(len(state.broken_step), -1)[bonds.plane, bonds.place] < 0
        )
    if not scene.experiment.fracture.breaks_frame_bonds():
        can_break &= (scene.raster.table_kind[bonds.ends] == FOLLOWER).all(axis=1)
    return BondStrains(np.where(can_break, p, 0.0), np.where(can_break, q, 0.0), np.ones(len(p)))


def strengths(scene: Scene, state: State) -> Floats:
    """Return the strain at which each bond breaks, (bond,).

    Raises
    ------
    ExperimentError
        If the fracture model does not define it.
    """
    model, bonds = scene.experiment.fracture, scene.bonds
    if not isinstance(model, BreaksAtStrain):
        raise ExperimentError(
            f"'{model.type}' defines no strain at which a bond breaks", ("fracture",)
        )
    limits = np.zeros(len(bonds.ends))
    for n, plane in enumerate(scene.neighbourhood.planes):
        rows = np.flatnonzero(bonds.plane == n)
        owner = Places(scene.raster.shape, bonds.place[rows])
        values = [owner.within(value[n]) for value in state.bond_values]
        c = scene.constants.of_bond(*scene.constants.limits_at(plane.slot, n, owner), *values)
        limits[rows] = model.breaking_strain(plane.slot.rest, c, scene.constants.fracture)
    return limits


def has_forces(scene: Scene) -> bool:
    """Return whether the rule of a scene defines forces."""
    return isinstance(scene.experiment.rule, Calibrated)


class MachineReading(NamedTuple):
    """Reading of a testing machine: force and displacement.

    The force is NaN if the rule does not define forces.
    """

    force: float
    displacement: float


@dataclass(frozen=True)
class LoadedGroup:
    """Leader group that loads a body.

    Parameters
    ----------
    group
        Index of the group.
    direction
        Unit vector of its displacement.
    factor
        Factor by which forces are multiplied.
    """

    group: int
    direction: Floats
    factor: float

    @classmethod
    def of(cls, scene: Scene, state: State, peaks: Peaks) -> LoadedGroup:
        """Return the selected group, or the one with the largest displacement.

        Raises
        ------
        ExperimentError
            If there is none, or if it does not move.
        """
        if not scene.leading:
            raise ExperimentError("there are no leaders that load the body", ("leaders",))
        displacements = np.stack([_mean(scene, state, n) for n in range(len(scene.leading))])
        size = np.hypot.reduce(displacements, axis=1)
        group = int(size.argmax()) if peaks.group is None else peaks.group
        if group >= len(displacements):
            text = no_such("leader group", group, len(displacements))
            raise ExperimentError(text, ("measured", "group"))
        if size[group] == 0.0:
            raise ExperimentError(
                f"leader group {group} does not move; use one that loads the body",
                ("measured", "group"),
            )
        return cls(
            group, displacements[group] / size[group], peaks.youngs_modulus * peaks.thickness
        )

    def read(self, tables: Tables, state: State) -> MachineReading:
        """Return the force on the group and its mean displacement, both along its direction."""
        reaction = np.full(len(self.direction), np.nan)
        if has_forces(tables.scene):
            reaction = reactions(StateMoment(state, tables))[self.group]
        return MachineReading(
            self.factor * float(self.direction @ reaction), self.displacement(tables.scene, state)
        )

    def displacement(self, scene: Scene, state: State) -> float:
        """Return the mean displacement of the group along its direction."""
        return float(self.direction @ _mean(scene, state, self.group))


def _mean(scene: Scene, state: State, group: int) -> Floats:
    place = scene.leading[group].place
    return np.asarray(state.u.reshape(scene.axes, -1)[:, place].mean(axis=1))


@dataclass(frozen=True)
class ElasticResponse:
    """A body before fracture, under the full load of the experiment.

    Parameters
    ----------
    strains
        Strains of the bonds.
    pull
        Leader group that loads it, if forces or displacements are measured.
    full
        Reading of the testing machine at the full load.
    u
        Displacements, as rasters.
    """

    strains: BondStrains
    pull: LoadedGroup | None
    full: MachineReading
    u: Floats

    @classmethod
    def of(cls, experiment: Experiment, peaks: Peaks) -> ElasticResponse:
        """Compute the equilibrium of an experiment under the assumption that no bond breaks.

        Raises
        ------
        ExperimentError
            If displacements are not proportional to the load.
        """
        experiment = experiment.model_copy(update={"solver": Equilibrium(increments=PARTS)})
        scene = build_scene(experiment)
        if scene.barriers:
            raise ExperimentError(
                "contacts with obstacles change with the load: " + NOT_PROPORTIONAL
            )
        state, displacements = initial_state(scene), list[Floats]()
        finder = finder_of(scene, state, compiles=False)
        for _ in increments(scene, state, Watch(), finder=finder):
            displacements.append(state.u.copy())
        _refuse_out_of_proportion(displacements, state.u, experiment.rule.linear)
        strains = bond_strains(scene, state)
        if peaks.of == "factor":
            return cls(strains, None, MachineReading(1.0, 1.0), state.u)
        pull = LoadedGroup.of(scene, state, peaks)
        return cls(strains, pull, pull.read(Tables(scene), state), state.u)


def _refuse_out_of_proportion(displacements: list[Floats], last: Floats, linear: bool) -> None:
    size, last_share = float(np.abs(last).max()), 0.0
    if size == 0.0:
        raise ExperimentError("nothing moves under the load of this experiment", ("leaders",))
    if not (displacements or linear):
        raise ExperimentError("the rule is not linear: " + NOT_PROPORTIONAL)
    for u in displacements:
        share = float((u * last).sum() / (last * last).sum())
        deviation = float(np.abs(u - share * last).max()) / size
        if deviation > MAX_NONPROPORTIONALITY or share < last_share:
            raise ExperimentError(
                f"displacements are not proportional to the load ({deviation:.2g} off): "
                + NOT_PROPORTIONAL
            )
        last_share = share


FAILURE_FRACTION = 0.5
"""Fraction of its peak force below which a specimen has failed."""


@dataclass(frozen=True)
class Specimen:
    """A simulated specimen.

    Parameters
    ----------
    peak
        Reading of the testing machine at the peak.
    first
        Reading when the first bond breaks; None if it cannot be computed from a single equilibrium.
    failed
        Whether the specimen failed.
    """

    peak: MachineReading
    first: MachineReading | None
    failed: bool

    def peak_of(self, quantity: str) -> float:
        """Return the force or the displacement at the peak, as `quantity` states."""
        return self.peak.force if quantity == "force" else self.peak.displacement

    def first_of(self, quantity: str) -> float:
        """Return the force or the displacement when the first bond breaks."""
        assert self.first is not None
        return self.first.force if quantity == "force" else self.first.displacement


@dataclass(frozen=True)
class Specimens:
    """Simulated specimens of an experiment.

    Parameters
    ----------
    scene
        Scene of the experiment.
    peaks
        Measured peaks.
    elastic
        The body before fracture, if it has been computed.
    """

    scene: Scene
    peaks: Peaks
    elastic: ElasticResponse | None

    @classmethod
    def of(cls, experiment: Experiment, peaks: Peaks, elastic: ElasticResponse | None) -> Specimens:
        """Prepare simulations by the experiment's solver, or by equilibria.

        Raises
        ------
        ExperimentError
            If the experiment is invalid.
        """
        if experiment.solver.makes_steps:
            experiment = experiment.model_copy(update={"solver": Equilibrium()})
        return cls(build_scene(experiment), peaks, elastic)

    def tear(self, experiment: Experiment) -> Specimen:
        """Simulate a specimen until it has lost half of its peak force.

        The experiment may differ from that of the scene in parameters and seed. Between increments,
        the load is scaled until the next bond breaks.
        """
        scene = scene_like(self.scene, experiment)
        state, tables = initial_state(scene), Tables(scene)
        limits = strengths(scene, state) if self._has_known_breaks else None
        first = None if limits is None else self._first(limits)
        start = self._advance_to_first_break(state, first) if first else 0.0
        pull = self.elastic.pull if self.elastic else None
        peak, last, growth = first or MachineReading(0.0, 0.0), MachineReading(0.0, 0.0), 1.0
        for _ in chain(increments(scene, state, Watch(), start), [None]):
            pull = pull or LoadedGroup.of(scene, state, self.peaks)
            reading = pull.read(tables, state)
            if growth > 1.0 and last.displacement > 0.0:
                share = min(growth, reading.displacement / last.displacement)
                peak = max(peak, MachineReading(share * last.force, share * last.displacement))
            if first is None or reading.displacement > first.displacement:
                peak = max(peak, reading)
            if (
                reading.force < FAILURE_FRACTION * peak.force
                and reading.displacement >= peak.displacement
            ):
                return Specimen(peak, first, True)
            last = reading
            if limits is not None:
                growth = float(bond_strains(scene, state).load_at(limits).min())
        return Specimen(peak, first, first is not None and peak.displacement < last.displacement)

    @property
    def _has_known_breaks(self) -> bool:
        model = self.scene.experiment.fracture
        is_deterministic = isinstance(model, BreaksAtStrain) and not isinstance(model, Softens)
        return is_deterministic and self.elastic is not None

    def _advance_to_first_break(self, state: State, first: MachineReading) -> float:
        """Set a state to the last increment before the first bond breaks, and return its time.

        Before the first break no simulation is needed, because displacements are proportional to
        the load.
        """
        assert self.elastic is not None
        full = self.elastic.full.displacement
        earlier = [
            (end, share) for end, share in self._load_path if share * full < first.displacement
        ]
        if not earlier:
            return 0.0
        moment, share = earlier[-1]
        _, state.starts = prescribe(self.scene, state, moment)
        state.u[...] = state.previous[...] = share * self.elastic.u
        state.step = math.floor(moment)
        return moment

    @cached_property
    def _load_path(self) -> list[tuple[float, float]]:
        """Return the ends of all increments except the last one, with their load factors."""
        assert self.elastic is not None
        assert self.elastic.pull is not None
        count, path = self.scene.experiment.solver.equilibrium.increments, []
        for moment in moments(self.scene, count)[:-1]:
            state = unmoved_state(self.scene, self.scene.raster.shape[1:])
            leaders, _ = prescribe(self.scene, state, moment)
            place(state.u, leaders)
            displacement = self.elastic.pull.displacement(self.scene, state)
            path.append((moment, displacement / self.elastic.full.displacement))
        return path

    def _first(self, limits: Floats) -> MachineReading:
        """Return the reading at the load at which the first bond breaks.

        The load is computed from the strains and limits of the bonds, and is not rounded to an
        increment.
        """
        assert self.elastic is not None
        share = float(self.elastic.strains.load_at(limits).min())
        return MachineReading(
            share * self.elastic.full.force, share * self.elastic.full.displacement
        )


def seeded(experiment: Experiment, seed: int) -> Experiment:
    """Return the experiment with another seed for its random strengths and random fields."""
    varies = any(getattr(part, "varying", None) for part in (experiment.rule, experiment.fracture))
    if not varies:
        return experiment.model_copy(update={"seed": seed})
    source = experiment.as_written()
    source = with_value(source, "seed", seed, "the seed of a specimen", Experiment.defaults())
    return Experiment.build(source, given_classes(experiment))


COARSE = 40
"""Number of nodes along a parameter for locating the region in which the likelihood is large."""

FINE = 64
"""Number of nodes along a parameter for integrating the likelihood."""
NEGLIGIBLE = 18.0
"""Decrease of the logarithm of the likelihood from its maximum that makes it negligible.

The likelihood is then smaller by a factor of about 2e-8.
"""
DRAWS = 20_000
"""Number of samples of the parameters."""
NEGLIGIBLE_DEPTH = 1e-8
"""Negligible strain, as a fraction of the strain of the weakest specimen."""
LawBounds = tuple[tuple[float, float], tuple[float, float]]
"""Bounds of both parameters of a law."""


@dataclass(frozen=True)
class Breaks:
    """Load factors of specimens, in an array of shape (specimen,), and whether each specimen broke
    or survived."""

    load: Floats
    broke: Mask


@dataclass(frozen=True)
class WeightedSamples:
    """Samples of the parameters, in an array of shape (draw, parameter), and their weights."""

    values: Floats
    weights: Floats


class StrengthLaw(ABC):
    """A distribution of strengths with two parameters. `paths` are their paths in an experiment."""

    paths: ClassVar[tuple[str, str]]

    @staticmethod
    @abstractmethod
    def whole(path: str) -> float:
        """Return a value with which no bond breaks, for the parameter at a path."""

    @abstractmethod
    def draws(self, strains: BondStrains, breaks: Breaks, bounds: LawBounds) -> WeightedSamples:
        """Sample parameters between bounds from the integrated likelihood."""

    @staticmethod
    @abstractmethod
    def variation(first: Floats, second: Floats) -> Floats:
        """Return the coefficient of variation of strengths."""


class WeibullLaw(StrengthLaw):
    """Weibull distribution, F(ε) = 1 - exp(-(ε/s)^m)."""

    paths = ("fracture.scale", "fracture.modulus")

    @staticmethod
    def whole(path: str) -> float:
        """Return a scale that no strain reaches, or a modulus for which strengths do not
        scatter."""
        return 1e60 if path == "fracture.scale" else 1000.0

    @staticmethod
    def variation(first: Floats, second: Floats) -> Floats:
        """Return √(Γ(1 + 2/m)/Γ(1 + 1/m)² - 1)."""
        return np.asarray(np.sqrt(np.expm1(gammaln(1 + 2 / second) - 2 * gammaln(1 + 1 / second))))

    def draws(self, strains: BondStrains, breaks: Breaks, bounds: LawBounds) -> WeightedSamples:
        """Draw parameters from the integrated likelihood.

        Notes
        -----
        For a given modulus, Σ_specimens Σ_b ε^m / s^m has a gamma distribution with the number of
        failures as its shape. Moduli are sampled from the marginal density.
        """
        count = int(breaks.broke.sum())

        def logarithm(log_m: Floats) -> tuple[Floats, Floats]:
            """Return the logarithms of the density of ln m, and of the sum."""
            m = np.exp(log_m)
            sums, slopes = weibull_sums(strains, breaks, m)
            total = np.logaddexp.reduce(sums, axis=1)
            density = slopes[:, breaks.broke].sum(axis=1) - log_m - count * total
            inside = [gammainc(count, np.exp(np.minimum(total - m * np.log(end), 700.0)))
                      for end in bounds[0]]  # fmt: skip
            with np.errstate(divide="ignore"):
                return density + np.log(np.maximum(inside[0] - inside[1], 0.0)), total

        nodes = _nodes(bounds[1])
        (nodes,) = _refine_nodes(logarithm(nodes)[0], nodes)
        density, total = logarithm(nodes)
        order = (np.arange(DRAWS) + 0.5) / DRAWS
        share = np.exp(density - density.max())
        cumulative = np.concatenate([[0.0], np.cumsum((share[1:] + share[:-1]) / 2)])
        log_m = np.interp(order, cumulative / cumulative[-1], nodes)
        m, log_total = np.exp(log_m), np.interp(log_m, nodes, total)
        low, high = (gammainc(count, np.exp(np.minimum(log_total - m * np.log(end), 700.0)))
                     for end in reversed(bounds[0]))  # fmt: skip
        # A low-discrepancy sequence, sorted by `order`, makes the draws reproducible.
        other = (np.arange(DRAWS) * 0.6180339887498949 + 0.5) % 1.0
        log_s = (log_total - np.log(gammaincinv(count, low + other * (high - low)))) / m
        return WeightedSamples(np.stack([np.exp(log_s), m], axis=1), np.full(DRAWS, 1.0 / DRAWS))


def weibull_sums(strains: BondStrains, breaks: Breaks, m: Floats) -> tuple[Floats, Floats]:
    """Return ln Σ_b ε^m for each modulus and load, (modulus, specimen).

    Also return the logarithm of the derivative of the sum with respect to the load.
    """
    with np.errstate(divide="ignore"):
        strain = np.log(strains.at(breaks.load))
        rate = np.where(strain > -np.inf, strains.rate(breaks.load), 1.0)
    top = strain.max(axis=1, keepdims=True)
    sums, slopes = np.empty((2, len(m), len(strain)))
    for n, modulus in enumerate(m):
        share = np.exp(modulus * (strain - top)) * strains.count
        sums[n] = np.log(share.sum(axis=1)) + modulus * top[:, 0]
        growth = (share * rate * np.exp(-np.maximum(strain - top, -700.0))).sum(axis=1)
        slopes[n] = np.log(modulus * growth) + (modulus - 1.0) * top[:, 0]
    return sums, slopes


class UniformLaw(StrengthLaw):
    """Uniform distribution over f (1 ± s).

    It begins at a = f (1 - s) and has the width w = 2 f s.
    """

    paths = ("fracture.failure", "fracture.scatter")

    @staticmethod
    def whole(path: str) -> float:
        """Return a value with which no bond breaks, or zero scatter.

        For the failure strain, it is a strain that no bond reaches.
        """
        return 1e60 if path == "fracture.failure" else 0.0

    @staticmethod
    def variation(first: Floats, second: Floats) -> Floats:
        """Return the coefficient of variation, s/√3."""
        return np.asarray(second / np.sqrt(3.0))

    def draws(self, strains: BondStrains, breaks: Breaks, bounds: LawBounds) -> WeightedSamples:
        """Sample parameters on a grid.

        Its coordinates are ln w, and the logarithm of the distance between the lower end of the
        distribution and the strain of the weakest specimen.
        """
        strain, rate = strains.at(breaks.load), strains.rate(breaks.load)
        lowest = float(strain[breaks.broke].max(axis=1).min())

        def logarithm(depth: Floats, log_w: Floats) -> Floats:
            a, w = lowest - np.exp(depth)[:, None], np.exp(log_w)[None, :]
            is_relevant = strain.max(axis=0) > a.min()
            parts = (
                strain[:, is_relevant],
                rate[:, is_relevant],
                strains.count[is_relevant],
                breaks.broke,
            )
            log_likelihood = np.array([[_uniform(*parts, x, y) for y in w[0]] for x in a[:, 0]])
            f, s = a + w / 2, w / np.maximum(2 * a + w, 1e-300)
            inside = (a > 0.0) & (f >= bounds[0][0]) & (f <= bounds[0][1])
            inside &= (s >= bounds[1][0]) & (s <= bounds[1][1])
            return np.where(inside, log_likelihood + depth[:, None], -np.inf)

        depth = np.log(lowest) + np.linspace(np.log(NEGLIGIBLE_DEPTH), -1e-9, COARSE)
        widths = 2 * bounds[0][0] * bounds[1][0], 2 * bounds[0][1] * bounds[1][1]
        log_w = _nodes(widths)
        depth, log_w = _refine_nodes(logarithm(depth, log_w), depth, log_w)
        log_likelihood = logarithm(depth, log_w)
        a, w = np.meshgrid(lowest - np.exp(depth), np.exp(log_w), indexing="ij")
        weights = np.exp(log_likelihood - log_likelihood.max()).ravel()
        values = np.stack([a + w / 2, w / (2 * a + w)], axis=-1).reshape(-1, 2)
        return WeightedSamples(values[weights > 0.0], weights[weights > 0.0] / weights.sum())


def _uniform(strain: Floats, rate: Floats, count: Floats, broke: Mask, a: float, w: float) -> float:
    """Return the logarithm of the likelihood.

    It is -inf if a specimen survived a load at which one of its bonds must break.
    """
    z = (strain - a) / w
    if z.max() >= 1.0 or z[broke].max(axis=1).min() <= 0.0:
        return -np.inf
    survival = 1.0 - np.maximum(z, 0.0)
    rates = np.where(z > 0.0, count * rate / survival, 0.0)[broke].sum(axis=1) / w
    return float(np.log(rates).sum() + (np.log(survival) @ count).sum())


def _nodes(ends: tuple[float, float]) -> Floats:
    """Return equidistant logarithms between those of the two ends."""
    return np.linspace(np.log(ends[0]), np.log(ends[1]), COARSE)


def _refine_nodes(logarithms: Floats, *nodes: Floats) -> tuple[Floats, ...]:
    """Return finer nodes along each axis where the likelihood is not negligible."""
    if not np.isfinite(logarithms).any():
        raise ExperimentError(
            (
                "no strengths between the bounds agree with these peaks; use wider bounds, and "
                "check that the peaks are in the experiment's units"
            ),
            ("unknown",),
        )
    is_relevant = logarithms > logarithms.max() - NEGLIGIBLE
    refined = []
    for axis, coarse in enumerate(nodes):
        indices = np.flatnonzero(is_relevant.any(axis=tuple({*range(is_relevant.ndim)} - {axis})))
        low, high = max(indices[0] - 1, 0), min(indices[-1] + 1, len(coarse) - 1)
        refined.append(np.linspace(coarse[low], coarse[high], FINE))
    return tuple(refined)


LAWS: dict[str, StrengthLaw] = {"weibull": WeibullLaw(), "uniform": UniformLaw()}
"""Distributions of strength by name."""
OF_FRACTURE = {"weibull": "weibull", "strain": "uniform"}
"""Law of the strengths of a fracture model, by its type."""


LIMITS = (0.025, 0.975)
"""Quantiles of the 95 % interval."""
MIDDLE = (0.15865525393145707, 0.8413447460685429)
"""Quantiles at a distance of one standard error from the median."""
CUT = 1.02
"""Ratio of a bound to the end of an interval up to which both are treated as equal."""
SHIFT = 0.25
"""Largest harmless mean of ln(peak / first break), in standard errors of the mean.

With this bias an interval of 95 % still contains the true value with a probability of 94.3 %.
"""


@dataclass(frozen=True)
class StrengthEstimate:
    """An estimate of a strength parameter.

    Parameters
    ----------
    value, error
        Median, and half the width of the interval of 68.3 %.
    low, high
        Ends of the interval of 95 %.
    identifiable
        Whether the data determine the value.
    cut
        Whether the interval ends at a bound, so that it might be wider without the bound.
    """

    value: float
    error: float
    low: float
    high: float
    identifiable: bool = True
    cut: bool = False

    def __str__(self) -> str:
        if not self.identifiable:
            return "not identifiable from the data"
        digits = max(0, 1 - int(np.floor(np.log10(max(self.error, 1e-12)))))
        value, error, low, high = (
            f"{number:.{digits}f}" for number in (self.value, self.error, self.low, self.high)
        )
        text = f"{value} ± {error}, 95 % from {low} to {high}"
        return text + (", truncated by its bounds" if self.cut else "")


@dataclass(frozen=True)
class Checked:
    """Test of the assumption that specimens fail when their first bond breaks.

    Parameters
    ----------
    excess
        Mean of ln(peak / first break) over simulated specimens.
    bore_more
        Number of specimens with a peak above the load at the first break.
    count
        Number of specimens.
    limit
        Largest excess that is harmless.
    """

    excess: float
    bore_more: int
    count: int
    limit: float

    @classmethod
    def of(cls, excess: Sequence[float], peaks: Floats) -> Checked:
        """Return the test from the excess of each specimen and the spread of the measured peaks."""
        limit = SHIFT * float(np.log(peaks).std(ddof=1)) / len(peaks) ** 0.5
        larger = sum(value > 1e-6 for value in excess)
        return cls(float(np.mean(excess)), larger, len(excess), limit)

    @property
    def holds(self) -> bool:
        """Return whether the first break is the failure of the specimen."""
        return self.excess <= self.limit

    def __str__(self) -> str:
        text = (
            f"{self.bore_more} of {self.count} simulated specimens carried more load than at "
            "their first break"
        )
        if self.holds:
            return f"the first break is the failure: {text}"
        return (
            f"the first break is not the failure: {text}, on average {np.expm1(self.excess):.1%} "
            f"more, which exceeds the limit of {np.expm1(self.limit):.2%}"
        )


@dataclass(frozen=True)
class FittedStrength:
    """Result of a strength fit.

    Parameters
    ----------
    values : mapping of str to StrengthEstimate
        Estimates by path.
    correlations : array of float, shape (parameter, parameter)
        Correlations of the estimates.
    variation : StrengthEstimate or None
        Coefficient of variation of the strengths of bonds, if their law is known.
    method : str
        likelihood or simulation.
    specimens, failed : int
        Number of specimens, and of broken ones.
    checked : Checked or None
        Test whether specimens fail when their first bond breaks.
    draws : WeightedSamples
        Samples of the parameters.
    """

    values: Mapping[str, StrengthEstimate]
    correlations: Floats
    variation: StrengthEstimate | None
    method: str
    specimens: int
    failed: int
    checked: Checked | None = None
    draws: WeightedSamples = field(kw_only=True, repr=False)

    def with_check(self, checked: Checked | None) -> FittedStrength:
        """Return the result, completed by the test of whether specimens fail when their first bond
        breaks."""
        return replace(self, checked=checked)

    def as_dict(self) -> dict[str, Any]:
        """Return the result as plain values, for JSON.

        Returns
        -------
        dict
            Content of the file that `pbdkit fit` writes.
        """
        checked = self.checked
        return {
            "values": {path: _plain(estimate) for path, estimate in self.values.items()},
            "correlations": {
                first: {
                    second: float(self.correlations[n, m]) for m, second in enumerate(self.values)
                }
                for n, first in enumerate(self.values)
            },
            "coefficient_of_variation": self.variation and _plain(self.variation),
            "method": self.method,
            "specimens": self.specimens,
            "broke": self.failed,
            "first_break_is_failure": None if checked is None else checked.holds,
            "excess": None if checked is None else checked.excess,
        }

    def __str__(self) -> str:
        """A summary: a line for each value with its error, then correlations and residuals."""
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        for path, estimate in self.values.items():
            yield f"{path}: {estimate}"
        if self.variation and all(value.identifiable for value in self.values.values()):
            yield f"coefficient of variation of strengths: {self.variation}"
        for n, first in enumerate(self.values):
            for m, second in list(enumerate(self.values))[n + 1 :]:
                if abs(self.correlations[n, m]) > 0.5:
                    yield f"correlation of {first} and {second}: {self.correlations[n, m]:.2f}"
        unbroken = self.specimens - self.failed
        yield f"method {self.method}, from {self.specimens} specimens" + (
            f", {unbroken} of which did not break" if unbroken else ""
        )
        if self.checked:
            yield str(self.checked)
        elif self.method == "likelihood":
            yield "assumption: a specimen fails when its first bond breaks"


def fitted_strength(
    fit: StrengthFit,
    paths: Sequence[str],
    draws: WeightedSamples,
    method: str,
    law: StrengthLaw | None,
) -> FittedStrength:
    """Return the result in terms of the fit file."""
    values = {}
    for n, path in enumerate(paths):
        low, high = fit.unknown[path]
        estimate = _estimate(draws.values[:, n], draws.weights)
        cut = min(estimate.low / low, high / estimate.high) < CUT
        values[path] = replace(
            estimate, identifiable=estimate.error <= IDENTIFIABLE_RATIO * (high - low), cut=cut
        )
    variation = None
    if law is not None:
        parameters = draws.values[:, [list(paths).index(path) for path in law.paths]]
        variation = _estimate(law.variation(parameters[:, 0], parameters[:, 1]), draws.weights)
    spread = np.cov(np.log(draws.values).T, aweights=draws.weights).reshape((len(paths),) * 2)
    errors = np.sqrt(np.diag(spread))
    failed = fit.measured.failed
    correlations = spread / np.outer(errors, errors)
    count = len(failed), int(failed.sum())
    return FittedStrength(values, correlations, variation, method, *count, draws=draws)


def _estimate(values: Floats, weights: Floats) -> StrengthEstimate:
    order = np.argsort(values)
    below = np.cumsum(weights[order]) - weights[order] / 2
    low, minus, middle, plus, high = np.interp(
        [LIMITS[0], MIDDLE[0], 0.5, MIDDLE[1], LIMITS[1]], below, values[order]
    )
    return StrengthEstimate(float(middle), float(plus - minus) / 2, float(low), float(high))


def _plain(estimate: StrengthEstimate) -> dict[str, Any]:
    if not estimate.identifiable:
        return dict.fromkeys(("value", "error", "low", "high", "cut")) | {"identifiable": False}
    return asdict(estimate)


SHARES = 0.2, 0.2, 0.6
"""Fractions of the specimens that are simulated in three passes.

In the first pass, strengths are from the whole range between the bounds, in the next two from the
region in which the measurement is likely.
"""
POINTS = 2**14
"""Number of points at which the likelihood is evaluated."""
LIKELY = 8.0
"""Difference from the largest logarithm of the likelihood up to which points are likely."""

WIDER = 0.25
"""Margin of the box around the likely points, relative to its size."""
REGRESSION_ITERATIONS = 50
"""Number of iterations of the regression of the spread."""

MAX_LOG_STEP = 3.0
"""Largest step in the logarithm of a variance."""
MIN_LOAD_RATIO = 1.25
"""Smallest ratio of the load in the experiment to the largest measured load."""


@dataclass(frozen=True)
class PeakDistribution:
    """Distribution of ln peak as a function of ln parameters in a box.

    Parameters
    ----------
    low, high : (parameter,)
        The box.
    mean, log_variance : (term,)
        Quadratic polynomials of the mean and of the logarithm of the variance.
    inverse : (term, term)
        Covariance of the coefficients of the mean.
    skewness, kurtosis
        Moments of the residuals.
    """

    low: Floats
    high: Floats
    mean: Floats
    log_variance: Floats
    inverse: Floats
    skewness: float
    kurtosis: float

    @classmethod
    def of(cls, logs: Floats, y: Floats) -> PeakDistribution:
        """Fit the distribution by maximum likelihood. Residuals are assumed to be normal.

        Mean and variance are fitted alternately.
        """
        empty = np.zeros(0)
        ends = logs.min(axis=0), logs.max(axis=0)
        distribution = cls(*ends, empty, empty, empty, 0.0, 3.0)
        x = distribution.terms(logs)
        gamma = np.zeros(x.shape[1])
        mean, *_ = np.linalg.lstsq(x, y, rcond=None)
        gamma[0] = np.log(np.mean((y - x @ mean) ** 2))
        for _ in range(REGRESSION_ITERATIONS):
            weight = np.exp(-x @ gamma)
            mean = np.linalg.solve((x.T * weight) @ x, x.T @ (weight * y))
            step, *_ = np.linalg.lstsq(x, (y - x @ mean) ** 2 * weight - 1.0, rcond=None)
            gamma += np.clip(step, -MAX_LOG_STEP, MAX_LOG_STEP)
        z = (y - x @ mean) * np.exp(-x @ gamma / 2.0)
        z = (z - z.mean()) / z.std()
        inverse = np.linalg.inv((x.T * np.exp(-x @ gamma)) @ x)
        higher = float(np.mean(z**3)), float(np.mean(z**4))
        return replace(
            distribution,
            mean=mean,
            log_variance=gamma,
            inverse=inverse,
            skewness=higher[0],
            kurtosis=higher[1],
        )

    def terms(self, logs: Floats) -> Floats:
        """Return constant, linear and quadratic terms, (point, term).

        Coordinates are scaled so that they range from -1 to 1 in the box.
        """
        x = 2.0 * (logs - self.low) / (self.high - self.low) - 1.0
        pairs = combinations_with_replacement(range(x.shape[1]), 2)
        return np.column_stack([np.ones(len(x)), x, *(x[:, a] * x[:, b] for a, b in pairs)])

    def likelihood(self, logs: Floats, y: Floats) -> Floats:
        """Return the logarithm of the likelihood at points.

        Notes
        -----
        The mean of the measured ln peaks y has the variance σ²/n. The logarithm of their standard
        deviation has the variance (κ - 1)/4n, and both have the covariance σ · skewness/2n. The
        uncertainty of mean and variance due to the number of simulated specimens is added.
        """
        n, x = len(y), self.terms(logs)
        variance = np.exp(x @ self.log_variance)
        uncertainty = np.einsum("pi,ij,pj->p", x, self.inverse, x)
        share = 1.0 / n + uncertainty / variance
        width = (self.kurtosis - 1.0) / 4.0
        a = y.mean() - x @ self.mean
        b = np.log(y.std(ddof=1)) - x @ self.log_variance / 2.0 + width / (2.0 * n)
        v, w, c = variance * share, width * share, np.sqrt(variance) * self.skewness / 2.0 * share
        determinant = v * w - c**2
        distance = (w * a**2 - 2.0 * c * a * b + v * b**2) / determinant
        return np.asarray(-(distance + np.log(determinant)) / 2.0)


def fit_by_simulation(
    fit: StrengthFit, experiment: Experiment, specimens: Specimens
) -> WeightedSamples:
    """Draw samples of the strength parameters that agree with the measured peaks.

    They lie between the bounds, and the prior density of their logarithms is constant.

    Raises
    ------
    ExperimentError
        If the measurement cannot be simulated.
    """
    if not fit.measured.failed.all():
        raise ExperimentError(
            "tests that ended before the specimen broke cannot be simulated; remove them",
            ("measured", "broke"),
        )
    if fit.measured.of == "factor":
        text = "simulated specimens have forces and displacements, but no factor"
        raise ExperimentError(text, ("measured", "of"))
    _refuse_short_load(specimens, float(fit.measured.values.max()))
    y = np.log(fit.measured.values)
    box = bounds = np.log(list(fit.unknown.values())).T
    logs, peaks = np.zeros((0, len(fit.unknown))), np.zeros(0)
    for stage, share in enumerate(SHARES):
        new_logs = _spread(box, int(share * fit.simulations), fit.seed + stage)
        new_peaks = _simulate_peaks(fit, experiment, specimens, new_logs, len(logs))
        logs, peaks = np.vstack([logs, new_logs]), np.concatenate([peaks, new_peaks])
        inside = ((logs >= box[0]) & (logs <= box[1])).all(axis=1)
        model, points = (
            PeakDistribution.of(logs[inside], peaks[inside]),
            _spread(box, POINTS, fit.seed),
        )
        logarithm = model.likelihood(points, y)
        likely = points[logarithm > logarithm.max() - LIKELY]
        margin = WIDER * np.ptp(likely, axis=0)
        box = np.clip([likely.min(axis=0) - margin, likely.max(axis=0) + margin], *bounds)
    weights = np.exp(logarithm - logarithm.max())
    return WeightedSamples(np.exp(points), weights / weights.sum())


def _spread(box: Floats, count: int, seed: int) -> Floats:
    """Return points of a scrambled Sobol sequence, which fill a box uniformly, (point,
    parameter)."""
    from scipy.stats import qmc

    unit_points = qmc.Sobol(box.shape[1], seed=seed).random_base2(int(np.ceil(np.log2(count))))
    return np.asarray(box[0] + unit_points[:count] * (box[1] - box[0]))


def _simulate_peaks(
    fit: StrengthFit, experiment: Experiment, specimens: Specimens, logs: Floats, offset: int
) -> Floats:
    """Return ln peak of one specimen for each point."""
    peaks = []
    for n, point in enumerate(np.exp(logs).tolist()):
        changed = experiment
        for path, value in zip(fit.unknown, point, strict=True):
            changed = Parameter(path).put(changed, value)
        specimen = specimens.tear(seeded(changed, (fit.seed << 20) + offset + n))
        peaks.append(np.log(specimen.peak_of(fit.measured.of)))
    return np.array(peaks)


def _refuse_short_load(specimens: Specimens, largest: float) -> None:
    """Raise ExperimentError if the load of the experiment is not much larger than measured loads.

    Otherwise the load at which the simulation ends would be treated as the peak of a specimen that
    survives it.
    """
    if (elastic := specimens.elastic) is None:
        return
    quantity = specimens.peaks.of
    full = elastic.full.force if quantity == "force" else elastic.full.displacement
    if full < MIN_LOAD_RATIO * largest:
        raise ExperimentError(
            f"the experiment's load ends at a {quantity} of {full:.4g} without fracture, but the "
            f"strongest specimen carried {largest:.4g}; increase the motion of the leaders by a "
            f"factor of at least {MIN_LOAD_RATIO * largest / full:.3g}",
            ("leaders",),
        )


def fit_strength_of(fit: StrengthFit, experiment: Experiment) -> FittedStrength:
    """Carry out a strength fit, on one thread.

    Raises
    ------
    ExperimentError
        If the strengths cannot be fitted.
    """
    try:
        with one_thread():
            if fit.method == "simulation":
                return _fit_with_simulations(fit, experiment, None)
            result = _fit_by_likelihood(fit, experiment)
            if fit.method == "auto" and result.checked and not result.checked.holds:
                return _fit_with_simulations(fit, experiment, result.checked)
            return result
    except ExperimentError as error:
        raise fit.located(error, experiment) from None


def _fit_by_likelihood(fit: StrengthFit, experiment: Experiment) -> FittedStrength:
    law = _law(fit, experiment)
    if {*fit.unknown} != {*law.paths}:
        raise ExperimentError(
            f"the likelihood requires bounds of both {' and '.join(law.paths)}",
            ("unknown",),
        )
    elastic = _elastic(fit, experiment, law)
    full = getattr(elastic.full, "displacement" if fit.measured.of == "displacement" else "force")
    if np.isnan(full):
        raise ExperimentError(
            f"the rule '{experiment.rule.type}' defines no forces; use 'elastic' or another "
            "calibrated rule, or peaks of: displacement",
            ("measured", "of"),
        )
    if full <= 0.0:
        raise ExperimentError(
            f"under the experiment's load the {fit.measured.of} is {full:g}: there is no tension "
            "along the displacement of the leader group",
            ("measured", "of"),
        )
    strains = elastic.strains.merged()
    breaks = Breaks(fit.measured.values / full, fit.measured.failed)
    if not (strains.at(breaks.load).max(axis=1) > 0.0).all():
        raise ExperimentError("no bond is stretched under this load", ("leaders",))
    first, second = (fit.unknown[path] for path in law.paths)
    draws = law.draws(strains, breaks, (first, second))
    result = fitted_strength(fit, law.paths, draws, "likelihood", law)
    return result.with_check(_check_first_break(fit, experiment, law, elastic, result))


def _elastic(fit: StrengthFit, experiment: Experiment, law: StrengthLaw) -> ElasticResponse:
    if experiment.fracture.can_break:
        for path in law.paths:
            experiment = Parameter(path).put(experiment, law.whole(path))
    return ElasticResponse.of(experiment, fit.measured)


def _law(fit: StrengthFit, experiment: Experiment) -> StrengthLaw:
    kind = experiment.fracture.type
    name = fit.law or OF_FRACTURE.get(kind)
    if name is None:
        raise ExperimentError(
            (
                f"the distribution of strengths of fracture '{kind}' is not known; give law: "
                "weibull or uniform, or use method: simulation"
            ),
            ("law",),
        )
    if OF_FRACTURE.get(kind, name) != name:
        raise ExperimentError(
            (
                f"law: the strengths of fracture '{kind}' are distributed as {OF_FRACTURE[kind]}, "
                f"not as {name}"
            ),
            ("law",),
        )
    return LAWS[name]


def _check_first_break(
    fit: StrengthFit,
    experiment: Experiment,
    law: StrengthLaw,
    elastic: ElasticResponse,
    result: FittedStrength,
) -> Checked | None:
    """Simulate specimens with the fitted strengths to test whether they fail at the first break.

    Return None if the experiment does not define the behaviour after the first break.
    """
    kind = experiment.fracture.type
    if (
        not fit.check
        or OF_FRACTURE.get(kind) is None
        or elastic.pull is None
        or not elastic.full.force > 0.0
    ):
        return None
    for path in law.paths:
        experiment = Parameter(path).put(experiment, result.values[path].value)
    specimens = Specimens.of(experiment, fit.measured, elastic)
    broken = [specimens.tear(seeded(experiment, fit.seed + n)) for n in range(fit.check)]
    return Checked.of(
        [_excess(specimen, fit.measured.of) for specimen in broken], fit.measured.values
    )


def _excess(specimen: Specimen, quantity: str) -> float:
    """Return ln(peak / value at the first break)."""
    assert specimen.first is not None
    return float(np.log(specimen.peak_of(quantity) / specimen.first_of(quantity)))


def _fit_with_simulations(
    fit: StrengthFit, experiment: Experiment, checked: Checked | None
) -> FittedStrength:
    for path in fit.unknown:
        Parameter(path).value_in(experiment)
    elastic = None
    if (name := OF_FRACTURE.get(experiment.fracture.type)) and experiment.rule.linear:
        elastic = _elastic(fit, experiment, LAWS[name])
    specimens = Specimens.of(experiment, fit.measured, elastic)
    if not has_forces(specimens.scene):
        raise ExperimentError(
            f"the rule '{experiment.rule.type}' defines no forces, so that specimens have no "
            "peak; use 'elastic' or another calibrated rule",
            ("rule",),
        )
    draws: WeightedSamples = fit_by_simulation(fit, experiment, specimens)
    law = LAWS[name] if name and {*fit.unknown} == {*LAWS[name].paths} else None
    result = fitted_strength(fit, tuple(fit.unknown), draws, "simulation", law)
    return result.with_check(checked)
