"""The experiment: a validated description of a scene, and of what to do with it."""

from __future__ import annotations

import json
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from typing import Annotated, Any, Self

from pydantic import (
    AfterValidator,
    Field,
    PrivateAttr,
    SerializeAsAny,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
    model_validator,
)

from pbdkit.errors import ExperimentError, PluginError
from pbdkit.experiment.beside import OF_PROGRAM
from pbdkit.experiment.body_algebra import BODIES, AnyBody
from pbdkit.experiment.clashes import clashes_of
from pbdkit.experiment.cuts import Cut
from pbdkit.experiment.initial import AnyInitial
from pbdkit.experiment.leaders import LeaderGroup
from pbdkit.experiment.loads import Load
from pbdkit.experiment.names import Name, RegionName, Version
from pbdkit.experiment.obstacles import Obstacle
from pbdkit.experiment.parts import fault, open_part, report
from pbdkit.experiment.record import Record
from pbdkit.experiment.renewal import announce, renewed
from pbdkit.experiment.sampling import sampled
from pbdkit.experiment.settings import Settings, with_settings
from pbdkit.experiment.solvers import AnySolver, Equilibrium, Stepping
from pbdkit.experiment.source import Source
from pbdkit.interfaces import (
    INTERFACES,
    Component,
    Diagnostic,
    FollowerRule,
    FractureModel,
    FramePolicy,
    Lattice,
    NeighbourMetric,
)
from pbdkit.interfaces.component import Strict, as_values
from pbdkit.interfaces.course import Course
from pbdkit.interfaces.fields import TakesFields
from pbdkit.interfaces.units import Scales, Units, given_by_units, of_one_material
from pbdkit.registry.blame import blaming
from pbdkit.registry.registry import Registry


def _declares_variables(part: Diagnostic) -> Diagnostic:
    with blaming(part, "when asked what it measures"):
        as_values(part.variables(), "variables")
    return part


AnyDiagnostic = Annotated[
    SerializeAsAny[Diagnostic],
    open_part(Diagnostic),
    AfterValidator(of_one_material),
    AfterValidator(_declares_variables),
]


def _default(part: str) -> Any:
    # As in a file, so that it is resolved like one, and `--set` can start from it.
    return Field(default={"type": part})


class Experiment(Strict):
    """A scene and what to do with it, checked as a whole: the same from a file, dict or objects.

    Raises ExperimentError, which names the field and the remedy, for anything that is not right,
    and PluginError where a part is asked of a distribution that is missing or broken.
    """

    version: Version = 1
    name: Name
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    units: Units | None = None
    lattice: Annotated[SerializeAsAny[Lattice], open_part(Lattice)]
    body: AnyBody
    regions: dict[RegionName, AnyBody] = Field(default_factory=dict)
    neighbours: Annotated[SerializeAsAny[NeighbourMetric], open_part(NeighbourMetric)] = _default(
        "coordination"
    )
    rule: Annotated[SerializeAsAny[FollowerRule], open_part(FollowerRule)]
    frame: Annotated[SerializeAsAny[FramePolicy], open_part(FramePolicy)] = _default("mean")
    fracture: Annotated[SerializeAsAny[FractureModel], open_part(FractureModel)] = _default("none")
    cuts: Annotated[tuple[Cut, ...], Field(strict=False)] = ()
    initial: AnyInitial = _default("reference")
    leaders: Annotated[tuple[LeaderGroup, ...], Field(strict=False)] = ()
    loads: Annotated[tuple[Load, ...], Field(strict=False)] = ()
    obstacles: Annotated[tuple[Obstacle, ...], Field(strict=False)] = ()
    steps: Annotated[int, Field(ge=1, lt=2**62)]
    record: Record = Field(default_factory=Record)
    diagnostics: Annotated[tuple[AnyDiagnostic, ...], Field(strict=False)] = ()
    solver: AnySolver = _default("stepping")

    @classmethod
    def found_elsewhere(cls, key: str) -> str:
        """Return the part that has the key."""
        registry, closed = Registry(), {"body": BODIES, "solver": (Stepping, Equilibrium)}
        known = {**closed, "record": (Record,)} | {
            field: tuple(registry.spellings(interface, installed=False))
            for field, interface in INTERFACES.items()
        }
        for field, classes in known.items():
            if key != "type" and any(key in each.known_keys() for each in classes):
                below = f"{{{key}: ...}}" if field != "diagnostics" else f"[{{{key}: ...}}]"
                return f"write it under `{field}`, as in `{field}: {below}`"
        return ""

    @model_validator(mode="after")
    def _together(self) -> Self:
        for key, text in clashes_of(self):
            raise fault(text, key=key)
        for field in ("rule", "fracture"):
            try:
                part = getattr(self, field)
                self.__dict__[field] = sampled(part, self.lattice, self.body, self.seed, field)
            except ValidationError as error:
                first = error.errors()[0]
                raise fault(first["msg"], key=(field, first["ctx"]["key"])) from None
        return self

    @property
    def stepping(self) -> Stepping:
        """How a step of it is made, whatever the solver."""
        return self.solver.stepping

    def records(self, step: int) -> bool:
        """Whether that step is recorded."""
        return self.record.keeps(step, self.steps)

    @property
    def record_count(self) -> int:
        """The number of recorded states, with an estimate of those at increments of load."""
        between = self.solver.sought.increments if self.record.increments else 0
        return self.record.count(self.steps) + between

    def next_wanted(self, step: int) -> int:
        """The next step after `step` of which something is recorded."""
        if any(d.every_step and not d.at_end for d in self.diagnostics):
            return step + 1
        return self.record.next_after(step, self.steps)

    _source: Source = PrivateAttr(default_factory=Source)
    _validated: dict[str, Any] = PrivateAttr(default_factory=dict)
    _registry: Registry = PrivateAttr()

    def __init__(self, **parts: Any) -> None:
        self._validate(parts, Registry(), Source(beside=OF_PROGRAM))

    @model_serializer(mode="wrap")
    def _with_origins(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Types that several distributions offer keep the name of theirs."""
        found: dict[str, Any] = serialize(self)
        if not found.keys() >= INTERFACES.keys():
            return found  # of some fields alone
        *single, many = (found[field] for field in INTERFACES)
        for part, dumped in zip(self.components(), [*single, *many], strict=True):
            dumped["type"] = self._registry.name_of(part)
            if isinstance(part, TakesFields):
                dumped |= part.in_place_of_numbers()
            for name in given_by_units(part):
                if self.units and self.units.value(name):
                    del dumped[name]  # there it is said
        for name in ("units", "regions"):
            if not found[name]:
                del found[name]
        return found

    @classmethod
    def build(cls, source: Source, components: Iterable[type[Component]] = ()) -> Self:
        """The experiment of a source, with components handed over besides the installed ones."""
        experiment = cls.__new__(cls)
        experiment._validate(source.data, Registry(components), source)
        return experiment

    def of_parts(self, parts: dict[str, Any]) -> Self:
        """The experiment of other parts, with the same components at hand."""
        experiment = type(self).__new__(type(self))
        experiment._validate(parts, self._registry, Source())
        return experiment

    def with_settings(self, settings: Settings) -> Self:
        """Return the experiment with some values changed, validated as a whole.

        Parameters
        ----------
        settings : mapping, or iterable of str
            ``{"steps": 20, "rule": {"relaxation": 0.3}}`` changes these values and leaves all
            others; a map with a `type` replaces the whole part. ``["steps=20"]`` does the same.

        Raises
        ------
        ExperimentError
            For a path that leads nowhere, and a value that is not right.
        """
        source = replace(self.as_written(), name=self._source.name)
        if source.beside.folder is None:
            source.beside = OF_PROGRAM
        changed = with_settings(source, settings, self.defaults())
        experiment = type(self).__new__(type(self))
        experiment._validate(changed.data, self._registry, changed)
        return experiment

    @property
    def is_as_validated(self) -> bool:
        """Whether its parts are those that were validated: `model_copy` replaces them unseen."""
        return all(self._validated.get(name) is part for name, part in self.__dict__.items())

    def refuse_unvalidated(self) -> None:
        """Raise ExperimentError where it is a copy with a part that is not right."""
        if not self.is_as_validated:
            self.of_parts(self.model_dump(mode="json", by_alias=True, warnings=False))

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        """The parts that a file may leave out, as it would write them."""
        fields = cls.model_fields.items()
        return {name: f.default for name, f in fields if isinstance(f.default, dict)}

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Experiment) and self.__dict__ == other.__dict__

    def __hash__(self) -> int:
        return hash((self.name, self.seed, self.lattice, self.body, self.steps))

    @property
    def parts_bonds(self) -> bool:
        """Whether bonds can come to be broken: torn by fracture, or cut."""
        return self.fracture.can_break or bool(self.cuts)

    @property
    def shows_bonds(self) -> bool:
        """Whether the dataset has a table of bonds: fracture, a cut or a diagnostic uses it."""
        return self.parts_bonds or any("bonds" in d.needs for d in self.diagnostics)

    def materials(self) -> dict[str, Experiment]:
        """The experiment with the rule as it is at each place that its fields tell apart, the same
        everywhere; itself under no name where it has no field."""
        fields = self.rule.varying
        found: dict[str, Experiment] = {}
        for label in dict.fromkeys(label for field in fields.values() for label in field.samples):
            values = {n: f.samples.get(label, getattr(self.rule, n)) for n, f in fields.items()}
            rule = self.rule.with_values(**values)
            found[label] = self.model_copy(update={"rule": rule})
        return found or {"": self}

    @property
    def courses(self) -> dict[tuple[str, str], Course[float]]:
        """What changes in the course of the steps, by part and parameter; loads say it themselves.
        In its field each parameter stands as it is in the end."""
        parts = {"rule": self.rule, "fracture": self.fracture, "solver": self.solver}
        return {(f, n): course for f, part in parts.items() for n, course in part.courses.items()}

    def at(self, moment: float) -> Experiment:
        """The experiment with its numbers as they are at the end of a step, or within it."""
        return self.model_copy(update={f: getattr(self, f).at(moment) for f, _ in self.courses})

    def _repr_html_(self) -> str:
        """What a notebook shows: the scene before it runs, and what is known of it."""
        return str(import_module("pbdkit.drawing.notebook").experiment_html(self))

    def components(self) -> list[Component]:
        """Every part of an open interface."""
        *single, many = (getattr(self, field) for field in INTERFACES)
        return [*single, *many]

    def distributions(self) -> dict[str, str]:
        """The distributions that the parts come from, with their versions."""
        return self._registry.versions(self.components())

    def as_written(self) -> Source:
        """Return what can be changed and built again. With `units` that is what it was made of,
        whose lengths may name a unit, where that holds plain values; else all of it in lattice
        units."""
        if self.units and self._source.data is not None and self.is_as_validated:
            with suppress(TypeError, ValueError):
                data = dict(json.loads(json.dumps(self._source.data)))
                return Source(self.name, data, beside=self._source.beside)
        return Source(self.name, self.model_dump(mode="json", by_alias=True))

    def located(self, error: ExperimentError) -> ExperimentError:
        """The error with the place of its field in the file, once."""
        if error.located:
            return error
        found = type(error)(self._source.message(error.where, str(error)), error.where)
        found.located = True
        return found

    def _validate(self, parts: dict[str, Any], registry: Registry, source: Source) -> None:
        parts, source, retired = renewed(parts, source)
        try:
            units = Scales.model_validate({"units": parts.get("units")}).units
            context = {"registry": registry, "beside": source.beside, "units": units}
            self.__pydantic_validator__.validate_python(parts, self_instance=self, context=context)
        except ValidationError as error:
            raise report(error, source) from None
        except PluginError as error:
            raise PluginError(source.message(error.where, str(error)), error.where) from None
        self._registry, self._source, self._validated = registry, source, {**self.__dict__}
        announce(retired, source, vars(self))
