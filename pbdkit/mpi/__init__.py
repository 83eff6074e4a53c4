"""One lattice divided among the ranks of MPI, each with a process of its own."""

from __future__ import annotations
