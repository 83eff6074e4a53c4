"""pbdkit: position-based dynamics of deformable bodies on lattices, rules instead of forces.

The names below are loaded when first used, so that importing pbdkit costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pbdkit.api import analyse, identify, load, rerun, run
    from pbdkit.errors import (
        DivergedError,
        ExperimentError,
        PbdkitError,
        PbdkitWarning,
        PluginError,
        StorageError,
    )
    from pbdkit.experiment.model import Experiment
    from pbdkit.interfaces import (
        BasisSite,
        Bonds,
        Cell,
        Component,
        Diagnostic,
        FollowerRule,
        FractureModel,
        FrameMap,
        FramePolicy,
        FrameSites,
        Here,
        Lattice,
        LeaderRows,
        Moment,
        Nearness,
        NeighbourMetric,
        Offset,
        Pair,
        Particles,
        Remembered,
        Setting,
        Slot,
        Stiffness,
        Variable,
        Vector,
        length,
        squared_length,
        where,
    )
    from pbdkit.registry.hooks import hookimpl
    from pbdkit.results.accessor import open

_HOME = {
    "pbdkit.errors": (
        "DivergedError", "ExperimentError", "PbdkitError", "PbdkitWarning", "PluginError",
        "StorageError",
    ),
    "pbdkit.experiment.model": ("Experiment",),
    "pbdkit.interfaces": (
        "BasisSite", "Bonds", "Cell", "Component", "Diagnostic", "FollowerRule", "FractureModel",
        "FrameMap", "FramePolicy", "FrameSites", "Here", "Lattice", "LeaderRows", "Moment",
        "Nearness", "NeighbourMetric", "Offset", "Pair", "Particles", "Remembered", "Setting",
        "Slot", "Stiffness", "Variable", "Vector", "length", "squared_length", "where",
    ),
    "pbdkit.registry.hooks": ("hookimpl",),
    "pbdkit.results.accessor": ("open",),
    "pbdkit.api": ("analyse", "identify", "load", "rerun", "run"),
}  # fmt: skip
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("pbdkit")
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'pbdkit' has no attribute '{name}'")
    return getattr(import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return sorted([*_MODULE_OF, "__version__"])


__all__ = sorted(_MODULE_OF)
