"""Plugin hooks, and discovery of installed plugins by pluggy.

Each plugin is loaded in its own guard, and errors of a component name the component and its
distribution. Components of earlier versions are mapped to their successors until version 1.0.
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
"""Names of the arguments of elementwise functions, by the class of their named tuple."""
NO_REFERENCE = (
    "`here.X` and `here.centred` are given to rules that declare "
    "`uses_reference: ClassVar[bool] = True`"
)
"""Message about reference positions in rules that do not declare their use."""


def interface_of(component: type[Component]) -> type[Component]:
    """Return the open interface that a component class implements."""
    return next(i for i in INTERFACES.values() if issubclass(component, i))


def whose(component: type[Component]) -> str:
    """Return interface, type and distribution of a component: ``FollowerRule 'odd' of pbdkit-odd
    0.3``.

    The distribution is that whose entry point refers to the package of the component.
    """
    package, origin = component.__module__.split(".")[0], ""
    with suppress(Exception):  # metadata of other distributions can be damaged
        for point in entry_points(group=GROUP):
            if point.module.split(".")[0] == package != GROUP and point.dist:
                origin = f" of {point.dist.name} {point.dist.version}".rstrip()
    return f"{interface_of(component).__name__} '{component.type_name()}'{origin}"


def blame(component: type[Component], when: str, error: BaseException) -> PluginError:
    """Return the PluginError for an error in the code of a component."""
    message = worded(error, component.__module__.split(".")[0], component)
    return PluginError(f"{whose(component)} failed {when}: {message}")


@contextmanager
def blaming(component: Component, when: str, *field: str | int) -> Iterator[None]:
    """Convert errors in the code of a component.

    An exception becomes a PluginError with interface, type and distribution of the component. An
    ExperimentError gets the `field` of the component, if one is given. An interrupt gets the place.
    """
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"in {whose(type(component))} {when}") from None
    except ExperimentError as error:
        if not field:
            raise blame(type(component), when, error) from error
        has_field = error.where[: len(field)] == field
        raise ExperimentError(
            str(error), error.where if has_field else (*field, *error.where)
        ) from None
    except (PbdkitError, MemoryError, FloatingPointError):
        raise
    except (Exception, SystemExit) as error:
        raise blame(type(component), when, error) from error


def worded(
    error: BaseException, package: str = "", component: type[Component] | None = None
) -> str:
    """Return ``Type: message`` of an error in foreign code.

    The text is on one line, without control characters, and shortened if it is long.

    Parameters
    ----------
    error
        The error.
    package
        Package for which the last place in the traceback is appended.
    component
        Component for which a remedy is appended.
    """
    try:
        message = str(error)
    except Exception:  # `__str__` of an error class of a plugin can fail
        message = "(its message is not available)"
    if isinstance(error, AnswerError):
        return one_line(message)
    text = f"{type(error).__name__}: {message}" if message else type(error).__name__
    place = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        if package and str(frame.f_globals.get("__name__")).split(".")[0] == package:
            # PureWindowsPath accepts the separators of every system
            place = f" ({PureWindowsPath(frame.f_code.co_filename).name}, line {line})"
    advice = ""
    with suppress(Exception):  # attributes of foreign errors and objects can fail
        advice = remedy(error, component)
    return one_line(text) + advice + place


def remedy(error: BaseException, component: type[Component] | None = None) -> str:
    """Return the remedy for frequent errors in elementwise functions."""
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
            f"; `{NUMBERS[kind]}` contains numbers, and the parameter '{name}' is not a number: "
            "convert it in `parameters` or `weights`"
        )
    names = [n for n in getattr(error.obj, "_fields", dir(error.obj)) if not n.startswith("_")]
    content = ""
    if kind in NUMBERS:
        content = f"; `{NUMBERS[kind]}` contains {', '.join(names) or 'nothing'}"
    return did_you_mean(name, names) or content


API = 1
"""Version of the hooks and the interfaces.

A plugin can declare the version that it implements as `pbdkit_api`, in the module or on the object
of its entry point.
"""

DISABLE, ALL = "PBDKIT_DISABLE_PLUGINS", "*"
"""The variable that lists what is not to be loaded, distributions or entry points, and its value
for: nothing at all."""
SEVERITY = ("ok", "conflict", "broken")
"""States of an offer in increasing severity; the state of a plugin is the most severe."""


@dataclass(frozen=True)
class Offer:
    """Component of a plugin.

    Parameters
    ----------
    name
        Type of the component.
    interface
        Interface, if it is known.
    component
        Class; None if it is not usable.
    reason
        Why it is not usable, or in conflict with others.
    """

    name: str
    interface: type[Component] | None = None
    component: type[Component] | None = None
    reason: str = ""

    @property
    def state(self) -> str:
        """State: ok, conflict or broken."""
        usable = "conflict" if self.reason else "ok"
        return usable if self.component else "broken"


@dataclass(frozen=True)
class Plugin:
    """Entry point of a distribution, with the components and commands that it provides.

    Parameters
    ----------
    name
        Name of the entry point.
    distribution, version
        Name and version of the distribution.
    entry
        Entry point.
    offers
        Components, after loading.
    commands
        Commands, after loading.
    unusable
        State if the plugin cannot be used.
    why
        Reason of that state.
    """

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
        """State: ok, disabled, broken (in whole or in part), incompatible or conflict."""
        states = [offer.state for offer in self.offers]
        return self.unusable or max(states, key=SEVERITY.index, default="ok")

    @property
    def reason(self) -> str:
        """Reason of the state, empty if it is ok."""
        return self.why or "; ".join(dict.fromkeys(o.reason for o in self.offers if o.reason))

    @property
    def fault(self) -> str:
        """State and reason if the plugin cannot be used, otherwise empty."""
        return "" if self.state in ("ok", "conflict") else f"{self.state}: {self.reason}"

    @property
    def components(self) -> tuple[type[Component], ...]:
        """Usable component classes."""
        return tuple(o.component for o in self.offers if o.component)

    def answers_to(self, name: str) -> bool:
        """Return whether a name is that of the distribution or of the entry point."""
        return canonical(name) in (canonical(self.distribution), canonical(self.name))

    def __str__(self) -> str:
        return f"{self.distribution} {self.version}".strip()


def installed_plugins(group: str = GROUP) -> list[Plugin]:
    """Return the entry points in a group of all other distributions, sorted by name, without
    loading them.

    A distribution with unreadable metadata becomes a broken plugin, one that the user disables a
    disabled plugin. Of two distributions with the same name, the first on the Python path counts.
    """
    names: set[str] = set()
    plugins: list[Plugin] = []
    for candidate in distributions():
        try:
            if f"[{group}]" in (candidate.read_text("entry_points.txt") or ""):
                names.add(canonical(_field(candidate, "Name")))
        except Exception as error:
            folder = PurePath(str(getattr(candidate, "_path", "(no name)"))).name
            plugins.append(_damaged(folder, error))
    for name in sorted(names - {BUILTIN}):
        try:
            source = distribution(name)
            label = _field(source, "Name"), _field(source, "Version")
            points = source.entry_points.select(group=group)
            plugins += [_with_state(Plugin(point.name, *label, point)) for point in points]
        except Exception as error:
            plugins.append(_damaged(name or "(no name)", error))
    return sorted(plugins, key=lambda plugin: (plugin.distribution, plugin.name))


def _field(source: Distribution, name: str) -> str:
    """Return a field of the metadata, or an empty string.

    The backport importlib_metadata, which replaces Python's reader once it is imported, raises if
    there are no metadata.
    """
    metadata: Any = None
    with suppress(FileNotFoundError):
        metadata = source.metadata
    return (metadata and metadata.get(name)) or ""


def _damaged(distribution: str, error: Exception) -> Plugin:
    why = f"its metadata cannot be read: {worded(error)}"
    return Plugin("", distribution, "", unusable="broken", why=why)


def _with_state(plugin: Plugin) -> Plugin:
    """Disable the plugin if the user demands it."""
    why = ""
    if ALL in (names := disabled_names()):
        why = f"all plugins are disabled (--no-plugins or {DISABLE}={ALL})"
    elif any(map(plugin.answers_to, names)):
        why = f"{DISABLE} contains it"
    return replace(plugin, unusable="disabled", why=why) if why else plugin


def disabled_names() -> list[str]:
    """Return the names in the environment variable `DISABLE`."""
    return [word.strip() for word in os.environ.get(DISABLE, "").split(",") if word.strip()]


def canonical(name: str) -> str:
    """Return the normalised name of a distribution."""
    return re.sub(r"[-_.]+", "-", name).lower()


TYPE = r"[A-Za-z0-9][A-Za-z0-9._-]*"
"""Pattern of the type of a component."""
REFUSALS = ("missing", "value_error", "assertion_error")
"""Types of pydantic errors that do not concern defaults.

A parameter is missing, or rejected by a validator of the component.
"""


class IncompatibleError(Exception):
    """The plugin implements another version of the plugin API."""


@cache
def load_builtin() -> Plugin:
    """Load the built-in components by their entry point, without other plugins.

    They are not checked, because tests do this.
    """
    source = distribution(BUILTIN)
    (entry,) = source.entry_points.select(group=GROUP)
    return Plugin(entry.name, BUILTIN, source.version, entry, tuple(map(offer_of, _offered(entry))))


def loaded(plugin: Plugin) -> Plugin:
    """Import a plugin and call its hook `pbdkit_components`.

    Errors become state and reason of the plugin; disabled plugins are not imported. An unusable
    class does not affect the others.
    """

    def load(entry: EntryPoint, package: str) -> Plugin:
        return replace(plugin, offers=tuple(_offer(c, package) for c in _offered(entry)))

    return _guarded(plugin, load)


def with_commands(plugin: Plugin) -> Plugin:
    """Import a plugin and call its hook `pbdkit_commands`.

    Errors become state and reason of the plugin; disabled plugins are not imported.
    """

    def load(entry: EntryPoint, package: str) -> Plugin:
        answer = _answer_of(entry, "pbdkit_commands", "commands")
        return replace(plugin, commands=tuple(map(_checked_command, answer)))

    return _guarded(plugin, load)


def _guarded(plugin: Plugin, load: Callable[[EntryPoint, str], Plugin]) -> Plugin:
    """Load a plugin; errors become its state and reason.

    Output of the plugin at import goes to standard error; its warning filters and working folder
    are isolated.
    """
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
    except BaseException as error:  # includes SystemExit at import
        return replace(plugin, unusable="broken", why=worded(error, package))


def offer_of(component: type[Component]) -> Offer:
    """Return the offer of a usable component class."""
    return Offer(component.type_name(), interface_of(component), component)


def _offered(entry: EntryPoint) -> list[Any]:
    answer = _answer_of(entry, "pbdkit_components", "component classes")
    return list({id(component): component for component in answer}.values())


def _answer_of(entry: EntryPoint, hook: str, elements: str) -> list[Any]:
    """Return the list of `elements` that a hook of the module of an entry point returns."""
    manager = pluggy.PluginManager(GROUP)
    manager.add_hookspecs(Hooks)
    module = entry.load()
    declared = getattr(module, "pbdkit_api", None)
    if declared is None:  # the entry point can refer to an object in the module
        declared = getattr(sys.modules.get(entry.module), "pbdkit_api", API)
    if type(declared) is not int:
        raise TypeError(f"its `pbdkit_api` should be a whole number, got {declared!r}")
    if declared != API:
        raise IncompatibleError(
            f"it implements version {declared} of the plugin API, but pbdkit {version(BUILTIN)} "
            f"has version {API}; install compatible versions of both"
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
    """Return the command if it is usable.

    Raises
    ------
    TypeError
        If it is not, with the remedy.
    """
    if not isinstance(command, Command):
        raise TypeError(f"{command!r} is not a pbdkit.plugin.Command")
    if not re.fullmatch(r"[a-z][a-z0-9-]*", command.name):
        raise TypeError(
            f"'{command.name}' is not a valid name of a command; it must begin with a lower-case "
            "letter and contain only lower-case letters, digits and '-'"
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
    """Return the offer of a component class if it is usable.

    Raises
    ------
    TypeError
        If it is not, with the remedy.
    """
    if isinstance(component, Component):
        name = type(component).__name__
        raise TypeError(f"the hook returned an object of {name}; return the class {name}")
    interfaces = tuple(INTERFACES.values())
    if not (inspect.isclass(component) and issubclass(component, interfaces)):
        raise TypeError(f"{component!r} does not implement an interface of pbdkit")
    label, name = component.__name__, component.type_name()
    if not re.fullmatch(TYPE, name):
        raise TypeError(
            f"{label} has the type '{name}'; a type must begin with a letter or digit and contain "
            "only letters, digits, '.', '_' and '-'"
        )
    if missing := ", ".join(sorted(getattr(component, "__abstractmethods__", ()))):
        raise TypeError(f"{label} does not define {missing}")
    _check_functions(component)
    try:
        component.model_json_schema()
    except Exception as error:
        why = f"cannot be described in a JSON Schema: {worded(error)}"
        raise TypeError(f"the parameters of {label} {why}") from None
    _check_defaults(component)
    return offer_of(component)


def _check_functions(component: type[Component]) -> None:
    """Check that methods have the signature of the interface, and are static where declared so."""
    interface, label = interface_of(component), component.__name__
    for name, declared in list(vars(interface).items()):
        if name.startswith("_") or not callable(getattr(interface, name)):
            continue
        function = inspect.getattr_static(component, name)
        is_shared = issubclass(component, SharesParticles) and name in vars(SharesParticles)
        specification = getattr(SharesParticles if is_shared else interface, name)
        parameters = list(inspect.signature(specification).parameters)
        call = f"{name}({', '.join(parameters)})"
        if isinstance(declared, staticmethod) and not isinstance(function, staticmethod):
            text = f"write @staticmethod above it, without `self` in {call}"
            raise TypeError(f"{label}.{name} must be static: {text}")
        if isinstance(function, (staticmethod, classmethod)):
            parameters = [parameter for parameter in parameters if parameter != "self"]
        try:
            signature = inspect.signature(getattr(component, name))
        except (TypeError, ValueError):  # functions in C can lack a signature
            continue
        try:
            signature.bind(*parameters)
        except TypeError:
            raise TypeError(f"{label}.{name}{signature} is called as {call}") from None


def _check_defaults(component: type[Component]) -> None:
    """Check that defaults have the declared types, because users cannot correct them."""
    try:
        component.model_validate({})
    except ValidationError as error:
        for fault in error.errors():
            if fault["loc"] and fault["type"] not in REFUSALS:
                raise TypeError(
                    f"the default of {component.__name__}.{fault['loc'][0]} is invalid: "
                    f"{one_line(fault['msg'])}, got {fault['input']!r}"
                ) from None
    except (Exception, SystemExit):  # errors of its code are reported where it is used
        return


@dataclass(frozen=True)
class Retired:
    """Built-in component that was removed.

    Parameters
    ----------
    field
        Field of the experiment.
    type
        Type of the component.
    successor
        Type of its successor.
    difference
        How results differ.
    renumbers
        Whether particles have other numbers under the successor.
    """

    field: str
    type: str
    successor: str
    difference: str
    renumbers: bool = False

    @property
    def advice(self) -> str:
        """Warning for experiments with this component."""
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
"""All retired components."""


def retired_parts(parts: Mapping[str, Any]) -> list[Retired]:
    """Return the retired components in the parts of an experiment."""
    result = []
    for component in RETIRED:
        part = parts.get(component.field)
        name = part.get("type") if isinstance(part, Mapping) else None
        if name in (component.type, f"{BUILTIN}:{component.type}"):
            result.append(component)
    return result


def with_successors(parts: Mapping[str, Any]) -> dict[str, Any]:
    """Replace retired components in the parts of an experiment by their successors."""
    successors = {
        component.field: {**parts[component.field], "type": component.successor}
        for component in retired_parts(parts)
    }
    return {**parts, **successors}


def refuse_retired(parts: Mapping[str, Any], what: str) -> None:
    """Raise ExperimentError if a scene cannot be built again because a component is retired.

    Parameters
    ----------
    parts
        Parts of the experiment.
    what
        What requires the scene, for the message.
    """
    for component in retired_parts(parts):
        field = component.field
        raise ExperimentError(
            f"{what} requires the scene of the run, but its {field} '{component.type}' is retired; "
            f"run the experiment again, with {field}: {{type: {component.successor}}}"
        )


def is_retired(interface: type | None, name: str) -> bool:
    """Return whether a type is the name of a retired component of an interface."""
    return any(name == part.type and INTERFACES[part.field] is interface for part in RETIRED)
