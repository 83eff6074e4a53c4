"""A bar with a stiffness that varies from place to place, with its exact solution. Needs numpy
only.

Young's modulus is f(x) g(y) and ν = 0, so that stress is along x alone and constant there:
u_x = ∫ dx / f from 0 to x over that to the right edge, whatever g is, and u_y = 0.
"""

from __future__ import annotations

import math

import numpy as np
from finite_elements.errors import Reference
from finite_elements.problems import FINEST, Problem

VARYING = Problem("varying", 2.0, 1.0)
SOFTER = 24.0
"""Decrease of f along the bar: from 1 to 1/25. No grid has exact values at its nodes then."""


def modulus(x, y):
    """From 1 to 1/50: 1/f = 1 + SOFTER (x/length)², g = 1 - y/2."""
    return (1 - y / 2) / (1 + SOFTER * (x / VARYING.length) ** 2)


def exact(x):
    """u_x, and the right edge moves by 1."""
    share = x / VARYING.length
    return (share + SOFTER / 3 * share**3) / (1 + SOFTER / 3)


def reference() -> Reference:
    """At the sites of the finest lattice, as those of other problems are kept."""
    x, y, _ = VARYING.sites(VARYING.columns, VARYING.rows)
    u = np.array([exact(x), np.zeros_like(x)])
    return Reference(VARYING, FINEST, x, y, u, math.nan, math.nan, 0.0)
