"""Position of the tip of a crack in a measured field.

A crack of the lattice ends only where a bond crosses its line, so that predictions do not depend
smoothly on the end of a cut. Near a tip with the field K u(x), the field of a tip that lies farther
by δ along the crack is, to first order, K u(x) - δ K ∂u/∂x₁. Its second term is singular as
1/√r and satisfies the equations of elasticity and the free lips, but a body with a crack that ends
at the tip cannot contain it. The two fields ∂u/∂x₁ of modes I and II are therefore displacements
that the measured field contains in addition to those of the body. With their amplitudes A the tip
lies at δ = -A · K / K · K (Roux and Hild 2006, Int. J. Fracture 140, 141; Roux, Réthoré and Hild
2009, J. Phys. D 42, 214004). The end of the cut is moved to the place nearest to the tip, and the
fit is repeated, until the tip remains nearest to this place.

The two terms also contain the distance, which is different in the two modes, between the tip of a
lattice and that of a continuum with the same field at a distance. They thus remove most of the
error of K that is due to the lattice.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pbdkit.array_types import Floats
from pbdkit.components.stress_intensity import (
    Cracks,
    Frame,
    IsotropicPlane,
    StressIntensity,
    Tip,
    side_of,
    stiffness_at,
)
from pbdkit.equilibrium.error_bound import UnconvergedError
from pbdkit.errors import ExperimentError, no_such
from pbdkit.fitting.derived import Response
from pbdkit.fitting.fit_file import CrackTip
from pbdkit.fitting.observations import FieldObservation, FieldPrediction, TipFields
from pbdkit.fitting.problem import Problem, Solution
from pbdkit.fitting.uncertainty import Estimate
from pbdkit.io.snapshot import StateMoment, Tables
from pbdkit.model.experiment import Experiment
from pbdkit.plugin.units import in_lengths
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stepping.state import initial_state

CORE = 3.0
"""Distance from the tip up to which points are not used, in sides of a cell.

The displacements of a lattice differ from those of a continuum there.
"""
SAME_PLACE = 1e-9
"""Distance between two places that are regarded as one, in sides of a cell."""
MAX_FITS = 20
"""Maximum number of fits by which the tip is located."""


@dataclass(frozen=True)
class LocatedTip:
    """Position of a crack tip in a measured field.

    Parameters
    ----------
    position : tuple of float
        Position in lattice units.
    extension : Estimate
        Distance from the end of the cut in the experiment, positive if the crack is longer.
    of_data : float
        Standard error due to the noise of the measurement.
    of_lattice : float
        Standard deviation of a position between two places at which the crack of the lattice ends.
    cut_end : tuple of float
        End of the cut in the fitted experiment.
    """

    position: tuple[float, float]
    extension: Estimate
    of_data: float
    of_lattice: float
    cut_end: tuple[float, float]

    def __str__(self) -> str:
        x, y = self.position
        return f"({x:.6g}, {y:.6g}), {self.extension} beyond the end of the cut"

    def as_dict(self) -> dict[str, Any]:
        """Return the position and its errors as plain values."""
        return asdict(self)


class CrackLine(NamedTuple):
    """Line on which the tip of a crack is searched.

    Parameters
    ----------
    end : array of float, shape (2,)
        End of the cut in the experiment.
    direction : array of float, shape (2,)
        Unit vector along the crack.
    places : array of float, shape (place,)
        Distances from the end at which bonds cross the line, in increasing order.
    """

    end: Floats
    direction: Floats
    places: Floats

    @classmethod
    def of(cls, scene: Scene, tip: CrackTip) -> CrackLine:
        """Return the line of a cut.

        Raises
        ------
        ExperimentError
            If there is no such cut, or if no bond crosses the line.
        """
        cuts = scene.experiment.cuts
        if tip.cut >= len(cuts):
            raise ExperimentError(no_such("cut", tip.cut, len(cuts)), ("crack_tip", "cut"))
        segment = cuts[tip.cut].segment
        start, end = map(np.array, segment if tip.end == "to" else segment[::-1])
        frame = Frame(end, (end - start) / math.dist(start, end))
        rows = scene.bonds.ends
        a, b = (frame.of(scene.raster.reference(rows[:, n])) for n in (0, 1))
        crosses = (a[:, 1] >= 0.0) != (b[:, 1] >= 0.0)
        a, b = a[crosses], b[crosses]
        places = np.sort(a[:, 0] - a[:, 1] * (b[:, 0] - a[:, 0]) / (b[:, 1] - a[:, 1]))
        places = places[np.diff(places, prepend=-math.inf) > SAME_PLACE * _side(scene)]
        places = places[abs(places) <= tip.within]
        if len(places) < 3 or -math.dist(start, end) >= places[0]:
            raise ExperimentError(
                "the line of the cut has no three places within this distance at which bonds cross "
                "it, or the distance exceeds the length of the cut; choose another distance",
                ("crack_tip", "within"),
            )
        return cls(end, frame.direction, places)

    def nearest(self, distance: float) -> int:
        """Return the number of the place nearest to a distance.

        Raises
        ------
        UnconvergedError
            If the distance lies outside the range of the places.
        """
        n = int(abs(self.places - distance).argmin())
        if not 0 < n < len(self.places) - 1:
            raise UnconvergedError(
                f"the crack tip lies {abs(distance):.3g} lattice units "
                f"{'ahead of' if distance > 0.0 else 'behind'} the end of the cut, beyond "
                "`crack_tip.within`; move the end of the cut, or increase `within`"
            )
        return n

    def cut_end(self, place: int) -> Floats:
        """Return an end of the cut before a place: bonds that cross the line there are intact, and
        those behind are broken."""
        behind, ahead = self.places[place - 1 : place + 1].tolist()
        return np.asarray(self.end + (behind + ahead) / 2.0 * self.direction)

    def spacing(self, place: int) -> float:
        """Return the mean distance from a place to both neighbours."""
        return float(self.places[place + 1] - self.places[place - 1]) / 2.0


Solve = Callable[
    [Experiment, Callable[[FieldObservation], FieldObservation]], tuple[Problem, Solution]
]
"""Type of a function that fits an experiment to changed observations."""


def locate_tip(
    tip: CrackTip, experiment: Experiment, solve: Solve
) -> tuple[Problem, Solution, LocatedTip]:
    """Fit an experiment, and move the end of a cut to the place nearest to the crack tip.

    Parameters
    ----------
    tip
        Tip in the fit file.
    experiment
        The experiment.
    solve
        Function that returns the problem and the solution for an experiment. It applies a given
        function to the observation of the field.

    Raises
    ------
    ExperimentError
        If the material at the tip is anisotropic, or the tip has no stress intensity factors.
    UnconvergedError
        If the tip is not located.
    """
    line = CrackLine.of(build_scene(experiment), tip)
    place, fitted, remaining = line.nearest(0.0), experiment, dict[int, float]()
    for count in range(MAX_FITS):
        end = line.cut_end(place)
        changed = _with_end(experiment, tip, end)
        terms = TipTerms(_with_end(fitted, tip, end), line, place)
        problem, solution = solve(changed, terms.added_to)
        distance = terms.distance(problem, solution)
        remaining[place] = abs(distance - terms.place)
        target = line.nearest(distance)
        is_nearest = target == place or remaining[place] <= remaining.get(target, -1.0)
        # The terms depend on the unknown parameters, which the first fit estimates.
        if is_nearest and (count or not problem.unknowns):
            return problem, solution, terms.located(problem, solution)
        (observation,) = problem.observations
        place, fitted = target, problem.experiment_at(observation, solution.z)
    raise UnconvergedError(
        f"the crack tip is not located after {MAX_FITS} fits; start closer to it, or exclude "
        "faulty points near the crack"
    )


def _with_end(experiment: Experiment, tip: CrackTip, end: Floats) -> Experiment:
    """Return the experiment in which a cut has another end."""
    cuts = list(experiment.cuts)
    name = "to" if tip.end == "to" else "from_"
    cuts[tip.cut] = cuts[tip.cut].model_copy(update={name: tuple(end.tolist())})
    return experiment.model_copy(update={"cuts": tuple(cuts)})


class TipTerms:
    """Terms of a measured field that are due to the distance between its crack tip and a place.

    Parameters
    ----------
    experiment
        Experiment with a crack to this place.
    line
        Line of the crack.
    place
        Number of the place.
    """

    def __init__(self, experiment: Experiment, line: CrackLine, place: int) -> None:
        self._line, self._number = line, place
        end = line.cut_end(place)
        scene = build_scene(experiment.model_copy(update={"diagnostics": ()}))
        moment = StateMoment(initial_state(scene), Tables(scene))
        at = Tip(at=(float(end[0]), float(end[1])), direction=_pair(line.direction))
        frame = Cracks(moment.cells.table(), moment).tip(at)
        if frame is None or (material := IsotropicPlane.of(stiffness_at(moment, end))) is None:
            raise ExperimentError(
                "the tip is located in isotropic materials only, with a cut that breaks bonds",
                ("crack_tip",),
            )
        self._fields, self._core = TipFields(frame, material), CORE * _side(scene)
        self.place = float((frame.origin - line.end) @ line.direction)
        self._diagnostic = StressIntensity(youngs_modulus=1.0, tips=(at,))

    def added_to(self, observation: FieldObservation) -> FieldObservation:
        """Return the observation with these terms, without the points close to the tip."""
        points = observation.evidence.points
        is_far = np.hypot(*(points - self._fields.frame.origin).T) > self._core
        part = observation.part(is_far)
        return replace(
            part,
            evidence=replace(part.evidence, tip=self._fields),
            left_out=observation.left_out + int((~is_far).sum()),
            left_out_because=f"{observation.left_out_because}, or lie within {CORE:g} cells of the "
            "crack tip",
        )

    def distance(self, problem: Problem, solution: Solution) -> float:
        """Return the distance of the tip from the end of the cut in the experiment."""
        K, A = self._intensities(problem, solution), solution.z[self._columns(problem)]
        return float(self.place - A @ K / (K @ K))

    def _intensities(self, problem: Problem, solution: Solution) -> Floats:
        """Return K_I and K_II divided by Young's modulus."""
        prediction = solution.at.predictions[0]
        assert isinstance(prediction, FieldPrediction)
        values = Response(prediction, problem, solution).values(self._diagnostic)
        K = np.array(values[:2]).ravel()
        if not np.isfinite(K).all():
            raise ExperimentError(
                "the crack tip has no stress intensity factors, because no domain around it is of "
                "sufficient size; use a finer lattice or a larger field",
                ("crack_tip",),
            )
        return K

    def located(self, problem: Problem, solution: Solution) -> LocatedTip:
        """Return the position of the tip with its standard error.

        The error of K is negligible, since the distance from the place is that between two places.
        """
        K, gradient = self._intensities(problem, solution), np.zeros(problem.size)
        gradient[self._columns(problem)] = -K / (K @ K)
        of_data = solution.directions.error_of(gradient)
        of_lattice = self._line.spacing(self._number) / math.sqrt(12.0)
        distance = self.distance(problem, solution)
        size, unit = in_lengths(problem.observations[0].experiment.units)
        total = size * float(np.hypot(of_data, of_lattice))
        return LocatedTip(
            _pair(self._line.end + distance * self._line.direction),
            Estimate(size * distance, total, unit=unit),
            size * of_data,
            size * of_lattice,
            _pair(self._line.cut_end(self._number)),
        )

    def _columns(self, problem: Problem) -> slice:
        """Return the slice of the amplitudes of the terms in the unknowns."""
        ((observation, own),) = problem.own_slices()
        assert isinstance(observation, FieldObservation)
        first = own.start + observation.coefficients
        return slice(first, first + 2)


def _pair(vector: Floats) -> tuple[float, float]:
    return float(vector[0]), float(vector[1])


def _side(scene: Scene) -> float:
    """Return the length of the longest side of a cell."""
    return max(
        side_of(np.array([[*place] for place in patch.polygon.rest])) for patch in scene.patches
    )
