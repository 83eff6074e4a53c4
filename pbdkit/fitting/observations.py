"""Observations of a fit: predictions of measured displacements, tracks and forces.

They are computed from an equilibrium or a run. If the measured displacements of a boundary were
prescribed, their noise would be prescribed too. The displacement of each leader group with the
motion `measured` is therefore a polynomial along the boundary. Its coefficients are estimated
together with all other unknowns, starting from the measured values.

Displacements between particles are interpolated bilinearly in the cells of the lattice. The
predictions of a run are differentiated by central differences of order 8. For these differences the
whole run is repeated with modified parameters, and the same bonds must break in all runs. If the
first run ends in equilibrium, the other runs make the same number of steps, because the number of
steps to equilibrium is not a smooth function of the parameters.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from itertools import combinations
from typing import Any, ClassVar, Literal, Self

import numpy as np
import shapely
from numpy.typing import NDArray

from pbdkit.array_types import Floats, Indices
from pbdkit.components.diagnostics import reactions
from pbdkit.components.stress_intensity import Frame, IsotropicPlane, auxiliary
from pbdkit.equilibrium.error_bound import UnconvergedError
from pbdkit.errors import ExperimentError
from pbdkit.fitting.channels import Channel, Time
from pbdkit.fitting.parameter import Parameter
from pbdkit.fitting.sensitivity import RestingScene, scene_like
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
from pbdkit.plugin.units import LENGTH, Quantity
from pbdkit.scene.leader_groups import Leading
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.simulation import FAILED, Simulation
from pbdkit.stepping.state import State, initial_state

MAX_LINE_DEVIATION = 1e-6
"""Largest distance of a particle of a group from the line of the group, relative to the length."""


@dataclass(frozen=True)
class Boundary:
    """A measured boundary.

    Parameters
    ----------
    group, leading
        Number of the leader group, and the group.
    polynomials : (particle, mode)
        Polynomials along the boundary.
    count
        Number of polynomials that are modes of the boundary, from the first.
    is_automatic
        Whether the data determine this number.
    """

    group: int
    leading: Leading
    polynomials: Floats
    count: int
    is_automatic: bool = False

    @property
    def modes(self) -> Floats:
        """Return the polynomials that are used, (particle, mode)."""
        return self.polynomials[:, : self.count]

    @property
    def largest(self) -> int:
        """Return the largest possible number of modes."""
        return int(self.polynomials.shape[1]) if self.is_automatic else self.count

    @property
    def size(self) -> int:
        """Return the number of coefficients, one for each mode and axis."""
        return self.count * len(self.leading.axes)

    def coefficients_of(self, other: Boundary, coefficients: Floats) -> Floats:
        """Return the coefficients for those of the same boundary with another number of modes.

        Coefficients of modes that the other one lacks are 0.
        """
        values = np.zeros((len(self.leading.axes), max(self.count, other.count)))
        values[:, : other.count] = coefficients.reshape(len(values), -1)
        return values[:, : self.count].ravel()

    def start(self, steps: int) -> Floats:
        """Fit the coefficients to the measured displacements, (axis · mode,)."""
        n = steps - self.leading.group.from_ + 1
        coefficients, *_ = np.linalg.lstsq(self.modes, self.leading.offset(n), rcond=None)
        return np.asarray(coefficients.T.ravel())

    def displacements(self, coefficients: Floats) -> Floats:
        """Return the displacements for coefficients, (particle, axis)."""
        return np.asarray(self.modes @ coefficients.reshape(len(self.leading.axes), -1).T)

    def moved(self, experiment: Experiment, coefficients: Floats) -> Experiment:
        """Return the experiment in which the measured displacements are replaced.

        The new displacements are those of the coefficients.
        """
        group = self.leading.group
        full = np.zeros_like(self.leading.reference)
        full[:, list(self.leading.axes)] = self.displacements(coefficients)
        motion = Measured(
            points=tuple(map(tuple, self.leading.reference.tolist())),
            displacements=tuple(map(tuple, full.tolist())),
            ramp=group.motion.ramp if isinstance(group.motion, Measured) else 1,
            outside="nearest",
        )
        leaders = list(experiment.leaders)
        leaders[self.group] = group.model_copy(update={"motion": motion})
        return experiment.model_copy(update={"leaders": tuple(leaders)})

    def planes(self, scene: Scene, n: int) -> Floats:
        """Return the displacements for coefficients of 0, except for coefficient n, which is 1.

        The result is a raster for each axis and sublattice, (axis, sublattice, cell, cell).
        """
        axis, mode = divmod(n, self.count)
        planes = np.zeros((scene.axes, *scene.raster.shape))
        flat = planes.reshape(scene.axes, -1)
        flat[self.leading.axes[axis], self.leading.place] = self.modes[:, mode]
        return planes


MAX_MODES = 12
"""Largest number of modes that is chosen for a boundary."""
INITIAL_MODES = 4
"""Number of modes before it is chosen."""
AUTOMATIC = "auto"
"""Number of modes that the data determine."""
Modes = int | Literal["auto"]
"""Number of modes of a boundary; with 0 the measured displacements are prescribed."""


def boundaries(scene: Scene, modes: Modes | Sequence[Modes]) -> tuple[Boundary, ...]:
    """Return the boundaries of all groups that move by `measured`.

    Parameters
    ----------
    modes
        Number of modes of all of these groups, or of each.

    Raises
    ------
    ExperimentError
        If a group is not on a line, has too few particles, or shares a prescribed particle with
        another group, or if the number of `modes` is not that of the groups.
    """
    groups = [
        (n, leading)
        for n, leading in enumerate(scene.leading)
        if isinstance(leading.group.motion, Measured)
    ]
    counts = [modes] * len(groups) if isinstance(modes, int | str) else [*modes]
    if len(counts) != len(groups):
        raise ExperimentError(
            f"expected a number for each of the {len(groups)} leader groups with the motion "
            f"`measured`, got {len(counts)}",
            ("modes",),
        )
    return tuple(
        _boundary(scene, n, leading, count)
        for (n, leading), count in zip(groups, counts, strict=True)
        if count != 0
    )


def _boundary(scene: Scene, n: int, leading: Leading, modes: Modes) -> Boundary:
    _refuse_shared(scene, n)
    points = leading.reference
    if modes == AUTOMATIC:
        polynomials = _polynomials(points, min(MAX_MODES, len(points)), n)
        return Boundary(n, leading, polynomials, min(INITIAL_MODES, len(points)), is_automatic=True)
    return Boundary(n, leading, _polynomials(points, int(modes), n), int(modes))


def _refuse_shared(scene: Scene, n: int) -> None:
    leading, steps = scene.leading[n], scene.experiment.steps
    for k, other in enumerate(scene.leading):
        overlap = (
            {*leading.axes} & {*other.axes}
            and leading.group.leads(steps)
            and other.group.leads(steps)
        )
        shared = np.intersect1d(leading.rows, other.rows)
        if k != n and overlap and len(shared):
            x, y = scene.raster.reference(shared[:1])[0]
            raise ExperimentError(
                f"leader groups {min(k, n)} and {max(k, n)} share the particle at ({x:g}, "
                f"{y:g}), but the displacement of each measured boundary is estimated "
                "separately; select the particle in one group only, by a box that ends before "
                "the corner, or prescribe measured displacements with `modes: 0`",
                ("leaders", n, "select"),
            )


def _polynomials(points: Floats, modes: int, n: int) -> Floats:
    """Return Legendre polynomials along a line, (particle, mode)."""
    if len(points) < 2:
        raise ExperimentError(
            "a measured boundary needs two particles or more; use the motion `displace` for one",
            ("leaders", n, "select"),
        )
    middle = points.mean(axis=0)
    _, sizes, directions = np.linalg.svd(points - middle, full_matrices=False)
    if sizes[1] > MAX_LINE_DEVIATION * sizes[0]:
        raise ExperimentError(
            "the particles of a measured boundary must lie on a line, along which their "
            "displacement is a polynomial",
            ("leaders", n, "select"),
        )
    if len(points) < modes:
        raise ExperimentError(
            f"{modes} modes exceed the {len(points)} particles of the boundary; use fewer modes",
            ("leaders", n, "select"),
        )
    along = (points - middle) @ directions[0]
    return np.polynomial.legendre.legvander(along / np.abs(along).max(), modes - 1)


ON_EDGE = 1e-9
"""Distance from a cell, relative to its size, up to which a point is treated as inside."""
OUTSIDE = (
    "they do not lie in a complete cell of the body, or lie in one that is torn from the start"
)
"""Reason why points are left out."""


@dataclass(frozen=True)
class Interpolation:
    """Linear interpolation between particles, at those points that lie in cells of the body.

    Parameters
    ----------
    inside : (point,)
        Whether a point lies in a cell.
    rows : (point inside, corner)
        Rows of the particles around each point inside.
    shares : (point inside, corner)
        Weights of these particles.
    """

    inside: NDArray[np.bool_]
    rows: Indices
    shares: Floats

    @classmethod
    def at(cls, scene: Scene, points: Floats) -> Interpolation:
        """Interpolate at points.

        On a lattice with one site in a cell, the four particles around a point are used. On other
        lattices the nearest three corners of a cell are used. Points are excluded if one of these
        particles is missing, for instance in a hole, or if a bond between two of them is broken
        from the start.
        """
        has_one_site = len(scene.raster.cell.sites) == 1
        interpolation = _in_cells(scene, points) if has_one_site else _in_triangles(scene, points)
        return (
            interpolation._restricted(~_is_torn(scene, interpolation))
            if scene.has_fracture
            else interpolation
        )

    def _restricted(self, mask: NDArray[np.bool_]) -> Interpolation:
        """Return the interpolation at some of the points; all other points are treated as
        outside."""
        inside = self.inside.copy()
        inside[self.inside] = mask
        return replace(self.part(mask), inside=inside)

    def part(self, selection: NDArray[Any]) -> Interpolation:
        """Return the interpolation at some of the points inside, given by indices or a mask."""
        return replace(self, rows=self.rows[selection], shares=self.shares[selection])

    @cached_property
    def _places(self) -> dict[str, tuple[Raster, Indices]]:
        """Cache of the positions of the particles in the raster that was used last."""
        return {}

    def of(self, planes: Floats, scene: Scene) -> Floats:
        """Interpolate rasters of displacements at the points inside, (point, axis)."""
        raster, place = self._places.get("last", (None, self.rows))
        if raster is not scene.raster:
            place = scene.raster.place_of(self.rows.ravel()).reshape(self.rows.shape)
            self._places["last"] = scene.raster, place
        flat = planes.reshape(len(planes), -1)
        values: Floats = np.einsum("apc,pc->pa", flat[:, place], self.shares)
        return values


def _in_cells(scene: Scene, points: Floats) -> Interpolation:
    raster = scene.raster
    cell = raster.cell
    vectors = np.array(cell.vectors, float)
    coordinates = np.linalg.solve(vectors.T, (points - raster.lattice.origin).T).T
    low = np.floor(coordinates + ON_EDGE)
    fraction = np.clip(coordinates - low, 0.0, 1.0)
    low = low.astype(np.intp)
    x, y = fraction.T
    corners, shares = [], [(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y]
    for step in ((0, 0), (1, 0), (0, 1), (1, 1)):
        corners.append(raster.rows_of_sites((low + step) * cell.period))
    rows, weights = np.stack(corners, axis=1), np.stack(shares, axis=1)
    is_unused = weights <= ON_EDGE  # The point lies on a side or at a corner of the cell.
    body = np.append(raster.table_kind == FOLLOWER, False)
    inside = np.asarray((body[rows] | is_unused).all(axis=1))
    rows = np.where(is_unused | ~inside[:, None], 0, rows)
    return Interpolation(inside, rows[inside], np.where(is_unused, 0.0, weights)[inside])


def _in_triangles(scene: Scene, points: Floats) -> Interpolation:
    from scipy.spatial import Delaunay

    body = scene.raster.body_rows
    mesh: Any = Delaunay(scene.raster.reference(body))
    simplex = mesh.find_simplex(points, tol=ON_EDGE)
    is_whole = _are_in_cells(scene, body[mesh.simplices])
    inside = (simplex >= 0) & is_whole[simplex]
    simplex_inside = simplex[inside]
    transform = mesh.transform[simplex_inside]
    coordinates = np.einsum("pab,pb->pa", transform[:, :2], points[inside] - transform[:, 2])
    shares = np.concatenate([coordinates, 1.0 - coordinates.sum(axis=1, keepdims=True)], axis=1)
    return Interpolation(inside, body[mesh.simplices[simplex_inside]], shares)


def _are_in_cells(scene: Scene, triangles: Indices) -> NDArray[np.bool_]:
    """Return whether the corners of each triangle are corners of one whole cell of the lattice.

    Triangles that are not in cells bridge holes or notches.
    """
    count = scene.raster.count
    threes = [
        np.sort(rows[:, corners], axis=1)
        for rows in polygons_of(scene)
        for corners in combinations(range(rows.shape[1]), 3)
    ]
    triples = np.concatenate([*threes, np.zeros((0, 3), np.intp)])
    # A pair is represented by one number, below the square of the number of particles.
    pairs, number = np.unique(triples[:, :2] @ (count, 1), return_inverse=True)
    keys = number * count + triples[:, 2]
    ordered = np.sort(triangles, axis=1)
    pair = ordered[:, :2] @ (count, 1)
    index = np.searchsorted(pairs, pair)
    exists = np.append(pairs, -1)[index] == pair
    return np.asarray(exists & np.isin(index * count + ordered[:, 2], keys))


def _is_torn(scene: Scene, interpolation: Interpolation) -> NDArray[np.bool_]:
    """Return for each point inside the body whether a bond between the particles around it is
    broken from the start."""
    broken, bonds = initial_state(scene).broken_step, scene.bonds
    assert broken is not None
    torn = broken.reshape(len(broken), -1)[bonds.plane, bonds.place] >= 0
    keys = bonds.ends[torn] @ (scene.raster.count, 1)
    rows, is_used = interpolation.rows, interpolation.shares > 0.0
    is_torn = np.zeros(len(rows), bool)
    for a, b in combinations(range(rows.shape[1]), 2):
        pair = np.sort(rows[:, [a, b]], axis=1) @ (scene.raster.count, 1)
        is_torn |= is_used[:, a] & is_used[:, b] & np.isin(pair, keys)
    return is_torn


@dataclass(frozen=True)
class TipFields:
    """Derivatives of the fields of modes I and II at a crack tip along the crack, ∂u/∂x₁.

    Parameters
    ----------
    frame
        Frame of the tip.
    material
        Material at the tip.
    """

    frame: Frame
    material: IsotropicPlane

    def at(self, points: Floats) -> Floats:
        """Return both fields at points, (axis · point, mode), for stress intensity factors of 1 and
        a Young's modulus of 1."""
        gradient = auxiliary(self.frame.of(points), self.material)[1][:2, ..., 0]
        return (gradient @ self.frame.axes).transpose(2, 1, 0).reshape(-1, 2)


@dataclass(frozen=True)
class FieldEvidence:
    """A measured field of displacements.

    Parameters
    ----------
    points : (point, axis)
        Points within the body.
    measured : (axis · point,)
        Displacements along the first measured axis of all points, then those along the second one.
    interpolation
        Interpolation at the points.
    terms
        Exponents of x and y of the distortions of ux and of uy.
    box
        Lower left and upper right corner of the points.
    tip
        Fields at a crack tip that the measured field contains in addition to the displacements of
        the body, if the position of the tip is unknown.
    axes
        Indices of the measured axes.
    """

    points: Floats
    measured: Floats
    interpolation: Interpolation = field(repr=False)
    terms: tuple[tuple[tuple[int, int], ...], ...]
    box: tuple[Floats, Floats]
    tip: TipFields | None = None
    axes: tuple[int, ...] = (0, 1)

    @classmethod
    def of(
        cls,
        scene: Scene,
        points: Floats,
        displacements: Floats,
        terms: tuple[tuple[tuple[int, int], ...], ...] = ((), ()),
        axes: tuple[int, ...] = (0, 1),
    ) -> FieldEvidence:
        """Return the field at those scattered points (point, axis) that lie inside the body."""
        interpolation = Interpolation.at(scene, points)
        inside = interpolation.inside
        points = points[inside]
        box = (points.min(axis=0), points.max(axis=0)) if len(points) else (points[0:1], points)
        measured = displacements[inside].T.ravel()
        return cls(points, measured, interpolation, terms, box, axes=axes)

    def part(self, mask: NDArray[np.bool_]) -> FieldEvidence:
        """Select some of the points."""
        return replace(
            self,
            points=self.points[mask],
            measured=self.measured.reshape(len(self.axes), -1)[:, mask].ravel(),
            interpolation=self.interpolation.part(mask),
        )

    @cached_property
    def distortions(self) -> Floats:
        """Return the values of the fields at a crack tip and of the polynomials of the distortions
        at the points.

        Coordinates of polynomials are scaled so that they range from -1 to 1 in the box.
        """
        low, high = self.box
        x, y = (2.0 * (self.points - low) / np.maximum(high - low, 1e-300) - 1.0).T
        n, places = len(x), list(self.axes)
        columns = []
        if self.tip:
            fields = self.tip.at(self.points)
            columns = [*fields.reshape(2, n, -1)[places].reshape(-1, fields.shape[1]).T]
        for place, axis in enumerate(self.axes):
            for p, q in self.terms[axis]:
                column = np.zeros(len(self.axes) * n)
                column[place * n : (place + 1) * n] = x**p * y**q
                columns.append(column)
        return np.stack(columns, axis=1) if columns else np.zeros((len(self.axes) * n, 0))

    def predict(self, planes: Floats, resting_scene: RestingScene) -> Floats:
        """Interpolate displacements at the points. They are given as rasters."""
        displacements = self.interpolation.of(planes, resting_scene.scene)
        return displacements[:, list(self.axes)].T.ravel()


@dataclass(frozen=True)
class GroupReaction:
    """Force of a leader group in equilibrium, along each axis.

    It is divided by Young's modulus and thickness.

    Parameters
    ----------
    resting_scene
        The equilibrium.
    group
        Number of the group.
    """

    resting_scene: RestingScene
    group: int

    @cached_property
    def predicted(self) -> Floats:
        """Return the force, (axis,)."""
        return self._reaction(self.resting_scene.scene, self.resting_scene.state.u)

    def change(self, du: Floats, parameter: Parameter | None = None) -> Floats:
        """Return the derivative of the force, (axis,).

        Parameters
        ----------
        du
            Derivative of the displacements.
        parameter
            Parameter with respect to which the derivative is taken.
        """
        scene, u = self.resting_scene.scene, self.resting_scene.state.u
        if self.resting_scene.finder.linear:
            result: Floats = self._reaction(scene, u + du) - self.predicted
        else:
            result = self.resting_scene.along(lambda u: self._reaction(scene, u), du)
        if parameter is not None:
            result = result + parameter.derivative(
                scene.experiment,
                lambda experiment: self._reaction(scene_like(scene, experiment), u),
            )
        return np.asarray(result)

    def _reaction(self, scene: Scene, u: Floats) -> Floats:
        state = self.resting_scene.state.copy()
        state.u = u
        moment = StateMoment(state, Tables(scene))
        return np.asarray(reactions(moment)[self.group])


@dataclass(frozen=True)
class Prediction:
    """Residuals and their derivatives at some values of the unknowns.

    Parameters
    ----------
    residuals : (number,)
        (measured - predicted) / weighted noise.
    by_parameter : (number, parameter)
        Derivatives of the predictions, divided by the weighted noise.
    by_own : (number, own unknown)
        The same derivatives with respect to unknowns that only this observation has.
    by_modulus : (number,)
        The same derivatives with respect to Young's modulus.
    """

    residuals: Floats
    by_parameter: Floats
    by_own: Floats
    by_modulus: Floats

    @property
    def is_exact(self) -> bool:
        """Return whether all derivatives are those at the values of the unknowns."""
        return True

    @property
    def is_linear(self) -> bool:
        """Return whether residuals are linear in the unknowns that only the observation has."""
        return True


@dataclass(frozen=True)
class NearbyPrediction:
    """A prediction at similar parameters.

    Parameters
    ----------
    prediction
        The prediction.
    away
        Largest difference between a parameter and its value in this prediction, as a fraction of
        the interval between its bounds or, if these span more than an order of magnitude, of the
        value.
    """

    prediction: Prediction
    away: float


@dataclass(frozen=True, kw_only=True)
class Observation(ABC):
    """Measured values, and their prediction by an experiment.

    Parameters
    ----------
    experiment
        The experiment.
    measured : (number,)
        Measured numbers.
    noise
        Standard deviation of the measured values.
    rows : (row,)
        Indices of the rows of the file that are used.
    left_out, left_out_because
        Number of rows that are not used, and the reason.
    unit
        Unit of `measured` and `noise` divided by the unit of the file.
    weight
        Weight of the measurement.
    """

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
        """Return the noise divided by the square root of the weight. Residuals are divided by this
        quotient."""
        return float(self.noise / np.sqrt(self.weight))

    @property
    def needs_modulus(self) -> bool:
        """Return whether predictions are proportional to an unknown Young's modulus."""
        return False

    @property
    def is_smooth(self) -> bool:
        """Return whether predictions are smooth functions of the parameters."""
        return True

    @property
    def quantity(self) -> Quantity | None:
        """Quantity of the measured numbers; None if they have no dimension."""
        return LENGTH

    @property
    def own_unknowns(self) -> int:
        """Return the number of unknowns that only this observation has."""
        return 0

    def start(self) -> Floats:
        """Return the initial values of the unknowns that only this observation has, (own
        unknown,)."""
        return np.zeros(self.own_unknowns)

    @abstractmethod
    def at(
        self,
        experiment: Experiment,
        parameters: Sequence[Parameter],
        own_values: Floats,
        modulus: float,
        near: NearbyPrediction | None = None,
    ) -> Prediction:
        """Predict the measured numbers, with derivatives.

        Parameters
        ----------
        experiment
            Experiment with the values of the parameters.
        parameters
            Parameters of the derivatives.
        own_values : (own unknown,)
            Values of the unknowns that only this observation has.
        modulus
            Young's modulus.
        near
            Prediction at similar parameters, which can serve as initial guess of the solution.

        Raises
        ------
        ExperimentError
            If the experiment is invalid.
        UnconvergedError
            If there is no prediction.
        """

    def moved(self, experiment: Experiment, own_values: Floats) -> Experiment:
        """Return the experiment in which measured boundaries have their estimated displacements."""
        return experiment

    def modulus_terms(self, experiment: Experiment) -> tuple[float, float]:
        """Return two sums, of which the ratio is the initial modulus.

        They are Σ measured · p and Σ p², divided by the square of the weighted noise. p is the
        prediction for a modulus of 1.
        """
        return 0.0, 0.0

    @abstractmethod
    def places(self) -> Floats:
        """Return coordinates of the rows, (row, coordinate).

        Rows with similar coordinates contain similar information.
        """

    def correlated_places(self) -> Floats | None:
        """Return coordinates of the rows; the correlation of residuals depends on their distance.

        The result is None if the correlation does not depend on a distance alone.
        """
        return self.places()

    def part(self, mask: NDArray[np.bool_]) -> Self:
        """Select some of the rows by a mask."""
        columns = len(self.measured) // len(self.rows)
        measured = self.measured.reshape(columns, -1)[:, mask].ravel()
        return replace(self, measured=measured, rows=self.rows[mask])

    def with_noise(self, noise: float) -> Self:
        """Return the observation with another standard deviation of the noise."""
        return replace(self, noise=noise)


def read_at(experiment: Experiment, steps: Sequence[int] | None = None) -> Scene:
    """Build the scene of an experiment without diagnostics, which records some steps.

    Parameters
    ----------
    steps
        Recorded steps; by default those of the experiment.
    """
    changed: dict[str, Any] = {"diagnostics": ()}
    if steps is not None:
        changed["record"] = Record(at=tuple(steps))
    return build_scene(experiment.model_copy(update=changed))


MAX_CACHED_RUNS = 24
"""Maximum number of runs with a control of which the predictions are kept."""
CLOSE_SECANT = 0.05
"""Largest change of parameters after which derivatives of a run with a control are reused, as a
fraction of the interval between the bounds."""


@dataclass(frozen=True)
class RunPrediction(Prediction):
    """Prediction of a run.

    Parameters
    ----------
    columns
        Derivatives of the predictions of the run with respect to the parameters.
    away
        Difference between the parameters and those of `columns`, as in `NearbyPrediction`.
    """

    columns: tuple[Floats, ...] = ()
    away: float = 0.0

    @property
    def is_exact(self) -> bool:
        """Return whether the derivatives are those at the values of the parameters."""
        return self.away == 0.0


@dataclass(frozen=True, kw_only=True)
class RunObservation(Observation):
    """Measured values that are predicted by a run.

    If the run has a control, it follows a softening body, and the predictions are not smooth
    functions of the parameters: they jump where another cell begins to soften. Derivatives are then
    differences over a finite change of the parameters, within one branch.

    Parameters
    ----------
    scene
        Scene of the run.
    runs
        Cache of the last runs with a control: their experiments, rows and predictions.
    """

    scene: Scene
    runs: list[tuple[Experiment, NDArray[np.intp], Floats]] = field(
        default_factory=list, repr=False, compare=False
    )

    @property
    def _is_controlled(self) -> bool:
        return self.scene.experiment.solver.equilibrium.control is not None

    @property
    def is_smooth(self) -> bool:
        """Return whether predictions are smooth functions of the parameters."""
        return not self._is_controlled

    def at(
        self,
        experiment: Experiment,
        parameters: Sequence[Parameter],
        own_values: Floats,
        modulus: float,
        near: NearbyPrediction | None = None,
    ) -> Prediction:
        """Predict the measured values by one run, and derivatives by eight runs for each
        parameter, or by two if the run has a control."""
        away = 0.0
        if self._is_controlled:
            predicted, away = self._followed(experiment), np.inf
            if near and isinstance(near.prediction, RunPrediction):
                columns, away = near.prediction.columns, near.prediction.away + near.away
            if away >= CLOSE_SECANT:
                columns, away = self._differences(experiment, parameters), 0.0
        else:
            predicted, broken, steps = self._run(experiment)
            columns = tuple(self._change(experiment, each, broken, steps) for each in parameters)
        rows = len(self.measured)
        scale = modulus if self.needs_modulus else 1.0
        return RunPrediction(
            (self.measured - scale * predicted) / self.weighted_noise,
            scale * np.array(columns).T.reshape(rows, len(columns)) / self.weighted_noise,
            np.zeros((rows, 0)),
            predicted / self.weighted_noise if self.needs_modulus else np.zeros(rows),
            columns,
            away,
        )

    def _differences(
        self, experiment: Experiment, parameters: Sequence[Parameter]
    ) -> tuple[Floats, ...]:
        """Return the derivatives of predictions under a control, as quotients of differences."""
        return tuple(each.difference(experiment, self._followed) for each in parameters)

    def modulus_terms(self, experiment: Experiment) -> tuple[float, float]:
        """Compute the two sums from one run."""
        if not self.needs_modulus:
            return 0.0, 0.0
        predicted = self._followed(experiment) if self._is_controlled else self._run(experiment)[0]
        variance = self.weighted_noise**2
        return float(self.measured @ predicted) / variance, float(predicted @ predicted) / variance

    def _change(
        self, experiment: Experiment, parameter: Parameter, broken: Floats, steps: int
    ) -> Floats:
        """Differentiate the predictions of a run with a fixed number of steps."""

        def predicted(changed: Experiment) -> Floats:
            numbers, broken_then, _ = self._run(_with_steps(changed, steps))
            if (broken_then != broken).any():
                raise ExperimentError(
                    f"a small change of {parameter.path} breaks other bonds, so that predictions "
                    "are not differentiable; use data before the first break, or fit thresholds "
                    "to repeated tests"
                )
            return numbers

        return np.asarray(parameter.derivative(experiment, predicted))

    def _followed(self, experiment: Experiment) -> Floats:
        """Return the predictions of a run with a control, or those of an equal run that is cached.

        Raises
        ------
        UnconvergedError
            If the branch cannot be followed, or its model is invalid on this lattice.
        """
        for n, (cached, rows, numbers) in enumerate(self.runs):
            if rows is self.rows and cached == experiment:
                self.runs.append(self.runs.pop(n))
                return numbers
        try:
            numbers, *_ = self._run(experiment)
        except ExperimentError as error:
            raise UnconvergedError(str(error)) from None
        self.runs.append((experiment, self.rows, numbers))
        del self.runs[:-MAX_CACHED_RUNS]
        return numbers

    def _run(self, experiment: Experiment) -> tuple[Floats, Floats, int]:
        """Return the predictions, the step in which each bond broke, and the number of steps."""
        original = self.scene.experiment
        changed = experiment.model_copy(
            update={"record": original.record, "diagnostics": original.diagnostics}
        )
        run = Simulation.of_scene(scene_like(self.scene, changed))
        numbers = self._read(run)
        broken = run.driver.state.broken_step
        breaking_steps = np.zeros(0) if broken is None else np.asarray(broken, float)
        return numbers, breaking_steps, run.driver.state.step

    def _recorded(self, run: Simulation) -> Iterator[tuple[float, State]]:
        """Yield time and state of each record of a run, and of its end.

        Raises
        ------
        UnconvergedError
            If the run ends without a result.
        """
        last = -1.0
        for state in run:
            load_time = run.driver.load_time
            moment = state.step if load_time is None else load_time
            is_due = load_time is not None or run.scene.experiment.records(state.step)
            if (is_due or run.driver.ends_early) and moment > last:
                last = moment
                yield moment, state
        if run.outcome is None or run.outcome.status in FAILED:
            reason = run.outcome.stop_reason if run.outcome else "the run did not end"
            raise UnconvergedError(reason)

    @abstractmethod
    def _read(self, run: Simulation) -> Floats:
        """Return the predictions of a run."""


def _with_steps(experiment: Experiment, steps: int) -> Experiment:
    """Return the experiment with a number of steps that all runs make, even if they converge."""
    changed: dict[str, Any] = {"steps": steps}
    if experiment.solver.makes_steps:
        changed["solver"] = experiment.stepping.model_copy(update={"settle": None})
    return experiment.model_copy(update=changed)


SLACK = 1e-9
"""Distance by which a row may lie beyond the range of a run, relative to this range."""


@dataclass(frozen=True, kw_only=True)
class CurveObservation(RunObservation):
    """A channel of a run as a function of another channel, such as force over displacement.

    The curve ends where the abscissa stops or reverses. Forces are divided by the thickness and, if
    it is known, by Young's modulus. Values are interpolated linearly between recorded steps.

    Parameters
    ----------
    value, over
        Measured channel, and the channel of which it is a function.
    scaled
        Whether the value is a force and Young's modulus is unknown.
    along : (number,)
        Values of `over`.
    """

    kind: ClassVar[str] = "curve"
    value: Channel
    over: Channel
    scaled: bool
    along: Floats

    @property
    def needs_modulus(self) -> bool:
        """Return whether Young's modulus is unknown."""
        return self.scaled

    @property
    def quantity(self) -> Quantity | None:
        """Quantity of the measured channel."""
        return self.value.quantity

    @property
    def at_times(self) -> bool:
        """Return whether the curve is a function of time."""
        return isinstance(self.over, Time)

    @classmethod
    def of(
        cls,
        scene: Scene,
        places: Floats,
        values: Floats,
        noise: float,
        channels: tuple[Channel, Channel],
        *,
        scaled: bool,
    ) -> CurveObservation:
        """Return the observation of a curve.

        Parameters
        ----------
        scene
            Scene of the run, as `read_at` returns it.
        places, values : (number,)
            Abscissae and ordinates.
        channels
            Measured channel, and the channel of the abscissae.

        Raises
        ------
        ExperimentError
            If the run does not reach the curve.
        """
        return cls(
            experiment=scene.experiment,
            measured=values,
            noise=noise,
            rows=np.arange(len(values)),
            scene=scene,
            value=channels[0],
            over=channels[1],
            scaled=scaled,
            along=places,
        )._restricted_to_run()

    def _restricted_to_run(self) -> CurveObservation:
        """Return the observation without the abscissae that the run does not reach.

        Raises
        ------
        ExperimentError
            If no row remains. Also if the values are functions of time, and a time lies beyond the
            run.
        """
        low, high = self.over.range_in(self.scene) or self._reached()
        inside = (self.along >= low) & (self.along <= high)
        range_text = f"in the run, the {self.over.label} goes from {low:g} to {high:g}"
        if not inside.any() or (self.at_times and not inside.all()):
            raise ExperimentError(
                (
                    f"the curve goes from {self.along.min():g} to {self.along.max():g}, but "
                    f"{range_text}; remove the rows outside, or extend the experiment"
                ),
                ("measured", "file"),
            )
        left_out = int((~inside).sum())
        return replace(self.part(inside), left_out=left_out, left_out_because=range_text)

    def _reached(self) -> tuple[float, float]:
        """Run the experiment, and return the range of the abscissa."""
        reached, _ = self.curve(Simulation.of_scene(self.scene))
        return float(reached.min()), float(reached.max())

    @property
    def names(self) -> tuple[str, str, bool]:
        """Return labels of the values and of the abscissa, and whether the values are one curve."""
        return self.value.label, self.over.label, True

    def places(self) -> Floats:
        """Return the abscissae of the rows."""
        return self.along[:, None]

    def part(self, mask: NDArray[np.bool_]) -> CurveObservation:
        """Select some of the rows by a mask."""
        return replace(super().part(mask), along=self.along[mask])

    def _read(self, run: Simulation) -> Floats:
        reached, values = self.curve(run)
        slack = SLACK * (reached.max() - reached.min())
        if self.along.min() < reached.min() - slack or self.along.max() > reached.max() + slack:
            raise UnconvergedError(
                f"the {self.over.label} goes from {reached.min():g} to {reached.max():g}, but the "
                f"curve from {self.along.min():g} to {self.along.max():g}"
            )
        return np.interp(self.along, reached, values)

    def curve(self, run: Simulation) -> tuple[Floats, Floats]:
        """Return abscissae and values at recorded steps, (step,).

        Forces are divided by Young's modulus and thickness. The curve ends where the abscissa stops
        or reverses. After a run has converged, values are constant.
        """
        tables, places, values = Tables(run.scene), list[float](), list[float]()
        try:
            for time, state in self._recorded(run):
                places.append(self.over.read(time, state, tables))
                values.append(self.value.read(time, state, tables))
                if self._is_controlled and self._is_within(places):
                    break
        except UnconvergedError:
            if not self._is_within(places):
                raise
        if self.at_times and places[-1] < self.experiment.steps:
            places.append(self.experiment.steps)
            values.append(values[-1])
        return _monotonic_part(np.array(places, float), np.array(values), self.over.label)

    def _is_within(self, places: Sequence[float]) -> bool:
        """Return whether the measured abscissae are within those of a run."""
        return (
            len(places) > 1 and min(places) <= self.along.min() and max(places) >= self.along.max()
        )


def _monotonic_part(
    places: Floats, values: Floats, label: str = "displacement"
) -> tuple[Floats, Floats]:
    """Return the first monotonic part of the abscissae, in increasing order, and its values.

    Raises
    ------
    ExperimentError
        If there is none.
    """
    signs = np.sign(np.diff(places))
    if not signs.size or signs[0] == 0.0:
        raise ExperimentError(
            (
                f"the {label} does not change in the first recorded step, so that it does not "
                "identify a step; give `against: time`, or another `axis`"
            ),
            ("measured", "against"),
        )
    turns = np.flatnonzero(signs != signs[0])
    count = int(turns[0]) + 1 if turns.size else len(places)
    order = slice(None) if signs[0] > 0.0 else slice(None, None, -1)
    return places[:count][order], values[:count][order]


DERIVATIVES = 1e-5
"""Accuracy of derivatives, relative to the largest derivative.

The resulting errors are far below any noise.
"""
CLOSE = 0.02
"""Largest change of parameters after which derivatives with respect to boundaries are reused.

It is a fraction as in `NearbyPrediction`. Residuals are exact in any case, and estimates
change by at most this fraction of their errors.
"""

NEAR = ", or nearer to its outline than the margin"
"""Addition to the reason for which points are excluded, if there is a margin."""


@dataclass(frozen=True)
class FieldPrediction(Prediction):
    """Prediction of a field.

    Parameters
    ----------
    resting_scene
        The equilibrium.
    changes
        Derivatives of the displacements with respect to the parameters, as rasters.
    answers
        Derivatives of the displacements with respect to the coefficients of boundaries. They can be
        those of another equilibrium with similar parameters.
    answering
        The equilibrium at which `answers` were computed.
    away
        Difference between the parameters and those of `answering`, as in `NearbyPrediction`.
    """

    resting_scene: RestingScene
    changes: tuple[Floats, ...] = field(repr=False)
    answers: tuple[Floats, ...] = field(repr=False)
    answering: RestingScene = field(repr=False)
    away: float = 0.0

    @property
    def is_exact(self) -> bool:
        """Return whether the derivatives with respect to boundaries are those of this state."""
        return self.away == 0.0

    @property
    def is_linear(self) -> bool:
        """Return whether the equilibrium is linear in the displacements of boundaries."""
        return self.resting_scene.finder.linear


@dataclass(frozen=True, kw_only=True)
class FieldObservation(Observation):
    """A measured field in equilibrium.

    The unknowns that only this observation has are the coefficients of the boundaries, followed by
    the amplitudes of the distortions.
    """

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
        modes: Modes | Sequence[Modes],
        mask: NDArray[np.bool_] | None = None,
    ) -> FieldObservation:
        """Return the observation of a field.

        Parameters
        ----------
        modes
            Number of modes along each measured boundary, or along all of them; 0 prescribes the
            measured displacements, and `auto` leaves the choice to the data.
        mask
            Mask of the rows from which `evidence` was selected.
        """
        inside = evidence.interpolation.inside if mask is None else mask
        rows = np.flatnonzero(mask) if mask is not None else np.arange(len(inside))
        return cls(
            experiment=scene.experiment,
            measured=evidence.measured,
            noise=noise,
            rows=rows[evidence.interpolation.inside],
            left_out=len(inside) - len(evidence.points),
            left_out_because=OUTSIDE + (NEAR if mask is not None and not mask.all() else ""),
            scene=scene,
            evidence=evidence,
            boundaries=boundaries(scene, modes),
        )

    @property
    def own_unknowns(self) -> int:
        """Return the number of coefficients and amplitudes."""
        return self.coefficients + int(self.evidence.distortions.shape[1])

    @property
    def coefficients(self) -> int:
        """Return the number of coefficients of boundaries."""
        return sum(boundary.size for boundary in self.boundaries)

    def start(self) -> Floats:
        """Return the coefficients of the measured boundaries, and zeros for the distortions."""
        coefficients = [boundary.start(self.experiment.steps) for boundary in self.boundaries]
        return np.concatenate([*coefficients, np.zeros(self.own_unknowns - self.coefficients)])

    def places(self) -> Floats:
        """Return the measured points."""
        return self.evidence.points

    def part(self, mask: NDArray[np.bool_]) -> FieldObservation:
        """Select some of the points by a mask."""
        return replace(super().part(mask), evidence=self.evidence.part(mask))

    def at(
        self,
        experiment: Experiment,
        parameters: Sequence[Parameter],
        own_values: Floats,
        modulus: float,
        near: NearbyPrediction | None = None,
    ) -> FieldPrediction:
        """Predict the field in equilibrium."""
        experiment, n = self.moved(experiment, own_values), self.coefficients
        previous = (
            near.prediction if near and isinstance(near.prediction, FieldPrediction) else None
        )
        resting_scene = RestingScene.of(
            experiment, previous.resting_scene if previous else self.scene, DERIVATIVES
        )
        changes = [resting_scene.change(parameter) for parameter in parameters]
        away = previous.away + near.away if previous and near else np.inf
        if previous and away < CLOSE and resting_scene.finder.linear:
            answers, answering = previous.answers, previous.answering
        else:
            answers, answering, away = self._boundary_derivatives(resting_scene), resting_scene, 0.0
        columns = [
            self.evidence.predict(du, resting_scene) / self.weighted_noise
            for du in (*changes, *answers)
        ]
        rows, count = len(self.measured), len(parameters)
        distortions = self.evidence.distortions / self.weighted_noise
        predicted = self.evidence.predict(resting_scene.state.u, resting_scene)
        residuals = (self.measured - predicted) / self.weighted_noise - distortions @ own_values[n:]
        return FieldPrediction(
            residuals,
            np.array(columns[:count]).T.reshape(rows, count),
            np.column_stack([*columns[count:], distortions]) if columns[count:] else distortions,
            np.zeros(rows),
            resting_scene,
            tuple(changes),
            answers,
            answering,
            away,
        )

    def moved(self, experiment: Experiment, own_values: Floats) -> Experiment:
        """Return the experiment in which boundaries have the displacements of coefficients."""
        n = 0
        for boundary in self.boundaries:
            experiment = boundary.moved(experiment, own_values[n : n + boundary.size])
            n += boundary.size
        return experiment

    def _boundary_derivatives(self, resting_scene: RestingScene) -> tuple[Floats, ...]:
        """Return the derivatives of the displacements with respect to the coefficients of the
        boundaries."""
        return tuple(
            resting_scene.answer(boundary.planes(resting_scene.scene, n))
            for boundary in self.boundaries
            for n in range(boundary.size)
        )


ON_STEP = 1e-9
"""Difference between a time and a step, in steps, up to which both are treated as equal."""


@dataclass(frozen=True, kw_only=True)
class TracksObservation(RunObservation):
    """Measured displacements of points at times: those along the first measured axis of all rows,
    then those along the second one.

    Predictions are interpolated linearly between steps and between particles, and are constant
    after a run has converged.

    Parameters
    ----------
    along : (row,)
        Times in steps.
    points : (row, axis)
        Points in the reference configuration.
    interpolation
        Interpolation at the points.
    axes
        Indices of the measured axes.
    """

    kind: ClassVar[str] = "tracks"
    along: Floats
    points: Floats
    interpolation: Interpolation
    axes: tuple[int, ...] = (0, 1)

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        times: Floats,
        points: Floats,
        u: Floats,
        noise: float,
        axes: tuple[int, ...] = (0, 1),
    ) -> TracksObservation:
        """Return the observation of times (row,), points (row, axis) and displacements (row, axis).

        Raises
        ------
        ExperimentError
            If a time lies beyond the run.
        """
        if times.min() < 0.0 or times.max() > experiment.steps:
            raise ExperimentError(
                (
                    f"times go from {times.min():g} to {times.max():g}, but the run from 0 to "
                    f"{experiment.steps}; times must be in steps"
                ),
                ("measured", "file"),
            )
        steps = np.unique(np.concatenate([np.floor(times), np.ceil(times)])).astype(int)
        scene = read_at(experiment, steps.tolist())
        interpolation = Interpolation.at(scene, points)
        inside = interpolation.inside
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
            interpolation=interpolation,
            axes=axes,
        )

    @property
    def names(self) -> tuple[str, str, bool]:
        """Return labels of the values and of the abscissa, and whether the values are one curve."""
        return "displacements (lattice unit)", "time (step)", False

    def places(self) -> Floats:
        """Return the tracked points."""
        return self.points

    def correlated_places(self) -> None:
        """Return None, because the correlation depends on places and times."""
        return

    def part(self, mask: NDArray[np.bool_]) -> TracksObservation:
        """Select some of the rows by a mask."""
        return replace(
            super().part(mask),
            along=self.along[mask],
            points=self.points[mask],
            interpolation=self.interpolation.part(mask),
        )

    def _read(self, run: Simulation) -> Floats:
        displacements, remainder = np.zeros((len(self.along), 2)), np.ones(len(self.along))
        for moment, state in self._recorded(run):
            weight = np.maximum(0.0, 1.0 - np.abs(self.along - moment))
            self._add(displacements, weight, state, run)
            remainder -= weight
        # The state of a run is constant after it has converged.
        is_after = self.along > run.driver.state.step
        self._add(displacements, np.where(is_after, remainder, 0.0), run.driver.state, run)
        if (missing := ~is_after & (remainder > ON_STEP)).any():
            raise ExperimentError(
                f"the run has no state at time {self.along[missing][0]:g}; remove this time",
                ("measured", "file"),
            )
        return np.asarray(displacements[:, list(self.axes)].T.ravel())

    def _add(self, displacements: Floats, weight: Floats, state: State, run: Simulation) -> None:
        """Add a weighted state to displacements, by row."""
        if (rows := np.flatnonzero(weight)).size:
            part = self.interpolation.part(rows)
            displacements[rows] += weight[rows, None] * part.of(state.u, run.scene)


CORNERS = 1024
"""Number of segments that represent a quarter of a circle, with an error of 3e-7 radii."""


def deeper(body: Body, lattice: Lattice, points: Floats, margin: float) -> NDArray[np.bool_]:
    """Return whether points are at least `margin` inside the outline of a body, (point,).

    Rounding errors are tolerated.
    """
    rounding = tolerance_of(body, lattice)
    return np.asarray(depths(body, lattice, points) >= margin - 2.0 * rounding)


def depths(body: Body, lattice: Lattice, points: Floats) -> Floats:
    """Return an array of shape (point,) with the distances of points to the outline of a body. They
    are negative outside."""
    region = _region(body, lattice, tolerance_of(body, lattice))
    if region.is_empty:
        return np.zeros(len(points))
    rings = shapely.get_parts(region.boundary)
    coordinates, ring = shapely.get_coordinates(rings, return_index=True)
    is_same_ring = ring[1:] == ring[:-1]
    sides = shapely.linestrings(np.stack([coordinates[:-1], coordinates[1:]], axis=1)[is_same_ring])
    places = shapely.points(points)
    (_, _), distance = shapely.STRtree(sides).query_nearest(
        places, return_distance=True, all_matches=False
    )
    shapely.prepare(region)
    return np.asarray(np.where(shapely.intersects(region, places), distance, -distance))


def _region(body: Body, lattice: Lattice, rounding: float, removed: bool = False) -> Any:
    """Return the region of a body, or of a body that is removed from another one.

    Sides with a distance of at most `rounding` are merged.
    """
    if isinstance(body, Grid):
        return _grid_region(body, lattice, removed)
    if isinstance(body, Composed):
        others_removed = removed != isinstance(body, Difference)
        parts = [
            _region(part, lattice, rounding, removed if n == 0 else others_removed)
            for n, part in enumerate(body.of)
        ]
        if isinstance(body, Difference):
            join = shapely.difference
        else:
            join = shapely.intersection if isinstance(body, Intersection) else shapely.union
        return reduce(lambda first, second: join(first, second, grid_size=rounding), parts)
    return _outline_region(body)


def _outline_region(body: Body) -> Any:
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
    """Return the region of a dogbone, constructed from its upper right quarter."""
    rise = min((body.width - body.gauge_width) / 2.0, body.radius)
    angle = np.linspace(0.0, np.arccos(1.0 - rise / body.radius), CORNERS)
    x = body.gauge_length / 2.0 + body.radius * np.sin(angle)
    y = body.gauge_width / 2.0 + body.radius * (1.0 - np.cos(angle))
    end, half = body.length / 2.0, body.width / 2.0
    quarter = np.vstack([np.c_[x, y], [[x[-1], half], [end, half]]])
    mirrored = quarter[::-1] * (-1.0, 1.0)
    upper = np.vstack([mirrored, quarter])
    outline = np.vstack([upper, upper[::-1] * (1.0, -1.0)])
    return shapely.Polygon(outline + np.add(body.origin, (end, half)))


def _grid_region(grid: Grid, lattice: Lattice, removed: bool) -> Any:
    """Return the cells of which all corners are sites of a grid.

    For a grid that is removed from a body, one corner suffices.
    """
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
        is_inside = inside.ravel()[numbers]
        selected = numbers[is_inside.any(axis=1) if removed else is_inside.all(axis=1)]
        sides.append(np.stack([selected, np.roll(selected, -1, axis=1)], axis=-1).reshape(-1, 2))
    all_sides = np.concatenate(sides)
    count = inside.size
    outer = all_sides[~np.isin(all_sides @ (count, 1), all_sides @ (1, count))]
    positions = np.stack([plane.ravel() for plane in sites_from(lattice, low, shape).at], axis=1)
    faces = shapely.get_parts(shapely.polygonize(shapely.linestrings(positions[outer])))
    return shapely.union_all(faces)
