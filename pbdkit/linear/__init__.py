"""Steps as linear maps of small displacements.

`response` linearises the functions of a rule in a body, and `stencil` on the infinite lattice.
`operator` assembles the sparse matrix of a step, and `spectrum` computes the eigenvalues of this
matrix.
"""

from __future__ import annotations
