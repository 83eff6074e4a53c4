"""What else there is to know of an identified rule, in words."""

from __future__ import annotations

import numpy as np

from pbdkit.analysis.region import NEUTRAL
from pbdkit.identity.elasticity import SAME, Elasticity
from pbdkit.identity.identity import DIFFUSION, ELASTICITY, Identity, LongWaves
from pbdkit.scene.scene import Scene


def notes_on(found: Identity, scene: Scene) -> tuple[str, ...]:
    """A line each."""
    notes = []
    if not found.linear:
        notes.append("the rule is not linear: this is what it is for small displacements from rest")
    if scene.experiment.rule.uses_reference:
        notes.append("it asks for the place: the figures are those in the middle of the body")
    if scene.experiment.neighbours.nearness():
        notes.append("neighbours are found anew: the figures hold while they are those at rest")
    if found.stencil.sites > 1:
        notes.append(f"{found.stencil.sites} sites a cell: shifts of them are eliminated")
    if found.long is not None:
        notes += _notes_of_long_waves(found, found.long)
    bound = found.spectrum.largest_stable_relaxation
    if bound is None and found.spectrum.largest > 1 + NEUTRAL:
        notes.append("some waves grow at any relaxation")
    elif bound is not None and found.relaxation > bound * (1 + NEUTRAL):
        notes.append(f"relaxation {found.relaxation:g} diverges; it is stable below {bound:.6g}")
    return tuple(notes)


def _notes_of_long_waves(found: Identity, long: LongWaves) -> list[str]:
    notes = []
    if abs(long.slow.smallest) <= SAME * abs(long.fast.largest):
        notes.append(f"some long waves along {long.slow.at_smallest:.4g}° do not decay at all")
    if found.kind == DIFFUSION and found.body:
        notes.append("away from free edges it is plane-stress elasticity with Poisson's ratio -1")
    if found.kind == ELASTICITY and long.elasticity:
        notes += _notes_of_body(long.elasticity)
        if not found.rests_at_edges:
            notes.append("away from free edges it is elastic; at them it pulls inwards")
    return [*notes, *_notes_of_gradients(long)]


def _notes_of_gradients(long: LongWaves) -> list[str]:
    attracting = [f"{g.direction:.4g}°" for g in long.gradients if min(g.material) < -SAME]
    if attracting:
        return [
            f"rows beyond the next attract along {', '.join(attracting)}: the wrong sign for "
            "gradient elasticity, and an effect that vanishes with the spacing"
        ]
    squares = [l2 for gradient in long.gradients for l2 in gradient.material]
    if not squares or min(squares) <= SAME:
        return []
    low, high = float(np.sqrt(min(squares))), float(np.sqrt(max(squares)))
    span = f"{low:.6g}" if high - low < SAME else f"{low:.6g} to {high:.6g}"
    return [f"it is gradient elasticity, with a length of {span} h"]


def _notes_of_body(body: Elasticity) -> list[str]:
    notes = []
    if body.least_stiffness < -SAME:
        notes.append("some uniform strain lowers the energy: only held edges keep it in shape")
    elif body.least_stiffness < SAME:
        notes.append("some uniform strain costs no energy")
    if np.abs(body.mobility - np.eye(2)).max() > SAME:
        notes.append("x and y go to equilibrium at different rates; the equilibrium is elastic")
    return notes
