"""Loads one plugin in its own guard: whatever it does, the others load."""

from __future__ import annotations

import inspect
import re
import sys
import warnings
from contextlib import chdir, redirect_stdout, suppress
from dataclasses import replace
from functools import cache
from importlib.metadata import EntryPoint, distribution, version
from typing import Any

import pluggy
from pydantic import ValidationError

from pbdkit.interfaces import INTERFACES, Component, SharesParticles
from pbdkit.registry import BUILTIN, GROUP
from pbdkit.registry.blame import interface_of, one_line, worded
from pbdkit.registry.discovery import API, Hooks, Offer, Plugin

TYPE = r"[A-Za-z0-9][A-Za-z0-9._-]*"
REFUSALS = ("missing", "value_error", "assertion_error")
"""Kinds of pydantic's errors that are no fault of a default: a parameter is not given, or the
component's own validator refuses it."""


class IncompatibleError(Exception):
    """A plugin was written for another version of the plugin API."""


@cache
def load_builtin() -> Plugin:
    """The components of pbdkit itself, by its own entry point, with no other looked at; they are
    not checked, for that is what the tests do."""
    own = distribution(BUILTIN)
    (entry,) = own.entry_points.select(group=GROUP)
    return Plugin(entry.name, BUILTIN, own.version, entry, tuple(map(offer_of, _offered(entry))))


def loaded(plugin: Plugin) -> Plugin:
    """Imports the plugin, unless it is disabled, and asks it for its components; a fault becomes
    its state and reason.

    One unusable class leaves the others of the plugin in use. What a plugin prints at import is no
    output of the program; its filters of warnings and its folder are its own.
    """
    if plugin.unusable or plugin.entry is None:
        return plugin
    package = plugin.entry.value.split(":")[0].split(".")[0].strip()
    try:
        with chdir("."), redirect_stdout(sys.stderr), warnings.catch_warnings():
            offers = tuple(_offer(c, package) for c in _offered(plugin.entry))
        return replace(plugin, offers=offers)
    except IncompatibleError as error:
        return replace(plugin, unusable="incompatible", why=str(error))
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"while {plugin.distribution} was loaded") from None
    except BaseException as error:  # SystemExit at import is a plugin's fault too
        return replace(plugin, unusable="broken", why=worded(error, package))


def offer_of(component: type[Component]) -> Offer:
    """The offer of a class that is known to be usable."""
    return Offer(component.type_name(), interface_of(component), component)


def _offered(entry: EntryPoint) -> list[Any]:
    manager = pluggy.PluginManager(GROUP)
    manager.add_hookspecs(Hooks)
    module = entry.load()
    declared = getattr(module, "pbdkit_api", None)
    if declared is None:  # the entry point may name an object in the module
        declared = getattr(sys.modules.get(entry.module), "pbdkit_api", API)
    if type(declared) is not int:
        raise TypeError(f"its `pbdkit_api` should be a whole number, got {declared!r}")
    if declared != API:
        raise IncompatibleError(
            f"it is written for version {declared} of the plugin API, and pbdkit "
            f"{version(BUILTIN)} has version {API}; install a version of either that fits the other"
        )
    manager.register(module, entry.name)
    manager.check_pending()
    if not manager.hook.pbdkit_components.get_hookimpls():
        raise TypeError("its module implements no hook `pbdkit_components`")
    answers = manager.hook.pbdkit_components()
    if not answers or not isinstance(answers[0], list):
        raise TypeError("its hook `pbdkit_components` must return a list of component classes")
    return list({id(component): component for component in answers[0]}.values())


def _offer(component: Any, package: str) -> Offer:
    try:
        return checked(component)
    except (Exception, SystemExit) as error:
        name, interface = "", None
        with suppress(Exception):
            interface, name = interface_of(component), str(component.type_name())
        return Offer(name, interface, reason=worded(error, package))


def checked(component: Any) -> Offer:
    """The offer of a component class; raises TypeError, with what to mend, where it is none that
    can be used."""
    if isinstance(component, Component):
        name = type(component).__name__
        raise TypeError(f"an object of {name} is offered; offer the class {name} itself")
    interfaces = tuple(INTERFACES.values())
    if not (inspect.isclass(component) and issubclass(component, interfaces)):
        raise TypeError(f"{component!r} is no class of one of pbdkit's interfaces")
    own, name = component.__name__, component.type_name()
    if not re.fullmatch(TYPE, name):
        raise TypeError(
            f"{own} has the type '{name}': a type begins with a letter or digit and "
            "holds letters, digits, '.', '_' and '-' only"
        )
    if missing := ", ".join(sorted(getattr(component, "__abstractmethods__", ()))):
        raise TypeError(f"{own} lacks {missing}")
    _check_functions(component)
    try:
        component.model_json_schema()
    except Exception as error:
        why = f"cannot be described in a JSON Schema: {worded(error)}"
        raise TypeError(f"the parameters of {own} {why}") from None
    _check_defaults(component)
    return offer_of(component)


def _check_functions(component: type[Component]) -> None:
    """What the interface declares is called as the interface declares it."""
    interface, of = interface_of(component), component.__name__
    for name, declared in list(vars(interface).items()):
        if name.startswith("_") or not callable(getattr(interface, name)):
            continue
        own = inspect.getattr_static(component, name)
        more = issubclass(component, SharesParticles) and name in vars(SharesParticles)
        asked = getattr(SharesParticles if more else interface, name)
        given = list(inspect.signature(asked).parameters)
        called = f"{name}({', '.join(given)})"
        if isinstance(declared, staticmethod) and not isinstance(own, staticmethod):
            how = f"write @staticmethod above it, and no `self` in {called}"
            raise TypeError(f"{of}.{name} must be static: {how}")
        if isinstance(own, (staticmethod, classmethod)):
            given = [parameter for parameter in given if parameter != "self"]
        try:
            signature = inspect.signature(getattr(component, name))
        except (TypeError, ValueError):  # a function in C does not always tell
            continue
        try:
            signature.bind(*given)
        except TypeError:
            raise TypeError(f"{of}.{name}{signature} is called as {called}") from None


def _check_defaults(component: type[Component]) -> None:
    """They are of the types that the parameters declare: the user could not mend them."""
    try:
        component.model_validate({})
    except ValidationError as error:
        for fault in error.errors():
            if fault["loc"] and fault["type"] not in REFUSALS:
                raise TypeError(
                    f"the default of {component.__name__}.{fault['loc'][0]} does not fit: "
                    f"{one_line(fault['msg'])}, got {fault['input']!r}"
                ) from None
    except (Exception, SystemExit):  # what its own code raises is said where it is used
        return
