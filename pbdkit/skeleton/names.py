"""The names in a plugin project, all made from that of its distribution."""

from __future__ import annotations

import keyword
import re
import sys
from dataclasses import dataclass
from importlib.util import find_spec

from pbdkit.errors import ExperimentError
from pbdkit.interfaces import INTERFACES
from pbdkit.registry.discovery import BUILTIN, canonical
from pbdkit.registry.registry import Registry

PREFIX = f"{BUILTIN}-"
TAKEN = {*keyword.kwlist, "Literal", "Field"}
"""What a class in the module cannot be called."""


@dataclass(frozen=True)
class Names:
    """``pbdkit-my-rule``: the module ``pbdkit_my_rule``, the type ``my-rule``, the class
    ``MyRule``."""

    distribution: str
    module: str
    type: str
    class_name: str


def names_from(name: str, interface: str) -> Names:
    """The names of a project with a component of that interface.

    Raises ExperimentError where one of them cannot be had.
    """
    if not re.fullmatch(r"[A-Za-z]([A-Za-z0-9._-]*[A-Za-z0-9])?", name):
        raise ExperimentError(
            f"'{name}' is no name for a distribution: it begins with a letter, ends with a letter "
            "or digit, and holds letters, digits, '.', '_' and '-', as pbdkit-my-rule does"
        )
    distribution = canonical(name)
    kind = distribution.removeprefix(PREFIX)
    class_name = "".join(word.capitalize() for word in kind.split("-"))
    module = distribution.replace("-", "_")
    if not class_name.isidentifier() or class_name in TAKEN:
        raise ExperimentError(f"'{name}' makes no name for a class{_try(f'my-{kind}')}")
    if module in keyword.kwlist or _is_module(module):
        raise ExperimentError(f"there is a module {module} already{_try(f'my-{kind}')}")
    if kind in Registry().components(INTERFACES[_field_of(interface)], installed=False):
        raise ExperimentError(f"'{kind}' is a built-in {interface}{_try(f'my-{kind}')}")
    return Names(distribution, module, kind, class_name)


def _field_of(interface: str) -> str:
    return next(field for field, i in INTERFACES.items() if i.__name__ == interface)


def _is_module(name: str) -> bool:
    """Whether Python finds a module of that name; a mere folder is none."""
    if name in sys.stdlib_module_names:
        return True
    spec = find_spec(name)
    return spec is not None and spec.origin is not None


def _try(kind: str) -> str:
    return f"; try {PREFIX}{kind}"
