"""Loads one plugin in its own guard: whatever it does, the others load."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from importlib.metadata import EntryPoint, distribution, entry_points
from typing import Any

import pluggy

from pbdkit.interfaces import INTERFACES, Component
from pbdkit.registry.hooks import GROUP, Hooks

BUILTIN = "pbdkit"


@dataclass(frozen=True)
class Plugin:
    """One entry point: the distribution it comes from, what it offers, and how it fared."""

    name: str
    distribution: str
    version: str
    state: str
    reason: str = ""
    components: tuple[type[Component], ...] = ()


def load_builtin() -> Plugin:
    """The components of pbdkit itself, by its own entry point, with no other looked at."""
    own = distribution(BUILTIN)
    (point,) = own.entry_points.select(group=GROUP)
    plugin = load_plugin(point, own.name, own.version)
    if plugin.state != "ok":
        raise RuntimeError(f"the built-in components do not load: {plugin.reason}")
    return plugin


def load_installed() -> list[Plugin]:
    """Every installed plugin but the built-in one, by name of distribution."""
    found = [
        (point.dist.name, point.dist.version, point)
        for point in entry_points(group=GROUP)
        if point.dist is not None and point.dist.name != BUILTIN
    ]
    return [
        load_plugin(point, name, version)
        for name, version, point in sorted(found, key=lambda f: (f[0], f[2].name))
    ]


def load_plugin(point: EntryPoint, name: str, version: str) -> Plugin:
    """Imports the plugin and asks it for its components; a fault becomes its state and reason."""
    try:
        components = _offered(point)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # SystemExit at import is a plugin's fault too
        reason = f"{type(error).__name__}: {error}"
        return Plugin(point.name, name, version, "broken", reason)
    return Plugin(point.name, name, version, "ok", components=tuple(components))


def _offered(point: EntryPoint) -> list[type[Component]]:
    manager = pluggy.PluginManager(GROUP)
    manager.add_hookspecs(Hooks)
    module = point.load()
    manager.register(module, point.name)
    manager.check_pending()
    answers = manager.hook.pbdkit_components()
    if not manager.get_hookcallers(module):
        raise TypeError("its module implements no hook `pbdkit_components`")
    if not answers or not isinstance(answers[0], list):
        raise TypeError("its hook `pbdkit_components` must return a list of component classes")
    for component in answers[0]:
        check_component(component)
    return list(answers[0])


def check_component(component: Any) -> None:
    """Raises TypeError, with what to mend, unless this is a usable component class."""
    interfaces = tuple(INTERFACES.values())
    if not (inspect.isclass(component) and issubclass(component, interfaces)):
        raise TypeError(f"{component!r} is no class of one of pbdkit's interfaces")
    component.type_name()
    if missing := ", ".join(sorted(getattr(component, "__abstractmethods__", ()))):
        raise TypeError(f"{component.__name__} lacks {missing}")
