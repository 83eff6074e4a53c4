"""Compare equilibria of slender and soft bodies with stiffnesses that are assembled here.

    python tests/reliability/slender_bodies.py [--trials N] [--seed S]

Bodies of up to --longest columns and few rows, soft at the root, in a layer or nowhere, that
leaders hold, or leave free to slide, or that nothing holds; by every method. Each result must lie
within its error bound of the solution of the assembled system, which is corrected in extended
precision until rounding of the stiffness no longer counts; bodies that loads move without end must
be refused. Exits with 1 otherwise.
"""

from __future__ import annotations

import argparse
import collections
import json
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np

sys.path[:0] = [str(Path(__file__).parents[2])]

import pbdkit

METHODS = ("auto", "lu", "multigrid", "conjugate-gradients")
CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.longdouble)
REFINEMENTS = 60
RESOLVED = 1e-9
"""The relative accuracy of references."""


def cells_of(X: np.ndarray, lattice: dict[str, Any], columns: int, rows: int) -> np.ndarray:
    """(cell, corner): the particles of a grid's rectangles or triangles, counterclockwise."""
    number = np.arange(columns * rows)
    order = np.lexsort((number, X[:, 0].round(9), X[:, 1].round(9)))
    at = np.empty_like(number)
    at[number] = order
    row = order.reshape(rows, columns)
    a, b, c, d = row[:-1, :-1], row[:-1, 1:], row[1:, 1:], row[1:, :-1]
    if lattice["type"] != "hexagonal":
        return np.stack([each.ravel() for each in (a, b, c, d)], axis=1)
    found = []
    for j in range(rows - 1):
        right = X[row[j + 1, 0], 0] > X[row[j, 0], 0]  # the row above begins to the right
        for i in range(columns - 1):
            p, q, r, s = a[j, i], b[j, i], c[j, i], d[j, i]
            found += [(p, q, s), (q, r, s)] if right else [(p, q, r), (p, r, s)]
    return np.array(found)


def cell_stiffness(corners: np.ndarray, nu: float) -> np.ndarray:
    """(corner, axis, corner, axis) of modulus 1: mean strain over the cell, and in rectangles the
    stiffness of the displacement that it does not see."""
    nu = np.longdouble(nu)
    shear = (1 - nu) / 2
    C = np.array([[1, nu, 0], [nu, 1, 0], [0, 0, shear]]) / (1 - nu * nu)
    if len(corners) == 4:
        sides = corners[2] - corners[0]
        gradient, area = CORNERS / (2 * sides), sides.prod()
    else:
        (x1, y1), (x2, y2), (x3, y3) = corners
        double = (x2 - x1) * (y3 - y1) - (x3 - x1) * (y2 - y1)
        gradient = np.array([[y2 - y3, x3 - x2], [y3 - y1, x1 - x3], [y1 - y2, x2 - x1]]) / double
        area = double / 2
    B = np.zeros((3, len(corners), 2), np.longdouble)
    B[0, :, 0] = B[2, :, 1] = gradient[:, 0]
    B[1, :, 1] = B[2, :, 0] = gradient[:, 1]
    K = area * np.einsum("ima,ij,jnb->manb", B, C, B)
    if len(corners) == 4:
        a, b = sides
        alternating = CORNERS.prod(axis=1)
        own = C[2, 2] * (a / b + b / a) / 4
        K = K + own * np.einsum("m,n,ab->manb", alternating, alternating, np.eye(2))
    return K


class Reference:
    """The assembled system of a run's body: cells of these stiffnesses."""

    def __init__(self, X: np.ndarray, cells: np.ndarray, nu: float, stiffness: np.ndarray) -> None:
        self.X, self.cells = X.astype(np.longdouble), cells
        shapes: dict[bytes, np.ndarray] = {}
        each = []
        for cell in cells:
            corners = self.X[cell] - self.X[cell[0]]
            key = corners.astype(float).round(9).tobytes()
            if key not in shapes:
                shapes[key] = cell_stiffness(corners, nu)
            each.append(shapes[key])
        self.K = np.array(each) * stiffness.astype(np.longdouble)[:, None, None, None, None]

    def forces(self, u: np.ndarray) -> np.ndarray:
        """(particle, axis): what particles need to stay at displacements; by differences of these,
        so that rigid motions cost nothing."""
        out = np.zeros_like(u)
        about = u[self.cells] - u[self.cells[:, :1]]
        np.add.at(out, self.cells, np.einsum("cmanb,cnb->cma", self.K, about))
        return out

    def solve(self, led: np.ndarray, u: np.ndarray, load: np.ndarray) -> np.ndarray | None:
        """The displacements with components `led` (particle, axis) at `u`; None where it does not
        become accurate."""
        from scipy.sparse import coo_array
        from scipy.sparse.linalg import splu

        size = self.X.size
        dof = (2 * self.cells[:, :, None] + np.arange(2)).reshape(len(self.cells), -1)
        n = dof.shape[1]
        rows, columns = np.repeat(dof, n, axis=1).ravel(), np.tile(dof, (1, n)).ravel()
        values = self.K.reshape(len(self.K), -1).astype(float).ravel()
        whole = coo_array((values, (rows, columns)), (size, size)).tocsr()
        free = np.flatnonzero(~led.ravel())
        own = whole[free][:, free]
        scale = 1.0 / np.sqrt(own.diagonal())
        factors = splu((own.multiply(scale[:, None]).multiply(scale)).tocsc())
        x = np.where(led, u, 0.0).astype(np.longdouble)
        for _ in range(REFINEMENTS):
            r = (load - self.forces(x)).ravel()[free]
            far = float(np.abs(r).max()) or 1.0
            step = scale * factors.solve(scale * (r / far).astype(float)) * far
            x.ravel()[free] += step
            if np.abs(step).max() <= RESOLVED * np.abs(x).max():
                return x.astype(float)
        return None


def scene(rng: np.random.Generator, longest: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """An experiment, and the data of it that the reference uses."""
    kind = str(rng.choice(["square", "rectangular", "hexagonal"]))
    columns = int(min(longest, np.exp(rng.uniform(np.log(8), np.log(longest + 1)))))
    rows = int(rng.integers(2, 7))
    a = float(2.0 ** rng.integers(-20, 21)) if rng.random() < 0.3 else 1.0
    lattice: dict[str, Any] = {"type": kind, "a": a}
    height = a
    if kind == "rectangular":
        lattice["b"] = height = a * float(rng.choice([0.5, 1.0, 2.0]))
    nu = float(rng.choice([0.0, 0.3, 0.45, -0.5, round(rng.uniform(-0.9, 0.49), 3)]))
    soft = float(10.0 ** -rng.uniform(0, 9)) if rng.random() < 0.7 else 1.0
    begin = int(rng.integers(0, columns - 1))
    end = int(rng.integers(begin + 1, columns))
    neighbours = {"type": "coordination" if kind == "hexagonal" else "chebyshev", "shells": 1}
    rule: dict[str, Any] = {"type": "elastic", "poisson_ratio": nu}
    experiment: dict[str, Any] = {
        "name": "slender",
        "lattice": lattice,
        "body": {"type": "grid", "columns": columns, "rows": rows},
        "neighbours": neighbours,
        "rule": rule,
        "frame": {"type": "natural"},
        "steps": 1,
        "diagnostics": [{"type": "displacement"}],
    }
    layer = None
    if soft < 1.0 and kind != "hexagonal":
        layer = begin * a, end * a
        experiment["regions"] = {
            "soft": {
                "type": "rectangle",
                "width": (end - begin) * a,
                "height": 4 * rows * height,
                "origin": [begin * a, -rows * height],
            }
        }
        rule["stiffness"] = {"otherwise": 1.0, "soft": soft}
    supports = str(rng.choice(["clamped", "clamped", "clamped", "sliding", "free"]))
    hold = {"select": {"edge": "left"}, "motion": {"type": "hold"}}
    if supports == "sliding":
        hold["axes"] = [str(rng.choice(["x", "y"]))]
    experiment["leaders"] = [] if supports == "free" else [hold]
    force = (a * 10.0 ** -rng.uniform(3, 12) * rng.normal(size=2)).tolist()
    tip = {"nearest": [[(columns - 1) * a, 0.0]]}
    experiment["loads"] = [{"select": tip, "force": force}]
    if supports != "clamped" and rng.random() < 0.7:
        if supports == "free":
            force[1] = 0.0  # no moment is left
        back = [-f for f in force]
        if supports == "sliding":
            axis = "xy".index(hold["axes"][0])
            back[axis] = 0.0
        where = tip if supports == "sliding" else {"nearest": [[0.0, 0.0]]}
        if rng.random() < 0.5:
            experiment["loads"].append({"select": where, "force": back})
    if supports == "clamped" and rng.random() < 0.3:
        way = (a * rng.normal(size=2)).tolist()
        pulled = {"select": {"edge": "right"}, "motion": {"type": "displace", "displacement": way}}
        experiment["leaders"].append(pulled)
        experiment["loads"] = []
    solver = {"type": "equilibrium", "method": str(rng.choice(METHODS))}
    experiment["solver"] = solver | {"tolerance": float(10.0 ** -rng.uniform(2, 8))}
    return experiment, {"nu": nu, "soft": soft, "layer": layer, "supports": supports}


def trial(experiment: dict[str, Any], known: dict[str, Any]) -> str:
    """Return the outcome as a text; it begins with "differs" if it is wrong."""
    method, supports = experiment["solver"]["method"], known["supports"]
    try:
        ds = pbdkit.run(experiment, progress=False)
    except pbdkit.DivergedError:
        return f"{supports}, {method}: unconverged"
    except pbdkit.ExperimentError as error:
        drifts = "is loaded, but not constrained" in str(error)
        if supports == "clamped":
            return f"{supports}: too soft" if not drifts else f"differs: refused, {error}"
        return f"{supports}: pushed on for ever" if drifts else f"{supports}: refused"
    error_bound = json.loads(ds.attrs["certificate"])
    u, X = ds.u.values[-1], ds.reference.values
    if supports == "free" and experiment["loads"]:
        loads = [np.array(load["force"]) for load in experiment["loads"]]
        if np.abs(sum(loads)).max() > 1e-9 * np.abs(loads).max():
            return "differs: pushed on for ever, and accepted"
    off = error_of(experiment, known, X, u)
    if off is None:
        return f"{supports}: no reference"
    ratio = off / error_bound["distance"] if off else 0.0
    ok = ratio <= 1.0 or off <= 1e-10 * np.abs(u).max()
    return f"{supports}, {error_bound['method']}: within" if ok else (
        f"differs: {error_bound['method']}, {error_bound['bound']}, {ratio:.3g} times beyond"
    )  # fmt: skip


def error_of(experiment: dict[str, Any], known: dict[str, Any], X: Any, u: Any) -> float | None:
    """The largest distance from the reference; what is free is compared where it has come to."""
    body = experiment["body"]
    cells = cells_of(X, experiment["lattice"], body["columns"], body["rows"])
    middle = X[cells].mean(axis=1)[:, 0]
    stiffness = np.ones(len(cells))
    if known["layer"]:
        low, high = known["layer"]
        stiffness[(middle > low) & (middle < high)] = known["soft"]
    reference = Reference(X, cells, known["nu"], stiffness)
    led, at = np.zeros(X.shape, bool), np.zeros(X.shape)
    left, right = edges(X, body["columns"], body["rows"])
    for group in experiment["leaders"]:
        some = left if group["select"]["edge"] == "left" else right
        for axis in ("xy".index(each) for each in group.get("axes", "xy")):
            led[some, axis] = True
            at[some, axis] = group["motion"].get("displacement", (0.0, 0.0))[axis]
    load = np.zeros(X.shape, np.longdouble)
    for each in experiment["loads"]:
        apart = np.hypot(*(X - np.array(each["select"]["nearest"][0])).T)
        load[np.argmin(apart)] += np.array(each["force"])
    if known["supports"] == "free":
        first, last = int(left[0]), int(right[0])
        led[first] = led[last, 1] = True
        at[first], at[last, 1] = u[first], u[last, 1]
    if known["supports"] == "sliding":
        held = int(np.flatnonzero(led.any(axis=0))[0])
        n = int(left[0])
        led[n, 1 - held], at[n, 1 - held] = True, u[n, 1 - held]
    found = reference.solve(led, at, load)
    if found is None:
        return None
    return float(np.hypot(*(found - u).T).max())


def edges(X: np.ndarray, columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """The particles of the first and of the last column."""
    order = np.lexsort((X[:, 0].round(9), X[:, 1].round(9))).reshape(rows, columns)
    return order[:, 0], order[:, -1]


def main() -> int:
    """Count the outcomes of the trials."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--longest", type=int, default=300)
    asked = parser.parse_args()
    warnings.simplefilter("ignore", pbdkit.PbdkitWarning)
    found: collections.Counter[str] = collections.Counter()
    for n in range(asked.trials):
        experiment, known = scene(np.random.default_rng([asked.seed, n]), asked.longest)
        what = trial(experiment, known)
        found[what.partition(":")[0] if what.startswith("differs") else what] += 1
        if what.startswith("differs"):
            print(n, what, json.dumps(experiment), flush=True)
    for what, count in sorted(found.items()):
        print(f"{what:48} {count}")
    return 1 if found["differs"] else 0


if __name__ == "__main__":
    sys.exit(main())
