"""Experiment: a validated description of a scene and of its run.

This module also contains the checks that concern several parts of an experiment.
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

from pbdkit.array_types import Floats
from pbdkit.errors import ExperimentError, PluginError, RetirementWarning, warn_caller
from pbdkit.model.bodies import BODIES, AnyBody, Body, Box
from pbdkit.model.boundary_conditions import AnyInitial, Cut, LeaderGroup, Load, Obstacle
from pbdkit.model.motions import Newton
from pbdkit.model.reading import OF_PROGRAM, Settings, Source, with_settings
from pbdkit.model.solver import AnySolver, DissipationControl, Equilibrium, Record, Stepping
from pbdkit.model.validation import brief, fault, open_part, report
from pbdkit.plugin import (
    INTERFACES,
    LISTS,
    BreaksAtStrain,
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
    RenewsBonds,
    RenewsParticles,
    Softens,
    SoftensCells,
    TearsCells,
)
from pbdkit.plugin.component import Strict, as_values
from pbdkit.plugin.discovery import Retired, errors_attributed_to, retired_parts, with_successors
from pbdkit.plugin.fields import (
    MAX_VALUES,
    RESERVED,
    PositionFunction,
    RandomField,
    TakesFields,
    Varying,
    unknown_regions,
)
from pbdkit.plugin.registry import GIVEN, Registry
from pbdkit.plugin.rule import Calibrated, material_of
from pbdkit.plugin.schedule import TimeDependent
from pbdkit.plugin.units import Scales, Units, given_by_units, of_one_material

Key = str | tuple[str, ...]
"""Type of a field, or of the path of a field."""


def clashes_of(experiment: Any) -> Iterator[tuple[Key, str]]:
    """Yield a field and a message for each incompatibility between parts of an experiment."""
    yield from ((key, text) for key, clashes, text in _checks(experiment) if clashes)
    for field in ("rule", "fracture"):
        for name, region, text in unknown_regions(getattr(experiment, field), experiment.regions):
            yield (field, name, region), text
        yield from _drawn_from(field, getattr(experiment, field))
    for name, region in experiment.regions.items():
        if any(box.in_sites for box in region.boxes()):
            yield ("regions", name), "a grid counts sites and cannot be a region; use a rectangle"


def _drawn_from(field: str, part: Any) -> Iterator[tuple[Key, str]]:
    draws = isinstance(part, Draws) and any(not number.changes for number in part.remembered())
    for name in part.time_dependent if draws else ():
        yield (
            (field, name),
            f"'{part.type}' draws random numbers from it before the first step, so that it cannot "
            "depend on time; give a single number, or remove the randomness",
        )


def _checks(experiment: Any) -> Iterator[tuple[Key, bool, str]]:
    yield from _neighbour_checks(experiment)
    yield from _event_checks(experiment)
    yield from _force_checks(experiment)
    if experiment.solver.equilibrium.control:
        yield from _control_checks(experiment)


def _neighbour_checks(experiment: Any) -> list[tuple[Key, bool, str]]:
    """Check that parts that require permanent bonds are not used with re-evaluated neighbours."""
    reevaluates = experiment.neighbours.nearness() is not None
    jumps = not experiment.solver.makes_steps
    ends_at_convergence = experiment.stepping.settle is not None
    return [
        ("fracture", reevaluates and experiment.fracture.can_break,
         "bonds cannot break if neighbours are re-evaluated, because bonds are not permanent; "
         "set neighbours.reevaluate: false or fracture: {type: none}"),
        ("cuts", reevaluates and bool(experiment.cuts),
         "bonds cannot be cut if neighbours are re-evaluated, because bonds are not permanent; "
         "set neighbours.reevaluate: false, or remove cuts"),
        ("solver", reevaluates and jumps,
         "an equilibrium is not defined if neighbours are re-evaluated; "
         "set neighbours.reevaluate: false or solver: {type: stepping}"),
        ("solver", reevaluates and ends_at_convergence,
         "the distance from equilibrium has no bound if neighbours are re-evaluated; "
         "set neighbours.reevaluate: false, or remove solver.settle"),
        ("loads", reevaluates and bool(experiment.loads),
         "loads require fixed neighbours; set neighbours.reevaluate: false"),
    ]  # fmt: skip


def _event_checks(experiment: Any) -> list[tuple[Key, bool, str]]:
    """Check steps of events, and that components are compatible with the solver.

    Records and cuts must not be later than the last step. A component of which the state depends on
    previous steps cannot be combined with some settings of the solver.
    """
    last = max(experiment.record.at or (0,))
    last_cut = max((cut.at for cut in experiment.cuts), default=0)
    jumps, ends_at_convergence = (
        not experiment.solver.makes_steps,
        experiment.stepping.settle is not None,
    )
    remembers, softens = (
        isinstance(experiment.rule, RenewsParticles),
        isinstance(experiment.fracture, (Softens, SoftensCells)),
    )
    steps, rule = experiment.steps, experiment.rule
    return [
        ("record", last > steps, f"step {last} exceeds the number of steps, {steps}"),
        ("record", experiment.record.increments and not jumps,
         "increments of load exist only for an equilibrium; use solver: {type: equilibrium}, or "
         "remove record.increments"),
        ("cuts", last_cut > steps, f"step {last_cut} exceeds the number of steps, {steps}"),
        ("solver", ends_at_convergence and (remembers or softens),
         f"'{(rule if remembers else experiment.fracture).type}' depends on the history, so that "
         "the distance from equilibrium has no bound; remove solver.settle"),
        ("solver", jumps and remembers,
         f"the rule '{rule.type}' depends on the history, so that there is no equilibrium that is "
         "independent of the steps; use solver: {type: stepping}"),
        *(("solver", (jumps or ends_at_convergence) and not operation.rests,
           f"'{operation.type}' can move particles at rest, so that the equilibrium is not "
           "determined; use solver: {type: stepping} without `settle`")
          for operation in experiment.operations),
    ]  # fmt: skip


def _force_checks(experiment: Any) -> list[tuple[Key, bool, str]]:
    """Check that the rule and the solver support the masses and loads of an experiment."""
    rests = not experiment.solver.makes_steps or experiment.stepping.settle is not None
    masses = any(isinstance(group.motion, Newton) for group in experiment.leaders)
    has_forces, rule = material_of(experiment.rule) is not None, experiment.rule
    return [
        ("solver", masses and rests,
         "leaders that move by Newton's law have no final position that is known before the run; "
         "use solver: {type: stepping} without `settle`, or a load on followers"),
        ("rule", masses and not has_forces,
         f"leaders that move by Newton's law require forces, which '{rule.type}' with these "
         "parameters does not define; use a calibrated rule: elastic with poisson_ratio above -1, "
         "or springs"),
        ("loads", bool(experiment.loads) and not (has_forces and isinstance(rule, Loadable)),
         f"the rule '{rule.type}' with these parameters defines moves, but no forces and no "
         "stiffness; use a calibrated rule ('elastic' or 'strain-gradient' with poisson_ratio "
         "above -1, 'orthotropic', 'springs')"),
    ]  # fmt: skip


def _control_checks(experiment: Any) -> list[tuple[Key, bool, str]]:
    """Check that the load of an experiment can be an unknown, which a control determines."""
    rule, fracture, steps = experiment.rule, experiment.fracture, experiment.steps
    driven = [*experiment.leaders, *experiment.loads]
    acts = all(each.from_ == 1 and (each.until or steps) >= steps for each in driven)
    dissipates = isinstance(experiment.solver.equilibrium.control, DissipationControl)
    gradually, key = isinstance(fracture, RenewsBonds), ("solver", "control")
    tears = isinstance(rule, TearsCells) and experiment.frame.weighs_cells
    return [
        (key, not rule.linear or material_of(rule) is None,
         f"the branch of equilibria is computed for linear rules with forces, and '{rule.type}' is "
         "none; use 'elastic' with poisson_ratio above -1 or 'orthotropic'"),
        (key, fracture.can_break and not tears,
         "damage on the branch of equilibria is computed by cells; use rule: {type: elastic, ...} "
         "or {type: orthotropic, ...}, with frame: {type: natural}"),
        (key, dissipates and not gradually,
         f"'{fracture.type}' does not soften, so that there is no load for a dissipated energy; "
         "use fracture: {type: cohesive, ...} or {type: damage, ...}, or control: {type: opening, "
         "...}"),
        (key, dissipates and steps < 2,
         "the first step ends where damage begins; set steps to 2 or more"),
        (key, fracture.can_break and not gradually and not isinstance(fracture, BreaksAtStrain),
         f"'{fracture.type}' has no breaking strain, so that it is not known which bond breaks "
         "first; use 'threshold', 'strain', 'damage' or 'cohesive'"),
        (key, not driven, "there is no load; add loads, or leaders that move"),
        (key, not acts,
         "all leaders and loads are multiplied by one load factor, and have to act in all steps; "
         "remove their `from` and `until`"),
        (key, any(cut.at > 0 for cut in experiment.cuts),
         "a cut during the run would change the branch; make it at step 0"),
        (key, bool(experiment.time_dependent),
         "parameters cannot depend on time, because the load factor takes the place of time; give "
         "single numbers"),
        (key, bool(experiment.obstacles), "obstacles are not supported; remove them"),
        (key, bool(experiment.operations),
         "operations of particles are not supported; remove them"),
        (key, not experiment.initial.at_rest,
         "the branch starts from the body at rest; remove `initial`"),
    ]  # fmt: skip


def _valid_name(name: str) -> str:
    words = name.split("/")
    if len(name) > 200 or ".." in name or not all(re.fullmatch(_WORD, word) for word in words):
        raise fault(
            "may contain letters, digits, '.', '_', '-' and '/', but no '..', and no part between "
            f"slashes that is empty or begins with a dot; got {brief(name)}"
        )
    return name


def _supported_version(version: int) -> int:
    if version != 1:
        raise fault(f"this pbdkit supports version 1, got {brief(version)}")
    return version


_WORD = r"[A-Za-z0-9_-][A-Za-z0-9._-]*"
"""Pattern of a part of the name of an experiment."""
Name = Annotated[
    str, AfterValidator(_valid_name), Field(json_schema_extra={"pattern": f"^{_WORD}(/{_WORD})*$"})
]
"""Type of the name of an experiment."""
Version = Annotated[int, AfterValidator(_supported_version), Field(json_schema_extra={"const": 1})]
"""Type of the version of the format."""


def _region(name: str) -> str:
    if name in RESERVED or not re.fullmatch(_WORD, name):
        raise fault(
            f"the name of a region may contain letters, digits, '.', '_' and '-', and must not be "
            f"one of {', '.join(RESERVED)}; got {brief(name)}"
        )
    return name


RegionName = Annotated[str, AfterValidator(_region)]
"""Type of the name of a region."""


SLACK = 1e-9
"""Tolerance for rounding errors of the extent of a body, relative to the lattice constant."""


def sampled(part: TakesFields, lattice: Lattice, body: Body, seed: int, field: str) -> Any:
    """Replace functions and random fields of a component by values on a grid.

    The distance of grid points is half the lattice constant. On the square and the rectangular
    lattice, particles and the midpoints of bonds and of cells are points of the grid.

    Parameters
    ----------
    part
        Component with spatially varying parameters.
    lattice, body
        Lattice and body of the experiment.
    seed
        Seed of random fields.
    field
        Field of the component in the experiment.

    Raises
    ------
    ValidationError
        If the component does not accept a value.
    PydanticCustomError
        If a random field cannot be generated.
    """
    values: dict[str, Varying] = {}
    for name, varying in part.varying.items():
        try:
            if isinstance(varying, PositionFunction):
                values[name] = varying.sampled(*_grid(lattice, body))
            elif isinstance(varying, RandomField):
                values[name] = varying.drawn_at(*_grid(lattice, body), seed, field)
        except ValueError as error:
            raise fault(str(error), key=(field, name)) from None
    return part.with_more(**values) if values else part


def _grid(lattice: Lattice, body: Body) -> tuple[Floats, Floats]:
    """Return the coordinates of the grid along both axes.

    Raises
    ------
    ValueError
        If the number of points exceeds the maximum number of values of a parameter.
    """
    cell = lattice.cell()
    steps = np.array(cell.vectors) / np.array(cell.period)[:, None]
    spacing = np.abs(np.diag(steps))
    corners = np.concatenate([_corners(box, steps, lattice) for box in body.boxes()])
    origin = np.array(lattice.origin)
    low = np.floor((corners.min(axis=0) - origin) / spacing + SLACK)
    high = np.ceil((corners.max(axis=0) - origin) / spacing - SLACK)
    if not (count := np.prod(2 * (high - low) + 1)) <= MAX_VALUES:
        raise ValueError(f"{count:.3g} values exceed {MAX_VALUES}; use a smaller body")
    x, y = (
        o + s / 2 * np.arange(2 * a, 2 * b + 1)
        for o, s, a, b in zip(origin, spacing, low, high, strict=True)
    )
    return x, y


def _corners(box: Box, steps: Floats, lattice: Lattice) -> Floats:
    """Return the corners of a box in coordinates."""
    corners = np.array(list(product(*zip(box.low, box.high, strict=True))), float)
    return corners @ steps + lattice.origin if box.in_sites else corners


def renewed(parts: dict[str, Any], source: Source) -> tuple[dict[str, Any], Source, list[Retired]]:
    """Replace retired components by their successors.

    Returns
    -------
    tuple
        The parts, the source with these parts, and the retired components.
    """
    retired = retired_parts(parts)
    if retired:
        parts = with_successors(parts)
        source = source if source.data is None else replace(source, data=parts)
    return parts, source, retired


def announce(retired: Iterable[Retired], source: Source, fields: Mapping[str, Any]) -> None:
    """Warn of the retired components of an experiment.

    Raises
    ------
    ExperimentError
        If particles are selected by numbers that a successor changes.
    """
    for component in retired:
        where = next(_numbered(fields), None) if component.renumbers else None
        field, successor = component.field, component.successor
        if where:
            text = (
                f"the numbers refer to particles under {field} '{component.type}', which is "
                f"retired; under '{successor}' particles have other numbers: select them by "
                f"position, or by their new numbers with {field}: {{type: {successor}}}"
            )
            error = ExperimentError(source.message(where, text), where)
            error.located = True
            raise error
        warn_caller(source.message((field, "type"), component.advice), RetirementWarning)


def _numbered(fields: Mapping[str, Any]) -> Iterator[tuple[str | int, ...]]:
    """Yield the fields that select particles by number."""
    for field in ("leaders", "loads"):
        for n, group in enumerate(fields[field]):
            if group.select.numbers:
                yield field, n, "select", "numbers"
    for n, diagnostic in enumerate(fields["diagnostics"]):
        if getattr(diagnostic, "numbers", None):
            yield "diagnostics", n, "numbers"


def _declares_variables(part: Diagnostic) -> Diagnostic:
    with errors_attributed_to(part, "to declare its variables"):
        as_values(part.variables(), "variables")
    return part


AnyDiagnostic = Annotated[
    SerializeAsAny[Diagnostic],
    open_part(Diagnostic),
    AfterValidator(of_one_material),
    AfterValidator(_declares_variables),
]
"""Type of a diagnostic in an experiment."""


AnyOperation = Annotated[SerializeAsAny[ParticleOperation], open_part(ParticleOperation)]


def _each(field: str, parts: Any) -> list[Any]:
    """Return the components at a field, which can be a list."""
    return list(parts) if field in LISTS else [parts]


def _default(part: str, description: str) -> Any:
    # The value is written as in a file. It is therefore read in the same way, and `--set` can
    # change a part of it.
    return Field(default={"type": part}, description=description)


def _default_frame(parts: dict[str, Any]) -> Any:
    rule = parts.get("rule")
    cells = isinstance(rule, FollowerRule) and rule.uses_cells
    return {"type": "natural" if cells and isinstance(rule, Calibrated) else "mean"}


class Experiment(Strict):
    """Experiment: a scene and its run, validated as a whole.

    Parts are given as dicts, as in an experiment file, or as objects of component classes.

    Raises
    ------
    ExperimentError
        If the experiment is invalid; the message names the field and the remedy.
    PluginError
        If a component belongs to a distribution that is missing or broken.

    Examples
    --------
    >>> experiment = pbdkit.Experiment(
    ...     name="sheet",
    ...     lattice={"type": "square", "a": 1.0},
    ...     body={"type": "grid", "columns": 8, "rows": 4},
    ...     rule={"type": "barycentre"},
    ...     leaders=[{"select": {"edge": "left"}, "motion": {"type": "hold"}}],
    ...     steps=10,
    ... )
    >>> experiment.frame.type
    'mean'
    """

    version: Version = Field(1, description="Version of the format of experiments.")
    name: Name = Field(
        "experiment",
        description="Name of the experiment, from which output files are named; by default the "
        "name of its file without the suffix.",
    )
    seed: Annotated[int, Field(ge=0, lt=2**63)] = Field(
        0, description="Seed of all random numbers."
    )
    units: Units | None = Field(
        None, description="Lattice unit, Young's modulus and thickness with their units."
    )
    lattice: Annotated[SerializeAsAny[Lattice], open_part(Lattice)] = Field(
        description="Lattice of the particles."
    )
    body: AnyBody = Field(description="Shape of the body: the sites that are particles.")
    regions: dict[RegionName, AnyBody] = Field(
        default_factory=dict, description="Named parts of the body, for parameters and selections."
    )
    neighbours: Annotated[SerializeAsAny[NeighbourMetric], open_part(NeighbourMetric)] = _default(
        "coordination", "Neighbours that enter the rule of a particle."
    )
    rule: Annotated[SerializeAsAny[FollowerRule], open_part(FollowerRule)] = Field(
        description="Rule by which followers move."
    )
    frame: Annotated[SerializeAsAny[FramePolicy], open_part(FramePolicy)] = Field(
        default_factory=_default_frame,
        description="Points around the body in place of neighbours that are missing at its edge; "
        "by default `natural` with a calibrated rule and `mean` with other rules.",
    )
    fracture: Annotated[SerializeAsAny[FractureModel], open_part(FractureModel)] = _default(
        "none", "Condition under which bonds break."
    )
    cuts: Annotated[tuple[Cut, ...], Field(strict=False)] = Field(
        (), description="Bonds that are cut at given steps."
    )
    initial: AnyInitial = _default("reference", "Displacements and broken bonds before step 1.")
    leaders: Annotated[tuple[LeaderGroup, ...], Field(strict=False)] = Field(
        (), description="Leader groups: particles with prescribed motion."
    )
    loads: Annotated[tuple[Load, ...], Field(strict=False)] = Field(
        (), description="Forces on followers."
    )
    obstacles: Annotated[tuple[Obstacle, ...], Field(strict=False)] = Field(
        (), description="Rigid bodies that particles cannot enter."
    )
    operations: Annotated[tuple[AnyOperation, ...], Field(strict=False)] = Field(
        (), description="Changes of displacements in each step besides the move of the rule."
    )
    steps: Annotated[int, Field(ge=1, lt=2**62)] = Field(description="Number of steps.")
    record: Record = Field(default_factory=Record, description="Steps that are recorded.")
    diagnostics: Annotated[tuple[AnyDiagnostic, ...], Field(strict=False)] = Field(
        (), description="Further variables of the dataset."
    )
    solver: AnySolver = _default("stepping", "Stepping, or equilibrium without steps.")

    @classmethod
    def key_hint(cls, key: str) -> str:
        """Return a hint if the key belongs to a part of the experiment."""
        registry, closed = Registry(), {"body": BODIES, "solver": (Stepping, Equilibrium)}
        classes_by_field = {**closed, "record": (Record,)} | {
            field: tuple(registry.spellings(interface, installed=False))
            for field, interface in INTERFACES.items()
        }
        for field, classes in classes_by_field.items():
            if key != "type" and any(key in part.known_keys() for part in classes):
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
        """Settings of a single step, for every solver."""
        return self.solver.stepping

    def records(self, step: int) -> bool:
        """Return whether a step is recorded."""
        return self.record.keeps(step, self.steps)

    @property
    def record_count(self) -> int:
        """Number of recorded states, with an estimate of those at increments of load."""
        increments = self.solver.equilibrium.increments if self.record.increments else 0
        return self.record.count(self.steps) + increments

    def next_recorded(self, step: int) -> int:
        """Return the next step after `step` with a recorded state or diagnostic."""
        if any(d.every_step and not d.at_end for d in self.diagnostics):
            return step + 1
        return self.record.next_after(step, self.steps)

    _source: Source = PrivateAttr(default_factory=Source)
    _validated: dict[str, Any] = PrivateAttr(default_factory=dict)
    _registry: Registry = PrivateAttr()

    def __init__(self, *positional: Any, **parts: Any) -> None:
        if positional:
            raise ExperimentError(
                "Experiment: expected parts by keyword, as lattice=...; pbdkit.load(...) returns "
                "the experiment in a file, and Experiment(**parts) that of a dict"
            )
        self._validate(parts, Registry(), Source(files=OF_PROGRAM))

    @model_serializer(mode="wrap")
    def _with_origins(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Serialize the experiment. If several distributions provide a type, its name is written
        with the distribution."""
        result: dict[str, Any] = serialize(self)
        if not result.keys() >= INTERFACES.keys():
            return result  # Only some fields are serialised.
        parts = [part for field in INTERFACES for part in _each(field, result[field])]
        for part, dumped in zip(self.components(), parts, strict=True):
            dumped["type"] = self._registry.name_of(part)
            if isinstance(part, TakesFields):
                dumped |= part.in_place_of_numbers()
            for name in given_by_units(part):
                if self.units and self.units.value(name):
                    del dumped[name]  # The value is given by `units`.
        for name in ("units", "regions", "operations"):
            if not result[name]:
                del result[name]
        return result

    @classmethod
    def build(cls, source: Source, components: Iterable[type[Component]] = ()) -> Self:
        """Create an experiment from a source.

        Parameters
        ----------
        source
            Raw data with their places in a file.
        components
            Component classes in addition to the installed ones.

        Raises
        ------
        ExperimentError
            If the experiment is invalid.
        """
        if not isinstance(source, Source):
            raise ExperimentError(
                f"Experiment.build: expected a source of data with their places, got "
                f"{type(source).__name__}; write Experiment(**parts), or pbdkit.load(...)"
            )
        experiment = cls.__new__(cls)
        experiment._validate(source.data, Registry(components), source)
        return experiment

    def of_parts(self, parts: dict[str, Any]) -> Self:
        """Create an experiment from other parts, with the same component classes."""
        experiment = type(self).__new__(type(self))
        experiment._validate(parts, self._registry, Source())
        return experiment

    def with_settings(self, settings: Settings) -> Self:
        """Return the experiment with some values changed, validated as a whole.

        Parameters
        ----------
        settings : mapping, or iterable of str
            ``{"steps": 20, "rule": {"relaxation": 0.3}}`` or ``["steps=20",
            "rule.relaxation=0.3"]`` changes these values only. A map with a `type` replaces the
            whole part.

        Returns
        -------
        Experiment
            The changed experiment.

        Raises
        ------
        ExperimentError
            If a path does not exist, or a value is invalid.

        Examples
        --------
        >>> experiment = pbdkit.load("paper/a").with_settings({"steps": 20})
        >>> experiment.steps
        20
        """
        source = replace(self.as_written(), name=self._source.name)
        if source.files.folder is None:
            source.files = OF_PROGRAM
        changed = with_settings(source, settings, self.defaults())
        experiment = type(self).__new__(type(self))
        experiment._validate(changed.data, self._registry, changed)
        return experiment

    @property
    def is_as_validated(self) -> bool:
        """True if all parts are those that were validated.

        It is false for a copy by `model_copy` with other parts, which are not validated.
        """
        return all(self._validated.get(name) is part for name, part in self.__dict__.items())

    def refuse_unvalidated(self) -> None:
        """Raise ExperimentError if the experiment is a copy with an invalid part."""
        if not self.is_as_validated:
            self.of_parts(self.model_dump(mode="json", by_alias=True, warnings=False))

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        """Return the default parts as in a file. They do not depend on the rule."""
        fields = cls.model_fields.items()
        parts = {name: f.default for name, f in fields if isinstance(f.default, dict)}
        return parts | {"frame": _default_frame({})}

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Experiment) and self.__dict__ == other.__dict__

    def __hash__(self) -> int:
        return hash((self.name, self.seed, self.lattice, self.body, self.steps))

    @property
    def parts_bonds(self) -> bool:
        """True if bonds can break by fracture or cuts."""
        return self.fracture.can_break or bool(self.cuts)

    @property
    def shows_bonds(self) -> bool:
        """True if the dataset has a table of bonds, because of fracture, cuts or a diagnostic."""
        return self.parts_bonds or any("bonds" in d.needs for d in self.diagnostics)

    def materials(self) -> dict[str, Experiment]:
        """Return uniform experiments, one for each combination of values of varying parameters.

        The parameters are the spatially varying parameters of the rule.

        Returns
        -------
        dict of str to Experiment
            Uniform experiments by label. If no parameter varies, it contains only the experiment
            itself, with an empty label.
        """
        fields = self.rule.varying
        result: dict[str, Experiment] = {}
        for label in dict.fromkeys(label for field in fields.values() for label in field.samples):
            values = {n: f.samples.get(label, getattr(self.rule, n)) for n, f in fields.items()}
            rule = self.rule.with_values(**values)
            result[label] = self.model_copy(update={"rule": rule})
        return result or {"": self}

    @property
    def time_dependent(self) -> dict[tuple[str, str], TimeDependent[float]]:
        """Time-dependent parameters, by part and parameter, except for those of loads.

        The fields of the experiment contain the last values.
        """
        parts = {"rule": self.rule, "fracture": self.fracture, "solver": self.solver}
        return {
            (f, n): number for f, part in parts.items() for n, number in part.time_dependent.items()
        }

    def at(self, moment: float) -> Experiment:
        """Return the experiment with the values of its parameters at a time, in steps."""
        return self.model_copy(
            update={f: getattr(self, f).at(moment) for f, _ in self.time_dependent}
        )

    def _repr_html_(self) -> str:
        """Return the scene and its stability analysis for notebooks."""
        return str(import_module("pbdkit.plotting.notebook").experiment_html(self))

    def components(self) -> list[Component]:
        """Return the components: the parts for which plugins can provide classes."""
        return [part for field in INTERFACES for part in _each(field, getattr(self, field))]

    def distributions(self) -> dict[str, str]:
        """Return the versions of the distributions of the components, by name."""
        return self._registry.versions(self.components())

    def as_written(self) -> Source:
        """Return the data from which the experiment can be created again.

        If the experiment has `units` and its original data consist of plain values, these data are
        returned; lengths in them may have units. Otherwise all parts are returned in lattice units.
        """
        if self.units and self._source.data is not None and self.is_as_validated:
            with suppress(TypeError, ValueError):
                data = dict(json.loads(json.dumps(self._source.data)))
                return Source(self.name, data, files=self._source.files)
        return Source(self.name, self.model_dump(mode="json", by_alias=True))

    def located(self, error: ExperimentError) -> ExperimentError:
        """Return the error with the place of its field in the file added to the message."""
        if error.located:
            return error
        result = type(error)(self._source.message(error.where, str(error)), error.where)
        result.located = True
        return result

    def _validate(self, parts: dict[str, Any], registry: Registry, source: Source) -> None:
        parts, source, retired = renewed(parts, source)
        try:
            units = Scales.model_validate({"units": parts.get("units")}).units
            context = {"registry": registry, "files": source.files, "units": units}
            self.__pydantic_validator__.validate_python(parts, self_instance=self, context=context)
        except ValidationError as error:
            raise report(error, source) from None
        except PluginError as error:
            raise PluginError(source.message(error.where, str(error)), error.where) from None
        self._registry, self._source, self._validated = registry, source, {**self.__dict__}
        announce(retired, source, vars(self))


def given_classes(experiment: Experiment) -> tuple[type[Component], ...]:
    """Return the classes of components that were passed as Python objects."""
    types = experiment.distributions().get(GIVEN, "").split(", ")
    return tuple({type(part): None for part in experiment.components() if part.type in types})
