"""The components that come with pbdkit, offered through the same door as anybody's."""

from __future__ import annotations

from importlib import import_module

from pbdkit.plugin import Component, hookimpl

COMPONENTS = {
    "lattices": "Square Rectangular CentredRectangular Hexagonal Oblique",
    "neighbours": "Coordination Chebyshev Euclidean",
    "rules": "Barycentre MeanDisplacement DistanceWeighted MixedCoordinate Springs",
    "elasticity": "Elastic Orthotropic StrainGradient",
    "frames": "MeanFrame FirstFrame MirrorFrame NoFrame Natural",
    "fracture": "NoFracture Threshold StrainFracture Damage Cohesive",
    "diagnostics": "PE1 PE1Intact PE2 Displacement Track BrokenBonds SmallestCellArea CrackPath "
    "Strain LocalRotation Stress StrainEnergy Reaction LoadDisplacement StressStrain "
    "ContactForces",
}
"""By module of this folder the classes that it offers."""


@hookimpl
def pbdkit_components() -> list[type[Component]]:
    """The built-in components of the seven interfaces."""
    return [
        getattr(import_module(f"{__name__}.{module}"), name)
        for module, names in COMPONENTS.items()
        for name in names.split()
    ]
