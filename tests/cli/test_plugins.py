"""No plugin brings a command down; its faults are reported where they matter."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from plugin_sources import BROKEN, NEWER, listed, rule
from scene_strategies import in_turn

import pbdkit
from pbdkit.bench import work_precision
from pbdkit.cli.commands import builtin_commands
from pbdkit.io.netcdf import NetcdfSink
from pbdkit.plugin.registry import Registry
from pbdkit.progress import Watch
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import Simulation, record

Install = Callable[..., None]
Call = Callable[..., Any]

HEALTHY = "--set=rule={type: zz-healthy}"
"""Found among the installed ones, so that all of them are loaded."""
TEARING = "--set=fracture={type: strain, failure: 0.05}"
EVERY_COMMAND = {
    "run": ["run", "e.json", HEALTHY, TEARING, "-o", "torn.nc"],
    "sweep": ["sweep", "s.json", "--workers", "1"],
    "resume": ["resume", "torn.nc", "--steps", "12", "--anyway"],
    "status": ["status", "left.nc"],
    "check": ["check", "e.json", HEALTHY],
    "experiments": ["experiments"],
    "init": ["init", "new.yaml"],
    "plot": ["plot", "made.nc"],
    "animate": ["animate", "made.nc", "-o", "made.gif", "--every", "10", "--dpi", "40"],
    "curve": ["curve", "torn.nc", "broken-bonds"],
    "export": ["export", "torn.nc"],
    "report": ["report", "torn.nc"],
    "explain": ["explain", "torn.nc"],
    "verify": ["verify", "torn.nc"],
    "identify": ["identify", "e.json", HEALTHY],
    "bench": ["bench", "e.json", HEALTHY, "--steps=1"],
    "live": ["live", "--help"],  # else it serves until it is ended
    "fit": ["fit", "--help"],  # `fitting/test_fit` carries some out
    "plugins": ["plugins", "list"],
    "schema": ["schema", "experiment"],
    "schema dataset": ["schema", "dataset"],
    "plugins new": ["plugins", "new", "pbdkit-fresh"],
    "plugins json": ["plugins", "list", "--json"],
}
DEAR = {"bench", "plot", "animate", "curve", "report"}
CHEAP = [name for name in EVERY_COMMAND if name not in DEAR]
"""Commands that take less than a second."""


@pytest.fixture
def healthy(install: Install, call: Call) -> None:
    """The plugin, and an unfinished run of left.nc."""
    install("zz-healthy", rule("zz-healthy"), "2.1")
    run = Simulation.of_scene(build_scene(pbdkit.load("e.json")), watch=Watch(lambda: True))
    record(run, NetcdfSink(Path("left.nc")))


def test_all_commands_are_tested() -> None:
    assert {arguments[0] for arguments in EVERY_COMMAND.values()} == set(builtin_commands())


def job_here(job: Any) -> Any:
    """Run a job of `pbdkit bench` in this process."""
    return work_precision._without_fault(json.loads(json.dumps(work_precision.result_of(job))))


@pytest.mark.usefixtures("healthy")
def test_all_broken_plugins_together_stop_no_command(
    install: Install, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = ("numpy", "float64", 1)
    Path("s.json").write_text('{"experiment": "e.json", "vary": {"rule.type": ["zz-healthy"]}}')
    monkeypatch.setattr(work_precision, "engines", lambda: [one])  # is enough
    monkeypatch.setattr(work_precision, "_run_in_process", lambda job, *_: job_here(job))
    assert call("run", "e.json", "-o", "made.nc").code == 0
    for n, (source, _) in enumerate(BROKEN.values()):
        install(f"pbdkit-broken-{n}", source, f"0.{n}")
    failed = {name: r for name, a in EVERY_COMMAND.items() if (r := call(*a)).code}
    assert failed == {}
    found = listed(call)
    for n, (_, reason) in enumerate(BROKEN.values()):
        row = found[f"pbdkit-broken-{n}"]
        expected = reason.replace("pbdkit-broken", f"pbdkit-broken-{n}")
        expected = expected.replace("pbdkit_broken", f"pbdkit_broken_{n}")
        assert row["reason"].startswith(expected)
        assert (row["version"], row["state"]) == (f"0.{n}", "broken")
    assert (found["zz-healthy"]["state"], found["zz-healthy"]["reason"]) == ("ok", "")


@pytest.mark.usefixtures("healthy")
@pytest.mark.parametrize("kind", in_turn(BROKEN, 2))
def test_no_broken_plugin_stops_a_command(install: Install, call: Call, kind: str) -> None:
    """Choose a run, of which others read the result, and some of the other commands, each in its
    turn."""
    source, reason = BROKEN[kind]
    run, *others = CHEAP
    tried = [run, *in_turn(others, 8, first=[*BROKEN].index(kind) % 8)]
    install("pbdkit-broken", source, "0.3")
    Path("s.json").write_text('{"experiment": "e.json", "vary": {"rule.type": ["zz-healthy"]}}')
    assert {name: r for name in tried if (r := call(*EVERY_COMMAND[name])).code} == {}
    table = " ".join(call("plugins", "list").out.split())
    assert f"pbdkit-broken 0.3 broken {reason}" in table


def test_program_survives_all_broken_plugins(install: Install, call: Call) -> None:
    install("zz-healthy", "print('noise')\n" + rule("zz-healthy"))
    install("pbdkit-exit", BROKEN["exit"][0])
    install("pbdkit-warns", "import warnings\nwarnings.simplefilter('error')\n" + rule("w"))
    command = [sys.executable, "-m", "pbdkit", "run", "e.json", HEALTHY, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, json.loads(done.stdout)["status"]) == (0, "complete")
    assert "noise" in done.stderr


METADATA = {
    "no equals sign": ("entry_points.txt", "[pbdkit]\nx\n", "pbdkit-torn"),
    "no module": ("entry_points.txt", "[pbdkit]\nx = ?\n", "pbdkit-torn"),
    "no UTF-8": ("entry_points.txt", b"\xff\xfe[pbdkit]", "pbdkit_torn-1.0.dist-info"),
    "no name": ("METADATA", "Version: 1.0\n", "(no name)"),
    "empty": ("METADATA", "", "(no name)"),
}


@pytest.mark.usefixtures("healthy")
@pytest.mark.parametrize(("file", "content", "name"), METADATA.values(), ids=METADATA)
def test_corrupt_metadata_stops_no_command(
    install: Install, call: Call, tmp_path: Path, file: str, content: Any, name: str
) -> None:
    install("pbdkit-torn", rule("torn"))
    tear(tmp_path / "site" / "pbdkit_torn-1.0.dist-info" / file, content)
    assert call("check", "e.json", HEALTHY).code == 0
    row = listed(call)[name]
    assert row["state"] == "broken"
    assert row["reason"] != ""


def tear(file: Path, content: Any) -> None:
    file.write_bytes(content if isinstance(content, bytes) else content.encode())


def test_corrupt_metadata_stops_no_first_command(
    install: Install, call: Call, tmp_path: Path
) -> None:
    """Pydantic would go through all distributions when a process builds its first model."""
    for n, (file, content, _) in enumerate(METADATA.values()):
        install(f"pbdkit-torn-{n}", rule(f"torn-{n}"))
        tear(tmp_path / "site" / f"pbdkit_torn_{n}-1.0.dist-info" / file, content)
    command = [sys.executable, "-m", "pbdkit", "run", "e.json", "--quiet"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def test_other_api_version_is_incompatible(install: Install, call: Call) -> None:
    install("pbdkit-newer", NEWER, "9.0")
    row = listed(call)["pbdkit-newer"]
    expected = "it implements version 2 of the plugin API, but pbdkit "
    assert (row["version"], row["state"]) == ("9.0", "incompatible")
    assert row["reason"].startswith(f"{expected}{pbdkit.__version__} has version 1; install")
    result = call("run", "e.json", "--set=rule={type: newer}")
    assert result.code == 2
    assert "unknown type 'newer'" in result.err
    assert "; pbdkit-newer 9.0 is incompatible: it implements version 2" in result.err


def test_current_api_version_is_accepted(install: Install) -> None:
    install("pbdkit-same", "pbdkit_api = 1\n" + rule("same"))
    assert [p.state for p in Registry().installed] == ["ok"]


def test_an_object_can_be_the_plugin_and_declare_its_api(install: Install, tmp_path: Path) -> None:
    source = rule("held").split("@pbdkit")[0] + (
        "class Plugin:\n    pbdkit_api = 3\n"
        "    @pbdkit.hookimpl\n    def pbdkit_components(self):\n        return [Rule]\n"
        "plugin = Plugin()\n"
    )
    install("pbdkit-held", source)
    points = tmp_path / "site" / "pbdkit_held-1.0.dist-info" / "entry_points.txt"
    points.write_text("[pbdkit]\nheld = pbdkit_held:plugin\n")
    assert [p.state for p in Registry().installed] == ["incompatible"]


def test_an_api_version_is_a_number(install: Install) -> None:
    install("pbdkit-odd", "pbdkit_api = '1'\n" + rule("odd"))
    (plugin,) = Registry().installed
    assert (plugin.state, plugin.reason) == (
        "broken",
        "TypeError: its `pbdkit_api` should be a whole number, got '1'",
    )


def test_run_names_the_plugin_of_a_broken_component(install: Install, call: Call) -> None:
    install("pbdkit-broken", "import no_such_module\n" + rule("lost"), "0.3")
    reason = "ModuleNotFoundError: No module named 'no_such_module' (pbdkit_broken.py, line 1)"
    result = call("run", "e.json", "--set=rule={type: 'pbdkit-broken:lost'}")
    assert (result.code, Path("tensile.nc").exists()) == (3, False)
    whose = "'lost' belongs to pbdkit-broken 0.3, which is broken"
    assert f": rule.type: {whose}: {reason}\n" in result.err
    result = call("run", "e.json", "--set=rule={type: lost}")
    assert (result.code, Path("tensile.nc").exists()) == (2, False)
    assert "unknown type 'lost'; " in result.err
    assert f"; pbdkit-broken 0.3 is broken: {reason}" in result.err


def test_directory_change_by_a_plugin_is_undone(
    install: Install, call: Call, tmp_path: Path
) -> None:
    install("pbdkit-moving", f"import os\nos.chdir({str(tmp_path)!r})\n" + rule("moving"))
    assert call("run", "e.json", "--set=rule={type: moving}", "-o", "here.nc").code == 0
    assert Path("here.nc").exists()


def test_long_names_are_printed_in_one_short_line(install: Install, call: Call) -> None:
    for name in ("\x1b[31mred", "y" * 100_000, "pbdkit-\x1b:red"):
        result = call("run", "e.json", "--set", f"rule.type={json.dumps(name)}")
        assert result.code in (2, 3)
        assert "\x1b" not in result.err.split("rule.type: ")[1]
        assert len(result.err.split("rule.type: ")[1]) < 2000


HALF = rule(
    "half",
    """
class Bad(Rule):
    type: Literal['bad'] = 'bad'
    def apply(self): pass
""",
)
HALF = HALF.replace("[Rule]", "[Bad, Rule, int]")


def test_one_invalid_class_leaves_the_others_usable(install: Install, call: Call) -> None:
    install("pbdkit-half", HALF, "0.3")
    assert call("run", "e.json", "--set=rule={type: half}").code == 0
    result = call("check", "e.json", "--set=rule={type: bad}")
    assert result.code == 3
    assert "'bad' belongs to pbdkit-half 0.3, which is broken: TypeError: Bad.apply" in result.err
    rows = json.loads(call("plugins", "list", "--json").out)
    states = [(r["interface"], r["type"], r["state"]) for r in rows if "half" in r["distribution"]]
    assert states == [
        ("plugin", "pbdkit-half", "broken"),
        ("FollowerRule", "bad", "broken"),
        ("FollowerRule", "half", "ok"),
        ("", "", "broken"),
    ]
