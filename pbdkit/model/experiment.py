"""The experiment: a validated description of a scene and of the run, with the checks that span
several of its parts.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from itertools import product
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
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

from pbdkit.errors import ExperimentError, PluginError, RetirementWarning, warn_caller
from pbdkit.model.bodies import BODIES, AnyBody, Body, Box
from pbdkit.model.boundary_conditions import AnyInitial, Cut, LeaderGroup, Load, Obstacle
from pbdkit.model.motions import Newton
from pbdkit.model.reading import OF_PROGRAM, Settings, Source, with_settings
from pbdkit.model.solver import AnySolver, Equilibrium, Record, Stepping
from pbdkit.model.validation import brief, fault, open_part, report
from pbdkit.plugin import (
    INTERFACES,
    LISTS,
    Component,
    Diagnostic,
    Draws,
    FollowerRule,
    FractureModel,
    FramePolicy,
    Lattice,
    Loadable,
    NeighbourMetric,
    ParticleOperation,
    RenewsParticles,
    Softens,
    SoftensCells,
)
from pbdkit.plugin.component import Strict, as_values
from pbdkit.plugin.discovery import Retired, blaming, retired_parts, with_successors
from pbdkit.plugin.fields import (
    MOST_VALUES,
    RESERVED,
    OfPlace,
    RandomField,
    TakesFields,
    Varying,
    unknown_regions,
)
from pbdkit.plugin.registry import GIVEN, Registry
from pbdkit.plugin.rule import material_of
from pbdkit.plugin.schedule import Course
from pbdkit.plugin.units import Scales, Units, given_by_units, of_one_material

Key = str | tuple[str, ...]


def clashes_of(asked: Any) -> Iterator[tuple[Key, str]]:
    """The fields of an experiment at which parts clash, each with a message."""
    yield from ((key, text) for key, clashes, text in _looked_at(asked) if clashes)
    for field in ("rule", "fracture"):
        for name, region, text in unknown_regions(getattr(asked, field), asked.regions):
            yield (field, name, region), text
        yield from _drawn_from(field, getattr(asked, field))
    for name, region in asked.regions.items():
        if any(box.in_sites for box in region.boxes()):
            yield ("regions", name), "counts sites, and a region is a place: take a rectangle"


def _drawn_from(field: str, part: Any) -> Iterator[tuple[Key, str]]:
    draws = isinstance(part, Draws) and any(not number.changes for number in part.remembered())
    for name in part.courses if draws else ():
        yield (
            (field, name),
            f"'{part.type}' draws numbers from it before the first step, so that it cannot change; "
            "give one number, or draw none",
        )


def _looked_at(asked: Any) -> Iterator[tuple[Key, bool, str]]:
    yield from _of_neighbours(asked)
    yield from _of_events(asked)
    yield from _of_forces(asked)


def _of_neighbours(asked: Any) -> list[tuple[Key, bool, str]]:
    """What needs bonds that last."""
    anew, jumps = asked.neighbours.nearness() is not None, not asked.solver.makes_steps
    settles = asked.stepping.settle is not None
    return [
        ("fracture", anew and asked.fracture.can_break,
         "bonds cannot break where neighbours are re-evaluated: there are no lasting bonds; "
         "set neighbours.reevaluate: false or fracture: {type: none}"),
        ("cuts", anew and bool(asked.cuts),
         "bonds cannot be cut where neighbours are re-evaluated: there are no lasting bonds; "
         "set neighbours.reevaluate: false, or leave cuts out"),
        ("solver", anew and jumps,
         "where neighbours are re-evaluated nothing tells where the steps lead; "
         "set neighbours.reevaluate: false or solver: {type: stepping}"),
        ("solver", anew and settles,
         "where neighbours are re-evaluated no distance from equilibrium is known; "
         "set neighbours.reevaluate: false, or leave solver.settle out"),
        ("loads", anew and bool(asked.loads),
         "need neighbours that stay; set neighbours.reevaluate: false"),
    ]  # fmt: skip


def _of_events(asked: Any) -> list[tuple[Key, bool, str]]:
    """What comes after the run's last step, and where steps do not tell their end."""
    last, late = max(asked.record.at or (0,)), max((cut.at for cut in asked.cuts), default=0)
    jumps, settles = not asked.solver.makes_steps, asked.stepping.settle is not None
    remembers, softens = (
        isinstance(asked.rule, RenewsParticles),
        isinstance(asked.fracture, (Softens, SoftensCells)),
    )
    return [
        ("record", last > asked.steps, f"step {last} is beyond the run's {asked.steps}"),
        ("record", asked.record.increments and not jumps,
         "increments of load are those of an equilibrium; take solver: {type: equilibrium}, or "
         "leave record.increments out"),
        ("cuts", late > asked.steps, f"step {late} is beyond the run's {asked.steps}"),
        ("solver", settles and (remembers or softens),
         f"'{(asked.rule if remembers else asked.fracture).type}' remembers, so that no distance "
         "from equilibrium is known; leave solver.settle out"),
        ("solver", jumps and remembers,
         f"the rule '{asked.rule.type}' remembers, so that where the steps lead depends on "
         "all of them; take solver: {type: stepping}"),
        *(("solver", (jumps or settles) and not operation.rests,
           f"'{operation.type}' may move particles that their rule leaves where they are, so that "
           "no equilibrium is known; take solver: {type: stepping} without settle")
          for operation in asked.operations),
    ]  # fmt: skip


def _of_forces(asked: Any) -> list[tuple[Key, bool, str]]:
    """What masses, obstacles and loads ask for."""
    rests = not asked.solver.makes_steps or asked.stepping.settle is not None
    masses = any(isinstance(group.motion, Newton) for group in asked.leaders)
    knows_forces = material_of(asked.rule) is not None
    return [
        ("solver", masses and rests,
         "leaders that move by Newton's law have no place at which they rest beforehand; take "
         "solver: {type: stepping} without settle, or a load on followers"),
        ("rule", masses and not knows_forces,
         f"leaders that move by Newton's law need forces, and '{asked.rule.type}' knows none "
         "with these parameters; take a calibrated rule: elastic with poisson_ratio above -1, or "
         "springs"),
        ("loads", bool(asked.loads) and not (knows_forces and isinstance(asked.rule, Loadable)),
         f"the rule '{asked.rule.type}' with these parameters knows no forces: it says where a "
         "particle goes, and of no material how far a force would move it; take a calibrated "
         "rule ('elastic' or 'strain-gradient' with poisson_ratio above -1, 'orthotropic', "
         "'springs')"),
    ]  # fmt: skip


def _valid_name(name: str) -> str:
    words = name.split("/")
    if len(name) > 200 or ".." in name or not all(re.fullmatch(_WORD, word) for word in words):
        raise fault(
            "may hold letters, digits, '.', '_', '-' and '/', no '..', and no part between slashes "
            f"that is empty or begins with a dot; got {brief(name)}"
        )
    return name


def _known_version(version: int) -> int:
    if version != 1:
        raise fault(f"this pbdkit reads version 1, got {brief(version)}")
    return version


_WORD = r"[A-Za-z0-9_-][A-Za-z0-9._-]*"
Name = Annotated[
    str, AfterValidator(_valid_name), Field(json_schema_extra={"pattern": f"^{_WORD}(/{_WORD})*$"})
]
Version = Annotated[int, AfterValidator(_known_version), Field(json_schema_extra={"const": 1})]


def _region(name: str) -> str:
    if name in RESERVED or not re.fullmatch(_WORD, name):
        raise fault(
            f"a region's name may hold letters, digits, '.', '_' and '-', and be none of "
            f"{', '.join(RESERVED)}; got {brief(name)}"
        )
    return name


RegionName = Annotated[str, AfterValidator(_region)]


Floats = NDArray[np.float64]
SLACK = 1e-9
"""Of spacings: so far a body reaches beyond a place by rounding."""


def sampled(part: TakesFields, lattice: Lattice, body: Body, seed: int, field: str) -> Any:
    """The part at a field of the experiment with values in place of functions, and of random fields
    from the seed, half a spacing apart: on the square and the rectangular lattice particles,
    middles of bonds and of cells are places of the grid.

    Raises ValidationError where the part does not take a value, PydanticCustomError where none can
    be drawn.
    """
    found: dict[str, Varying] = {}
    for name, varying in part.varying.items():
        try:
            if isinstance(varying, OfPlace):
                found[name] = varying.sampled(*_grid(lattice, body))
            elif isinstance(varying, RandomField):
                found[name] = varying.drawn_at(*_grid(lattice, body), seed, field)
        except ValueError as error:
            raise fault(str(error), key=(field, name)) from None
    return part.with_more(**found) if found else part


def _grid(lattice: Lattice, body: Body) -> tuple[Floats, Floats]:
    """Raises ValueError for more places than a field takes, before they are made."""
    cell = lattice.cell()
    steps = np.array(cell.vectors) / np.array(cell.period)[:, None]
    spacing = np.abs(np.diag(steps))
    corners = np.concatenate([_corners(box, steps, lattice) for box in body.boxes()])
    origin = np.array(lattice.origin)
    low = np.floor((corners.min(axis=0) - origin) / spacing + SLACK)
    high = np.ceil((corners.max(axis=0) - origin) / spacing - SLACK)
    if not (count := np.prod(2 * (high - low) + 1)) <= MOST_VALUES:
        raise ValueError(f"{count:.3g} values are more than {MOST_VALUES}; make the body smaller")
    x, y = (
        o + s / 2 * np.arange(2 * a, 2 * b + 1)
        for o, s, a, b in zip(origin, spacing, low, high, strict=True)
    )
    return x, y


def _corners(box: Box, steps: Floats, lattice: Lattice) -> Floats:
    """Of a rectangle around a body, in coordinates."""
    corners = np.array(list(product(*zip(box.low, box.high, strict=True))), float)
    return corners @ steps + lattice.origin if box.in_sites else corners


def renewed(parts: dict[str, Any], source: Source) -> tuple[dict[str, Any], Source, list[Retired]]:
    """Return the parts with successors of what is retired, a source that holds them, and what was
    retired."""
    retired = retired_parts(parts)
    if retired:
        parts = with_successors(parts)
        source = source if source.data is None else replace(source, data=parts)
    return parts, source, retired


def announce(retired: Iterable[Retired], source: Source, fields: Mapping[str, Any]) -> None:
    """Warn of retired components that an experiment with these fields named.

    Raises ExperimentError where particles are chosen by numbers, which are those of other
    particles under the successor.
    """
    for one in retired:
        where = next(_numbered(fields), None) if one.renumbers else None
        if where:
            text = (
                f"its numbers are those of particles under {one.field} '{one.type}', which is "
                f"retired; under '{one.successor}' particles have others: choose them by place, "
                f"or by their new numbers with {one.field}: {{type: {one.successor}}}"
            )
            error = ExperimentError(source.message(where, text), where)
            error.located = True
            raise error
        warn_caller(source.message((one.field, "type"), one.advice), RetirementWarning)


def _numbered(fields: Mapping[str, Any]) -> Iterator[tuple[str | int, ...]]:
    """The fields that choose particles by their numbers."""
    for field in ("leaders", "loads"):
        for n, group in enumerate(fields[field]):
            if group.select.numbers:
                yield field, n, "select", "numbers"
    for n, diagnostic in enumerate(fields["diagnostics"]):
        if getattr(diagnostic, "numbers", None):
            yield "diagnostics", n, "numbers"


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


AnyOperation = Annotated[SerializeAsAny[ParticleOperation], open_part(ParticleOperation)]


def _each(field: str, parts: Any) -> list[Any]:
    """The components at a field, of which some list any number."""
    return list(parts) if field in LISTS else [parts]


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
    operations: Annotated[tuple[AnyOperation, ...], Field(strict=False)] = ()
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
                below = f"[{{{key}: ...}}]" if field in LISTS else f"{{{key}: ...}}"
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
        written = [each for field in INTERFACES for each in _each(field, found[field])]
        for part, dumped in zip(self.components(), written, strict=True):
            dumped["type"] = self._registry.name_of(part)
            if isinstance(part, TakesFields):
                dumped |= part.in_place_of_numbers()
            for name in given_by_units(part):
                if self.units and self.units.value(name):
                    del dumped[name]  # there it is said
        for name in ("units", "regions", "operations"):
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
        return str(import_module("pbdkit.plotting.notebook").experiment_html(self))

    def components(self) -> list[Component]:
        """Every part of an open interface."""
        return [each for field in INTERFACES for each in _each(field, getattr(self, field))]

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


def given_classes(experiment: Experiment) -> tuple[type[Component], ...]:
    """Those that the parts of an experiment are of."""
    types = experiment.distributions().get(GIVEN, "").split(", ")
    return tuple({type(part): None for part in experiment.components() if part.type in types})
