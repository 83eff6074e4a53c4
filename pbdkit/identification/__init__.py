"""Physical identity of a rule on its lattice and neighbourhood, from its response to plane
waves."""

from __future__ import annotations
