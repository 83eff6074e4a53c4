"""The compiled engine: the same elementwise functions, inlined into generated kernels (numba)."""

from __future__ import annotations
