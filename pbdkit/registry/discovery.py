"""The hook of pbdkit and its marker; where installed plugins declare it, with nothing imported."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import Distribution, EntryPoint, distribution, distributions
from pathlib import PurePath
from typing import Any

import pluggy

from pbdkit.interfaces import Component
from pbdkit.registry import BUILTIN, GROUP
from pbdkit.registry.blame import worded

API = 1
"""The version of the hook and the six interfaces. A plugin may declare the one that it was written
for as `pbdkit_api`, in the module or on the object that its entry point names."""

hookspec = pluggy.HookspecMarker(GROUP)
hookimpl = pluggy.HookimplMarker(GROUP)
DISABLE, ALL = "PBDKIT_DISABLE_PLUGINS", "*"
"""The variable that lists what is not to be loaded, distributions or entry points, and its value
for: nothing at all."""
SEVERITY = ("ok", "conflict", "broken")
"""The states of what a plugin offers; its own is the worst of them."""


class Hooks:
    """What a plugin may implement, as functions of the module that its entry point names."""

    @hookspec
    def pbdkit_components(self) -> list[type[Component]]:
        """The component classes that the distribution offers."""
        raise NotImplementedError  # a specification only: pluggy never calls it


@dataclass(frozen=True)
class Offer:
    """One thing on the list of a plugin: a `component` with its type as `name`, and the `reason`
    where it is in conflict with others. Of a broken one the component is left out, and of
    `interface` and `name` there is what is known."""

    name: str
    interface: type[Component] | None = None
    component: type[Component] | None = None
    reason: str = ""

    @property
    def state(self) -> str:
        """ok, conflict or broken."""
        usable = "conflict" if self.reason else "ok"
        return usable if self.component else "broken"


@dataclass(frozen=True)
class Plugin:
    """An entry point with the distribution that declares it, and what it offers once it is loaded;
    or in which state it is that nothing of it can be had, and why."""

    name: str
    distribution: str
    version: str
    entry: EntryPoint | None = None
    offers: tuple[Offer, ...] = ()
    unusable: str = ""
    why: str = ""

    @property
    def state(self) -> str:
        """ok, disabled, broken (in whole or in part), incompatible or conflict."""
        states = [offer.state for offer in self.offers]
        return self.unusable or max(states, key=SEVERITY.index, default="ok")

    @property
    def reason(self) -> str:
        """Why it is in that state; empty where it is ok."""
        return self.why or "; ".join(dict.fromkeys(o.reason for o in self.offers if o.reason))

    @property
    def fault(self) -> str:
        """``broken: why``, or another state in which it cannot be used; else empty."""
        return "" if self.state in ("ok", "conflict") else f"{self.state}: {self.reason}"

    @property
    def components(self) -> tuple[type[Component], ...]:
        """The classes that can be used."""
        return tuple(o.component for o in self.offers if o.component)

    def answers_to(self, name: str) -> bool:
        """Whether the name is that of the distribution or of the entry point."""
        return canonical(name) in (canonical(self.distribution), canonical(self.name))

    def __str__(self) -> str:
        return f"{self.distribution} {self.version}".strip()


def installed_plugins() -> list[Plugin]:
    """The entry points of all distributions but our own, sorted by the names of both, not loaded.

    Metadata that cannot be read become a broken plugin, and what the user does not want loaded a
    disabled one. Of two distributions with one name the first on Python's path counts, as for
    Python itself.
    """
    names: set[str] = set()
    found: list[Plugin] = []
    for each in distributions():
        try:
            if f"[{GROUP}]" in (each.read_text("entry_points.txt") or ""):
                names.add(canonical(_field(each, "Name")))
        except Exception as error:
            folder = PurePath(str(getattr(each, "_path", "(no name)"))).name
            found.append(_torn(folder, error))
    for name in sorted(names - {BUILTIN}):
        try:
            own = distribution(name)
            what = _field(own, "Name"), _field(own, "Version")
            points = own.entry_points.select(group=GROUP)
            found += [_wanted(Plugin(point.name, *what, point)) for point in points]
        except Exception as error:
            found.append(_torn(name or "(no name)", error))
    return sorted(found, key=lambda plugin: (plugin.distribution, plugin.name))


def _field(own: Distribution, name: str) -> str:
    """Of the metadata; empty where it is missing, whether Python reads them or the backport
    importlib_metadata, which takes its place once anybody imports it, and then raises."""
    metadata: Any = None
    with suppress(FileNotFoundError):
        metadata = own.metadata
    return (metadata and metadata.get(name)) or ""


def _torn(distribution: str, error: Exception) -> Plugin:
    why = f"its metadata cannot be read: {worded(error)}"
    return Plugin("", distribution, "", unusable="broken", why=why)


def _wanted(plugin: Plugin) -> Plugin:
    """The plugin, disabled where the user says so."""
    why = ""
    if ALL in (names := disabled_names()):
        why = f"no plugin is wanted (--no-plugins or {DISABLE}={ALL})"
    elif any(map(plugin.answers_to, names)):
        why = f"{DISABLE} names it"
    return replace(plugin, unusable="disabled", why=why) if why else plugin


def disabled_names() -> list[str]:
    """What the variable lists."""
    return [word.strip() for word in os.environ.get(DISABLE, "").split(",") if word.strip()]


def canonical(name: str) -> str:
    """The name of a distribution in the one spelling that installers compare."""
    return re.sub(r"[-_.]+", "-", name).lower()
