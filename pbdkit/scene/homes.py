"""The numbers that a scene's elementwise functions see: what they are, asked for once, and where
each lives, told once for numpy and for kernels.

A new kind of value is declared here: by who sees it, under which name, and where it lives.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import cache
from typing import Any

from pbdkit.errors import ExperimentError, PluginError
from pbdkit.experiment.model import Experiment
from pbdkit.interfaces import (
    Calibrated,
    FollowerRule,
    FractureModel,
    KnowsStiffness,
    Remembered,
    Setting,
    Slot,
    SoftensCells,
    TearsCells,
)
from pbdkit.registry.blame import blaming
from pbdkit.scene.declarations import bond_numbers, particle_numbers
from pbdkit.scene.places import Floats, Where

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
