"""Compare fracture with energy with linear fracture mechanics: a double-cantilever beam and a plate
with a central notch, over spacings. Exits with 1 if a force of a beam of at least 29 rows differs
from that of Griffith by more than 4 %.

    python tests/reliability/fracture_energy.py beam 15 29 57 119
    python tests/reliability/fracture_energy.py plate 31 63 127 255

The bodies are the net of springs of ν = 1/3, which 'elastic' is for small strains, mirrored at the
crack's plane. The part outside that plane is linear and condensed once; the cells across it soften
by `Cohesive` itself under the stress across the plane, with equilibrium and softening in turn as
`solver: equilibrium` does. Lattices can therefore be finer than with whole bodies;
`tests/components/test_fracture_cohesive.py` holds one of these, cracked, against a whole one by
pbdkit.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

sys.path[:0] = [str(Path(__file__).parents[2])]

import numpy as np
import scipy.linalg
import scipy.sparse
from scipy.sparse.linalg import splu

from pbdkit.components.fracture import Cohesive
from pbdkit.model.experiment import Experiment
from pbdkit.plugin import CellStress, Vector
from pbdkit.scene.scene import build_scene

PARTS = {
    "name": "bonds",
    "body": {"type": "grid", "columns": 2, "rows": 2},
    "neighbours": {"type": "chebyshev"},
    "rule": {"type": "elastic", "poisson_ratio": 1 / 3},
    "frame": {"type": "natural"},
    "steps": 1,
}
EDGE, DIAGONAL = 0.75, 0.375
"""Stiffnesses of bonds over Young's modulus and thickness."""
POISSON = 1 / 3
ONSET, ENOUGH, MOST = 1e-4, 1e-5, 3000
NUMBERS = tuple(
    f"{name}_{side}" for name in ("damage", "normal_x", "normal_y") for side in ("left", "right")
)
"""State variables of a bond of `Cohesive`, in their order."""


def net(columns, rows):
    """The stiffness of the half above the crack's plane, (2 particles)²: (0, 0) lies half a spacing
    above it at the left edge, and j counts fastest. The lowest row has the horizontal bonds of the
    torn cells too, as pbdkit has."""
    i, j = np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij")
    parts = []
    for di, dj, k in ((1, 0, EDGE), (0, 1, EDGE), (1, 1, DIAGONAL), (-1, 1, DIAGONAL)):
        there = (i + di < columns) & (i + di >= 0) & (j + dj < rows)
        free = (dj == 0) & (j == rows - 1) | (di == 0) & ((i == 0) | (i == columns - 1))
        a = (i * rows + j)[there]
        n = np.array([di, dj]) / np.hypot(di, dj)
        parts.append(
            (a, a + di * rows + dj, np.where(free, k / 2, k)[there], np.tile(n, (len(a), 1)))
        )
    a, b, k, n = (np.concatenate(part) for part in zip(*parts, strict=True))
    places = np.concatenate([2 * a, 2 * a + 1, 2 * b, 2 * b + 1])
    rates = np.concatenate([-n[:, 0], -n[:, 1], n[:, 0], n[:, 1]])
    shape = len(a), 2 * columns * rows
    stretch = scipy.sparse.csr_matrix((rates, (np.tile(np.arange(len(a)), 4), places)), shape)
    return (stretch.T @ scipy.sparse.diags(k) @ stretch).tocsc()


@dataclass
class Half:
    """A body above its crack's plane, condensed on its lowest row (u of all, then v) and on one
    upward displacement of the leaders."""

    h: float
    columns: int
    stiffness: np.ndarray

    @classmethod
    def of(cls, h, columns, rows, leads):
        """`leads` are the numbers of those that lead together, and are held along x."""
        full, lowest = net(columns, rows), np.arange(columns) * rows
        kept = np.concatenate([2 * lowest, 2 * lowest + 1])
        led = np.asarray(leads)
        rest = np.setdiff1d(np.arange(full.shape[0]), np.concatenate([kept, 2 * led, 2 * led + 1]))
        to_led = np.asarray(full[:, 2 * led + 1].sum(axis=1)).ravel()
        across = np.column_stack([full[:, kept].toarray(), to_led])
        inner = splu(full[rest][:, rest].tocsc()).solve(across[rest])
        reduced = across - full[:, rest] @ inner
        rows_of = np.vstack([reduced[kept], reduced[2 * led + 1].sum(axis=0)])
        return cls(h, columns, (rows_of + rows_of.T) / 2)

    def __post_init__(self):
        c, k = self.columns, np.arange(self.columns - 1)
        self.stretch = np.zeros(
            (2 * c - 1, 2 * c)
        )  # columns upright bonds, then pairs of diagonals
        self.stretch[np.arange(c), c + np.arange(c)] = 2.0
        for place, sign in ((k, -1), (k + 1, 1), (c + k, 1), (c + k + 1, 1)):
            self.stretch[c + k, place] += sign / np.sqrt(2)
        self.k = np.concatenate([np.full(c, EDGE), np.full(c - 1, 2 * DIAGONAL)])
        self.k[[0, c - 1]] /= 2

    def force(self, damage, opening):
        """(the force that opens it, the displacements of the lowest row), with the shares of their
        pull that the bonds across have lost."""
        c = 2 * self.columns
        matrix = 2 * self.stiffness[:c, :c]
        matrix = matrix + (self.stretch.T * (self.k * (1 - damage))) @ self.stretch
        right = -self.stiffness[:c, c] * opening
        x = scipy.linalg.solve(matrix, right, assume_a="pos")
        force = self.stiffness[c, :c] @ x + self.stiffness[c, c] * opening / 2
        return force, x

    def torn(self, first, last):
        """The damage where the upright bonds of these columns, and the diagonals between, are
        torn."""
        damage = np.zeros(2 * self.columns - 1)
        damage[first : last + 1] = damage[self.columns + first : self.columns + last] = 1.0
        return damage

    def load(self, fracture, cut, openings):
        """Yield the force and the damage of the cells at each opening, with equilibrium and
        softening in turn, for the requested openings; some bonds are `cut`."""
        (c, p), zero = constants(self.h, fracture), np.zeros(self.columns - 1)
        upright, diagonal = Vector(zero, zero + self.h), Vector(zero + self.h, zero + self.h)
        bonds = {"left": upright, "right": upright, "diagonal": diagonal}
        numbers = {bond: dict.fromkeys(NUMBERS, zero) for bond in bonds}
        for opening in openings:
            for _ in range(MOST):
                damage = {bond: numbers[bond]["damage_left"] for bond in bonds}
                force, x = self.force(np.maximum(cut, self.lost(**damage)), opening)
                strains = 2 * x[self.columns :] / self.h
                strain = (strains[1:] + strains[:-1]) / 2
                along = np.diff(x[: self.columns]) / self.h
                pull = (strain + POISSON * along) / (1 - POISSON**2)
                own = {"left": strains[:-1], "right": strains[1:], "diagonal": (along + strain) / 2}
                for bond, r in bonds.items():
                    mean = along, strain, zero
                    stress = CellStress(zero, pull, zero, zero + 1.0, *mean, own[bond])
                    known = SimpleNamespace(**numbers[bond], **c)
                    found = Cohesive.update(r, r, known, p, stress, stress)
                    numbers[bond] = dict(zip(NUMBERS, found, strict=True))
                if all((numbers[n]["damage_left"] - damage[n]).max() < ENOUGH for n in bonds):
                    break
            yield force, damage

    def lost(self, left, right, diagonal):
        """The shares of their pull that bonds lose by the damage in the cells beside them."""
        beside = np.concatenate([left[:1], (left[1:] + right[:-1]) / 2, right[-1:]])
        return np.concatenate([beside, diagonal])


def constants(h, fracture):
    """Return the constants of upright bonds and the parameters that `Cohesive` has in a scene of
    that spacing."""
    scene = build_scene(Experiment(**PARTS, lattice={"type": "square", "a": h}, fracture=fracture))
    upright = next(s for s in scene.constants.limits if s.rest.x == 0.0)
    return scene.constants.limits[upright]._asdict(), scene.constants.fracture


def beam(n, a=2.0, size=5.0, energy=1.0, far=1.8, count=24):
    """Force over Griffith's at the same opening, of openings from 1.2 to `far` times that at which
    the crack starts to run: arms of height 1 and length 5, n rows of cells, crack 2."""
    h = 2.0 / n
    columns, rows, lead = round(size / h) + 1, (n + 1) // 2, (n - 1) // 2 - round((n - 1) / 4)
    half = Half.of(h, columns, rows, [lead])
    torn = np.unique(np.round(np.arange(a - 0.4, size - 1.0, 0.25) / h).astype(int))
    compliance = [1.0 / half.force(half.torn(0, i), 1.0)[0] for i in torn]
    root = np.polynomial.Polynomial.fit(torn * h, np.cbrt(compliance), 3)
    ways = np.linspace(torn[0] * h, torn[-1] * h, 2000)
    C, slope = root(ways) ** 3, 3 * root(ways) ** 2 * root.deriv()(ways)
    griffith = np.sqrt(2 * energy * ONSET**2 / slope)
    start = round(a / h)
    openings = np.linspace(0.7, far, count) * np.interp(start * h, ways, griffith * C)
    fracture = {"type": "cohesive", "energy": energy * ONSET**2, "onset": ONSET}
    forces = np.array([f for f, _ in half.load(fracture, half.torn(0, start), openings)])
    runs = openings > openings[0] / 0.7 * 1.2
    return (forces / np.interp(openings, griffith * C, griffith))[runs]


def plate(n, notch=0.4, size=2.0, energy=0.2):
    """Strength over that of linear fracture mechanics, of a plate 2 wide and 4 high between rigid
    grips with a central notch 0.8 long: σ √(πa) √sec(πa/w) = √(E G)."""
    h = size / n
    columns, rows = n + 1, n + 1
    half = Half.of(h, columns, rows, np.arange(columns) * rows + rows - 1)
    first = round((size / 2 - notch) / h)
    last = columns - 1 - first
    a = (last - first + 1) * h / 2  # to the middle between torn bonds and whole ones
    linear = np.sqrt(energy / (np.pi * a) * np.cos(np.pi * a / size)) * ONSET
    start = half.torn(first, last)
    stiffness = half.force(start, 1.0)[0] / size
    fracture, most = {"type": "cohesive", "energy": energy * ONSET**2, "onset": ONSET}, 0.0
    for force, _ in half.load(fracture, start, np.arange(0.5, 1.5, 0.01) * linear / stiffness):
        if force < 0.9 * most:
            break
        most = max(most, force)
    return most / size / linear


def main() -> int:
    """One line a spacing."""
    which, *spacings = sys.argv[1:]
    held = True
    for n in map(int, spacings):
        if which == "beam":
            share = beam(n)
            held &= n < 29 or abs(share.mean() - 1) < 0.04
            found = f"force over Griffith's {share.mean():.4f} ± {share.std():.4f}"
        else:
            found = f"strength over that of linear fracture mechanics {plate(n):.4f}"
        print(f"{which}, spacing 2/{n}: {found}", flush=True)
    return int(not held)


if __name__ == "__main__":
    sys.exit(main())
