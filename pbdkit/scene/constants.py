"""The numbers that a scene's elementwise functions are called with, asked for once."""

from __future__ import annotations

from collections import namedtuple
from dataclasses import dataclass
from functools import cache
from typing import Any

from pbdkit.errors import PluginError
from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import Setting, Slot
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
        limits = {s: _named("Constants", fracture.constants(s)) for s in slots}
        _refuse_other_names(limits, "constants")
        own = tuple(number.name for number in bond_numbers(experiment))
        names = limits[slots[0]]._fields if slots else ()
        if twice := set(names) & set(own):
            raise PluginError(
                f"'{fracture.type}' has a constant and remembers a number of the name "
                f"'{min(twice)}': leave one out"
            )
    of_particle = tuple(number.name for number in particle_numbers(experiment))
    kinds = _kind("Constants", (*names, *own)), _kind("Own", of_particle)
    return SceneConstants(of_rule, weights, of_fracture, limits, *kinds)


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
