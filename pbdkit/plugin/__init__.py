"""The interfaces that component authors implement and the data that they exchange, and the registry
of installed components.
"""

from __future__ import annotations

from pbdkit.plugin.component import Bonds, Component, Draws, Pair, Particles, Remembered, Remembers
from pbdkit.plugin.diagnostic import (
    Diagnostic,
    LeaderRows,
    LoadRows,
    Moment,
    TouchingRows,
    Variable,
)
from pbdkit.plugin.fracture import (
    BreaksAtStrain,
    CellStress,
    FractureModel,
    KnowsStiffness,
    RenewsBonds,
    Softens,
    SoftensCells,
    StartsCracked,
)
from pbdkit.plugin.frame import Anchors, FrameMap, FramePolicy, FrameSites
from pbdkit.plugin.lattice import BasisSite, Cell, Lattice, Nearness, NeighbourMetric, Offset, Slot
from pbdkit.plugin.operation import ParticleOperation
from pbdkit.plugin.rule import (
    AppliesTwice,
    Calibrated,
    FollowerRule,
    Here,
    Loadable,
    MixesCells,
    RenewsParticles,
    Setting,
    SharesParticles,
    Stiffness,
    StoresEnergy,
    TearsCells,
    Torn,
    TurnsParticles,
)
from pbdkit.plugin.units import AREA, ENERGY, FORCE, FRACTURE_ENERGY, LENGTH, STRESS, Quantity
from pbdkit.plugin.vector import Components, SpaceVector, Vector, dot, length, squared_length, where

INTERFACES: dict[str, type[Component]] = {
    "lattice": Lattice,
    "neighbours": NeighbourMetric,
    "rule": FollowerRule,
    "frame": FramePolicy,
    "fracture": FractureModel,
    "operations": ParticleOperation,
    "diagnostics": Diagnostic,
}
"""The open interfaces by the field of the experiment in which their components stand."""
LISTS = frozenset({"operations", "diagnostics"})
"""The fields that list any number of components."""

__all__ = [
    "AREA", "ENERGY", "FORCE", "FRACTURE_ENERGY", "INTERFACES", "LENGTH", "LISTS", "STRESS",
    "Anchors", "AppliesTwice", "BasisSite", "Bonds", "BreaksAtStrain", "Calibrated", "Cell",
    "CellStress", "Component", "Components", "Diagnostic", "Draws", "FollowerRule",
    "FractureModel", "FrameMap", "FramePolicy", "FrameSites", "Here", "KnowsStiffness", "Lattice",
    "LeaderRows", "LoadRows", "Loadable", "MixesCells", "Moment", "Nearness", "NeighbourMetric",
    "Offset", "Pair", "ParticleOperation", "Particles", "Quantity", "Remembered", "Remembers",
    "RenewsBonds", "RenewsParticles", "Setting", "SharesParticles", "Slot", "Softens",
    "SoftensCells", "SpaceVector", "StartsCracked", "Stiffness", "StoresEnergy", "TearsCells",
    "Torn", "TouchingRows", "TurnsParticles", "Variable", "Vector", "dot", "length",
    "squared_length", "where",
]  # fmt: skip


BUILTIN = GROUP = "pbdkit"
"""The distribution of the built-in components, and the entry-point group of plugins, which is the
project name of their hook markers too."""
