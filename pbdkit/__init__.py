"""pbdkit: position-based dynamics of deformable bodies on lattices, rules instead of forces.

The public names are listed in `__init__.pyi`. Each is imported when it is first used, so that
`import pbdkit` is fast. The interfaces for authors of components are in `pbdkit.plugin`.
"""

from __future__ import annotations

from importlib import import_module
from itertools import pairwise

from pbdkit.lazy_accessor import register_accessor


def _public_names() -> dict[str, str]:
    """Return the module of each public name, from the lines of the stub.

    A line of the stub is ``from MODULE import NAME as NAME``.
    """
    # This replaces `pkgutil.get_data`, which takes 13 ms to import; it also reads from archives.
    stub = __spec__.loader.get_data(f"{__file__}i").decode()  # type: ignore[union-attr]  # optional
    lines = (line for line in stub.splitlines() if not line.startswith("#"))
    words = " ".join(lines).replace("(", " ").replace(")", " ").replace(",", " ").split()
    names, module = dict[str, str](), ""
    for previous, word in pairwise(words):
        if previous == "from":
            module = word
        elif previous == "as":
            names[word] = module
    return names


_MODULE_OF = _public_names()
"""Module of each public name."""
_RENAMED = {"Components": "Vector"}
"""Names in `pbdkit.plugin` that replace former names in this module."""


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("pbdkit")
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'pbdkit' has no attribute '{name}'{_hint(name)}")
    module = _MODULE_OF[name]
    return (
        import_module(f"pbdkit.{name}")
        if module == "pbdkit"
        else getattr(import_module(module), name)
    )


def _hint(name: str) -> str:
    """Return a hint to import a name from pbdkit.plugin; empty if the name is not public there."""
    if name.startswith("_"):
        return ""
    present_name = _RENAMED.get(name, name)
    is_public = present_name in import_module("pbdkit.plugin").__all__
    return f"; write `from pbdkit.plugin import {present_name}`" if is_public else ""


def __dir__() -> list[str]:
    return sorted([*_MODULE_OF, "__version__"])


__all__ = sorted(name for name, module in _MODULE_OF.items() if module != "pbdkit")
register_accessor()
