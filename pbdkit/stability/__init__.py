"""Predictions about a run before its first step.

`analysis` computes the spectrum of a step and the rate of convergence, `relaxation` the optimal
relaxation and momentum, and `distance` the distance from equilibrium while leaders move. `forecast`
combines these results with warnings and with estimates of memory and time, for `pbdkit check`.
"""

from __future__ import annotations
