"""Where the steps converge to, without making them, and how far from there a state can be.

Linear rules whose bonds break: settling, breaking and settling again in one compiled call.

Linear systems on the stencils of a lattice: multigrid, compiled, without a matrix.
"""

from __future__ import annotations
