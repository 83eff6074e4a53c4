"""`pbdkit plugins new`: the project installs, passes its tests and runs as it stands."""

from __future__ import annotations

import ast
import json
import os
import runpy
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from plugin_sources import listed
from scene_strategies import in_turn

import pbdkit
from pbdkit.cli.interface import INTERFACE_NAMES as OFFERED
from pbdkit.model.reading import read_file
from pbdkit.model.schema import experiment_schema
from pbdkit.plugin import INTERFACES
from pbdkit.plugin.registry import Registry
from pbdkit.testing import examine

Install = Callable[..., None]
Call = Callable[..., Any]
New = Callable[..., Path]


@pytest.fixture
def new(call: Call, install: Install) -> New:
    """``new("pbdkit-mine", "Lattice")``: the folder of a project that is as good as installed."""

    def make(name: str, interface: str) -> Path:
        result = call("plugins", "new", name, "--interface", interface)
        assert (result.code, result.err) == (0, "")
        (point,) = tomllib.loads(Path(name, "pyproject.toml").read_text())["project"][
            "entry-points"
        ]["pbdkit"].values()
        install(name, Path(name, f"{point}.py").read_text(), "0.1.0")
        return Path(name)

    return make


def test_every_open_interface_is_available() -> None:
    assert sorted(OFFERED) == sorted(i.__name__ for i in INTERFACES.values())


@pytest.mark.parametrize("interface", in_turn(OFFERED, 2))
def test_project_runs_unchanged(new: New, call: Call, interface: str) -> None:
    folder = new("pbdkit-brand-new", interface)
    assert listed(call)["pbdkit-brand-new"]["state"] == "ok"
    result = call("run", str(folder / "example.yaml"), "--json")
    assert (result.code, result.err, json.loads(result.out)["status"]) == (0, "", "complete")
    warnings = json.loads(call("check", str(folder / "example.yaml"), "--json").out)["warnings"]
    left_out = ["the analysis does not include 'brand-new'"] * (interface == "ParticleOperation")
    assert [part in warning for part, warning in zip(left_out, warnings, strict=True)] == [
        True
    ] * len(left_out)
    tests = runpy.run_path(str(folder / "tests" / "test_example.py"))
    tests["test_the_example_runs_with_this_plugin"]()


def test_bonds_break_in_the_example_of_a_fracture_model(new: New) -> None:
    folder = new("pbdkit-brand-new", "FractureModel")
    broken = pbdkit.run(folder / "example.yaml", progress=False).broken_step > 0
    assert 0 < broken.sum() < broken.size


@pytest.mark.parametrize("interface", in_turn(OFFERED, 2))
def test_project_passes_conformance(
    new: New, interface: str, request: pytest.FixtureRequest
) -> None:
    """Rules are compiled; in the profile `long`, all components."""
    if interface != "FollowerRule":
        request.getfixturevalue("compiled_at_length")
    new("pbdkit-brand-new", interface)
    kind = next(i for i in INTERFACES.values() if i.__name__ == interface)
    report = examine(Registry().find(kind, "brand-new")())
    assert report.holds, str(report)


@pytest.mark.parametrize("interface", in_turn(OFFERED, 3))
def test_example_validates_in_editors(new: New, interface: str) -> None:
    folder = new("pbdkit-brand-new", interface)
    source = read_file(folder / "example.yaml")
    jsonschema.validate(json.loads(json.dumps(source.data)), experiment_schema(Registry()))
    assert (folder / "example.yaml").read_text().startswith("# yaml-language-server: $schema=")


def test_project_passes_style_checks(call: Call) -> None:
    for interface in OFFERED:
        assert call("plugins", "new", f"my-{interface}", "--interface", interface).code == 0
    rules = ["--isolated", "--line-length=100"]
    for words in (["check", "--select=E,F,W,I,B,UP,RUF"], ["format", "--check"]):
        command = [sys.executable, "-m", "ruff", *words, *rules, "."]
        done = subprocess.run(command, capture_output=True, text=True)
        assert (done.returncode, done.stdout) == (0, done.stdout)


def test_the_rule_is_short(call: Call) -> None:
    assert call("plugins", "new", "pbdkit-mine").code == 0
    tree = ast.parse(Path("pbdkit-mine/pbdkit_mine.py").read_text())
    (rule,) = (node for node in tree.body if isinstance(node, ast.ClassDef))
    functions = [node for node in rule.body if isinstance(node, ast.FunctionDef)]
    assert [function.name for function in functions] == ["gather", "apply"]
    assert sum(len(ast.unparse(function.body).splitlines()) for function in functions) <= 5


OWN = ("return r + d, 1.0", "return d, 1.0")
"""The one line in which the mean displacement differs from the barycentre."""


@pytest.mark.parametrize(("edited", "same"), [((), "barycentre"), (OWN, "mean-displacement")])
def test_rule_is_the_barycentre_and_one_line_changes_it(
    new: New, call: Call, edited: tuple[str, ...], same: str
) -> None:
    module = new("pbdkit-mine", "FollowerRule") / "pbdkit_mine.py"
    text = module.read_text().replace(*edited) if edited else module.read_text()
    assert (text == module.read_text()) == (not edited)
    names: dict[str, Any] = {}
    exec(compile(text.replace('"mine"', '"edited"'), "edited.py", "exec", dont_inherit=True), names)
    runs = [
        pbdkit.run(
            pbdkit.load("paper/c", settings=[f"rule={{type: {kind}}}"], components=[names["Mine"]]),
            progress=False,
        )
        for kind in ("edited", same)
    ]
    moved = [run.position - run.reference for run in runs]
    assert float(abs(moved[1]).max()) > 0.1
    assert float(abs(moved[0] - moved[1]).max()) < 1e-12


def test_three_commands_lead_to_the_first_run(call: Call, interpreted: None) -> None:
    """The first one prints the other two; the project is installed beside the other packages."""
    pytest.importorskip("hatchling")
    site = Path("site").absolute()
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(site), *sys.path])}

    def run(*words: str) -> str:
        command = [sys.executable, "-m", *words]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    said = call("plugins", "new", "pbdkit-mine").out.splitlines()
    assert said[1:] == ["  pip install -e ./pbdkit-mine", "  pbdkit run pbdkit-mine/example.yaml"]
    offline = ["--no-build-isolation", "--no-deps", "--no-index", "--target", "site"]
    run(*said[1].split(), *offline)
    (link,) = site.glob("*.pth")
    editable = link.read_text().strip()
    environment["PYTHONPATH"] += os.pathsep + editable  # a .pth counts in site-packages only
    assert editable == str(Path("pbdkit-mine").absolute())
    assert "complete: " in run(*said[2].split())
    assert " passed" in run("pytest", "-p", "no:cacheprovider", "pbdkit-mine")


REFUSED = {
    "pbdkit-": "'pbdkit-' is not a valid distribution name: it starts with a letter, ends with",
    "my rule": "'my rule' is not a valid distribution name: ",
    "../mine": "'../mine' is not a valid distribution name: ",
    "pbdkit": "there is already a module pbdkit; try pbdkit-my-pbdkit",
    "json": "there is already a module json; try pbdkit-my-json",
    "numpy": "there is already a module numpy; try pbdkit-my-numpy",
    "if": "there is already a module if; try pbdkit-my-if",
    "pbdkit-2d": "'pbdkit-2d' cannot be converted to the name of a class; try pbdkit-my-2d",
    "literal": "'literal' cannot be converted to the name of a class; try pbdkit-my-literal",
    "pbdkit-none": "'pbdkit-none' cannot be converted to the name of a class; try pbdkit-my-none",
    "pbdkit-barycentre": "'barycentre' is a built-in FollowerRule; try pbdkit-my-barycentre",
}


@pytest.mark.parametrize(("name", "message"), REFUSED.items())
def test_invalid_names(call: Call, name: str, message: str) -> None:
    result = call("plugins", "new", name)
    assert (result.code, result.err.startswith(f"pbdkit: {message}")) == (2, True)
    assert [path.name for path in Path().iterdir()] == ["e.json"]


def test_spellings_of_a_name_are_normalised(call: Call) -> None:
    assert call("plugins", "new", "PBDkit_My.Rule").code == 0
    assert "class MyRule(" in Path("pbdkit-my-rule/pbdkit_my_rule.py").read_text()


def test_existing_files_are_kept(call: Call) -> None:
    Path("pbdkit-mine").mkdir()
    result = call("plugins", "new", "pbdkit-mine")
    message = "pbdkit: pbdkit-mine: exists and is not replaced; choose another name or --dir\n"
    assert (result.code, result.err) == (2, message)
    assert list(Path("pbdkit-mine").iterdir()) == []


def test_other_directory(call: Call, tmp_path: Path) -> None:
    result = call("plugins", "new", "pbdkit-mine", "--dir", str(tmp_path))
    assert f"  pip install -e {tmp_path / 'pbdkit-mine'}\n" in result.out
    assert (tmp_path / "pbdkit-mine" / "README.md").exists()
    assert call("plugins", "new", "pbdkit-mine", "--dir", "nowhere").code == 2


def test_partial_project_is_removed(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[int] = []

    def full(descriptor: int) -> None:
        synced.append(descriptor)
        if len(synced) == 5:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    result = call("plugins", "new", "pbdkit-mine")
    message = "pbdkit: pbdkit-mine: cannot be written: No space left on device; "
    message += "free some space, and repeat the command\n"
    assert (result.code, result.err) == (6, message)
    assert [path.name for path in Path.cwd().iterdir()] == ["e.json"]


def test_directory_without_permission(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    def closed(self: Path, *_: Any, **more: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", closed)
    result = call("plugins", "new", "pbdkit-mine")
    assert (result.code, result.err) == (
        6,
        "pbdkit: pbdkit-mine: cannot be written: Permission denied\n",
    )
