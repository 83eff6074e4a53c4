"""What the author of a component reads: the six interfaces and the data they exchange."""

from pbdkit.interfaces.arithmetic import Vector, length, squared_length, where
from pbdkit.interfaces.component import Component, Pair
from pbdkit.interfaces.diagnostic import Diagnostic, LeaderRows, Moment, Variable
from pbdkit.interfaces.fracture import FractureModel
from pbdkit.interfaces.frame import FrameMap, FramePolicy, FrameSites
from pbdkit.interfaces.lattice import BasisSite, Cell, Lattice, Offset
from pbdkit.interfaces.neighbours import Nearness, NeighbourMetric, Slot
from pbdkit.interfaces.remembered import Bonds, Particles, Remembered
from pbdkit.interfaces.rule import FollowerRule, Here, Setting, Stiffness

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
    "INTERFACES",
    "BasisSite",
    "Bonds",
    "Cell",
    "Component",
    "Diagnostic",
    "FollowerRule",
    "FractureModel",
    "FrameMap",
    "FramePolicy",
    "FrameSites",
    "Here",
    "Lattice",
    "LeaderRows",
    "Moment",
    "Nearness",
    "NeighbourMetric",
    "Offset",
    "Pair",
    "Particles",
    "Remembered",
    "Setting",
    "Slot",
    "Stiffness",
    "Variable",
    "Vector",
    "length",
    "squared_length",
    "where",
]
