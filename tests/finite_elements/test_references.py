"""The references of tests/finite_elements: loader, error measure, and where they come from."""

import numpy as np
import pytest
from finite_elements.errors import load, relative_l2
from finite_elements.problems import BAR, CANTILEVER, HOLE, PROBLEMS

WHY = "finite-element references are recomputed with scikit-fem, of the group test"
KEPT = [(name, cells) for name, p in PROBLEMS.items() for cells in p.kept]
ELEMENTS = ("P1", "Q1", "P2", "Q2")


@pytest.fixture(scope="module")
def skfem():
    return pytest.importorskip("skfem", reason=WHY)


@pytest.mark.parametrize(("name", "cells"), KEPT)
def test_sites_match_the_lattice(name, cells):
    reference, problem = load(name, cells), PROBLEMS[name]
    columns, rows = reference.x.shape
    assert columns == problem.length * cells + 1
    row = np.sqrt(3) / 2 / cells if problem.hexagonal else 1 / cells
    shifts = np.arange(rows) % 2 / 2 if problem.hexagonal else np.zeros(rows)
    assert np.allclose(reference.x, (np.arange(columns)[:, None] + shifts) / cells)
    assert np.allclose(reference.y, np.arange(rows) * row)
    assert reference.y.max() == pytest.approx(problem.height)


@pytest.mark.parametrize(("name", "cells"), KEPT)
def test_every_body_site_and_no_other_has_a_displacement(name, cells):
    reference, problem = load(name, cells), PROBLEMS[name]
    middle = np.hypot(reference.x - problem.length / 2, reference.y - problem.height / 2)
    body = (reference.x < problem.length + 1e-9) & (middle > problem.radius - 1e-9)
    assert np.array_equal(np.isfinite(reference.u), np.stack([body, body]))


@pytest.mark.parametrize(("name", "cells"), KEPT)
def test_edges_are_held_as_specified(name, cells):
    reference, problem = load(name, cells), PROBLEMS[name]
    inside = np.isfinite(reference.u[0])
    left, right = (np.isclose(reference.x, x) & inside for x in (0, problem.length))
    assert np.abs(reference.u[:, left]).max() < 1e-12
    assert np.allclose(reference.u[problem.pulled][right], 1, rtol=0, atol=1e-12)
    assert np.allclose(reference.u[problem.across][right], 0, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", PROBLEMS)
def test_energy_is_half_the_work_of_the_right_edge_with_small_error(name):
    reference = load(name)
    assert reference.energy == pytest.approx(reference.reaction / 2, rel=1e-8)
    assert reference.error < 1e-6


@pytest.mark.parametrize(("name", "cells"), KEPT)
def test_relative_error_is_zero_for_the_reference_and_scales(name, cells):
    reference = load(name, cells)
    assert relative_l2(np.nan_to_num(reference.u, nan=7.0), reference) == 0
    assert relative_l2(1.25 * reference.u, reference) == pytest.approx(0.25)


def test_edge_sites_count_half_and_corner_sites_a_quarter():
    reference = load("bar", 10)
    assert reference.weights.sum() == pytest.approx(2 * 1 * 10**2)
    assert reference.weights[0, 0] == 0.25
    assert reference.weights[0, 5] == reference.weights[5, -1] == 0.5
    u = reference.u.copy()
    u[:, 0, 5] += [0.3, 0.4]
    norm = np.sqrt(np.sum(reference.weights * reference.u**2))
    assert relative_l2(u, reference) == pytest.approx(0.5 * np.sqrt(0.5) / norm)


def test_hexagonal_weights_equal_the_area():
    reference = load("hexagonal-bar", 20)
    cell = np.sqrt(3) / 2 / 20**2
    area = reference.problem.length * reference.problem.height
    assert reference.weights.sum() * cell == pytest.approx(area)


def test_other_lattices_and_shapes_are_refused():
    with pytest.raises(ValueError, match="bar: kept for 10, 20, 40, 80 cells per unit length, not"):
        load("bar", 30)
    with pytest.raises(ValueError, match=r"u: expected shape \(2, 21, 11\), got \(21, 11\)"):
        relative_l2(np.zeros((21, 11)), load("bar", 10))


def affine(points):
    """A displacement of uniform strain."""
    return np.array([[0.3, -0.1], [0.2, 0.4]]) @ points.reshape(2, -1)


def strained(skfem, basis):
    """The solution of which only the edges are held, as `affine` has it."""
    from finite_elements.elasticity import plane_stress

    exact = np.zeros(basis.N)
    for axis in (0, 1):
        dofs = basis.get_dofs(elements=True).all(f"u^{axis + 1}")
        exact[dofs] = affine(basis.doflocs[:, dofs])[axis]
    K = plane_stress().assemble(basis)
    held = basis.get_dofs().all()
    return skfem.solve(*skfem.condense(K, x=exact, D=held)), exact


@pytest.mark.parametrize("problem", [BAR, HOLE], ids=lambda p: p.name)
@pytest.mark.parametrize("element", [*ELEMENTS, "graded"])
def test_uniform_strain_is_exact(skfem, problem, element):
    from finite_elements import elasticity, graded, uniform

    if element == "graded":
        solution = graded.solve(problem, 4)
        basis = solution.basis
    else:
        basis = uniform.basis_of(problem, element, 4)
    u, exact = strained(skfem, basis)
    assert np.abs(u - exact).max() < 1e-12
    if element != "graded":
        points = np.array([[0.13, 0.5, 1.9], [0.2, 0.77, 0.4]])
        cells = elasticity.find(basis, points)
        assert np.allclose(elasticity.values(basis, u, points, cells), affine(points), atol=1e-12)


@pytest.mark.parametrize("problem", [BAR, CANTILEVER, HOLE], ids=lambda p: p.name)
def test_references_are_reproduced(skfem, problem):
    """A coarser graded mesh of the quarter, at the sites of the coarsest lattice."""
    from finite_elements.graded import solve

    reference, solution = load(problem.name, 10), solve(problem, 24)
    columns, rows = (n // 2 + 1 for n in reference.x.shape)
    x, y = (a[:columns, :rows] for a in (reference.x, reference.y))
    kept = reference.u[:, :columns, :rows]
    sites = np.isfinite(kept[0])
    assert np.abs(solution.at(x[sites], y[sites]) - kept[:, sites]).max() < 1e-4
    assert solution.reaction == pytest.approx(reference.reaction, rel=1e-4)


@pytest.mark.parametrize("problem", [BAR, CANTILEVER, HOLE], ids=lambda p: p.name)
def test_whole_bodies_on_uniform_meshes_converge_to_the_references(skfem, problem):
    """Mirrors and holds of the quarter are right, and so are its reaction and its unfolding."""
    from finite_elements.uniform import measure

    rough, fine = measure(problem, "Q2", (4, 12), repeats=1, cells=10)
    assert fine.error < min(rough.error / 3, 1e-3)
    assert fine.reaction == pytest.approx(load(problem.name).reaction, rel=2e-3)
    assert min(fine.assembly_s, fine.solve_s) > 0


def test_solvers_agree(skfem):
    pytest.importorskip("pyamg", reason="compares the solver that preconditions with pyamg")
    from finite_elements import uniform

    basis = uniform.basis_of(BAR, "P2", 12)
    K = uniform.plane_stress().assemble(basis)
    held, u = uniform._held(BAR, basis)
    direct, multigrid = (
        uniform._solved(solver, basis, K, held, u)
        for solver in (uniform._direct, uniform._multigrid)
    )
    assert np.abs(direct - multigrid).max() < 1e-6
