"""What a rule is physically, on its lattice and neighbours, and how that is found."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pbdkit.analysis.stencil import Stencil
from pbdkit.errors import ExperimentError
from pbdkit.identity.dispersion import LongWaves, Spectrum, gradients, ranges, spectrum
from pbdkit.identity.elastic_constants import (
    DIFFUSION,
    ELASTICITY,
    NEITHER,
    SAME,
    Elasticity,
    Floats,
    diffusion,
    elasticity,
    second_order,
)
from pbdkit.identity.probe import probed
from pbdkit.identity.verdict import notes_on
from pbdkit.identity.waves import Primitive, primitive, slow_waves, spacing_of
from pbdkit.registry.blame import blaming
from pbdkit.scene.scene import Scene


@dataclass(frozen=True)
class Identity:
    """A rule on its lattice and neighbours, linearised at rest; exact for linear rules.

    `kind` is diffusion, elasticity or neither; `reasons` say why neither, `notes` what else there
    is to know. `spacing`, the unit of length, is the smallest distance of two sites (lattice
    units). `linear`: finite displacements move it as infinitesimal ones do; `turns`: a finite
    rotation of its neighbours rotates its move; `symmetric`: j weighs for k as k for j;
    `rests_at_edges`: a particle at rest stays where neighbours are missing. `long` is None where
    there are no slow waves. `spectrum` is of all waves; `relaxation` and `memory` are the
    solver's.
    """

    name: str
    lattice: str
    neighbours: str
    rule: str
    reasons: tuple[str, ...]
    spacing: float
    linear: bool
    turns: bool
    symmetric: bool
    rests_at_edges: bool
    stencil: Primitive
    spectrum: Spectrum
    relaxation: float
    memory: float
    kind: str
    long: LongWaves | None
    notes: tuple[str, ...] = ()

    @property
    def symmetry(self) -> str | None:
        """isotropic, anisotropic (diffusion), square, orthotropic, general; None for neither."""
        if self.long is None or self.kind == NEITHER:
            return None
        if self.kind == DIFFUSION:
            return "isotropic" if self.isotropic else "anisotropic"
        return self.body.symmetry if self.body else None

    @property
    def isotropic(self) -> bool:
        """Whether long waves of each kind are as fast in every direction."""
        return self.long is not None and all(
            r.largest - r.smallest <= SAME * abs(self.long.fast.largest)
            for r in (self.long.fast, self.long.slow)
        )

    @property
    def body(self) -> Elasticity | None:
        """The elastic body that it is; isotropic diffusion is one too, away from free edges."""
        is_one = self.kind == ELASTICITY or (self.kind == DIFFUSION and self.isotropic)
        return self.long.elasticity if self.long and is_one else None

    @property
    def diffusivity(self) -> float | None:
        """D of isotropic diffusion, spacing²/step."""
        known = self.kind == DIFFUSION and self.isotropic and self.long
        return self.long.fast.largest if self.long and known else None

    @property
    def poisson_ratio(self) -> float | None:
        """In plane stress, of an isotropic body."""
        isotropic = self.body is not None and self.body.symmetry == "isotropic"
        return self.body.poisson_ratio(0.0) if self.body and isotropic else None

    def as_dict(self) -> dict[str, Any]:
        """What ``pbdkit identify --json`` prints, in units of the spacing and of a step."""
        names = (
            *("name", "lattice", "neighbours", "rule", "kind", "spacing", "linear", "symmetric"),
            *("rests_at_edges", "symmetry", "reasons", "notes", "diffusivity", "poisson_ratio"),
        )
        found = {name: getattr(self, name) for name in names} | {
            "turns_with_the_body": self.turns,
            "sites": self.stencil.sites,
            "elasticity": self.body.as_dict() if self.body else None,
            "long_waves": self.long.as_dict() if self.long else None,
            "spectrum": vars(self.spectrum),
        }
        plain: dict[str, Any] = json.loads(json.dumps(found, default=np.ndarray.tolist))
        return plain


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
