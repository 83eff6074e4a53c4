"""Everything that the author of a component needs.

These are the interfaces, the optional capabilities, the classes of the data that components receive
and return, and the marker of the hook by which a distribution registers its components.

Examples
--------
>>> from typing import Literal
>>> from pbdkit.plugin import FollowerRule, Vector
>>> class Mean(FollowerRule):
...     type: Literal["mean"] = "mean"
...
...     @staticmethod
...     def gather(d: Vector, r: Vector, w, p):
...         return d, 1.0
...
...     @staticmethod
...     def apply(total, here, p):
...         return total[0] / total[1]
"""

from __future__ import annotations

from pbdkit.hooks import GROUP, Command, hookimpl
from pbdkit.plugin.component import (
    Bonds,
    Component,
    Drawn,
    Draws,
    Pair,
    Particles,
    Remembered,
    Remembers,
)
from pbdkit.plugin.diagnostic import (
    BondHistory,
    CellTable,
    CellValues,
    CrackEnd,
    Diagnostic,
    ForceValues,
    LeaderRows,
    LoadRows,
    Moment,
    TouchingRows,
    Variable,
)
from pbdkit.plugin.fracture_model import (
    BreaksAtStrain,
    CellStress,
    FractureModel,
    RenewsBonds,
    Segment,
    Softens,
    SoftensCells,
    SpacingLimits,
    StartsCracked,
    UsesStiffness,
)
from pbdkit.plugin.frame_policy import Anchors, FrameMap, FramePolicy, FrameSites
from pbdkit.plugin.lattice import (
    BasisSite,
    Cell,
    CellPolygon,
    Lattice,
    Nearness,
    NeighbourMetric,
    Offset,
    Slot,
    Tiling,
)
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
    UsesAngles,
)
from pbdkit.plugin.table import Axes, Table, interpolate
from pbdkit.plugin.units import AREA, ENERGY, FORCE, FRACTURE_ENERGY, LENGTH, STRESS, Quantity
from pbdkit.plugin.vector import (
    Condition,
    Constants,
    Number,
    Numbers,
    Parameters,
    SpaceVector,
    Vector,
    Weights,
    dot,
    length,
    squared_length,
    where,
)

INTERFACES: dict[str, type[Component]] = {
    "lattice": Lattice,
    "neighbours": NeighbourMetric,
    "rule": FollowerRule,
    "frame": FramePolicy,
    "fracture": FractureModel,
    "operations": ParticleOperation,
    "diagnostics": Diagnostic,
}
"""Interfaces that plugins can implement, by the field of the experiment that selects a
component."""
LISTS = frozenset({"operations", "diagnostics"})
"""The fields that contain a list of components instead of one component."""

BUILTIN = GROUP
"""The distribution of the built-in components."""

__all__ = [
    "AREA", "ENERGY", "FORCE", "FRACTURE_ENERGY", "LENGTH", "STRESS", "Anchors", "AppliesTwice",
    "Axes", "BasisSite", "BondHistory", "Bonds", "BreaksAtStrain", "Calibrated", "Cell",
    "CellPolygon", "CellStress", "CellTable", "CellValues", "Command", "Component", "Condition",
    "Constants", "CrackEnd",
    "Diagnostic", "Drawn", "Draws", "FollowerRule", "ForceValues", "FractureModel", "FrameMap",
    "FramePolicy", "FrameSites", "Here", "Lattice", "LeaderRows", "LoadRows", "Loadable",
    "MixesCells", "Moment", "Nearness", "NeighbourMetric", "Number", "Numbers", "Offset", "Pair",
    "Parameters", "ParticleOperation", "Particles", "Quantity", "Remembered", "Remembers",
    "RenewsBonds", "RenewsParticles", "Segment", "Setting", "SharesParticles", "Slot", "Softens",
    "SoftensCells", "SpaceVector", "SpacingLimits", "StartsCracked", "Stiffness", "StoresEnergy",
    "Table", "TearsCells", "Tiling", "Torn", "TouchingRows", "TurnsParticles", "UsesAngles",
    "UsesStiffness", "Variable", "Vector", "Weights", "dot", "hookimpl", "interpolate", "length",
    "squared_length", "where",
]  # fmt: skip
