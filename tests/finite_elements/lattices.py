"""The problems on pbdkit's lattices, and how far the equilibrium there is from the references."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from finite_elements.errors import load, relative_l2
from finite_elements.problems import FINEST, NU, Problem

import pbdkit

HAIR = 1e-6
ELASTIC = {"type": "elastic", "poisson_ratio": NU}
NATURAL = {"type": "natural"}
UNIT = {"youngs_modulus": 1.0, "thickness": 1.0}


@dataclass(frozen=True)
class Solved:
    """`u` (2, i, j) at the sites of the reference of `cells` per unit length, NaN where the body
    has none; `reaction` along the pull on the right edge, for E = 1."""

    problem: Problem
    cells: int
    u: np.ndarray
    reaction: float

    @property
    def at_sites(self) -> float:
        """The relative L2 error at the lattice's own sites."""
        return relative_l2(self.u, load(self.problem.name, self.cells))

    @property
    def throughout(self) -> float:
        """That of the bilinear interpolation between sites, at the sites of the finest lattice:
        what finite elements are measured by. Square lattices only."""
        fine = load(self.problem.name, FINEST)
        return relative_l2(interpolated(self.u, self.cells), fine)


def experiment(problem: Problem, cells: int, **parts: Any) -> dict[str, Any]:
    """The experiment of `cells` per unit length; `parts` replace its own."""
    kind = "hexagonal" if problem.hexagonal else "square"
    near = "coordination" if problem.hexagonal else "chebyshev"
    body = {"type": "rectangle", "width": problem.length, "height": problem.height}
    if problem.radius:
        middle = [problem.length / 2, problem.height / 2]
        disc = {"type": "disc", "radius": problem.radius, "centre": middle}
        body = {"type": "difference", "of": [body, disc]}
    left = [-9.0, -9.0, HAIR, 9.0]
    right = [problem.length - HAIR, -9.0, 2 * problem.length, 9.0]
    pull = {"type": "displace", "displacement": np.eye(2)[problem.pulled].tolist()}
    return {
        "name": problem.name,
        "lattice": {"type": kind, "a": 1 / cells},
        "body": body,
        "neighbours": {"type": near, "shells": 1},
        "rule": ELASTIC,
        "frame": NATURAL,
        "leaders": [
            {"select": {"box": left}, "motion": {"type": "hold"}},
            {"select": {"box": right}, "motion": pull},
        ],
        "steps": 1,
        "solver": {"type": "equilibrium"},
    } | parts


def between_edges(problem: Problem, cells: int) -> dict[str, Any]:
    """Parts in which the free edges lie half a spacing outside the outer rows, where frames other
    than the natural one have them: as many rows as cells."""
    below = [0.0, 0.5 / cells]
    return {
        "lattice": {"type": "square", "a": 1 / cells, "origin": below},
        "body": {
            "type": "rectangle",
            "width": problem.length,
            "height": problem.height - 1 / cells,
            "origin": below,
        },
    }


def solved(problem: Problem, cells: int, **parts: Any) -> Solved:
    """Return the equilibrium, with the reaction if the natural frame defines it, else NaN."""
    asked = experiment(problem, cells, **parts)
    natural = asked["frame"] == NATURAL
    if natural:
        asked["diagnostics"] = [{"type": "reaction", **UNIT}]
    dataset = pbdkit.run(asked, progress=False)
    body = (dataset.kind[-1] != 2).values
    X = dataset.reference.values[body]
    u = (dataset.position[-1] - dataset.reference).values[body]
    reaction = float(dataset.reaction[-1, 1, problem.pulled]) if natural else np.nan
    return Solved(problem, cells, on_grid(problem, cells, X, u), reaction)


def on_grid(problem: Problem, cells: int, X: Any, u: Any) -> np.ndarray:
    """Displacements u (site, 2) at X on the reference's grid, (2, i, j). Sites between its rows
    are on one of twice as many cells."""
    row = problem.height * FINEST / problem.rows / cells
    if not np.allclose(X[:, 1] / row, np.rint(X[:, 1] / row), atol=1e-6):
        return on_grid(problem, 2 * cells, X, u)
    columns = round(problem.length * cells)
    found = np.full((2, columns + 1, round(problem.height / row) + 1), np.nan)
    j = np.rint(X[:, 1] / row).astype(int)
    shift = j % 2 / 2 if problem.hexagonal else 0.0
    i = np.rint(X[:, 0] * cells - shift).astype(int)
    there = (i >= 0) & (i < found.shape[1]) & (j >= 0) & (j < found.shape[2])
    found[:, i[there], j[there]] = u[there].T
    return found


def error_at(problem: Problem, found: np.ndarray, cells: int) -> float:
    """The relative L2 error at those sites of the reference that were found."""
    reference = load(problem.name, cells)
    weights = np.where(np.isnan(found[0]), 0.0, reference.weights)
    off, exact = (np.nansum(v**2, axis=0) for v in (found - reference.u, reference.u))
    return float(np.sqrt((weights * off).sum() / (weights * exact).sum()))


def interpolated(u: np.ndarray, cells: int) -> np.ndarray:
    """At the sites of the finest lattice, bilinear between those of the grid of `cells`."""
    u = continued(u)
    for axis in (1, 2):
        n = u.shape[axis]
        place = np.arange(round((n - 1) * FINEST / cells) + 1) * (cells / FINEST)
        first = np.minimum((place + 1e-9).astype(int), n - 2)
        share = (place - first).reshape(-1, 1) if axis == 1 else place - first
        u = (1 - share) * u.take(first, axis) + share * u.take(first + 1, axis)
    return u


def continued(u: np.ndarray) -> np.ndarray:
    """With the corners of cut cells: where two sites in a row are known, the next one as a linear
    function has it, the mean over directions."""
    wide = np.pad(u, ((0, 0), (2, 2), (2, 2)), constant_values=np.nan)
    guesses = []
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            if i or j:
                near, far = (np.roll(wide, (n * i, n * j), (1, 2)) for n in (1, 2))
                guesses.append(2 * near - far)
    known = ~np.isnan(guesses)
    count = known.sum(axis=0)
    mean = np.where(known, guesses, 0.0).sum(axis=0) / np.where(count, count, 1)
    wide = np.where(np.isnan(wide) & (count > 0), mean, wide)
    return wide[:, 2:-2, 2:-2]
