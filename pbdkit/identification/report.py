"""The physical identity of a rule on its lattice and neighbours: a verdict, notes and a table."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from pbdkit.identification.elastic_constants import DIFFUSION, ELASTICITY, NEITHER, SAME, Elasticity
from pbdkit.identification.waves import DirectionalRange, LongWaves, Primitive, WaveSpectrum
from pbdkit.linear.spectrum import NEUTRAL
from pbdkit.scene.scene import Scene

if TYPE_CHECKING:
    from rich.table import Table


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
    stencil: Primitive = field(repr=False)
    spectrum: WaveSpectrum = field(repr=False)
    relaxation: float
    memory: float
    kind: str
    long: LongWaves | None = field(repr=False)
    notes: tuple[str, ...] = ()

    def _repr_html_(self) -> str:
        """What a notebook shows: what the rule is, with its constants."""
        return str(import_module("pbdkit.plotting.notebook").identity_html(self))

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


SYMMETRIES = {
    "isotropic": "isotropic {}",
    "anisotropic": "anisotropic {}",
    "square": "{} with the symmetry of a square",
    "orthotropic": "orthotropic {}",
    "general": "{} with no axis of symmetry",
}
Row = tuple[str, str]
WIDEST = 19
"""Characters of a title."""


def verdict(found: Identity) -> str:
    """What it is, in a few words."""
    if found.kind == NEITHER:
        return "neither diffusion nor elasticity"
    return SYMMETRIES[found.symmetry or "general"].format(found.kind)


def table(found: Identity, *, whole: bool = True) -> Table:
    """A row a property; h is the spacing. Without `whole` the verdict and the constants alone."""
    from rich import box
    from rich.table import Column, Table

    rows = Table(
        Column(no_wrap=True, min_width=WIDEST),
        "",
        box=box.SIMPLE,
        show_header=False,
        pad_edge=False,
    )
    for row in rows_of(found, whole=whole):
        rows.add_row(*row)
    return rows


def rows_of(found: Identity, *, whole: bool = False) -> list[Row]:
    """Titles and what they say, the verdict first."""
    first = [*_what(found), ("relaxation", _relaxation_text(found))]
    return [*first, *_waves(found), *_character(found)] if whole else first


def _what(found: Identity) -> Iterator[Row]:
    yield "it is", verdict(found)
    for n, reason in enumerate(found.reasons):
        yield "because" if n == 0 else "and", reason
    yield "spacing h", f"{_number(found.spacing)} lattice unit{'s' if found.spacing != 1 else ''}"
    if found.diffusivity is not None:
        yield "diffusivity D", f"{_number(found.diffusivity)} h²/step"
    if found.kind != DIFFUSION and found.body is not None:
        yield from _elastic(found, found.body)


def _elastic(found: Identity, body: Elasticity) -> Iterator[Row]:
    (_, c12, c16), (_, c22, c26), (*_, c66) = body.stiffness / body.stiffness[0, 0]
    ratios = {"C22": c22, "C12": c12, "C66": c66}
    ratios |= {name: c for name, c in (("C16", c16), ("C26", c26)) if abs(c) > SAME}
    text = ", ".join(f"{name} {_number(c)}" for name, c in ratios.items())
    yield "elastic constants", f"{text} in units of C11 = {_number(body.stiffness[0, 0])} h²/step"
    if (ratio := found.poisson_ratio) is not None:
        strain = f", {_number(ratio / (1 + ratio))} in plane strain" if ratio > -0.999 else ""
        yield "Poisson's ratio", f"{_number(ratio)} in plane stress{strain}"
        return
    along = [body.poisson_ratio(angle) for angle in (0.0, 90.0)]
    *texts, zener = ["none" if r is None else _number(r) for r in (*along, body.zener)]
    yield "Poisson's ratio", f"{texts[0]} pulled along x, {texts[1]} along y (plane stress)"
    yield "anisotropy", f"4 C66 / (C11 + C22 - 2 C12) = {zener}, isotropic 1"
    if body.axis is not None:
        yield "axis of symmetry", f"at {_number(body.axis)}°"


def _waves(found: Identity) -> Iterator[Row]:
    if found.long is None:
        return
    if found.kind != DIFFUSION:
        yield "fast long waves", _range_text(found.long.fast, "h²/step diffusivity")
        yield "slow long waves", _range_text(found.long.slow, "h²/step diffusivity")
    elif not found.isotropic:
        yield "diffusivity D", _range_text(found.long.fast, "h²/step")
    for gradient in found.long.gradients:
        fast, slow = (_number(length) for length in gradient.material)
        alike = abs(gradient.material[0] - gradient.material[1]) < 1e-9
        where = f"along {_number(gradient.direction)}°"
        rows = f"across rows {_number(gradient.rows_apart)} h apart"
        yield "gradient length²", f"{fast if alike else f'{fast} and {slow}'} h² {where}, {rows}"


def _range_text(waves: DirectionalRange, unit: str) -> str:
    largest = f"{_number(waves.largest)} {unit}"
    if waves.largest - waves.smallest < 1e-8 * abs(waves.largest):
        return f"{largest} in every direction"
    smallest = f"{_number(waves.smallest)} along {_number(waves.at_smallest)}°"
    return f"{largest} along {_number(waves.at_largest)}°, {smallest}"


def _character(found: Identity) -> Iterator[Row]:
    spectrum, yes = found.spectrum, {True: "yes", False: "no"}
    turning = f", imaginary parts up to {_number(spectrum.imaginary)}"
    ends = f"{_number(spectrum.smallest)} to {_number(spectrum.largest)}"
    yield "eigenvalues", ends + turning * (spectrum.imaginary > NEUTRAL)
    yield "linear", yes[found.linear]
    yield "symmetric", "yes, k weighs for j as j for k" if found.symmetric else "no"
    yield "turns with the body", yes[found.turns]
    yield "rests at free edges", yes[found.rests_at_edges]


def _relaxation_text(found: Identity) -> str:
    with_memory = f" with memory {found.memory:g}" if found.memory else ""
    bound = found.spectrum.largest_stable_relaxation
    if bound is not None:
        return f"stable below {_number(bound)}{with_memory}"
    grows = found.spectrum.largest > 1.0 + NEUTRAL or abs(found.memory) >= 1.0
    return f"diverges at any{with_memory}" if grows else "no bound"


def _number(value: float) -> str:
    """Six digits; what is rounding, in units of the spacing, is 0."""
    return f"{round(value, 11) + 0.0:.6g}"


def notes_on(found: Identity, scene: Scene) -> Iterator[str]:
    """A line each."""
    if not found.linear:
        yield "the rule is not linear: this is what it is for small displacements from rest"
    if scene.experiment.rule.uses_reference:
        yield "it asks for the place: the figures are those in the middle of the body"
    if scene.experiment.neighbours.nearness():
        yield "neighbours are found anew: the figures hold while they are those at rest"
    if found.stencil.sites > 1:
        yield f"{found.stencil.sites} sites a cell: shifts of them are eliminated"
    if found.long is not None:
        yield from _notes_of_long_waves(found, found.long)
    bound = found.spectrum.largest_stable_relaxation
    if bound is None and found.spectrum.largest > 1 + NEUTRAL:
        yield "some waves grow at any relaxation"
    elif bound is not None and found.relaxation > bound * (1 + NEUTRAL):
        yield f"relaxation {found.relaxation:g} diverges; it is stable below {bound:.6g}"


def _notes_of_long_waves(found: Identity, long: LongWaves) -> Iterator[str]:
    if abs(long.slow.smallest) <= SAME * abs(long.fast.largest):
        yield f"some long waves along {long.slow.at_smallest:.4g}° do not decay at all"
    if found.kind == DIFFUSION and found.body:
        yield "away from free edges it is plane-stress elasticity with Poisson's ratio -1"
    if found.kind == ELASTICITY and long.elasticity:
        yield from _notes_of_body(long.elasticity)
        if not found.rests_at_edges:
            yield "away from free edges it is elastic; at them it pulls inwards"
    lengths = [length for gradient in long.gradients for length in gradient.material]
    attracting = [f"{g.direction:.4g}°" for g in long.gradients if min(g.material) < -SAME]
    if attracting:
        yield (
            f"rows beyond the next attract along {', '.join(attracting)}: the wrong sign for "
            "gradient elasticity, and an effect that vanishes with the spacing"
        )
    elif min(lengths, default=0.0) > SAME:
        low, high = np.sqrt(min(lengths)), np.sqrt(max(lengths))
        span = f"{low:.6g}" if high - low < SAME else f"{low:.6g} to {high:.6g}"
        yield f"it is gradient elasticity, with a length of {span} h"


def _notes_of_body(body: Elasticity) -> Iterator[str]:
    if body.least_stiffness < -SAME:
        yield "some uniform strain lowers the energy: only held edges keep it in shape"
    elif body.least_stiffness < SAME:
        yield "some uniform strain costs no energy"
    if np.abs(body.mobility - np.eye(2)).max() > SAME:
        yield "x and y go to equilibrium at different rates; the equilibrium is elastic"
