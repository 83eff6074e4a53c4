"""What a rule is physically, on its lattice and neighbours."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import numpy as np

from pbdkit.identity.dispersion import LongWaves, Spectrum
from pbdkit.identity.elastic_constants import DIFFUSION, ELASTICITY, NEITHER, SAME, Elasticity
from pbdkit.identity.waves import Primitive


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
    spectrum: Spectrum = field(repr=False)
    relaxation: float
    memory: float
    kind: str
    long: LongWaves | None = field(repr=False)
    notes: tuple[str, ...] = ()

    def _repr_html_(self) -> str:
        """What a notebook shows: what the rule is, with its constants."""
        return str(import_module("pbdkit.drawing.notebook").identity_html(self))

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
