"""A bar whose stiffness varies from place to place, with its exact solution. Needs numpy only.

Young's modulus is f(x) g(y) and ν = 0, so that stress is along x alone and constant there:
u_x = ∫ dx / f from 0 to x over that to the right edge, whatever g is, and u_y = 0.
"""

from __future__ import annotations

import math

import numpy as np

from finite_elements.errors import Reference
from finite_elements.problems import FINEST, Problem

VARYING = Problem("varying", 2.0, 1.0)
LARGEST_OVER_SMALLEST = 50.0
RATE = math.log(LARGEST_OVER_SMALLEST / 2) / VARYING.length


def modulus(x, y):
    """From 1 to 1/50: f = exp(-RATE x), g = 1 - y/2."""
    return np.exp(-RATE * x) * (1 - y / 2)


def exact(x):
    """u_x, and the right edge moves by 1."""
    return np.expm1(RATE * x) / math.expm1(RATE * VARYING.length)


def reference() -> Reference:
    """At the sites of the finest lattice, as those of other problems are kept."""
    x, y, _ = VARYING.sites(VARYING.columns, VARYING.rows)
    u = np.array([exact(x), np.zeros_like(x)])
    return Reference(VARYING, FINEST, x, y, u, math.nan, math.nan, 0.0)
