"""Equilibria of a scene: the states in which no follower moves.

`solve` steps through the load and lets bonds break, `newton` finds one equilibrium, `certificate`
bounds its error. The linear systems are matrices (`sparse`, `linear_solver`, `amg`) or stencils on
the lattice (`lattice_system`, `stencil_matrix`, `krylov`, `multigrid`, `grid_kernels`); `contact`
adds obstacles. `breaking_kernel` settles linear rules whose bonds break in one compiled call.
"""

from __future__ import annotations
