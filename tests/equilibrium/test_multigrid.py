"""Equilibria on grids: any linear rule, how few iterations it takes, and what is certified."""

import json
from contextlib import contextmanager, nullcontext
from types import SimpleNamespace
from typing import ClassVar, Literal

import numpy as np
import pytest
from interpreted_kernels import interpreting
from scene_strategies import in_turn
from turning_frame import Turning

import pbdkit
from pbdkit.equilibrium import (
    linear_solver,
    linearise as linearisation,
    load_stepping as increments,
    multigrid,
    system as moves,
)
from pbdkit.equilibrium.load_stepping import equilibrate
from pbdkit.equilibrium.stencil_matrix import kernels
from pbdkit.plugin import FollowerRule, Vector
from pbdkit.scene import memory_estimate as solver_sizes
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.state import initial_state

pytest.importorskip("numba")
CHEBYSHEV = {"type": "chebyshev", "shells": 1}
HEXAGONAL = {
    "lattice": {"type": "hexagonal", "a": 1.0},
    "neighbours": {"type": "coordination", "shells": 1},
}
PULL = [
    {"select": {"edge": "left"}, "motion": {"type": "hold"}},
    {"select": {"edge": "right"}, "motion": {"type": "displace", "displacement": [1.0, 0.4]}},
]


class Skew(FollowerRule):
    """Leans to the right-hand neighbours, and lets x move y: a linear rule of its own."""

    type: Literal["skew"] = "skew"
    lean: float = 0.2

    linear: ClassVar[bool] = True

    @staticmethod
    def gather(d, r, w, p):
        """Weights by the direction of the bond."""
        weight = 1.0 + p.lean * r.x
        return weight * d, weight

    @staticmethod
    def apply(total, here, p):
        """The weighted mean, and a share of x in y."""
        move = total[0] / total[1]
        return Vector(move.x + 0.1 * move.y, move.y - 0.1 * move.x)


def elastic(poisson_ratio=0.3, **more):
    return {"type": "elastic", "poisson_ratio": poisson_ratio} | more


def sheet(n=40, rows=None, **parts):
    return {
        "version": 1,
        "name": "sheet",
        "lattice": {"type": "square", "a": 1.0},
        "body": {"type": "grid", "columns": n, "rows": rows or n - 9},
        "neighbours": CHEBYSHEV,
        "rule": elastic(),
        "frame": {"type": "natural"},
        "leaders": PULL,
        "steps": 1,
    } | parts


def disc(**parts):
    select = [{"box": [x, -20.0, x + 3.0, 20.0]} for x in (-14.2, 11.2)]
    motions = ({"type": "hold"}, {"type": "displace", "displacement": [0.6, 0.3]})
    leaders = [{"select": s, "motion": m} for s, m in zip(select, motions, strict=True)]
    body = {"type": "ring", "inner": 5.3, "outer": 14.1, "centre": [0.0, 0.0]}
    return sheet(**{"body": body, "leaders": leaders} | parts)


SCENES = {
    "elastic": sheet(),
    "auxetic": sheet(rule=elastic(-0.5)),
    "nearly incompressible": sheet(rule=elastic(0.45)),
    "rectangular": sheet(lattice={"type": "rectangular", "a": 3.0, "b": 1.0}),
    "hexagonal": sheet(**HEXAGONAL),
    "cut cells": disc(),
    "barycentre": sheet(rule={"type": "barycentre"}, frame={"type": "mean"}, neighbours={
        "type": "coordination", "shells": 1}),
    "barycentre of eight, free": sheet(rule={"type": "barycentre"}, frame={"type": "none"}),
    "oblique": sheet(
        lattice={"type": "oblique", "a": 1.0, "b": 0.9, "angle": 65.0},
        rule={"type": "mean-displacement"},
        frame={"type": "first"},
    ),
    "copying frame": sheet(frame={"type": "mean"}),
    "mirror": sheet(frame={"type": "mirror"}),
    "a rule of one's own": sheet(rule={"type": "skew"}, frame={"type": "none"}),
}  # fmt: skip


def solved(given, method="multigrid", tolerance=1e-8):
    """Return (u, error bound) of followers and leaders."""
    given = given | {"diagnostics": [{"type": "displacement"}]}
    given |= {"solver": {"type": "equilibrium", "method": method, "tolerance": tolerance}}
    found = pbdkit.run(given, components=[Skew], progress=False)
    return found.u.values[-1], json.loads(found.attrs["certificate"])


@pytest.mark.parametrize("name", in_turn(SCENES, 2))
def test_few_iterations_reach_the_error_bound(name):
    """The error bound is never below the true error, and near it; it is the same in a second run,
    to the bit."""
    exact, _ = solved(SCENES[name], "lu", 1e-11)
    for tolerance in (1e-3, 1e-8):
        u, error_bound = solved(SCENES[name], tolerance=tolerance)
        error = np.hypot(*(u - exact).T).max()
        assert error_bound["method"].startswith("multigrid, ")
        assert error <= error_bound["distance"] <= tolerance * 1.1
        assert error_bound["inner_iterations"] <= (24 if "conj" in error_bound["method"] else 60)
    again, _ = solved(SCENES[name], tolerance=tolerance)
    assert again.tobytes() == u.tobytes()


MORE = {
    "second neighbours": sheet(
        rule={"type": "barycentre"},
        neighbours={"type": "chebyshev", "shells": 2},
        frame={"type": "none"},
    ),
    "strain gradient": sheet(rule={"type": "strain-gradient", "poisson_ratio": 0.3, "length": 1.0}),
    "matrices of a frame": sheet(frame=Turning()),
}


@pytest.mark.parametrize("name", in_turn([*SCENES, *MORE], 2))
def test_without_numba_bilinear_grids_are_used(name, monkeypatch):
    given = (SCENES | MORE)[name]
    exact, _ = solved(given, "lu", 1e-11)
    monkeypatch.setattr(linearisation, "find_spec", lambda name: None)
    u, error_bound = solved(given)
    assert error_bound["method"].startswith("multigrid, ")
    assert np.hypot(*(u - exact).T).max() <= error_bound["distance"]


def cracked(n, cracks):
    """1 - P of a sheet of springs between four neighbours, held at both ends, without the bonds
    across cracks, each (row, first, last)."""
    sparse = pytest.importorskip("scipy.sparse")
    at = np.arange(n * n).reshape(n, n)
    bonds = [
        np.stack([at[:-1].ravel(), at[1:].ravel()]),
        np.stack([at[:, :-1].ravel(), at[:, 1:].ravel()]),
    ]
    for row, first, last in cracks:
        across = np.isin(bonds[0][0], at[row, first:last])
        bonds[0] = bonds[0][:, ~across]
    i, j = np.concatenate(bonds, axis=1)
    held = np.bincount(at[:, [0, -1]].ravel(), minlength=n * n)
    ones = np.ones(len(i))
    graph = sparse.coo_array((ones, (i, j)), (n * n, n * n))
    graph = (graph + graph.T).tocsr()
    return (sparse.diags_array(graph.sum(axis=1) + held) - graph).tocsr(), at


@pytest.mark.parametrize("cracks", ["half", "seven"])
def test_bilinear_interpolation_does_not_bridge_cracks(cracks):
    n = 90
    rows = [n // 2] if cracks == "half" else range(10, 80, 10)
    matrix, at = cracked(n, [(row, 0, n // 2 if cracks == "half" else n - 8) for row in rows])
    places = np.stack(np.unravel_index(at.ravel(), at.shape), axis=1).astype(float)
    led = np.array([(i, j) for i in range(n) for j in (-1.0, float(n))])
    coordinates = linear_solver.Coordinates(1, places, led)
    solver = linear_solver.linear_solver(matrix, "multigrid", coordinates=coordinates)
    b = np.random.default_rng(0).normal(size=n * n)
    x = solver.solve(b, 1e-8)
    assert np.linalg.norm(b - matrix @ x) <= 1e-7 * np.linalg.norm(b)
    assert solver.iterations <= 35


def test_method_depends_on_the_size(monkeypatch):
    monkeypatch.setattr(moves, "LARGEST_BY_NUMPY", 10**6)
    for n, method in ((12, "lu"), (160, "multigrid, conjugate-gradients")):
        scene = build_scene(pbdkit.Experiment(**sheet(n, n)))
        assert (scene.raster.count > solver_sizes.LARGEST_DIRECT) == (n > 100)
        assert equilibrate(scene, initial_state(scene)).method == method


NOT_LINEAR = {
    "springs": sheet(20, 5, rule={"type": "springs"}, **HEXAGONAL),
    "distance-weighted": sheet(20, rule={"type": "distance-weighted"}, frame={"type": "mean"}),
}


@contextmanager
def interpreted_moves():
    """The loops over grids are compiled, the moves of a scene are run by Python."""
    kernels()
    with interpreting():
        yield


@pytest.mark.parametrize("name", NOT_LINEAR)
def test_nonlinear_rules_are_solved_by_multigrid(name, monkeypatch):
    """Differences of compiled moves, of one rule really compiled, lead to the result of the direct
    solver."""
    exact, _ = solved(NOT_LINEAR[name], "lu", 1e-10)
    monkeypatch.setattr(moves, "LARGEST_BY_NUMPY", 0)
    with nullcontext() if name == "springs" else interpreted_moves():
        u, error_bound = solved(NOT_LINEAR[name], tolerance=1e-7)
    assert error_bound["method"].startswith("multigrid, ")
    assert np.hypot(*(u - exact).T).max() <= error_bound["distance"] <= 1.1e-7
    assert error_bound["iterations"] <= 6


def test_multigrid_detects_buckling(monkeypatch):
    monkeypatch.setattr(moves, "LARGEST_BY_NUMPY", 0)
    monkeypatch.setattr(increments, "MAX_ROUNDS", 2)
    push = {"type": "displace", "displacement": [-4.0, 0.0]}
    leaders = [PULL[0], {"select": {"edge": "right"}, "motion": push}]
    pressed = sheet(20, 5, rule={"type": "springs"}, leaders=leaders, **HEXAGONAL)
    with pytest.raises(pbdkit.DivergedError, match="branches into several equilibria"):
        solved(pressed)


@pytest.mark.parametrize("shape", [(40, 30), (40, 4), (4, 40), (4, 3)])
@pytest.mark.parametrize("stiffness", [(1.0, 1.0), (1.0, 100.0), (100.0, 1.0)])
def test_grids_are_halved_along_their_long_sides_and_stiff_couplings(shape, stiffness):
    """Relaxation smooths errors along stiff couplings only."""
    stencil = np.zeros((3, 3, 2, 2))
    for axis, k in enumerate(stiffness):
        ends = np.moveaxis(stencil, axis, 0)
        ends[0, 1] -= k * np.eye(2)
        ends[2, 1] -= k * np.eye(2)
        stencil[1, 1] += 2.0 * k * np.eye(2)
    grid = SimpleNamespace(stencils=stencil.reshape(1, 9, 2, 2), code=np.zeros(shape, np.int32))
    halved = multigrid.StencilGrid.halved(grid, shape[0])
    if min(shape) <= multigrid.MIN_PLACES:
        assert halved == (shape[0] > shape[1], shape[1] > shape[0])
    else:
        assert halved == tuple(k == max(stiffness) for k in stiffness)
