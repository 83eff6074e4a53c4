"""The load at which bonds break in a body whose displacements grow in proportion to the load.

With d the difference along a bond under the experiment's full load, the strain under a share λ of
it is ε(λ) = |r + λ d| / |r| - 1 = √(1 + 2 λ p + λ² q) - 1, p = r·d/|r|², q = |d|²/|r|². It is
convex and 0 at λ = 0, so that a bond that is strained is strained the more the larger λ.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pbdkit.components.forces import reactions
from pbdkit.equilibrium.finder import finder_of
from pbdkit.equilibrium.increments import increments
from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.experiment.solvers import Equilibrium
from pbdkit.fitting.strength_specification import Peaks
from pbdkit.interfaces import BreaksAtStrain, Calibrated
from pbdkit.results.moment import StateMoment
from pbdkit.results.progress import Watch
from pbdkit.results.tables import Tables
from pbdkit.scene.places import Places
from pbdkit.scene.raster import FOLLOWER
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stepping.state import Floats, State, initial_state

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


class Seen(NamedTuple):
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

    def seen(self, tables: Tables, state: State) -> Seen:
        """Both along the way; the displacement is the mean of the group's particles."""
        carried = np.full(len(self.way), np.nan)
        if knows_forces(tables.scene):
            carried = reactions(StateMoment(state, tables))[self.group]
        return Seen(self.factor * float(self.way @ carried), self.moved(tables.scene, state))

    def moved(self, scene: Scene, state: State) -> float:
        """The displacement alone."""
        return float(self.way @ _mean(scene, state, self.group))


def _mean(scene: Scene, state: State, group: int) -> Floats:
    place = scene.leading[group].place
    return np.asarray(state.u.reshape(scene.axes, -1)[:, place].mean(axis=1))


@dataclass(frozen=True)
class Elastic:
    """A body before anything breaks, under the experiment's full load: its displacements u as
    planes, how its bonds are strained, and what is seen of it, if a leader group is asked for."""

    strains: BondStrains
    pull: Pull | None
    full: Seen
    u: Floats

    @classmethod
    def of(cls, experiment: Experiment, peaks: Peaks) -> Elastic:
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
            return cls(strains, None, Seen(1.0, 1.0), state.u)
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
