"""The physical identity of a rule on its lattice and neighbours.

It consists of a verdict, notes and a table of constants.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import numpy as np

from pbdkit.identification.elastic_constants import DIFFUSION, ELASTICITY, NEITHER, SAME, Elasticity
from pbdkit.identification.waves import DirectionalRange, LongWaves, Primitive, WaveSpectrum
from pbdkit.linear.spectrum import NEUTRAL
from pbdkit.scene.scene import Scene


@dataclass(frozen=True)
class Identity:
    """Physical identity of a rule on its lattice and neighbourhood.

    The rule is linearised at rest, which is exact for linear rules.

    Parameters
    ----------
    name, lattice, neighbours, rule : str
        Name of the experiment, and types of its components.
    reasons : tuple of str
        Reasons why the rule is neither diffusion nor elasticity.
    spacing : float
        Smallest distance of two sites in lattice units, the unit of length.
    linear : bool
        Whether the move is linear in finite displacements.
    turns : bool
        Whether a finite rotation of the neighbours rotates the move.
    symmetric : bool
        Whether particle j has the same weight in the move of k as k has in the move of j.
    rests_at_edges : bool
        Whether a particle at rest does not move if neighbours are missing.
    stencil : Primitive
        Derivatives of the move.
    spectrum : WaveSpectrum
        Eigenvalues over all plane waves.
    relaxation, memory : float
        Relaxation and momentum of the solver.
    kind : str
        diffusion, elasticity or neither.
    long : LongWaves or None
        Response to long waves; None if there are no slow waves.
    notes : tuple of str
        Further properties, a sentence each.
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
    stencil: Primitive = field(repr=False)
    spectrum: WaveSpectrum = field(repr=False)
    relaxation: float
    memory: float
    kind: str
    long: LongWaves | None = field(repr=False)
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        """A summary with the verdict on the rule, its constants, and notes."""
        title = f"{self.name}: {self.rule}, {self.lattice} lattice, {self.neighbours}"
        rows = [*rows_of(self), *(("note", note) for note in self.notes)]
        width = max(len(name) for name, _ in rows)
        return "\n".join([title, *(f"  {name:<{width}}  {text}" for name, text in rows)])

    def _repr_html_(self) -> str:
        """Return the identity with its constants for notebooks."""
        return str(import_module("pbdkit.plotting.notebook").identity_html(self))

    @property
    def symmetry(self) -> str | None:
        """Symmetry: isotropic, anisotropic (diffusion), square, orthotropic, or general.

        It is None if the rule is neither diffusion nor elasticity.
        """
        if self.long is None or self.kind == NEITHER:
            return None
        if self.kind == DIFFUSION:
            return "isotropic" if self.isotropic else "anisotropic"
        return self.body.symmetry if self.body else None

    @property
    def isotropic(self) -> bool:
        """True if the diffusivities of long waves are equal in every direction."""
        return self.long is not None and all(
            r.largest - r.smallest <= SAME * abs(self.long.fast.largest)
            for r in (self.long.fast, self.long.slow)
        )

    @property
    def body(self) -> Elasticity | None:
        """Elastic body that is equivalent to the rule.

        Away from free edges isotropic diffusion is also equivalent to an elastic body.
        """
        is_elastic = self.kind == ELASTICITY or (self.kind == DIFFUSION and self.isotropic)
        return self.long.elasticity if self.long and is_elastic else None

    @property
    def diffusivity(self) -> float | None:
        """Diffusivity D of isotropic diffusion, in spacing² per step."""
        is_diffusion = self.kind == DIFFUSION and self.isotropic and self.long
        return self.long.fast.largest if self.long and is_diffusion else None

    @property
    def poisson_ratio(self) -> float | None:
        """Poisson's ratio in plane stress of an isotropic body."""
        isotropic = self.body is not None and self.body.symmetry == "isotropic"
        return self.body.poisson_ratio(0.0) if self.body and isotropic else None

    def as_dict(self) -> dict[str, Any]:
        """Return the values of ``pbdkit identify --json``, in units of the spacing and of a step.

        Returns
        -------
        dict
            Values by name.
        """
        names = (
            *("name", "lattice", "neighbours", "rule", "kind", "spacing", "linear", "symmetric"),
            *("rests_at_edges", "symmetry", "reasons", "notes", "diffusivity", "poisson_ratio"),
        )
        values = {name: getattr(self, name) for name in names} | {
            "turns_with_the_body": self.turns,
            "sites": self.stencil.sites,
            "elasticity": self.body.as_dict() if self.body else None,
            "long_waves": self.long.as_dict() if self.long else None,
            "spectrum": vars(self.spectrum),
        }
        plain: dict[str, Any] = json.loads(json.dumps(values, default=np.ndarray.tolist))
        return plain


SYMMETRIES = {
    "isotropic": "isotropic {}",
    "anisotropic": "anisotropic {}",
    "square": "{} with the symmetry of a square",
    "orthotropic": "orthotropic {}",
    "general": "{} without an axis of symmetry",
}
"""Description by symmetry; {} is the kind."""
Row = tuple[str, str]
TITLE_WIDTH = 19
"""Width of the titles in characters."""


def verdict(identity: Identity) -> str:
    """Return the identity in a few words."""
    if identity.kind == NEITHER:
        return "neither diffusion nor elasticity"
    return SYMMETRIES[identity.symmetry or "general"].format(identity.kind)


def rows_of(identity: Identity, *, whole: bool = False) -> list[Row]:
    """Return titles and values, the verdict first."""
    first = [*_what(identity), ("relaxation", _relaxation_text(identity))]
    return [*first, *_waves(identity), *_character(identity)] if whole else first


def _what(identity: Identity) -> Iterator[Row]:
    yield "identity", verdict(identity)
    for n, reason in enumerate(identity.reasons):
        yield "because" if n == 0 else "and", reason
    yield (
        "spacing h",
        f"{_number(identity.spacing)} lattice unit{'s' if identity.spacing != 1 else ''}",
    )
    if identity.diffusivity is not None:
        yield "diffusivity D", f"{_number(identity.diffusivity)} h²/step"
    if identity.kind != DIFFUSION and identity.body is not None:
        yield from _elastic(identity, identity.body)


def _elastic(identity: Identity, body: Elasticity) -> Iterator[Row]:
    (_, c12, c16), (_, c22, c26), (*_, c66) = body.stiffness / body.stiffness[0, 0]
    ratios = {"C22": c22, "C12": c12, "C66": c66}
    ratios |= {name: c for name, c in (("C16", c16), ("C26", c26)) if abs(c) > SAME}
    text = ", ".join(f"{name} {_number(c)}" for name, c in ratios.items())
    yield "elastic constants", f"{text} in units of C11 = {_number(body.stiffness[0, 0])} h²/step"
    if (ratio := identity.poisson_ratio) is not None:
        strain = f", {_number(ratio / (1 + ratio))} in plane strain" if ratio > -0.999 else ""
        yield "Poisson's ratio", f"{_number(ratio)} in plane stress{strain}"
        return
    along = [body.poisson_ratio(angle) for angle in (0.0, 90.0)]
    *texts, zener = ["none" if r is None else _number(r) for r in (*along, body.zener)]
    yield "Poisson's ratio", f"{texts[0]} under tension along x, {texts[1]} along y (plane stress)"
    yield "anisotropy", f"4 C66 / (C11 + C22 - 2 C12) = {zener}, isotropic 1"
    if body.axis is not None:
        yield "axis of symmetry", f"at {_number(body.axis)}°"


def _waves(identity: Identity) -> Iterator[Row]:
    if identity.long is None:
        return
    if identity.kind != DIFFUSION:
        yield "fast long waves", _range_text(identity.long.fast, "h²/step diffusivity")
        yield "slow long waves", _range_text(identity.long.slow, "h²/step diffusivity")
    elif not identity.isotropic:
        yield "diffusivity D", _range_text(identity.long.fast, "h²/step")
    for gradient in identity.long.gradients:
        fast, slow = (_number(length) for length in gradient.material)
        is_isotropic = abs(gradient.material[0] - gradient.material[1]) < 1e-9
        direction = f"along {_number(gradient.direction)}°"
        rows = f"across rows {_number(gradient.rows_apart)} h apart"
        yield (
            "gradient length²",
            f"{fast if is_isotropic else f'{fast} and {slow}'} h² {direction}, {rows}",
        )


def _range_text(waves: DirectionalRange, unit: str) -> str:
    largest = f"{_number(waves.largest)} {unit}"
    if waves.largest - waves.smallest < 1e-8 * abs(waves.largest):
        return f"{largest} in every direction"
    smallest = f"{_number(waves.smallest)} along {_number(waves.at_smallest)}°"
    return f"{largest} along {_number(waves.at_largest)}°, {smallest}"


def _character(identity: Identity) -> Iterator[Row]:
    spectrum, yes = identity.spectrum, {True: "yes", False: "no"}
    turning = f", imaginary parts up to {_number(spectrum.imaginary)}"
    ends = f"{_number(spectrum.smallest)} to {_number(spectrum.largest)}"
    yield "eigenvalues", ends + turning * (spectrum.imaginary > NEUTRAL)
    yield "linear", yes[identity.linear]
    yield (
        "symmetric",
        ("yes, the weight of k for j is that of j for k") if identity.symmetric else "no",
    )
    yield "rotation invariant", yes[identity.turns]
    yield "rest at free edges", yes[identity.rests_at_edges]


def _relaxation_text(identity: Identity) -> str:
    with_memory = f" with memory {identity.memory:g}" if identity.memory else ""
    bound = identity.spectrum.largest_stable_relaxation
    if bound is not None:
        return f"stable below {_number(bound)}{with_memory}"
    grows = identity.spectrum.largest > 1.0 + NEUTRAL or abs(identity.memory) >= 1.0
    return f"always diverges{with_memory}" if grows else "no bound"


def _number(value: float) -> str:
    """Format with six digits; rounding errors, in units of the spacing, are 0."""
    return f"{round(value, 11) + 0.0:.6g}"


def notes_on(identity: Identity, scene: Scene) -> Iterator[str]:
    """Yield further properties of the rule, a sentence each."""
    if not identity.linear:
        yield "the rule is not linear: the values hold for small displacements from rest"
    if scene.experiment.rule.uses_reference:
        yield "the rule depends on the position: the values hold in the middle of the body"
    if scene.experiment.neighbours.nearness():
        yield "neighbours are re-evaluated: the values hold while they are those at rest"
    if identity.stencil.sites > 1:
        yield f"{identity.stencil.sites} sites per cell: their relative shifts are eliminated"
    if identity.long is not None:
        yield from _notes_of_long_waves(identity, identity.long)
    bound = identity.spectrum.largest_stable_relaxation
    if bound is None and identity.spectrum.largest > 1 + NEUTRAL:
        yield "some waves grow at any relaxation"
    elif bound is not None and identity.relaxation > bound * (1 + NEUTRAL):
        yield f"relaxation {identity.relaxation:g} diverges; it is stable below {bound:.6g}"


def _notes_of_long_waves(identity: Identity, long: LongWaves) -> Iterator[str]:
    if abs(long.slow.smallest) <= SAME * abs(long.fast.largest):
        yield f"some long waves along {long.slow.at_smallest:.4g}° do not decay at all"
    if identity.kind == DIFFUSION and identity.body:
        yield "away from free edges the rule is plane-stress elasticity with Poisson's ratio -1"
    if identity.kind == ELASTICITY and long.elasticity:
        yield from _notes_of_body(long.elasticity)
        if not identity.rests_at_edges:
            yield (
                "away from free edges the rule is elastic; at free edges it exerts an inward force"
            )
    lengths = [length for gradient in long.gradients for length in gradient.material]
    attracting = [f"{g.direction:.4g}°" for g in long.gradients if min(g.material) < -SAME]
    if attracting:
        yield (
            f"rows beyond the nearest attract along {', '.join(attracting)}, which is not the "
            "sign of gradient elasticity; the effect vanishes with the spacing"
        )
    elif min(lengths, default=0.0) > SAME:
        low, high = np.sqrt(min(lengths)), np.sqrt(max(lengths))
        span = f"{low:.6g}" if high - low < SAME else f"{low:.6g} to {high:.6g}"
        yield f"the rule is gradient elasticity with a length of {span} h"


def _notes_of_body(body: Elasticity) -> Iterator[str]:
    if body.least_stiffness < -SAME:
        yield "some uniform strain lowers the energy: the body is stable only with prescribed edges"
    elif body.least_stiffness < SAME:
        yield "the energy of some uniform strain is zero"
    if np.abs(body.mobility - np.eye(2)).max() > SAME:
        yield "x and y converge to equilibrium at different rates; the equilibrium is elastic"
