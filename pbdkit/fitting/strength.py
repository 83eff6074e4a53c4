"""Strength of bonds and its scatter from repeated tests: fit file, likelihood, simulated specimens
and result.

The load at which the first bond breaks in a body whose displacements grow in proportion to the
load: with d the difference along a bond under the experiment's full load, the strain under a share
λ of it is ε(λ) = |r + λ d| / |r| - 1 = √(1 + 2 λ p + λ² q) - 1, p = r·d/|r|², q = |d|²/|r|². It is
convex and 0 at λ = 0, so that a strained bond is strained the more the larger λ.

A specimen bears the load λ where all its bonds do: with probability Π_b (1 - F(ε_b(λ))). The
likelihood of repeats is therefore known without any run (weakest link: W. Weibull, J. Appl. Mech.
18 (1951) 293). Location μ and scale σ of ln strength (Weibull: μ = ln s, σ = 1/m) or of strength
(uniform) have the density dμ dσ/σ and the likelihood is integrated. Where all bonds are strained
alike specimens are of a location-scale family too, and intervals from the integrated likelihood are
exact, however few the specimens (J. Berger, Statistical Decision Theory, 1985, section 6.6).

Where no likelihood is known it is synthetic: single specimens are torn at strengths all over the
bounds, and then where the measurement is likely. Mean and spread of ln peak follow by regression
over the logarithms of the parameters; the mean of the measured ln peaks and the logarithm of their
standard deviation, which are about normal, are compared (S. Wood, Nature 466 (2010) 1102).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from itertools import chain, combinations_with_replacement
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, ValidationError, ValidationInfo, model_validator

from pbdkit.components.diagnostics import reactions
from pbdkit.equilibrium.solve import finder_of, increments, moments
from pbdkit.equilibrium.system import one_thread
from pbdkit.errors import ExperimentError
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.problem import TELLS
from pbdkit.fitting.sensitivity import scene_like
from pbdkit.fitting.specification import FOLDER, Bounds, Positive
from pbdkit.io.snapshot import StateMoment, Tables
from pbdkit.lattice.raster import FOLLOWER, Mask, Places
from pbdkit.model.experiment import Experiment, Version, given_classes
from pbdkit.model.motions import read_columns
from pbdkit.model.reading import FIT, OF_PROGRAM, Source, of_kind, read_file, with_value
from pbdkit.model.shipped import Base, base_source
from pbdkit.model.solver import Equilibrium
from pbdkit.model.validation import fault, report
from pbdkit.plugin import BreaksAtStrain, Calibrated, Softens
from pbdkit.plugin.component import Strict
from pbdkit.progress import Watch
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stepping.leaders import place, prescribe
from pbdkit.stepping.state import Floats, State, initial_state, unmoved_state

KIND = "strength"
"""What a strength fit says under `kind`."""
FEWEST = 3
"""So many specimens have to break: of fewer nothing is known of the scatter."""


class Peaks(Strict):
    """How far each specimen bore the load, one number each: `peaks` themselves, or the `column` of
    a CSV `file` beside this one. `of` says what they are: the `force` or the `displacement` of the
    leader group `group` at the peak, or `factor`, the share of the experiment's own load.

    In place of `column`, `curve` names the columns specimen, displacement and force of whole
    curves, of which the peaks are taken. `broke` is 1 where a specimen broke and 0 where its test
    ended before; a list, or the name of a column. Without it all broke. Forces are those of a body
    of `youngs_modulus` and `thickness`; `group` is by default the one that moves farthest.
    """

    file: str | None = None
    column: str = "peak"
    curve: Annotated[tuple[str, str, str] | None, Field(strict=False)] = None
    peaks: Annotated[tuple[float, ...], Field(strict=False)] = ()
    broke: str | Annotated[tuple[Annotated[int, Field(ge=0, le=1)], ...], Field(strict=False)] = ()
    of: Literal["force", "displacement", "factor"]
    group: Annotated[int, Field(ge=0)] | None = None
    youngs_modulus: Positive = 1.0
    thickness: Positive = 1.0
    _values: Any = None
    _broke: Any = None

    @model_validator(mode="after")
    def _read(self, info: ValidationInfo) -> Self:
        if (self.file is None) == (not self.peaks):
            raise fault("needs either a file, or the peaks themselves", key="file")
        values, broke = self._columns(info) if self.file is not None else self._given()
        for n, value in enumerate(values):
            if not 0.0 < value < np.inf:
                text = f"peaks are above 0; that of specimen {n + 1} is {value:g}"
                raise fault(text, key="file" if self.file else "peaks")
        if broke.sum() < FEWEST:
            raise fault(
                f"{int(broke.sum())} specimens broke; scatter needs at least {FEWEST}",
                key="file" if self.file else "peaks",
            )
        object.__setattr__(self, "_values", values)
        object.__setattr__(self, "_broke", broke)
        return self

    def _given(self) -> tuple[Floats, Any]:
        if isinstance(self.broke, str):
            raise fault("names a column, and there is no file; give a list of 0 and 1", key="broke")
        broke = np.array(self.broke or [1] * len(self.peaks), bool)
        if len(broke) != len(self.peaks):
            text = f"{len(broke)} numbers for {len(self.peaks)} peaks; give one each"
            raise fault(text, key="broke")
        return np.array(self.peaks), broke

    def _columns(self, info: ValidationInfo) -> tuple[Floats, Any]:
        if self.broke and not isinstance(self.broke, str):
            raise fault("is a list, and peaks are in a file; name its column", key="broke")
        more = (self.broke,) if isinstance(self.broke, str) else ()
        if self.curve is None:
            rows = np.array(read_columns(self.file, info, (self.column, *more)))
        else:
            if self.of == "factor":
                raise fault("curves tell forces and displacements, no factor", key="of")
            rows = _of_curves(
                np.array(read_columns(self.file, info, (*self.curve, *more))), self.of
            )
        return rows[:, 0], rows[:, 1] != 0.0 if more else np.ones(len(rows), bool)

    @property
    def values(self) -> Floats:
        """(specimen,): the peaks."""
        return np.asarray(self._values)

    @property
    def failed(self) -> Any:
        """(specimen,): whether it broke."""
        return self._broke


def _of_curves(rows: Floats, of: str) -> Floats:
    """Of each specimen its largest force, or the displacement there, and the rest of the row."""
    kept = []
    for specimen in np.unique(rows[:, 0]):
        own = rows[rows[:, 0] == specimen]
        top = own[own[:, 2].argmax()]
        kept.append([top[2] if of == "force" else top[1], *top[3:]])
    return np.array(kept)


class StrengthFit(Strict):
    """Looks for the strength of bonds and its scatter, the `unknown` parameters between bounds, in
    repeats of one experiment.

    `law` is the distribution of strengths, by default that of the experiment's fracture. `method`:
    `likelihood` counts the first bond that breaks as the failure of the specimen, `simulation`
    compares with specimens that are torn, `auto` takes the second where the first does not hold.
    So many specimens are torn to `check` that, so many sets of them make the `simulations`; `seed`
    is of the random numbers of both.
    """

    version: Version = 1
    kind: Literal["strength"]
    experiment: Base
    law: Literal["weibull", "uniform"] | None = None
    unknown: Annotated[dict[str, Bounds], Field(min_length=1)]
    measured: Peaks
    method: Literal["auto", "likelihood", "simulation"] = "auto"
    check: Annotated[int, Field(ge=0, le=1000)] = 8
    simulations: Annotated[int, Field(ge=100, le=1_000_000)] = 2000
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0

    @model_validator(mode="after")
    def _positive(self) -> Self:
        for path, (low, _) in self.unknown.items():
            if low <= 0.0:
                raise fault(f"strengths and their scatter are above 0; got {low:g}", key=path)
        return self


def is_strength_fit(description: Mapping[str, Any] | str | Path) -> bool:
    """Whether a fit file, a shipped fit or a dict describes a strength fit: by its `kind`. False
    where nothing can be read there; whoever reads it next says why."""
    if isinstance(description, Mapping):
        return description.get("kind") == KIND
    path = _file(description)
    return path.is_file() and dict(of_kind(FIT, read_file(path)).data).get("kind") == KIND


def described_strength_fit(
    description: Mapping[str, Any] | str | Path, *, given: bool
) -> tuple[StrengthFit, Source]:
    """The strength fit in a file, of a shipped name or in a dict, and the source of its experiment;
    none is looked for where one is `given`. Raises ExperimentError."""
    if isinstance(description, Mapping):
        path, source = Path("fit"), Source("fit", dict(description), {}, OF_PROGRAM)
    else:
        path = _file(description)
        source = of_kind(FIT, read_file(path))
    if given and isinstance(source.data, dict):
        data = {"experiment": "", **source.data}
        source = Source(source.name, data, source.places, source.beside)
    try:
        fit = StrengthFit.model_validate(source.data, context={"beside": source.beside})
    except ValidationError as error:
        raise report(error, source) from None
    return fit, source if given else base_source(path, fit.experiment, source)


def _file(name: str | Path) -> Path:
    shipped = FOLDER / f"{name}.yaml"
    return shipped if not Path(name).is_file() and shipped.is_file() else Path(name)


PARTS = 4
"""Of the load, after each of which proportion is looked at."""
PROPORTION, ALIKE = 1e-6, 1e-9
"""The share of the largest displacement by which displacements may be out of it; that of the
largest p and q within which bonds count as alike."""

FIRST = "the load of the first break is not known from one equilibrium; take method: simulation"


@dataclass(frozen=True)
class BondStrains:
    """p and q of bonds, (bond,), and how many bonds each row counts for."""

    p: Floats
    q: Floats
    count: Floats

    def at(self, load: Floats) -> Floats:
        """ε, (load, bond); 0 for what is pressed."""
        x = load[:, None] * (2.0 * self.p + load[:, None] * self.q)
        return np.asarray(np.maximum(x, 0.0) / (np.sqrt(1.0 + np.maximum(x, 0.0)) + 1.0))

    def rate(self, load: Floats) -> Floats:
        """dε/dλ, (load, bond), where ε > 0."""
        return np.asarray((self.p + load[:, None] * self.q) / (1.0 + self.at(load)))

    def load_at(self, strain: Floats) -> Floats:
        """λ at which each bond has a strain of its own, (bond,); inf for bonds without motion."""
        x = strain * (2.0 + strain)
        with np.errstate(divide="ignore", invalid="ignore"):
            found = x / (self.p + np.sqrt(self.p**2 + self.q * x))
        return np.asarray(np.where(self.q > 0.0, found, np.inf))

    def merged(self) -> BondStrains:
        """Those that are strained at some load, and bonds that are alike in one row."""
        strained = self.q > 0.0
        pq = np.stack([self.p[strained], self.q[strained]], axis=1)
        steps = np.round(pq / (ALIKE * np.abs(pq).max(axis=0)))
        _, first, group = np.unique(steps, axis=0, return_index=True, return_inverse=True)
        count = np.bincount(group.ravel(), self.count[strained]).astype(float)
        return BondStrains(pq[first, 0], pq[first, 1], count)


def bond_strains(scene: Scene, state: State) -> BondStrains:
    """Of the bonds of a scene in their order, from where they are in a state; p = q = 0 for those
    that are broken or cannot break."""
    bonds, shape = scene.bonds, scene.raster.shape
    p, q = np.zeros((2, len(bonds.ends)))
    for n, plane in enumerate(scene.neighbourhood.planes):
        rows = np.flatnonzero(bonds.plane == n)
        here = Places(shape, bonds.place[rows] + plane.slot.source * int(np.prod(shape[1:])))
        d = here.seen_through(plane.slot).of(state.u) - here.of(state.u)
        rest = np.array(plane.slot.rest)
        p[rows] = rest @ d / (rest @ rest)
        q[rows] = (d**2).sum(axis=0) / (rest @ rest)
    whole = np.ones(len(p), bool)
    if state.broken_step is not None:
        whole = state.broken_step.reshape(len(state.broken_step), -1)[bonds.plane, bonds.place] < 0
    if not scene.experiment.fracture.breaks_frame_bonds():
        whole &= (scene.raster.table_kind[bonds.ends] == FOLLOWER).all(axis=1)
    return BondStrains(np.where(whole, p, 0.0), np.where(whole, q, 0.0), np.ones(len(p)))


def strengths(scene: Scene, state: State) -> Floats:
    """The strain at which each bond of a scene breaks, (bond,). Raises ExperimentError where the
    model does not tell."""
    model, bonds = scene.experiment.fracture, scene.bonds
    if not isinstance(model, BreaksAtStrain):
        raise ExperimentError(
            f"'{model.type}' tells no strain at which a bond breaks", ("fracture",)
        )
    found = np.zeros(len(bonds.ends))
    for n, plane in enumerate(scene.neighbourhood.planes):
        rows = np.flatnonzero(bonds.plane == n)
        home = Places(scene.raster.shape, bonds.place[rows])
        own = [home.within(value[n]) for value in state.bond_values]
        c = scene.constants.of_bond(*scene.constants.limits_at(plane.slot, n, home), *own)
        found[rows] = model.breaking_strain(plane.slot.rest, c, scene.constants.fracture)
    return found


def knows_forces(scene: Scene) -> bool:
    """Whether its rule pulls with forces: others only say where particles go."""
    return isinstance(scene.experiment.rule, Calibrated)


class MachineReading(NamedTuple):
    """What a testing machine shows; the force is nan where the rule knows none."""

    force: float
    displacement: float


@dataclass(frozen=True)
class Pull:
    """The leader group that tears a body, the direction in which it goes, and what forces are
    multiplied by."""

    group: int
    way: Floats
    factor: float

    @classmethod
    def of(cls, scene: Scene, state: State, peaks: Peaks) -> Pull:
        """The group that is asked for, or the one that moves farthest, along its way. Raises
        ExperimentError where there is none, and where it does not move."""
        if not scene.leading:
            raise ExperimentError("there are no leaders that tear the body", ("leaders",))
        moved = np.stack([_mean(scene, state, n) for n in range(len(scene.leading))])
        size = np.hypot.reduce(moved, axis=1)
        group = int(size.argmax()) if peaks.group is None else peaks.group
        if group >= len(moved):
            raise ExperimentError(f"there is no leader group {group}", ("measured", "group"))
        if size[group] == 0.0:
            raise ExperimentError(
                f"leader group {group} does not move; name one that tears the body",
                ("measured", "group"),
            )
        return cls(group, moved[group] / size[group], peaks.youngs_modulus * peaks.thickness)

    def seen(self, tables: Tables, state: State) -> MachineReading:
        """Both along the way; the displacement is the mean of the group's particles."""
        carried = np.full(len(self.way), np.nan)
        if knows_forces(tables.scene):
            carried = reactions(StateMoment(state, tables))[self.group]
        return MachineReading(
            self.factor * float(self.way @ carried), self.moved(tables.scene, state)
        )

    def moved(self, scene: Scene, state: State) -> float:
        """The displacement alone."""
        return float(self.way @ _mean(scene, state, self.group))


def _mean(scene: Scene, state: State, group: int) -> Floats:
    place = scene.leading[group].place
    return np.asarray(state.u.reshape(scene.axes, -1)[:, place].mean(axis=1))


@dataclass(frozen=True)
class ElasticResponse:
    """A body before anything breaks, under the experiment's full load: its displacements u as
    planes, how its bonds are strained, and what is seen of it, if a leader group is asked for."""

    strains: BondStrains
    pull: Pull | None
    full: MachineReading
    u: Floats

    @classmethod
    def of(cls, experiment: Experiment, peaks: Peaks) -> ElasticResponse:
        """From the equilibrium of an experiment whose bonds do not break. Raises ExperimentError
        where displacements do not grow in proportion to the load."""
        experiment = experiment.model_copy(update={"solver": Equilibrium(increments=PARTS)})
        scene = build_scene(experiment)
        if scene.barriers:
            raise ExperimentError("what touches obstacles is held by more and more of it: " + FIRST)
        state, seen = initial_state(scene), list[Floats]()
        finder = finder_of(scene, state, compiles=False)
        for _ in increments(scene, state, Watch(), finder=finder):
            seen.append(state.u.copy())
        _refuse_out_of_proportion(seen, state.u, experiment.rule.linear)
        strains = bond_strains(scene, state)
        if peaks.of == "factor":
            return cls(strains, None, MachineReading(1.0, 1.0), state.u)
        pull = Pull.of(scene, state, peaks)
        return cls(strains, pull, pull.seen(Tables(scene), state), state.u)


def _refuse_out_of_proportion(seen: list[Floats], last: Floats, linear: bool) -> None:
    size, before = float(np.abs(last).max()), 0.0
    if size == 0.0:
        raise ExperimentError("nothing moves under the load of this experiment", ("leaders",))
    if not (seen or linear):
        raise ExperimentError("the rule is not linear: " + FIRST)
    for u in seen:
        share = float((u * last).sum() / (last * last).sum())
        off = float(np.abs(u - share * last).max()) / size
        if off > PROPORTION or share < before:
            raise ExperimentError(
                f"displacements do not grow in proportion to the load ({off:.2g} off): " + FIRST
            )
        before = share


LOST = 0.5
"""The share of its peak below which a specimen that bears no more has failed."""


@dataclass(frozen=True)
class Specimen:
    """What was seen of one at its peak, and when its first bond broke (None where one equilibrium
    does not tell), and whether it failed."""

    peak: MachineReading
    first: MachineReading | None
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
    elastic: ElasticResponse | None

    @classmethod
    def of(cls, experiment: Experiment, peaks: Peaks, elastic: ElasticResponse | None) -> Specimens:
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
        top, before, grows = first or MachineReading(0.0, 0.0), MachineReading(0.0, 0.0), 1.0
        for _ in chain(increments(scene, state, Watch(), since), [None]):
            pull = pull or Pull.of(scene, state, self.peaks)
            seen = pull.seen(tables, state)
            if grows > 1.0 and before.displacement > 0.0:
                share = min(grows, seen.displacement / before.displacement)
                top = max(top, MachineReading(share * before.force, share * before.displacement))
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

    def _whole_until(self, state: State, first: MachineReading) -> float:
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

    def _first(self, limits: Floats) -> MachineReading:
        """Bond by bond, in their order: exact."""
        assert self.elastic is not None
        share = float(self.elastic.strains.load_at(limits).min())
        return MachineReading(
            share * self.elastic.full.force, share * self.elastic.full.displacement
        )


def seeded(experiment: Experiment, seed: int) -> Experiment:
    """The experiment with another seed: strengths and random fields are drawn anew."""
    varies = any(getattr(part, "varying", None) for part in (experiment.rule, experiment.fracture))
    if not varies:
        return experiment.model_copy(update={"seed": seed})
    source = experiment.as_written()
    source = with_value(source, "seed", seed, "the seed of a specimen", Experiment.defaults())
    return Experiment.build(source, given_classes(experiment))


COARSE, FINE = 40, 64
"""Nodes along a parameter: to find where the likelihood is, and to integrate it."""
NEGLIGIBLE = 18.0
"""Below the largest logarithm: less than 2e-8 of it."""
DRAWS = 20_000
DEPTH = 1e-8
"""The share of the weakest specimen's strain that counts as none."""
LawBounds = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class Breaks:
    """Load factors of specimens, (specimen,), and whether each broke there or bore more."""

    load: Floats
    broke: Mask


@dataclass(frozen=True)
class WeightedSamples:
    """Parameters that go with the measurement, (draw, parameter), and how much each counts."""

    values: Floats
    weights: Floats


class StrengthLaw(ABC):
    """A distribution of strengths with two parameters, by their paths in an experiment."""

    paths: ClassVar[tuple[str, str]]

    @staticmethod
    @abstractmethod
    def whole(path: str) -> float:
        """The number at a path with which no bond breaks."""

    @abstractmethod
    def draws(self, strains: BondStrains, breaks: Breaks, bounds: LawBounds) -> WeightedSamples:
        """From the integrated likelihood between bounds."""

    @staticmethod
    @abstractmethod
    def variation(first: Floats, second: Floats) -> Floats:
        """The coefficient of variation of strengths."""


class WeibullLaw(StrengthLaw):
    """F(ε) = 1 - exp(-(ε/s)^m)."""

    paths = ("fracture.scale", "fracture.modulus")

    @staticmethod
    def whole(path: str) -> float:
        """A scale out of reach, and hardly any scatter."""
        return 1e60 if path == "fracture.scale" else 1000.0

    @staticmethod
    def variation(first: Floats, second: Floats) -> Floats:
        """√(Γ(1 + 2/m)/Γ(1 + 1/m)² - 1)."""
        from scipy.special import gammaln

        return np.asarray(np.sqrt(np.expm1(gammaln(1 + 2 / second) - 2 * gammaln(1 + 1 / second))))

    def draws(self, strains: BondStrains, breaks: Breaks, bounds: LawBounds) -> WeightedSamples:
        """For a modulus, Σ_specimens Σ_b ε^m / s^m is gamma-distributed with the number of
        failures; moduli are drawn from what is left when that is integrated."""
        from scipy.special import gammainc, gammaincinv

        count = int(breaks.broke.sum())

        def logarithm(log_m: Floats) -> tuple[Floats, Floats]:
            """Of the density of ln m, and of the sum."""
            m = np.exp(log_m)
            sums, slopes = weibull_sums(strains, breaks, m)
            total = np.logaddexp.reduce(sums, axis=1)
            density = slopes[:, breaks.broke].sum(axis=1) - log_m - count * total
            inside = [gammainc(count, np.exp(np.minimum(total - m * np.log(end), 700.0)))
                      for end in bounds[0]]  # fmt: skip
            with np.errstate(divide="ignore"):
                return density + np.log(np.maximum(inside[0] - inside[1], 0.0)), total

        nodes = _nodes(bounds[1])
        (nodes,) = _where(logarithm(nodes)[0], nodes)
        density, total = logarithm(nodes)
        order = (np.arange(DRAWS) + 0.5) / DRAWS
        share = np.exp(density - density.max())
        within = np.concatenate([[0.0], np.cumsum((share[1:] + share[:-1]) / 2)])
        log_m = np.interp(order, within / within[-1], nodes)
        m, log_total = np.exp(log_m), np.interp(log_m, nodes, total)
        low, high = (gammainc(count, np.exp(np.minimum(log_total - m * np.log(end), 700.0)))
                     for end in reversed(bounds[0]))  # fmt: skip
        # A low-discrepancy sequence beside `order`: the same draws whenever the fit is made.
        other = (np.arange(DRAWS) * 0.6180339887498949 + 0.5) % 1.0
        log_s = (log_total - np.log(gammaincinv(count, low + other * (high - low)))) / m
        return WeightedSamples(np.stack([np.exp(log_s), m], axis=1), np.full(DRAWS, 1.0 / DRAWS))


def weibull_sums(strains: BondStrains, breaks: Breaks, m: Floats) -> tuple[Floats, Floats]:
    """For each modulus and load ln Σ_b ε^m, and the logarithm of its rate by the load, (modulus,
    specimen)."""
    with np.errstate(divide="ignore"):
        strain = np.log(strains.at(breaks.load))
        rate = np.where(strain > -np.inf, strains.rate(breaks.load), 1.0)
    top = strain.max(axis=1, keepdims=True)
    sums, slopes = np.empty((2, len(m), len(strain)))
    for n, each in enumerate(m):
        share = np.exp(each * (strain - top)) * strains.count
        sums[n] = np.log(share.sum(axis=1)) + each * top[:, 0]
        grows = (share * rate * np.exp(-np.maximum(strain - top, -700.0))).sum(axis=1)
        slopes[n] = np.log(each * grows) + (each - 1.0) * top[:, 0]
    return sums, slopes


class UniformLaw(StrengthLaw):
    """Uniform within f (1 ± s): from a = f (1 - s), w = 2 f s wide."""

    paths = ("fracture.failure", "fracture.scatter")

    @staticmethod
    def whole(path: str) -> float:
        """A strain out of reach, the same for all."""
        return 1e60 if path == "fracture.failure" else 0.0

    @staticmethod
    def variation(first: Floats, second: Floats) -> Floats:
        """s/√3."""
        return np.asarray(second / np.sqrt(3.0))

    def draws(self, strains: BondStrains, breaks: Breaks, bounds: LawBounds) -> WeightedSamples:
        """On a grid of ln w and of how far a lies below what the weakest specimen bore."""
        strain, rate = strains.at(breaks.load), strains.rate(breaks.load)
        lowest = float(strain[breaks.broke].max(axis=1).min())

        def logarithm(depth: Floats, log_w: Floats) -> Floats:
            a, w = lowest - np.exp(depth)[:, None], np.exp(log_w)[None, :]
            matters = strain.max(axis=0) > a.min()
            parts = strain[:, matters], rate[:, matters], strains.count[matters], breaks.broke
            found = np.array([[_uniform(*parts, x, y) for y in w[0]] for x in a[:, 0]])
            f, s = a + w / 2, w / np.maximum(2 * a + w, 1e-300)
            inside = (a > 0.0) & (f >= bounds[0][0]) & (f <= bounds[0][1])
            inside &= (s >= bounds[1][0]) & (s <= bounds[1][1])
            return np.where(inside, found + depth[:, None], -np.inf)

        depth = np.log(lowest) + np.linspace(np.log(DEPTH), -1e-9, COARSE)
        widths = 2 * bounds[0][0] * bounds[1][0], 2 * bounds[0][1] * bounds[1][1]
        log_w = _nodes(widths)
        depth, log_w = _where(logarithm(depth, log_w), depth, log_w)
        found = logarithm(depth, log_w)
        a, w = np.meshgrid(lowest - np.exp(depth), np.exp(log_w), indexing="ij")
        weights = np.exp(found - found.max()).ravel()
        values = np.stack([a + w / 2, w / (2 * a + w)], axis=-1).reshape(-1, 2)
        return WeightedSamples(values[weights > 0.0], weights[weights > 0.0] / weights.sum())


def _uniform(strain: Floats, rate: Floats, count: Floats, broke: Mask, a: float, w: float) -> float:
    """The logarithm of the likelihood, -inf where a specimen bore what no bond does."""
    z = (strain - a) / w
    if z.max() >= 1.0 or z[broke].max(axis=1).min() <= 0.0:
        return -np.inf
    left = 1.0 - np.maximum(z, 0.0)
    rates = np.where(z > 0.0, count * rate / left, 0.0)[broke].sum(axis=1) / w
    return float(np.log(rates).sum() + (np.log(left) @ count).sum())


def _nodes(ends: tuple[float, float]) -> Floats:
    """The logarithms from end to end."""
    return np.linspace(np.log(ends[0]), np.log(ends[1]), COARSE)


def _where(found: Floats, *nodes: Floats) -> tuple[Floats, ...]:
    """Finer nodes along each axis over where the logarithms are not negligible."""
    if not np.isfinite(found).any():
        raise ExperimentError(
            "no strengths between the bounds go with these peaks: take wider ones, and look "
            "whether the peaks are in the experiment's units",
            ("unknown",),
        )
    kept = found > found.max() - NEGLIGIBLE
    finer = []
    for axis, each in enumerate(nodes):
        some = np.flatnonzero(kept.any(axis=tuple({*range(kept.ndim)} - {axis})))
        low, high = max(some[0] - 1, 0), min(some[-1] + 1, len(each) - 1)
        finer.append(np.linspace(each[low], each[high], FINE))
    return tuple(finer)


LAWS: dict[str, StrengthLaw] = {"weibull": WeibullLaw(), "uniform": UniformLaw()}
OF_FRACTURE = {"weibull": "weibull", "strain": "uniform"}
"""The law of the strengths of a fracture model, by its type."""


LIMITS = (0.025, 0.975)
MIDDLE = (0.15865525393145707, 0.8413447460685429)
CUT = 1.02
"""An interval ends at a bound that is no farther away, as a ratio."""
SHIFT = 0.25
"""The share of the standard error of the mean of ln peak by which peaks may lie above first breaks:
an interval of 95 % that is so far off holds 94.3 %."""


@dataclass(frozen=True)
class StrengthEstimate:
    """A median with its standard error, half of the interval that holds 68.3 %, and the ends of
    that of 95 %. `told` is False where the data cannot tell it; `cut` is True where a bound ends
    the interval, beyond which it might go on."""

    value: float
    error: float
    low: float
    high: float
    told: bool = True
    cut: bool = False

    def __str__(self) -> str:
        if not self.told:
            return "the data cannot tell it"
        digits = max(0, 1 - int(np.floor(np.log10(max(self.error, 1e-12)))))
        value, error, low, high = (
            f"{each:.{digits}f}" for each in (self.value, self.error, self.low, self.high)
        )
        text = f"{value} ± {error}, 95 % from {low} to {high}"
        return text + (", cut off by its bounds" if self.cut else "")


@dataclass(frozen=True)
class Checked:
    """How far above the load of their first break specimens were borne: the mean of ln peak/first
    over `count` torn ones, and how many bore more; `limit` is what does no harm."""

    excess: float
    bore_more: int
    count: int
    limit: float

    @classmethod
    def of(cls, excess: Sequence[float], peaks: Floats) -> Checked:
        """From that of each, against the spread of what was measured."""
        limit = SHIFT * float(np.log(peaks).std(ddof=1)) / len(peaks) ** 0.5
        more = sum(each > 1e-6 for each in excess)
        return cls(float(np.mean(excess)), more, len(excess), limit)

    @property
    def holds(self) -> bool:
        """Whether the first break counts as the failure of the specimen."""
        return self.excess <= self.limit

    def __str__(self) -> str:
        how = f"{self.bore_more} of {self.count} torn specimens bore more than at their first break"
        if self.holds:
            return f"the first break is the failure: {how}"
        return (
            f"the first break is not the failure: {how}, on average {np.expm1(self.excess):.1%} "
            f"more; no harm does {np.expm1(self.limit):.2%}"
        )


@dataclass(frozen=True)
class FittedStrength:
    """The answer of a strength fit.

    `values` by path, `correlations` (parameter, parameter), `variation`, the coefficient of
    variation of bonds, where their law is known. `method` is how they were found; `checked` whether
    specimens fail at their first break, None where that was not looked at. `draws` are parameters
    as the measurement leaves them open.
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
        """The same with what was seen of torn specimens."""
        return replace(self, checked=checked)

    def as_dict(self) -> dict[str, Any]:
        """All of it in plain values, as the JSON file holds it."""
        checked = self.checked
        return {
            "values": {path: _plain(each) for path, each in self.values.items()},
            "correlations": {
                one: {other: float(self.correlations[n, m]) for m, other in enumerate(self.values)}
                for n, one in enumerate(self.values)
            },
            "coefficient_of_variation": self.variation and _plain(self.variation),
            "method": self.method,
            "specimens": self.specimens,
            "broke": self.failed,
            "first_break_is_failure": None if checked is None else checked.holds,
            "excess": None if checked is None else checked.excess,
        }

    def lines(self) -> Iterator[str]:
        """What to tell first."""
        for path, estimate in self.values.items():
            yield f"{path}: {estimate}"
        if self.variation and all(each.told for each in self.values.values()):
            yield f"coefficient of variation of strengths: {self.variation}"
        for n, one in enumerate(self.values):
            for m, other in list(enumerate(self.values))[n + 1 :]:
                if abs(self.correlations[n, m]) > 0.5:
                    yield f"correlation of {one} and {other}: {self.correlations[n, m]:.2f}"
        kept = self.specimens - self.failed
        yield f"by {self.method}, of {self.specimens} specimens" + (
            f", {kept} of which did not break" if kept else ""
        )
        if self.checked:
            yield str(self.checked)
        elif self.method == "likelihood":
            yield "taken for granted: a specimen fails as its first bond breaks"


def fitted_strength(
    fit: StrengthFit,
    paths: Sequence[str],
    draws: WeightedSamples,
    method: str,
    law: StrengthLaw | None,
) -> FittedStrength:
    """The answer in words of the fit file."""
    values = {}
    for n, path in enumerate(paths):
        low, high = fit.unknown[path]
        found = _estimate(draws.values[:, n], draws.weights)
        cut = min(found.low / low, high / found.high) < CUT
        values[path] = replace(found, told=found.error <= TELLS * (high - low), cut=cut)
    variation = None
    if law is not None:
        each = draws.values[:, [list(paths).index(path) for path in law.paths]]
        variation = _estimate(law.variation(each[:, 0], each[:, 1]), draws.weights)
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
    if not estimate.told:
        return dict.fromkeys(("value", "error", "low", "high", "cut")) | {"told": False}
    return asdict(estimate)


SHARES = 0.2, 0.2, 0.6
"""Of specimens: over the bounds, then twice where the measurement is likely."""
POINTS = 2**14
"""At which the likelihood is evaluated."""
LIKELY, WIDER = 8.0, 0.25
"""Logarithms below the largest likelihood that is still looked at, and by how much of itself the
box around these points is made wider."""
TURNS, MOST = 50, 3.0
"""Of the regression of the spread, and the largest step in ln of a variance."""
AMPLE = 1.25
"""The load of the experiment over the largest that was measured, at least."""


@dataclass(frozen=True)
class PeakDistribution:
    """How ln peak is distributed over ln parameters in a box: its mean and the logarithm of its
    variance are quadratic; `skewness` and `kurtosis` are those of what is left."""

    low: Floats
    high: Floats
    mean: Floats
    log_variance: Floats
    inverse: Floats
    skewness: float
    kurtosis: float

    @classmethod
    def of(cls, logs: Floats, y: Floats) -> PeakDistribution:
        """By the likelihood of normal numbers, mean and variance in turn."""
        nothing = np.zeros(0)
        ends = logs.min(axis=0), logs.max(axis=0)
        found = cls(*ends, nothing, nothing, nothing, 0.0, 3.0)
        x = found.terms(logs)
        gamma = np.zeros(x.shape[1])
        mean, *_ = np.linalg.lstsq(x, y, rcond=None)
        gamma[0] = np.log(np.mean((y - x @ mean) ** 2))
        for _ in range(TURNS):
            weight = np.exp(-x @ gamma)
            mean = np.linalg.solve((x.T * weight) @ x, x.T @ (weight * y))
            step, *_ = np.linalg.lstsq(x, (y - x @ mean) ** 2 * weight - 1.0, rcond=None)
            gamma += np.clip(step, -MOST, MOST)
        z = (y - x @ mean) * np.exp(-x @ gamma / 2.0)
        z = (z - z.mean()) / z.std()
        inverse = np.linalg.inv((x.T * np.exp(-x @ gamma)) @ x)
        more = float(np.mean(z**3)), float(np.mean(z**4))
        return replace(
            found,
            mean=mean,
            log_variance=gamma,
            inverse=inverse,
            skewness=more[0],
            kurtosis=more[1],
        )

    def terms(self, logs: Floats) -> Floats:
        """1, what is linear and what is quadratic, (point, term), over the box from -1 to 1."""
        x = 2.0 * (logs - self.low) / (self.high - self.low) - 1.0
        pairs = combinations_with_replacement(range(x.shape[1]), 2)
        return np.column_stack([np.ones(len(x)), x, *(x[:, a] * x[:, b] for a, b in pairs)])

    def likelihood(self, logs: Floats, y: Floats) -> Floats:
        """Its logarithm at points: the mean of the measured ln peaks y and ln of their standard
        deviation have the variances σ²/n and (κ - 1)/4n, and the covariance σ · skewness/2n; what
        few torn specimens leave open of mean and variance is added."""
        n, x = len(y), self.terms(logs)
        variance = np.exp(x @ self.log_variance)
        open_ = np.einsum("pi,ij,pj->p", x, self.inverse, x)
        share = 1.0 / n + open_ / variance
        width = (self.kurtosis - 1.0) / 4.0
        a = y.mean() - x @ self.mean
        b = np.log(y.std(ddof=1)) - x @ self.log_variance / 2.0 + width / (2.0 * n)
        v, w, c = variance * share, width * share, np.sqrt(variance) * self.skewness / 2.0 * share
        determinant = v * w - c**2
        away = (w * a**2 - 2.0 * c * a * b + v * b**2) / determinant
        return np.asarray(-(away + np.log(determinant)) / 2.0)


def simulated(fit: StrengthFit, experiment: Experiment, specimens: Specimens) -> WeightedSamples:
    """Strengths that go with the measured peaks, between the bounds, on which the logarithm is
    spread evenly. Raises ExperimentError."""
    if not fit.measured.failed.all():
        raise ExperimentError(
            "tests that ended before the specimen broke cannot be compared with torn specimens; "
            "leave them out",
            ("measured", "broke"),
        )
    if fit.measured.of == "factor":
        text = "torn specimens show forces and displacements, no factor"
        raise ExperimentError(text, ("measured", "of"))
    _refuse_short_load(specimens, float(fit.measured.values.max()))
    y = np.log(fit.measured.values)
    box = whole = np.log(list(fit.unknown.values())).T
    logs, peaks = np.zeros((0, len(fit.unknown))), np.zeros(0)
    for stage, share in enumerate(SHARES):
        more = _spread(box, int(share * fit.simulations), fit.seed + stage)
        found = _torn(fit, experiment, specimens, more, len(logs))
        logs, peaks = np.vstack([logs, more]), np.concatenate([peaks, found])
        inside = ((logs >= box[0]) & (logs <= box[1])).all(axis=1)
        model, points = (
            PeakDistribution.of(logs[inside], peaks[inside]),
            _spread(box, POINTS, fit.seed),
        )
        logarithm = model.likelihood(points, y)
        near = points[logarithm > logarithm.max() - LIKELY]
        margin = WIDER * np.ptp(near, axis=0)
        box = np.clip([near.min(axis=0) - margin, near.max(axis=0) + margin], *whole)
    weights = np.exp(logarithm - logarithm.max())
    return WeightedSamples(np.exp(points), weights / weights.sum())


def _spread(box: Floats, count: int, seed: int) -> Floats:
    """Points all over a box, (point, parameter): Sobol's, scrambled."""
    from scipy.stats import qmc

    whole = qmc.Sobol(box.shape[1], seed=seed).random_base2(int(np.ceil(np.log2(count))))
    return np.asarray(box[0] + whole[:count] * (box[1] - box[0]))


def _torn(
    fit: StrengthFit, experiment: Experiment, specimens: Specimens, logs: Floats, begun: int
) -> Floats:
    """ln peak of one specimen a point."""
    found = []
    for n, point in enumerate(np.exp(logs).tolist()):
        there = experiment
        for path, value in zip(fit.unknown, point, strict=True):
            there = Parameter(path).put(there, value)
        specimen = specimens.torn(seeded(there, (fit.seed << 20) + begun + n))
        found.append(np.log(specimen.peak_of(fit.measured.of)))
    return np.array(found)


def _refuse_short_load(specimens: Specimens, largest: float) -> None:
    """Those that outlast the load count with what they bore by its end: that has to be far above
    what was measured."""
    if (elastic := specimens.elastic) is None:
        return
    of = specimens.peaks.of
    full = elastic.full.force if of == "force" else elastic.full.displacement
    if full < AMPLE * largest:
        raise ExperimentError(
            f"the experiment's load ends at a {of} of {full:.4g} while nothing breaks, and the "
            f"strongest specimen bore {largest:.4g}: let the leaders go "
            f"{AMPLE * largest / full:.3g} times as far, or farther",
            ("leaders",),
        )


def fit_strength_of(fit: StrengthFit, experiment: Experiment) -> FittedStrength:
    """Carries a strength fit out, on one thread. Raises ExperimentError for what cannot be
    fitted."""
    with one_thread():
        if fit.method == "simulation":
            return _by_simulation(fit, experiment, None)
        found = _by_likelihood(fit, experiment)
        if fit.method == "auto" and found.checked and not found.checked.holds:
            return _by_simulation(fit, experiment, found.checked)
        return found


def _by_likelihood(fit: StrengthFit, experiment: Experiment) -> FittedStrength:
    law = _law(fit, experiment)
    if {*fit.unknown} != {*law.paths}:
        raise ExperimentError(
            f"the likelihood is of {' and '.join(law.paths)}, both: give bounds of these",
            ("unknown",),
        )
    elastic = _elastic(fit, experiment, law)
    full = getattr(elastic.full, "displacement" if fit.measured.of == "displacement" else "force")
    if np.isnan(full):
        raise ExperimentError(
            f"the rule '{experiment.rule.type}' knows no forces; take 'elastic' or another "
            "calibrated rule, or peaks of: displacement",
            ("measured", "of"),
        )
    if full <= 0.0:
        raise ExperimentError(
            f"under the experiment's load the {fit.measured.of} is {full:g}: nothing pulls along "
            "the way of the leader group",
            ("measured", "of"),
        )
    strains = elastic.strains.merged()
    breaks = Breaks(fit.measured.values / full, fit.measured.failed)
    if not (strains.at(breaks.load).max(axis=1) > 0.0).all():
        raise ExperimentError("no bond is drawn out under this load", ("leaders",))
    first, second = (fit.unknown[path] for path in law.paths)
    draws = law.draws(strains, breaks, (first, second))
    found = fitted_strength(fit, law.paths, draws, "likelihood", law)
    return found.with_check(_checked(fit, experiment, law, elastic, found))


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
            f"of what law strengths are is not known of fracture '{kind}'; give law: weibull or "
            "uniform, or take method: simulation",
            ("law",),
        )
    if OF_FRACTURE.get(kind, name) != name:
        raise ExperimentError(
            f"the strengths of fracture '{kind}' are {OF_FRACTURE[kind]}, not {name}", ("law",)
        )
    return LAWS[name]


def _checked(
    fit: StrengthFit,
    experiment: Experiment,
    law: StrengthLaw,
    elastic: ElasticResponse,
    found: FittedStrength,
) -> Checked | None:
    """Whether specimens of the strengths found fail as their first bond breaks; None where the
    experiment says nothing of what happens then."""
    kind = experiment.fracture.type
    if (
        not fit.check
        or OF_FRACTURE.get(kind) is None
        or elastic.pull is None
        or not elastic.full.force > 0.0
    ):
        return None
    for path in law.paths:
        experiment = Parameter(path).put(experiment, found.values[path].value)
    specimens = Specimens.of(experiment, fit.measured, elastic)
    torn = [specimens.torn(seeded(experiment, fit.seed + n)) for n in range(fit.check)]
    return Checked.of([_excess(each, fit.measured.of) for each in torn], fit.measured.values)


def _excess(specimen: Specimen, of: str) -> float:
    """ln of its peak over that of its first break."""
    assert specimen.first is not None
    return float(np.log(specimen.peak_of(of) / specimen.first_of(of)))


def _by_simulation(
    fit: StrengthFit, experiment: Experiment, checked: Checked | None
) -> FittedStrength:
    for path in fit.unknown:
        Parameter(path).value_in(experiment)
    elastic = None
    if (name := OF_FRACTURE.get(experiment.fracture.type)) and experiment.rule.linear:
        elastic = _elastic(fit, experiment, LAWS[name])
    specimens = Specimens.of(experiment, fit.measured, elastic)
    if not knows_forces(specimens.scene):
        raise ExperimentError(
            f"the rule '{experiment.rule.type}' knows no forces, so that torn specimens have no "
            "peak; take 'elastic' or another calibrated rule",
            ("rule",),
        )
    draws: WeightedSamples = simulated(fit, experiment, specimens)
    law = LAWS[name] if name and {*fit.unknown} == {*LAWS[name].paths} else None
    found = fitted_strength(fit, tuple(fit.unknown), draws, "simulation", law)
    return found.with_check(checked)
