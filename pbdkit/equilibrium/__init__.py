"""Equilibria of a scene: the states in which no follower moves.

`load_stepping` follows the load and breaks bonds, `newton` computes one equilibrium, `error_bound`
bounds its error. The linear systems are stored as matrices or as stencils on the lattice. Matrices
are treated in `sparse`, `linear_solver` and `amg`, and stencils in `lattice_system`,
`stencil_matrix`, `krylov`, `multigrid` and `grid_kernels`; `contact_system` adds obstacles.
`breaking_kernel` computes equilibria of linear rules with breaking bonds in one compiled call.
"""

from __future__ import annotations
