"""The compiled functions of grids, loaded when first used."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from types import SimpleNamespace
from typing import Any

from pbdkit.stepping.compiled.kernel_cache import is_kept, load_kernel


@cache
def kernels() -> SimpleNamespace:
    """The compiled functions: how grids are made, what is done on one, and with whole fields."""
    found: dict[str, Any] = {}
    for source in _sources():
        found |= load_kernel(source, {}, ()).__globals__
    return SimpleNamespace(**found)


def are_kept() -> bool:
    """Whether none of them is to be compiled."""
    loaded = kernels.cache_info().currsize > 0
    return loaded or all(is_kept(source, {}, ()) for source in _sources())


@cache
def _sources() -> tuple[str, ...]:
    folder = files("pbdkit.equilibrium.grids")
    names = ("coarsening", "grid", "field")
    return tuple(folder.joinpath(f"{n}_kernels.py").read_text(encoding="utf-8") for n in names)
