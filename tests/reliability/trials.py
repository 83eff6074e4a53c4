"""Small experiments, calls of the program in processes of their own that can be killed, and the
comparison of two results, bit for bit; the trials of runs share them."""

from __future__ import annotations

import io
import json
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, suppress
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parent.parent)]

import h5netcdf  # noqa: F401  # the children find all that is heavy loaded
import h5py  # noqa: F401  # as above
import numpy as np
import xarray  # noqa: F401  # as above

import pbdkit
import pbdkit.cli.run
import pbdkit.io.open
import pbdkit.io.run_store
import pbdkit.restart
import pbdkit.stability.forecast
from pbdkit.cli import main
from pbdkit.io import netcdf as netcdf_sink, sqlite_file
from pbdkit.io.atomic_file import is_local
from pbdkit.io.netcdf import FINAL_STATE, NetcdfSink
from pbdkit.io.seal import SealedFile, open_sealed

OUTPUT = "out.nc"
OF_A_RUN = ("created", "ranks")
"""Attributes with the time and the number of processes of a run."""
BASE: dict[str, Any] = {
    "name": "trial",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "grid", "columns": 24, "rows": 20},
    "rule": {"type": "barycentre"},
    "leaders": [
        {"select": {"edge": "left"}, "motion": {"type": "hold"}},
        {
            "select": {"edge": "right"},
            "motion": {"type": "velocity", "velocity": [0.07, 0.01], "steps": 20},
        },
    ],
    "steps": 30,
    "solver": {"type": "stepping", "engine": "numpy"},
}
BREAKING = {
    "fracture": {"type": "damage", "onset": 0.1, "failure": 0.4},
    "diagnostics": [{"type": "displacement"}, {"type": "broken"}],
}
LARGE = {  # records of more than a chunk of one entry
    "body": {"type": "grid", "columns": 330, "rows": 220},
    "steps": 8,
    "diagnostics": [{"type": "pe1"}],
}
COMPRESSED = LARGE | {"record": {"dtype": "float32", "compression": "zlib"}}
SETTLING = {
    "body": {"type": "grid", "columns": 6, "rows": 5},
    "steps": 400,
    "record": {"every": 7},
    "solver": {"type": "stepping", "engine": "numpy", "settle": {"tolerance": 1e-4}},
}
INCREMENTS = {
    "body": {"type": "grid", "columns": 8, "rows": 6},
    "fracture": {"type": "strain", "failure": 0.3, "scatter": 0.1},
    "solver": {"type": "equilibrium"},
}
EXPERIMENTS = {
    "breaking": BASE | BREAKING,
    "large": BASE | LARGE,
    "compressed": BASE | COMPRESSED,
    "settling": BASE | SETTLING,
    "increments": BASE | INCREMENTS,
}


def often(first_s: float = 0.0) -> None:
    """From now on this process commits whenever it can."""
    kinds = NetcdfSink.__init__.__kwdefaults__
    assert kinds is not None
    kinds["first_s"] = first_s
    netcdf_sink.EVERY_S, netcdf_sink.SHARE = 0.0, 0


def network() -> None:
    """Take the disk for one of another machine: no write-ahead log."""
    sqlite_file.is_local = lambda path: is_local(path, mounts="/nowhere")


def started(work: Callable[[], object], log: Path) -> int:
    """Start a process that does the work and exits as it does; its output is written to the log."""
    log.touch()  # it may be killed before any output
    if pid := os.fork():
        return pid
    code = 70
    try:
        descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(descriptor, 1)
        os.dup2(descriptor, 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
        work()
        code = 0
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 71
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def ended(pid: int, patience_s: float = 600.0) -> int:
    """Return the exit status of a process, or minus the signal; one that hangs is killed: -1000."""
    end = time.monotonic() + patience_s
    while time.monotonic() < end:
        found, status = os.waitpid(pid, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.002)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    return -1000


def warm_up(folder: Path) -> None:
    """Calls the program in this process, so that those that it forks find all modules loaded."""
    folder.mkdir()
    os.chdir(folder)
    name = write_experiment(BASE | BREAKING | {"steps": 2}, folder)
    last = ["resume", OUTPUT, "--steps", "3", "--quiet"]
    for line in (["run", name, "-o", OUTPUT, "--quiet"], ["status", OUTPUT], last):
        with suppress(SystemExit), redirect_stderr(io.StringIO()):
            main(line)
    recorded(Path(OUTPUT))


def called(*arguments: str, log: Path, before: Callable[[], object] = often) -> int:
    """The process id of a call of the program, in the current folder."""

    def work() -> None:
        before()
        main([*arguments])

    return started(work, log)


def done(*arguments: str, log: Path, before: Callable[[], object] = often) -> tuple[int, str]:
    """Return the exit status of such a call, and its output."""
    code = ended(called(*arguments, log=log, before=before))
    return code, log.read_text(errors="replace")


def write_experiment(parts: dict[str, Any], folder: Path) -> str:
    """Its name in the folder."""
    (folder / "e.json").write_text(json.dumps(parts))
    return "e.json"


def reference(parts: dict[str, Any], folder: Path) -> tuple[Path, float]:
    """The result of the uninterrupted run, and how long a run that commits often takes."""
    folder.mkdir()
    os.chdir(folder)
    name = write_experiment(parts, folder)
    code, said = done("run", name, "-o", "plain.nc", log=Path("log"), before=lambda: often(1e9))
    assert code == 0, said
    begun = time.perf_counter()
    code, said = done("run", name, "-o", "kept.nc", log=Path("log"))
    assert code == 0, said
    assert differences(Path("plain.nc"), Path("kept.nc")) == []
    return folder / "plain.nc", time.perf_counter() - begun


def differences(one: Path, other: Path) -> list[str]:
    """Return the differences of two results, to the bit, except the time of their creation."""
    for path in (one, other):
        with SealedFile(path) as file:
            file.check()
    with open_sealed(one) as first, open_sealed(other) as second:
        return list(_different(first, second))


def _different(first: Any, second: Any) -> Iterator[str]:
    if list(first.variables) != list(second.variables):
        yield f"variables {list(first.variables)}, {list(second.variables)}"
        return
    for name in first.variables:
        one, two = first[name], second[name]
        if one.dimensions != two.dimensions or one.dtype != two.dtype or one.shape != two.shape:
            yield f"{name}: {one.shape} {one.dtype}, {two.shape} {two.dtype}"
        elif _bytes(one[...]) != _bytes(two[...]):
            yield f"{name}: other values"
        elif _attributes(one) != _attributes(two):
            yield f"{name}: other attributes"
    if (mine := _attributes(first)) != (others := _attributes(second)):
        yield f"attributes {[k for k in mine | others if mine.get(k) != others.get(k)]}"
    ends = [json.loads(f.groups[FINAL_STATE].attrs["facts"])["run"] for f in (first, second)]
    if ends[0] != ends[1]:
        yield f"final states {ends}"
    for name, one in first.groups[FINAL_STATE].variables.items():
        if _bytes(one[...]) != _bytes(second.groups[FINAL_STATE][name][...]):
            yield f"final state, {name}"


def _attributes(of: Any) -> dict[str, Any]:
    return {k: np.asarray(v).tolist() for k, v in of.attrs.items() if k not in OF_A_RUN}


def _bytes(values: Any) -> bytes:
    array = np.asarray(values)
    return json.dumps(array.tolist()).encode() if array.dtype == object else array.tobytes()


def recorded(path: Path) -> Any:
    """Steps and positions of a result, or of what was kept of a run; the last as it is forced."""
    with pbdkit.open(path) as dataset:
        return dataset["time"].values.copy(), dataset["position"].values.copy()


def debris(folder: Path, *known: str) -> list[str]:
    """Return the files in a folder that should not be there."""
    return sorted({p.name for p in folder.iterdir()} - {*known, "e.json", "log"})


def row(goal: str, measured: str) -> None:
    """A row of the table."""
    print(f"{goal} | {measured}", flush=True)
