"""Physical identity of a rule on its lattice and neighbourhood, from its response to plane waves.

`identified` determines whether the continuum limit of a rule is diffusion, linear elasticity or
neither of them. It also computes elastic constants, diffusivities and the dispersion of short
waves.
"""

from __future__ import annotations
