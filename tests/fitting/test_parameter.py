"""Differences of the parameters of fits."""

import numpy as np
import pytest

import pbdkit
from pbdkit.fitting.parameter import ORDER_4, SECANT_STEP, WEIGHTS, Parameter


@pytest.mark.parametrize("weights", [ORDER_4, WEIGHTS])
def test_differences_are_exact_for_polynomials_of_their_order(weights):
    """The derivative of xᵖ at 0 is 1 for p = 1, and 0 for other powers up to the order."""
    k = np.arange(1, len(weights) + 1)
    for power in range(1, 2 * len(weights) + 1):
        difference = np.dot(weights, k**power - (-k) ** power)
        assert difference == pytest.approx(float(power == 1), abs=1e-12)


@pytest.mark.parametrize("jump", [0.0, 1.0, -1.0, 1e4, -1e4])
def test_differences_omit_another_branch(jump):
    """x² jumps on one side of the value, by a multiple of its change in a step. Without a jump the
    quotient is the derivative 2 x."""
    experiment = pbdkit.load("fracture/edge-crack")
    parameter = Parameter("rule.poisson_ratio")
    x = parameter.value_in(experiment)

    def function(changed):
        value = parameter.value_in(changed)
        change = 2 * x * SECANT_STEP * x
        return np.array([value**2 + jump * change * (jump * (value - x) > 0.0)])

    expected = 2 * x - np.sign(jump) * SECANT_STEP * x
    assert parameter.difference(experiment, function)[0] == pytest.approx(expected, rel=1e-9)
