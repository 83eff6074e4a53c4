"""What was measured, as a fit file says it: fields of displacements, tracks in time, curves."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    SerializeAsAny,
    TypeAdapter,
    ValidationInfo,
    model_validator,
)

from pbdkit.errors import ExperimentError
from pbdkit.experiment.columns import read_columns
from pbdkit.experiment.model import Experiment
from pbdkit.experiment.parts import closed_part
from pbdkit.experiment.solvers import Equilibrium
from pbdkit.fitting.evidence import FieldEvidence
from pbdkit.fitting.force_curve import CurveObservation
from pbdkit.fitting.observation import Observation
from pbdkit.fitting.resting_field import FieldObservation
from pbdkit.fitting.tracks import TracksObservation
from pbdkit.interfaces.component import Component, Strict
from pbdkit.scene.scene import Scene, build_scene
from pbdkit.stepping.state import Floats

GUESS = 1.0
"""The noise where none is given, until residuals tell it."""
FEW, TINY = 4, 2e-3
"""More points than that within such a share of the body are points in another unit."""
Positive = Annotated[float, Field(gt=0.0)]
Term = Annotated[
    tuple[Annotated[int, Field(ge=0, le=4)], Annotated[int, Field(ge=0, le=4)]],
    Field(strict=False),
]


def _once(terms: tuple[tuple[int, int], ...]) -> tuple[tuple[int, int], ...]:
    for n, term in enumerate(terms):
        if term in terms[:n]:
            raise ValueError(f"names {list(term)} twice")
    return terms


Terms = Annotated[tuple[Term, ...], Field(strict=False), AfterValidator(_once)]
Pair = Annotated[tuple[float, float], Field(strict=False)]
WAYS = {"x": (1.0, 0.0), "y": (0.0, 1.0)}


class Measured(Component):
    """The columns of a CSV `file` beside the fit file.

    `noise` is the standard deviation of what was measured; without it that of the residuals is
    taken. A `weight` of 4 makes each number count like one of half the noise. `settings` are
    changes of the experiment, by path, for this measurement alone: another load, another end.
    """

    file: str
    noise: Positive | None = None
    weight: Positive = 1.0
    settings: Annotated[dict[str, Any], Field(default_factory=dict)]
    _rows: Any = None
    columns: Any

    @model_validator(mode="after")
    def _read(self, info: ValidationInfo) -> Self:
        object.__setattr__(self, "_rows", np.array(read_columns(self.file, info, self.columns)))
        return self

    @property
    def rows(self) -> Floats:
        """(row, column)."""
        return np.asarray(self._rows)

    @property
    def assumed_noise(self) -> float:
        """The noise, or a guess until residuals tell it."""
        return self.noise or GUESS

    @abstractmethod
    def observation(self, experiment: Experiment, modes: int) -> Observation:
        """Of an experiment, with so many modes along measured boundaries. Raises
        ExperimentError."""


class Distortion(Strict):
    """What the measurement shows beside the displacement of the body, in its plane: polynomials of
    x and y, by their exponents, each as much as fits. A camera that turns, a lens, and bending out
    of the plane are such: `ux: [[2, 0]]` is a strain that rises evenly along x."""

    ux: Terms = ()
    uy: Terms = ()


def _without_type(schema: dict[str, Any]) -> None:
    # A measurement is a field unless it says otherwise.
    schema["required"] = [key for key in schema["required"] if key != "type"]


class MeasuredField(Measured):
    """Displacements at scattered points of the equilibrium, in lattice units.

    Points nearer to the outline of the body than `margin` are left out.
    """

    model_config = ConfigDict(json_schema_extra=_without_type)

    type: Literal["field"] = "field"
    columns: Annotated[tuple[str, str, str, str], Field(strict=False)] = ("x", "y", "ux", "uy")
    margin: Annotated[float, Field(ge=0.0)] = 0.0
    distortion: Distortion = Field(default_factory=Distortion)

    def observation(self, experiment: Experiment, modes: int) -> FieldObservation:
        """At rest, whatever the experiment says of steps."""
        if experiment.solver.makes_steps:
            experiment = experiment.model_copy(update={"solver": Equilibrium()})
        scene = build_scene(experiment)
        points, displacements = self.rows[:, :2], self.rows[:, 2:]
        far = np.ones(len(points), bool)
        if self.margin:
            from pbdkit.fitting.depth import deeper  # shapely is loaded where it is needed

            far = deeper(experiment.body, experiment.lattice, points, self.margin)
        terms = self.distortion.ux, self.distortion.uy
        evidence = FieldEvidence.of(scene, points[far], displacements[far], terms)
        _refuse_other_unit(evidence.points, scene)
        return FieldObservation.of(scene, evidence, self.assumed_noise, modes, far)


class MeasuredTracks(Measured):
    """Displacements of points of the body as it moves: at `time`, counted in steps, of the point
    that lies at x and y in the reference."""

    type: Literal["tracks"] = "tracks"
    columns: Annotated[tuple[str, str, str, str, str], Field(strict=False)] = (
        "time",
        "x",
        "y",
        "ux",
        "uy",
    )

    def observation(self, experiment: Experiment, modes: int) -> TracksObservation:
        """Of its run."""
        times, points, u = self.rows[:, 0], self.rows[:, 1:3], self.rows[:, 3:]
        return TracksObservation.of(experiment, times, points, u, self.assumed_noise)


class MeasuredCurve(Measured):
    """The force that leader group `group` exerts along `axis`, over its own displacement along it,
    or over time, counted in steps, where it is measured `against` that.

    Forces are those of a body of this `thickness`. Without `youngs_modulus` that is found too.
    Where the experiment has units, these are N, mm and MPa.
    """

    type: Literal["curve"] = "curve"
    group: Annotated[int, Field(ge=0)]
    axis: Literal["x", "y"] = "x"
    against: Literal["displacement", "time"] = "displacement"
    thickness: Positive = 1.0
    youngs_modulus: Positive | None = None
    columns: Annotated[tuple[str, str], Field(strict=False)] = ("displacement", "force")

    def observation(self, experiment: Experiment, modes: int) -> CurveObservation:
        """Of its run, over thickness and modulus, as far as they are known."""
        scale = self.thickness * (self.youngs_modulus or 1.0)
        scale *= experiment.units.length_mm if experiment.units else 1.0
        found = CurveObservation.of(
            experiment,
            self.rows[:, 0],
            self.rows[:, 1] / scale,
            self.assumed_noise / scale,
            self.group,
            WAYS[self.axis],
            at_times=self.against == "time",
            scaled=self.youngs_modulus is None,
        )
        return replace(found, unit=scale)


def _refuse_other_unit(points: Floats, scene: Scene) -> None:
    body = np.ptp(scene.raster.reference(scene.raster.body_rows), axis=0).max()
    size = np.ptp(points, axis=0).max() if len(points) > FEW else body
    if size < TINY * body:
        raise ExperimentError(
            f"the {len(points)} points lie within {size:.3g}, and the body is {body:.3g} long; "
            "columns x, y, ux, uy count in the experiment's lattice units: multiply them",
            ("measured", "file"),
        )


_Any = Annotated[Measured, closed_part(Measured, MeasuredField, MeasuredTracks, MeasuredCurve)]
_one = TypeAdapter[Measured](_Any)
_some = TypeAdapter[tuple[Measured, ...]](
    Annotated[tuple[_Any, ...], Field(strict=False, min_length=1)]
)


def _one_or_some(value: Any, info: ValidationInfo) -> tuple[Measured, ...]:
    if isinstance(value, Mapping):
        return (_one.validate_python(_typed(value), context=info.context),)
    if isinstance(value, (list, tuple)):
        value = [_typed(each) if isinstance(each, Mapping) else each for each in value]
    return _some.validate_python(value, context=info.context)


def _typed(value: Mapping[str, Any]) -> dict[str, Any]:
    return {"type": "field", **value}


Measurements = Annotated[
    tuple[SerializeAsAny[Measured], ...],
    BeforeValidator(_one_or_some, json_schema_input_type=_Any | tuple[_Any, ...]),
]
"""One measurement, of a field unless it says otherwise, or a list of some."""
