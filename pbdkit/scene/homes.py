"""The numbers that a scene's elementwise functions see: what they are, asked for once, and where
each lives, told once for numpy and for kernels.

A new kind of value is declared here: by who sees it, under which name, and where it lives.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from functools import cache
from typing import Any

from pbdkit.errors import ExperimentError, PluginError
from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import (
    FollowerRule,
    FractureModel,
    HasStiffBonds,
    KnowsStiffness,
    Remembered,
    Setting,
    Slot,
)
from pbdkit.registry.blame import blaming
from pbdkit.scene.declarations import bond_numbers, particle_numbers

WHOLE_CELLS = {"left": 1.0, "right": 1.0}
"""The shares of the cells on both sides of a bond, where no frame weighs cells."""


@dataclass(frozen=True)
class SceneConstants:
    """Named tuples: the parameters `rule` and `fracture` (``p``); by slot the rule's `weights`
    (``w``) and the fracture model's `limits` (``c`` without what is remembered). `of_bond` makes
    ``c`` of limits and remembered numbers, `of_particle` ``here.own``."""

    rule: Any
    weights: dict[Slot, Any]
    fracture: Any
    limits: dict[Slot, Any]
    of_bond: Any
    of_particle: Any


def ask_for_constants(experiment: Experiment, setting: Setting) -> SceneConstants:
    """What rule and fracture model answer; what they refuse is about their part."""
    slots = [slot for own in setting.slots for slot in own]
    rule, fracture = experiment.rule, experiment.fracture
    with blaming(rule, "when asked for its constants", "rule"):
        of_rule = _named("Parameters", rule.parameters(setting))
        sides = WHOLE_CELLS if rule.uses_cells else {}
        weights = {s: _named("Weights", rule.weights(s, setting), **sides) for s in slots}
        _refuse_other_names(weights, "weights")
    with blaming(fracture, "when asked for its constants", "fracture"):
        of_fracture = _named("Parameters", fracture.parameters())
        further = _of_material(fracture, rule, setting)
        limits = {
            s: _named("Constants", fracture.constants(s), **further.get(s, {})) for s in slots
        }
        _refuse_other_names(limits, "constants")
        names = (*limits[slots[0]]._fields, *(n.name for n in bond_numbers(experiment)))
        if twice := {name for name in names if names.count(name) > 1}:
            raise PluginError(
                f"'{fracture.type}' has a constant and remembers a number of the name "
                f"'{min(twice)}': leave one out"
            )
    own = tuple(number.name for number in particle_numbers(experiment))
    kinds = _kind("Constants", names), _kind("Own", own)
    return SceneConstants(of_rule, weights, of_fracture, limits, *kinds)


def _of_material(
    fracture: FractureModel, rule: FollowerRule, setting: Setting
) -> dict[Slot, dict[str, float]]:
    """Further constants by slot of a model that knows how stiff bonds are."""
    if not isinstance(fracture, KnowsStiffness):
        return {}
    if not isinstance(rule, HasStiffBonds) or rule.stiffness() is None:
        raise ExperimentError(
            f"'{fracture.type}' needs a rule that is calibrated to a material, and knows how stiff "
            f"bonds are, which '{rule.type}' with these parameters is not; take 'springs' or "
            "'elastic'"
        )
    slots = [slot for own in setting.slots for slot in own]
    stiffness = {slot: rule.stiffness_along(slot, setting) for slot in slots}
    return {slot: fracture.of_material(slot, stiffness, setting) for slot in slots}


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


@dataclass(frozen=True)
class Number:
    """A number that elementwise functions see by its name; one that is remembered may change."""

    name: str
    home: Home
    changes: bool = False


Numbers = tuple[Number, ...]


@dataclass(frozen=True)
class Seen:
    """The numbers by who sees them, in their order: the rule's parameters p, weights w and
    `here.own`, the fracture model's parameters p and c."""

    rule: Numbers
    weights: Numbers
    own: Numbers
    fracture: Numbers
    bond: Numbers


def numbers_of(experiment: Experiment, constants: SceneConstants, *, weighs_cells: bool) -> Seen:
    """What the functions of a scene's rule and fracture model see."""
    shares = WHOLE_CELLS if weighs_cells else {}
    weights = next(iter(constants.weights.values()))._fields
    limits = next(iter(constants.limits.values()))._fields
    return Seen(
        _all(constants.rule._fields, Home.SCENE),
        tuple(Number(w, Home.CELL if w in shares else Home.SLOT) for w in weights),
        _remembered(particle_numbers(experiment), Home.PARTICLE),
        _all(constants.fracture._fields, Home.SCENE),
        _all(limits, Home.SLOT) + _remembered(bond_numbers(experiment), Home.BOND),
    )


def _all(names: Iterable[str], home: Home) -> Numbers:
    return tuple(Number(name, home) for name in names)


def _remembered(numbers: Iterable[Remembered], home: Home) -> Numbers:
    return tuple(Number(number.name, home, number.changes) for number in numbers)
