"""The program: exit codes, what it prints, which files it leaves, and what it imports."""

# ruff: noqa: E501  (a row of a table is a line)

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray
from scene_strategies import in_turn

import pbdkit
from pbdkit.cli import FIRST
from pbdkit.cli.commands import GROUPS, MEANT, builtin_commands
from pbdkit.model.shipped import shipped_text

Call = Callable[..., Any]
Probing = Callable[..., None]
OUT = Path("tensile.nc")


def python(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=60)


def left() -> list[str]:
    return sorted(path.name for path in Path().iterdir() if path.name != "e.json")


PROBED = ("run", "e.json", "--set", "diagnostics=[{type: probe}]")


def test_every_command_has_help(call: Call) -> None:
    listed = python("-m", "pbdkit", "--help").stdout
    assert [c for c in builtin_commands() if c not in listed or call(c, "--help").code] == []


def test_without_a_command_first_commands_are_suggested(call: Call) -> None:
    result = call()
    assert (result.code, result.err) == (0, "")
    assert [name for name in builtin_commands() if f"\n  {name} " not in result.out] == []
    for group in GROUPS:
        assert f"\n{group}:\n" in result.out
    assert max(map(len, result.out.splitlines())) <= 80
    sentences = [one.does for one in builtin_commands().values()]
    assert [does for does in sentences if does[0].islower() or does[-1] != "."] == []


def test_suggested_first_commands_work(call: Call) -> None:
    for typed in FIRST:
        assert call(*typed.removeprefix("pbdkit ").split()).code == 0
    assert left() == ["experiment.yaml", "paper-a.nc", "paper-a.png"]


def test_run_writes_the_named_file(call: Call) -> None:
    result = call("run", "e.json")
    assert (result.code, result.err, left()) == (0, "", ["tensile.nc"])
    assert "complete: 30 particles, 10 steps in " in result.out
    with xarray.open_dataset(OUT) as ds:
        assert ds.attrs["status"] == "complete"
        xarray.testing.assert_equal(ds.load(), pbdkit.run("e.json", progress=False))
    assert call("run", "paper/a", "--set", "steps=1", "--quiet") == (0, "", "")
    assert left() == ["paper-a.nc", "tensile.nc"]


def test_json_output_of_run(call: Call) -> None:
    result = call("run", "e.json", "--json")
    figures = json.loads(result.out)
    known = {"status": "complete", "steps": 10, "particles": 30, "output": "tensile.nc"}
    assert known.items() <= figures.items()
    measured = {"wall_s", "ns_per_particle_step", "peak_memory_mib", "engine"}
    assert (set(figures) >= known.keys() | measured, result.err) == (True, "")


def test_json_output_of_check(call: Call) -> None:
    figures = json.loads(call("check", "e.json", "--json").out)
    known = {"particles": 30, "followers": 6, "bonds": 31, "warnings": []}
    assert known.items() <= figures.items()
    assert min(figures["memory_mib"], figures["output_mib"]) > 0
    assert left() == []


def test_check_with_warnings_exits_with_zero(call: Call) -> None:
    fracture = "--set=fracture={type: threshold, thresholds: [1.2]}"
    others = ["--set=neighbours={type: chebyshev}", "--set=leaders=[]"]
    result = call("check", "e.json", fracture, *others)
    assert "warning: fracture.thresholds.0: 1.2 is below the largest rest length" in result.out
    assert (result.code, "warning: leaders: the experiment has neither" in result.out) == (0, True)


def rows_of_check(call: Call, *arguments: str) -> dict[str, str]:
    """The lines by their first word, after the first."""
    lines = call("check", *arguments).out.splitlines()[1:]
    return {title: text for title, _, text in (line.strip().partition(" ") for line in lines)}


def test_check_starts_with_groups_and_events(call: Call) -> None:
    said = {title: text.strip() for title, text in rows_of_check(call, "e.json").items()}
    assert said["body"] == "12 particles over 3 × 2 lattice units, and 18 of the frame"
    assert said["supports"] == "leaders.0, 3 particles (edge left)"
    assert said["leaders"] == "leaders.1, 3 particles (edge right) by velocity until step 3"
    assert said["stable"].startswith("yes (spectral radius 0.")
    assert said["converges"].endswith(" steps; the run of 10 steps reaches neither")
    assert said["cost"].startswith("less than a second of stepping, ")
    assert len(call("check", "e.json").out.splitlines()) <= 12
    whole = call("check", "e.json", "--verbose").out
    assert call("check", "e.json").out.splitlines() == whole.splitlines()[: len(said) + 1]
    assert "bonds      31" in whole


def test_check_converts_the_limits_of_cohesive_fracture(call: Call) -> None:
    """The process zone of 10 N/mm, 1000 MPa and 10 MPa is 100 mm in all units of length."""
    parts = ["frame={type: natural}", "neighbours={type: chebyshev}"]
    parts += ["rule={type: elastic, poisson_ratio: 0.3}"]
    parts += ["fracture={type: cohesive, onset: 10 MPa, energy: 10 N/mm}"]
    rows = []
    for length, lengths in (("2 mm", 50.0), ("1 mm", 100.0)):
        units = [f"units={{length: {length}, youngs_modulus: 1000 MPa, thickness: 1 mm}}"]
        settings = [f"--set={part}" for part in parts + units]
        rows.append(rows_of_check(call, "e.json", *settings)["fracture"].strip())
        zone = f"process zone E G_c/f_t² = 100 mm, {lengths:g} lattice constants; "
        assert rows[-1].startswith(zone + "largest lattice constant in mm")
    assert rows[0].partition("; ")[2] == rows[1].partition("; ")[2]


def test_check_lists_loads_and_regions(call: Call) -> None:
    said = rows_of_check(call, "modelling/composite-plate")
    assert said["regions"].strip() == "steel, 197 particles"
    assert said["loads"].strip().startswith("loads.0, 41 particles (edge right) force [")
    assert said["supports"].strip() == (
        "leaders.0, 41 particles (edge left) along x; leaders.1, 1 particle along y"
    )
    assert "stable" not in said  # no steps are made
    assert said["solver"].strip().startswith("computes the equilibrium directly")


def test_check_lists_only_some_of_many_groups(call: Call) -> None:
    held = ", ".join(
        f"{{select: {{numbers: [{n}]}}, motion: {{type: hold}}}}" for n in (7, 8, 9, 12, 13)
    )
    setting = f"leaders=[{held}]"
    said = rows_of_check(call, "e.json", "--set", setting)["supports"]
    assert said.strip().endswith("leaders.2, 1 particle; and 2 more")
    assert "leaders.4" in rows_of_check(call, "e.json", "--verbose", "--set", setting)["supports"]


def test_check_predicts_divergence_and_sufficient_length(call: Call) -> None:
    said = rows_of_check(call, "e.json", "--set", "solver.relaxation=3")
    assert said["stable"].strip().startswith("NO, some modes grow (spectral radius ")
    assert "converges" not in said
    said = rows_of_check(call, "e.json", "--set", "steps=100000")
    assert said["converges"].endswith("the run of 100000 steps reaches 1e-6")
    said = rows_of_check(call, "e.json", "--set", "solver.settle.tolerance=1e-3")
    assert said["converges"].endswith("once it has converged, or after 10 steps")


def test_identify_prints_classification_and_constants_first(call: Call) -> None:
    settings = ("--set", "rule={type: springs}", "--set", "neighbours.type=chebyshev")
    lines = call("identify", "e.json", *settings).out.splitlines()
    titles = [line[:22].strip() for line in lines[1:] if line.strip() and "note" not in line]
    constants = ["elastic constants", "Poisson's ratio", "relaxation"]
    assert titles == ["identity", "spacing h", *constants]
    whole = call("identify", "e.json", "--verbose", *settings).out
    assert {*lines} < {*whole.splitlines()}
    for title in ("fast long waves", "gradient length²", "eigenvalues", "rest at free edges"):
        assert f" {title} " in whole


def test_identify_prints_common_properties_of_materials_once(call: Call) -> None:
    other = call("identify", "modelling/composite-plate").out
    assert (other.count("identity "), other.count("note")) == (2, 1)
    alike = "rule.poisson_ratio={otherwise: 0.3, steel: 0.3}"
    result = call("identify", "modelling/composite-plate", "--set", alike).out
    assert result.startswith("modelling/composite-plate: elastic (otherwise, steel), square")
    assert result.count("identity ") == 1


def test_an_existing_output_is_kept_unless_forced(call: Call) -> None:
    OUT.write_text("mine")
    message = "pbdkit: tensile.nc: exists; --force replaces it, -o names another file\n"
    assert call("run", "e.json") == (2, "", message)
    assert OUT.read_text() == "mine"
    assert call("run", "e.json", "--force").code == 0
    assert pbdkit.open(OUT).attrs["status"] == "complete"


WRONG = {
    "an experiment as command": (2, ["paper/a"], "there is no command 'paper/a'; `pbdkit run paper/a` runs it"),
    "no command at all": (2, ["qqqqqq"], "there is no command 'qqqqqq'; `pbdkit` without arguments lists them"),
    "a word for several": (2, ["list"], "there is no command 'list'; `pbdkit experiments` lists shipped experiments, `pbdkit plugins list` plugins"),
    "a word of others": (2, ["validate"], "there is no command 'validate'; `pbdkit check` checks an experiment"),
    "unknown command": (2, ["rnu"], "there is no command 'rnu'; did you mean 'run'?"),
    "missing file": (2, ["run", "f.yaml"], "f.yaml: is neither a file nor a shipped experiment"),
    "fault in the file": (2, ["check", "e.json", "--set", "steps=0"], "setting steps=0: steps: "),
    "unknown type": (2, ["run", "e.json", "--set", "rule.type=x"], "unknown type 'x'"),
    "missing plugin": (3, ["run", "e.json", "--set", "rule.type=no:x"], "no, which is not installed"),
    "output is a folder": (2, ["run", "e.json", "-o", "."], ".: is a folder"),
    "no such folder": (6, ["run", "e.json", "-o", "no/o.nc"], "no/o.nc: there is no folder no"),
    "file for a folder": (6, ["run", "e.json", "-o", "e.json/o.nc"], "e.json/o.nc: there is no folder e.json"),
    "closed folder": (6, ["run", "e.json", "-o", "/proc/o.nc"], "/proc/o.nc: cannot be written"),
    "long file name": (6, ["run", "e.json", "-o", "o" * 300], "File name too long"),
    "init over a file": (2, ["init", "e.json"], "e.json: exists and is not replaced"),
    "init of a shipped one": (2, ["init", "paper/f1"], "paper/f1: is the name of a shipped experiment, not a file; `pbdkit init f1.yaml --from paper/f1` copies it"),
    "init from no shipped one": (2, ["init", "--from", "paper/f3"], "paper/f3: is not a shipped experiment; did you mean 'paper/f2'?"),
    "no shipped experiment": (2, ["experiments", "f1"], "f1: is not a shipped experiment; `pbdkit experiments` lists them"),
    "status of the root": (2, ["status", "/"], "/: is a folder, not a result of pbdkit"),
    "plot of nothing": (6, ["plot", "o.nc"], "o.nc: there is no such file"),
    "plot in no folder": (6, ["plot", "no/o.nc"], "no/o.nc: there is no such file"),
}  # fmt: skip


@pytest.mark.parametrize(("code", "arguments", "message"), WRONG.values(), ids=WRONG)
def test_exit_codes(call: Call, code: int, arguments: list[str], message: str) -> None:
    result = call(*arguments)
    assert message in result.err
    assert (result.code, result.out, left()) == (code, "", [])
    assert "Traceback" not in result.err


def test_a_traceback_only_on_request(call: Call) -> None:
    result = call("--debug", "run", "f.yaml")
    assert (result.code, "Traceback" in result.err) == (2, True)


SETTINGS = {
    "a default absent in the file": ("solver.relaxation=0.5", lambda e: e.solver.relaxation == 0.5),
    "a part absent in the file": ("record.every=5", lambda e: e.record.every == 5),
    "a whole part": ("rule={type: mean-displacement}", lambda e: e.rule.type == "mean-displacement"),
    "in a list": ("leaders.1.until=7", lambda e: e.leaders[1].until == 7),
    "in two lists": ("leaders.1.motion.velocity.0=1e-3", lambda e: e.leaders[1].motion.velocity[0] == 1e-3),
    "an item": ("leaders.0={select: {numbers: [8]}, motion: {type: hold}}", lambda e: e.leaders[0].select.numbers == (8,)),
}  # fmt: skip


@pytest.mark.parametrize(("setting", "holds"), SETTINGS.values(), ids=SETTINGS)
def test_valid_setting(call: Call, setting: str, holds: Callable[[Any], bool]) -> None:
    call("run", "e.json", "--set", setting)
    assert holds(pbdkit.Experiment(**json.loads(pbdkit.open(OUT).attrs["experiment"])))


UNSET = {
    "steps": "expected PATH=VALUE, for instance rule.K=-0.002",
    "leaders.-1.until=3": "'-1' is not an index of a list of 2; indices are counted from 0",
    "leaders.².until=3": "'²' is not an index of a list of 2; indices are counted from 0",
    "steps.x=1": "'x' is given as a key below a single value",
    "rule.K=1": "rule.K: unknown key",
    "rulee.K=1": "rulee: unknown key; did you mean 'rule'?",
    "steps=[1": "not valid YAML",
}


@pytest.mark.parametrize(("setting", "message"), UNSET.items())
def test_invalid_setting(call: Call, setting: str, message: str) -> None:
    result = call("run", "e.json", "--set", setting)
    assert (result.code, left()) == (2, [])
    assert result.err.startswith(f"pbdkit: setting {setting}")
    assert message in result.err


BLOWN = ["--set=solver.relaxation=50", "--set=steps=300", "--set=diagnostics=[{type: pe1}]"]


@pytest.mark.parametrize("arguments", [["identify", "paper/a"], ["schema", "experiment"]])
def test_closed_pipe_is_no_error(arguments: list[str]) -> None:
    command = [sys.executable, "-m", "pbdkit", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout
        assert process.stderr
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 0


def test_diverging_run_keeps_finite_records(call: Call) -> None:
    result = python("-m", "pbdkit", "run", "e.json", *BLOWN)
    assert (result.returncode, left()) == (4, ["tensile.nc"])
    ds = pbdkit.open(OUT)
    assert ds.attrs["status"] == "diverged"
    assert int(ds["time"][-1]) >= 1
    assert bool(abs(ds["position"]).max() < float("inf"))
    assert "diverged under rule 'barycentre'" in result.stderr
    assert len(result.stderr.splitlines()) == 2, result.stderr  # the warning before, and the end


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
@pytest.mark.parametrize("every", [1, 7])
def test_interrupted_run_keeps_all_records(
    call: Call, probing: Probing, name: str, every: int
) -> None:
    probing(f"signal.raise_signal(signal.{name})")
    result = call(*PROBED, "--set", f"record.every={every}")
    code = {"SIGINT": 130, "SIGTERM": 143}[name]
    assert (result.code, left()) == (code, ["tensile.nc.run", "tensile.nc.run-records"])
    how = "`pbdkit resume tensile.nc` continues it"
    assert result.err == f"pbdkit: interrupted: stopped after step 3; {how}\n"
    ds = pbdkit.open(OUT)
    assert ds.attrs["status"] == "interrupted"
    assert int(ds["time"][-1]) == 3


def test_killed_run_leaves_no_apparent_result(call: Call, probing: Probing) -> None:
    probing("os.kill(os.getpid(), signal.SIGKILL)")
    OUT.write_text("mine")
    assert python("-m", "pbdkit", *PROBED, "--force").returncode == -9
    assert OUT.read_text() == "mine"
    assert [str(path) for path in Path().glob("*.nc")] == ["tensile.nc"]


FAILING = {
    "second Ctrl-C": (130, {"body": "raise KeyboardInterrupt"}, "interrupted"),
    "error of a plugin": (3, {"body": "raise ZeroDivisionError"}, "probe"),
    "OSError of a plugin": (3, {"body": "raise OSError"}, "probe"),
    "too many values": (3, {"body": "return (0.0, 1.0)"}, "probe"),
    "wrong shape": (3, {"body": "return ([1.0, 2.0],)"}, "probe"),
    "unknown dimension": (3, {"dims": "('nowhere',)"}, "probe"),
    "taken name": (3, {"name": "position"}, "probe"),
}


@pytest.mark.parametrize(("code", "fault", "word"), FAILING.values(), ids=FAILING)
def test_failed_run_leaves_no_file(
    call: Call, probing: Probing, code: int, fault: Any, word: str
) -> None:
    probing(**fault)
    result = call(*PROBED)
    assert (result.code, left()) == (code, [])
    assert word in result.err


def test_file_appears_only_when_complete(call: Call, probing: Probing) -> None:
    probing("seen.extend(os.listdir())")
    assert call(*PROBED).code == 0
    seen = sys.modules["pbdkit_probe"].seen
    assert ("e.json" in seen, "tensile.nc" in seen) == (True, False)


def test_version_report_lists_what_a_defect_can_depend_on(
    call: Call, install: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    install("pbdkit-extra", "def pbdkit_components(): return []", "2.5")
    monkeypatch.setenv("PBDKIT_CACHE_DIR", "/kept")
    assert call("--version").out == f"pbdkit {pbdkit.__version__}\n"
    first, *lines = call("--version", "--verbose").out.splitlines()
    rows = dict(line.split(maxsplit=1) for line in lines)
    assert first == f"pbdkit {pbdkit.__version__}"
    assert rows.keys() >= {"python", "system", "processors", "memory", "pint", "emcee", "mpi4py"}
    assert (rows["numpy"], rows["PBDKIT_CACHE_DIR"]) == (np.__version__, "/kept")
    assert rows["pbdkit-extra"].startswith("2.5")
    assert "as in `pbdkit --version --verbose`" in call("--verbose").err


HELP = "from pbdkit.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass"


@pytest.mark.parametrize("start", [HELP, "import pbdkit"], ids=["help", "import"])
def test_startup_imports_no_heavy_package(start: str) -> None:
    heavy = "{'xarray', 'scipy', 'numba', 'netCDF4', 'matplotlib', 'rich'}"
    ask = f"{start}\nimport sys\nprint('heavy:', sorted({heavy} & set(sys.modules)))"
    assert python("-c", ask).stdout.splitlines()[-1] == "heavy: []"


LIBRARIES = {"dask", "h5py", "matplotlib", "numba", "pandas", "rich", "scipy", "shapely", "xarray"}
NEEDED = {
    "import pbdkit.api": (
        {"numpy", "pydantic"},
        {"pbdkit.equilibrium", "pbdkit.stability.distance"},
    ),
    "run paper/aa": (set(), {"pbdkit.plugin", "pbdkit.components", "pbdkit.model.experiment"}),
    "run e.json --set rul=1": ({"numpy", "pydantic"}, {"pbdkit.scene.scene", "pbdkit.stepping"}),
    "check e.json": ({"numpy", "pydantic"}, {"pbdkit.io.netcdf", "pbdkit.restart"}),
    "run e.json": ({"h5py", "numpy", "pydantic"}, {"pbdkit.equilibrium.load_stepping"}),
    "run e.json --quiet": (
        {"h5py", "numpy", "pydantic"},
        {"pbdkit.equilibrium", "pbdkit.stability.distance"},
    ),
    "status e.nc": ({"numpy"}, {"pbdkit.plugin", "pbdkit.components"}),
    "verify e.nc": ({"numpy", "pydantic"}, {"pbdkit.stepping", "pbdkit.equilibrium"}),
}
"""Return, for commands and an import, the libraries that are loaded, and the parts of pbdkit that
are not."""


@pytest.mark.parametrize(("asked", "needed"), in_turn(NEEDED.items(), 2), ids=in_turn(NEEDED, 2))
@pytest.mark.usefixtures("call")  # its folder
def test_unused_modules_are_not_imported(asked: str, needed: tuple[set[str], set[str]]) -> None:
    start = asked if asked.startswith("import") else HELP.replace("['--help']", str(asked.split()))
    told = python("-c", f"{start}\nimport sys\nprint('loaded:', *sys.modules)").stdout
    (line,) = (line for line in told.splitlines() if line.startswith("loaded:"))
    libraries, unused = needed
    assert {*line.split()} & (LIBRARIES | {"numpy", "pydantic"}) == libraries
    assert {*line.split()} & unused == set()


ASKED = {
    "run": (["run", "e.json"], False),
    "the distribution named": (["check", "e.json", "--set", "rule.type=pbdkit:barycentre"], False),
    "list": (["plugins", "list", "--json"], True),
}


@pytest.mark.parametrize(("arguments", "imported"), ASKED.values(), ids=ASKED)
def test_built_in_components_import_no_plugin(
    install: Any, call: Call, arguments: list[str], imported: bool
) -> None:
    install("pbdkit-loud", "open('imported', 'w').close()\nraise ImportError('loud')")
    assert call(*arguments).code == 0
    assert Path("imported").exists() == imported


def test_plugins_list_has_rows_for_plugins_and_components(install: Any, call: Call) -> None:
    install("pbdkit-sick", "raise ImportError('sick')", "0.3")
    rows = json.loads(call("plugins", "list", "--json").out)
    assert {*rows[-1]} == {"interface", "type", "distribution", "version", "state", "reason"}
    assert {row["distribution"] for row in rows} == {"pbdkit", "pbdkit-sick"}
    assert (rows[-1]["state"], rows[-1]["reason"]) == (
        "broken",
        "ImportError: sick (pbdkit_sick.py, line 1)",
    )


def test_init_writes_an_experiment_that_runs_and_plots(call: Call) -> None:
    assert call("init", "a.yaml").code == 0
    assert call("run", "a.yaml", "--set", "steps=5", "-o", "a.nc").code == 0
    assert call("plot", "a.nc", "--color", "pe1").code == 0
    assert left() == ["a.nc", "a.png", "a.yaml"]


def test_shipped_experiment_is_printed_verbatim(call: Call) -> None:
    assert call("experiments", "paper/f1") == (0, shipped_text("paper/f1"), "")


@pytest.mark.parametrize("name", ["start", "material/dogbone", "modelling/measured-boundary"])
def test_copy_of_a_shipped_experiment_is_equal(call: Call, name: str) -> None:
    assert call("init", "a.yaml", "--from", name).code == 0
    assert Path("a.yaml").read_text() == shipped_text(name)
    assert pbdkit.load("a.yaml").model_dump() == pbdkit.load(name).model_dump()
    data = ["measured-boundary.csv"] if "measured" in name else []
    assert left() == ["a.yaml", *data]
    assert call("check", "a.yaml").code == 0


def test_copy_takes_the_shipped_name_and_overwrites_nothing(call: Call) -> None:
    assert "f1.yaml written; next: pbdkit check f1.yaml" in call("init", "--from", "paper/f1").out
    Path("measured-boundary.csv").write_text("mine")
    refused = call("init", "--from", "modelling/measured-boundary")
    assert (refused.code, "measured-boundary.csv: exists and is not replaced" in refused.err) == (
        2,
        True,
    )
    assert left() == ["f1.yaml", "measured-boundary.csv"]


def test_copy_completes_that_of_a_killed_call(call: Call) -> None:
    copy = ["init", "--from", "modelling/measured-boundary"]
    assert call(*copy).code == 0
    Path("measured-boundary.yaml").rename(f".measured-boundary.csv.{'0' * 16}.partial")
    assert call(*copy).code == 0
    assert left() == ["measured-boundary.csv", "measured-boundary.yaml"]


def test_setup_can_be_plotted_before_the_run(call: Call) -> None:
    assert call("plot", "e.json", "--dpi", "50").out == "tensile-setup.png written\n"
    assert call("plot", "paper/a", "--set", "steps=3", "-o", "a.svg").out == "a.svg written\n"
    assert left() == ["a.svg", "tensile-setup.png"]
    assert "tensile-setup.png: exists" in call("plot", "e.json").err


def completed(*words: str) -> list[str]:
    """Return the completions of these words with the Tab key in bash."""
    asked = {"_PBDKIT_COMPLETE": "bash_complete", "COMP_WORDS": " ".join(["pbdkit", *words])}
    environment = os.environ | asked | {"COMP_CWORD": str(len(words))}
    command = [sys.executable, "-m", "pbdkit"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.splitlines()


COMPLETED = {
    "commands": (["plu"], ["plain,plugins"]),
    "commands in a group": (["plugins", "n"], ["plain,new"]),
    "shipped experiments": (["run", "paper/f2-"], ["plain,paper/f2-cusp", "plain,paper/f2-early", "plain,paper/f2-second-fracture"]),
    "files are the shell's": (["run", "mine"], ["file,mine"]),
    "options": (["run", "e.json", "--no"], ["plain,--no-plugins"]),
    "choices": (["plugins", "new", "x", "--interface", "Fr"], ["plain,FramePolicy", "plain,FractureModel"]),
    "nothing": (["nonsense", "x"], [""]),
}  # fmt: skip


@pytest.mark.parametrize(("words", "offered"), COMPLETED.values(), ids=COMPLETED)
def test_shell_completes_commands(words: list[str], offered: list[str]) -> None:
    assert completed(*words) == offered


def test_documented_shells_are_supported() -> None:
    text = (Path(pbdkit.__file__).parent.parent / "docs" / "experiments.md").read_text()
    shells = re.findall(r"_PBDKIT_COMPLETE=(\w+) pbdkit", text)
    assert shells == ["bash_source", "zsh_source", "fish_source"]
    for shell in shells:
        environment = os.environ | {"_PBDKIT_COMPLETE": shell}
        command = [sys.executable, "-m", "pbdkit"]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
        assert (done.returncode, "_pbdkit_completion" in done.stdout) == (0, True)


def test_titles_of_experiments_are_whole_sentences(call: Call) -> None:
    listed = call("experiments").out.splitlines()
    assert "paper/a                        A square sheet is pulled at" in "\n".join(listed)
    assert all(line.endswith(".") and len(line) < 160 for line in listed)


def test_command_group_alone_shows_its_help(call: Call) -> None:
    result = call("plugins")
    assert (result.code, result.err) == (0, "")
    assert result.out.startswith("Usage: pbdkit plugins")


def test_unexpected_exit_prints_a_message(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    def leave() -> None:
        raise SystemExit(0)

    monkeypatch.setattr("pbdkit.model.shipped.shipped_names", leave)
    result = call("experiments")
    assert (result.code, "a bug in pbdkit, please report it: SystemExit: 0" in result.err) == (
        1,
        True,
    )


def test_suggested_commands_exist():
    named = [word for told in MEANT.values() for word in re.findall(r"`pbdkit ([a-z]+)", told)]
    assert {*named} <= {*builtin_commands()}
    assert not {word for words in MEANT for word in words} & {*builtin_commands()}
