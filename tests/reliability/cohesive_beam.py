"""A notched beam in three-point bending, beyond its peak, by `cohesive` and interface elements.

    python tests/reliability/cohesive_beam.py [--height 32] [linear] [bilinear] [exponential]

The beam has the given height in cells, an even number, and a notch of nearly half of it; the
process zone is 2.8 times as long as the beam is high. The reference consists of quadratic elements
(scikit-fem) with the same softening law between the two halves in the plane of the notch. For both,
the deflection of the load grows in the same increments. Printed are the peak load over that of the
reference, and the work of both over the fracture energy of the ligament. Exits with 1 if a peak
differs by more than 5 % from that of the reference, or the work by more than 3 %.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[2])]

import numpy as np

import pbdkit
from pbdkit.components.fracture import LAWS

ONSET, ENERGY, POISSON = 1e-4, 2.8125e-8, 0.2
"""Strength over Young's modulus, fracture energy over Young's modulus and height, and Poisson's
ratio."""
PENALTY = 3200.0
"""Stiffness of the interface before it opens, times height over Young's modulus."""
INCREMENTS, FIRST, LAST = 60, 0.75, 156.25
"""Number of increments, and their first and last deflection over onset and height."""


class Beam:
    """Measures of the beam, in cells.

    Parameters
    ----------
    height : int
        Height.
    """

    def __init__(self, height: int) -> None:
        self.height, self.length, self.notch = height, 4 * height + 1, (height - 1) / 2
        self.energy, self.penalty = ENERGY * height, PENALTY / height
        self.deflections = height * ONSET * np.geomspace(FIRST, LAST, INCREMENTS)
        """Deflections of the increments, which grow in proportion."""

    def work(self, loads):
        """Return the work over the fracture energy of the ligament."""
        ways, loads = np.append(0.0, self.deflections), np.append(0.0, loads)
        return np.trapezoid(loads, ways) / (self.energy * (self.height - self.notch))


def lattice_loads(beam, law):
    """Return the loads of the lattice."""
    middle = beam.length / 2

    def at(*points):
        return {"nearest": [list(point) for point in points]}

    supports = [
        {"select": at((0.0, 0.0)), "motion": {"type": "hold"}},
        {"select": at((float(beam.length), 0.0)), "motion": {"type": "hold"}, "axes": ["y"]},
    ]
    ways = [[0.0, -float(way)] for way in beam.deflections]
    load = {
        "select": at((middle - 0.5, float(beam.height)), (middle + 0.5, float(beam.height))),
        "motion": {"type": "path", "steps": list(range(1, INCREMENTS + 1)), "displacements": ways},
        "axes": ["y"],
    }
    ds = pbdkit.run(
        {
            "name": "beam",
            "lattice": {"type": "square", "a": 1.0},
            "body": {"type": "grid", "columns": beam.length + 1, "rows": beam.height + 1},
            "neighbours": {"type": "chebyshev"},
            "rule": {"type": "elastic", "poisson_ratio": POISSON},
            "frame": {"type": "natural"},
            "fracture": {
                "type": "cohesive",
                "energy": beam.energy,
                "onset": ONSET,
                "law": law,
                "cracks": [[[middle, -1.0], [middle, beam.notch]]],
            },
            "leaders": [*supports, load],
            "steps": INCREMENTS,
            "solver": {"type": "equilibrium", "tolerance": 1e-4, "increments": INCREMENTS},
            "record": {"every": 1},
            "diagnostics": [{"type": "reaction", "youngs_modulus": 1.0, "thickness": 1.0}],
        },
        progress=False,
    )
    return np.abs(ds.reaction.sel(leader_group=2, axis="y").values[1:])


def condensed_half(beam, size):
    """Return the stiffness of half a beam, condensed on the displacements along x of the ligament
    and on the deflection, and the lengths of the nodes of the ligament."""
    import skfem
    from skfem.models.elasticity import lame_parameters, linear_elasticity

    half, lame = beam.length / 2, lame_parameters(1.0, POISSON)
    plane_stress = 2 * lame[0] * lame[1] / (lame[0] + 2 * lame[1]), lame[1]
    x = np.linspace(0.0, half, round(half / (2 * size)) + 1)
    x = half * (1 - (1 - x / half) ** 1.3)
    mesh = skfem.MeshQuad.init_tensor(
        x, np.linspace(0.0, beam.height, round(beam.height / size) + 1)
    )
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementQuad2()), intorder=4)
    K = linear_elasticity(*plane_stress).assemble(basis).tocsc()
    places, axis = basis.doflocs, np.full(K.shape[0], -1)
    for a in (0, 1):
        for dofs in (basis.nodal_dofs, basis.facet_dofs, basis.interior_dofs):
            axis[dofs[a]] = a
    middle = np.isclose(places[0], half)
    lip = np.flatnonzero(middle & (axis == 0) & (places[1] > beam.notch - 1e-9))
    lip = lip[np.argsort(places[1][lip])]
    top = np.flatnonzero(middle & (axis == 1) & np.isclose(places[1], beam.height))
    support = np.flatnonzero(np.isclose(places[0], 0.0) & np.isclose(places[1], 0.0) & (axis == 1))
    kept = np.concatenate([lip, top])
    rest = np.setdiff1d(np.arange(K.shape[0]), np.concatenate([kept, support]))
    from scipy.sparse.linalg import splu

    inner = splu(K[rest][:, rest].tocsc()).solve(K[rest][:, kept].toarray())
    reduced = K[kept][:, kept].toarray() - K[kept][:, rest] @ inner
    weights = np.zeros(len(lip))
    for n in range(0, len(lip) - 2, 2):
        weights[n : n + 3] += size * np.array([1.0, 4.0, 1.0]) / 6.0
    return reduced, weights


def interface_loads(beam, law, size=0.5):
    """Return the loads of the reference with elements of the given size."""
    K, weights = condensed_half(beam, size)
    softening = LAWS[law]
    first = ONSET / beam.penalty
    x = np.concatenate([[0.0], first + softening.opening * beam.energy / ONSET])
    t = np.concatenate([[0.0], softening.stress * ONSET])
    u, largest, loads = np.zeros(len(weights)), np.zeros(len(weights)), []
    for way in beam.deflections:
        u = equilibrium(beam.penalty, K, weights, x, t, u, largest, way)
        largest = np.maximum(largest, -2 * u)
        loads.append(2 * abs(K[-1, :-1] @ u - K[-1, -1] * way))
    return np.array(loads)


def equilibrium(penalty, K, weights, x, t, u, largest, way):
    """Return the displacements of the ligament by Newton's method with a line search.

    It is the left half of the beam: where the ligament opens, its displacement u is negative.
    """

    def forces(u):
        w = -2 * u
        seen = np.maximum(np.maximum(w, largest), x[1])
        secant = np.interp(seen, x, t) / seen
        secant = np.where(w < 0.0, penalty, secant)
        n = np.clip(np.searchsorted(x, w, side="right") - 1, 0, len(x) - 2)
        slope = np.where(w > x[-1], 0.0, (t[n + 1] - t[n]) / (x[n + 1] - x[n]))
        slope = np.where((w >= seen) & (w > 0.0), slope, secant)
        return K[:-1, :-1] @ u - K[:-1, -1] * way - weights * secant * w, 2 * weights * slope

    for _ in range(200):
        residual, slope = forces(u)
        if np.abs(residual).max() < 1e-10 * ONSET:
            return u
        step = np.linalg.solve(K[:-1, :-1] + np.diag(slope), -residual)
        size = 1.0
        while size > 1e-3:
            if np.linalg.norm(forces(u + size * step)[0]) < np.linalg.norm(residual):
                break
            size /= 2
        u = u + size * step
    raise SystemExit(f"the reference does not converge: {np.abs(residual).max() / ONSET:.1e}")


def main() -> int:
    """Print one line for each law."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("law", nargs="*", default=["linear"], help="softening laws")
    parser.add_argument("--height", type=int, default=32, help="height of the beam in cells")
    options, held = parser.parse_args(), True
    beam = Beam(options.height)
    for law in options.law:
        reference, loads = interface_loads(beam, law), lattice_loads(beam, law)
        peak = loads.max() / reference.max()
        work = beam.work(loads) / beam.work(reference)
        held &= abs(peak - 1) < 0.05 and abs(work - 1) < 0.03
        print(
            f"{law}: peak over that of interface elements {peak:.3f}, work {work:.3f}; work over "
            f"energy · ligament {beam.work(loads):.3f}, of interface elements "
            f"{beam.work(reference):.3f}, last load over the peak {loads[-1] / loads.max():.3f}",
            flush=True,
        )
    return int(not held)


if __name__ == "__main__":
    sys.exit(main())
