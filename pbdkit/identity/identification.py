"""Finds what a rule is physically, on its lattice and neighbours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pbdkit.analysis.stencil import Stencil
from pbdkit.errors import ExperimentError
from pbdkit.identity.dispersion import LongWaves, gradients, ranges, spectrum
from pbdkit.identity.elastic_constants import (
    DIFFUSION,
    ELASTICITY,
    NEITHER,
    SAME,
    Floats,
    diffusion,
    elasticity,
    second_order,
)
from pbdkit.identity.identity import Identity
from pbdkit.identity.probe import Probed, probed
from pbdkit.identity.verdict import notes_on
from pbdkit.identity.waves import (
    NoSlowWavesError,
    primitive,
    slow_waves,
    spacing_of,
)
from pbdkit.registry.blame import blaming
from pbdkit.scene.scene import Scene


def identified(scene: Scene) -> Identity:
    """The identity of the scene's rule on its lattice and neighbours.

    PluginError where the rule's own code fails, ExperimentError where it answers without numbers.
    """
    experiment = scene.experiment
    spacing = spacing_of(experiment.lattice.cell())
    with blaming(experiment.rule, "when asked for its answer to small displacements", "rule"):
        answers = probed(scene, spacing)
    _refuse_no_numbers(answers.stencil, experiment.rule.type)
    cell = primitive(experiment.lattice.cell(), answers.stencil)
    around = len(scene.neighbourhood.slots[0])
    found = Identity(
        name=experiment.name,
        lattice=experiment.lattice.type,
        neighbours=f"{around} neighbours ({experiment.neighbours.type})",
        rule=experiment.rule.type,
        reasons=tuple(_reasons(answers, spacing)),
        spacing=spacing,
        linear=answers.linear,
        turns=answers.turns,
        symmetric=answers.symmetric,
        rests_at_edges=answers.rests_at_edges,
        stencil=cell,
        spectrum=spectrum(cell, experiment.stepping.memory),
        relaxation=experiment.stepping.relaxation,
        memory=experiment.stepping.memory,
    )
    found = _with_long_waves(found)
    return replace(found, notes=notes_on(found, scene))


def _refuse_no_numbers(stencil: Stencil, rule: str) -> None:
    if not np.isfinite([*stencil.own, *stencil.neighbours.values()]).all():
        raise ExperimentError(
            f"'{rule}' answers small displacements of a body at rest with numbers that are not "
            "finite: look at what it divides by",
            ("rule",),
        )


def _reasons(answers: Probed, spacing: float) -> list[str]:
    """Why the rule is no diffusion and no elasticity, apart from what long waves see."""
    reasons = []
    if not answers.move_at_rest <= SAME * spacing:
        moved = answers.move_at_rest / spacing
        reasons.append(f"a body at rest does not stay: the rule moves it by {moved:.6g} h a step")
    if not answers.smooth:
        reasons.append(
            "small displacements do not add up, however small: the rule is not differentiable at "
            "rest, and no plane wave answers for another"
        )
    if answers.place_dependence:
        reasons.append(answers.place_dependence)
    return reasons


def _with_long_waves(found: Identity) -> Identity:
    """The same with what long waves see, its kind, and all reasons."""
    try:
        waves = slow_waves(found.stencil)
    except NoSlowWavesError as error:
        return replace(found, reasons=(*found.reasons, str(error)))
    along = [waves.series(np.array(k), 2) for k in ((1.0, 0.0), (0.0, 1.0), (1.0, 1.0))]
    second = second_order(*(np.array(series[2].real, float) for series in along))
    reasons = [*found.reasons, *_drift(np.array([series[1].imag for series in along[:2]], float))]
    if np.abs(second).max() <= SAME * np.abs(found.stencil.matrix).max():
        reasons.append("nothing of second order is left: long waves do not decay as diffusion does")
        return replace(found, reasons=tuple(reasons))
    fast, slow = ranges(second)
    if slow.smallest < -SAME * abs(fast.largest):
        reasons.append(
            f"long waves along {slow.at_smallest:.4g}° grow instead of decaying: their diffusivity "
            f"is {slow.smallest:.6g}"
        )
    diffusivity, body = diffusion(second), elasticity(second)
    if isinstance(body, str) and diffusivity is None:
        reasons.append(body)
    kind = NEITHER if reasons else ELASTICITY if diffusivity is None else DIFFUSION
    lengths = () if slow.smallest <= SAME * abs(fast.largest) else gradients(waves)
    solid = None if isinstance(body, str) else body
    long = LongWaves(waves, second, diffusivity, solid, fast, slow, lengths)
    return replace(found, kind=kind, reasons=tuple(reasons), long=long)


def _drift(first: Floats) -> list[str]:
    """Of the first-order terms i A_1 k, along x and y: a step takes u(x) to u(x - A_1)."""
    if np.abs(first).max() < SAME:
        return []
    velocity = first.trace(axis1=1, axis2=2) / 2
    return [
        "neighbours opposite to each other do not weigh the same: a displacement is carried along, "
        f"on average by ({velocity[0]:.6g}, {velocity[1]:.6g}) h a step"
    ]
