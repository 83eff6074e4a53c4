"""What a step is to small displacements: the step operator, its spectrum, plane waves."""

from __future__ import annotations
