"""The numbers that a scene's elementwise functions are called with, asked for once."""

from __future__ import annotations

from collections import namedtuple
from dataclasses import dataclass
from functools import cache
from typing import Any

from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import Setting, Slot
from pbdkit.interfaces.answers import as_values
from pbdkit.registry.blame import blaming

Constants = tuple[float, ...]
WHOLE_CELLS = (1.0, 1.0)
"""The shares of the cells on both sides of a bond, where no frame weighs cells."""


@dataclass(frozen=True)
class SceneConstants:
    """Parameters as tuples with names (``p.K``), and by slot the rule's weights and, where bonds
    can break, the fracture model's constants."""

    rule: Any
    weights: dict[Slot, Constants]
    fracture: Any
    limits: dict[Slot, Constants]


def ask_for_constants(experiment: Experiment, setting: Setting) -> SceneConstants:
    """What rule and fracture model answer; what they refuse is about their part."""
    slots = [slot for own in setting.slots for slot in own]
    with blaming(experiment.rule, "when asked for its constants", "rule"):
        rule = _named(experiment.rule.parameters(setting))
        sides = WHOLE_CELLS if experiment.rule.uses_cells else ()
        weights = {
            s: (*_numbers(experiment.rule.weights(s, setting), "weights"), *sides) for s in slots
        }
    fracture = experiment.fracture
    with blaming(fracture, "when asked for its constants", "fracture"):
        parameters = _named(fracture.parameters())
        asked = slots if fracture.can_break else []
        limits = {s: _numbers(fracture.constants(s), "constants") for s in asked}
    return SceneConstants(rule, weights, parameters, limits)


def _named(values: dict[str, float]) -> Any:
    return _kind(tuple(values))(*map(float, values.values()))


@cache
def _kind(names: tuple[str, ...]) -> Any:
    """Making a kind of tuple takes as long as many a part of a scene."""
    return namedtuple("Parameters", names)


def _numbers(answer: Any, what: str) -> Constants:
    """Plain numbers: those of numpy would raise single precision to double."""
    return tuple(map(float, as_values(answer, what)))
