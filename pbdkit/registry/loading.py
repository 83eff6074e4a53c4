"""Loads one plugin in its own guard: whatever it does, the others load."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import chdir, contextmanager, redirect_stdout
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint, version
from typing import Any

import pluggy

from pbdkit.interfaces import Component
from pbdkit.registry.checking import check_class, check_component, interface_of
from pbdkit.registry.discovery import BUILTIN, Point, builtin_point
from pbdkit.registry.hooks import API, GROUP, Hooks
from pbdkit.registry.wording import worded


@dataclass(frozen=True)
class Offer:
    """One thing on the list of a plugin.

    A component that can be used has the state ok or conflict. Of a broken one `interface` and
    `name`, its type, are what is known.
    """

    name: str
    interface: type[Component] | None = None
    component: type[Component] | None = None
    state: str = "ok"
    reason: str = ""


@dataclass(frozen=True)
class Plugin:
    """One entry point: the distribution it comes from, what it offers, and how it fared.

    `state` is ok, disabled, broken (in whole or in part), incompatible or conflict.
    """

    name: str
    distribution: str
    version: str
    state: str
    reason: str = ""
    offers: tuple[Offer, ...] = ()

    @property
    def components(self) -> tuple[type[Component], ...]:
        """The classes that can be used."""
        return tuple(o.component for o in self.offers if o.component is not None)

    def __str__(self) -> str:
        return f"{self.distribution} {self.version}".strip()


class IncompatibleError(Exception):
    """A plugin was written for another version of the plugin API."""


def load_builtin() -> Plugin:
    """The components of pbdkit itself, by its own entry point, with no other looked at."""
    plugin = load_plugin(builtin_point(), check_class)
    if plugin.state != "ok":
        raise RuntimeError(f"the built-in components do not load: {plugin.reason}")
    return plugin


def load_plugin(point: Point, check: Callable[[Any], None] = check_component) -> Plugin:
    """Imports the plugin and asks it for its components; a fault becomes its state and reason.

    One unusable class leaves the others of the plugin in use.
    """
    offers: tuple[Offer, ...] = ()
    try:
        if point.entry is None:
            return _plugin(point, "broken", point.fault)
        with _kept_apart():
            offers = _apart([_offer(c, check, point) for c in _offered(point.entry)])
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"while {point.distribution} was loaded") from None
    except IncompatibleError as error:
        return _plugin(point, "incompatible", str(error))
    except BaseException as error:  # SystemExit at import is a plugin's fault too
        return _plugin(point, "broken", worded(error, point.package))
    faults = dict.fromkeys(offer.reason for offer in offers if offer.state != "ok")
    return _plugin(point, "broken" if faults else "ok", "; ".join(faults), offers)


def offer_of(component: type[Component]) -> Offer:
    """The offer of a class that has been checked."""
    return Offer(component.type_name(), interface_of(component), component)


def _plugin(point: Point, state: str, reason: str, offers: tuple[Offer, ...] = ()) -> Plugin:
    return Plugin(point.name, point.distribution, point.version, state, reason, offers)


def _offered(entry: EntryPoint) -> list[Any]:
    manager = pluggy.PluginManager(GROUP)
    manager.add_hookspecs(Hooks)
    module = entry.load()
    _refuse_other_api(module, entry)
    manager.register(module, entry.name)
    manager.check_pending()
    if not manager.hook.pbdkit_components.get_hookimpls():
        raise TypeError("its module implements no hook `pbdkit_components`")
    answers = manager.hook.pbdkit_components()
    if not answers or not isinstance(answers[0], list):
        raise TypeError("its hook `pbdkit_components` must return a list of component classes")
    return [c for n, c in enumerate(answers[0]) if not any(c is d for d in answers[0][:n])]


def _refuse_other_api(module: Any, entry: EntryPoint) -> None:
    """Raises IncompatibleError where the plugin declares another version than ours."""
    declared = getattr(module, "pbdkit_api", None)
    if declared is None:
        declared = getattr(sys.modules.get(entry.module), "pbdkit_api", API)
    if type(declared) is not int:
        raise TypeError(f"its `pbdkit_api` should be a whole number, got {declared!r}")
    if declared != API:
        raise IncompatibleError(
            f"it is written for version {declared} of the plugin API, and pbdkit "
            f"{version(BUILTIN)} has version {API}; install a version of either that fits the other"
        )


def _offer(component: Any, check: Callable[[Any], None], point: Point) -> Offer:
    try:
        check(component)
        return offer_of(component)
    except (Exception, SystemExit) as error:
        reason = worded(error, point.package)
        return Offer(_known_type(component), _known_interface(component), None, "broken", reason)


def _known_type(component: Any) -> str:
    try:
        return str(component.type_name())
    except Exception:
        return ""


def _known_interface(component: Any) -> type[Component] | None:
    try:
        return interface_of(component)
    except Exception:
        return None


def _apart(offers: list[Offer]) -> tuple[Offer, ...]:
    """The offers, with two classes that nothing could tell apart both broken."""
    named = [(offer.interface, offer.name) for offer in offers if offer.component]
    return tuple(
        replace(
            offer,
            component=None,
            state="broken",
            reason=f"it offers two classes with the type '{offer.name}'; give one of them another",
        )
        if named.count((offer.interface, offer.name)) > 1
        else offer
        for offer in offers
    )


@contextmanager
def _kept_apart() -> Iterator[None]:
    """What a plugin prints at import is no output of the program, its filters of warnings are its
    own, and so is the folder that it works in."""
    with redirect_stdout(sys.stderr), warnings.catch_warnings(), chdir("."):
        yield
