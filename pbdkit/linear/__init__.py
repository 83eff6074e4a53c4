"""Steps as linear maps of small displacements.

`response` and `stencil` linearise the functions of a rule, in a body and on the infinite lattice;
`operator` assembles the sparse matrix of a step, and `spectrum` computes its eigenvalues.
"""

from __future__ import annotations
