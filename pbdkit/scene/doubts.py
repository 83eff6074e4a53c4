"""What a user is warned of where a scene can be built and may not be what was meant."""

from __future__ import annotations

from pbdkit.experiment.model import Experiment
from pbdkit.interfaces.rule import material_of
from pbdkit.scene.neighbourhood import Neighbourhood, flatness
from pbdkit.scene.places import Mask
from pbdkit.scene.sites import has_narrow_slot

FLAT = 0.05
"""Cells flatter than this are warned of."""


def doubts_of(
    experiment: Experiment, neighbourhood: Neighbourhood, body: Mask, layers: int
) -> list[str]:
    """A line each, on the lattice, who is whose neighbour, and the frame of a body."""
    doubts, frame, rule = [], experiment.frame, experiment.rule
    if (flat := flatness(neighbourhood.cell)) < FLAT:
        doubts.append(
            f"lattice: nearly degenerate, sites lie {1 / flat:.3g} times closer along one line "
            "than its longer cell vector is long, so that neighbours by distance lie along that "
            "line; take chebyshev neighbours, or open the angle between the vectors"
        )
    if not neighbourhood.spans_space():
        doubts.append(
            "neighbours: they lie along one line only, so that rows do not feel each other; "
            "more shells, or chebyshev neighbours, connect them"
        )
    if layers and has_narrow_slot(body, layers):
        doubts.append(
            f"body: a slot is narrower than {2 * layers + 1} sites, so that frame points in it "
            "belong to both faces; widen it, or take fewer layers"
        )
    if not frame.edges_are_free and material_of(rule) is not None:
        doubts.append(
            f"frame: under '{frame.type}' edges are not free of stress, and with the calibrated "
            f"rule '{rule.type}' the result does not converge to elasticity, however fine the "
            "lattice (copying frames err by 6.7 % on a bar in tension, 14.5 % on a cantilever); "
            "take {type: natural} or {type: traction-free}"
        )
    return doubts
