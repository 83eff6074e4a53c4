"""The user, and never an order, decides which plugins are loaded and which of two is used; unused
plugins are not imported."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click
import jsonschema
import pytest
from plugin_sources import hook, listed, rule

import pbdkit
from pbdkit.cli import program
from pbdkit.hooks import DISABLE, installed_plugins
from pbdkit.model.schema import experiment_schema
from pbdkit.plugin.registry import Registry

Install = Callable[..., None]
Call = Callable[..., Any]

HEALTHY = "--set=rule={type: zz-healthy}"


@pytest.fixture
def healthy(install: Install) -> None:
    install("zz-healthy", rule("zz-healthy"), "2.1")


@pytest.fixture
def twins(install: Install) -> None:
    install("pbdkit-one", rule("twin"), "0.1")
    install("pbdkit-two", rule("twin"), "0.2")
    install("pbdkit-thief", rule("barycentre"))


@pytest.mark.usefixtures("twins")
def test_conflict_names_both_distributions_and_the_remedy(call: Call) -> None:
    found = listed(call)
    assert found["pbdkit-one"]["reason"] == (
        "'twin' is offered by pbdkit-two 0.2 too; write 'pbdkit-one:twin'"
    )
    assert found["pbdkit-two"]["reason"] == (
        "'twin' is offered by pbdkit-one 0.1 too; write 'pbdkit-two:twin'"
    )
    assert found["pbdkit-thief"]["reason"] == (
        "'barycentre' is the name of a built-in FollowerRule; write 'pbdkit-thief:barycentre', or "
        "change the type"
    )
    assert {row["state"] for row in found.values()} == {"ok", "conflict"}
    assert call("run", "e.json", "--set=rule={type: twin}").code == 2
    assert call("run", "e.json", "--set=rule={type: 'PBDKIT_Two:twin'}").code == 0


@pytest.mark.usefixtures("twins")
def test_overriding_distribution_chosen_by_name_stays_chosen(tensile: dict[str, Any]) -> None:
    ds = pbdkit.run(tensile | {"rule": {"type": "pbdkit-thief:barycentre"}}, progress=False)
    assert json.loads(ds.attrs["experiment"])["rule"]["type"] == "pbdkit-thief:barycentre"
    assert "pbdkit-thief" in json.loads(ds.attrs["plugins"])


@pytest.mark.usefixtures("twins")
@pytest.mark.parametrize("name", ["pbdkit-one:twin", "pbdkit-two:twin", "pbdkit-thief:barycentre"])
def test_schema_accepts_the_names_that_the_program_accepts(
    tensile: dict[str, Any], name: str
) -> None:
    schema = experiment_schema(Registry())
    given = tensile | {"rule": {"type": name}}
    jsonschema.validate(given, schema)
    pbdkit.Experiment(**given)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(tensile | {"rule": {"type": "twin"}}, schema)


def test_two_entry_points_of_one_distribution(install: Install, tmp_path: Path) -> None:
    install("pbdkit-one", rule("twin"))
    install("pbdkit-two", rule("twin"))
    site = tmp_path / "site"
    (site / "pbdkit_two-1.0.dist-info" / "entry_points.txt").unlink()
    points = site / "pbdkit_one-1.0.dist-info" / "entry_points.txt"
    points.write_text("[pbdkit]\na = pbdkit_one\nb = pbdkit_one\n")
    assert Registry().find(pbdkit.FollowerRule, "twin").__module__ == "pbdkit_one"
    points.write_text("[pbdkit]\na = pbdkit_one\nb = pbdkit_two\n")
    for name in ("twin", "pbdkit-one:twin"):
        with pytest.raises(pbdkit.PluginError, match="it has two classes with the type 'twin'"):
            Registry().find(pbdkit.FollowerRule, name)


def test_two_distributions_with_one_entry_point_name(install: Install, tmp_path: Path) -> None:
    for name in ("one", "two"):
        install(f"pbdkit-{name}", rule(name))
        points = tmp_path / "site" / f"pbdkit_{name}-1.0.dist-info" / "entry_points.txt"
        points.write_text(f"[pbdkit]\nsame = pbdkit_{name}\n")
    assert [(p.distribution, p.state) for p in Registry().installed] == [
        ("pbdkit-one", "ok"),
        ("pbdkit-two", "ok"),
    ]


def test_requested_distribution_alone_is_imported(install: Install, call: Call) -> None:
    install("pbdkit-loud", "open('imported', 'w').close()")
    install("zz-healthy", rule("zz-healthy"))
    assert call("run", "e.json", "--set=rule={type: 'zz-healthy:zz-healthy'}").code == 0
    assert not Path("imported").exists()
    again = pbdkit.rerun(pbdkit.open("tensile.nc"), progress=False)
    assert json.loads(again.attrs["plugins"])["zz-healthy"] == "1.0"
    assert not Path("imported").exists()


@pytest.mark.parametrize("names", ["pbdkit-loud", "other, PBDKIT_Loud", "*"])
def test_a_disabled_plugin_is_not_imported(
    install: Install, call: Call, monkeypatch: pytest.MonkeyPatch, names: str
) -> None:
    install("pbdkit-loud", "open('imported', 'w').close()\n" + rule("loud"), "0.3")
    monkeypatch.setenv(DISABLE, names)
    row = listed(call)["pbdkit-loud"]
    assert (row["state"], row["version"], DISABLE in row["reason"]) == ("disabled", "0.3", True)
    result = call("run", "e.json", "--set=rule={type: loud}")
    assert result.code == 2
    assert "unknown type 'loud' (installed: " in result.err
    assert "; pbdkit-loud 0.3 is disabled: " in result.err
    assert call("run", "e.json", "--set=rule={type: 'pbdkit-loud:loud'}").code == 3
    assert not Path("imported").exists()


@pytest.mark.usefixtures("twins")
def test_disabling_one_of_two_resolves_a_conflict(
    call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(DISABLE, "pbdkit-one")
    assert call("run", "e.json", "--set=rule={type: twin}").code == 0


@pytest.mark.usefixtures("twins")
def test_misspelt_name_to_disable_is_reported(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(DISABLE, "pbdkit-tow")
    expected = "warning: PBDKIT_DISABLE_PLUGINS contains 'pbdkit-tow', which is not installed; "
    assert call("plugins", "list").err == f"{expected}did you mean 'pbdkit-two'?\n"


def commands(command: click.Command, *names: str) -> Iterator[tuple[str, ...]]:
    """Every command below, by its words."""
    if not isinstance(command, click.Group):
        yield names
        return
    with click.Context(command) as context:
        for name in command.list_commands(context):
            inner = command.get_command(context, name)
            assert inner is not None
            yield from commands(inner, *names, name)


def test_every_command_can_run_without_plugins(call: Call) -> None:
    found = list(commands(program))
    assert ("plugins", "list") in found
    assert [name for name in found if "--no-plugins" not in call(*name, "--help").out] == []


@pytest.mark.usefixtures("healthy")
@pytest.mark.parametrize(
    "words",
    [("plugins", "list", "--json", "--no-plugins"), ("--no-plugins", "plugins", "list", "--json")],
)
def test_without_plugins_all_are_disabled_for_that_call(call: Call, words: Any) -> None:
    rows = json.loads(call(*words).out)
    (row,) = [row for row in rows if row["distribution"] == "zz-healthy"]
    assert row["state"] == "disabled"
    assert row["reason"] == "plugins are disabled (--no-plugins or PBDKIT_DISABLE_PLUGINS=*)"
    assert call("check", "e.json", HEALTHY, "--no-plugins").code == 2
    assert (DISABLE in os.environ, call("check", "e.json", HEALTHY).code) == (False, 0)


SEEN = """
import sys
from pbdkit.cli import main
from pbdkit.plugin import discovery
def refuse(): raise AssertionError("the installed distributions were looked through")
discovery.distributions = refuse
try:
    main(sys.argv[1:])
except SystemExit as end:
    assert not end.code, end.code
print([name for name in sys.modules if name.startswith("pbdkit_unused")])
"""


@pytest.mark.parametrize("command", ["run", "check"])
def test_fifty_unused_plugins_are_not_inspected(install: Install, call: Call, command: str) -> None:
    for n in range(50):
        install(f"pbdkit-unused-{n}", "raise ImportError")
    assert len(installed_plugins()) == 50
    words = [sys.executable, "-c", SEEN, command, "e.json"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.endswith("\n[]\n")


def test_order_is_by_name_independent_of_the_path(install: Install) -> None:
    for name in ("c", "a", "b"):
        install(f"pbdkit-{name}", hook("return []"))
    assert [p.distribution for p in Registry().installed] == ["pbdkit-a", "pbdkit-b", "pbdkit-c"]
