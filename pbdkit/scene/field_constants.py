"""Constants of a scene that fields make differ from particle to particle or from bond to bond."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from operator import add
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbdkit.errors import ExperimentError
from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import (
    AppliesTwice,
    Draws,
    FollowerRule,
    FractureModel,
    KnowsStiffness,
    Setting,
    Slot,
    Softens,
)
from pbdkit.interfaces.fields import TakesFields
from pbdkit.interfaces.vector import vector
from pbdkit.registry.blame import blaming
from pbdkit.scene.bonds import bonds_in, plane_block
from pbdkit.scene.declarations import bond_numbers
from pbdkit.scene.field_values import Values, kinds_of, values_at
from pbdkit.scene.homes import SceneConstants, of_material
from pbdkit.scene.neighbourhood import Neighbourhood
from pbdkit.scene.places import Floats, Mask
from pbdkit.scene.raster import Raster

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
    for clash, field, text in unfit:
        part: TakesFields = getattr(experiment, field)
        if clash and part.varying:
            name = min(part.varying)
            raise ExperimentError(
                f"'{part.type}' {text}; '{name}' must be one number here", (field, name)
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
        if raster.others.any((own != base).any()):
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
    return {name: v for name, v in found.items() if raster.others.any(apart[name])}


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
