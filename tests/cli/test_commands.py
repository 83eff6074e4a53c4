"""Plugins add commands by the hook `pbdkit_commands`; one that cannot be used stops no other."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from inspect import getsource
from typing import Any

import pytest
from plugin_sources import rule

from pbdkit.cli import interface, options
from pbdkit.cli.commands import builtin_commands
from pbdkit.hooks import DISABLE, import_object

Install = Callable[..., None]
Call = Callable[..., Any]

TARGET = """
import click

@click.command()
@click.option("--by", type=float, default=1.0)
def shear(by):
    '''Shear a sheet.'''
    if by < 0:
        raise KeyError(by)
    click.echo(f"sheared by {by:g}")
"""


def source(name: str = "shear", target: str = "pbdkit_target:shear", does: str = "Shears.") -> str:
    return (
        "import pbdkit\n@pbdkit.hookimpl\ndef pbdkit_commands():\n"
        f"    return [pbdkit.plugin.Command({name!r}, {target!r}, {does!r})]\n"
    )


@pytest.fixture
def add(install: Install) -> Install:
    """``add("pbdkit-x", source)`` adds a distribution with an entry point for commands."""
    install("pbdkit-target", TARGET)

    def of(distribution: str, text: str, version: str = "1.0") -> None:
        install(distribution, text, version, group="pbdkit.commands")

    return of


def test_a_plugin_adds_a_command(add: Install, call: Call) -> None:
    add("pbdkit-shear", source(), "0.4")
    assert "\nPlugins:\n  shear         Shears. (pbdkit-shear 0.4)\n" in call("--help").out
    assert call("shear", "--by", "2").out == "sheared by 2\n"
    assert "--no-plugins" in call("shear", "--help").out
    rows = json.loads(call("plugins", "list", "--json").out)
    (row,) = [row for row in rows if row["interface"] == "command"]
    assert (row["type"], row["distribution"], row["state"]) == ("shear", "pbdkit-shear", "ok")


def test_an_error_of_a_command_names_its_plugin(add: Install, call: Call) -> None:
    add("pbdkit-shear", source(), "0.4")
    result = call("shear", "--by", "-1")
    assert result.code == 3
    assert result.err == (
        "pbdkit: the command 'shear' of pbdkit-shear 0.4 failed: KeyError: -1.0 "
        "(pbdkit_target.py, line 9)\n"
    )


def test_disabled_plugin_adds_no_command(
    add: Install, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    add("pbdkit-shear", source())
    monkeypatch.setenv(DISABLE, "pbdkit-shear")
    assert "shear" not in call("--help").out
    result = call("shear")
    assert result.code == 2
    assert "no command 'shear'" in result.err
    assert f"pbdkit-shear 1.0 is disabled: {DISABLE} contains it" in result.err
    assert call("plugins", "list").err == ""


def test_built_in_command_has_precedence(add: Install, call: Call) -> None:
    add("pbdkit-thief", source("run"))
    assert call("run", "e.json").code == 0
    told = "run Unavailable from pbdkit-thief 1.0: pbdkit has a command of this name."
    assert told in " ".join(call("--help").out.split())
    rows = json.loads(call("plugins", "list", "--json").out)
    (row,) = [row for row in rows if row["interface"] == "command"]
    assert (row["state"], row["reason"]) == ("conflict", "pbdkit has a command 'run'")


def test_user_chooses_between_plugins_with_the_same_command(
    add: Install, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    add("pbdkit-one", source())
    add("pbdkit-two", source())
    result = call("shear")
    assert (result.code, result.err) == (
        3,
        "pbdkit: the command 'shear' is offered by pbdkit-one 1.0 and pbdkit-two 1.0; "
        f"name one of them in {DISABLE} to use the other\n",
    )
    assert "Unavailable: offered by pbdkit-one 1.0 and pbdkit-two 1.0" in " ".join(
        call("--help").out.split()
    )
    monkeypatch.setenv(DISABLE, "pbdkit-two")
    assert call("shear").out == "sheared by 1\n"


BROKEN = {
    "import error": ("import no_such_module", "ModuleNotFoundError: No module named"),
    "no hook": ("", "TypeError: its module implements no hook `pbdkit_commands`"),
    "no list": (
        source().replace("[", "").replace("]", ""),
        "TypeError: its hook `pbdkit_commands`",
    ),
    "no command": (
        "import pbdkit\n@pbdkit.hookimpl\ndef pbdkit_commands():\n    return [3]\n",
        "TypeError: 3 is not a pbdkit.plugin.Command",
    ),
    "no name": (source("Shear it"), "TypeError: 'Shear it' is not a valid name of a command"),
    "no target": (source(target="pbdkit_target"), "TypeError: the target of the command 'shear'"),
}


@pytest.mark.parametrize(("text", "reason"), BROKEN.values(), ids=BROKEN)
def test_a_broken_plugin_stops_no_command(add: Install, call: Call, text: str, reason: str) -> None:
    add("pbdkit-broken", text, "0.3")
    add("pbdkit-bend", source("bend"))
    assert call("bend").out == "sheared by 1\n"
    assert call("run", "e.json").code == 0
    help_ = call("--help")
    assert help_.code == 0
    assert f"pbdkit-broken 0.3 Is broken: {reason}" in " ".join(help_.out.split())
    unknown = call("shear")
    assert unknown.code == 2
    assert f"pbdkit-broken 0.3 is broken: {reason}" in unknown.err


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        ("no_such_module:shear", "failed: ModuleNotFoundError: No module named 'no_such_module'"),
        ("pbdkit_target:bend", "failed: AttributeError: module 'pbdkit_target' has no attribute"),
        ("json:dumps", "cannot be used: json:dumps is not a click command"),
    ],
)
def test_unusable_target_is_named(add: Install, call: Call, target: str, reason: str) -> None:
    add("pbdkit-shear", source(target=target))
    result = call("shear")
    assert result.code == 3
    assert f"the command 'shear' of pbdkit-shear 1.0 {reason}" in result.err


LOADED = """
import sys
from pbdkit.cli import main
try:
    main(sys.argv[1:])
except SystemExit as end:
    assert not end.code, end.code
print(sorted({name for name in sys.modules if name.startswith("pbdkit_")}))
"""


def test_unused_command_modules_are_not_imported(
    add: Install, install: Install, call: Call
) -> None:
    add("pbdkit-shear", source())
    install("pbdkit-components", rule("unused"))

    def loaded(*arguments: str) -> str:
        words = [sys.executable, "-c", LOADED, *arguments]
        done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=True)
        return done.stdout.splitlines()[-1]

    assert loaded("run", "e.json") == "[]"
    assert loaded("--help") == "['pbdkit_shear']"
    assert loaded("shear") == "['pbdkit_shear', 'pbdkit_target']"


SOURCE = getsource(interface) + getsource(options)
TARGETS = sorted({*re.findall(r'(?:call|completed_by)\("([\w:]+)"', SOURCE)})


@pytest.mark.parametrize("target", TARGETS)
def test_every_command_and_completer_has_a_function(target: str) -> None:
    """The command line names them by texts, so that they are imported when they are called."""
    assert callable(import_object(f"pbdkit.cli.{target}"))


def test_every_command_is_declared_under_its_name() -> None:
    for name, command in builtin_commands().items():
        assert command.load().name == name
    assert len(TARGETS) > len(builtin_commands())
