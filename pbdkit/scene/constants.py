"""Constants and remembered numbers that elementwise functions see, and where each is attached: to
the scene, a slot, a cell, a bond or a particle.

A new kind of value is declared here: who sees it, under which name, and where it is attached. numpy
and kernels read this description.
"""

from __future__ import annotations

import math
from collections import namedtuple
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cache, partial
from itertools import combinations
from operator import add
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from pbdkit.errors import AccuracyWarning, ExperimentError, PluginError, of_category
from pbdkit.lattice.cells import patches
from pbdkit.lattice.fill import rounding_of
from pbdkit.lattice.neighbourhood import Neighbourhood, bonds_in, plane_block
from pbdkit.lattice.raster import FRAME, Floats, Mask, Raster, Where
from pbdkit.model.bodies import Body, Sites
from pbdkit.model.experiment import Experiment
from pbdkit.plugin import (
    AppliesTwice,
    Calibrated,
    Cell,
    Diagnostic,
    Draws,
    FollowerRule,
    FractureModel,
    KnowsStiffness,
    Remembered,
    Remembers,
    Setting,
    Slot,
    Softens,
    SoftensCells,
    TearsCells,
    Vector,
)
from pbdkit.plugin.component import as_values
from pbdkit.plugin.discovery import blaming
from pbdkit.plugin.fields import ByRegion, TakesFields
from pbdkit.plugin.rule import material_of
from pbdkit.plugin.vector import vector

Declared = tuple[Remembered, ...]


def bond_numbers(experiment: Experiment) -> Declared:
    """What the fracture model remembers of each bond; nothing where bonds cannot break."""
    return _declared(experiment.fracture, "fracture") if experiment.fracture.can_break else ()


def particle_numbers(experiment: Experiment) -> Declared:
    """What the rule remembers of each particle."""
    return _declared(experiment.rule, "rule")


def _declared(part: FollowerRule | FractureModel, field: str) -> Declared:
    if not isinstance(part, Remembers):
        return ()
    with blaming(part, "when asked what it remembers", field):
        return as_values(part.remembered(), "remembered")


def remembered_names(experiment: Experiment) -> dict[str, str]:
    """Each number's name with the field of the part that remembers it.

    Raises PluginError for a name that is declared twice.
    """
    bonds, particles = bond_numbers(experiment), particle_numbers(experiment)
    names = [number.name for number in (*bonds, *particles)]
    for name in names:
        if (count := names.count(name)) > 1:
            raise PluginError(
                f"the number '{name}' is declared {count} times, by FractureModel "
                f"'{experiment.fracture.type}' and FollowerRule '{experiment.rule.type}'; "
                "each needs a name of its own"
            )
    return {n.name: "fracture" for n in bonds} | {n.name: "rule" for n in particles}


def check_diagnostics(
    experiment: Experiment, raster: Raster, neighbourhood: Neighbourhood
) -> list[str]:
    """Raises ExperimentError for diagnostics that do not go with the scene or each other; returns
    warnings about them."""
    taken = remembered_names(experiment)
    for n, diagnostic in enumerate(experiment.diagnostics):
        with blaming(diagnostic, "when asked what it measures", "diagnostics", n):
            diagnostic.check(raster.total, len(experiment.leaders))
            diagnostic.coordinates()
            if "cells" in diagnostic.needs and not raster.communicator.any(
                patches(raster, neighbourhood.tiling)
            ):
                raise ExperimentError(
                    f"'{diagnostic.type}' needs cells, and nowhere do the corners of one all "
                    "belong to the body; make it wider, or leave the diagnostic out"
                )
            if "loads" in diagnostic.needs and not experiment.loads:
                raise ExperimentError(f"'{diagnostic.type}' is of loads, and there is none")
            if diagnostic.needs & {"material", "forces"}:
                _refuse_without_material(diagnostic, experiment)
            for variable in diagnostic.variables():
                ours = diagnostic.own_dimension != "obstacle" and not diagnostic.coordinates()
                if "obstacle" in variable.dims and ours and not experiment.obstacles:
                    raise ExperimentError(f"'{diagnostic.type}' is of obstacles, and there is none")
                if variable.name in taken:
                    other = f"{taken[variable.name]} does too"
                    raise ExperimentError(f"adds the variable '{variable.name}'; {other}")
                taken[variable.name] = f"diagnostics.{n}"
    return _doubts(experiment, raster)


def _doubts(experiment: Experiment, raster: Raster) -> list[str]:
    has_frame = raster.communicator.any((raster.table_kind == FRAME).any())
    return of_category(
        AccuracyWarning,
        (
            f"diagnostics.{n}: '{diagnostic.type}' counts what frame points pull at leaders, which "
            "at the corners of held edges is no force of the body (the reaction of a clamped "
            "cantilever with 10 cells over its height is 8 times that of the body under 'mean', "
            "and 1.6 % off under 'natural'); take frame: {type: natural}"
            for n, diagnostic in enumerate(experiment.diagnostics)
            if has_frame and "forces" in diagnostic.needs
        ),
    )


def _refuse_without_material(diagnostic: Diagnostic, experiment: Experiment) -> None:
    rule = experiment.rule
    if material_of(rule) is None:
        raise ExperimentError(
            f"'{diagnostic.type}' needs a rule that is calibrated to a material ('elastic', "
            f"'orthotropic', 'springs', 'strain-gradient'), which '{rule.type}' with these "
            "parameters is not; take one of those, or leave the diagnostic out"
        )
    if experiment.neighbours.nearness():
        raise ExperimentError(
            f"'{diagnostic.type}' needs neighbours that stay; set neighbours.reevaluate: false"
        )


Values = Mapping[str, Floats]
"""By the name of the parameter, an array over the places."""


def values_at(experiment: Experiment, field: str, x: Floats, y: Floats, needed: Mask) -> Values:
    """The parameters of the part at a field of the experiment that differ, at places where they
    are `needed`; elsewhere where there is none the number that serves for all.

    Raises ExperimentError for a place outside of what is known, and where the values at a place do
    not go together.
    """
    part: TakesFields = getattr(experiment, field)
    cell, held = experiment.lattice.cell(), dict[str, Mask]()
    # Corners of cut cells lie that far outside of a body at most.
    reach = max(math.hypot(*vector) for vector in cell.vectors)
    if any(isinstance(varying, ByRegion) for varying in part.varying.values()):
        for name, region in experiment.regions.items():
            held[name] = signed_distance(region, cell, x, y) <= 0.0
    found = {}
    for name, varying in part.varying.items():
        values = varying.at(x, y, held, reach)
        missing = np.isnan(values)
        if (missing & needed).any():
            place = int(np.argmax(missing & needed))
            raise ExperimentError(
                f"has no value at ({x.flat[place]:.6g}, {y.flat[place]:.6g}), where one is needed; "
                "its places must cover the body",
                (field, name),
            )
        found[name] = np.where(missing, getattr(part, name), values)
    if len(found) > 1 and needed.any():
        _refuse_apart(
            part, field, {name: own[needed] for name, own in found.items()}, x[needed], y[needed]
        )
    return found


def _refuse_apart(part: TakesFields, field: str, values: Values, x: Floats, y: Floats) -> None:
    """Numbers that each may be need not go together, as where one must be above another: looked at
    are the places where two are farthest apart, either way."""
    for one, other in combinations(values.values(), 2):
        for place in (int(np.argmin(one - other)), int(np.argmax(one - other))):
            try:
                part.with_values(**{name: float(own[place]) for name, own in values.items()})
            except ValidationError as error:
                fault = error.errors()[0]
                text = f"at ({x[place]:.6g}, {y[place]:.6g}): {fault['msg']}"
                raise ExperimentError(text, (field, fault.get("ctx", {}).get("key", ""))) from None


def signed_distance(body: Body, cell: Cell, x: Floats, y: Floats) -> Floats:
    """To an outline, negative inside, zero on it whatever the rounding."""
    nowhere = np.zeros(np.shape(x), int)
    distance = body.distance(Sites((nowhere, nowhere), Vector(x, y)))
    return np.where(np.abs(distance) <= rounding_of(cell, x, y), 0.0, distance)


def kinds_of(part: TakesFields, values: Values) -> tuple[list[Any], NDArray[np.intp]]:
    """(parts, kind): the part with the numbers of each kind of place, and of each place its kind,
    in the shape of the values."""
    shape = next(iter(values.values())).shape
    table = np.stack([value.ravel() for value in values.values()], axis=1)
    rows, kind = np.unique(table, axis=0, return_inverse=True)
    parts = [part.with_values(**dict(zip(values, row, strict=True))) for row in rows.tolist()]
    return parts, kind.reshape(shape)


WHOLE_CELLS = {"left": 1.0, "right": 1.0}
"""The shares of the cells on both sides of a bond, where no frame weighs cells."""

Planes = Mapping[str, Floats]


@dataclass(frozen=True)
class SceneConstants:
    """Named tuples: the parameters `rule` and `fracture` (``p``); by slot the rule's `weights`
    (``w``) and the fracture model's `limits` (``c`` without what is remembered). `of_bond` makes
    ``c`` of limits and remembered numbers, `of_particle` ``here.own``.

    Where fields make them differ, `by_particle` has parameters of the rule, (sublattice, cell,
    cell), and `by_bond` limits, (plane, cell, cell), each by name.
    """

    rule: Any
    weights: dict[Slot, Any]
    fracture: Any
    limits: dict[Slot, Any]
    of_bond: Any
    of_particle: Any
    by_particle: Planes = field(default_factory=dict)
    by_bond: Planes = field(default_factory=dict)

    @property
    def shared(self) -> list[float]:
        """The parameters of the rule that are the same everywhere."""
        return [v for name, v in self.rule._asdict().items() if name not in self.by_particle]

    def limits_of(self, slot: Slot) -> list[float]:
        """The limits of a slot that all its bonds share."""
        own = self.limits[slot]._asdict()
        return [value for name, value in own.items() if name not in self.by_bond]

    def rule_at(self, where: Where) -> Any:
        """The rule's parameters of some particles."""
        return self.rule._replace(**{name: where.of(v) for name, v in self.by_particle.items()})

    def limits_at(self, slot: Slot, plane: int, home: Where) -> Any:
        """The limits of bonds along a slot, where they are kept on a plane."""
        own = {name: home.within(values[plane]) for name, values in self.by_bond.items()}
        return self.limits[slot]._replace(**own)


def ask_for_constants(experiment: Experiment, setting: Setting) -> SceneConstants:
    """What rule and fracture model answer; what they refuse is about their part."""
    slots = [slot for own in setting.slots for slot in own]
    rule, fracture = experiment.rule, experiment.fracture
    with blaming(rule, "when asked for its constants", "rule"):
        of_rule = _named("Parameters", rule.parameters(setting))
        weights = {s: named_weights(rule.weights(s, setting), rule) for s in slots}
        _refuse_other_names(weights, "weights")
    with blaming(fracture, "when asked for its constants", "fracture"):
        of_fracture = _named("Parameters", fracture.parameters())
        further = {s: of_material(fracture, rule, setting, s) for s in slots}
        if isinstance(fracture, SoftensCells) and not experiment.frame.weighs_cells:
            raise ExperimentError(
                f"'{fracture.type}' softens the cells of the body, which the frame "
                f"'{experiment.frame.type}' does not tell from others; take frame: "
                "{type: natural}, or fracture: {type: damage}"
            )
        limits = {s: _named("Constants", fracture.constants(s), **further[s]) for s in slots}
        _refuse_other_names(limits, "constants")
        if isinstance(rule, Calibrated) and fracture.can_break:
            _refuse_pulling(fracture, rule, slots, of_fracture)
        names = (*limits[slots[0]]._fields, *(n.name for n in bond_numbers(experiment)))
        if twice := {name for name in names if names.count(name) > 1}:
            raise PluginError(
                f"'{fracture.type}' has a constant and remembers a number of the name "
                f"'{min(twice)}': leave one out"
            )
    own = tuple(number.name for number in particle_numbers(experiment))
    kinds = _kind("Constants", names), _kind("Own", own)
    return SceneConstants(of_rule, weights, of_fracture, limits, *kinds)


def _refuse_pulling(
    fracture: FractureModel, rule: FollowerRule, slots: list[Slot], parameters: Any
) -> None:
    """A force that a lost bond goes on to exert on one end alone balances no other."""
    u = 0.1 * slots[0].rest
    lost = [fracture.fictitious(u, slot.rest, parameters) for slot in slots]
    if any(component != 0.0 for one in lost for component in one):
        raise ExperimentError(
            f"'{fracture.type}' places fictitious points that pull at the ends of lost bonds, and "
            f"under the calibrated rule '{rule.type}' nothing would balance these forces; take "
            "placement: 1 and fictitious: cell, or a rule of the paper"
        )


def named_weights(values: Any, rule: FollowerRule) -> Any:
    """w of what a rule gives for a slot."""
    return _named("Weights", values, **(WHOLE_CELLS if rule.uses_cells else {}))


def of_material(
    fracture: FractureModel, rule: FollowerRule, setting: Setting, slot: Slot
) -> dict[str, float]:
    """Further constants of a slot, of a model that knows the material."""
    if not isinstance(fracture, KnowsStiffness):
        return {}
    if not isinstance(rule, TearsCells) or rule.elasticity() is None:
        raise ExperimentError(
            f"'{fracture.type}' needs a rule that is calibrated to a material and works cell by "
            f"cell, which '{rule.type}' with these parameters is not; take 'springs' or 'elastic', "
            "or fracture: {type: damage}"
        )
    return fracture.of_material(slot, rule, setting)


def _named(kind: str, values: Any, **more: float) -> Any:
    """Plain numbers by name: those of numpy would raise single precision to double."""
    if not isinstance(values, dict):
        raise TypeError(f"it returned {type(values).__name__}, not numbers by name: {{'k': 1.0}}")
    return _kind(kind, (*values, *more))(*map(float, (*values.values(), *more.values())))


@cache
def _kind(name: str, fields: tuple[str, ...]) -> Any:
    """Making a kind of tuple takes as long as many a part of a scene."""
    return namedtuple(name, fields)


def _refuse_other_names(by_slot: dict[Slot, Any], what: str) -> None:
    if len({values._fields for values in by_slot.values()}) > 1:
        raise ValueError(f"its `{what}` do not have the same names for all slots")


class Home(Enum):
    """What has a value of its own."""

    SCENE = "scene"
    SLOT = "slot"
    CELL = "cell"
    BOND = "bond"
    PARTICLE = "particle"
    FIXED_BOND = "bond, by a field"
    FIXED_PARTICLE = "particle, by a field"


@dataclass(frozen=True)
class Number:
    """A number that elementwise functions see by its name; one that is remembered may change."""

    name: str
    home: Home
    changes: bool = False


Numbers = tuple[Number, ...]


@dataclass(frozen=True)
class VisibleNumbers:
    """The numbers by who sees them, in their order: the rule's parameters p, weights w and
    `here.own`, the fracture model's parameters p and c."""

    rule: Numbers
    weights: Numbers
    own: Numbers
    fracture: Numbers
    bond: Numbers


def numbers_of(
    experiment: Experiment, constants: SceneConstants, *, weighs_cells: bool
) -> VisibleNumbers:
    """What the functions of a scene's rule and fracture model see."""
    shares = WHOLE_CELLS if weighs_cells else {}
    weights = next(iter(constants.weights.values()))._fields
    limits = next(iter(constants.limits.values()))._fields
    return VisibleNumbers(
        _all(constants.rule._fields, Home.SCENE, constants.by_particle, Home.FIXED_PARTICLE),
        tuple(Number(w, Home.CELL if w in shares else Home.SLOT) for w in weights),
        _remembered(particle_numbers(experiment), Home.PARTICLE),
        _all(constants.fracture._fields, Home.SCENE),
        _all(limits, Home.SLOT, constants.by_bond, Home.FIXED_BOND)
        + _remembered(bond_numbers(experiment), Home.BOND),
    )


def _all(
    names: Iterable[str], home: Home, fixed: Container[str] = (), theirs: Home = Home.SCENE
) -> Numbers:
    return tuple(Number(name, theirs if name in fixed else home) for name in names)


def _remembered(numbers: Iterable[Remembered], home: Home) -> Numbers:
    return tuple(Number(number.name, home, number.changes) for number in numbers)


FEW = 3
"""So many places are looked at to see whether a part answers for whole arrays."""
PROBE = 0.7
"""So far, in bond lengths, ends are put to see what a fracture model's functions look at."""


def with_fields(
    constants: SceneConstants,
    experiment: Experiment,
    raster: Raster,
    neighbourhood: Neighbourhood,
    setting: Setting,
) -> SceneConstants:
    """The constants with those that fields make differ; the same where the experiment has none.

    Raises ExperimentError where the place cannot be taken into account.
    """
    rule, fracture = experiment.rule, experiment.fracture
    if not (rule.varying or fracture.varying):
        return constants
    _refuse(experiment)
    if rule.varying and not rule.uses_cells:
        with blaming(rule, "when asked for its constants", "rule"):
            found = _by_particle(experiment, raster, setting, constants)
        constants = replace(constants, by_particle=found)
    if fracture.can_break and (fracture.varying or _knows_varying(fracture, rule)):
        with blaming(fracture, "when asked for its constants", "fracture"):
            found = _by_bond(experiment, raster, neighbourhood, constants, setting)
        constants = replace(constants, by_bond=found)
    return constants


def _refuse(experiment: Experiment) -> None:
    rule, fracture = experiment.rule, experiment.fracture
    unfit = (
        (isinstance(rule, AppliesTwice), "rule",
         "applies a rule to the moves of another: what its energy would be is not told"),
        (experiment.neighbours.nearness(), "rule",
         "is asked for neighbours that are found anew; set neighbours.reevaluate: false"),
        (_draws(rule), "rule", "draws a number for each particle from it"),
        (_draws(fracture), "fracture", "draws a number for each bond from it"),
    )  # fmt: skip
    for clash, part_name, text in unfit:
        part: TakesFields = getattr(experiment, part_name)
        if clash and part.varying:
            name = min(part.varying)
            raise ExperimentError(
                f"'{part.type}' {text}; '{name}' must be one number here", (part_name, name)
            )


def _knows_varying(fracture: FractureModel, rule: FollowerRule) -> bool:
    """Whether bonds break by a stiffness that differs from place to place."""
    return isinstance(fracture, KnowsStiffness) and bool(rule.varying)


def _draws(part: TakesFields) -> bool:
    """Whether numbers that stay come from the part's parameters."""
    return isinstance(part, Draws) and any(not number.changes for number in part.remembered())


def _by_particle(
    experiment: Experiment, raster: Raster, setting: Setting, constants: SceneConstants
) -> dict[str, Floats]:
    """(sublattice, cell, cell) by name; frame points have the parameters that serve for all."""
    rule, rows = experiment.rule, raster.body_rows
    x, y = raster.reference(rows).T
    values = values_at(experiment, "rule", x, y, np.ones(len(rows), bool))
    _refuse_weights(rule, values, setting)
    place, found = raster.place_of(rows), {}
    for name, own in _asked(rule, values, lambda part: part.parameters(setting)).items():
        base = getattr(constants.rule, name)
        if raster.communicator.any((own != base).any()):
            planes = np.full(raster.shape, base)
            planes.reshape(-1)[place] = own
            found[name] = planes
    return found


def _refuse_weights(rule: FollowerRule, values: Values, setting: Setting) -> None:
    """Weights are of slots: they cannot differ from place to place."""
    slots = [slot for own in setting.slots for slot in own]
    parts, _ = kinds_of(rule, {name: _ends(value) for name, value in values.items()})
    weights = [[part.weights(slot, setting) for slot in slots] for part in parts]
    if any(own != weights[0] for own in weights):
        name = min(values)
        raise ExperimentError(
            f"'{rule.type}' takes its weights of neighbours from its numbers, and has one weight a "
            f"neighbour for all particles; '{name}' must be one number",
            ("rule", name),
        )


def _by_bond(
    experiment: Experiment,
    raster: Raster,
    around: Neighbourhood,
    constants: SceneConstants,
    setting: Setting,
) -> dict[str, Floats]:
    """(plane, cell, cell) by name, of the fracture model's limits; bonds take the values at their
    middle, and what the functions see besides must be the same everywhere."""
    fracture, slots = experiment.fracture, [plane.slot for plane in around.planes]
    base = [constants.limits[slot]._asdict() for slot in slots]
    shape, origin = raster.shape[1:], raster.lattice.origin
    found = {name: np.stack([np.full(shape, b[name]) for b in base]) for name in base[0]}
    for n, plane in enumerate(around.planes):
        if not (block := plane_block(raster, plane)):
            continue
        start = raster.reference_planes(block)
        middle = (start + 0.5 * plane.slot.rest).each(add, origin)
        x, y = np.broadcast_arrays(*middle)
        needed = bonds_in(raster, block, plane, frame_too=False)
        values = values_at(experiment, "fracture", x, y, needed)
        for rule, some in _rules_at(experiment, x, y, needed):
            ask = partial(_limits, plane.slot, rule, setting)
            own = {name: value[some] for name, value in values.items()}
            for name, limits in (_asked(fracture, own, ask) if own else ask(fracture)).items():
                block.within(found[name][n])[some] = limits
        if values:
            _refuse_parameters(experiment, constants, plane.slot, values)
    apart = {
        name: any((own != b[name]).any() for own, b in zip(planes, base, strict=True))
        for name, planes in found.items()
    }
    return {name: v for name, v in found.items() if raster.communicator.any(apart[name])}


def _rules_at(
    experiment: Experiment, x: Floats, y: Floats, needed: Mask
) -> Iterator[tuple[FollowerRule, Mask]]:
    """The rule as the fracture model knows it, and where: of each kind of place, if it does."""
    rule = experiment.rule
    parts, kind = [rule], np.zeros(x.shape, np.intp)
    if _knows_varying(experiment.fracture, rule):
        parts, kind = kinds_of(rule, values_at(experiment, "rule", x, y, needed))
    yield from ((part, kind == n) for n, part in enumerate(parts))


def _limits(slot: Slot, rule: FollowerRule, setting: Setting, fracture: FractureModel) -> Any:
    """What a fracture model gives for a slot, what it makes of the rule's stiffness included."""
    return {**fracture.constants(slot), **of_material(fracture, rule, setting, slot)}


def _refuse_parameters(
    experiment: Experiment, constants: SceneConstants, slot: Slot, values: Values
) -> None:
    """Limits are of bonds, the model's parameters of all: what its functions make of these must be
    the same everywhere."""
    fracture = experiment.fracture
    parts, _ = kinds_of(fracture, {name: _ends(value) for name, value in values.items()})
    alone = [_probed(experiment, constants, slot, part.parameters()) for part in parts]
    if any(not np.array_equal(answers, alone[0], equal_nan=True) for answers in alone):
        name = min(fracture.varying)
        raise ExperimentError(
            f"'{name}' of '{fracture.type}' is no limit of a bond: it must be one number",
            ("fracture", name),
        )


def _probed(
    experiment: Experiment, constants: SceneConstants, slot: Slot, parameters: Mapping[str, float]
) -> Floats:
    """What the model's functions make of some differences."""
    fracture, p = experiment.fracture, type(constants.fracture)(**parameters)
    initial = (number.initial for number in bond_numbers(experiment))
    c = constants.of_bond(*constants.limits[slot], *initial)
    u = vector(np.linspace(-PROBE, PROBE, 2 * FEW) * math.hypot(*slot.rest) for _ in slot.rest)
    lost = fracture.fictitious(u, slot.rest, p)
    answers = [*lost, fracture.breaks(u, slot.rest, c, p)]
    if isinstance(fracture, Softens):
        answers += fracture.seen(u, lost, slot.rest, c, p)
    return np.array([np.broadcast_to(np.asarray(a, float), (2 * FEW,)) for a in answers])


def _ends(value: Floats) -> Floats:
    """The smallest and the largest."""
    return np.array([value.min(), value.max()])


def _asked(
    part: Any, values: Values, ask: Callable[[Any], Mapping[str, Any]]
) -> dict[str, NDArray[Any]]:
    """What a part answers, by name, for numbers at places.

    It is asked for whole arrays first. Where it does not take them, or answers otherwise for the
    first places than for each by itself, it is asked once for each kind of place.
    """
    shape, names = next(iter(values.values())).shape, list(ask(part))
    found = _of_arrays(part, values, ask, names)
    if found is None:
        parts, kind = kinds_of(part, values)
        answers = [ask(one) for one in parts]
        found = {name: np.array([float(a[name]) for a in answers])[kind] for name in names}
    return {name: np.broadcast_to(value, shape) for name, value in found.items()}


def _of_arrays(
    part: Any, values: Values, ask: Callable[[Any], Mapping[str, Any]], names: Iterable[str]
) -> dict[str, NDArray[Any]] | None:
    try:
        answer = ask(part.model_copy(update=dict(values)))
        found = {name: np.asarray(answer[name], float) for name in names}
    except Exception:  # it is asked place by place instead
        return None
    size = next(iter(values.values())).size
    for n in sorted({0, size // 2, size - 1})[:FEW]:
        alone = ask(part.with_values(**{name: float(v.flat[n]) for name, v in values.items()}))
        for name, value in found.items():
            here = value if value.ndim == 0 else value.flat[n]
            if value.size not in (1, size) or float(here) != float(alone[name]):
                return None
    return found
