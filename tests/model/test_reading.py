"""A file where another was wanted is recognised by its content, and the right command is named."""

# ruff: noqa: E501  (a row of a table is a line)

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import pbdkit
from pbdkit.model import shipped
from pbdkit.model.reading import EXPERIMENT, FIT, PARTS, SWEEP, kind_of, read_text
from pbdkit.model.shipped import read_experiment, shipped_names

TAKES_EXPERIMENTS = ["run", "check", "identify", "bench"]
TAKES_RESULTS = ["animate", "explain", "status", "verify", "resume"]
SWEEP_FILE = "experiment: e.json\nvary: {solver.memory: [0.1, 0.2]}\n"
FIT_FILE = "experiment: e.json\nunknown: {rule.K: [-1, 0]}\nmeasured: {file: d.csv}\n"


@pytest.fixture
def told(call: Any) -> Any:
    """Results of commands for files of all kinds with names that do not show their kind."""
    assert call("run", "e.json", "-o", "result.yaml", "--quiet").code == 0
    Path("sweep.nc").write_text(SWEEP_FILE)
    Path("fit.nc").write_text(FIT_FILE)
    Path("experiment.nc").write_text(Path("e.json").read_text())
    Path("other.yaml").write_text("services: {web: 1}\nvolumes: []\n")
    Path("picture.yaml").write_bytes(b"\x89PNG\r\n\x1a\n\0\0")
    Path("left.nc.run").write_bytes(b"SQLite format 3\0" + bytes(100))
    before = sorted(Path().iterdir())

    def of(*arguments: str) -> str:
        result = call(*arguments)
        assert (result.code, "Traceback" in result.err) in ((2, False), (6, False))
        assert sorted(Path().iterdir()) == before
        return str(result.err or result.out).strip().removeprefix("pbdkit: ")

    return of


NO_EXPERIMENT = {
    "result.yaml": "result.yaml: is a result, not an experiment; `pbdkit plot result.yaml` draws it",
    "sweep.nc": "sweep.nc: is a sweep, not an experiment; `pbdkit sweep sweep.nc` runs it",
    "fit.nc": "fit.nc: is a fit, not an experiment; `pbdkit fit fit.nc` runs it",
    "other.yaml": "other.yaml: is not an experiment, it has `services`, `volumes`; it requires `lattice`, `body`, `rule`, `steps`; `pbdkit init` writes one",
    "picture.yaml": "picture.yaml: is not text, and not an experiment",
    "left.nc.run": "left.nc.run: is the store of an unfinished run or of a sweep, not an experiment; `pbdkit resume OUT.nc` continues a run",
}  # fmt: skip
NO_SWEEP = {
    "result.yaml": NO_EXPERIMENT["result.yaml"],
    "experiment.nc": "experiment.nc: is an experiment, not a sweep; `pbdkit run experiment.nc` runs it; a sweep refers to it by `experiment`",
    "fit.nc": "fit.nc: is a fit, not a sweep",
    "paper/a": "paper/a: is an experiment, not a sweep; `pbdkit run paper/a` runs it; a sweep refers to it by `experiment`",
    "other.yaml": "other.yaml: is not a sweep, it has `services`, `volumes`; it requires `experiment` and `vary`",
}  # fmt: skip
NO_RESULT = {
    "experiment.nc": "experiment.nc: is an experiment; `pbdkit run experiment.nc` computes its result and prints the path",
    "e.json": "e.json: is an experiment; `pbdkit run e.json` computes its result and prints the path",
    "sweep.nc": "sweep.nc: is a sweep, not a result; `pbdkit sweep sweep.nc` runs it",
    "fit.nc": "fit.nc: is a fit, not a result; `pbdkit fit fit.nc` runs it",
    "other.yaml": "other.yaml: is not a result; the names of results end in .nc",
    "picture.yaml": "picture.yaml: is not a result; by its name it is an experiment",
}  # fmt: skip


@pytest.mark.parametrize("command", TAKES_EXPERIMENTS)
def test_other_files_instead_of_an_experiment_are_refused(told: Any, command: str) -> None:
    for file, message in NO_EXPERIMENT.items():
        assert told(command, file).startswith(message)


def test_other_files_instead_of_a_sweep_are_refused(told: Any) -> None:
    for file, message in NO_SWEEP.items():
        assert told("sweep", file).startswith(message)


@pytest.mark.parametrize("command", TAKES_RESULTS)
def test_other_files_instead_of_a_result_are_refused(told: Any, command: str) -> None:
    for file, message in NO_RESULT.items():
        assert told(command, file).startswith(message)


def test_plot_accepts_any_experiment_name_and_refuses_other_files(told: Any) -> None:
    for file in ("sweep.nc", "fit.nc", "other.yaml"):
        assert told("plot", file).startswith(NO_RESULT[file])
    assert told("plot", "picture.yaml").startswith(NO_EXPERIMENT["picture.yaml"])
    refused = "--color: applies to results, but e.json is an experiment; `pbdkit run e.json` computes a result"
    assert told("plot", "e.json", "--color", "u") == refused
    assert told("plot", "experiment.nc", "--time", "3").startswith("--time: applies to results")
    refused = "--set: changes an experiment, but result.yaml is a result"
    assert told("plot", "result.yaml", "--set", "steps=3") == refused


@pytest.mark.parametrize(
    "command", ["plot", "animate", "curve", "export", "report", "explain", "status", "resume"]
)
def test_directory_is_no_result(call: Any, command: str) -> None:
    assert call(command, ".").err == "pbdkit: .: is a folder, not a result of pbdkit\n"


def test_result_may_have_any_name(call: Any) -> None:
    call("run", "e.json", "-o", "result.yaml", "--quiet")
    assert call("verify", "result.yaml").out == "result.yaml: unchanged since it was written\n"
    assert pbdkit.open("result.yaml").attrs["status"] == "complete"


@pytest.mark.parametrize("command", ["status", "resume"])
def test_the_store_of_a_run_names_its_output(told: Any, command: str) -> None:
    message = "left.nc.run: is the store of an unfinished run; give its output, left.nc"
    assert told(command, "left.nc.run") == message


def test_directory_of_a_sweep_names_its_dataset(call: Any) -> None:
    Path("sweep").mkdir()
    Path("sweep/sweep.nc").touch()
    for command in TAKES_RESULTS:
        result = call(command, "sweep")
        said = result.out + result.err
        assert "sweep: is the folder of a sweep; its dataset is sweep/sweep.nc" in said


def test_a_shipped_experiment_is_no_result(call: Any) -> None:
    told = "paper/a: is a shipped experiment; `pbdkit run paper/a` computes its result"
    for command in ("explain", "animate", "status", "resume"):
        assert told in call(command, "paper/a").err


def test_a_sweep_of_a_sweep_is_refused(call: Any) -> None:
    Path("one.yaml").write_text(SWEEP_FILE)
    Path("two.yaml").write_text("experiment: one.yaml\nvary: {seed: [1, 2]}\n")
    assert "one.yaml: is a sweep, not an experiment" in call("sweep", "two.yaml").err


def test_intended_kind_of_a_faulty_file_is_recognised() -> None:
    assert {kind_of(read_experiment(name).data) for name in shipped_names()} == {EXPERIMENT}
    assert kind_of({"latice": {}, "body": {}}) == EXPERIMENT
    assert kind_of({"name": "begun"}) == EXPERIMENT
    assert kind_of({"experiment": "paper/a", "varry": {}}) == SWEEP
    assert kind_of({"unknown": {}, "measured": {}, "steps": 3}) == FIT
    assert kind_of(json.loads('{"name": "x", "version": "1", "jobs": []}')) == ""


def test_every_key_of_an_experiment_is_listed() -> None:
    assert {*pbdkit.Experiment.known_keys()} == PARTS


def test_shipped_experiment_is_parsed_once_and_copied(monkeypatch: pytest.MonkeyPatch) -> None:
    shipped._parsed.cache_clear()
    parsed: list[Any] = []
    monkeypatch.setattr(shipped, "read_text", lambda *text: parsed.append(text) or read_text(*text))
    first = read_experiment("paper/a")
    places, steps = dict(first.places), first.data["steps"]
    first.data["steps"] = first.data["lattice"]["a"] = -1
    first.places.clear()
    again = read_experiment("paper/a")
    assert len(parsed) == 1
    assert (again.data["steps"], again.places) == (steps, places)
    assert again.data["lattice"]["a"] > 0
    assert again.files.folder == first.files.folder
