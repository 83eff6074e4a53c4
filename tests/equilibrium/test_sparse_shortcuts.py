"""Work that is done in one pass, once, or not at all, with the same result.

Derivatives, cut cells, kernels.
"""

import numpy as np
import pytest
from finite_elements.lattices import experiment
from finite_elements.problems import HEXAGONAL_BAR
from scipy import sparse

import pbdkit
from pbdkit.equilibrium import linear_solver as linear
from pbdkit.equilibrium.linear_solver import FEWEST, dissected
from pbdkit.lattice import fill as cut_cells
from pbdkit.linear.operator import step_operator
from pbdkit.linear.stencil import derivative
from pbdkit.scene.scene import build_scene


def plane(columns, rows, far=1):
    """(matrix, places): every place coupled with those up to `far` away along both axes, and a
    little more to the right than to the left."""
    i, j = (a.ravel() for a in np.indices((columns, rows)))
    number = np.arange(columns * rows).reshape(columns, rows)
    found = [(number.ravel(), number.ravel(), np.full(columns * rows, 9.0 * far))]
    for axis, place in enumerate((i, j)):
        for step in range(1, far + 1):
            first = np.flatnonzero(place < (columns, rows)[axis] - step)
            second = first + step * (rows, 1)[axis]
            found += [(first, second, np.full(len(first), -1.1)),
                      (second, first, np.full(len(first), -0.9))]  # fmt: skip
    row, column, value = (np.concatenate(part) for part in zip(*found, strict=True))
    return sparse.csr_array((value, (row, column))), np.stack([i, j], axis=1) * 0.1


@pytest.mark.parametrize("far", [1, 2])
def test_dissection_orders_uncrossed_separators_last(far):
    matrix, places = plane(60, 25, far)
    order = dissected(matrix, places)
    assert np.array_equal(np.sort(order), np.arange(len(places)))
    rank = np.argsort(order)
    # The first strip lies across the long side, in the middle: to its left and right nothing
    # couples with what lies on the other side.
    strip = order[-25 * far :]
    x = places[:, 0]
    low, high = x[strip].min(), x[strip].max()
    assert high - low == pytest.approx(0.1 * (far - 1))
    assert 2.5 < low < 3.5
    left, right = np.flatnonzero(x < low - 1e-9), np.flatnonzero(x > high + 1e-9)
    assert matrix[left][:, right].nnz == 0
    assert rank[strip].min() > max(rank[left].max(), rank[right].max())


def test_unknowns_of_one_site_stay_adjacent():
    matrix, places = plane(40, 30)
    both = sparse.csr_array(sparse.kron(matrix, np.ones((2, 2))))
    order = dissected(both, np.repeat(places, 2, axis=0))
    assert np.array_equal(order[0::2] + 1, order[1::2])
    assert np.array_equal(order[0::2] // 2, dissected(matrix, places))


def test_few_sites_and_far_couplings_are_not_dissected():
    assert dissected(*plane(FEWEST // 10, 10)) is None
    matrix, places = plane(60, 25)
    matrix = matrix.tolil()
    matrix[0, len(places) - 1] = 0.1
    assert dissected(matrix.tocsr(), places) is None


@pytest.mark.parametrize("shift", [0.0, 1e6], ids=["here", "far away"])
def test_dissected_factors_solve_both_systems_with_less_fill_in(shift):
    scene = build_scene(pbdkit.Experiment(**experiment(HEXAGONAL_BAR, 40)))
    operator = step_operator(scene)
    both = sparse.csr_array(sparse.eye_array(operator.current.shape[0]) - operator.current)
    places = scene.raster.reference(operator.followers) + shift
    plain = linear.SparseLU(both, symmetric=False)
    found = linear.SparseLU(
        both, symmetric=False, coordinates=linear.Coordinates(2, places, places[:0])
    )
    assert found._factors.nnz < 0.7 * plain._factors.nnz
    b = np.random.default_rng(0).normal(size=2 * len(places))
    for x, of in ((found.solve(b, 0.0), both), (found.solve_transposed(b, 0.0), both.T)):
        assert np.abs(of @ x - b).max() < 1e-10


def test_matrices_without_a_symmetric_pattern_are_detected():
    matrix, _ = plane(30, 20)
    assert linear.is_nearly_symmetric(matrix)
    assert not linear.is_nearly_symmetric(sparse.csr_array(sparse.triu(matrix)))


def test_derivatives_are_exact_if_analytic_otherwise_to_nine_digits():
    x, y = np.array([0.3, -0.7, 2.0]), np.array([1.5, -0.4, 0.9])
    root = np.sqrt(x * x + y * y)
    exact = derivative(lambda s: (np.sqrt((x + s) ** 2 + y * y), x / (y - 2 * s)), x.shape, 1.0)
    np.testing.assert_allclose(exact, [x / root, 2 * x / (y * y)], rtol=1e-15)
    close = derivative(lambda s: (np.abs(x + s), np.hypot(x, y + s)), x.shape, 1.0)
    np.testing.assert_allclose(close, [np.sign(x), y / root], rtol=1e-9)


BODIES = [
    {"type": "rectangle", "width": 2.0, "height": 1.03, "origin": [0.01, 0.02]},
    {"type": "ring", "inner": 0.3, "outer": 0.77, "centre": [0.1, 0.2]},
    {"type": "polygon", "vertices": [[0, 0], [2, 0.3], [1.7, 1.9], [0.8, 0.6], [0.1, 1.4]]},
    {"type": "dogbone", "length": 3, "width": 1, "gauge_length": 1, "gauge_width": 0.4,
     "radius": 0.5},
]  # fmt: skip


@pytest.mark.parametrize("lattice", ["square", "hexagonal"])
@pytest.mark.parametrize("body", BODIES, ids=lambda body: body["type"])
def test_uncut_cells_are_whole_or_outside(body, lattice, monkeypatch):
    """Shares are the same where far more cells are looked at."""
    near = "chebyshev" if lattice == "square" else "coordination"
    given = {
        "name": "cut",
        "lattice": {"type": lattice, "a": 0.1},
        "neighbours": {"type": near, "shells": 1},
        "body": body,
        "rule": {"type": "elastic", "poisson_ratio": 0.3},
        "frame": {"type": "natural"},
        "steps": 1,
    }
    found = build_scene(pbdkit.Experiment(**given)).cells.share
    if body["type"] != "dogbone":  # its distance contains more than that to its fillets
        monkeypatch.setattr(cut_cells, "NEAREST", 3.0)
    else:
        monkeypatch.setattr(cut_cells, "_width", lambda corners: 0.15)
    assert np.array_equal(found, build_scene(pbdkit.Experiment(**given)).cells.share)


def test_kernel_is_loaded_once_per_process(interpreted):
    pytest.importorskip("numba")
    from pbdkit.stepping.numba_engine.engine import CompiledStepper

    given = experiment(HEXAGONAL_BAR, 20, solver={"type": "stepping"})
    scene = build_scene(pbdkit.Experiment(**given))
    assert CompiledStepper(scene)._run is CompiledStepper(scene)._run
