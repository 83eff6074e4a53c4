"""The components that come with pbdkit, offered through the same door as anybody's."""

from __future__ import annotations

from pbdkit.interfaces import Component
from pbdkit.registry.hooks import hookimpl


@hookimpl
def pbdkit_components() -> list[type[Component]]:
    """The built-in components of the six interfaces."""
    from pbdkit.components import diagnostics, fracture, frames, lattices, neighbours, rules

    return [
        lattices.Square,
        lattices.Rectangular,
        lattices.CentredRectangular,
        lattices.Hexagonal,
        lattices.Oblique,
        neighbours.Coordination,
        neighbours.Chebyshev,
        neighbours.Euclidean,
        rules.Barycentre,
        rules.MeanDisplacement,
        rules.DistanceWeighted,
        rules.MixedCoordinate,
        frames.MeanFrame,
        frames.FirstFrame,
        frames.MirrorFrame,
        frames.NoFrame,
        fracture.NoFracture,
        fracture.Threshold,
        diagnostics.PE1,
        diagnostics.PE1Intact,
        diagnostics.PE2,
        diagnostics.Displacement,
        diagnostics.Track,
        diagnostics.Broken,
        diagnostics.SmallestCellArea,
    ]
