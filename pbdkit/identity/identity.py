"""What a rule is physically, on its lattice and neighbours."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pbdkit.identity.dispersion import Gradient, Range, Spectrum
from pbdkit.identity.elasticity import SAME, Elasticity, Floats
from pbdkit.identity.primitive import Primitive
from pbdkit.identity.waves import SlowWaves

DIFFUSION, ELASTICITY, NEITHER = "diffusion", "elasticity", "neither"


@dataclass(frozen=True)
class LongWaves:
    """What long waves see, in units of the spacing and of a step.

    `second` is Q_abcd, of which a step moves a body by Q_abcd ∂_c ∂_d u_b; `diffusivity` D_cd where
    x and y diffuse by themselves and alike; `elasticity` the body that the rule solves for, also
    that of a diffusion; `fast` and `slow` the diffusivities of the two waves by direction;
    `gradients` the lengths of the fourth order.
    """

    waves: SlowWaves
    second: Floats
    diffusivity: Floats | None
    elasticity: Elasticity | None
    fast: Range
    slow: Range
    gradients: tuple[Gradient, ...]

    def as_dict(self) -> dict[str, Any]:
        """The figures as plain values."""
        tensor = self.diffusivity
        return {
            "second_order": self.second.tolist(),
            "diffusivity_tensor": None if tensor is None else tensor.tolist(),
            "fast": asdict(self.fast),
            "slow": asdict(self.slow),
            "gradients": [
                asdict(g) | {"total": list(g.total), "material": list(g.material)}
                for g in self.gradients
            ],
        }


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
    kind: str
    reasons: tuple[str, ...]
    notes: tuple[str, ...]
    spacing: float
    linear: bool
    turns: bool
    symmetric: bool
    rests_at_edges: bool
    stencil: Primitive
    long: LongWaves | None
    spectrum: Spectrum
    relaxation: float
    memory: float

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

    def speed(self, diffusivity: float) -> float | None:
        """Spacings a step of a wave of that diffusivity D with the solver's relaxation w and
        memory b: √(w D / √b). None without memory, or where it grows by itself.

        μ² - (1 + b - w D k²) μ + b = 0 has the roots √b exp(±iω) with
        ω² = (w D k² - (1 - √b)²) / √b for small ω: waves of that speed, less a cut-off.
        """
        if not 0.0 < self.memory <= 1.0 or diffusivity < 0.0:
            return None
        return float(np.sqrt(self.relaxation * diffusivity / np.sqrt(self.memory)))

    def as_dict(self) -> dict[str, Any]:
        """What ``pbdkit identify --json`` prints, in units of the spacing and of a step."""
        plain = ("name", "lattice", "neighbours", "rule", "kind", "spacing", "linear", "symmetric")
        return {name: getattr(self, name) for name in plain} | {
            "turns_with_the_body": self.turns,
            "rests_at_edges": self.rests_at_edges,
            "symmetry": self.symmetry,
            "reasons": list(self.reasons),
            "notes": list(self.notes),
            "sites": self.stencil.sites,
            "diffusivity": self.diffusivity,
            "poisson_ratio": self.poisson_ratio,
            "elasticity": self.body.as_dict() if self.body else None,
            "long_waves": self.long.as_dict() if self.long else None,
            "spectrum": asdict(self.spectrum),
        }
