"""A round inclusion in a plate under tension, against the exact solution (Goodier 1933).

A square plate, side 1, around the inclusion's centre; the exact displacements are prescribed on its
boundary, so that inside it is the infinite plate under σ_x = `PULL` far away. Plane stress, E = 1
and ν = .3, in the inclusion 10 and .2.

`python tests/finite_elements/inclusion.py` prints how well the solution satisfies what it must, the
errors of the lattice rule over spacings, and the stress beside the pole and in the inclusion.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
import pbdkit

PULL, RADIUS, CENTRE = 1e-3, 0.3, (0.5, 0.5)
SIZES = (20, 40, 80)
"""Cells across the plate; the inclusion has .6 of them across."""


@dataclass(frozen=True)
class Material:
    """Elastic constants under plane stress."""

    modulus: float
    poisson_ratio: float

    @property
    def shear(self) -> float:
        return self.modulus / (2.0 * (1.0 + self.poisson_ratio))

    @property
    def kappa(self) -> float:
        return (3.0 - self.poisson_ratio) / (1.0 + self.poisson_ratio)


MATRIX, INCLUSION = Material(1.0, 0.3), Material(10.0, 0.2)


@dataclass(frozen=True)
class Potentials:
    """Kolosov and Muskhelishvili's φ and ψ in one material, as coefficients of powers of z:

    2μ (u + iv) = κ φ - z φ'* - ψ*,  σ_x + σ_y = 4 Re φ',  σ_y - σ_x + 2iτ = 2 (z* φ'' + ψ').
    """

    material: Material
    phi: dict[int, float]
    psi: dict[int, float]

    def displacement(self, z):
        """Return u + iv at z."""
        of = self.material
        turned = z * np.conj(_derivative(self.phi, z)) + np.conj(_sum(self.psi, z))
        return (of.kappa * _sum(self.phi, z) - turned) / (2.0 * of.shear)

    def stress(self, z):
        """Return (σ_x, σ_y, τ) at z."""
        trace = 4.0 * _derivative(self.phi, z).real
        second = _derivative({n - 1: n * c for n, c in self.phi.items()}, z)
        apart = 2.0 * (np.conj(z) * second + _derivative(self.psi, z))
        return (trace - apart.real) / 2.0, (trace + apart.real) / 2.0, apart.imag / 2.0


def _sum(coefficients, z):
    return sum(c * z**n for n, c in coefficients.items())


def _derivative(coefficients, z):
    return sum(c * n * z ** (n - 1) for n, c in coefficients.items())


def goodier() -> tuple[Potentials, Potentials]:
    """(matrix, inclusion), z from the centre.

    φ = S/4 (z + A a²/z), ψ = -S/2 (z + B a²/z + C a⁴/z³) outside, φ = P z, ψ = Q z inside. That
    φ + z φ'* + ψ* (tractions) and u + iv are the same on |z| = a, power by power, gives them all.
    """
    ratio = INCLUSION.shear / MATRIX.shear
    k, k_in = MATRIX.kappa, INCLUSION.kappa
    A = 2.0 * (1.0 - ratio) / (1.0 + ratio * k)
    B = (k_in - 1.0 - ratio * (k - 1.0)) / (2.0 * ratio + k_in - 1.0)
    C, P, Q = -A / 2.0, (1.0 - B) / 4.0, (A - 2.0) / 4.0
    a, S = RADIUS, PULL
    outside = Potentials(
        MATRIX,
        {1: S / 4, -1: S / 4 * A * a**2},
        {1: -S / 2, -1: -S / 2 * B * a**2, -3: -S / 2 * C * a**4},
    )
    return outside, Potentials(INCLUSION, {1: S * P}, {1: S * Q})


def exact(places: np.ndarray) -> np.ndarray:
    """Displacements (place, 2) at places (place, 2)."""
    z = (places - CENTRE) @ [1.0, 1.0j]
    matrix, inclusion = goodier()
    far = np.where(np.abs(z) > RADIUS, z, RADIUS)
    u = np.where(np.abs(z) > RADIUS, matrix.displacement(far), inclusion.displacement(z))
    return np.stack([u.real, u.imag], axis=-1)


def jumps() -> tuple[float, float]:
    """The largest jumps across the border: of displacements over the largest, of tractions over
    the pull."""
    z = RADIUS * np.exp(2j * np.pi * np.arange(360) / 360)
    n = np.stack([z.real, z.imag]) / RADIUS
    u, traction = [], []
    for side in goodier():
        u.append(side.displacement(z))
        x, y, shear = side.stress(z)
        traction.append(np.stack([x * n[0] + shear * n[1], shear * n[0] + y * n[1]]))
    off = np.abs(u[0] - u[1]).max() / np.abs(u[0]).max()
    return float(off), float(np.abs(traction[0] - traction[1]).max() / PULL)


@dataclass(frozen=True)
class Plate:
    """Places (particle, 2), displacements (particle, 2) and σ_x (particle,)."""

    places: np.ndarray
    u: np.ndarray
    stress: np.ndarray

    @property
    def error(self) -> float:
        """The largest of all particles, over the largest displacement."""
        wanted = exact(self.places)
        return float(np.abs(self.u - wanted).max() / np.abs(wanted).max())

    @property
    def stretch(self) -> float:
        """The mean strain ε_x of the inclusion, fitted to its particles, over the exact one, which
        is the same everywhere in it."""
        within = np.hypot(*(self.places - CENTRE).T) < RADIUS
        at = np.column_stack([np.ones(within.sum()), self.places[within]])
        found, wanted = (
            np.linalg.lstsq(at, u[within], rcond=None)[0][1, 0]
            for u in (self.u, exact(self.places))
        )
        return float(found / wanted)

    @property
    def rim(self) -> tuple[float, float]:
        """The smallest and the largest σ_x of the inclusion's particles over the exact one, which
        is the same everywhere in it."""
        within = np.hypot(*(self.places - CENTRE).T) <= RADIUS + 1e-9
        exact_one = goodier()[1].stress(1e-3 + 0j)[0]
        return tuple(float(end(self.stress[within]) / exact_one) for end in (np.min, np.max))

    @property
    def pole(self) -> tuple[float, float, float]:
        """σ_x at the first particle of the matrix on the axis beyond the pole, over the exact one
        there; where it lies, in radii from the centre; the same over the exact one at the pole."""
        away = self.places - CENTRE
        on = (np.abs(away[:, 1]) < 1e-9) & (away[:, 0] > RADIUS + 1e-9)
        first = np.flatnonzero(on)[away[on, 0].argmin()]
        place = away[first, 0]
        there, pole = (goodier()[0].stress(complex(x))[0] for x in (place, RADIUS))
        return (
            float(self.stress[first] / there),
            float(place / RADIUS),
            float(self.stress[first] / pole),
        )


@cache
def plate(cells: int) -> Plate:
    """Return the plate with a number of cells across."""
    line = np.arange(cells + 1) / cells
    around = [np.stack(p, -1) for s in (0 * line, 0 * line + 1) for p in ((line, s), (s, line))]
    points = np.unique(np.concatenate(around), axis=0)
    known = {"points": points.tolist(), "displacements": exact(points).tolist()}
    edges = ("left", "right", "bottom", "top")
    given = {
        "name": "goodier",
        "lattice": {"type": "square", "a": 1.0 / cells},
        "body": {"type": "rectangle", "width": 1.0, "height": 1.0},
        "regions": {"inclusion": {"type": "disc", "radius": RADIUS, "centre": CENTRE}},
        "neighbours": {"type": "chebyshev"},
        "rule": {
            "type": "elastic",
            "stiffness": {"otherwise": MATRIX.modulus, "inclusion": INCLUSION.modulus},
            "poisson_ratio": {
                "otherwise": MATRIX.poisson_ratio,
                "inclusion": INCLUSION.poisson_ratio,
            },
        },
        "frame": {"type": "natural"},
        "leaders": [
            {"select": {"edge": edge}, "motion": {"type": "measured", **known}} for edge in edges
        ],
        "steps": 1,
        "solver": {"type": "equilibrium", "tolerance": 1e-9},
        "diagnostics": [{"type": "displacement"}, {"type": "stress", "youngs_modulus": 1.0}],
    }
    ds = pbdkit.run(given, progress=False).isel(time=-1)
    return Plate(ds.reference.values, ds.u.values, ds.stress_xx.values)


if __name__ == "__main__":
    of_u, of_traction = jumps()
    print(f"exact solution: jumps of {of_u:.2g} in displacement, {of_traction:.2g} in traction")
    last = None
    for n in SIZES:
        found = plate(n)
        order = "" if last is None else f", order {np.log2(last / found.error):.2f}"
        there, place, pole = found.pole
        print(
            f"{n:3} cells: largest error {found.error:.3g}{order}; the inclusion's strain "
            f"{found.stretch - 1:+.2%} off; σ_x at {place:.3f} radii {there - 1:+.2%} off, from "
            f"that at the pole {pole - 1:+.2%}; in the inclusion {found.rim[0]:.2f} to "
            f"{found.rim[1]:.2f} of the exact one"
        )
        last = found.error
