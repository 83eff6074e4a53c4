"""How a rule is identified: from its answer to small displacements to what long waves see."""

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
from pbdkit.identity.probe import probed
from pbdkit.identity.verdict import notes_on
from pbdkit.identity.waves import Primitive, primitive, slow_waves, spacing_of
from pbdkit.registry.blame import blaming
from pbdkit.scene.scene import Scene


def identified(scene: Scene) -> Identity:
    """The identity of the scene's rule on its lattice and neighbours.

    PluginError where the rule's own code fails, ExperimentError where it answers without numbers.
    """
    experiment, cell = scene.experiment, scene.experiment.lattice.cell()
    spacing = spacing_of(cell)
    with blaming(experiment.rule, "when asked for its answer to small displacements", "rule"):
        answers = probed(scene, spacing)
    _refuse_no_numbers(answers.stencil, experiment.rule.type)
    stencil, around = primitive(cell, answers.stencil), len(scene.neighbourhood.slots[0])
    long, against = _long_waves(stencil)
    reasons = (*answers.reasons, *against)
    kind = ELASTICITY if long is not None and long.diffusivity is None else DIFFUSION
    found = Identity(
        name=experiment.name,
        lattice=experiment.lattice.type,
        neighbours=f"{around} neighbours ({experiment.neighbours.type})",
        rule=experiment.rule.type,
        reasons=reasons,
        spacing=spacing,
        linear=answers.linear,
        turns=answers.turns,
        symmetric=answers.symmetric,
        rests_at_edges=answers.rests_at_edges,
        stencil=stencil,
        spectrum=spectrum(stencil, experiment.stepping.memory),
        relaxation=experiment.stepping.relaxation,
        memory=experiment.stepping.memory,
        kind=NEITHER if reasons else kind,
        long=long,
    )
    return replace(found, notes=tuple(notes_on(found, scene)))


def _refuse_no_numbers(stencil: Stencil, rule: str) -> None:
    if not np.isfinite([*stencil.own, *stencil.neighbours.values()]).all():
        raise ExperimentError(
            f"'{rule}' answers small displacements of a body at rest with numbers that are not "
            "finite: look at what it divides by",
            ("rule",),
        )


def _long_waves(stencil: Primitive) -> tuple[LongWaves | None, list[str]]:
    """What long waves see, and why that is no diffusion and no elasticity."""
    waves = slow_waves(stencil)
    if isinstance(waves, str):
        return None, [waves]
    along = [waves.series(np.array(k), 2) for k in ((1.0, 0.0), (0.0, 1.0), (1.0, 1.0))]
    second = second_order(*(np.array(series[2].real, float) for series in along))
    reasons = [*_drift(np.array([series[1].imag for series in along[:2]], float))]
    if np.abs(second).max() <= SAME * np.abs(stencil.matrix).max():
        reasons.append("nothing of second order is left: long waves do not decay as diffusion does")
        return None, reasons
    fast, slow = ranges(second)
    if slow.smallest < -SAME * abs(fast.largest):
        reasons.append(
            f"long waves along {slow.at_smallest:.4g}° grow instead of decaying: their diffusivity "
            f"is {slow.smallest:.6g}"
        )
    diffusivity, body = diffusion(second), elasticity(second)
    if isinstance(body, str) and diffusivity is None:
        reasons.append(body)
    lengths = () if slow.smallest <= SAME * abs(fast.largest) else gradients(waves)
    solid = None if isinstance(body, str) else body
    return LongWaves(second, diffusivity, solid, fast, slow, lengths), reasons


def _drift(first: Floats) -> list[str]:
    """Of the first-order terms i A_1 k, along x and y: a step takes u(x) to u(x - A_1)."""
    if np.abs(first).max() < SAME:
        return []
    velocity = first.trace(axis1=1, axis2=2) / 2
    return [
        "neighbours opposite to each other do not weigh the same: a displacement is carried along, "
        f"on average by ({velocity[0]:.6g}, {velocity[1]:.6g}) h a step"
    ]
