"""What the author of a component reads: the six interfaces and the data they exchange."""

from pbdkit.interfaces.component import Component, Pair
from pbdkit.interfaces.diagnostic import Diagnostic, LeaderRows, Moment, TouchingRows, Variable
from pbdkit.interfaces.fracture_model import (
    BreaksAtStrain,
    FractureModel,
    RenewsBonds,
    Softens,
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
    RenewsParticles,
    Setting,
    Stiffness,
    StoresEnergy,
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
    "INTERFACES", "Anchors", "AppliesTwice", "BasisSite", "Bonds", "BreaksAtStrain", "Calibrated",
    "Cell", "Component", "Components", "Diagnostic", "Draws", "FollowerRule", "FractureModel",
    "FrameMap", "FramePolicy", "FrameSites", "Here", "Lattice", "LeaderRows", "Moment", "Nearness",
    "NeighbourMetric", "Offset", "Pair", "Particles", "Remembered", "Remembers", "RenewsBonds",
    "RenewsParticles", "Setting", "Slot", "Softens", "SpaceVector", "StartsCracked", "Stiffness",
    "StoresEnergy", "TouchingRows", "Variable", "Vector", "dot", "length", "squared_length",
    "where",
]  # fmt: skip
