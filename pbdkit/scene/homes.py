"""Where each number lives that elementwise functions see: told once, for numpy and for kernels.

A new kind of value is declared here: by who sees it, under which name, and where it lives.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from pbdkit.interfaces import Remembered
from pbdkit.scene.constants import WHOLE_CELLS
from pbdkit.scene.declarations import bond_numbers, particle_numbers
from pbdkit.scene.scene import Scene


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


def numbers_of(scene: Scene) -> Seen:
    """What the functions of a scene's rule and fracture model see."""
    constants, experiment = scene.constants, scene.experiment
    shares = tuple(WHOLE_CELLS) if scene.cells else ()
    weights = next(iter(constants.weights.values()))._fields
    limits = next((limits._fields for limits in constants.limits.values()), ())
    return Seen(
        _all(constants.rule._fields, Home.SCENE),
        tuple(Number(w, Home.CELL if w in shares else Home.SLOT) for w in weights),
        _remembered(particle_numbers(experiment), Home.PARTICLE),
        _all(constants.fracture._fields, Home.SCENE),
        _all(limits, Home.SLOT) + _remembered(bond_numbers(experiment), Home.BOND),
    )


def _all(names: tuple[str, ...], home: Home) -> Numbers:
    return tuple(Number(name, home) for name in names)


def _remembered(numbers: tuple[Remembered, ...], home: Home) -> Numbers:
    return tuple(Number(number.name, home, number.changes) for number in numbers)
