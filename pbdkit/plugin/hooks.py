"""The hooks that a plugin implements, their markers, and the command that one of them offers."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

import pluggy

from pbdkit.plugin.component import Component

GROUP = "pbdkit"
"""The entry-point group of plugins, and the project name of their hook markers."""
COMMAND_GROUP = "pbdkit.commands"
"""The entry-point group of modules that implement `pbdkit_commands`. They are imported to list
commands, those of the group "pbdkit" are not."""

hookspec = pluggy.HookspecMarker(GROUP)
hookimpl = pluggy.HookimplMarker(GROUP)
"""Marks a function of a plugin as the implementation of a hook of the same name."""


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
        """Import the click command."""
        module, _, attribute = self.target.partition(":")
        return getattr(import_module(module), attribute)


class Hooks:
    """What a plugin may implement, as functions of the module that its entry point names."""

    @hookspec
    def pbdkit_components(self) -> list[type[Component]]:
        """The component classes that the distribution offers."""
        raise NotImplementedError  # a specification only: pluggy never calls it

    @hookspec
    def pbdkit_commands(self) -> list[Command]:
        """Return the commands that the distribution adds to the program `pbdkit`. The modules of
        the commands are imported when they are called, so the module of this hook should import
        nothing but `pbdkit.plugin`."""
        raise NotImplementedError
