"""Test completions with the Tab key on a line that has been begun."""

# ruff: noqa: E501  (a row of a table is a line)

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from scene_strategies import in_turn

import pbdkit
from pbdkit.cli import program
from pbdkit.cli.completion import _Bash
from pbdkit.cli.setting_completion import SettingPaths
from pbdkit.model.reading import with_setting
from pbdkit.model.schema import experiment_schema
from pbdkit.model.shipped import read_experiment, shipped_names
from pbdkit.plugin.registry import Registry

Offered = Callable[..., list[str]]


@pytest.fixture
def offered(call: Any, monkeypatch: pytest.MonkeyPatch) -> Offered:
    """Return the completions of the last of some words, in the folder of `call`, which has a
    result."""
    call("run", "e.json", "--set", "diagnostics=[{type: pe1}, {type: displacement}]", "--quiet")

    def complete(*words: str) -> list[str]:
        monkeypatch.setenv("COMP_WORDS", "\n".join(["pbdkit", *words]))
        monkeypatch.setenv("COMP_CWORD", str(len(words)))
        said = _Bash(program, {}, "pbdkit", "_PBDKIT_COMPLETE").complete()
        return [line.removeprefix("plain,") for line in said.splitlines()]

    return complete


SET = {
    "a path": (["run", "e.json", "--set", "lattice."], ["lattice.type=", "lattice.a=", "lattice.origin="]),
    "in a list": (["run", "e.json", "--set", "leaders.1.motion.v"], ["leaders.1.motion.velocity="]),
    "with a default": (["check", "e.json", "--set", "solver.rel"], ["solver.relaxation="]),
    "a part left out": (["check", "e.json", "--set", "record.c"], ["record.compression="]),
    "after a setting": (["run", "e.json", "--set", "rule.type=mixed-coordinate", "--set", "rule.K"], ["rule.K="]),
    "before the experiment": (["run", "--set", "ste"], ["steps="]),
    "a type": (["run", "e.json", "--set", "rule.type=mi"], ["rule.type=mixed-coordinate"]),
    "a word": (["run", "e.json", "--set", "solver.engine=n"], ["solver.engine=numpy"]),
    "yes or no": (["run", "e.json", "--set", "leaders.0.clamped="], ["leaders.0.clamped=true", "leaders.0.clamped=false"]),
    "the present value": (["run", "e.json", "--set", "leaders.1.until="], ["leaders.1.until=3"]),
    "a list": (["run", "e.json", "--set", "leaders.1.motion.velocity="], ["leaders.1.motion.velocity=[0.1,0.0]"]),
    "parted at = by bash": (["run", "e.json", "--set", "rule.type", "=", "mi"], ["mixed-coordinate"]),
    "parted behind =": (["run", "e.json", "--set", "leaders.1.until", "="], ["3"]),
    "an option with =": (["run", "e.json", "--set", "=", "solver.engine", "=", "n"], ["numpy"]),
    "no such path": (["run", "e.json", "--set", "rule.x=y"], []),
    "no such file": (["run", "no.yaml", "--set", "ru"], []),
    "no experiment": (["run", "tensile.nc", "--set", "ru"], []),
}  # fmt: skip


@pytest.mark.parametrize(("words", "expected"), in_turn(SET.values(), 2), ids=in_turn(SET, 2))
def test_settings(offered: Offered, words: list[str], expected: list[str]) -> None:
    assert offered(*words) == expected


@pytest.mark.parametrize("name", in_turn(shipped_names(), 3))
def test_every_suggested_path_can_be_set(name: str) -> None:
    source, defaults = read_experiment(name), pbdkit.Experiment.defaults()
    schema = experiment_schema(Registry(), installed=False)
    paths = SettingPaths({**defaults, **source.data}, schema).paths()
    for path in paths:
        found: Any = with_setting(source, f"{path}=word", defaults).data
        for word in path.split("."):
            found = found[int(word) if isinstance(found, list) else word]
        assert found == "word"
    assert {"steps", "seed", "rule.type", "solver.type"} <= {*paths}


def test_suggested_types_match_the_registry() -> None:
    schema = experiment_schema(Registry(), installed=False)
    known = SettingPaths(read_experiment("paper/a").data, schema)
    motions = {"hold", "velocity", "displace", "path", "rotation", "oscillation", "table"}
    assert motions <= {*known.values("leaders.0.motion.type")}
    assert {"grid", "dogbone", "union"} <= {*known.values("body.type")}
    assert {"elastic", "springs", "barycentre"} <= {*known.values("rule.type")}


RESULT = {
    "variables": (["plot", "tensile.nc", "--color", ""], ["position", "position_x", "position_y", "kind", "pe1", "u", "u_x", "u_y"]),
    "begun": (["plot", "tensile.nc", "--color", "p"], ["position", "position_x", "position_y", "pe1"]),
    "option first": (["plot", "--color", "pe"], []),
    "steps": (["plot", "tensile.nc", "--time", "1"], ["1", "10"]),
    "another step": (["plot", "tensile.nc", "--time", "1", "--time", "9"], ["9"]),
    "steps of no result": (["plot", "e.json", "--time", ""], []),
    "results": (["plot", "t"], ["tensile.nc"]),
    "results to be explained": (["explain", ""], ["tensile.nc"]),
    "several results": (["verify", "tensile.nc", "ten"], ["tensile.nc"]),
    "no result": (["plot", "x"], ["file,x"]),
}  # fmt: skip


@pytest.mark.parametrize(("words", "expected"), RESULT.values(), ids=RESULT)
def test_results_and_their_variables(
    offered: Offered, words: list[str], expected: list[str]
) -> None:
    assert offered(*words) == expected


def test_bonds_and_unfinished_runs(offered: Offered, call: Any) -> None:
    assert call("run", "e.json", "-o", "torn.nc", "--set", "cuts=[{from: [1.5, -9], to: [1.5, 9]}]")
    assert "broken_step" in offered("plot", "torn.nc", "--color", "")
    Path("left.nc.run").touch()
    Path("folder").mkdir()
    assert offered("resume", "l") == ["left.nc"]
    assert offered("resume", "f") == ["folder/"]


def test_only_some_of_many_steps_are_suggested(offered: Offered, call: Any) -> None:
    call("run", "e.json", "--set", "steps=1000", "-o", "long.nc", "--quiet")
    steps = [int(step) for step in offered("plot", "long.nc", "--time", "")]
    assert (steps[0], steps[-1]) == (0, 1000)
    assert 100 < len(steps) <= 201


def test_damaged_results_suggest_nothing_silently(offered: Offered) -> None:
    whole = Path("tensile.nc").read_bytes()
    for damaged in (whole[:100], b"", b"\x89HDF\r\n\x1a\n" + bytes(500), whole[: len(whole) // 2]):
        Path("bad.nc").write_bytes(damaged)
        assert offered("plot", "bad.nc", "--color", "") == []


def test_completion_imports_little(call: Any) -> None:
    """Test the two lines that a shell runs: they import neither xarray nor the numerical code."""
    call("run", "e.json", "--quiet")
    for words in (["run", "e.json", "--set", "ru"], ["plot", "tensile.nc", "--color", "p"]):
        asked = {"_PBDKIT_COMPLETE": "bash_complete", "COMP_WORDS": " ".join(["pbdkit", *words])}
        ask = (
            "import sys\nfrom pbdkit.cli import main\ntry: main([])\nexcept SystemExit: pass\n"
            "print('heavy', sorted({'xarray', 'scipy', 'numba', 'matplotlib'} & {*sys.modules}))"
        )
        done = subprocess.run(
            [sys.executable, "-c", ask],
            env=os.environ | asked | {"COMP_CWORD": str(len(words))},
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert (done.stderr, done.stdout.splitlines()[-1]) == ("", "heavy []")
        assert len(done.stdout.splitlines()) > 1
