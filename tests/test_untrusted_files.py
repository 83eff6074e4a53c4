"""Files without seal are tried in another process; samples of the long trials of files."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import xarray

import pbdkit
from pbdkit.untrusted_files import BEGINNINGS, MODULE, opened_unsealed, try_reading

sys.path.append(str(Path(__file__).parent / "reliability"))
import fuzz_experiments
import mutate_results


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("subjects")


@pytest.fixture
def bare(folder):
    return mutate_results.make_subject("rewritten", folder)


NO_RESULTS = {
    "picture.jpeg": b"\x89PNG\r\n\x1a\n" + bytes(100),
    "empty.nc": b"",
    "short.nc": BEGINNINGS[0][:5],
}


@pytest.mark.parametrize("name", NO_RESULTS)
def test_other_files_are_refused_in_one_line(name, call):
    Path(name).write_bytes(NO_RESULTS[name])
    said = f"{name}: is not a result of pbdkit: its first bytes are not those of netCDF"
    verified = call("verify", name)
    assert (verified.code, verified.out) == (6, said + "\n")
    for command in ("plot", "explain"):
        assert call(command, name)[::2] == (6, f"pbdkit: {said}\n")


def test_experiment_directory_and_missing_file_are_no_results(call):
    Path("kept").mkdir()
    result = call("verify", "e.json", "kept", "gone.nc", "/dev/null")
    assert result.code == 6
    assert result.out.splitlines() == [
        "e.json: is an experiment; `pbdkit run e.json` computes its result and prints the path",
        "kept: is a folder, not a result of pbdkit",
        "gone.nc: there is no such file",
        "/dev/null: is not a plain file, and not a result of pbdkit",
    ]


LIBRARIES = {
    "crashes": ("import os; os.abort()", "the process that reads it ends by a signal: Aborted"),
    "ends": ("import os; os._exit(3)", "the process that reads it ends with status 3"),
    "hangs": (
        "import faulthandler as f; f.dump_traceback_later(.3, exit=True)\nwhile True: pass",
        "the process that reads it does not end within",
    ),
    "fails": ("raise ValueError('odd')", "cannot be read as netCDF-4: odd"),
    "eats": (
        "import numpy; numpy.ones(2**60)",
        "cannot be read as netCDF-4: (Unable to allocate|array is too big|Maximum allowed)",
    ),
}


@pytest.mark.parametrize("name", LIBRARIES)
def test_failing_library_gives_an_error(name, bare, tmp_path, monkeypatch):
    source, said = LIBRARIES[name]
    (tmp_path / f"{MODULE}.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(pbdkit.StorageError, match=rf"rewritten\.nc: .*{said}"):
        try_reading(bare)


def test_intact_files_pass(bare):
    assert try_reading(bare) is None
    with pytest.warns(pbdkit.PbdkitWarning, match="has no seal"):
        dataset = pbdkit.open(bare)
    with dataset, opened_unsealed(bare) as plain:
        xarray.testing.assert_identical(dataset.load(), plain.load())


def test_child_process_imports_this_pbdkit_from_any_directory(bare):
    """Python was started beside the package, and the folder was changed."""
    code = "import os, sys, pbdkit; os.chdir('/'); pbdkit.open(sys.argv[1]).close()"
    done = subprocess.run(
        [sys.executable, "-c", code, bare],
        cwd=Path(pbdkit.__file__).parents[1],
        env={k: v for k, v in os.environ.items() if k != "PYTHONPATH"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "has no seal" in done.stderr


def test_declared_size_beyond_the_file_is_refused(bare, tmp_path):
    """A length that was changed has libraries fill memory with what is not there."""
    import h5py

    large = shutil.copy(bare, tmp_path / "large.nc")
    with h5py.File(large, "r+") as file:
        file.create_dataset("more", (2**40,), "f8", chunks=(2**16,))
    with pytest.raises(pbdkit.StorageError, match=r"its size is too small for the 8\.8e\+12 bytes"):
        pbdkit.open(large)


def test_a_large_file_is_read_in_pieces(tmp_path):
    """The child process takes memory for a piece, and not for the whole file."""
    import numpy as np

    path, values = tmp_path / "large.nc", np.zeros((300, 2**17))
    xarray.Dataset({"x": (("t", "n"), values)}).to_netcdf(path)
    code = (
        "import sys; from pathlib import Path; from pbdkit import untrusted_files\n"
        "untrusted_files._read(Path(sys.argv[1])); from pbdkit.simulation import peak_memory\n"
        "print(peak_memory())"
    )
    done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True)
    assert path.stat().st_size > values.nbytes
    assert int(done.stdout) < 0.9 * values.nbytes


@pytest.mark.skipif(sys.platform != "linux", reason="memory is measured as on Linux")
def test_fuzzed_experiments_end_cleanly():
    """Ten times the bounds: imports are in them, and others may be at work."""
    found = fuzz_experiments.fuzz(6, seed=0, workers=1, quick=True)
    assert len(found) == 6
    assert [(n, f) for n, o in found for f in fuzz_experiments.faults(o, slack=10.0)] == []


def test_mutated_results_never_differ_silently(folder):
    found = mutate_results.mutate(6, seed=0, folder=folder, workers=1)
    assert len(found) == 6
    assert [(n, fault) for n, o in found for fault in mutate_results.faults(o, slack=5.0)] == []
