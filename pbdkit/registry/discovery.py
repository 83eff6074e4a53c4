"""Finds the entry points of plugins in the metadata of what is installed, and imports nothing."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from importlib.metadata import Distribution, EntryPoint, distribution, distributions
from pathlib import PurePath

from pbdkit.registry.blame import worded
from pbdkit.registry.hooks import GROUP

BUILTIN = "pbdkit"
DISABLE, ALL = "PBDKIT_DISABLE_PLUGINS", "*"
"""The variable that lists what is not to be loaded, distributions or entry points, and its value
for: nothing at all."""


@dataclass(frozen=True)
class Point:
    """An entry point with the distribution that declares it; `fault` where it cannot be read."""

    name: str
    distribution: str
    version: str
    entry: EntryPoint | None = None
    fault: str = ""

    def answers_to(self, name: str) -> bool:
        """Whether the name is that of the distribution or of the entry point."""
        return canonical(name) in (canonical(self.distribution), canonical(self.name))

    @property
    def disabled(self) -> str:
        """Why the user does not want it loaded; empty where that is not said."""
        if ALL in (names := disabled_names()):
            return f"no plugin is wanted (--no-plugins or {DISABLE}={ALL})"
        return f"{DISABLE} names it" if any(map(self.answers_to, names)) else ""


def points_of(found: Distribution) -> list[Point]:
    """The entry points of a distribution."""
    name, version = found.metadata["Name"], found.metadata["Version"] or ""
    entries = found.entry_points.select(group=GROUP)
    return [Point(entry.name, name, version, entry) for entry in entries]


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
            points.append(_unreadable(folder, error))
    for name in sorted(names - {BUILTIN}):
        try:
            points += points_of(distribution(name))
        except Exception as error:
            points.append(_unreadable(name or "(no name)", error))
    return sorted(points, key=lambda point: (point.distribution, point.name))


def disabled_names() -> list[str]:
    """What the variable lists."""
    return [word.strip() for word in os.environ.get(DISABLE, "").split(",") if word.strip()]


def canonical(name: str) -> str:
    """The name of a distribution in the one spelling that installers compare."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _unreadable(distribution: str, error: Exception) -> Point:
    return Point("", distribution, "", fault=f"its metadata cannot be read: {worded(error)}")
