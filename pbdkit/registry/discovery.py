"""Finds the entry points of plugins in the metadata of what is installed, and imports nothing."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import Distribution, EntryPoint, distribution, distributions
from pathlib import PurePath

from pbdkit.registry.hooks import GROUP
from pbdkit.registry.wording import worded

BUILTIN = "pbdkit"
DISABLE, ALL = "PBDKIT_DISABLE_PLUGINS", "*"
"""The variable that lists what is not to be loaded, and its value for: nothing at all."""


@dataclass(frozen=True)
class Point:
    """An entry point with the distribution that declares it; `fault` where it cannot be read."""

    name: str
    distribution: str
    version: str
    entry: EntryPoint | None = None
    fault: str = ""

    @property
    def package(self) -> str:
        """The top-level module that it leads to."""
        return re.split(r"[.:\s]", self.entry.value.strip())[0] if self.entry else ""

    def answers_to(self, name: str) -> bool:
        """Whether the name is that of the distribution or of the entry point."""
        return canonical(name) in (canonical(self.distribution), canonical(self.name))


def builtin_point() -> Point:
    """The entry point of pbdkit itself, with no other distribution looked at."""
    (point,) = _points_of(distribution(BUILTIN))
    return point


def installed_points() -> list[Point]:
    """The entry points of all other distributions, sorted by the names of both.

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
            points.append(_unreadable(_folder(found), error))
    for name in sorted(names - {BUILTIN}):
        try:
            points += _points_of(distribution(name))
        except Exception as error:
            points.append(_unreadable(name or "(no name)", error))
    return sorted(points, key=lambda point: (point.distribution, point.name))


def disabled(points: list[Point], environment: Mapping[str, str] = os.environ) -> dict[Point, str]:
    """The points that the user does not want loaded, with how that was said."""
    names = disabled_names(environment)
    if ALL in names:
        return dict.fromkeys(points, f"no plugin is wanted (--no-plugins or {DISABLE}={ALL})")
    return {p: f"{DISABLE} names it" for p in points if any(p.answers_to(n) for n in names)}


def disabled_names(environment: Mapping[str, str] = os.environ) -> list[str]:
    """What PBDKIT_DISABLE_PLUGINS lists: distributions or entry points, or * for all."""
    return [word.strip() for word in environment.get(DISABLE, "").split(",") if word.strip()]


def canonical(name: str) -> str:
    """The name of a distribution in the one spelling that installers compare."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _points_of(found: Distribution) -> list[Point]:
    name, version = found.metadata["Name"], found.metadata["Version"] or ""
    entries = found.entry_points.select(group=GROUP)
    return [Point(entry.name, name, version, entry) for entry in entries]


def _unreadable(distribution: str, error: Exception) -> Point:
    return Point("", distribution, "", fault=f"its metadata cannot be read: {worded(error)}")


def _folder(found: Distribution) -> str:
    return PurePath(str(getattr(found, "_path", "(no name)"))).name
