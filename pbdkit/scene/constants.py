"""Constants and state variables that elementwise functions receive. This module calls them numbers.

Each number belongs to the scene, a slot, a cell, a bond or a particle. New kinds of numbers are
declared here, with their name and the functions that receive them. The numpy engine and the kernels
use these declarations.
"""

from __future__ import annotations

import math
from collections import namedtuple
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cache, partial
from itertools import chain, combinations
from operator import add
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from pbdkit.array_types import Floats, Mask
from pbdkit.errors import AccuracyWarning, ExperimentError, PluginError, of_category
from pbdkit.lattice.cells import patches
from pbdkit.lattice.fill import rounding_of
from pbdkit.lattice.neighbourhood import Neighbourhood, bonds_in, plane_block
from pbdkit.lattice.raster import FRAME, Raster, Restriction, Where
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
    MixesCells,
    Remembered,
    Remembers,
    Setting,
    Slot,
    Softens,
    SoftensCells,
    StoresEnergy,
    TearsCells,
    UsesAngles,
    UsesStiffness,
    Vector,
)
from pbdkit.plugin.component import as_values
from pbdkit.plugin.discovery import errors_attributed_to
from pbdkit.plugin.fields import ByRegion, TakesFields
from pbdkit.plugin.rule import material_of
from pbdkit.plugin.table import Table
from pbdkit.plugin.vector import vector

Declared = tuple[Remembered, ...]
"""Type of the declarations of state variables."""


def bond_numbers(experiment: Experiment) -> Declared:
    """Return the declarations of the state variables of bonds; none if bonds cannot break."""
    return _declared(experiment.fracture, "fracture") if experiment.fracture.can_break else ()


def particle_numbers(experiment: Experiment) -> Declared:
    """Return the declarations of the state variables of particles."""
    return _declared(experiment.rule, "rule")


def _declared(part: FollowerRule | FractureModel, field: str) -> Declared:
    if not isinstance(part, Remembers):
        return ()
    with errors_attributed_to(part, "to declare its remembered numbers", field):
        return as_values(part.remembered(), "remembered")


def remembered_names(experiment: Experiment) -> dict[str, str]:
    """Return for each state variable, by its name, the field of the component that declares it.

    Raises
    ------
    PluginError
        If a name is declared twice.
    """
    bonds, particles = bond_numbers(experiment), particle_numbers(experiment)
    names = [number.name for number in (*bonds, *particles)]
    for name in names:
        if (count := names.count(name)) > 1:
            raise PluginError(
                f"the number '{name}' is declared {count} times, by FractureModel "
                f"'{experiment.fracture.type}' and FollowerRule '{experiment.rule.type}'; "
                "use different names"
            )
    return {n.name: "fracture" for n in bonds} | {n.name: "rule" for n in particles}


def check_diagnostics(
    experiment: Experiment, raster: Raster, neighbourhood: Neighbourhood
) -> list[str]:
    """Check that diagnostics are compatible with the scene and with each other.

    Returns
    -------
    list
        Warnings about diagnostics.

    Raises
    ------
    ExperimentError
        If a diagnostic requires something that the scene does not have, or if two diagnostics
        declare the same variable.
    """
    owners = remembered_names(experiment)
    for n, diagnostic in enumerate(experiment.diagnostics):
        with errors_attributed_to(diagnostic, "to declare its variables", "diagnostics", n):
            diagnostic.check(raster.total, len(experiment.leaders))
            diagnostic.coordinates()
            if "cells" in diagnostic.needs and not raster.communicator.any(
                patches(raster, neighbourhood.tiling)
            ):
                raise ExperimentError(
                    f"'{diagnostic.type}' requires cells, but no cell has all its corners in the "
                    "body; use a wider body, or remove the diagnostic"
                )
            if "loads" in diagnostic.needs and not experiment.loads:
                raise ExperimentError(
                    f"'{diagnostic.type}' requires loads; the experiment has none"
                )
            if diagnostic.needs & {"material", "forces"}:
                _refuse_without_material(diagnostic, experiment)
            for variable in diagnostic.variables():
                is_plain = diagnostic.own_dimension != "obstacle" and not diagnostic.coordinates()
                if "obstacle" in variable.dims and is_plain and not experiment.obstacles:
                    raise ExperimentError(
                        f"'{diagnostic.type}' requires obstacles; the experiment has none"
                    )
                if variable.name in owners:
                    other = f"so does {owners[variable.name]}; remove one"
                    raise ExperimentError(f"adds the variable '{variable.name}'; {other}")
                owners[variable.name] = f"diagnostics.{n}"
    return _frame_warnings(experiment, raster)


def _frame_warnings(experiment: Experiment, raster: Raster) -> list[str]:
    has_frame = raster.communicator.any((raster.table_kind == FRAME).any())
    return of_category(
        AccuracyWarning,
        (
            f"diagnostics.{n}: '{diagnostic.type}' includes forces of frame points on leaders, "
            "which at the corners of prescribed edges are artefacts of the frame (the reaction of "
            "a clamped cantilever with 10 cells over its height is too large by a factor of 8 "
            "under 'mean', and has an error of 1.6 % under 'natural'); use frame: {type: natural}"
            for n, diagnostic in enumerate(experiment.diagnostics)
            if has_frame and "forces" in diagnostic.needs
        ),
    )


def _refuse_without_material(diagnostic: Diagnostic, experiment: Experiment) -> None:
    rule = experiment.rule
    if material_of(rule) is None:
        raise ExperimentError(
            f"'{diagnostic.type}' requires a rule that is calibrated to a material ('elastic', "
            f"'orthotropic', 'springs', 'strain-gradient'); '{rule.type}' with these parameters is "
            "not; use one of those, or remove the diagnostic"
        )
    if experiment.neighbours.nearness():
        raise ExperimentError(
            f"'{diagnostic.type}' requires fixed neighbours; set neighbours.reevaluate: false"
        )


Values = Mapping[str, Floats]
"""Type of spatially varying parameters: arrays over places, by name."""


def values_at(experiment: Experiment, field: str, x: Floats, y: Floats, needed: Mask) -> Values:
    """Evaluate the spatially varying parameters of a component at places.

    Parameters
    ----------
    experiment
        The experiment.
    field
        Field of the component in the experiment.
    x, y
        Coordinates of the places.
    needed
        Mask of the places where values are required. Elsewhere missing values are replaced by the
        default of the parameter.

    Returns
    -------
    dict
        Values by name of the parameter.

    Raises
    ------
    ExperimentError
        If a required place lies outside the data, or the values at a place are incompatible.
    """
    part: TakesFields = getattr(experiment, field)
    cell, regions = experiment.lattice.cell(), dict[str, Mask]()
    # Corners of cut cells lie at most this distance outside the body.
    reach = max(math.hypot(*vector) for vector in cell.vectors)
    if any(isinstance(varying, ByRegion) for varying in part.varying.values()):
        for name, region in experiment.regions.items():
            regions[name] = signed_distance(region, cell, x, y) <= 0.0
    result = {}
    for name, varying in part.varying.items():
        values = varying.at(x, y, regions, reach)
        missing = np.isnan(values)
        if (missing & needed).any():
            place = int(np.argmax(missing & needed))
            raise ExperimentError(
                f"has no value at ({x.flat[place]:.6g}, {y.flat[place]:.6g}), where one is "
                "required; extend its data to cover the body",
                (field, name),
            )
        result[name] = np.where(missing, getattr(part, name), values)
    if len(result) > 1 and needed.any():
        selected = {name: array[needed] for name, array in result.items()}
        _refuse_incompatible(part, field, selected, x[needed], y[needed])
    return result


def _refuse_incompatible(
    part: TakesFields, field: str, values: Values, x: Floats, y: Floats
) -> None:
    """Validate the values of all parameters together, at the places where the difference between
    two parameters is largest.

    Values that are valid for each parameter alone can be incompatible, for instance if one
    parameter must exceed another.
    """
    for first, second in combinations(values.values(), 2):
        for place in (int(np.argmin(first - second)), int(np.argmax(first - second))):
            try:
                part.with_values(**{name: float(array[place]) for name, array in values.items()})
            except ValidationError as error:
                fault = error.errors()[0]
                text = f"at ({x[place]:.6g}, {y[place]:.6g}): {fault['msg']}"
                raise ExperimentError(text, (field, fault.get("ctx", {}).get("key", ""))) from None


def signed_distance(body: Body, cell: Cell, x: Floats, y: Floats) -> Floats:
    """Return the signed distance from an outline, negative inside, exactly zero within rounding."""
    nowhere = np.zeros(np.shape(x), int)
    distance = body.distance(Sites((nowhere, nowhere), Vector(x, y)))
    return np.where(np.abs(distance) <= rounding_of(cell, x, y), 0.0, distance)


def kinds_of(part: TakesFields, values: Values) -> tuple[list[Any], NDArray[np.intp]]:
    """Return the component with each distinct combination of values, and the index of the
    combination at each place.

    Returns
    -------
    tuple
        Components, and indices in the shape of the values.
    """
    shape = next(iter(values.values())).shape
    table = np.stack([value.ravel() for value in values.values()], axis=1)
    rows, kind = np.unique(table, axis=0, return_inverse=True)
    parts = [part.with_values(**dict(zip(values, row, strict=True))) for row in rows.tolist()]
    return parts, kind.reshape(shape)


WHOLE_CELLS = {"left": 1.0, "right": 1.0}
"""Area fractions of the cells on both sides of a bond if the frame policy does not weight cells."""
Planes = Mapping[str, Floats]
"""Type of values for each particle or each bond, by name."""


Pairs = tuple[tuple[int, int], ...]
"""Type of pairs of slots, by their indices."""


@dataclass(frozen=True)
class SceneConstants:
    """Constants passed to elementwise functions, as named tuples.

    Parameters
    ----------
    rule
        Parameters ``p`` of the rule.
    weights
        Weights ``w`` of the rule, by slot.
    fracture
        Parameters ``p`` of the fracture model.
    limits
        Constants of the fracture model by slot. State variables, which are also in ``c``, are not
        included.
    of_bond
        Named tuple of limits and state variables of a bond, ``c``.
    of_particle
        Named tuple of state variables of a particle, ``here.own``.
    by_particle
        Spatially varying parameters of the rule by name, (sublattice, cell, cell).
    pairs
        Pairs of slots of each sublattice, for a rule that uses angles.
    by_bond
        Spatially varying limits by name, (plane, cell, cell).
    """

    rule: Any
    weights: dict[Slot, Any]
    fracture: Any
    limits: dict[Slot, Any]
    of_bond: Any
    of_particle: Any
    pairs: tuple[Pairs, ...] = ()
    by_particle: Planes = field(default_factory=dict)
    by_bond: Planes = field(default_factory=dict)

    def restrict(self, to: Restriction) -> SceneConstants:
        """Return the constants restricted to some rows."""
        by_particle = {name: to.cut(planes) for name, planes in self.by_particle.items()}
        by_bond = {name: to.cut(planes) for name, planes in self.by_bond.items()}
        return replace(self, by_particle=by_particle, by_bond=by_bond)

    @property
    def shared(self) -> list[float]:
        """Parameters of the rule that do not vary in space."""
        numbers = {name: v for name, v in self.rule._asdict().items() if isinstance(v, float)}
        return [v for name, v in numbers.items() if name not in self.by_particle]

    @property
    def choices(self) -> list[str]:
        """Parameters of the rule that are chosen by name."""
        return [v for v in self.rule if isinstance(v, str)]

    @property
    def tables(self) -> list[Floats]:
        """Parameters of the rule that are tables."""
        return [v for v in self.rule if isinstance(v, np.ndarray)]

    def limits_of(self, slot: Slot) -> list[float]:
        """Return those limits of a slot that do not vary in space."""
        limits = self.limits[slot]._asdict()
        return [value for name, value in limits.items() if name not in self.by_bond]

    def rule_at(self, where: Where) -> Any:
        """Return the parameters of the rule at particles."""
        return self.rule._replace(**{name: where.of(v) for name, v in self.by_particle.items()})

    def limits_at(self, slot: Slot, plane: int, owner: Where) -> Any:
        """Return the limits of the bonds along a slot. `plane` is the index of the plane in which
        the bonds are stored, and `owner` are the places at which they are stored."""
        if not self.by_bond:
            return self.limits[slot]
        values = {name: owner.within(planes[plane]) for name, planes in self.by_bond.items()}
        return self.limits[slot]._replace(**values)


def scene_constants(experiment: Experiment, setting: Setting) -> SceneConstants:
    """Compute the constants of the rule and the fracture model.

    Raises
    ------
    ExperimentError
        If a component does not support the lattice or the other components.
    PluginError
        If a component fails or returns malformed constants.
    """
    slots = [slot for ends in setting.slots for slot in ends]
    rule, fracture = experiment.rule, experiment.fracture
    with errors_attributed_to(rule, "to return its constants", "rule"):
        of_rule = _named("Parameters", rule.parameters(setting), convert=_parameter)
        weights = {s: named_weights(rule.weights(s, setting), rule) for s in slots}
        _refuse_other_names(weights, "weights")
        pairs = _pairs(rule, setting, experiment)
    with errors_attributed_to(fracture, "to return its constants", "fracture"):
        of_fracture = _named("Parameters", fracture.parameters())
        material_constants = {s: of_material(fracture, rule, setting, s) for s in slots}
        if isinstance(fracture, SoftensCells) and not experiment.frame.weighs_cells:
            raise ExperimentError(
                f"'{fracture.type}' softens the cells of the body, which the frame "
                f"'{experiment.frame.type}' does not distinguish from other cells; use frame: "
                "{type: natural}, or fracture: {type: damage}"
            )
        limits = {
            s: _named("Constants", fracture.constants(s), material_constants[s]) for s in slots
        }
        _refuse_other_names(limits, "constants")
        if isinstance(rule, Calibrated) and fracture.can_break:
            _refuse_pulling(fracture, rule, slots, of_fracture)
        names = (*limits[slots[0]]._fields, *(n.name for n in bond_numbers(experiment)))
        if duplicates := {name for name in names if names.count(name) > 1}:
            raise PluginError(
                f"'{fracture.type}' has a constant and a remembered number of the name "
                f"'{min(duplicates)}'; rename one of them"
            )
    particle_names = tuple(number.name for number in particle_numbers(experiment))
    kinds = _kind("Constants", names), _kind("Own", particle_names)
    return SceneConstants(of_rule, weights, of_fracture, limits, *kinds, pairs)


NO_PAIRS = (TearsCells, MixesCells, StoresEnergy)
"""Capabilities of which the functions receive single neighbours, so that they cannot be combined
with sums over pairs."""


def _pairs(rule: FollowerRule, setting: Setting, experiment: Experiment) -> tuple[Pairs, ...]:
    """Return the pairs of slots of each sublattice; none if the rule does not use angles.

    Raises
    ------
    ExperimentError
        If a sublattice has no pairs, or neighbours are re-evaluated.
    PluginError
        If the rule has capabilities that cannot be combined, or returns malformed pairs.
    """
    if not isinstance(rule, UsesAngles):
        return ()
    for kind in NO_PAIRS:
        if isinstance(rule, kind):
            raise PluginError(
                f"'{rule.type}' is both {kind.__name__} and UsesAngles, which cannot be combined; "
                "remove one of the two base classes"
            )
    if experiment.neighbours.nearness():
        raise ExperimentError(
            f"'{rule.type}' sums over pairs of constant neighbours; set neighbours.reevaluate: "
            "false"
        )
    result = []
    for slots in setting.slots:
        pairs = tuple((int(k), int(n)) for k, n in as_values(rule.pairs(slots), "pairs"))
        if not pairs:
            raise ExperimentError(
                f"'{rule.type}' requires pairs of neighbours; this lattice has none in a shell: "
                "use neighbours with two or more in a shell"
            )
        if any(not 0 <= n < len(slots) for n in chain.from_iterable(pairs)):
            raise ValueError(
                f"`pairs` returned {pairs}; return indices of the slots, from 0 to {len(slots) - 1}"
            )
        result.append(pairs)
    return tuple(result)


def _refuse_pulling(
    fracture: FractureModel, rule: FollowerRule, slots: list[Slot], parameters: Any
) -> None:
    """Raise ExperimentError if broken bonds exert forces under a calibrated rule.

    The fictitious point of a broken bond exerts a force on one end only, so that forces would not
    balance.
    """
    u = 0.1 * slots[0].rest
    lost = [fracture.fictitious(u, slot.rest, parameters) for slot in slots]
    if any(component != 0.0 for difference in lost for component in difference):
        raise ExperimentError(
            f"'{fracture.type}' places fictitious points that exert forces at broken bonds, and "
            f"under the calibrated rule '{rule.type}' these forces would not balance; use "
            "placement: 1 and fictitious: cell, or a rule of the paper"
        )


def named_weights(values: Any, rule: FollowerRule) -> Any:
    """Return the weights of a rule for a slot as the named tuple that functions receive as
    ``w``."""
    return _named("Weights", values, WHOLE_CELLS if rule.uses_cells else {})


def of_material(
    fracture: FractureModel, rule: FollowerRule, setting: Setting, slot: Slot
) -> dict[str, float]:
    """Return the constants of a slot that a fracture model derives from the material.

    Raises
    ------
    ExperimentError
        If the rule is not calibrated to a material, or is not defined on cells although the
        fracture model requires cells.
    """
    if not isinstance(fracture, UsesStiffness):
        return {}
    if not isinstance(rule, TearsCells) or rule.elasticity() is None:
        raise ExperimentError(
            f"'{fracture.type}' requires a rule that is calibrated to a material and defined by "
            f"cells; '{rule.type}' with these parameters is not; use 'springs' or 'elastic', or "
            "fracture: {type: damage}"
        )
    return fracture.of_material(slot, rule, setting)


def _parameter(value: Any) -> Any:
    """Return a parameter of a rule as its functions receive it: a number, a word or a table."""
    if isinstance(value, str):
        return value
    return value.array if isinstance(value, Table) else float(value)


def _named(
    kind: str,
    values: Any,
    more: Mapping[str, float] | None = None,
    convert: Callable[[Any], Any] | None = None,
) -> Any:
    """Return a named tuple of Python floats. numpy's scalars are not used because they would
    promote single precision to double precision. Another function can convert the values."""
    constants = more or {}
    if not isinstance(values, dict):
        raise TypeError(
            f"it returned {type(values).__name__}; return numbers by name: {{'k': 1.0}}"
        )
    numbers = {**values, **constants}
    for name, value in numbers.items():
        try:
            numbers[name] = convert(value) if convert else float(value)
        except (TypeError, ValueError):
            raise TypeError(
                f"it returned {type(value).__name__} as '{name}', not a number; return one number "
                f"for each component, as {name}_x and {name}_y"
            ) from None
    return _kind(kind, tuple(numbers))(*numbers.values())


@cache
def _kind(name: str, fields: tuple[str, ...]) -> Any:
    """Create a type of named tuples. The result is cached, because creating a type is slow."""
    return namedtuple(name, fields)


def _refuse_other_names(by_slot: dict[Slot, Any], what: str) -> None:
    if len({values._fields for values in by_slot.values()}) > 1:
        raise ValueError(f"`{what}` returned different names for different slots; use the same")


class Owner(Enum):
    """Kind of object to which a number belongs."""

    SCENE = "scene"
    """One value for the whole scene."""
    SLOT = "slot"
    """One value for each slot."""
    CELL = "cell"
    """One value for each cell beside a slot."""
    BOND = "bond"
    """One value for each bond, stored as a state variable."""
    PARTICLE = "particle"
    """One value for each particle, stored as a state variable."""
    FIXED_BOND = "bond, by a field"
    """One value for each bond, constant in time."""
    FIXED_PARTICLE = "particle, by a field"
    """One value for each particle, constant in time."""
    CHOICE = "scene, as a word"
    """One word for the whole scene, which is a constant of the code."""
    TABLE = "scene, as a table"
    """One table for the whole scene."""


@dataclass(frozen=True)
class Number:
    """Constant or state variable that is passed to elementwise functions.

    Parameters
    ----------
    name
        Name of the constant or state variable.
    owner
        Kind of object to which it belongs.
    changes
        Whether it can change during a run.
    """

    name: str
    owner: Owner
    changes: bool = False


Numbers = tuple[Number, ...]
"""Type of the numbers that a function receives, in order."""


@dataclass(frozen=True)
class VisibleNumbers:
    """Numbers that elementwise functions receive, sorted by the argument that contains them.

    Parameters
    ----------
    rule
        Parameters ``p`` of the rule.
    weights
        Weights ``w`` of the rule.
    own
        State variables of a particle, ``here.own``.
    fracture
        Parameters ``p`` of the fracture model.
    bond
        Constants and state variables of a bond, ``c``.
    """

    rule: Numbers
    weights: Numbers
    own: Numbers
    fracture: Numbers
    bond: Numbers


def numbers_of(
    experiment: Experiment, constants: SceneConstants, *, weighs_cells: bool
) -> VisibleNumbers:
    """Return the numbers that the functions of the rule and the fracture model receive."""
    shares = WHOLE_CELLS if weighs_cells else {}
    weights = next(iter(constants.weights.values()))._fields
    limits = next(iter(constants.limits.values()))._fields
    return VisibleNumbers(
        tuple(Number(name, _owner(name, constants)) for name in constants.rule._fields),
        tuple(Number(w, Owner.CELL if w in shares else Owner.SLOT) for w in weights),
        _remembered(particle_numbers(experiment), Owner.PARTICLE),
        _all(constants.fracture._fields, Owner.SCENE),
        _all(limits, Owner.SLOT, constants.by_bond, Owner.FIXED_BOND)
        + _remembered(bond_numbers(experiment), Owner.BOND),
    )


def _owner(name: str, constants: SceneConstants) -> Owner:
    """Return the owner of a parameter of the rule."""
    value = getattr(constants.rule, name)
    if isinstance(value, str):
        return Owner.CHOICE
    if isinstance(value, np.ndarray):
        return Owner.TABLE
    return Owner.FIXED_PARTICLE if name in constants.by_particle else Owner.SCENE


def _all(
    names: Iterable[str],
    owner: Owner,
    varying: Container[str] = (),
    varying_owner: Owner = Owner.SCENE,
) -> Numbers:
    return tuple(Number(name, varying_owner if name in varying else owner) for name in names)


def _remembered(numbers: Iterable[Remembered], owner: Owner) -> Numbers:
    return tuple(Number(number.name, owner, number.changes) for number in numbers)


SAMPLE_COUNT = 3
"""Number of places at which the result of a component for whole arrays is compared with its results
for single places."""
PROBE = 0.7
"""Largest relative displacement at which fracture models are evaluated, in bond lengths."""


def with_fields(
    constants: SceneConstants,
    experiment: Experiment,
    raster: Raster,
    neighbourhood: Neighbourhood,
    setting: Setting,
) -> SceneConstants:
    """Add the constants that vary in space.

    Raises
    ------
    ExperimentError
        If a component does not support spatially varying parameters.
    """
    rule, fracture = experiment.rule, experiment.fracture
    if not (rule.varying or fracture.varying):
        return constants
    _refuse(experiment)
    if rule.varying and not rule.uses_cells:
        with errors_attributed_to(rule, "to return its constants", "rule"):
            planes = _by_particle(experiment, raster, setting, constants)
        constants = replace(constants, by_particle=planes)
    if fracture.can_break and (fracture.varying or _uses_varying(fracture, rule)):
        with errors_attributed_to(fracture, "to return its constants", "fracture"):
            planes = _by_bond(experiment, raster, neighbourhood, constants, setting)
        constants = replace(constants, by_bond=planes)
    return constants


def _refuse(experiment: Experiment) -> None:
    """Raise ExperimentError if a component does not support spatially varying parameters."""
    rule, fracture = experiment.rule, experiment.fracture
    clashes = (
        (isinstance(rule, AppliesTwice), "rule",
         "applies a rule to the moves of another, and has no energy for varying parameters"),
        (experiment.neighbours.nearness(), "rule",
         "requires fixed neighbours for varying parameters; set neighbours.reevaluate: false"),
        (_draws(rule), "rule", "draws a random number for each particle from its parameters"),
        (_draws(fracture), "fracture", "draws a random number for each bond from its parameters"),
    )  # fmt: skip
    for clash, part_name, text in clashes:
        part: TakesFields = getattr(experiment, part_name)
        if clash and part.varying:
            name = min(part.varying)
            raise ExperimentError(
                f"'{part.type}' {text}; '{name}' must be a single number", (part_name, name)
            )


def _uses_varying(fracture: FractureModel, rule: FollowerRule) -> bool:
    """Return whether the fracture model depends on the stiffness of the rule while this stiffness
    varies in space."""
    return isinstance(fracture, UsesStiffness) and bool(rule.varying)


def _draws(part: TakesFields) -> bool:
    """Return whether a component has constant state variables that are drawn at random, in
    dependence on its parameters."""
    return isinstance(part, Draws) and any(not number.changes for number in part.remembered())


def _by_particle(
    experiment: Experiment, raster: Raster, setting: Setting, constants: SceneConstants
) -> dict[str, Floats]:
    """Compute the spatially varying parameters of the rule by name, (sublattice, cell, cell).

    Frame points have the default parameters.
    """
    rule, rows = experiment.rule, raster.body_rows
    x, y = raster.reference(rows).T
    values = values_at(experiment, "rule", x, y, np.ones(len(rows), bool))
    _refuse_weights(rule, values, setting)
    place, result = raster.place_of(rows), {}

    def numbers_of_rule(part: FollowerRule) -> dict[str, Any]:
        parameters = part.parameters(setting).items()
        return {name: v for name, v in parameters if not isinstance(v, (str, Table))}

    for name, numbers in _evaluate(rule, values, numbers_of_rule).items():
        base = getattr(constants.rule, name)
        if raster.communicator.any((numbers != base).any()):
            planes = np.full(raster.shape, base)
            planes.reshape(-1)[place] = numbers
            result[name] = planes
    return result


def _refuse_weights(rule: FollowerRule, values: Values, setting: Setting) -> None:
    """Raise ExperimentError if the weights depend on varying parameters, because the weights of a
    slot cannot vary in space."""
    slots = [slot for ends in setting.slots for slot in ends]
    parts, _ = kinds_of(rule, {name: _ends(value) for name, value in values.items()})
    weights = [[part.weights(slot, setting) for slot in slots] for part in parts]
    if any(other != weights[0] for other in weights):
        name = min(values)
        raise ExperimentError(
            f"the weights of '{rule.type}' depend on its parameters and are the same for all "
            f"particles; '{name}' must be a single number",
            ("rule", name),
        )


def _by_bond(
    experiment: Experiment,
    raster: Raster,
    neighbourhood: Neighbourhood,
    constants: SceneConstants,
    setting: Setting,
) -> dict[str, Floats]:
    """Compute the spatially varying limits of the fracture model by name, (plane, cell, cell).

    The parameters are evaluated at the midpoint of each bond. Results of the model other than
    limits must not vary.
    """
    fracture, slots = experiment.fracture, [plane.slot for plane in neighbourhood.planes]
    base = [constants.limits[slot]._asdict() for slot in slots]
    shape, origin = raster.shape[1:], raster.lattice.origin
    result = {name: np.stack([np.full(shape, b[name]) for b in base]) for name in base[0]}
    for n, plane in enumerate(neighbourhood.planes):
        if not (block := plane_block(raster, plane)):
            continue
        start = raster.reference_planes(block)
        middle = (start + 0.5 * plane.slot.rest).each(add, origin)
        x, y = np.broadcast_arrays(*middle)
        needed = bonds_in(raster, block, plane, frame_too=False)
        values = values_at(experiment, "fracture", x, y, needed)
        for rule, mask in _rules_at(experiment, x, y, needed):
            limits_of = partial(_limits, plane.slot, rule, setting)
            local = {name: value[mask] for name, value in values.items()}
            limits = _evaluate(fracture, local, limits_of) if local else limits_of(fracture)
            for name, numbers in limits.items():
                block.within(result[name][n])[mask] = numbers
        if values:
            _refuse_parameters(experiment, constants, plane.slot, values)
    varies = {
        name: any((limits != b[name]).any() for limits, b in zip(planes, base, strict=True))
        for name, planes in result.items()
    }
    return {name: v for name, v in result.items() if raster.communicator.any(varies[name])}


def _rules_at(
    experiment: Experiment, x: Floats, y: Floats, needed: Mask
) -> Iterator[tuple[FollowerRule, Mask]]:
    """Generate the rule for each combination of parameters that occurs, and a mask of the places
    with this combination.
    """
    rule = experiment.rule
    parts, kind = [rule], np.zeros(x.shape, np.intp)
    if _uses_varying(experiment.fracture, rule):
        parts, kind = kinds_of(rule, values_at(experiment, "rule", x, y, needed))
    yield from ((part, kind == n) for n, part in enumerate(parts))


def _limits(slot: Slot, rule: FollowerRule, setting: Setting, fracture: FractureModel) -> Any:
    """Return the constants of a fracture model for a slot, including the constants derived from the
    material.
    """
    return {**fracture.constants(slot), **of_material(fracture, rule, setting, slot)}


def _refuse_parameters(
    experiment: Experiment, constants: SceneConstants, slot: Slot, values: Values
) -> None:
    """Raise ExperimentError if functions of the fracture model depend directly on varying
    parameters. They may depend on them only by means of limits.

    The reason is that limits are stored for each bond, but parameters only once for all bonds.
    """
    fracture = experiment.fracture
    parts, _ = kinds_of(fracture, {name: _ends(value) for name, value in values.items()})
    results = [_probed(experiment, constants, slot, part.parameters()) for part in parts]
    if any(not np.array_equal(answers, results[0], equal_nan=True) for answers in results):
        name = min(fracture.varying)
        raise ExperimentError(
            f"'{name}' of '{fracture.type}' is not a limit of bonds; it must be a single number",
            ("fracture", name),
        )


def _probed(
    experiment: Experiment, constants: SceneConstants, slot: Slot, parameters: Mapping[str, float]
) -> Floats:
    """Evaluate the functions of the fracture model for several relative displacements."""
    fracture, p = experiment.fracture, type(constants.fracture)(**parameters)
    initial = (number.initial for number in bond_numbers(experiment))
    c = constants.of_bond(*constants.limits[slot], *initial)
    size = 2 * SAMPLE_COUNT
    u = vector(np.linspace(-PROBE, PROBE, size) * math.hypot(*slot.rest) for _ in slot.rest)
    lost = fracture.fictitious(u, slot.rest, p)
    answers = [*lost, fracture.breaks(u, slot.rest, c, p)]
    if isinstance(fracture, Softens):
        answers += fracture.seen(u, lost, slot.rest, c, p)
    return np.array([np.broadcast_to(np.asarray(a, float), (size,)) for a in answers])


def _ends(value: Floats) -> Floats:
    return np.array([value.min(), value.max()])


def _evaluate(
    part: Any, values: Values, function: Callable[[Any], Mapping[str, Any]]
) -> dict[str, NDArray[Any]]:
    """Evaluate a function of a component with spatially varying parameters.

    The function is first evaluated on whole arrays. If it does not support arrays, or if its
    results for several places differ from those for each place alone, it is evaluated once for each
    distinct combination of values.
    """
    shape, names = next(iter(values.values())).shape, list(function(part))
    result = _evaluate_arrays(part, values, function, names)
    if result is None:
        parts, kind = kinds_of(part, values)
        answers = [function(component) for component in parts]
        result = {name: np.array([float(a[name]) for a in answers])[kind] for name in names}
    return {name: np.broadcast_to(value, shape) for name, value in result.items()}


def _evaluate_arrays(
    part: Any, values: Values, function: Callable[[Any], Mapping[str, Any]], names: Iterable[str]
) -> dict[str, NDArray[Any]] | None:
    try:
        answer = function(part.model_copy(update=dict(values)))
        result = {name: np.asarray(answer[name], float) for name in names}
    except Exception:  # The function is then evaluated for each combination of values.
        return None
    size = next(iter(values.values())).size
    for n in sorted({0, size // 2, size - 1})[:SAMPLE_COUNT]:
        numbers = {name: float(value.flat[n]) for name, value in values.items()}
        expected = function(part.with_values(**numbers))
        for name, value in result.items():
            number = value if value.ndim == 0 else value.flat[n]
            if value.size not in (1, size) or float(number) != float(expected[name]):
                return None
    return result
