"""The compiled functions of grids, loaded when first used."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from types import SimpleNamespace
from typing import Any


@cache
def kernels() -> SimpleNamespace:
    """The compiled functions: how grids are made, what is done on one, and with whole fields."""
    # Only here: numba is the extra `fast`, and equilibria are found without it too.
    from pbdkit.stepping.compiled.kernel_cache import load_kernel

    found: dict[str, Any] = {}
    for name in ("coarsening", "grid", "field"):
        file = files("pbdkit.equilibrium.grids").joinpath(f"{name}_kernels.py")
        found |= load_kernel(file.read_text(encoding="utf-8"), {}, ()).__globals__
    return SimpleNamespace(**found)
