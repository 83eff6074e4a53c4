"""The compiled functions of grids, loaded when first used."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from types import SimpleNamespace


@cache
def kernels() -> SimpleNamespace:
    """The compiled functions: how grids are made, what is done on one, and with whole fields."""
    # Only here: numba is the extra `fast`, and equilibria are found without it too.
    from pbdkit.stepping.numba_engine.cache import load_kernel

    source = files("pbdkit.equilibrium").joinpath("grid_kernels.py").read_text(encoding="utf-8")
    return SimpleNamespace(**load_kernel(source, {}, ()).__globals__)
