"""Processes that mpiexec starts."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import commands_on_ranks
import h5netcdf
import pytest

import pbdkit
from pbdkit.io.run_store import has_committed, status_of
from tests.mpi.test_distributed_run import assert_same, written

BESIDE = Path(sys.executable).parent
"""Place of the launcher of mpi4py's own MPI, whether or not the environment is activated."""
MPIEXEC = shutil.which("mpiexec", path=BESIDE) or shutil.which("mpiexec")
pytestmark = pytest.mark.skipif(not MPIEXEC, reason="no mpiexec: pip install mpich")

SCRIPT = Path(__file__).parents[1] / "reliability" / "rank_runs.py"
MULTIGRID = "solver.method=multigrid"
NOBODY = "leaders.0.select={box: [-9, -9, -8, -8]}"
REEVALUATED = ["neighbours={type: euclidean, radius: 1.2, reevaluate: true}", "steps=20"]
ALONE = {"material/bar": [], "paper/a": REEVALUATED}
"""Experiments that several processes do not share: an equilibrium, and a run of steps."""
SHARED = {"paper/f2": ["steps=40"], "modelling/strip": [MULTIGRID]}
"""Experiments that they share: a run of steps, and an equilibrium on grids."""
LINES = {
    "refused": ["run", "paper/f2", "--set", "rule.K=1"],
    "refused by the first": ["run", "material/bar", "--set", NOBODY],
    "diverging": ["run", "paper/a", "--set", "solver.relaxation=2.5", "--set", "steps=200"],
    "unconverged": ["run", "modelling/strip", f"--set={MULTIGRID}", "--set=solver.tolerance=1e-17"],
    "random scenes": [str(SCRIPT), "--trials", "1"],
} | {
    name: ["run", name, *(f"--set={text}" for text in settings), "-o", f"{Path(name).name}.nc"]
    for name, settings in (ALONE | SHARED).items()
}


@pytest.fixture(scope="module")
def launched(tmp_path_factory):
    """The outcomes of `LINES` in two processes that mpiexec starts, and their folder."""
    folder = tmp_path_factory.mktemp("launched")
    found = commands_on_ranks.on_ranks(MPIEXEC, 2, [*LINES.values()], folder)
    return dict(zip(LINES, found, strict=True)), folder


def assert_file_of_one_process(name, settings, launched, folder):
    done, others = launched[0][name], launched[1]
    assert done.statuses == [0] * 2, done.err
    assert done.out.count("complete: ") == 1
    given = pbdkit.load(name, settings=settings).model_dump(mode="json", by_alias=True)
    written(given, folder / "one.nc")
    assert_same(folder / "one.nc", others / f"{Path(name).name}.nc")


@pytest.mark.parametrize("name", SHARED)
def test_mpiexec_gives_the_file_of_one_process(name, launched, tmp_path):
    assert_file_of_one_process(name, SHARED[name], launched, tmp_path)
    assert launched[0][name].out.count(" on 2 processes") == 1
    with h5netcdf.File(launched[1] / f"{Path(name).name}.nc", "r") as file:
        assert file.attrs["ranks"] == "2"


@pytest.mark.parametrize("name", ALONE)
def test_first_process_runs_undistributed_work_alone(name, launched, tmp_path):
    assert_file_of_one_process(name, ALONE[name], launched, tmp_path)
    assert launched[0][name].err.count("; the first process runs it alone") == 1


def test_errors_are_printed_once(launched):
    refused, diverged = launched[0]["refused"], launched[0]["diverging"]
    assert refused.statuses == [2] * 2
    assert refused.err.count("pbdkit: ") == 1
    assert "rule.K" in refused.err
    assert diverged.statuses == [4] * 2
    assert diverged.err.count("pbdkit: diverged") == 1


def test_refusal_by_the_first_process_ends_all(launched):
    done = launched[0]["refused by the first"]
    assert done.statuses == [2] * 2
    assert done.err.count("selects no particle") == 1


def test_end_without_equilibrium_is_reported_once(launched):
    done = launched[0]["unconverged"]
    assert done.statuses == [4] * 2
    assert done.err.count("pbdkit: unconverged: ") == 1


def test_a_sample_of_the_long_trial_on_random_scenes(launched):
    done = launched[0]["random scenes"]
    assert done.statuses == [0] * 2, done.out + done.err
    assert "'compared': " in done.out


def test_killing_one_process_ends_all_and_the_run_resumes(tmp_path):
    settings = ["--set", "steps=1000000", "--set", "record.every=1000000", "--quiet"]
    arguments = ["run", "paper/a", *settings, "-o", "out.nc"]
    command = [MPIEXEC, "-n", "2", sys.executable, "-m", "pbdkit", *arguments]
    quiet = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
    running = subprocess.Popen(command, cwd=tmp_path, **quiet)
    try:
        end = time.monotonic() + 60
        while not has_committed(tmp_path / "out.nc"):
            assert time.monotonic() < end
            assert running.poll() is None
            time.sleep(0.1)
        every = processes_of(running.pid)
        os.kill(every[-1], signal.SIGKILL)
        assert running.wait(10) != 0
        assert not set(every) & set(processes_of(1))
    finally:
        running.kill()
        running.wait()
    assert status_of(tmp_path / "out.nc")["step"] > 0


def processes_of(launcher):
    """The processes that a launcher has started, down to the last."""
    text = subprocess.run(["ps", "-eo", "pid,ppid"], capture_output=True, text=True).stdout
    pairs = [tuple(map(int, line.split())) for line in text.splitlines()[1:]]
    found = [launcher]
    for parent in found:
        found += [pid for pid, above in pairs if above == parent]
    return found
