"""Two ways to the linear system of a scene: stencils with multigrid, and a matrix with factors."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import pbdkit
from pbdkit.equilibrium.krylov import best_of
from pbdkit.equilibrium.lattice_system import SlowMode, lattice_system
from pbdkit.equilibrium.sparse import MatrixSystem
from pbdkit.equilibrium.stencil_matrix import (
    LED,
    StencilMatrix,
    differenced_matrix,
    stencil_matrix,
)
from pbdkit.equilibrium.system import Moves, random_displacements
from pbdkit.progress import Watch
from pbdkit.scene.scene import build_scene
from pbdkit.stepping.state import initial_state
from tests.equilibrium.test_multigrid import PULL, SCENES, Skew, elastic, sheet

pytest.importorskip("numba")
SMALL = {"type": "grid", "columns": 30, "rows": 14}
LINEAR = {
    name: SCENES[name] | {"body": SMALL}
    for name in ("elastic", "rectangular", "hexagonal", "oblique", "mirror")
}
LINEAR["a rule of one's own"] = sheet(rule=Skew(), frame={"type": "none"}, body=SMALL)
LINEAR["barycentre"] = SCENES["barycentre of eight, free"] | {"body": SMALL}

LINEAR["a soft body with an inclusion"] = SCENES["elastic"] | {
    "body": SMALL,
    "rule": elastic(stiffness={"otherwise": 1e-9, "inner": 4e-9}),
    "regions": {"inner": {"type": "disc", "centre": [14.0, 6.0], "radius": 3.4}},
}
ON_ROLLERS = {
    "select": {"box": [5.5, -1.0, 20.5, 0.5]}, "motion": {"type": "hold"}, "axes": ["y"],
}  # fmt: skip
GUIDED = {"on rollers": LINEAR["elastic"] | {"leaders": [*PULL, ON_ROLLERS]}}


def at_rest(given):
    """Return the scene and its state at rest."""
    scene = build_scene(pbdkit.Experiment(**given))
    state = initial_state(scene)
    return scene, replace(state, u=np.zeros_like(state.u))


def blocks(matrix: StencilMatrix, with_leaders: bool):
    """Return the stencils of all followers, (place, 9, 2, 2), and the scales, (place, 2, 2).
    Entries of leaders are zero unless `with_leaders`."""
    places = np.argwhere(matrix.code >= 0)
    code = matrix.code[tuple(places.T)]
    stencils = matrix.stencils[code].reshape(-1, 9, 2, 2).copy()
    for s in range(9):
        beside = tuple((places + np.array([s // 3 - 1, s % 3 - 1])).T)
        stencils[(matrix.kind[beside] == LED) & (not with_leaders), s] = 0.0
    return stencils, matrix.scale[code].reshape(-1, 2, 2)


@pytest.mark.parametrize("name", LINEAR)
def test_differences_of_moves_give_the_same_stencils_as_derivatives(name):
    """K of derivatives is the row scale times A of differences, except that frame points beside
    leaders are not part of K."""
    scene, rest = at_rest(LINEAR[name])
    derived = stencil_matrix(scene, rest, 1)
    differenced = differenced_matrix(scene, rest, 1, Moves(scene))
    np.testing.assert_array_equal(derived.code < 0, differenced.code < 0)
    np.testing.assert_array_equal(derived.kind, differenced.kind)
    assert (derived.code[derived.code >= 0] == 0).mean() > 0.5  # The most frequent stencil.
    with_leaders = scene.frame is None
    (K, scale), (A, ones) = (blocks(m, with_leaders) for m in (derived, differenced))
    np.testing.assert_array_equal(ones, np.broadcast_to(np.eye(2), ones.shape))
    expected = np.einsum("pij,psjk->psik", scale, A)
    np.testing.assert_allclose(K, expected, rtol=0, atol=1e-6 * np.abs(K).max())


def test_contributions_that_cancel_up_to_rounding_are_no_bonds():
    """At corners of a mirror frame, those of the diagonal neighbour and of its images cancel."""
    middle = {"select": {"box": [9.5, 4.5, 12.5, 8.5]}, "motion": {"type": "hold"}}
    mirrored = {"rule": {"type": "barycentre"}, "frame": {"type": "mirror"}}
    scene, rest = at_rest(sheet(**mirrored, body=SMALL, leaders=[middle]))
    displaced = replace(rest, u=random_displacements(scene, 100.0))
    matrices = (
        stencil_matrix(scene, rest, 1),
        differenced_matrix(scene, displaced, 1, Moves(scene)),
    )
    bonds = [blocks(matrix, False)[0].any(axis=(2, 3)) for matrix in matrices]
    np.testing.assert_array_equal(*bonds)
    assert bonds[0].sum(axis=1).min() == 3


TOLERANCE = 1e-9


def assert_near(found, exact):
    np.testing.assert_allclose(found, exact, rtol=0, atol=10 * TOLERANCE * np.abs(exact).max())


def longest(u):
    return np.sqrt((u**2).sum(axis=0)).max()


@pytest.mark.parametrize("name", LINEAR | GUIDED)
def test_solutions_by_grids_are_those_of_the_matrix(name):
    """Both systems are A c = moves(0) - moves(c), and grids take few iterations. Transposed
    solutions satisfy λ · moves = weights · c."""
    scene, rest = at_rest((LINEAR | GUIDED)[name])
    grids = lattice_system(scene, rest, 1, Watch())
    assert grids.methods.startswith("multigrid")
    assert grids.iterations == 0
    moves, exact = Moves(scene), random_displacements(scene, 1.0)
    weights = exact[::-1].copy()
    still, moved = (moves.at(replace(rest, u=u.copy()), 1) for u in (rest.u, exact))
    load, near = still - moved, [0.3 * exact + 0.1 * weights, weights]
    for system in (grids, MatrixSystem(scene, rest, "lu", Watch(), 1)):
        assert_near(system.solve(load, TOLERANCE), exact)
        assert system.iterations <= 18
        assert_near(system.answer(load, TOLERANCE), exact)
        before = system.iterations
        assert_near(system.answer(load, TOLERANCE, near), exact)
        assert system.iterations - before <= 4
        assert system.mismatch(exact, still, moved) <= 1e-9
        assert system.mismatch(exact, still, still) == pytest.approx(1.0)
        product = (system.solve_transposed(weights, TOLERANCE) * load).sum()
        assert product == pytest.approx((weights * exact).sum(), rel=1e-7)
        assert system.is_stable()


@pytest.mark.parametrize("name", LINEAR)
def test_bounds_of_both_systems_are_near_the_distance(name):
    """The effect of rounding is that of moves of this size, up to their signs."""
    scene, rest = at_rest(LINEAR[name])
    grids, factors = (
        lattice_system(scene, rest, 1, Watch()),
        MatrixSystem(scene, rest, "lu", Watch(), 1),
    )
    force = np.where(random_displacements(scene, 1.0) != 0.0, 1.0, 0.0)
    length = longest(factors.solve(force, TOLERANCE))
    for system, excess in ((grids, 1.2), (factors, 1.5)):
        bound = system.distance(force, 0.0)
        assert length * (1 - 1e-9) <= bound <= excess * length
        by_rounding = system.distance(force, 1.0) - bound
        assert 0.15 * length <= by_rounding <= 1.25 * excess * length
    for _ in range(2):  # The bound does not depend on earlier ones.
        assert grids.distance(force, 0.0) == pytest.approx(grids.distance(0.5 * force, 0.0) * 2)


@pytest.mark.parametrize("name", LINEAR)
def test_the_slowest_mode_is_estimated_on_coarser_grids(name):
    scene, rest = at_rest(LINEAR[name])
    grids, factors = (
        lattice_system(scene, rest, 1, Watch()),
        MatrixSystem(scene, rest, "lu", Watch(), 1),
    )
    mode = SlowMode(random_displacements(scene, 1.0), 1.0)
    for _ in range(40):
        mode = mode.improved(factors, 1e-9)
    estimate = grids.slowest()
    assert mode.slowness / 4 <= estimate.slowness <= mode.slowness * 4
    if "conjugate" in grids.methods:
        better = estimate.improved(grids, 1e-3).improved(grids, 1e-3)
        assert better.slowness == pytest.approx(mode.slowness, rel=5e-3)


@pytest.mark.parametrize("name", LINEAR)
def test_displacements_of_leaders_cause_the_moves_of_the_scene(name):
    """The coupling is stored unless frame points or several sites of a cell take part."""
    scene, rest = at_rest(LINEAR[name])
    led = np.zeros_like(rest.u).reshape(2, -1)
    for leading in scene.leading:
        led[:, leading.place] = np.random.default_rng(0).normal(size=(2, len(leading.place)))
    led, moves = led.reshape(rest.u.shape), Moves(scene)
    found = lattice_system(scene, rest, 1, Watch()).pushed_by(led)
    if name in ("oblique", "mirror", "hexagonal"):
        assert found is None
        return
    still, moved = (moves.at(replace(rest, u=u.copy()), 1) for u in (rest.u, led))
    np.testing.assert_allclose(found, moved - still, rtol=0, atol=1e-12)


def test_constrained_components_have_no_coupling_to_leaders():
    scene, rest = at_rest(GUIDED["on rollers"])
    assert lattice_system(scene, rest, 1, Watch()).pushed_by(rest.u) is None


def test_a_floating_body_is_solved_up_to_its_rigid_body_modes():
    """Moves of at most 1 cause no larger displacements than rounding errors of 1, and both add."""
    scene, rest = at_rest(sheet(9, 6, leaders=[]))
    moves, exact = Moves(scene), random_displacements(scene, 1.0)
    still, moved = (moves.at(replace(rest, u=u.copy()), 1) for u in (rest.u, exact))
    system = MatrixSystem(scene, rest, "lu", Watch(), 1)
    found = system.solve(still - moved, TOLERANCE)
    np.testing.assert_allclose(moves.at(replace(rest, u=found), 1), moved, atol=1e-10)
    by_moves, by_rounding = system.distance(moved, 0.0), system.distance(rest.u, 1.0)
    assert 0.0 < by_moves <= by_rounding
    assert system.distance(moved, 1.0) == pytest.approx(by_moves + by_rounding)


@pytest.mark.parametrize("count", [0, 1, 3])
@pytest.mark.parametrize("size", [1e-8, 1.0, 1e8])
def test_the_start_of_an_iteration_leaves_a_residual_orthogonal_to_its_fields(count, size):
    """The fields may have any sizes."""
    generator = np.random.default_rng(count)
    root = generator.normal(size=(12, 12))
    K = root @ root.T + np.eye(12)
    krylov = SimpleNamespace(product=lambda v: K @ v, dot=lambda v, w: float(v @ w))
    fields = [scale * generator.normal(size=12) for scale in size ** np.arange(1.0, 1 + count)]
    b = generator.normal(size=12)
    residual = b.copy()
    x = best_of(krylov, fields, residual) + np.zeros(12)
    np.testing.assert_allclose(residual, b - K @ x, atol=1e-9)
    for field in fields:
        assert abs(field @ residual) <= 1e-9 * np.linalg.norm(field)
