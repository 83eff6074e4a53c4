"""The components that come with pbdkit, offered through the same door as anybody's."""

from __future__ import annotations

from pbdkit.interfaces import Component
from pbdkit.registry.hooks import hookimpl

Offered = list[type[Component]]


@hookimpl
def pbdkit_components() -> list[type[Component]]:
    """The built-in components of the six interfaces."""
    return [*_lattices_and_neighbours(), *_rules_and_frames(), *_fracture_and_diagnostics()]


def _lattices_and_neighbours() -> Offered:
    from pbdkit.components import lattices, neighbours

    return [
        lattices.Square,
        lattices.Rectangular,
        lattices.CentredRectangular,
        lattices.Hexagonal,
        lattices.Oblique,
        neighbours.Coordination,
        neighbours.Chebyshev,
        neighbours.Euclidean,
    ]


def _rules_and_frames() -> Offered:
    from pbdkit.components import elasticity, frames, free_edges, rules, springs

    return [
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
    ]


def _fracture_and_diagnostics() -> Offered:
    from pbdkit.components import diagnostics, fracture, straining

    return [
        fracture.NoFracture,
        fracture.Threshold,
        straining.Strain,
        straining.Damage,
        diagnostics.PE1,
        diagnostics.PE1Intact,
        diagnostics.PE2,
        diagnostics.Displacement,
        diagnostics.Track,
        diagnostics.Broken,
        diagnostics.CrackPath,
    ]
