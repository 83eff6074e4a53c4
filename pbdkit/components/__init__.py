"""The components that come with pbdkit, offered through the same door as anybody's."""

from __future__ import annotations

from pbdkit.interfaces import Component
from pbdkit.registry.hooks import hookimpl


@hookimpl
def pbdkit_components() -> list[type[Component]]:
    """The built-in components of the six interfaces."""
    from pbdkit.components import (
        diagnostics,
        elasticity,
        fracture,
        frames,
        free_edges,
        lattices,
        neighbours,
        rules,
        springs,
    )

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
        elasticity.Elastic,
        elasticity.Orthotropic,
        springs.Springs,
        frames.MeanFrame,
        frames.FirstFrame,
        frames.MirrorFrame,
        frames.NoFrame,
        free_edges.Natural,
        fracture.NoFracture,
        fracture.Threshold,
        diagnostics.PE1,
        diagnostics.PE1Intact,
        diagnostics.PE2,
        diagnostics.Displacement,
        diagnostics.Track,
        diagnostics.Broken,
    ]
