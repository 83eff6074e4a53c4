"""Outputs: files that are never replaced, files that a failed run leaves, and messages before a
run."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import pbdkit
from pbdkit.cli.output import refuse_output

Call = Callable[..., Any]
OUT = Path("tensile.nc")
PROBED = ("--set", "diagnostics=[{type: probe}]")


def left() -> list[str]:
    return sorted(path.name for path in Path().iterdir() if path.name != "e.json")


def link(to: str) -> Callable[[], None]:
    return lambda: OUT.symlink_to(to)


SPECIAL = {
    "link": (link("e.json"), "is a symbolic link"),
    "dangling link": (link("nowhere"), "is a symbolic link"),
    "pipe": (lambda: os.mkfifo(OUT), "is a pipe"),
    "the experiment by a hard link": (lambda: os.link("e.json", OUT), "is the experiment itself"),
}


@pytest.mark.parametrize("force", [(), ("--force",)], ids=["", "forced"])
@pytest.mark.parametrize(("make", "word"), SPECIAL.values(), ids=SPECIAL)
def test_only_regular_files_other_than_the_experiment_are_replaced(
    call: Call, make: Callable[[], None], word: str, force: tuple[str, ...]
) -> None:
    make()
    kind, text = stat.S_IFMT(OUT.lstat().st_mode), Path("e.json").read_text()
    result = call("run", "e.json", *force)
    assert (result.code, result.out) == (2, "")
    assert result.err.startswith(f"pbdkit: tensile.nc: {word}")
    assert "name another file with -o" in result.err
    assert (stat.S_IFMT(OUT.lstat().st_mode), Path("e.json").read_text()) == (kind, text)
    assert left() == ["tensile.nc"]


def test_a_device_is_not_replaced() -> None:
    """Replace the check alone: a command that failed it would cost this machine its device."""
    with pytest.raises(pbdkit.ExperimentError, match="is a device, which is not replaced"):
        refuse_output(Path(os.devnull), force=True)


@pytest.mark.parametrize("name", ["e.json", "./e.json", "linked.json"])
def test_experiment_file_is_not_replaced(call: Call, name: str) -> None:
    Path("linked.json").symlink_to("e.json")
    text = Path("e.json").read_text()
    around = f"../{Path.cwd().name}/e.json"
    for given, output in ((name, "e.json"), ("e.json", around)):
        result = call("run", given, "-o", output, "--force")
        assert (result.code, "is the experiment itself" in result.err) == (2, True)
    assert Path("e.json").read_text() == text


def test_file_name_that_is_not_utf_8_is_refused(call: Call) -> None:
    result = call("run", "e.json", "-o", os.fsdecode(b"o\xff.nc"))
    assert (result.code, left()) == (2, [])
    assert "o\\xff.nc: the name is not UTF-8; name another file with -o" in result.err


FAILING = {
    "diverged": (4, ["--set=solver.relaxation=50", "--set=steps=300"]),
    "unconverged": (
        4,
        [
            "--set=solver={type: equilibrium, tolerance: 1e-17}",
            "--set=body.rows=20",
            "--set=leaders.1.until=10",
        ],
    ),
}


@pytest.mark.parametrize(("status", "code", "settings"), [(k, *v) for k, v in FAILING.items()])
def test_failed_run_keeps_a_previous_result(
    call: Call, status: str, code: int, settings: list[str]
) -> None:
    again = "--set=rule={type: mean-displacement}"
    assert call("run", "e.json", "--quiet", again).code == 0
    good = OUT.read_bytes()
    for name in ("tensile-partial.nc", "tensile-partial-2.nc"):
        result = call("run", "e.json", "--force", *settings)
        assert (result.code, OUT.read_bytes() == good) == (code, True)
        ending = f"the records up to this step are in {name}; tensile.nc is unchanged\n"
        assert result.err.endswith(ending)
        assert pbdkit.open(name).attrs["status"] == status
    assert left() == ["tensile-partial-2.nc", "tensile-partial.nc", "tensile.nc"]
    figures = json.loads(call("run", "e.json", "--force", "--json", *settings).out)
    assert figures["output"] == "tensile-partial-3.nc"


def test_failed_run_takes_the_output_name_if_it_is_free(call: Call) -> None:
    code, settings = FAILING["diverged"]
    result = call("run", "e.json", "--force", *settings)
    assert (result.code, left()) == (code, ["tensile.nc"])
    assert result.err.endswith("the records up to this step are in tensile.nc\n")


def test_existing_result_is_kept_without_hard_links(
    call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> None:
        raise OSError("no hard links here")

    monkeypatch.setattr(os, "link", refuse)
    OUT.write_text("mine")
    code, settings = FAILING["diverged"]
    assert call("run", "e.json", "--force", *settings).code == code
    assert (OUT.read_text(), left()) == ("mine", ["tensile-partial.nc", "tensile.nc"])


def test_run_warns_beforehand_of_output_larger_than_the_disk(
    call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = SimpleNamespace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: small)
    result = call("run", "e.json")
    assert (result.code, left()) == (0, ["tensile.nc"])
    warning = r"warning: record: the output of about 0.0\d+ MiB may not fit into the 0.000954 MiB"
    assert pytest.approx(1000 / 2**20, rel=1e-3) == 0.000954
    assert re.match(warning, result.err), result.err
    assert call("run", "e.json", "--force", "--quiet").err == ""


MOVES = "import os, tempfile\nos.chdir(tempfile.mkdtemp())\n"


@pytest.mark.parametrize("when", ["imported", "used"])
def test_plugin_that_changes_directory_does_not_move_output(
    call: Call, probing: Any, tmp_path: Path, when: str
) -> None:
    probing("import tempfile; os.chdir(tempfile.mkdtemp())" if when == "used" else "pass")
    source = tmp_path / "site" / "pbdkit_probe.py"
    if when == "imported":
        source.write_text(MOVES + source.read_text())
    folder = Path.cwd()
    result = call("run", "e.json", *PROBED)
    assert result.code == 0, result.err
    assert (folder / "tensile.nc").is_file()


def test_missing_current_directory_is_reported(call: Call) -> None:
    gone = Path.cwd() / "gone"
    gone.mkdir()
    os.chdir(gone)
    gone.rmdir()
    result = call("run", "paper/a")
    assert (result.code, result.err.startswith("pbdkit: the current folder: ")) == (6, True)


def test_plot_overwrites_only_on_request(call: Call) -> None:
    assert call("run", "e.json", "--quiet").code == 0
    picture = Path("tensile.png")
    picture.write_text("mine")
    result = call("plot", "tensile.nc")
    message = "pbdkit: tensile.png: exists; --force replaces it, -o names another file\n"
    assert (result.code, result.err, picture.read_text()) == (2, message, "mine")
    assert call("plot", "tensile.nc", "--force").code == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    picture.unlink()
    picture.symlink_to("tensile.nc")
    assert call("plot", "tensile.nc", "--force").code == 2
    assert pbdkit.open(OUT).attrs["status"] == "complete"


INTERRUPT = """
import runpy, sys

class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == NAME:
            raise KeyboardInterrupt

sys.argv = ["pbdkit", "run", "e.json"]
sys.meta_path.insert(0, Interrupt())
runpy.run_module("pbdkit", run_name="__main__")
"""


@pytest.mark.parametrize("module", ["pbdkit.cli", "click", "pbdkit.scene.scene", "h5netcdf"])
def test_interrupt_during_startup_shows_no_traceback(call: Call, module: str) -> None:
    command = [sys.executable, "-c", INTERRUPT.replace("NAME", repr(module))]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr.strip(), left()) == (130, "pbdkit: interrupted", [])


SIGNAL = """
import os, runpy, signal, sys

number, seen = int(sys.argv.pop(1)), []

def count(event, arguments):
    if event == "import" and (seen or arguments[0] == "pbdkit.cli"):
        seen.append(arguments[0])
        if len(seen) == number:
            os.kill(os.getpid(), signal.SIGINT)

sys.addaudithook(count)
runpy.run_module("pbdkit", run_name="__main__", alter_sys=True)
"""


@pytest.mark.parametrize("number", [1, 2, 3, 10, 30, 100, 200, 300])
def test_signal_during_any_import_exits_with_one_line(call: Call, number: int) -> None:
    command = [sys.executable, "-c", SIGNAL, str(number), "run", "e.json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr.strip(), left()) == (130, "pbdkit: interrupted", [])


CLASS = """
class Stops:
    def __set_name__(self, owner, name):
        raise KeyboardInterrupt

class Made:
    part = Stops()
"""


@pytest.mark.parametrize("body", ["raise KeyboardInterrupt", CLASS], ids=["exec", "class"])
def test_interrupt_converted_by_python_is_handled(body: str) -> None:
    """Code that is a text, as that of named tuples, ends by the signal; classes by an error."""
    code = (
        f"import pbdkit.cli as c; c.program.main = lambda *a, **k: exec({body!r}, {{}}); c.main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130, "pbdkit: interrupted\n")


@pytest.mark.skipif(sys.platform != "linux", reason="limits on address space are Linux's")
@pytest.mark.parametrize(("mib", "code"), [(100, 6), (900, 6), (1030, 2), (1300, 0)])
def test_memory_limit_is_reported_in_one_line(call: Call, mib: int, code: int) -> None:
    """Libraries that get no memory spin, or end the process: they are not called."""
    limit = f"import resource as r; r.setrlimit(r.RLIMIT_AS, ({mib} * 2**20,) * 2)"
    program = f"{limit}; from pbdkit.__main__ import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", program, "run", "e.json", "--quiet"], capture_output=True, text=True
    )
    assert (done.returncode, done.stderr.count("\n")) == (code, int(code > 0))
    assert {6: "(ulimit -v)", 2: "may be used on this machine", 0: ""}[code] in done.stderr


@pytest.mark.parametrize(
    "error",
    [
        "MemoryError",
        'RuntimeError("can\'t start new thread")',
        "ImportError('libx.so: failed to map segment from shared object')",
        'OSError("Can\'t synchronously write data (memory allocation failed for chunk)")',
    ],
)
def test_out_of_memory_during_a_run_is_reported(error: str, capsys: Any, monkeypatch: Any) -> None:
    from pbdkit.cli import main, program

    def raises(*_: Any, **more: Any) -> None:
        raise eval(error)

    monkeypatch.setattr(program, "main", raises)
    with pytest.raises(SystemExit) as caught:
        main(["run"])
    assert caught.value.code == 6
    assert capsys.readouterr().err.startswith("pbdkit: out of memory")


@pytest.mark.parametrize(
    ("function", "command"),
    [
        ("pbdkit.linear.stencil._eigenvalues", ["run", "e.json", "-o", "new.nc"]),
        ("pbdkit.io.open.open_sealed", ["plot", "out.nc"]),
        ("pbdkit.io.hdf5_file.refuse_no_file_cache", ["plot", "out.nc"]),
        ("pbdkit.io.hdf5_file.refuse_no_file_cache", ["run", "e.json", "-o", "new.nc"]),
        ("pbdkit.cli.verify.open_sealed", ["verify", "out.nc"]),
    ],
)
def test_exhausted_memory_has_no_other_effect(
    function: str, command: list[str], call: Call, monkeypatch: Any
) -> None:
    """It neither counts as damage of a file, nor leaves anything out of a result."""

    def raises(*_: Any, **more: Any) -> None:
        raise MemoryError

    assert call("run", "e.json", "-o", "out.nc").code == 0
    monkeypatch.setattr(function, raises)
    found = call(*command)
    assert (found.code, found.err.startswith("pbdkit: out of memory")) == (6, True), found.err
    assert left() == ["out.nc"]


@pytest.mark.parametrize("name", ["e.json", "m.csv"])
def test_disk_that_fails_while_an_input_is_read(name: str, call: Call, monkeypatch: Any) -> None:
    opened = Path.open

    def fails(path: Path, *mode: Any, **more: Any) -> Any:
        if path.name == name:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return opened(path, *mode, **more)

    Path("m.csv").write_text("step,ux,uy\n0,0,0\n9,1,0\n")
    motion = "leaders.1.motion={type: table, file: m.csv}"
    monkeypatch.setattr(Path, "open", fails)
    found = call("run", "e.json", "--set", motion, "-o", "out.nc")
    assert (found.code, f"{name}: cannot be read: Input/output error; " in found.err) == (6, True)


def test_container_limit_bounds_memory(tmp_path: Path, monkeypatch: Any) -> None:
    from pbdkit import memory

    monkeypatch.setattr(memory, "CONTAINER", tmp_path / "memory.max")
    whole = memory.machine_memory()
    (tmp_path / "memory.max").write_text("max\n")
    assert memory.machine_memory() == whole
    (tmp_path / "memory.max").write_text("1048576\n")
    assert memory.machine_memory() == 2**20
