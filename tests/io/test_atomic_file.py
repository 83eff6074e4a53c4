"""Whatever a command writes appears whole or not at all, and the earlier file stands until then."""

from __future__ import annotations

import errno
import io
import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import pbdkit
from pbdkit.io import atomic_file
from pbdkit.io.atomic_file import NewFile, open_atomic, write, write_folder, write_together
from pbdkit.io.paged_file import PagedFile
from pbdkit.io.seal import SealedFile
from pbdkit.sweeps import store
from tests.conftest import Call

SCRIPT = Path(__file__).parents[1] / "reliability" / "disk_faults.py"


class Short(io.FileIO):
    """Takes half of what it is given, as POSIX allows."""

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        return super().write(view[: (len(view) + 1) // 2])


class Full(io.FileIO):
    """A disk that is full once it holds some bytes."""

    room = 3000

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        place = self.tell()
        if place >= self.room and view:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return super().write(view[: self.room - place])


def left() -> list[str]:
    """The hidden files of the current folder, which are temporaries."""
    return [path.name for path in Path.cwd().rglob(".*")]


def sealed(path: Path) -> bool:
    with SealedFile(path) as file:
        file.check()
        return file.seal is not None


SWEEP = {"experiment": "e.json", "vary": {"solver.relaxation": [0.5, 1.0]}}


@pytest.fixture
def result(call: Call) -> Call:
    """In the folder are the result in.nc and the sweep s.json."""
    assert call("run", "e.json", "-o", "in.nc").code == 0
    Path("s.json").write_text(json.dumps(SWEEP))
    return call


def test_seal_written_in_pieces_is_complete(result: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(io, "FileIO", Short)
    assert result("run", "e.json", "-o", "out.nc").code == 0
    assert result("sweep", "s.json", "-o", "s", "--workers", "1").code == 0
    assert sealed(Path("out.nc"))
    assert sealed(Path("s/sweep.nc"))


def test_result_read_back_differently_from_disk_gets_no_name(
    call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run of less than a second has no store, and is read back nevertheless."""
    settle = os.fsync

    def spoil(descriptor: int) -> None:
        settle(descriptor)
        if os.fstat(descriptor).st_size > 1000:
            os.pwrite(descriptor, b"\xff\x00\xff", 700)

    monkeypatch.setattr(os, "fsync", spoil)
    found = call("run", "e.json", "-o", "out.nc")
    assert (found.code, Path("out.nc").exists(), left()) == (6, False, [])
    assert "that the disk returns differ from those written" in found.err


WRITING = {
    "export": ["export", "in.nc", "-o", "out.vtkhdf"],
    "animate": ["animate", "in.nc", "-o", "out.gif", "--size", "2", "2", "--dpi", "60"],
    "plot": ["plot", "in.nc", "-o", "out.png"],
    "plot svg": ["plot", "in.nc", "-o", "out.svg"],
    "report": ["report", "in.nc", "-o", "out.html"],
    "run": ["run", "e.json", "-o", "out.nc"],
}


@pytest.mark.parametrize("name", WRITING)
def test_full_disk_leaves_the_earlier_file_and_is_named(
    result: Call, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    words = WRITING[name]
    output = Path(words[3])
    output.write_text("earlier")
    with monkeypatch.context() as patch:
        patch.setattr(io, "FileIO", Full)
        found = result(*words, "--force")
    assert (found.code, output.read_text(), left()) == (6, "earlier", [])
    assert found.err.startswith(f"pbdkit: {output}: cannot be written: ")
    assert "damaged" not in found.err


@pytest.mark.parametrize("name", ["export", "animate"])
def test_short_writes_give_the_same_file(
    result: Call, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    words = WRITING[name]
    assert result(*words).code == 0
    whole = Path(words[3]).read_bytes()
    monkeypatch.setattr(io, "FileIO", Short)
    assert result(*words, "--force").code == 0
    assert Path(words[3]).read_bytes() == whole


def test_a_sweep_on_a_full_disk_keeps_its_earlier_dataset(
    result: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep = ["sweep", "s.json", "-o", "s", "--workers", "1"]
    assert result(*sweep).code == 0
    earlier = Path("s/sweep.nc").read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(io, "FileIO", Full)
        found = result(*sweep)
    assert (found.code, left()) == (6, [])
    full = "No space left on device; free some space, and repeat the command"
    assert found.err == f"pbdkit: s/sweep.nc: cannot be written: {full}\n"
    assert Path("s/sweep.nc").read_bytes() == earlier


def test_write_errors_are_hidden_from_hdf5(tmp_path: Path) -> None:
    """It would try again as the process ends, and crash it."""
    disk = Full(tmp_path / "x", "x+b")
    file = NewFile(disk)
    with h5py.File(file, "w") as content:
        for n in range(50):
            content[f"variable{n}"] = np.arange(1000.0)
    with pytest.raises(OSError, match="No space left"):
        file.finalize()
    disk.close()


def test_unrelated_error_in_the_block_is_raised_unchanged(
    tmp_path: Path,
) -> None:
    path = tmp_path / "x"
    path.write_text("earlier")
    for kind in (NewFile, PagedFile):
        with pytest.raises(KeyError), open_atomic(path, kind, replace=True):
            raise KeyError("mine")
        with pytest.raises(KeyboardInterrupt), open_atomic(path, kind, replace=True):
            raise KeyboardInterrupt
    assert path.read_text() == "earlier"
    assert [p.name for p in tmp_path.iterdir()] == ["x"]


def test_permissions_of_the_earlier_file_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_text("earlier")
    path.chmod(0o600)
    write(path, "new", replace=True)
    assert (path.read_text(), path.stat().st_mode & 0o777) == ("new", 0o600)


def test_links_and_pipes_are_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    link, pipe = tmp_path / "link", tmp_path / "pipe"
    link.symlink_to("mine")
    os.mkfifo(pipe)
    for path, kind in ((link, "a symbolic link"), (pipe, "a pipe")):
        with pytest.raises(pbdkit.StorageError, match=f"is {kind}, which is not replaced"):
            write(path, "new", replace=True)
    assert (tmp_path / "mine").read_text() == "mine"


def test_the_figures_of_bench_replace_no_link(call: Call) -> None:
    """Refused before anything is measured."""
    Path("link.json").symlink_to("e.json")
    found = call("bench", "e.json", "--json", "link.json")
    assert (found.code, "is a symbolic link, which is not replaced" in found.err) == (2, True)


def test_related_files_appear_together_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(io, "FileIO", Full)
    texts = {"a": "a", "b/c": "x" * 9000, "b/d": "d"}
    with pytest.raises(pbdkit.StorageError, match="folder: cannot be written: No space"):
        write_folder(tmp_path / "folder", texts)
    with pytest.raises(pbdkit.StorageError, match="c: cannot be written: No space"):
        write_together({tmp_path / "a": "a", tmp_path / "c": "x" * 9000})
    assert [*tmp_path.iterdir()] == []
    monkeypatch.setattr(Full, "room", 10**6)
    write_folder(tmp_path / "folder", texts)
    assert {n: (tmp_path / "folder" / n).read_text() for n in texts} == texts
    with pytest.raises(pbdkit.StorageError, match="File exists"):
        write_folder(tmp_path / "folder", texts)


@pytest.mark.parametrize("letter", ["a", "名"])
def test_names_may_have_the_maximum_length_of_the_system(call: Call, letter: str) -> None:
    most = 243 - len(".nc")  # a run has files with names that are 12 bytes longer
    name = letter * (most // len(letter.encode())) + ".nc"
    assert call("run", "e.json", "-o", name).code == 0
    assert call("plot", name).code == 0
    assert left() == []


@pytest.mark.parametrize("length", [244, 250, 251, 255, 256])
def test_too_long_a_name_is_named(call: Call, length: int) -> None:
    name = "a" * (length - 3) + ".nc"
    for words in (["run", "e.json", "-o", name], ["resume", name]):
        found = call(*words)
        assert (found.code, "File name too long" in found.err) == (6, True), found
        assert "bug" not in found.err


PROGRAM = [sys.executable, "-m", "pbdkit"]
OTHER_LOCALE = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


def test_utf_8_name_is_the_same_in_any_locale(call: Call) -> None:
    command = [*PROGRAM, "run", "e.json", "-o", "ü.nc"]
    done = subprocess.run(command, env=os.environ | OTHER_LOCALE, capture_output=True, check=False)
    assert (done.returncode, done.stderr, Path("ü.nc").exists()) == (0, b"", True)


def test_too_few_descriptors_for_the_workers_are_named(result: Call) -> None:
    def few() -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (22, 22))

    Path("s.json").write_text(json.dumps(SWEEP | {"replicates": 3}))

    command = [*PROGRAM, "sweep", "s.json", "-o", "s", "--workers", "2"]
    done = subprocess.run(command, capture_output=True, text=True, preexec_fn=few, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (6, 1), done.stderr
    assert "Too many open files; raise the limit (`ulimit -n`)" in done.stderr


def test_failing_standard_output_is_named_and_no_bug(result: Call) -> None:
    listing, told = ["experiments"], "pbdkit: standard output: {}\n"
    full = "No space left on device; free some space, and repeat the command"
    runs = ["run", "e.json", "-o", "out.nc", "--force"]
    cases = {
        ">/dev/full": (listing, 6, told.format(full)),
        ">&-": (listing, 6, told.format("is closed")),
        " >/dev/full": (runs, 6, told.format(full)),
        "2>/dev/full": (["explain", "none.nc"], 6, ""),
        "2>&- >&- <&-": (["explain", "none.nc"], 6, ""),
        " 2>&- <&-": (["explain", "in.nc"], 2, ""),
    }
    for redirection, (words, code, err) in cases.items():
        line = f"exec {' '.join([*PROGRAM, *words])} {redirection}"
        done = subprocess.run(["sh", "-c", line], capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (code, err), redirection
    assert sealed(Path("out.nc"))


def test_a_database_with_a_journal_is_created_again(result: Call) -> None:
    """The sweep was killed, or the disk failed, while the database was created."""
    Path("s").mkdir()
    for suffix in ("", "-journal"):
        Path(f"s/sweep.sqlite.new{suffix}").write_bytes(b"incomplete")
    assert result("sweep", "s.json", "-o", "s", "--workers", "1").code == 0
    assert sorted(p.name for p in Path("s").iterdir()) == ["lock", "sweep.nc", "sweep.sqlite"]


def test_a_folder_that_cannot_be_created_was_not_moved(
    result: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **more: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "mkdir", full)
    found = result("sweep", "s.json", "-o", "s", "--workers", "1")
    assert found.err.startswith("pbdkit: s: No space left on device; ")


def test_new_folders_of_a_sweep_outlast_a_power_cut(
    result: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced = set[Path]()
    for module in (atomic_file, store):
        monkeypatch.setattr(module, "sync_folder", lambda folder: synced.add(folder.absolute()))
    monkeypatch.setattr(store, "LARGE_BYTES", 0)
    assert result("sweep", "s.json", "-o", "of/s", "--workers", "1").code == 0
    here = Path.cwd()
    assert synced >= {here, here / "of", here / "of" / "s", here / "of" / "s" / "members"}


def failing_sync(fault: int) -> Callable[[int], None]:
    """Return a function in place of os.fsync that fails for the current folder."""
    settle = os.fsync

    def sync(descriptor: int) -> None:
        if os.path.samestat(os.fstat(descriptor), Path.cwd().stat()):
            raise OSError(fault, os.strerror(fault))
        settle(descriptor)

    return sync


UNSYNCED = {name: WRITING[name] for name in ("run", "plot svg")} | {
    "init": ["init", "out.yaml"],
    "plugins new": ["plugins", "new", "pbdkit-mine"],
}


@pytest.mark.parametrize("name", UNSYNCED)
def test_output_in_a_folder_that_cannot_be_synced_is_complete_and_named(
    result: Call, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    output = Path(UNSYNCED[name][-1])
    monkeypatch.setattr(os, "fsync", failing_sync(errno.EIO))
    found = result(*UNSYNCED[name])
    assert (found.code, output.exists(), list(Path().glob(".*"))) == (6, True, [])
    assert found.err.startswith(f"pbdkit: {output}: is complete, but its name may be lost")
    assert "Input/output error" in found.err
    output.rename("first")
    monkeypatch.setattr(os, "fsync", failing_sync(errno.EINVAL))  # for instance on a network
    assert (result(*UNSYNCED[name]).code, output.exists()) == (0, True)


def test_sweep_in_a_folder_that_cannot_be_synced_ends(
    result: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["sweep", "s.json", "-o", "s", "--workers", "1"]
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", failing_sync(errno.EIO))
        found = result(*words)
    assert found.code == 6
    assert found.err.startswith("pbdkit: s: Input/output error; the disk failed")
    assert result(*words).code == 0


def test_picture_that_cannot_be_encoded_blames_no_file_that_is_read(
    result: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pillow raises this error if memory is exhausted."""

    def exhausted(*_: Any, **more: Any) -> None:
        raise OSError("codec configuration error")

    monkeypatch.setattr("PIL.Image.Image.save", exhausted)
    for words in (["plot", "in.nc", "-o", "o.png"], ["animate", "in.nc", "-o", "o.gif"]):
        found = result(*words)
        assert (found.code, left()) == (6, [])
        assert f"{words[-1]}: cannot be written: codec configuration error; " in found.err


def test_sample_of_disk_faults() -> None:
    """The script tries each call of each command; tests/reliability/disk_faults.py."""
    some = ["--command", "run,init --from", "--kind", "eio,kill,torn,block"]
    some += ["--first", "5", "--every", "50"]
    done = subprocess.run(
        [sys.executable, str(SCRIPT), *some], capture_output=True, text=True, check=False
    )
    if done.returncode == 77:
        pytest.skip(done.stdout.strip())
    assert done.returncode == 0, done.stdout + done.stderr
    assert "\n0 of 0 held" not in done.stdout
