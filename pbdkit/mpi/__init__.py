"""One lattice cut into parts, each with a process that steps it or finds its equilibrium."""

from __future__ import annotations
