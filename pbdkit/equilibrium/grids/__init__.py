"""Linear systems on the stencils of a lattice: multigrid, compiled, without a matrix."""
