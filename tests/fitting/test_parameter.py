"""Weights of differences of the parameters of fits."""

import numpy as np
import pytest

from pbdkit.fitting.parameter import ORDER_4, WEIGHTS


@pytest.mark.parametrize("weights", [ORDER_4, WEIGHTS])
def test_differences_are_exact_for_polynomials_of_their_order(weights):
    """The derivative of xᵖ at 0 is 1 for p = 1, and 0 for other powers up to the order."""
    k = np.arange(1, len(weights) + 1)
    for power in range(1, 2 * len(weights) + 1):
        difference = np.dot(weights, k**power - (-k) ** power)
        assert difference == pytest.approx(float(power == 1), abs=1e-12)
