"""Rows of grids that processes share, and solutions of a given relative accuracy."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scene_strategies import samples

from pbdkit.equilibrium.sparse import MatrixSystem
from pbdkit.equilibrium.system import (
    ALL,
    Moves,
    Strip,
    coarser_size,
    random_displacements,
    solved,
)
from pbdkit.progress import Watch
from tests.equilibrium.test_lattice_system import LINEAR, at_rest


@st.composite
def strips(draw):
    """The strips of several processes, which begin at any rows; arrays have some rows around the
    own ones, and stencils are known in fewer of them."""
    count = draw(st.integers(30, 200))
    cuts = draw(st.lists(st.integers(1, count - 1), min_size=1, max_size=4, unique=True))
    bounds = [0, *sorted(cuts), count]
    around, known = draw(st.integers(8, 20)), draw(st.integers(0, 6))
    return [
        Strip(
            count, max(0, begin - around) // 2 * 2, begin, end,
            max(0, begin - around + known), min(count, end + around - known), 5,
        )
        for begin, end in pairwise(bounds)
    ]  # fmt: skip


@samples(50)
@given(strips(), st.booleans())
def test_coarser_rows_are_shared_and_their_stencils_follow_from_known_rows(parts, is_halved):
    """Row n of a grid with half the rows lies at row 2n - 1, and its stencil depends on two rows on
    either side; with as many rows, on the adjacent rows."""
    coarse = [part.coarser(int(is_halved)) for part in parts]
    count = coarser_size(parts[0].count) if is_halved else parts[0].count
    assert [strip.count for strip in coarse] == [count] * len(parts)
    assert coarse[0].begin == 0
    assert coarse[-1].end == count
    assert all(a.end == b.begin for a, b in pairwise(coarse))
    reach = 2 if is_halved else 1
    for fine, strip in zip(parts, coarse, strict=True):
        assert strip.depth == fine.depth - 1
        assert strip.low == (fine.low // 2 if is_halved else fine.low)
        known = {*range(fine.first, fine.last)}
        assert {*range(strip.first, strip.last)} == {
            n
            for n in range(count)
            if all(
                row in known or not 0 <= row < fine.count
                for row in range(
                    (2 * n - 1 if is_halved else n) - reach,
                    (2 * n - 1 if is_halved else n) + reach + 1,
                )
            )
        }


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3, 1e9])
def test_rough_solutions_have_a_relative_accuracy(size):
    """The size of the solution is assumed wrongly, by any factor."""
    exact, tolerances = np.array([[[3.0, -1.0]]]), []

    def solve(moves, tolerance):
        tolerances.append(tolerance)
        return moves + tolerance

    found = solved(SimpleNamespace(solve=solve), exact, size)
    assert np.abs(found - exact).max() <= 0.08 * np.abs(exact).max()
    assert len(tolerances) <= 5


def test_random_fields_are_between_minus_one_and_one():
    field = ALL.random((2, 1, 40, 50))
    assert field.min() >= -1.0
    assert field.max() < 1.0
    assert abs(field.mean()) < 0.05
    assert field.std() == pytest.approx(1.0 / np.sqrt(3.0), rel=0.05)


@pytest.mark.parametrize("relaxation", [1.0, 0.05])
def test_a_translation_changes_moves_by_rounding_errors_only(relaxation):
    """They are at most as large as assumed, and not a hundred times smaller."""
    solver = {"type": "stepping", "relaxation": relaxation}
    scene, rest = at_rest(LINEAR["elastic"] | {"solver": solver})
    moves, u, far = Moves(scene), random_displacements(scene, 1.0), 1e6
    near, moved = (moves.at(replace(rest, u=u + shift), 1) for shift in (0.0, far))
    system = MatrixSystem(scene, rest, "lu", Watch(), 1)
    assumed = system.amplification * moves.rounding(u + far)
    assert 0.01 * assumed <= np.abs(moved - near).max() <= assumed
