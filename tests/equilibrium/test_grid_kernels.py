"""The loops over grids, executed by Python, against dense matrices."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from types import FunctionType
from typing import Any

import numpy as np
import pytest
from interpreted_kernels import interpreting
from scipy.ndimage import label

from pbdkit.equilibrium import grid_kernels
from pbdkit.equilibrium.multigrid import coarser_size
from pbdkit.equilibrium.stencil_matrix import FREE, LED, OUTSIDE, StencilMatrix
from tests.equilibrium.test_stencil_matrix import dense, random_matrix

HALVED = [(1, 1), (1, 0), (0, 1)]


@pytest.fixture(scope="module")
def kernels() -> Iterator[Any]:
    """The functions without compilation."""
    spec = importlib.util.spec_from_file_location("plain_grid_kernels", grid_kernels.__file__)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    with interpreting():
        spec.loader.exec_module(module)
        yield module


def grid_of(kernels: Any, matrix: StencilMatrix) -> Any:
    rows, size = len(matrix.code), matrix.code.size
    first, lone = np.zeros(rows + 1, int), np.zeros(rows + 1, int)
    begin, end, place, which = (np.zeros(size, int) for _ in range(4))
    kernels.runs(matrix.code, first, begin, end, lone, place, which)
    inverses = np.linalg.inv(matrix.stencils[:, 4].reshape(-1, 2, 2)).reshape(-1, 4)
    same = tuple(tuple(row) for row in matrix.stencils[0].reshape(3, 12))
    return kernels.Grid(
        first, begin, end, lone, place, which, same, matrix.stencils, inverses[0], inverses
    )


def field(matrix: StencilMatrix, seed: int) -> Any:
    """Random values at free places, (axis, row, place)."""
    values = np.random.default_rng(seed).normal(size=(2, *matrix.code.shape))
    return values * (matrix.code >= 0)


def flat(matrix: Any, values: Any) -> Any:
    """Values at free places in the order of the dense matrix."""
    return values[:, matrix.code >= 0].T.ravel()


def separate(seed: int) -> StencilMatrix:
    """A matrix in which each place has a stencil of its own."""
    matrix = random_matrix(seed)
    free = matrix.code >= 0
    code = np.where(free, np.cumsum(free).reshape(free.shape), -1).astype(np.int32)
    stencils = np.random.default_rng(seed).normal(size=(int(free.sum()) + 1, 9, 4))
    return StencilMatrix(code, matrix.kind, stencils, stencils[:, 4], None, None)


@pytest.mark.parametrize("seed", range(2))
def test_products_and_relaxation_are_those_of_the_dense_matrix(kernels: Any, seed: int) -> None:
    matrix = random_matrix(seed)
    grid, K = grid_of(kernels, matrix), dense(matrix)
    x, b = field(matrix, 1), field(matrix, 2)
    out, sums = np.zeros_like(x), np.zeros(len(matrix.code))
    kernels.product(grid, x, out, sums)
    np.testing.assert_allclose(flat(matrix, out), K @ flat(matrix, x), atol=1e-12)
    np.testing.assert_allclose(sums, (x * out).sum(axis=(0, 2)), atol=1e-12)
    row = np.repeat(np.argwhere(matrix.code >= 0)[:, 0], 2)
    inverse = np.zeros_like(K)
    for n in range(0, len(K), 2):
        inverse[n : n + 2, n : n + 2] = np.linalg.inv(K[n : n + 2, n : n + 2])
    for start, upwards in ((False, False), (False, True), (True, False), (True, True)):
        found, exact = x.copy(), flat(matrix, x) * (not start)
        kernels.relax(grid, b, found, 0.7, start, upwards)
        for parity in (1, 0) if upwards else (0, 1):
            step = 0.7 * inverse @ (flat(matrix, b) - K @ exact)
            exact = exact + np.where(row % 2 == parity, step, 0.0)
        np.testing.assert_allclose(flat(matrix, found), exact, rtol=1e-9, atol=1e-9)
    S = np.random.default_rng(3).normal(size=(len(matrix.stencils), 4))
    kernels.scaled(grid, tuple(S[0]), S, x, out)
    each = S[np.maximum(matrix.code, 0)].reshape(*matrix.code.shape, 2, 2)
    np.testing.assert_allclose(
        flat(matrix, out), flat(matrix, np.einsum("ijab,bij->aij", each, x)), atol=1e-12
    )


@pytest.mark.parametrize("halved", HALVED, ids=str)
@pytest.mark.parametrize("seed", range(2))
def test_coarse_matrices_are_those_of_galerkin(kernels: Any, halved: Any, seed: int) -> None:
    """P interpolates linearly between coarse places. Restriction is Pᵀ, and the coarse stencils
    are those of PᵀK P."""
    matrix = random_matrix(seed)
    grid, K = grid_of(kernels, matrix), dense(matrix)
    shape = [
        coarser_size(n) if half else n for n, half in zip(matrix.code.shape, halved, strict=True)
    ]
    kind, code = np.zeros(shape, np.int8), np.zeros(shape, np.int32)
    kernels.coarse_kinds(matrix.kind, halved, kind)
    count = kernels.coarse_codes(matrix.code, kind, halved, code)
    stencils = np.zeros((count + 1, 9, 4))
    kernels.galerkin(matrix.code, matrix.stencils, code, halved, stencils)
    coarse = StencilMatrix(code, kind, stencils, stencils[:, 4], None, None)
    places = np.argwhere(code >= 0)
    fine = np.argwhere(matrix.code >= 0)
    P = np.zeros((2 * len(fine), 2 * len(places)))
    for n, (row, place) in enumerate(places):
        for axis in range(2):
            unit, x = np.zeros((2, *shape)), np.zeros((2, *matrix.code.shape))
            unit[axis, row, place] = 1.0
            kernels.prolong(*grid[:5], unit, halved, x)
            P[:, 2 * n + axis] = flat(matrix, x)
            assert not x[:, matrix.code < 0].any()
        at = np.where(halved, 2 * np.array([row, place]) - 1, [row, place])
        share = np.maximum(1.0 - np.abs(fine - at) / (1 + np.array(halved)), 0.0)
        share = np.where(np.array(halved) == 1, share, fine == at).prod(axis=1)
        np.testing.assert_allclose(P[::2, 2 * n], share, atol=1e-12)
    b, x = field(matrix, 4), field(matrix, 5)
    out = np.zeros((2, *shape))
    kernels.restrict(grid, b, x, halved, code, out)
    exact = P.T @ (flat(matrix, b) - K @ flat(matrix, x))
    np.testing.assert_allclose(flat(coarse, out), exact, atol=1e-10)
    whole, found = P.T @ K @ P, dense(coarse)
    own = np.repeat(code[code >= 0] > 0, 2)
    np.testing.assert_allclose(found[own], whole[own], atol=1e-10)
    np.testing.assert_allclose(P.sum(axis=1)[np.repeat(beside_body(kind, fine, halved), 2)], 1.0)


def beside_body(kind: Any, fine: Any, halved: Any) -> Any:
    """Return whether all coarse places around fine places are free."""
    result = np.ones(len(fine), bool)
    for down in (0, 1):
        for along in (0, 1):
            low = np.where(halved, (fine + 1) // 2, fine)
            high = np.where(halved, fine // 2 + 1, fine)
            row, place = np.where([down, along], high, low).T
            result &= kind[row, place] == 1
    return result


@pytest.mark.parametrize("halved", HALVED, ids=str)
@pytest.mark.parametrize("seed", range(3))
def test_coarse_places_have_the_kind_of_the_nearest_places(
    kernels: Any, halved: Any, seed: int
) -> None:
    """Among the places of which values are interpolated from a coarse place; if a free place and a
    leader are equally near, the coarse place is free."""
    kind = random_matrix(seed, 0.6).kind
    shape = [coarser_size(n) if half else n for n, half in zip(kind.shape, halved, strict=True)]
    out = np.zeros(shape, np.int8)
    kernels.coarse_kinds(kind, halved, out)
    body = np.argwhere(kind != OUTSIDE)
    for n, m in np.argwhere(np.pad(np.ones(np.array(shape) - 2), 1)):
        at = np.where(halved, 2 * np.array([n, m]) - 1, [n, m])
        away = np.abs(body - at)
        near = (away <= halved).all(axis=1)
        kinds = kind[tuple(body[near].T)]
        distance = away[near].sum(axis=1)
        nearest = kinds[distance == distance.min(initial=9)]
        expected = OUTSIDE if not len(nearest) else FREE if FREE in nearest else LED
        assert out[n, m] == expected


def test_uniform_bodies_keep_one_stencil(kernels: Any) -> None:
    """The next grid has the most frequent stencil where all stencils around a place have it."""
    code = np.full((10, 24), -1, np.int32)
    code[1:-1, 1:-1] = 0
    kind = (code >= 0).astype(np.int8)
    code[4, 5] = 1
    for halved in HALVED:
        shape = [coarser_size(n) if half else n for n, half in zip(code.shape, halved, strict=True)]
        coarse_kind, coarse = np.zeros(shape, np.int8), np.zeros(shape, np.int32)
        kernels.coarse_kinds(kind, halved, coarse_kind)
        count = kernels.coarse_codes(code, coarse_kind, halved, coarse)
        assert ((coarse >= 0) == (coarse_kind == 1)).all()
        assert sorted(coarse[coarse > 0]) == [*range(1, count + 1)]
        stencils = np.random.default_rng(0).normal(size=(2, 9, 4))
        out = np.zeros((count + 1, 9, 4))
        kernels.galerkin(code, stencils, np.where(coarse == 0, count + 1, coarse), halved,
                         out := np.zeros((count + 2, 9, 4)))  # fmt: skip
        for row, place in np.argwhere(coarse == 0):
            single = np.zeros((2, 9, 4))
            only = np.full(shape, -1, np.int32)
            only[row, place] = 1
            kernels.galerkin(code, stencils, only, halved, single)
            np.testing.assert_allclose(
                single[1], out[count + 1] / (coarse == 0).sum(), rtol=1e-10, atol=1e-12
            )


@pytest.mark.parametrize("seed", range(2))
def test_asymmetry_symmetric_part_and_balance(kernels: Any, seed: int) -> None:
    matrix = separate(seed)
    K = dense(matrix)
    assert kernels.asymmetry(matrix.code, matrix.stencils) == pytest.approx(abs(K - K.T).max())
    mixed = random_matrix(seed)
    assert kernels.asymmetry(mixed.code, mixed.stencils) <= abs(dense(mixed) - dense(mixed).T).max()
    kernels.symmetrise(matrix.code, matrix.stencils)
    np.testing.assert_allclose(dense(matrix), (K + K.T) / 2, atol=1e-14)
    assert kernels.asymmetry(matrix.code, matrix.stencils) == 0.0
    for row, place in np.argwhere(matrix.code >= 0):
        for s in range(9):
            if s != 4 and matrix.code[row + s // 3 - 1, place + s % 3 - 1] >= 0:
                entry = matrix.stencils[matrix.code[row, place], s]
                entry[s % 4] += 0.5
                assert kernels.asymmetry(matrix.code, matrix.stencils) == pytest.approx(0.5)
                entry[s % 4] -= 0.5
    share = np.random.default_rng(7).uniform(0.5, 2.0, matrix.code.shape)
    for row, place in np.argwhere(matrix.code >= 0):
        matrix.stencils[matrix.code[row, place]] /= share[row, place]
    factor = np.zeros(matrix.code.shape)
    known = tuple(np.argwhere(matrix.code >= 0)[5])
    factor[known] = share[known]
    missing, before = kernels.balance(matrix.code, matrix.stencils, factor)
    assert before == (matrix.code >= 0).sum() - 1
    found = factor > 0.0
    assert missing == before + 1 - found.sum()
    parts, _ = label(matrix.code >= 0, np.ones((3, 3)))
    np.testing.assert_array_equal(found, parts == parts[known])
    np.testing.assert_allclose(factor[found], share[found], rtol=1e-10)


def test_asymmetry_of_the_most_frequent_stencil_is_found_beside_other_stencils(
    kernels: Any,
) -> None:
    """Entries differ between places with the most frequent stencil only."""
    code = np.full((8, 8), -1, np.int32)
    code[1:-1, 1:-1] = 0
    code[2, 2] = code[1, 2] = 1
    stencils = np.ones((2, 9, 4))
    stencils[0, 8, 1] = stencils[1, 0, 2] = 1.3
    matrix = StencilMatrix(code, (code >= 0).astype(np.int8), stencils, stencils[:, 4], None, None)
    assert abs(dense(matrix) - dense(matrix).T).max() == pytest.approx(0.3)
    assert kernels.asymmetry(code, stencils) == pytest.approx(0.3)


def test_vector_operations(kernels: Any) -> None:
    p, q, x, r = np.random.default_rng(2).normal(size=(4, 2, 3, 5))
    out, sums = np.zeros_like(x), np.full((2, 3), 9.0)
    new_x, new_r = x.copy(), r.copy()
    kernels.descend(-0.3, p, q, new_x, new_r, 0.5, out, sums)
    np.testing.assert_allclose(new_x, x - 0.3 * p)
    np.testing.assert_allclose(new_r, r + 0.3 * q)
    np.testing.assert_allclose(out, 0.5 * new_r)
    np.testing.assert_allclose(sums, [(new_r**2).sum(axis=(0, 2)), 0.3 * abs(p).max(axis=(0, 2))])
    new_p = p.copy()
    kernels.turn(0.5, q, 0.2, new_p)
    np.testing.assert_allclose(new_p, 0.5 * q + 0.2 * p)
    kernels.dot(p, q, sums[0])
    np.testing.assert_allclose(sums[0], (p * q).sum(axis=(0, 2)))
    still, moved = p.reshape(2, -1), q.reshape(2, -1)
    place, number = np.array([3, 7, 11]), np.array([0, 4, 8])
    stencils = np.zeros((3, 9, 2, 2))
    largest = kernels.differences(still, moved, place, number, 2.0, 1, stencils)
    entries = 2.0 * (still - moved)[:, place].T
    np.testing.assert_allclose(stencils[np.arange(3), number, :, 1], entries)
    assert largest == pytest.approx(abs(entries).max())
    limit = np.sort(abs(entries).max(axis=1))[1]
    kernels.clear_noise(stencils, limit)
    assert np.count_nonzero(stencils.any(axis=(1, 2, 3))) == 1
    single = np.zeros((4, 9, 2, 2))
    single.reshape(4, 9, 4)[range(4), 2, range(4)] = -1.0
    kernels.clear_noise(single, 0.9)
    assert np.count_nonzero(single) == 4


def test_run_compiles_every_function(kernels):
    """A function that is neither called by it nor named in a called function would be compiled
    later, during a calculation."""
    calls = set()
    sys.setprofile(lambda frame, event, _: calls.add(frame.f_code) if event == "call" else None)
    try:
        kernels.run()
    finally:
        sys.setprofile(None)
    functions = [value for value in vars(kernels).values() if isinstance(value, FunctionType)]
    code = {f.__name__: f.__code__ for f in functions if f.__module__ == kernels.__name__}
    compiled = {name for name in code if code[name] in calls}
    for _ in code:
        compiled |= {named for name in compiled for named in code[name].co_names if named in code}
    assert compiled == set(code)
