"""Hooks that a distribution may implement, and installed plugins.

Each plugin is loaded in isolation, so that an error in its code becomes a message with the name of
the plugin.

This module does not import the interfaces of components, so that commands start without them.
"""

from __future__ import annotations

import os
import re
import sys
import traceback
import warnings
from collections.abc import Callable
from contextlib import chdir, redirect_stdout, suppress
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from importlib.metadata import Distribution, EntryPoint, distribution, distributions, version
from pathlib import PurePath, PureWindowsPath
from typing import Any

import pluggy

from pbdkit.errors import AnswerError, did_you_mean, one_line

GROUP = "pbdkit"
"""The entry-point group of plugins, and the project name that pluggy's hook markers require."""
COMMAND_GROUP = "pbdkit.commands"
"""The entry-point group of modules that implement `pbdkit_commands`.

These modules are imported when commands are listed; the modules of the group "pbdkit" are not.
"""

hookspec = pluggy.HookspecMarker(GROUP)
hookimpl = pluggy.HookimplMarker(GROUP)
"""Marks a function of a plugin as the implementation of a hook of the same name."""


@cache
def pbdkit_version() -> str:
    """Return the version of pbdkit. The metadata of the distribution are read once."""
    return version(GROUP)


def import_object(target: str) -> Any:
    """Import and return an object, given as ``module:attribute``."""
    module, _, attribute = target.partition(":")
    return getattr(import_module(module), attribute)


@dataclass(frozen=True)
class Command:
    """A command of the program `pbdkit`.

    Parameters
    ----------
    name : str
        The word after `pbdkit`: lower-case letters, digits and hyphens.
    target : str
        The click command, as ``module:attribute``.
    does : str
        One sentence for `pbdkit --help`.
    group : str
        Heading in `pbdkit --help` under which the command is listed.
    """

    name: str
    target: str
    does: str
    group: str = "Plugins"

    def load(self) -> Any:
        """Import the click command.

        Returns
        -------
        click.Command
            Command that the target names.
        """
        return import_object(self.target)


class Hooks:
    """Hooks that a plugin may implement, as functions of the module that its entry point names."""

    @hookspec
    def pbdkit_components(self) -> list[type[Any]]:
        """The component classes that the distribution offers."""
        raise NotImplementedError  # This is a specification, which pluggy never calls.

    @hookspec
    def pbdkit_commands(self) -> list[Command]:
        """Return the commands that the distribution adds to the program `pbdkit`.

        The module of a command is imported when the command is called. For this to be fast, the
        module of this hook should import nothing except `pbdkit.plugin`.
        """
        raise NotImplementedError


NUMBERS = {"Parameters": "p", "Weights": "w", "Constants": "c", "Own": "here.own"}
"""Names of the arguments of elementwise functions, by the name of the class of the argument."""

NO_REFERENCE = (
    "`here.X` and `here.centred` exist only in rules that declare `uses_reference: ClassVar[bool] "
    "= True`"
)
"""Message about reference positions in rules that do not declare their use."""


SLIPS: tuple[tuple[type[Exception], str, str], ...] = (
    (IndexError, "tuple index out of range",
     "`total` contains the sums of the values that `gather` and `gather_pair` return"),
    (ValueError, "could not be broadcast",
     "compute one value for each particle, element by element from the arguments"),
    (ValueError, "read-only",
     "make new arrays, `x = x + 1` instead of `x += 1`"),
    (TypeError, "can be converted to Python scalars",
     "use functions of numpy, as `numpy.sqrt`, in place of those of `math`"),
    (TypeError, "'numpy.ndarray' object is not callable",
     "a table is evaluated by `interpolate(x, p.name)`"),
    (AttributeError, "can't set attribute",
     "components of a vector cannot be set; make a new one, as `Vector(0.5 * v.x, v.y)`"),
)  # fmt: skip
"""Frequent errors in elementwise functions: type, words of the message, and remedy."""


def worded(error: BaseException, package: str = "", component: type[Any] | None = None) -> str:
    """Return ``Type: message`` of an error in foreign code.

    The text is on one line, without control characters, and shortened if it is long.

    Parameters
    ----------
    error
        The error.
    package
        Package of the foreign code. The last line of the traceback that lies in it is appended.
    component
        Component in which the error occurred. The remedy for the error is appended.
    """
    try:
        message = str(error)
    except Exception:  # `__str__` of an error class of a plugin can fail.
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


def remedy(error: BaseException, component: type[Any] | None = None) -> str:
    """Return the remedy for frequent errors in elementwise functions."""
    if isinstance(error, ValueError) and "truth value of an array" in str(error):
        return "; use `pbdkit.plugin.where` instead of `if`, `and` and `or`"
    of_none = isinstance(error, AttributeError | TypeError) and "'NoneType'" in str(error)
    if of_none and not getattr(component, "uses_reference", True):
        return f"; {NO_REFERENCE}"
    for slip, words, advice in SLIPS:
        if isinstance(error, slip) and words in str(error):
            return f"; {advice}"
    if not isinstance(error, AttributeError):
        return ""
    name, kind = str(error.name), type(error.obj).__name__
    if kind in ("Vector", "SpaceVector"):
        return f"; vectors have the components {', '.join(vars(type(error.obj))['_fields'])}"
    if kind in NUMBERS and component and name in component.model_fields:
        return (
            f"; `{NUMBERS[kind]}` contains numbers, and the parameter '{name}' is not a number: "
            "convert it in `parameters` or `weights`, or declare it as `Literal[...]` (words) or "
            "`Table` (points)"
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

DISABLE = "PBDKIT_DISABLE_PLUGINS"
"""Environment variable that lists plugins to be disabled, by distribution or entry point."""
ALL = "*"
"""Value of the environment variable that disables all plugins."""

SEVERITY = ("ok", "conflict", "broken")
"""States of an offer in the order of increasing severity; a plugin has the most severe state of its
offers."""


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
    interface: type[Any] | None = None
    component: type[Any] | None = None
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
    def components(self) -> tuple[type[Any], ...]:
        """Component classes that are usable."""
        return tuple(o.component for o in self.offers if o.component)

    def answers_to(self, name: str) -> bool:
        """Return whether a name is that of the distribution or of the entry point."""
        return canonical(name) in (canonical(self.distribution), canonical(self.name))

    def __str__(self) -> str:
        return f"{self.distribution} {self.version}".strip()


def installed_plugins(group: str = GROUP) -> list[Plugin]:
    """Return the entry points of other distributions in a group, sorted by name.

    They are not loaded.

    A distribution with unreadable metadata is returned as a broken plugin, and one that the user
    disables as a disabled plugin. If two distributions have the same name, the first one on the
    Python path is used.
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
    for name in sorted(names - {GROUP}):
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
        why = f"plugins are disabled (--no-plugins or {DISABLE}={ALL})"
    elif any(map(plugin.answers_to, names)):
        why = f"{DISABLE} contains it"
    return replace(plugin, unusable="disabled", why=why) if why else plugin


def disabled_names() -> list[str]:
    """Return the names in the environment variable `DISABLE`."""
    return [word.strip() for word in os.environ.get(DISABLE, "").split(",") if word.strip()]


def canonical(name: str) -> str:
    """Return the normalised name of a distribution."""
    return re.sub(r"[-_.]+", "-", name).lower()


class IncompatibleError(Exception):
    """The plugin implements another version of the plugin API."""


def with_commands(plugin: Plugin) -> Plugin:
    """Import a plugin and call its hook `pbdkit_commands`.

    An error is stored as the state and reason of the plugin; disabled plugins are not imported.
    """

    def load(entry: EntryPoint, package: str) -> Plugin:
        answer = hook_answer(entry, "pbdkit_commands", "commands")
        return replace(plugin, commands=tuple(map(_checked_command, answer)))

    return guarded(plugin, load)


def guarded(plugin: Plugin, load: Callable[[EntryPoint, str], Plugin]) -> Plugin:
    """Load a plugin, and store an error as its state and reason.

    Text that the plugin prints at import is written to standard error. Changes of the warning
    filters and of the working folder by the plugin are undone.
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
    except BaseException as error:  # This includes SystemExit at import.
        return replace(plugin, unusable="broken", why=worded(error, package))


def hook_answer(entry: EntryPoint, hook: str, elements: str) -> list[Any]:
    """Call a hook in the module of an entry point, and return its list of `elements`."""
    manager = pluggy.PluginManager(GROUP)
    manager.add_hookspecs(Hooks)
    module = entry.load()
    declared = getattr(module, "pbdkit_api", None)
    if declared is None:  # The entry point can refer to an object in the module.
        declared = getattr(sys.modules.get(entry.module), "pbdkit_api", API)
    if type(declared) is not int:
        raise TypeError(f"its `pbdkit_api` should be a whole number, got {declared!r}")
    if declared != API:
        raise IncompatibleError(
            f"it implements version {declared} of the plugin API, but pbdkit {version(GROUP)} "
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
        If the command is not usable. The message contains the remedy.
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
