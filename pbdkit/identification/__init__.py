"""What a rule is physically, on its lattice and neighbours: from its answer to plane waves."""

from __future__ import annotations
