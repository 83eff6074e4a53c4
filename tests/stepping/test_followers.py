"""The displacement after a step, from the move of the rule."""

import numpy as np
import pytest

from pbdkit.model.solver import Stepping
from pbdkit.stepping.followers import target


@pytest.mark.parametrize("relaxation", [0.3, 1.0, 1.7])
@pytest.mark.parametrize("memory", [-1.0, 0.0, 0.4, 1.0])
def test_relaxation_and_memory_are_linear(relaxation: float, memory: float) -> None:
    """x(t + 1) = x(t) + w move + b (x(t) - x(t - 1))."""
    u, move, before = np.random.default_rng(0).normal(size=(3, 5))
    solver = Stepping(relaxation=relaxation, memory=memory)
    exact = u + relaxation * move + memory * (u - before)
    np.testing.assert_array_equal(target(u, move, before, solver), exact)
