"""What the author of a component reads: the six interfaces and the data they exchange."""

from pbdkit.interfaces.component import Component, Pair
from pbdkit.interfaces.diagnostic import (
    Diagnostic,
    LeaderRows,
    LoadRows,
    Moment,
    TouchingRows,
    Variable,
)
from pbdkit.interfaces.fracture_model import (
    BreaksAtStrain,
    CellStress,
    FractureModel,
    KnowsStiffness,
    RenewsBonds,
    Softens,
    SoftensCells,
    StartsCracked,
)
from pbdkit.interfaces.frame import Anchors, FrameMap, FramePolicy, FrameSites
from pbdkit.interfaces.lattice import BasisSite, Cell, Lattice, Offset
from pbdkit.interfaces.neighbour_metric import Nearness, NeighbourMetric, Slot
from pbdkit.interfaces.rule import (
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
from pbdkit.interfaces.units import (
    AREA,
    ENERGY,
    FORCE,
    FRACTURE_ENERGY,
    LENGTH,
    STRESS,
    Quantity,
)
from pbdkit.interfaces.values import Bonds, Draws, Particles, Remembered, Remembers
from pbdkit.interfaces.vector import (
    Components,
    SpaceVector,
    Vector,
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
    "diagnostics": Diagnostic,
}
"""The open interfaces by the field of the experiment in which their components stand."""

__all__ = [
    "AREA", "ENERGY", "FORCE", "FRACTURE_ENERGY", "INTERFACES", "LENGTH", "STRESS", "Anchors",
    "AppliesTwice", "BasisSite", "Bonds", "BreaksAtStrain", "Calibrated", "Cell", "CellStress",
    "Component", "Components", "Diagnostic", "Draws", "FollowerRule", "FractureModel", "FrameMap",
    "FramePolicy", "FrameSites", "Here", "KnowsStiffness", "Lattice", "LeaderRows", "LoadRows",
    "Loadable", "MixesCells", "Moment", "Nearness", "NeighbourMetric", "Offset", "Pair",
    "Particles", "Quantity", "Remembered", "Remembers", "RenewsBonds", "RenewsParticles",
    "Setting", "SharesParticles", "Slot", "Softens", "SoftensCells", "SpaceVector",
    "StartsCracked", "Stiffness", "StoresEnergy", "TearsCells", "Torn", "TouchingRows",
    "TurnsParticles", "Variable", "Vector", "dot", "length", "squared_length", "where",
]  # fmt: skip
