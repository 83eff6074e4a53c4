"""Observations of a fit: what an equilibrium or a run predicts for the displacements, tracks and
forces that were measured.

A measured boundary carries noise, and prescribing it prescribes the noise. The displacement of each
group that moves by `measured` is therefore a polynomial along it, for which the measured values are
only the start: its coefficients are estimated with all other unknowns.

Points between particles are interpolated bilinearly in the cells of the lattice. Derivatives of
what is measured while an experiment runs are central differences of order 8 of whole runs, between
which no bond may break otherwise; where the run ends at rest, the differences make as many steps as
the run did, since that number is no smooth function of the parameters.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from itertools import combinations
from typing import Any, ClassVar, Self

import numpy as np
import shapely
from numpy.typing import NDArray

from pbdkit.components.diagnostics import reactions
from pbdkit.equilibrium.certificate import UnconvergedError
from pbdkit.errors import ExperimentError
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.sensitivity import Resting, scene_like
from pbdkit.io.snapshot import StateMoment, Tables
from pbdkit.io.vtkhdf import polygons_of
from pbdkit.lattice.cells import tiling_of
from pbdkit.lattice.fill import margin_of, sites_from, sublattices_from, tolerance_of
from pbdkit.lattice.raster import FOLLOWER, Raster
from pbdkit.model.bodies import (
    Body,
    Composed,
    Difference,
    Disc,
    Dogbone,
    Grid,
    Intersection,
    Polygon,
    Rectangle,
    Ring,
)
from pbdkit.model.experiment import Experiment
from pbdkit.model.motions import Measured
from pbdkit.model.solver import Record
from pbdkit.plugin import Lattice
from pbdkit.plugin.frame import Indices
from pbdkit.scene.leaders import Leading
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.simulation import FAILED, Simulation
from pbdkit.stepping.state import Floats, State, initial_state

STRAIGHT = 1e-6
"""The share of its length by which a group may be off a line."""


@dataclass(frozen=True)
class Boundary:
    """A leader group, by its place among them, and its modes (particle, mode)."""

    group: int
    leading: Leading
    modes: Floats

    @property
    def size(self) -> int:
        """How many coefficients: a mode along each axis."""
        return int(self.modes.shape[1]) * len(self.leading.axes)

    def start(self, steps: int) -> Floats:
        """The coefficients of what was measured, (axis · mode,)."""
        n = steps - self.leading.group.from_ + 1
        found, *_ = np.linalg.lstsq(self.modes, self.leading.offset(n), rcond=None)
        return np.asarray(found.T.ravel())

    def displacements(self, coefficients: Floats) -> Floats:
        """(particle, axis): what they come to."""
        return np.asarray(self.modes @ coefficients.reshape(len(self.leading.axes), -1).T)

    def moved(self, experiment: Experiment, coefficients: Floats) -> Experiment:
        """The experiment with these in place of what was measured."""
        given = self.leading.group
        full = np.zeros_like(self.leading.reference)
        full[:, list(self.leading.axes)] = self.displacements(coefficients)
        motion = Measured(
            points=tuple(map(tuple, self.leading.reference.tolist())),
            displacements=tuple(map(tuple, full.tolist())),
            ramp=given.motion.ramp if isinstance(given.motion, Measured) else 1,
        )
        leaders = list(experiment.leaders)
        leaders[self.group] = given.model_copy(update={"motion": motion})
        return experiment.model_copy(update={"leaders": tuple(leaders)})

    def planes(self, scene: Scene, n: int) -> Floats:
        """The displacement of coefficient n alone, (axis, sublattice, cell, cell)."""
        axis, mode = divmod(n, self.modes.shape[1])
        planes = np.zeros((scene.axes, *scene.raster.shape))
        flat = planes.reshape(scene.axes, -1)
        flat[self.leading.axes[axis], self.leading.place] = self.modes[:, mode]
        return planes


def boundaries(scene: Scene, modes: int) -> tuple[Boundary, ...]:
    """Of every group that moves as it was measured. Raises ExperimentError for one that is no
    line, for too few particles, and for one that another group leads along the same axis."""
    found = []
    for n, leading in enumerate(scene.leading):
        if isinstance(leading.group.motion, Measured):
            _refuse_shared(scene, n)
            found.append(Boundary(n, leading, _polynomials(leading.reference, modes, n)))
    return tuple(found)


def _refuse_shared(scene: Scene, n: int) -> None:
    own, steps = scene.leading[n], scene.experiment.steps
    for k, other in enumerate(scene.leading):
        alike = {*own.axes} & {*other.axes} and own.group.leads(steps) and other.group.leads(steps)
        shared = np.intersect1d(own.rows, other.rows)
        if k != n and alike and len(shared):
            x, y = scene.raster.reference(shared[:1])[0]
            raise ExperimentError(
                f"leader groups {min(k, n)} and {max(k, n)} share the particle at ({x:g}, {y:g}), "
                "and the displacement of a measured boundary is estimated by itself, so that there "
                "would be two of it; select it in one group, by a box that ends before the corner, "
                "or let `modes: 0` take boundaries as they were measured",
                ("leaders", n, "select"),
            )


def _polynomials(at: Floats, modes: int, n: int) -> Floats:
    """Legendre's along a line, (particle, mode)."""
    middle = at.mean(axis=0)
    _, sizes, ways = np.linalg.svd(at - middle, full_matrices=False)
    if sizes[1] > STRAIGHT * sizes[0]:
        raise ExperimentError(
            "the particles of a measured boundary should lie on a line, so that their displacement "
            "can be smooth along it",
            ("leaders", n, "select"),
        )
    if len(at) < modes:
        raise ExperimentError(
            f"{modes} modes are more than the {len(at)} particles of the boundary; take fewer",
            ("leaders", n, "select"),
        )
    along = (at - middle) @ ways[0]
    return np.polynomial.legendre.legvander(along / np.abs(along).max(), modes - 1)


ON_EDGE = 1e-9
"""By what share of a cell a point beside it counts as within."""
OUTSIDE = "they lie in no whole cell of the body, or in one that is torn from the start"
"""The reason to leave a point out."""


@dataclass(frozen=True)
class Interpolation:
    """Points within cells of a body: which of those asked for (point,), the rows of the particles
    around each (point, corner), and the share that each has (point, corner)."""

    inside: NDArray[np.bool_]
    rows: Indices
    shares: Floats

    @classmethod
    def at(cls, scene: Scene, points: Floats) -> Interpolation:
        """The corners of a cell with one site are the four around a point; of others the nearest
        three of a cell of the lattice. A point that lacks one of them, as in a hole, is left out,
        and one between particles whose bond is broken from the start."""
        one = len(scene.raster.lattice.cell().sites) == 1
        found = _in_cells(scene, points) if one else _in_triangles(scene, points)
        return found._where(~_is_torn(scene, found)) if scene.has_fracture else found

    def _where(self, chosen: NDArray[np.bool_]) -> Interpolation:
        """With some of the points inside alone, True for each; the others count as outside."""
        inside = self.inside.copy()
        inside[self.inside] = chosen
        return replace(self.part(chosen), inside=inside)

    def part(self, chosen: NDArray[Any]) -> Interpolation:
        """Of some of the points inside: by their numbers among these, or True for each."""
        return replace(self, rows=self.rows[chosen], shares=self.shares[chosen])

    @cached_property
    def _places(self) -> dict[str, tuple[Raster, Indices]]:
        """Where the rows lie on the last raster that was asked for."""
        return {}

    def of(self, planes: Floats, scene: Scene) -> Floats:
        """(point, axis): the values of planes at the points inside."""
        known, place = self._places.get("last", (None, self.rows))
        if known is not scene.raster:
            place = scene.raster.place_of(self.rows.ravel()).reshape(self.rows.shape)
            self._places["last"] = scene.raster, place
        flat = planes.reshape(len(planes), -1)
        found: Floats = np.einsum("apc,pc->pa", flat[:, place], self.shares)
        return found


def _in_cells(scene: Scene, points: Floats) -> Interpolation:
    raster = scene.raster
    cell = raster.lattice.cell()
    vectors = np.array(cell.vectors, float)
    along = np.linalg.solve(vectors.T, (points - raster.lattice.origin).T).T
    low = np.floor(along + ON_EDGE)
    part = np.clip(along - low, 0.0, 1.0)
    low = low.astype(np.intp)
    x, y = part.T
    corners, shares = [], [(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y]
    for step in ((0, 0), (1, 0), (0, 1), (1, 1)):
        corners.append(raster.rows_of_sites((low + step) * cell.period))
    rows, weights = np.stack(corners, axis=1), np.stack(shares, axis=1)
    unused = weights <= ON_EDGE  # on a side of the cell, or in its corner
    body = np.append(raster.table_kind == FOLLOWER, False)
    inside = np.asarray((body[rows] | unused).all(axis=1))
    rows = np.where(unused | ~inside[:, None], 0, rows)
    return Interpolation(inside, rows[inside], np.where(unused, 0.0, weights)[inside])


def _in_triangles(scene: Scene, points: Floats) -> Interpolation:
    from scipy.spatial import Delaunay

    body = scene.raster.body_rows
    mesh: Any = Delaunay(scene.raster.reference(body))
    found = mesh.find_simplex(points, tol=ON_EDGE)
    whole = _within_cells(scene, body[mesh.simplices])
    inside = (found >= 0) & whole[found]
    there = found[inside]
    transform = mesh.transform[there]
    part = np.einsum("pab,pb->pa", transform[:, :2], points[inside] - transform[:, 2])
    shares = np.concatenate([part, 1.0 - part.sum(axis=1, keepdims=True)], axis=1)
    return Interpolation(inside, body[mesh.simplices[there]], shares)


def _within_cells(scene: Scene, triangles: Indices) -> NDArray[np.bool_]:
    """Whether the corners of each triangle, rows of particles, are corners of one whole cell of the
    lattice; others bridge holes and notches."""
    count = scene.raster.count
    threes = [
        np.sort(rows[:, corners], axis=1)
        for rows in polygons_of(scene)
        for corners in combinations(range(rows.shape[1]), 3)
    ]
    known = np.concatenate([*threes, np.zeros((0, 3), np.intp)])
    # Pairs are numbered, so that no number is larger than the square of how many there are.
    pairs, number = np.unique(known[:, :2] @ (count, 1), return_inverse=True)
    keys = number * count + known[:, 2]
    own = np.sort(triangles, axis=1)
    pair = own[:, :2] @ (count, 1)
    at = np.searchsorted(pairs, pair)
    there = np.append(pairs, -1)[at] == pair
    return np.asarray(there & np.isin(at * count + own[:, 2], keys))


def _is_torn(scene: Scene, found: Interpolation) -> NDArray[np.bool_]:
    """Whether a bond between particles around each point inside is broken from the start."""
    broken, bonds = initial_state(scene).broken_step, scene.bonds
    assert broken is not None
    torn = broken.reshape(len(broken), -1)[bonds.plane, bonds.place] >= 0
    keys = bonds.ends[torn] @ (scene.raster.count, 1)
    rows, used = found.rows, found.shares > 0.0
    is_torn = np.zeros(len(rows), bool)
    for a, b in combinations(range(rows.shape[1]), 2):
        pair = np.sort(rows[:, [a, b]], axis=1) @ (scene.raster.count, 1)
        is_torn |= used[:, a] & used[:, b] & np.isin(pair, keys)
    return is_torn


@dataclass(frozen=True)
class FieldEvidence:
    """Displacements measured at points within the body (point, axis): x of all, then y of all.
    `terms` are the exponents of x and y of what the measurement shows besides, of ux and of uy,
    over a `box`, from its lower left to its upper right corner."""

    points: Floats
    measured: Floats
    interpolation: Interpolation = field(repr=False)
    terms: tuple[tuple[tuple[int, int], ...], ...]
    box: tuple[Floats, Floats]

    @classmethod
    def of(
        cls,
        scene: Scene,
        points: Floats,
        displacements: Floats,
        terms: tuple[tuple[tuple[int, int], ...], ...] = ((), ()),
    ) -> FieldEvidence:
        """Of scattered points (point, axis); those outside of the body are left out."""
        found = Interpolation.at(scene, points)
        inside = found.inside
        points = points[inside]
        box = (points.min(axis=0), points.max(axis=0)) if len(points) else (points[0:1], points)
        return cls(points, displacements[inside].T.ravel(), found, terms, box)

    def part(self, chosen: NDArray[np.bool_]) -> FieldEvidence:
        """Of some of the points."""
        return replace(
            self,
            points=self.points[chosen],
            measured=self.measured.reshape(2, -1)[:, chosen].ravel(),
            interpolation=self.interpolation.part(chosen),
        )

    @cached_property
    def distortions(self) -> Floats:
        """The polynomials over the box, from -1 to 1 in it."""
        low, high = self.box
        x, y = (2.0 * (self.points - low) / np.maximum(high - low, 1e-300) - 1.0).T
        columns, n = [], len(x)
        for axis, terms in enumerate(self.terms):
            for p, q in terms:
                column = np.zeros(2 * n)
                column[axis * n : (axis + 1) * n] = x**p * y**q
                columns.append(column)
        return np.stack(columns, axis=1) if columns else np.zeros((2 * n, 0))

    def seen(self, planes: Floats, resting: Resting) -> Floats:
        """Displacements that are given as planes, there."""
        return self.interpolation.of(planes, resting.scene).T.ravel()


@dataclass(frozen=True)
class Carried:
    """What a leader group carries at rest along each axis, over Young's modulus and thickness."""

    resting: Resting
    group: int

    @cached_property
    def predicted(self) -> Floats:
        """(axis,)."""
        return self._reaction(self.resting.scene, self.resting.state.u)

    def change(self, du: Floats, parameter: Parameter | None = None) -> Floats:
        """How that changes, (axis,), where displacements change by du and, if one is named, a
        parameter by 1 with them."""
        scene, u = self.resting.scene, self.resting.state.u
        if self.resting.finder.linear:
            found: Floats = self._reaction(scene, u + du) - self.predicted
        else:
            found = self.resting.along(lambda u: self._reaction(scene, u), du)
        if parameter is not None:
            found = found + parameter.derivative(
                scene.experiment, lambda e: self._reaction(scene_like(scene, e), u)
            )
        return np.asarray(found)

    def _reaction(self, scene: Scene, u: Floats) -> Floats:
        state = self.resting.state.copy()
        state.u = u
        moment = StateMoment(state, Tables(scene))
        return np.asarray(reactions(moment)[self.group])


@dataclass(frozen=True)
class Prediction:
    """At some parameters: the residuals (measured - predicted) / weighted noise, (number,), and how
    the predictions over it change with each parameter, (number, parameter), with each unknown
    of the observation's own, (number, own), and with Young's modulus, (number,)."""

    residuals: Floats
    by_parameter: Floats
    by_own: Floats
    by_modulus: Floats


@dataclass(frozen=True)
class Near:
    """What was seen before, and by what share of the way between its bounds a parameter is away
    from there at most."""

    seen: Prediction
    away: float


@dataclass(frozen=True, kw_only=True)
class Observation(ABC):
    """Numbers that were measured of an experiment. `noise` is their standard deviation; both come
    in `unit`s of what was given. `rows` are the numbers of the rows
    that count among those that were given; `left_out` are of no use, for that reason."""

    kind: ClassVar[str]
    experiment: Experiment
    measured: Floats
    noise: float
    rows: NDArray[np.intp]
    left_out: int = 0
    left_out_because: str = ""
    unit: float = 1.0
    weight: float = 1.0

    @property
    def weighted_noise(self) -> float:
        """The noise over the root of the weight: what residuals are counted in."""
        return float(self.noise / np.sqrt(self.weight))

    @property
    def needs_modulus(self) -> bool:
        """Whether it tells Young's modulus."""
        return False

    @property
    def own(self) -> int:
        """How many unknowns it has beside the parameters."""
        return 0

    def start(self) -> Floats:
        """Where the search for these begins, (own,)."""
        return np.zeros(self.own)

    @abstractmethod
    def at(
        self,
        experiment: Experiment,
        parameters: Sequence[Parameter],
        own: Floats,
        modulus: float,
        near: Near | None = None,
    ) -> Prediction:
        """What there is at an experiment like its own; what was seen `near` there is where
        the search for it may begin. Raises ExperimentError, and
        UnconvergedError where nothing can be predicted."""

    def modulus_terms(self, experiment: Experiment) -> tuple[float, float]:
        """Σ measured · p and Σ p² over the square of the weighted noise, with the predictions p for
        a modulus of 1: their ratio is where the search for it begins."""
        return 0.0, 0.0

    @abstractmethod
    def places(self) -> Floats:
        """Where it was measured, (row, coordinate): what lies near another row tells the same."""

    def part(self, chosen: NDArray[np.bool_]) -> Self:
        """The same of some of its rows, True for each."""
        columns = len(self.measured) // len(self.rows)
        measured = self.measured.reshape(columns, -1)[:, chosen].ravel()
        return replace(self, measured=measured, rows=self.rows[chosen])

    def with_noise(self, noise: float) -> Self:
        """The same with another noise."""
        return replace(self, noise=noise)


def read_at(experiment: Experiment, steps: Sequence[int] | None = None) -> Scene:
    """The scene of an experiment that comes by at these steps, or at those that it records, and
    measures nothing itself. Raises ExperimentError."""
    changed: dict[str, Any] = {"diagnostics": ()}
    if steps is not None:
        changed["record"] = Record(at=tuple(steps))
    return build_scene(experiment.model_copy(update=changed))


@dataclass(frozen=True, kw_only=True)
class RunObservation(Observation):
    """Of a whole run."""

    scene: Scene

    def at(
        self,
        experiment: Experiment,
        parameters: Sequence[Parameter],
        own: Floats,
        modulus: float,
        near: Near | None = None,
    ) -> Prediction:
        """By one run, and eight for each parameter."""
        predicted, broken, steps = self._run(experiment)
        columns = [self._change(experiment, each, broken, steps) for each in parameters]
        rows = len(self.measured)
        scale = modulus if self.needs_modulus else 1.0
        return Prediction(
            (self.measured - scale * predicted) / self.weighted_noise,
            scale * np.array(columns).T.reshape(rows, len(columns)) / self.weighted_noise,
            np.zeros((rows, 0)),
            predicted / self.weighted_noise if self.needs_modulus else np.zeros(rows),
        )

    def modulus_terms(self, experiment: Experiment) -> tuple[float, float]:
        """Of one run."""
        if not self.needs_modulus:
            return 0.0, 0.0
        predicted, *_ = self._run(experiment)
        over = self.weighted_noise**2
        return float(self.measured @ predicted) / over, float(predicted @ predicted) / over

    def _change(
        self, experiment: Experiment, parameter: Parameter, broken: Floats, steps: int
    ) -> Floats:
        """The derivative of the predictions of a run that made so many steps."""

        def predicted(changed: Experiment) -> Floats:
            found, others, _ = self._run(_of_steps(changed, steps))
            if (others != broken).any():
                raise ExperimentError(
                    f"a little more or less of {parameter.path} breaks other bonds: what was "
                    "measured is no smooth function of it; take data before the first break, or "
                    "fit thresholds to repeated tests"
                )
            return found

        return np.asarray(parameter.derivative(experiment, predicted))

    def _run(self, experiment: Experiment) -> tuple[Floats, Floats, int]:
        """What it predicts, (number,), when which bond broke, and after how many steps it ended."""
        mine = self.scene.experiment
        asked = experiment.model_copy(
            update={"record": mine.record, "diagnostics": mine.diagnostics}
        )
        run = Simulation.of_scene(scene_like(self.scene, asked))
        found = self._read(run)
        broken = run.driver.state.broken_step
        when = np.zeros(0) if broken is None else np.asarray(broken, float)
        return found, when, run.driver.state.step

    def _recorded(self, run: Simulation) -> Iterator[tuple[float, State]]:
        """The states that a run records and the moment of each, in steps, and that at which it
        ends. Raises UnconvergedError where it ends without a result."""
        last = -1.0
        for state in run:
            within = run.driver.within
            moment = state.step if within is None else within
            wanted = within is not None or run.scene.experiment.records(state.step)
            if (wanted or run.driver.ending) and moment > last:
                last = moment
                yield moment, state
        if run.outcome is None or run.outcome.status in FAILED:
            reason = run.outcome.stop_reason if run.outcome else "the run did not end"
            raise UnconvergedError(reason)

    @abstractmethod
    def _read(self, run: Simulation) -> Floats:
        """What a run predicts of the numbers that were measured."""


def _of_steps(experiment: Experiment, steps: int) -> Experiment:
    """The experiment with so many steps, all of which are made."""
    changed: dict[str, Any] = {"steps": steps}
    if experiment.solver.makes_steps:
        changed["solver"] = experiment.stepping.model_copy(update={"settle": None})
    return experiment.model_copy(update=changed)


SLACK = 1e-9
"""The share of a run's way by which a row may lie beyond its end."""


@dataclass(frozen=True, kw_only=True)
class CurveObservation(RunObservation):
    """The force that a leader group exerts along a direction, at displacements of the group along
    it until it stops or turns, or at times; over the thickness, and over Young's modulus unless
    that is to be `scaled` by what fits. It is linear between recorded steps."""

    kind: ClassVar[str] = "curve"
    group: int
    way: tuple[float, float]
    at_times: bool
    scaled: bool
    along: Floats

    @property
    def needs_modulus(self) -> bool:
        """Where it is not known."""
        return self.scaled

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        places: Floats,
        forces: Floats,
        noise: float,
        group: int,
        way: tuple[float, float],
        *,
        at_times: bool,
        scaled: bool,
    ) -> CurveObservation:
        """Raises ExperimentError for a group that is not there, and for places that the run does
        not come to."""
        scene = read_at(experiment)
        if group >= len(scene.leading):
            raise ExperimentError(f"there is no leader group {group}", ("measured", "group"))
        return cls(
            experiment=experiment,
            measured=forces,
            noise=noise,
            rows=np.arange(len(forces)),
            scene=scene,
            group=group,
            way=way,
            at_times=at_times,
            scaled=scaled,
            along=places,
        )._within_the_run()

    def _within_the_run(self) -> CurveObservation:
        """Without the rows to which the run does not come. Raises ExperimentError where none is
        left, and for times beyond the run."""
        come, _ = self.curve(Simulation.of_scene(self.scene))
        inside = (self.along >= come.min()) & (self.along <= come.max())
        what = "times" if self.at_times else "displacements of the group"
        ends = f"the run's {what} go from {come.min():g} to {come.max():g}"
        if not inside.any() or (self.at_times and not inside.all()):
            raise ExperimentError(
                f"the curve goes from {self.along.min():g} to {self.along.max():g}, and {ends}; "
                "leave other rows out, or let the experiment go as far",
                ("measured", "file"),
            )
        left_out = int((~inside).sum())
        return replace(self.part(inside), left_out=left_out, left_out_because=ends)

    @property
    def names(self) -> tuple[str, str, bool]:
        """What its numbers are, what they go over, and whether they are one curve."""
        over = "time (step)" if self.at_times else f"displacement of group {self.group}"
        return f"force on group {self.group}", over, True

    def places(self) -> Floats:
        """The displacements or times."""
        return self.along[:, None]

    def part(self, chosen: NDArray[np.bool_]) -> CurveObservation:
        """Of some of them."""
        return replace(super().part(chosen), along=self.along[chosen])

    def _read(self, run: Simulation) -> Floats:
        come, force = self.curve(run)
        beyond = SLACK * (come.max() - come.min())
        if self.along.min() < come.min() - beyond or self.along.max() > come.max() + beyond:
            raise UnconvergedError(
                f"the group goes from {come.min():g} to {come.max():g}, and the curve from "
                f"{self.along.min():g} to {self.along.max():g}"
            )
        return np.interp(self.along, come, force)

    def curve(self, run: Simulation) -> tuple[Floats, Floats]:
        """At each recorded moment, until the group stops or turns, the place (step,) and the force
        over Young's modulus and thickness (step,). After a run has settled its force stays."""
        tables, places, forces = Tables(run.scene), [], []
        for moment, state in self._recorded(run):
            places.append(moment if self.at_times else self._gone(state))
            forces.append(np.dot(self.way, reactions(StateMoment(state, tables))[self.group]))
        if self.at_times and places[-1] < self.experiment.steps:
            places.append(self.experiment.steps)
            forces.append(forces[-1])
        return _going_on(np.array(places, float), np.array(forces))

    def _gone(self, state: State) -> float:
        place = self._leading_place
        flat = state.u.reshape(len(state.u), -1)[:, place]
        return float(np.dot(self.way, flat.mean(axis=1)))

    @cached_property
    def _leading_place(self) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        return np.asarray(self.scene.leading[self.group].place)


def _going_on(places: Floats, forces: Floats) -> tuple[Floats, Floats]:
    """Places as far as they go on one way, rising, and the forces there. Raises ExperimentError
    where they do not at all."""
    ways = np.sign(np.diff(places))
    if not ways.size or ways[0] == 0.0:
        raise ExperimentError(
            "the group does not move along the force in its first recorded step, so that a "
            "displacement names no moment: give `against: time`",
            ("measured", "against"),
        )
    other = np.flatnonzero(ways != ways[0])
    count = int(other[0]) + 1 if other.size else len(places)
    order = slice(None) if ways[0] > 0.0 else slice(None, None, -1)
    return places[:count][order], forces[:count][order]


DERIVATIVES = 1e-5
"""How accurate they are, as a share of the largest: far within any noise."""
CLOSE = 0.02
"""Parameters that are away by so little leave the answers to boundaries as they were, to such a
share: residuals stay exact, and estimates move by that share of their errors."""

NEAR = ", or nearer to its outline than the margin"


@dataclass(frozen=True)
class FieldPrediction(Prediction):
    """With the scene at rest, and the derivative of its displacements by each parameter and by each
    coefficient of boundaries, as planes; the latter may be those of an equilibrium nearby."""

    resting: Resting
    changes: tuple[Floats, ...] = field(repr=False)
    answers: tuple[Floats, ...] = field(repr=False)
    answering: Resting = field(repr=False)
    """Whose answers these are."""
    away: float = 0.0
    """How far these parameters are from there at most, as `Near.away` counts."""


@dataclass(frozen=True, kw_only=True)
class FieldObservation(Observation):
    """Its own unknowns are the coefficients of the boundaries, then the strengths of the
    distortions."""

    kind: ClassVar[str] = "field"
    scene: Scene
    evidence: FieldEvidence
    boundaries: tuple[Boundary, ...]

    @classmethod
    def of(
        cls,
        scene: Scene,
        evidence: FieldEvidence,
        noise: float,
        modes: int,
        among: NDArray[np.bool_] | None = None,
    ) -> FieldObservation:
        """With so many modes along each measured boundary; 0 takes it as it was measured. The
        evidence was chosen `among` the rows that are True."""
        inside = evidence.interpolation.inside if among is None else among
        rows = np.flatnonzero(among) if among is not None else np.arange(len(inside))
        return cls(
            experiment=scene.experiment,
            measured=evidence.measured,
            noise=noise,
            rows=rows[evidence.interpolation.inside],
            left_out=len(inside) - len(evidence.points),
            left_out_because=OUTSIDE + (NEAR if among is not None and not among.all() else ""),
            scene=scene,
            evidence=evidence,
            boundaries=boundaries(scene, modes) if modes else (),
        )

    @property
    def own(self) -> int:
        """Coefficients and strengths."""
        return self._coefficients + int(self.evidence.distortions.shape[1])

    @property
    def _coefficients(self) -> int:
        return sum(b.size for b in self.boundaries)

    def start(self) -> Floats:
        """Boundaries as they were measured, and no distortion."""
        known = [b.start(self.experiment.steps) for b in self.boundaries]
        return np.concatenate([*known, np.zeros(self.own - self._coefficients)])

    def places(self) -> Floats:
        """The points."""
        return self.evidence.points

    def part(self, chosen: NDArray[np.bool_]) -> FieldObservation:
        """Of some of them."""
        return replace(super().part(chosen), evidence=self.evidence.part(chosen))

    def at(
        self,
        experiment: Experiment,
        parameters: Sequence[Parameter],
        own: Floats,
        modulus: float,
        near: Near | None = None,
    ) -> FieldPrediction:
        """At its equilibrium."""
        n = 0
        for boundary in self.boundaries:
            experiment = boundary.moved(experiment, own[n : n + boundary.size])
            n += boundary.size
        before = near.seen if near and isinstance(near.seen, FieldPrediction) else None
        resting = Resting.of(experiment, before.resting if before else self.scene, DERIVATIVES)
        changes = [resting.change(parameter) for parameter in parameters]
        away = before.away + near.away if before and near else np.inf
        if before and away < CLOSE and resting.finder.linear:
            answers, answering = before.answers, before.answering
        else:
            answers, answering, away = self._answers(resting), resting, 0.0
        by = [self.evidence.seen(du, resting) / self.weighted_noise for du in (*changes, *answers)]
        rows, count = len(self.measured), len(parameters)
        beside = self.evidence.distortions / self.weighted_noise
        predicted = self.evidence.seen(resting.state.u, resting)
        residuals = (self.measured - predicted) / self.weighted_noise - beside @ own[n:]
        return FieldPrediction(
            residuals,
            np.array(by[:count]).T.reshape(rows, count),
            np.column_stack([*by[count:], beside]) if by[count:] else beside,
            np.zeros(rows),
            resting,
            tuple(changes),
            answers,
            answering,
            away,
        )

    def _answers(self, resting: Resting) -> tuple[Floats, ...]:
        """The derivative of the displacements by each coefficient of the boundaries."""
        return tuple(
            resting.answer(boundary.planes(resting.scene, m))
            for boundary in self.boundaries
            for m in range(boundary.size)
        )


ON_STEP = 1e-9
"""The share of a step by which a time beside one counts as on it."""


@dataclass(frozen=True, kw_only=True)
class TracksObservation(RunObservation):
    """Displacements of points at times, x of all, then y of all. Between steps, and between
    particles, they are linear; after a run has settled they stay."""

    kind: ClassVar[str] = "tracks"
    along: Floats
    points: Floats
    interpolation: Interpolation

    @classmethod
    def of(
        cls, experiment: Experiment, times: Floats, points: Floats, u: Floats, noise: float
    ) -> TracksObservation:
        """Of times (row,), points (row, axis) and displacements (row, axis). Raises
        ExperimentError where a time lies beyond the run."""
        if times.min() < 0.0 or times.max() > experiment.steps:
            raise ExperimentError(
                f"times go from {times.min():g} to {times.max():g}, and the run from 0 to "
                f"{experiment.steps}; times are counted in steps",
                ("measured", "file"),
            )
        steps = np.unique(np.concatenate([np.floor(times), np.ceil(times)])).astype(int)
        scene = read_at(experiment, steps.tolist())
        found = Interpolation.at(scene, points)
        inside = found.inside
        return cls(
            experiment=experiment,
            measured=u[inside].T.ravel(),
            noise=noise,
            rows=np.flatnonzero(inside),
            left_out=int((~inside).sum()),
            left_out_because=OUTSIDE,
            scene=scene,
            along=times[inside],
            points=points[inside],
            interpolation=found,
        )

    @property
    def names(self) -> tuple[str, str, bool]:
        """What its numbers are, what they go over, and whether they are one curve."""
        return "displacements (lattice unit)", "time (step)", False

    def places(self) -> Floats:
        """The points."""
        return self.points

    def part(self, chosen: NDArray[np.bool_]) -> TracksObservation:
        """Of some of them."""
        return replace(
            super().part(chosen),
            along=self.along[chosen],
            points=self.points[chosen],
            interpolation=self.interpolation.part(chosen),
        )

    def _read(self, run: Simulation) -> Floats:
        found, left = np.zeros((len(self.along), 2)), np.ones(len(self.along))
        for moment, state in self._recorded(run):
            share = np.maximum(0.0, 1.0 - np.abs(self.along - moment))
            self._add(found, share, state, run)
            left -= share
        # A run that has settled stays where it is.
        after = self.along > run.driver.state.step
        self._add(found, np.where(after, left, 0.0), run.driver.state, run)
        if (missing := ~after & (left > ON_STEP)).any():
            raise ExperimentError(
                f"the run gives no state at time {self.along[missing][0]:g}; leave that time out",
                ("measured", "file"),
            )
        return np.asarray(found.T.ravel())

    def _add(self, found: Floats, share: Floats, state: State, run: Simulation) -> None:
        """Adds a share of a state, by row, to the displacements that were found."""
        if (rows := np.flatnonzero(share)).size:
            part = self.interpolation.part(rows)
            found[rows] += share[rows, None] * part.of(state.u, run.scene)


CORNERS = 1024
"""Straight parts of a quarter of a circle, which are within 3e-7 radii of it."""


def deeper(body: Body, lattice: Lattice, points: Floats, margin: float) -> NDArray[np.bool_]:
    """The points of a body, (point,), whose distance to its outline is at least that of a margin,
    but for rounding."""
    rounding = tolerance_of(body, lattice)
    return np.asarray(depths(body, lattice, points) >= margin - 2.0 * rounding)


def depths(body: Body, lattice: Lattice, points: Floats) -> Floats:
    """The distance of points to the outline of a body, (point,), below 0 outside of it."""
    region = _region(body, lattice, tolerance_of(body, lattice))
    if region.is_empty:
        return np.zeros(len(points))
    rings = shapely.get_parts(region.boundary)
    coordinates, ring = shapely.get_coordinates(rings, return_index=True)
    follows = ring[1:] == ring[:-1]
    sides = shapely.linestrings(np.stack([coordinates[:-1], coordinates[1:]], axis=1)[follows])
    at = shapely.points(points)
    (_, _), distance = shapely.STRtree(sides).query_nearest(
        at, return_distance=True, all_matches=False
    )
    shapely.prepare(region)
    return np.asarray(np.where(shapely.intersects(region, at), distance, -distance))


def _region(body: Body, lattice: Lattice, rounding: float, removed: bool = False) -> Any:
    """The region of a body, or of one that is removed from another; sides within `rounding` of
    each other are one."""
    if isinstance(body, Grid):
        return _of_sites(body, lattice, removed)
    if isinstance(body, Composed):
        others = removed != isinstance(body, Difference)
        parts = [
            _region(part, lattice, rounding, removed if n == 0 else others)
            for n, part in enumerate(body.of)
        ]
        if isinstance(body, Difference):
            join = shapely.difference
        else:
            join = shapely.intersection if isinstance(body, Intersection) else shapely.union
        return reduce(lambda a, b: join(a, b, grid_size=rounding), parts)
    return _of_outline(body)


def _of_outline(body: Body) -> Any:
    """The region within an outline."""
    if isinstance(body, Rectangle):
        (x, y), width, height = body.origin, body.width, body.height
        return shapely.box(x, y, x + width, y + height)
    if isinstance(body, Disc):
        return _disc(body.centre, body.radius)
    if isinstance(body, Ring):
        return shapely.difference(_disc(body.centre, body.outer), _disc(body.centre, body.inner))
    if isinstance(body, Polygon):
        return shapely.Polygon(body.vertices)
    assert isinstance(body, Dogbone)
    return _dogbone(body)


def _disc(centre: tuple[float, ...], radius: float) -> Any:
    return shapely.Point(centre).buffer(radius, quad_segs=CORNERS)


def _dogbone(body: Dogbone) -> Any:
    """Its upper right quarter, mirrored."""
    rise = min((body.width - body.gauge_width) / 2.0, body.radius)
    angle = np.linspace(0.0, np.arccos(1.0 - rise / body.radius), CORNERS)
    x = body.gauge_length / 2.0 + body.radius * np.sin(angle)
    y = body.gauge_width / 2.0 + body.radius * (1.0 - np.cos(angle))
    end, half = body.length / 2.0, body.width / 2.0
    quarter = np.vstack([np.c_[x, y], [[x[-1], half], [end, half]]])
    left = quarter[::-1] * (-1.0, 1.0)
    upper = np.vstack([left, quarter])
    outline = np.vstack([upper, upper[::-1] * (1.0, -1.0)])
    return shapely.Polygon(outline + np.add(body.origin, (end, half)))


def _of_sites(grid: Grid, lattice: Lattice, removed: bool) -> Any:
    """The cells whose corners all are sites of a grid; where these are removed, all that have a
    corner among them."""
    cell = lattice.cell()
    tiling = tiling_of(cell, ((),) * len(cell.sites))
    margin = margin_of(tiling)
    low, shape = (-margin, -margin), (grid.columns + 2 * margin, grid.rows + 2 * margin)
    sublattice = sublattices_from(cell, low, shape)
    inside = np.zeros(shape, bool)
    inside[margin:-margin, margin:-margin] = sublattice[margin:-margin, margin:-margin] >= 0
    sides = []
    for polygon in tiling.polygons:
        steps = np.array([corner.site for corner in polygon.corners])
        first = np.argwhere(sublattice == polygon.source)
        corners = first[:, None] + steps
        corners = corners[((corners >= 0) & (corners < shape)).all(axis=(1, 2))]
        numbers = np.ravel_multi_index(tuple(np.moveaxis(corners, -1, 0)), shape)
        among = inside.ravel()[numbers]
        chosen = numbers[among.any(axis=1) if removed else among.all(axis=1)]
        sides.append(np.stack([chosen, np.roll(chosen, -1, axis=1)], axis=-1).reshape(-1, 2))
    every = np.concatenate(sides)
    count = inside.size
    outer = every[~np.isin(every @ (count, 1), every @ (1, count))]
    at = np.stack([plane.ravel() for plane in sites_from(lattice, low, shape).at], axis=1)
    faces = shapely.get_parts(shapely.polygonize(shapely.linestrings(at[outer])))
    return shapely.union_all(faces)
