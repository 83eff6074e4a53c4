"""The table of commands. It contains the commands of pbdkit, and the commands that plugins add with
the hook `pbdkit_commands`.

The table lists a command by its name, its target and one sentence. The module of a command is
imported when the command is called. Plugins are searched only if a name is not a command of pbdkit
itself, and for `pbdkit --help`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any, TypeVar

import click
import pluggy

from pbdkit.cli.options import with_no_plugins
from pbdkit.errors import PbdkitError, PluginError, did_you_mean
from pbdkit.hooks import (
    COMMAND_GROUP,
    DISABLE,
    GROUP,
    Command,
    Hooks,
    Plugin,
    hookimpl,
    installed_plugins,
    with_commands,
    worded,
)

T = TypeVar("T")
BUILTIN_MODULES = ("pbdkit.cli.commands", "pbdkit.web", "pbdkit.bench")
"""Modules of pbdkit that implement `pbdkit_commands`. The last two modules import from this
package; therefore no module except this table refers to them."""
GROUPS = ("Start", "Run", "Look", "Understand", "Vary and fit", "Extend")
"""Headings of `pbdkit --help`, in the order of a first session."""

MEANT = {
    ("list", "ls"): "`pbdkit experiments` lists shipped experiments, `pbdkit plugins list` plugins",
    ("show", "view", "draw", "picture", "image"): "`pbdkit plot` draws a result or a set-up",
    ("movie", "video", "gif"): "`pbdkit animate` makes a movie",
    ("continue", "restart"): "`pbdkit resume` continues a run",
    ("validate", "lint", "analyse", "analyze"): "`pbdkit check` checks an experiment",
    (
        "new",
        "create",
        "template",
    ): "`pbdkit init` writes an experiment, `pbdkit plugins new` a plugin",
    ("convert", "vtk", "paraview"): "`pbdkit export` writes VTKHDF for ParaView",
    (
        "info",
        "progress",
    ): "`pbdkit status` shows the progress of a run, `pbdkit report` writes a page about it",
    ("simulate", "solve", "start"): "`pbdkit run` runs an experiment",
    ("test",): "`pbdkit plugins check` tests a plugin",
    ("gui", "play", "interactive"): "`pbdkit live` shows a body that is moved by the mouse",
    ("version",): "`pbdkit --version` prints the version",
}
"""Remedies for words that are often typed as commands but are not commands."""


@hookimpl
def pbdkit_commands() -> list[Command]:
    """Return the commands of `pbdkit.cli`."""
    sentences: dict[str, dict[str, str]] = {
        "Start": {
            "init": "Write an experiment to start from, or copy a shipped one.",
            "experiments": "List the shipped experiments, or print one.",
        },
        "Run": {
            "run": "Run an experiment and write its result to a file.",
            "resume": "Continue an interrupted run, or extend a finished one.",
            "status": "Show the progress and the remaining time of a run.",
        },
        "Look": {
            "plot": "Draw a result, or the set-up of an experiment before it runs.",
            "animate": "Make a movie of a result.",
            "curve": "Draw quantities over time: a curve, a history, the crack.",
            "export": "Write a result for ParaView.",
            "explain": "List the bonds that broke, with step and strain.",
            "verify": "Check that results are unchanged since they were written.",
        },
        "Understand": {
            "check": "Forecast the stability, time and memory of a run.",
            "identify": "Identify the physics of a rule, with its constants.",
        },
        "Vary and fit": {
            "sweep": "Run an experiment for many values of its parameters.",
            "fit": "Fit parameters to measurements, with standard errors.",
        },
        "Extend": {
            "plugins": "List and check plugins, or create one.",
            "schema": "Print the JSON Schema, for completion in an editor.",
        },
    }
    return [
        Command(name, f"pbdkit.cli.interface:{name}", does, group)
        for group, names in sentences.items()
        for name, does in names.items()
    ]


@cache
def builtin_commands() -> dict[str, Command]:
    """Return the commands of pbdkit itself by name, in the order of the groups."""
    manager = pluggy.PluginManager(GROUP)
    manager.add_hookspecs(Hooks)
    # pluggy calls modules in the reverse order of registration.
    for module in reversed(BUILTIN_MODULES):
        manager.register(import_module(module))
    listed = [command for answer in manager.hook.pbdkit_commands() for command in answer]
    listed.sort(key=lambda command: GROUPS.index(command.group))
    return {command.name: command for command in listed}


def plugins_with_commands() -> list[Plugin]:
    """Return the installed plugins that add commands. A plugin that could not be loaded contains
    the reason."""
    return [with_commands(plugin) for plugin in installed_plugins(COMMAND_GROUP)]


class CommandTable(click.Group):
    """A group of commands that are imported when they are called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands, in the order of a first session."""
        added = [command.name for p in plugins_with_commands() for command in p.commands]
        return list(dict.fromkeys([*builtin_commands(), *added]))

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        """Return the command of that name. If there is none, a usage error proposes the command
        with the nearest name."""
        if listed := builtin_commands().get(name):
            command: click.Command = listed.load()
            return with_no_plugins(command)
        plugins = plugins_with_commands()
        offers = _offers(plugins).get(name, [])
        if not offers and not ctx.resilient_parsing:  # Otherwise a shell is completing the line.
            ctx.fail(_no_command(name, plugins))
        if not offers:
            return None
        if len(offers) > 1:
            rivals = " and ".join(str(plugin) for plugin, _ in offers)
            raise PluginError(f"the command '{name}' is offered by {rivals}; {DISABLE_ONE}")
        (plugin, offer), *_ = offers
        loaded = _call_plugin(plugin, offer, offer.load)
        if not isinstance(loaded, click.Command):
            raise PluginError(
                f"the command '{name}' of {plugin} cannot be used: {offer.target} is not a click "
                "command"
            )
        return with_no_plugins(loaded)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command. If an error occurs in the code of a plugin, the message contains the
        name of the plugin."""
        try:
            return super().invoke(ctx)
        except (PbdkitError, click.ClickException, click.exceptions.Exit, click.Abort):
            raise
        except Exception as error:
            name = ctx.invoked_subcommand or ""
            if name not in builtin_commands():
                for plugin, offer in _offers(plugins_with_commands()).get(name, []):
                    raise _failure(plugin, offer, error) from error
            raise

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands by group, without importing them."""
        for group, rows in _sections().items():
            with formatter.section(group):
                formatter.write_dl([(f"{name:<12}", does) for name, does in rows])


DISABLE_ONE = f"name one of them in {DISABLE} to use the other"
"""Remedy for several commands with the same name."""


def _sections() -> dict[str, list[tuple[str, str]]]:
    """Return the lines of `pbdkit --help` as pairs of command and sentence, by group."""
    sections: dict[str, list[tuple[str, str]]] = {group: [] for group in GROUPS}
    for command in builtin_commands().values():
        sections[command.group].append((command.name, command.does))
    plugins = plugins_with_commands()
    for name, offers in _offers(plugins).items():
        origin = " and ".join(str(plugin) for plugin, _ in offers)
        command = offers[0][1]
        does, group = f"{command.does} ({origin})", command.group
        if name in builtin_commands():
            does, group = (
                f"Unavailable from {origin}: pbdkit has a command of this name.",
                "Plugins",
            )
        elif len(offers) > 1:
            does, group = f"Unavailable: offered by {origin}; {DISABLE_ONE}.", "Plugins"
        sections.setdefault(group, []).append((name, does))
    for plugin in plugins:
        if plugin.unusable not in ("", "disabled"):
            sections.setdefault("Plugins", []).append((str(plugin), f"Is {plugin.fault}"))
    return sections


def _offers(plugins: list[Plugin]) -> dict[str, list[tuple[Plugin, Command]]]:
    """Return the commands of plugins by name, each with the plugins that offer it."""
    offers: dict[str, list[tuple[Plugin, Command]]] = {}
    for plugin in plugins:
        for command in plugin.commands:
            offers.setdefault(command.name, []).append((plugin, command))
    return offers


def _no_command(name: str, plugins: list[Plugin]) -> str:
    from pbdkit.model.shipped import shipped_names

    run = f"; `pbdkit run {name}` runs it" * (name in shipped_names())
    meant = next((f"; {what}" for words, what in MEANT.items() if name in words), "")
    names = [*builtin_commands(), *_offers(plugins)]
    near = run or meant or did_you_mean(name, names) or "; `pbdkit` without arguments lists them"
    unusable = "".join(f"; {plugin} is {plugin.fault}" for plugin in plugins if plugin.fault)
    return f"there is no command '{name}'{near}{unusable}"


def _call_plugin(plugin: Plugin, command: Command, call: Callable[[], T]) -> T:
    """Call code of a plugin. An error is converted to a PluginError with the name of the plugin."""
    try:
        return call()
    except PbdkitError:
        raise
    except (Exception, SystemExit) as error:
        raise _failure(plugin, command, error) from error


def _failure(plugin: Plugin, command: Command, error: BaseException) -> PluginError:
    package = command.target.partition(":")[0].partition(".")[0]
    return PluginError(f"the command '{command.name}' of {plugin} failed: {worded(error, package)}")
