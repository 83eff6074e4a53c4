"""pbdkit: position-based dynamics of deformable bodies on lattices, rules instead of forces.

The names below are loaded when first used, so that importing pbdkit costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module

from pbdkit.lazy_accessor import register_accessor

TYPE_CHECKING = False  # to load `typing` takes longer than all that is here
if TYPE_CHECKING:
    from typing import Any

    # `as`: type checkers of those who say `import pbdkit` then find the names.
    from pbdkit.api import (
        analyse as analyse,
        fit as fit,
        fit_strength as fit_strength,
        identify as identify,
        load as load,
        rerun as rerun,
        resume as resume,
        run as run,
        sweep as sweep,
    )
    from pbdkit.errors import (
        DivergedError as DivergedError,
        ExperimentError as ExperimentError,
        PbdkitError as PbdkitError,
        PbdkitWarning as PbdkitWarning,
        PluginError as PluginError,
        StorageError as StorageError,
    )
    from pbdkit.model.experiment import Experiment as Experiment
    from pbdkit.plugin import (
        AREA as AREA,
        ENERGY as ENERGY,
        FORCE as FORCE,
        FRACTURE_ENERGY as FRACTURE_ENERGY,
        LENGTH as LENGTH,
        STRESS as STRESS,
        Anchors as Anchors,
        AppliesTwice as AppliesTwice,
        BasisSite as BasisSite,
        Bonds as Bonds,
        BreaksAtStrain as BreaksAtStrain,
        Calibrated as Calibrated,
        Cell as Cell,
        CellStress as CellStress,
        Component as Component,
        Components as Components,
        Diagnostic as Diagnostic,
        Draws as Draws,
        FollowerRule as FollowerRule,
        FractureModel as FractureModel,
        FrameMap as FrameMap,
        FramePolicy as FramePolicy,
        FrameSites as FrameSites,
        Here as Here,
        KnowsStiffness as KnowsStiffness,
        Lattice as Lattice,
        LeaderRows as LeaderRows,
        LoadRows as LoadRows,
        Loadable as Loadable,
        MixesCells as MixesCells,
        Moment as Moment,
        Nearness as Nearness,
        NeighbourMetric as NeighbourMetric,
        Offset as Offset,
        Pair as Pair,
        ParticleOperation as ParticleOperation,
        Particles as Particles,
        Quantity as Quantity,
        Remembered as Remembered,
        Remembers as Remembers,
        RenewsBonds as RenewsBonds,
        RenewsParticles as RenewsParticles,
        Setting as Setting,
        SharesParticles as SharesParticles,
        Slot as Slot,
        Softens as Softens,
        SoftensCells as SoftensCells,
        SpaceVector as SpaceVector,
        StartsCracked as StartsCracked,
        Stiffness as Stiffness,
        StoresEnergy as StoresEnergy,
        TearsCells as TearsCells,
        Torn as Torn,
        TouchingRows as TouchingRows,
        TurnsParticles as TurnsParticles,
        Variable as Variable,
        Vector as Vector,
        dot as dot,
        length as length,
        squared_length as squared_length,
        where as where,
    )
    from pbdkit.web.report import report as report
    from pbdkit.plugin.discovery import Command as Command, hookimpl as hookimpl
    from pbdkit.io.open import open as open
    from pbdkit.web.widget import live as live
    from pbdkit.sweeps.combine import concat as concat

_HOME = {
    "pbdkit.errors": (
        "DivergedError ExperimentError PbdkitError PbdkitWarning PluginError StorageError"
    ),
    "pbdkit.model.experiment": "Experiment",
    "pbdkit.plugin": (
        "AREA ENERGY FORCE FRACTURE_ENERGY LENGTH STRESS Anchors AppliesTwice BasisSite Bonds "
        "BreaksAtStrain Calibrated Cell CellStress Component Components Diagnostic Draws "
        "FollowerRule FractureModel FrameMap FramePolicy FrameSites Here KnowsStiffness Lattice "
        "LeaderRows LoadRows Loadable MixesCells Moment Nearness NeighbourMetric Offset Pair "
        "ParticleOperation Particles Quantity Remembered Remembers RenewsBonds RenewsParticles "
        "Setting SharesParticles Slot Softens SoftensCells SpaceVector StartsCracked Stiffness "
        "StoresEnergy TearsCells Torn TouchingRows TurnsParticles Variable Vector dot length "
        "squared_length where"
    ),
    "pbdkit.web.report": "report",
    "pbdkit.plugin.discovery": "Command hookimpl",
    "pbdkit.io.open": "open",
    "pbdkit.web.widget": "live",
    "pbdkit.sweeps.combine": "concat",
    "pbdkit.api": "analyse fit fit_strength identify load rerun resume run sweep",
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names.split()}


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
register_accessor()
