"""Steps as linear maps of small displacements: step operator, spectrum, response to plane waves."""

from __future__ import annotations
