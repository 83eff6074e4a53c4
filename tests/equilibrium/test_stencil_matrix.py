"""Operations on matrices of stencils, against dense matrices and searches of connected parts."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import label

from pbdkit.equilibrium.multigrid import StencilGrid
from pbdkit.equilibrium.stencil_matrix import (
    FREE,
    LED,
    OUTSIDE,
    WINDOW,
    StencilMatrix,
    is_held,
    leads_one_way,
    transposed,
)

STEPS = [(s // 3 - 1, s % 3 - 1) for s in range(WINDOW)]


def random_matrix(seed: int, holes: float = 0.2) -> StencilMatrix:
    """A third of the free places have stencils of their own, the others the most frequent one."""
    rng = np.random.default_rng(seed)
    kind = np.full((9, 10), OUTSIDE, np.int8)
    kind[1:-1, 1:-1] = np.where(rng.random((7, 8)) < holes, OUTSIDE, FREE)
    kind[1:-1, 1:-1][rng.random((7, 8)) < 0.05] = LED
    free = kind == FREE
    own = free & (rng.random(kind.shape) < 0.3)
    code = np.where(free, np.where(own, np.cumsum(own).reshape(kind.shape), 0), -1)
    count = int(own.sum()) + 1
    return StencilMatrix(
        code.astype(np.int32), kind, rng.normal(size=(count, WINDOW, 4)),
        rng.normal(size=(count, 4)), None, None,
    )  # fmt: skip


def dense(matrix: StencilMatrix) -> Any:
    """The matrix of the free places."""
    free = np.argwhere(matrix.code >= 0)
    number = {tuple(at): n for n, at in enumerate(free.tolist())}
    result = np.zeros((2 * len(free), 2 * len(free)))
    for (row, place), n in number.items():
        for s, (down, along) in enumerate(STEPS):
            k = number.get((row + down, place + along))
            if k is not None:
                block = matrix.stencils[matrix.code[row, place], s].reshape(2, 2)
                result[2 * n : 2 * n + 2, 2 * k : 2 * k + 2] = block
    return result


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("holes", [0.0, 0.3])
def test_the_transposed_matrix_is_that_of_the_dense_one(seed: int, holes: float) -> None:
    matrix = random_matrix(seed, holes)
    found = transposed(matrix)
    np.testing.assert_array_equal(dense(found), dense(matrix).T)
    np.testing.assert_array_equal(dense(transposed(found)), dense(matrix))
    rows = matrix.code >= 0
    np.testing.assert_array_equal(found.scale[found.code[rows]], matrix.scale[matrix.code[rows]])


@pytest.mark.parametrize("seed", range(12))
def test_a_body_is_held_if_each_connected_part_is_beside_a_leader(seed: int) -> None:
    matrix = random_matrix(seed, 0.55)
    parts, count = label(matrix.kind == FREE, np.ones((3, 3)))
    beside = np.zeros(matrix.kind.shape, bool)
    for row, place in np.argwhere(matrix.kind == LED):
        beside[row - 1 : row + 2, place - 1 : place + 2] = True
    exact = {*range(1, count + 1)} <= {*parts[beside].tolist()}
    assert is_held(matrix) == exact
    everywhere = np.ones(matrix.kind.shape, bool)
    assert is_held(matrix, np.array([everywhere, everywhere]))
    assert not is_held(matrix, np.array([everywhere, ~everywhere])) or exact


def test_held_and_free_bodies_occur() -> None:
    held = [is_held(random_matrix(seed, 0.55)) for seed in range(12)]
    assert any(held)
    assert not all(held)


@pytest.mark.parametrize("cut", [None, "column", "row"])
def test_a_crack_across_a_held_body_is_found(cut: str | None) -> None:
    """Every place has a stencil of its own; bonds between two columns or rows are cut."""
    kind = np.full((9, 10), OUTSIDE, np.int8)
    kind[1:-1, 1:-1] = FREE
    kind[1, 1:-1] = kind[-2, 1:-1] = LED
    free = kind == FREE
    code = np.where(free, np.cumsum(free).reshape(kind.shape), -1).astype(np.int32)
    stencils = np.ones((int(free.sum()) + 1, WINDOW, 4))
    axis, first = {"column": (1, 5), "row": (0, 4)}.get(cut or "", (0, -9))
    for at in np.argwhere(free):
        for s, step in enumerate(STEPS):
            if {at[axis], at[axis] + step[axis]} == {first, first + 1}:
                stencils[code[tuple(at)], s] = 0.0
    matrix = StencilMatrix(code, kind, stencils, stencils[:, 4], None, None)
    assert is_held(matrix) == (cut is None)


@pytest.mark.parametrize(("xy", "yx"), [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)])
def test_axes_are_solved_one_after_the_other_if_one_leads(xy: float, yx: float) -> None:
    matrix = random_matrix(0)
    matrix.stencils[..., 1] *= xy
    matrix.stencils[..., 2] *= yx
    assert leads_one_way(matrix) == (xy != yx)


@pytest.mark.parametrize("seed", range(8))
def test_definite_diagonal_blocks_have_positive_eigenvalues(seed: int) -> None:
    rng = np.random.default_rng(seed)
    blocks = rng.normal(size=(3, 2, 2))
    blocks = blocks @ blocks.swapaxes(1, 2) - rng.choice([0.0, 0.3]) * np.eye(2)
    stencils = np.zeros((3, WINDOW, 4))
    stencils[:, 4] = blocks.reshape(3, 4)
    exact = bool((np.linalg.eigvalsh(blocks) > 0.0).all())
    assert StencilGrid.is_definite_alone(SimpleNamespace(stencils=stencils)) == exact
    negative = SimpleNamespace(stencils=-np.abs(stencils))
    assert not StencilGrid.is_definite_alone(negative)


@pytest.mark.parametrize("seed", range(2))
def test_the_matrix_of_a_grid_is_the_dense_one(seed: int) -> None:
    matrix = random_matrix(seed)
    grid = SimpleNamespace(code=matrix.code, stencils=matrix.stencils)
    at, found = StencilGrid.matrix(grid)
    np.testing.assert_array_equal(np.transpose(at), np.argwhere(matrix.code >= 0))
    np.testing.assert_array_equal(found, dense(matrix))
