"""Distributed runs: one lattice divided among the ranks of MPI, each a separate process.

`partition` divides the rows of the lattice and exchanges halos, `driver` has the drivers of a part,
`distributed_run` builds the scenes of the parts and records their states, and `launch` detects a
start by mpiexec.
"""

from __future__ import annotations
