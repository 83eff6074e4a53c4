"""The hook of pbdkit and its marker; where installed plugins declare it, with nothing imported."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from importlib.metadata import EntryPoint, distribution, distributions
from pathlib import PurePath
from typing import TYPE_CHECKING

import pluggy

if TYPE_CHECKING:
    from pbdkit.interfaces import Component

BUILTIN = GROUP = "pbdkit"
"""The distribution of the built-in components, and the entry-point group of plugins, which is the
project name of their hook markers too."""

API = 1
"""The version of the hook and the six interfaces. A plugin may declare the one that it was written
for as `pbdkit_api`, in the module or on the object that its entry point names."""

hookspec = pluggy.HookspecMarker(GROUP)
hookimpl = pluggy.HookimplMarker(GROUP)
DISABLE, ALL = "PBDKIT_DISABLE_PLUGINS", "*"
"""The variable that lists what is not to be loaded, distributions or entry points, and its value
for: nothing at all."""


class Hooks:
    """What a plugin may implement, as functions of the module that its entry point names."""

    @hookspec
    def pbdkit_components(self) -> list[type[Component]]:
        """The component classes that the distribution offers."""
        raise NotImplementedError  # a specification only: pluggy never calls it


@dataclass(frozen=True)
class Point:
    """An entry point with the distribution that declares it; `fault` where it cannot be read."""

    name: str
    distribution: str
    version: str
    entry: EntryPoint | None = None
    fault: Exception | None = None

    def answers_to(self, name: str) -> bool:
        """Whether the name is that of the distribution or of the entry point."""
        return canonical(name) in (canonical(self.distribution), canonical(self.name))

    @property
    def disabled(self) -> str:
        """Why the user does not want it loaded; empty where that is not said."""
        if ALL in (names := disabled_names()):
            return f"no plugin is wanted (--no-plugins or {DISABLE}={ALL})"
        return f"{DISABLE} names it" if any(map(self.answers_to, names)) else ""


def installed_points() -> list[Point]:
    """The entry points of all distributions but our own, sorted by the names of both.

    Metadata that cannot be read become a point with a fault. Of two distributions with one name
    the first on Python's path counts, as for Python itself.
    """
    names: set[str] = set()
    points: list[Point] = []
    for found in distributions():
        try:
            if f"[{GROUP}]" in (found.read_text("entry_points.txt") or ""):
                names.add(canonical(found.metadata["Name"] or ""))
        except Exception as error:
            folder = PurePath(str(getattr(found, "_path", "(no name)"))).name
            points.append(Point("", folder, "", fault=error))
    for name in sorted(names - {BUILTIN}):
        try:
            own = distribution(name)
            what = own.metadata["Name"], own.metadata["Version"] or ""
            points += [Point(e.name, *what, e) for e in own.entry_points.select(group=GROUP)]
        except Exception as error:
            points.append(Point("", name or "(no name)", "", fault=error))
    return sorted(points, key=lambda point: (point.distribution, point.name))


def disabled_names() -> list[str]:
    """What the variable lists."""
    return [word.strip() for word in os.environ.get(DISABLE, "").split(",") if word.strip()]


def canonical(name: str) -> str:
    """The name of a distribution in the one spelling that installers compare."""
    return re.sub(r"[-_.]+", "-", name).lower()
