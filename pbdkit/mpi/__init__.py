"""Distributed runs: a lattice is divided among the ranks of MPI, each of which is a separate
process.

`partition` divides the rows of the lattice and exchanges halos. `driver` contains the drivers for a
part of the lattice. `distributed_run` builds the scenes of the parts and records their states.
`launch` detects a start by mpiexec. The root is the process of rank 0.
"""

from __future__ import annotations
