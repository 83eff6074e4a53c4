"""Plugin hooks and discovery of installed plugins by pluggy: each is loaded in its own guard, and
an error of a component names the component and its distribution.

Components of earlier versions are mapped to their successors until version 1.0.
"""

from __future__ import annotations

import inspect
import os
import re
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import chdir, contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import (
    Distribution,
    EntryPoint,
    distribution,
    distributions,
    entry_points,
    version,
)
from pathlib import PurePath, PureWindowsPath
from typing import Any

import pluggy
from pydantic import ValidationError

from pbdkit.errors import ExperimentError, PbdkitError, PluginError, did_you_mean, one_line
from pbdkit.plugin import BUILTIN, INTERFACES, Component, SharesParticles
from pbdkit.plugin.component import AnswerError
from pbdkit.plugin.hooks import GROUP, Command, Hooks

NUMBERS = {"Parameters": "p", "Weights": "w", "Constants": "c", "Own": "here.own"}
"""What authors call the tuples of numbers that their functions are given."""
NO_REFERENCE = (
    "`here.X` and `here.centred` are given to rules that declare "
    "`uses_reference: ClassVar[bool] = True`"
)


def interface_of(component: type[Component]) -> type[Component]:
    """The open interface that a component class implements."""
    return next(i for i in INTERFACES.values() if issubclass(component, i))


def whose(component: type[Component]) -> str:
    """``FollowerRule 'odd' of pbdkit-odd 0.3``, where a distribution's entry point leads to its
    package."""
    package, origin = component.__module__.split(".")[0], ""
    with suppress(Exception):  # metadata of others can be torn
        for point in entry_points(group=GROUP):
            if point.module.split(".")[0] == package != GROUP and point.dist:
                origin = f" of {point.dist.name} {point.dist.version}".rstrip()
    return f"{interface_of(component).__name__} '{component.type_name()}'{origin}"


def blame(component: type[Component], when: str, error: BaseException) -> PluginError:
    """The error to raise where a component's own code has failed."""
    told = worded(error, component.__module__.split(".")[0], component)
    return PluginError(f"{whose(component)} failed {when}: {told}")


@contextmanager
def blaming(component: Component, when: str, *field: str | int) -> Iterator[None]:
    """What a component's own code raises becomes a PluginError with its interface, type and
    distribution; what it refuses with an ExperimentError is about its `field` of the experiment,
    where one is given. An interrupt says where it came."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"in {whose(type(component))} {when}") from None
    except ExperimentError as error:
        if not field:
            raise blame(type(component), when, error) from error
        named = error.where[: len(field)] == field
        raise ExperimentError(
            str(error), error.where if named else (*field, *error.where)
        ) from None
    except (PbdkitError, MemoryError, FloatingPointError):
        raise
    except (Exception, SystemExit) as error:
        raise blame(type(component), when, error) from error


def worded(
    error: BaseException, package: str = "", component: type[Component] | None = None
) -> str:
    """Return ``Type: message`` of whatever foreign code raised, on one line, without control
    characters, cut where it is long; with `package`, the place in its code where the traceback has
    one, and with the `component` whose code it is a remedy that fits."""
    try:
        message = str(error)
    except Exception:  # a plugin's own error class can fail to say what it is
        message = "(its message cannot be had)"
    if isinstance(error, AnswerError):
        return one_line(message)
    told = f"{type(error).__name__}: {message}" if message else type(error).__name__
    place = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        if package and str(frame.f_globals.get("__name__")).split(".")[0] == package:
            # which takes the separators of every system
            place = f" ({PureWindowsPath(frame.f_code.co_filename).name}, line {line})"
    advice = ""
    with suppress(Exception):  # foreign errors and objects can fail to be looked at
        advice = remedy(error, component)
    return one_line(told) + advice + place


def remedy(error: BaseException, component: type[Component] | None = None) -> str:
    """Return what elementwise functions are to do instead, where the fault is a frequent one."""
    if isinstance(error, ValueError) and "truth value of an array" in str(error):
        return "; choose with `pbdkit.plugin.where` in the place of `if`, `and` and `or`"
    of_none = isinstance(error, AttributeError | TypeError) and "'NoneType'" in str(error)
    if of_none and not getattr(component, "uses_reference", True):
        return f"; {NO_REFERENCE}"
    if not isinstance(error, AttributeError):
        return ""
    name, kind = str(error.name), type(error.obj).__name__
    if kind in NUMBERS and component and name in component.model_fields:
        return (
            f"; `{NUMBERS[kind]}` holds numbers, and the parameter '{name}' is none: make numbers "
            "of it in `parameters` or `weights`"
        )
    known = [n for n in getattr(error.obj, "_fields", dir(error.obj)) if not n.startswith("_")]
    there = f"; `{NUMBERS[kind]}` holds {', '.join(known) or 'nothing'}" if kind in NUMBERS else ""
    return did_you_mean(name, known) or there


API = 1
"""The version of the hook and the interfaces. A plugin may declare the one that it was written for
as `pbdkit_api`, in the module or on the object that its entry point names."""

DISABLE, ALL = "PBDKIT_DISABLE_PLUGINS", "*"
"""The variable that lists what is not to be loaded, distributions or entry points, and its value
for: nothing at all."""
SEVERITY = ("ok", "conflict", "broken")
"""The states of what a plugin offers; its own is the worst of them."""


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
    commands: tuple[Command, ...] = ()
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


def installed_plugins(group: str = GROUP) -> list[Plugin]:
    """Return the entry points in a group of all distributions but our own, sorted by the names of
    both, not loaded.

    Metadata that cannot be read become a broken plugin, and what the user does not want loaded a
    disabled one. Of two distributions with one name the first on Python's path counts, as for
    Python itself.
    """
    names: set[str] = set()
    found: list[Plugin] = []
    for each in distributions():
        try:
            if f"[{group}]" in (each.read_text("entry_points.txt") or ""):
                names.add(canonical(_field(each, "Name")))
        except Exception as error:
            folder = PurePath(str(getattr(each, "_path", "(no name)"))).name
            found.append(_torn(folder, error))
    for name in sorted(names - {BUILTIN}):
        try:
            own = distribution(name)
            what = _field(own, "Name"), _field(own, "Version")
            points = own.entry_points.select(group=group)
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
    """Import the plugin, unless it is disabled, and call its hook `pbdkit_components`; a fault
    becomes its state and reason. One unusable class leaves the others of the plugin in use."""

    def load(entry: EntryPoint, package: str) -> Plugin:
        return replace(plugin, offers=tuple(_offer(c, package) for c in _offered(entry)))

    return _guarded(plugin, load)


def with_commands(plugin: Plugin) -> Plugin:
    """Import the plugin, unless it is disabled, and call its hook `pbdkit_commands`; a fault
    becomes its state and reason."""

    def load(entry: EntryPoint, package: str) -> Plugin:
        answer = _answer_of(entry, "pbdkit_commands", "commands")
        return replace(plugin, commands=tuple(map(_checked_command, answer)))

    return _guarded(plugin, load)


def _guarded(plugin: Plugin, load: Callable[[EntryPoint, str], Plugin]) -> Plugin:
    """Return the loaded plugin, or with the reason why it cannot be. What a plugin prints at import
    is no output of the program; its filters of warnings and its folder are its own."""
    if plugin.unusable or plugin.entry is None:
        return plugin
    package = plugin.entry.value.split(":")[0].split(".")[0].strip()
    try:
        with chdir("."), redirect_stdout(sys.stderr), warnings.catch_warnings():
            return load(plugin.entry, package)
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
    answer = _answer_of(entry, "pbdkit_components", "component classes")
    return list({id(component): component for component in answer}.values())


def _answer_of(entry: EntryPoint, hook: str, elements: str) -> list[Any]:
    """Return the list of `elements` that a hook of the entry point's module returns."""
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
    caller = getattr(manager.hook, hook)
    if not caller.get_hookimpls():
        raise TypeError(f"its module implements no hook `{hook}`")
    answers = caller()
    if not answers or not isinstance(answers[0], list):
        raise TypeError(f"its hook `{hook}` must return a list of {elements}")
    return answers[0]


def _checked_command(command: Any) -> Command:
    """Return the command; raise TypeError, with what to mend, where it cannot be used."""
    if not isinstance(command, Command):
        raise TypeError(f"{command!r} is no pbdkit.plugin.Command")
    if not re.fullmatch(r"[a-z][a-z0-9-]*", command.name):
        raise TypeError(
            f"'{command.name}' is no name for a command: it begins with a lower-case letter and "
            "holds lower-case letters, digits and '-' only"
        )
    if not re.fullmatch(r"[\w.]+:\w+", command.target):
        raise TypeError(
            f"the target of the command '{command.name}' is '{command.target}'; write "
            "'module:attribute'"
        )
    return command


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


@dataclass(frozen=True)
class Retired:
    """A built-in component that was removed: its `type` in a `field` of an experiment, the type
    that takes its place, and how results differ. `renumbers` is true where particles get other
    numbers."""

    field: str
    type: str
    successor: str
    difference: str
    renumbers: bool = False

    @property
    def advice(self) -> str:
        """The warning of experiments that name it."""
        return (
            f"'{self.type}' is retired and read as '{self.successor}' until version 1.0; "
            f"{self.difference}; write {self.field}: {{type: {self.successor}}}"
        )


RETIRED = (
    Retired(
        field="frame",
        type="traction-free",
        successor="natural",
        difference="the body then ends at its outermost particles, not half a spacing outside "
        "them, and no frame points are numbered",
        renumbers=True,
    ),
)


def retired_parts(parts: Mapping[str, Any]) -> list[Retired]:
    """Return the retired components that the parts of an experiment name."""
    found = []
    for one in RETIRED:
        part = parts.get(one.field)
        name = part.get("type") if isinstance(part, Mapping) else None
        if name in (one.type, f"{BUILTIN}:{one.type}"):
            found.append(one)
    return found


def with_successors(parts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parts with the successors of retired components in their places."""
    renewed = {
        one.field: {**parts[one.field], "type": one.successor} for one in retired_parts(parts)
    }
    return {**parts, **renewed}


def refuse_retired(parts: Mapping[str, Any], what: str) -> None:
    """Raise ExperimentError where a scene that was run cannot be built again, since the parts of
    its experiment name a retired component; `what` needs the scene."""
    for one in retired_parts(parts):
        raise ExperimentError(
            f"{what} needs the scene that was run, and its {one.field} '{one.type}' is retired; "
            f"run the experiment anew, with {one.field}: {{type: {one.successor}}}"
        )


def is_retired(interface: type | None, name: str) -> bool:
    """Return whether a type is the name of a retired component of an interface."""
    return any(name == one.type and INTERFACES[one.field] is interface for one in RETIRED)
