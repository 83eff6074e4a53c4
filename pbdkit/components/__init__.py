"""Built-in components: lattices, neighbour metrics, rules, frame policies, fracture models and
diagnostics.

They implement the interfaces of `pbdkit.plugin` and are registered through the same hook as those
of plugins.
"""

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
    "gauges": "Extensometer StrainGauge",
    "stress_intensity": "StressIntensity",
}
"""Names of the component classes, by the module of this package that defines them."""


@hookimpl
def pbdkit_components() -> list[type[Component]]:
    """Return the built-in component classes of the seven interfaces."""
    return [
        getattr(import_module(f"{__name__}.{module}"), name)
        for module, names in COMPONENTS.items()
        for name in names.split()
    ]
