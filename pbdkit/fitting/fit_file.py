"""Fit files: an experiment, its unknown parameters, and measurements.

Measurements are fields of displacements, tracks in time and curves. For a fit of strength they are
the peak loads of repeated tests.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self, TypeVar

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    SerializeAsAny,
    Tag,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    model_validator,
)

from pbdkit.array_types import Floats
from pbdkit.components.gauges import Extensometer, Gauge, StrainGauge
from pbdkit.errors import ExperimentError, PbdkitError, did_you_mean, no_such
from pbdkit.fitting.channels import (
    Channel,
    ControlledOpening,
    GaugeReading,
    GroupDisplacement,
    GroupForce,
    LoadDisplacement,
    LoadForce,
    Time,
    direction_of_load,
    unit_vector,
)
from pbdkit.fitting.formula import Formula
from pbdkit.fitting.observations import (
    CurveObservation,
    FieldEvidence,
    FieldObservation,
    Modes,
    Observation,
    TracksObservation,
    deeper,
    read_at,
)
from pbdkit.fitting.problem import Loss
from pbdkit.model.experiment import Experiment, Version
from pbdkit.model.loading import Base, base_source
from pbdkit.model.reading import (
    FIT,
    OF_PROGRAM,
    FileResolver,
    Source,
    file_resolver,
    of_kind,
    read_file,
)
from pbdkit.model.schema import DIALECT
from pbdkit.model.solver import Equilibrium, Toward
from pbdkit.model.validation import closed_part, fault, read_columns, report
from pbdkit.plugin.component import Component, Strict
from pbdkit.plugin.schedule import AS_LIST, AS_PART, AS_WORD, PLAIN, WITH_UNITS, WORD
from pbdkit.plugin.units import LENGTH, Scales, Units, number_with_unit
from pbdkit.scene.scene import Scene, build_scene

if TYPE_CHECKING:
    import xarray

GUESS = 1.0
"""Standard deviation of the noise until it is estimated from the residuals."""
MIN_POINTS = 4
"""Largest number of points for which their extent is not compared with that of the body."""

MIN_EXTENT = 2e-3
"""Extent of the points divided by that of the body, below which the unit must be wrong."""
Positive = Annotated[float, Field(gt=0.0)]
Term = Annotated[
    tuple[Annotated[int, Field(ge=0, le=4)], Annotated[int, Field(ge=0, le=4)]],
    Field(strict=False),
]


def _once(terms: tuple[tuple[int, int], ...]) -> tuple[tuple[int, int], ...]:
    for n, term in enumerate(terms):
        if term in terms[:n]:
            raise ValueError(f"lists {list(term)} twice")
    return terms


Terms = Annotated[tuple[Term, ...], Field(strict=False), AfterValidator(_once)]
Pair = Annotated[tuple[float, float], Field(strict=False)]
SpecimenName = Annotated[
    str, BeforeValidator(lambda name: str(name), json_schema_input_type=str | int)
]
"""Name of a specimen; a number is read as text."""


def _word_or(form: str) -> Discriminator:
    """Select the member of a union for words, or that for all other values."""
    return Discriminator(lambda value: AS_WORD if isinstance(value, str) else form)


def _has_text(value: Any) -> bool:
    return isinstance(value, (list, tuple)) and any(isinstance(item, str) for item in value)


Count = Annotated[
    Annotated[int, Field(ge=0, le=40), Tag(PLAIN)] | Annotated[Literal["auto"], Tag(WORD)],
    Discriminator(lambda value: WORD if isinstance(value, str) else PLAIN),
]
Counts = Annotated[
    Annotated[Count, Tag(PLAIN)] | Annotated[tuple[Count, ...], Field(strict=False), Tag(AS_LIST)],
    Discriminator(lambda value: AS_LIST if isinstance(value, (list, tuple)) else PLAIN),
]
ModesOfGroups = Modes | tuple[Modes, ...]


def _in_order(axes: tuple[str, ...]) -> tuple[str, ...]:
    if [*axes] != sorted({*axes}):
        raise ValueError(f"expected [x], [y] or [x, y], got [{', '.join(axes)}]")
    return axes


Axes = Annotated[
    tuple[Literal["x", "y"], ...],
    Field(strict=False, min_length=1, max_length=2),
    AfterValidator(_in_order),
]


class Force(Strict):
    """The force of a leader group and the thickness of the body, from which Young's modulus is
    computed. Units are N, mm and MPa if the experiment has units. Otherwise the unit of the modulus
    is that of the force divided by the unit of the thickness and by the lattice unit."""

    group: Annotated[int, Field(ge=0)]
    value: Pair
    thickness: Positive = 1.0
    noise: Annotated[float, Field(ge=0.0)] = 0.0


class MeasuredColumns(Component):
    """A measurement: columns of a CSV `file` in the folder of the fit file.

    `specimen` is the name of the measured specimen, if the fit has several. `noise` is the standard
    deviation of the measured values; by default it is estimated from the residuals of this
    measurement. A `weight` of 4 has the same effect as half the noise. `settings` are changes of
    the experiment, by path, for this measurement only, for instance another load or another number
    of steps.
    """

    file: str
    specimen: SpecimenName | None = None
    noise: Positive | None = None
    weight: Positive = 1.0
    settings: Annotated[dict[str, Any], Field(default_factory=dict)]
    _rows: Any = None
    columns: Any

    @model_validator(mode="after")
    def _read(self, info: ValidationInfo) -> Self:
        table = (info.context or {}).get(self.file)
        rows = (
            read_columns(self.file, info, self.columns)
            if table is None
            else _rows_of(table, self.columns)
        )
        object.__setattr__(self, "_rows", np.array(rows))
        return self

    @property
    def rows(self) -> Floats:
        """Return the values in the file, (row, column)."""
        return np.asarray(self._rows)

    @property
    def assumed_noise(self) -> float:
        """Return the noise or, before it is estimated from the residuals, a guess."""
        return self.noise or GUESS

    @abstractmethod
    def observation(self, experiment: Experiment, modes: ModesOfGroups) -> Observation:
        """Return the observation of this measurement.

        Parameters
        ----------
        experiment
            The experiment with the settings of this measurement.
        modes
            Numbers of modes of displacements along measured boundaries.

        Raises
        ------
        ExperimentError
            If the experiment cannot predict the measurement.
        """


DATASET = "(dataset)"
"""Value of `file` for a measurement that is passed as a dataset in Python."""


def _rows_of(table: xarray.Dataset, columns: Sequence[str]) -> Floats:
    """Return the values of variables of a dataset as rows, with a column for each variable.

    Raises ValueError.
    """
    for name in columns:
        if name not in table:
            hint = did_you_mean(name, map(str, table))
            raise ValueError(f"the dataset has no variable '{name}'{hint}")
    values = [np.asarray(table[name], float).ravel() for name in columns]
    if len({len(value) for value in values}) > 1:
        sizes = ", ".join(f"{n} {len(v)}" for n, v in zip(columns, values, strict=True))
        raise ValueError(f"the variables of the dataset must have one size, got {sizes}")
    rows = np.stack(values, axis=1)
    if not len(rows) or not np.isfinite(rows).all():
        raise ValueError(
            "the variables of the dataset must contain at least one number, and finite ones only"
        )
    return rows


class Distortion(Strict):
    """Apparent displacements in the plane that are not displacements of the body, for instance
    those due to a rotated camera, a lens, or bending out of the plane. They are polynomials of x
    and y. Each term is given by exponents; its amplitude is fitted. For example, `ux: [[2, 0]]` is
    a displacement proportional to x², or a strain that increases linearly along x."""

    ux: Terms = ()
    uy: Terms = ()


def _without_type(schema: dict[str, Any]) -> None:
    # A measurement without a type is a field.
    schema["required"] = [key for key in schema["required"] if key != "type"]


class MeasuredDisplacements(MeasuredColumns):
    """Displacements at points.

    `axes` are the axes along which they are measured, by default both. The last `columns` are the
    displacements along these axes.
    """

    first_columns: ClassVar[tuple[str, ...]]

    axes: Axes = ("x", "y")

    @model_validator(mode="before")
    @classmethod
    def _columns_of_axes(cls, data: Any) -> Any:
        """Set the default of `columns` for `axes`, and compare the numbers of both."""
        axes = data.get("axes", ["x", "y"]) if isinstance(data, Mapping) else None
        if not isinstance(axes, (list, tuple)) or not {*map(str, axes)} <= {"x", "y"}:
            return data
        expected = [*cls.first_columns, *(f"u{axis}" for axis in axes)]
        columns = data.get("columns", expected)
        if isinstance(columns, (list, tuple)) and len(columns) != len(expected):
            raise fault(
                f"expected {len(expected)} columns, for {', '.join(expected)}, got {len(columns)}",
                key="columns",
            )
        return {**data, "columns": columns}

    @property
    def measured_axes(self) -> tuple[int, ...]:
        """Return the indices of the measured axes."""
        return tuple("xy".index(axis) for axis in self.axes)


class MeasuredField(MeasuredDisplacements):
    """Displacements of a body in equilibrium at scattered points, in lattice units.

    `axes` are the axes along which they are measured, by default both; with `axes: [x]` the columns
    are x, y and ux. Points that are closer to the outline of the body than `margin` are not used.
    `force` is the force of a leader group during this measurement. It replaces `force` of the fit,
    and is required here if several specimens are measured under different forces.
    """

    model_config = ConfigDict(json_schema_extra=_without_type)
    first_columns = ("x", "y")

    type: Literal["field"] = "field"
    columns: Annotated[tuple[str, ...], Field(strict=False)] = ("x", "y", "ux", "uy")
    margin: Annotated[float, Field(ge=0.0)] = 0.0
    distortion: Distortion = Field(default_factory=Distortion)
    force: Force | None = None

    @model_validator(mode="after")
    def _distortion_of_measured_axes(self) -> Self:
        for axis in "xy":
            if axis not in self.axes and getattr(self.distortion, f"u{axis}"):
                raise fault(
                    f"has terms of u{axis}, which is not measured; remove them", key="distortion"
                )
        return self

    def observation(self, experiment: Experiment, modes: ModesOfGroups) -> FieldObservation:
        """Return the observation of an equilibrium. The solver of the experiment is not used."""
        if experiment.solver.makes_steps:
            experiment = experiment.model_copy(update={"solver": Equilibrium()})
        scene = build_scene(experiment)
        points, displacements = self.rows[:, :2], self.rows[:, 2:]
        inside = np.ones(len(points), bool)
        if self.margin:
            inside = deeper(experiment.body, experiment.lattice, points, self.margin)
        terms = self.distortion.ux, self.distortion.uy
        evidence = FieldEvidence.of(
            scene, points[inside], displacements[inside], terms, self.measured_axes
        )
        _refuse_other_unit(evidence.points, scene)
        return FieldObservation.of(scene, evidence, self.assumed_noise, modes, inside)


class MeasuredTracks(MeasuredDisplacements):
    """Displacements of points of the moving body. Each row contains a `time`, in steps, the
    coordinates x and y of a point in the reference configuration, and its displacement at that
    time. `axes` are the axes along which displacements are measured, by default both."""

    first_columns = ("time", "x", "y")

    type: Literal["tracks"] = "tracks"
    columns: Annotated[tuple[str, ...], Field(strict=False)] = ("time", "x", "y", "ux", "uy")

    def observation(self, experiment: Experiment, modes: ModesOfGroups) -> TracksObservation:
        """Return the observation of a run."""
        times, points, u = self.rows[:, 0], self.rows[:, 1:3], self.rows[:, 3:]
        return TracksObservation.of(
            experiment, times, points, u, self.assumed_noise, self.measured_axes
        )


AnyGauge = Annotated[SerializeAsAny[Gauge], closed_part(Gauge, Extensometer, StrainGauge)]
"""Type of a gauge."""


class MeasuredCurve(MeasuredColumns):
    """A quantity as a function of another one.

    By default it is the force that the leader group `group` exerts along `axis`, or the force of
    the load `load`. `quantity` can also be a gauge: an extensometer or a strain gauge. It is
    measured `against` the displacement of the group or load along `axis`, against `time` in steps,
    the `opening` that the control of the solver prescribes, or a gauge. `axis` is x, y or a vector;
    the default is x for a group, and the direction of the force for a load. `thickness` is the
    thickness of the tested body, by default that of `units` or 1. By default, `youngs_modulus` is
    fitted too. Forces are in N, the modulus in MPa and the thickness in mm if the experiment has
    units. Lengths are in lattice units.
    """

    type: Literal["curve"] = "curve"
    quantity: Annotated[
        Annotated[Literal["force"], Tag(AS_WORD)] | Annotated[AnyGauge, Tag(AS_PART)],
        _word_or(AS_PART),
    ] = "force"
    against: Annotated[
        Annotated[Literal["displacement", "time", "opening"], Tag(AS_WORD)]
        | Annotated[AnyGauge, Tag(AS_PART)],
        _word_or(AS_PART),
    ] = "displacement"
    group: Annotated[int, Field(ge=0)] | None = None
    load: Annotated[int, Field(ge=0)] | None = None
    axis: (
        Annotated[
            Annotated[Literal["x", "y"], Tag(AS_WORD)] | Annotated[Toward, Tag(AS_LIST)],
            _word_or(AS_LIST),
        ]
        | None
    ) = None
    thickness: Positive | None = None
    youngs_modulus: Positive | None = None
    columns: Annotated[tuple[str, str], Field(strict=False)] = ("displacement", "force")

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        needs = self.quantity == "force" or self.against == "displacement"
        if self.group is not None and self.load is not None:
            raise fault("the curve has a `group` and a `load`; give one of them", key="load")
        if needs and self.group is None and self.load is None:
            raise fault("is missing; give the `group` or the `load` of the force", key="group")
        for key in ("thickness", "youngs_modulus"):
            if getattr(self, key) and not self.measures_force:
                raise fault("converts forces, but a gauge is measured; remove it", key=key)
        if isinstance(self.axis, tuple) and not any(self.axis):
            raise fault("the axis is a zero vector; give one, such as [1, 0]", key="axis")
        return self

    @property
    def measures_force(self) -> bool:
        """Return whether the measured quantity is a force."""
        return self.quantity == "force"

    def observation(self, experiment: Experiment, modes: ModesOfGroups) -> CurveObservation:
        """Return the observation of a run.

        Forces are divided by the thickness and by a known modulus.
        """
        scene, scale = read_at(experiment), 1.0
        if self.measures_force:
            scale = self._thickness(experiment) * (self.youngs_modulus or 1.0)
            scale *= experiment.units.length_mm if experiment.units else 1.0
        curve = CurveObservation.of(
            scene,
            self.rows[:, 0],
            self.rows[:, 1] / scale,
            self.assumed_noise / scale,
            self._channels(scene),
            scaled=self.measures_force and self.youngs_modulus is None,
        )
        return replace(curve, unit=scale)

    def _thickness(self, experiment: Experiment) -> float:
        units = experiment.units
        return self.thickness or (units and units.value("thickness")) or 1.0

    def _channels(self, scene: Scene) -> tuple[Channel, Channel]:
        """Return the measured channel, and the channel of the abscissae."""
        if self.group is not None and self.group >= len(scene.leading):
            text = no_such("leader group", self.group, len(scene.leading))
            raise ExperimentError(text, ("measured", "group"))
        force, displacement = self._of_group_or_load(scene)
        value = GaugeReading(self.quantity) if isinstance(self.quantity, Gauge) else force
        over: Channel | None
        if isinstance(self.against, Gauge):
            over = GaugeReading(self.against)
        elif self.against == "opening":
            over = ControlledOpening.of(scene)
        else:
            over = Time() if self.against == "time" else displacement
        assert value is not None
        assert over is not None
        return value, over

    def _of_group_or_load(self, scene: Scene) -> tuple[Channel | None, Channel | None]:
        """Return force and displacement of the group or load."""
        if self.load is not None:
            default = direction_of_load(scene, self.load)
            direction = unit_vector(self.axis) if self.axis else default
            return LoadForce(self.load, direction), LoadDisplacement(self.load, direction)
        if self.group is None:
            return None, None
        direction = unit_vector(self.axis or "x")
        return GroupForce(self.group, direction), GroupDisplacement(self.group, direction)


def _refuse_other_unit(points: Floats, scene: Scene) -> None:
    body = np.ptp(scene.raster.reference(scene.raster.body_rows), axis=0).max()
    size = np.ptp(points, axis=0).max() if len(points) > MIN_POINTS else body
    if size < MIN_EXTENT * body:
        raise ExperimentError(
            (
                f"the {len(points)} points extend over {size:.3g}, but the body is {body:.3g} "
                "long; columns x, y, ux, uy must be in the experiment's lattice units: rescale "
                "them"
            ),
            ("measured", "file"),
        )


_Any = Annotated[
    MeasuredColumns, closed_part(MeasuredColumns, MeasuredField, MeasuredTracks, MeasuredCurve)
]
_one = TypeAdapter[MeasuredColumns](_Any)
_some = TypeAdapter[tuple[MeasuredColumns, ...]](
    Annotated[tuple[_Any, ...], Field(strict=False, min_length=1)]
)


def _one_or_some(value: Any, info: ValidationInfo) -> tuple[MeasuredColumns, ...]:
    if hasattr(value, "columns") or hasattr(value, "data_vars"):
        raise ValueError(
            f"expected keys such as `file`, got an object of type {type(value).__name__}; write it "
            "to a CSV file, or pass it as `pbdkit.fit(..., measured=dataset)`, a table as "
            "table.to_xarray()"
        )
    if isinstance(value, Mapping):
        return (_one.validate_python(_typed(value), context=info.context),)
    if isinstance(value, (list, tuple)):
        value = [_typed(item) if isinstance(item, Mapping) else item for item in value]
    return _some.validate_python(value, context=info.context)


def _typed(value: Mapping[str, Any]) -> dict[str, Any]:
    return {"type": "field", **value}


Measurements = Annotated[
    tuple[SerializeAsAny[MeasuredColumns], ...],
    BeforeValidator(_one_or_some, json_schema_input_type=_Any | tuple[_Any, ...]),
]
"""One measurement, or a list of measurements. A measurement without a type is a field."""


FOLDER = Path(__file__).parent.parent / "fits"
"""Folder of the shipped fits."""


def _two(bounds: Pair) -> Pair:
    _refuse_wrong_order(bounds, bounds)
    return bounds


def _refuse_wrong_order(numbers: Pair, bounds: Pair | tuple[str, str]) -> None:
    if not numbers[0] < numbers[1]:
        low, high = bounds
        text = f"write [{high}, {low}]" if numbers[1] < numbers[0] else "give two different ones"
        raise ValueError(f"expected [lower bound, upper bound], got [{low}, {high}]; {text}")


def _in_one_unit(bounds: tuple[str, str]) -> tuple[str, str]:
    (low, unit), (high, other) = map(number_with_unit, bounds)
    if unit != other:
        raise ValueError(f"expected bounds in the same unit, got {unit} and {other}")
    _refuse_wrong_order((low, high), bounds)
    return bounds


Bounds = Annotated[Pair, AfterValidator(_two)]
UnitBounds = Annotated[tuple[str, str], Field(strict=False), AfterValidator(_in_one_unit)]
AnyBounds = Annotated[
    Annotated[Bounds, Tag(PLAIN)] | Annotated[UnitBounds, Tag(WITH_UNITS)],
    Discriminator(lambda value: WITH_UNITS if _has_text(value) else PLAIN),
]
"""Type of bounds: two numbers, or two texts with a unit."""


def _formula(text: str) -> str:
    Formula.read(text)
    return text


_Formula = Annotated[str, AfterValidator(_formula)]


class CrackTip(Strict):
    """A crack tip with unknown position: one end of a cut in the experiment.

    `cut` is the number of the cut, from 0, and `end` the one of its ends at which the tip is. The
    tip is searched on the line of the cut, up to a distance `within` from this end, in lattice
    units.
    """

    cut: Annotated[int, Field(ge=0)] = 0
    end: Literal["from", "to"] = "to"
    within: Annotated[float, Field(gt=0.0), LENGTH]


class AlternativeModel(Strict):
    """Another model for the same data.

    It is given by changes of the experiment, by path, and by its unknown parameters if they are not
    those of the fit.
    """

    settings: Annotated[dict[str, Any], Field(min_length=1)]
    unknown: dict[str, AnyBounds] | None = None


class Sampler(Strict):
    """Number of walkers of emcee, and number of steps of each walker.

    The first quarter of the steps is discarded.
    """

    walkers: Annotated[int, Field(ge=4, le=1000)] = 16
    steps: Annotated[int, Field(ge=10)] = 200
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0


class FitFile(Strict):
    """A fit, with the places of its values in its file."""

    _source: Source = Source()

    def located(self, error: ExperimentError, experiment: Experiment) -> ExperimentError:
        """Return an error with the place in the fit file, or in its experiment, in the message."""
        if error.located or not error.where:
            return error
        if error.where[0] not in type(self).model_fields:
            return experiment.located(error)
        result = ExperimentError(self._source.message(error.where, str(error)), error.where)
        result.located = True
        return result


class Fit(FitFile):
    """Fits the `unknown` parameters of an experiment, within bounds, to one or several
    measurements, which are fields in equilibrium, tracks or curves.

    Bounds are numbers as in the experiment or, with `units`, texts such as 2 MPa. `unknown` can be
    empty if Young's modulus, `derived` quantities or a `crack_tip` are determined.

    If a leader group has the motion `measured`, its displacement along each axis is a sum of
    `modes` smooth functions with amplitudes that are also fitted. By default, `auto`, the data
    determine their number for each group. A list has a number or `auto` for each of these groups.
    If the number is 0, the measured displacements are prescribed. `loss` is the loss function of
    the residuals. All functions except `linear` reduce the weight of outliers.

    With `specimens: true`, the measurements are of several specimens of one material, which differ.
    Each specimen is fitted separately. The result contains the mean of each parameter over the
    specimens with its standard error, and the standard deviation between specimens. A measurement
    names its `specimen`; by default each measurement is of a separate one.

    Three computations are optional and expensive. `profile` lists the parameters of which the
    profile likelihood is computed, by fitting all other parameters again. `sampler` generates
    samples of the posterior distribution. `candidates` are other models by name, which are compared
    with this one by cross-validation over a number of `folds`.

    `derived` lists quantities that are computed from the fit with their standard errors: variables
    of the experiment's diagnostics, for the equilibrium of the first measurement, and formulas of
    them, of unknown parameters and of a fitted `youngs_modulus`. `crack_tip` is a crack tip with
    an unknown position.
    """

    version: Version = 1
    experiment: Base
    unknown: dict[str, AnyBounds]
    measured: Measurements
    specimens: bool = False
    force: Force | None = None
    modes: Counts = "auto"
    loss: Loss = "linear"
    profile: Annotated[tuple[str, ...], Field(strict=False)] = ()
    sampler: Sampler | None = None
    candidates: dict[str, AlternativeModel] = Field(default_factory=dict)
    folds: Annotated[int, Field(ge=2, le=20)] = 5
    derived: Annotated[tuple[_Formula, ...], Field(strict=False)] = ()
    crack_tip: CrackTip | None = None

    _files: FileResolver = FileResolver()

    @property
    def files(self) -> FileResolver:
        """Return the folder to which the file names in the fit refer."""
        return self._files

    @model_validator(mode="after")
    def _fits_together(self, info: ValidationInfo) -> Self:
        object.__setattr__(self, "_files", file_resolver(info))
        self._refuse_unclear_specimens()
        for fit in self.by_specimen().values():
            fit._refuse_unclear_measurements()
        if invalid := [path for path in self.profile if path not in self.unknown]:
            hint = did_you_mean(invalid[0], self.unknown)
            raise ValueError(f"`profile` names '{invalid[0]}', which is not unknown{hint}")
        if self.sampler and self.loss != "linear":
            raise ValueError("a `sampler` assumes normal noise; set `loss: linear`")
        if self.sampler and not self.unknown:
            raise ValueError("a `sampler` requires `unknown` parameters; omit it, or give some")
        if self.sampler and self.sampler.walkers < 2 * len(self.unknown):
            raise ValueError("a `sampler` requires at least two walkers for each parameter")
        return self

    def by_specimen(self) -> dict[str, Fit]:
        """Return the fit of each specimen by name; without `specimens`, this fit with an empty
        name."""
        if not self.specimens:
            return {"": self}
        groups: dict[str, list[MeasuredColumns]] = {}
        for n, measurement in enumerate(self.measured, 1):
            groups.setdefault(measurement.specimen or str(n), []).append(measurement)
        return {
            name: self.model_copy(update={"measured": tuple(group), "specimens": False})
            for name, group in groups.items()
        }

    @property
    def measured_force(self) -> Force | None:
        """Return the force during the first measurement."""
        return getattr(self.measured[0], "force", None) or self.force

    def _refuse_unclear_specimens(self) -> None:
        names = [measurement.specimen for measurement in self.measured]
        if not self.specimens:
            if any(names):
                raise ValueError(
                    "a measurement names its `specimen`; set `specimens: true` to fit several"
                )
            return
        if any(names) and not all(names):
            raise ValueError(
                f"measurement {names.index(None)} names no `specimen`; name it in all or in none"
            )
        if len(self.by_specimen()) < 2:
            raise fault(
                "requires measurements of at least two specimens"
                "; add measurements of another one, or omit `specimens`",
                key="specimens",
            )
        if self.profile or self.sampler or self.candidates:
            raise ValueError(
                "`profile`, `sampler` and `candidates` describe one specimen; omit them, or fit "
                "each specimen in a file of its own"
            )

    def _refuse_unclear_measurements(self) -> None:
        """Raise ValueError if the measurements of one specimen do not fit together."""
        if self.crack_tip:
            self._refuse_beside_tip()
        force = self.measured_force
        if any(getattr(measurement, "force", None) for measurement in self.measured[1:]):
            raise ValueError("give `force` at the first measurement of a specimen, or for the fit")
        if force and not isinstance(self.measured[0], MeasuredField):
            raise ValueError(
                "`force` is the force of a group in equilibrium while a field is measured; give "
                "forces over displacement as a curve"
            )
        if force and force.value == (0.0, 0.0):
            raise ValueError(
                "`force` is 0 along both axes, which does not determine a modulus; omit it"
            )
        curves_without_modulus = [
            measurement
            for measurement in self.measured
            if isinstance(measurement, MeasuredCurve)
            and measurement.measures_force
            and not measurement.youngs_modulus
        ]
        if not (self.unknown or force or curves_without_modulus or self.derived or self.crack_tip):
            raise ValueError(
                "there is nothing to fit: without `unknown` parameters, give a `force` or a curve "
                "for Young's modulus, `derived` quantities, or a `crack_tip`"
            )
        if force and curves_without_modulus:
            raise ValueError(
                "both `force` and a curve without `youngs_modulus` determine Young's modulus; "
                "omit `force`"
            )

    def _refuse_beside_tip(self) -> None:
        if len(self.measured) > 1 or not isinstance(self.measured[0], MeasuredField):
            raise ValueError("`crack_tip` requires that the only measurement is a field")
        for name in ("profile", "sampler", "candidates"):
            if getattr(self, name):
                raise ValueError(
                    f"`{name}` is not available with `crack_tip`, since each position of the tip "
                    "requires a fit; give the position that a fit with `crack_tip` reports"
                )


KIND = "strength"
"""Value of `kind` in fits of strength."""
MIN_BROKEN = 3
"""Smallest number of broken specimens from which scatter can be estimated."""


class Peaks(Strict):
    """The peak load of each specimen, given as a list of `peaks` or as a `column` of a CSV `file`
    in the folder of the fit file. `of` is the measured quantity. It is the `force` or the
    `displacement` of the leader group `group` at the peak, or `factor`, the peak load as a fraction
    of the load in the experiment.

    In place of `column`, `curve` can name the columns specimen, displacement and force of whole
    curves, the peaks of which are used. `broke` is a list or the name of a column with a 1 for each
    specimen that broke and a 0 for each one that did not break before the end of its test. By
    default all specimens broke. `youngs_modulus` and `thickness` are those of the tested body. By
    default, `group` is the one with the largest displacement.
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
            raise fault("give either a file or a list of peaks", key="file")
        values, broke = self._columns(info) if self.file is not None else self._listed()
        for n, value in enumerate(values):
            if not 0.0 < value < np.inf:
                text = f"peaks must be above 0, but that of specimen {n + 1} is {value:g}"
                raise fault(text, key="file" if self.file else "peaks")
        if broke.sum() < MIN_BROKEN:
            raise fault(
                f"{int(broke.sum())} specimens broke, but scatter requires at least {MIN_BROKEN}",
                key="file" if self.file else "peaks",
            )
        object.__setattr__(self, "_values", values)
        object.__setattr__(self, "_broke", broke)
        return self

    def _listed(self) -> tuple[Floats, Any]:
        if isinstance(self.broke, str):
            raise fault("names a column, but there is no file; give a list of 0 and 1", key="broke")
        broke = np.array(self.broke or [1] * len(self.peaks), bool)
        if len(broke) != len(self.peaks):
            text = f"expected one number for each of {len(self.peaks)} peaks, got {len(broke)}"
            raise fault(text, key="broke")
        return np.array(self.peaks), broke

    def _columns(self, info: ValidationInfo) -> tuple[Floats, Any]:
        if self.broke and not isinstance(self.broke, str):
            raise fault(
                ("is a list, but peaks are read from a file; name a column of it"), key="broke"
            )
        further = (self.broke,) if isinstance(self.broke, str) else ()
        if self.curve is None:
            rows = np.array(read_columns(self.file, info, (self.column, *further)))
        else:
            if self.of == "factor":
                raise fault("curves contain forces and displacements, but no factor", key="of")
            rows = _peaks_of_curves(
                np.array(read_columns(self.file, info, (*self.curve, *further))), self.of
            )
        return rows[:, 0], rows[:, 1] != 0.0 if further else np.ones(len(rows), bool)

    @property
    def values(self) -> Floats:
        """Return the peaks, (specimen,)."""
        return np.asarray(self._values)

    @property
    def failed(self) -> Any:
        """Return whether each specimen broke, (specimen,)."""
        return self._broke


def _peaks_of_curves(rows: Floats, quantity: str) -> Floats:
    """Return the largest force of each specimen, or the displacement at this force.

    The remaining columns of the row with the largest force are returned too.
    """
    peaks = []
    for specimen in np.unique(rows[:, 0]):
        curve = rows[rows[:, 0] == specimen]
        top = curve[curve[:, 2].argmax()]
        peaks.append([top[2] if quantity == "force" else top[1], *top[3:]])
    return np.array(peaks)


class StrengthFit(FitFile):
    """Fits the strength of bonds and its scatter to repeated tests of one experiment.

    They are the `unknown` parameters, with bounds.

    `law` is the distribution of strengths, by default that of the fracture model of the experiment.
    The `method` `likelihood` assumes that a specimen fails when its first bond breaks. `simulation`
    compares the measurements with simulated specimens. `auto` uses `likelihood`, and `simulation`
    if the assumption does not hold. `check` is the number of specimens that are simulated to test
    the assumption, and `simulations` the number of specimens for the method `simulation`. `seed` is
    the seed of the random numbers of both methods.
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
                raise fault(f"strengths and their scatter must be above 0, got {low:g}", key=path)
        return self


def is_strength_fit(description: Mapping[str, Any] | str | Path) -> bool:
    """Return whether a fit file, a shipped fit or a mapping has the `kind` of a strength fit.

    If the file cannot be read, the result is False; the error is reported when the fit is read.
    """
    if isinstance(description, Mapping):
        return description.get("kind") == KIND
    shipped = FOLDER / f"{description}.yaml"
    path = shipped if shipped.is_file() and not Path(description).is_file() else Path(description)
    return path.is_file() and dict(of_kind(FIT, read_file(path)).data).get("kind") == KIND


AnyFit = TypeVar("AnyFit", Fit, StrengthFit)


def read_fit(
    model: type[AnyFit],
    description: Mapping[str, Any] | str | Path,
    *,
    has_experiment: bool = False,
    measured: xarray.Dataset | None = None,
    units: Units | None = None,
) -> tuple[AnyFit, Source]:
    """Read a fit from a file, a shipped name or a mapping.

    Parameters
    ----------
    model
        Class of the fit, `Fit` or `StrengthFit`.
    description
        Path or name, or the content.
    has_experiment
        Whether the caller provides the experiment, so that the fit need not name one.
    measured
        Dataset that replaces the file of the measurement.
    units
        Units of the experiment that the caller provides.

    Returns
    -------
    fit
        The fit.
    source
        Source of its experiment.

    Raises
    ------
    ExperimentError
        If the fit is invalid.
    """
    if not isinstance(description, (Mapping, str, Path)):
        raise ExperimentError(
            "fit: expected a fit file, the name of a shipped fit or a dict with their keys, got an "
            f"object of type {type(description).__name__}; measurements are given as `measured`"
        )
    if isinstance(description, Mapping):
        path, source = Path("fit"), Source("fit", dict(description), {}, OF_PROGRAM)
    else:
        path = _file(str(description))
        source = of_kind(FIT, read_file(path))
    if has_experiment and isinstance(source.data, dict):
        source = Source(source.name, {"experiment": "", **source.data}, source.places, source.files)
    context: dict[str, Any] = {"files": source.files, "units": units or _units(path, source)}
    if measured is not None:
        source, context[DATASET] = _with_dataset(source), measured
    try:
        fit = model.model_validate(source.data, context=context)
    except ValidationError as error:
        raise report(error, source) from None
    object.__setattr__(fit, "_source", source)
    return fit, source if has_experiment else base_source(path, fit.experiment, source)


def _units(path: Path, source: Source) -> Units | None:
    """Return the units of the experiment of a fit; None if it has none, or if they are invalid,
    which is reported when the experiment is built."""
    base = source.data.get("experiment") if isinstance(source.data, Mapping) else None
    with suppress(PbdkitError, ValidationError):
        data = base_source(path, base, source).data
        return Scales.model_validate({"units": data.get("units")}).units
    return None


def _with_dataset(source: Source) -> Source:
    """Return the description in which a dataset replaces the file of the measurement."""
    data = dict(source.data) if isinstance(source.data, Mapping) else {}
    file = data.get("measured") or {}
    if not isinstance(file, Mapping):
        raise ExperimentError(
            "measured: a dataset can replace one measurement, but the fit has several"
        )
    data["measured"] = {**file, "file": DATASET}
    return Source(source.name, data, source.places, source.files)


def shipped_fits() -> list[str]:
    """Return the sorted names of the shipped fits."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))


def _file(name: str) -> Path:
    path = Path(name)
    if path.is_file():
        return path
    if name in (names := shipped_fits()):
        return FOLDER / f"{name}.yaml"
    files = [str(p) for p in path.parent.glob("*.yaml")] if path.parent.is_dir() else []
    hint = did_you_mean(name, [*files, *names])
    raise ExperimentError(f"{name}: is neither a file nor a shipped fit{hint} ({', '.join(names)})")


def fit_schema() -> dict[str, Any]:
    """Return the JSON Schema of fit files of both kinds, without that of their experiments."""
    schema = TypeAdapter[Any](Fit | StrengthFit).json_schema(by_alias=True)
    return {"$schema": DIALECT, **schema, "title": "pbdkit fit"}
