"""Runs are killed, raced, stopped, starved and mended: a short sample of the long trials, which are
scripts in tests/reliability, and faults that are injected one by one."""

from __future__ import annotations

import errno
import io
import json
import os
import random
import signal
import stat
import sys
import tempfile
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scene_strategies import experiments, pulled_apart, samples

import pbdkit
from pbdkit.io import netcdf as netcdf_sink, run_store as run_store, sqlite_file
from pbdkit.io.atomic_file import is_local
from pbdkit.io.netcdf import NetcdfSink
from pbdkit.io.run_store import RunStore, UnfinishedRun, status_of, store_of
from pbdkit.io.sinks import OverlappingSink

FOLDER = Path(__file__).parents[1] / "reliability"
sys.path.append(str(FOLDER))
OUT = Path("out.nc")


@pytest.mark.parametrize(
    "trial",
    [
        "kill_runs --trials 1 --kinds settling",
        "two_writers --trials 1 --kinds small",
        "mutate_stores --trials 1 --kinds breaking",
        "mutate_sweeps --trials 1",
        "equilibria fracture --trials 3",
        "equilibria bounds --trials 5",
        "fit_coverage --trials 5 --processes 1 --kinds poisson",
    ],
)
def test_a_sample_of_the_long_trials(
    trial: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The processes that the scripts fork from this one find all modules loaded."""
    monkeypatch.setattr(sys, "argv", [*trial.split(), "--seed", "1"])
    monkeypatch.chdir(Path.cwd())
    try:
        status = import_module(sys.argv[0]).main()
    except SystemExit as ended:
        status = ended.code
    if status == 77:
        pytest.skip("needs a C compiler")
    assert status in (0, False), capsys.readouterr().out


@samples(6)
@given(experiments(leaders=pulled_apart()), st.integers(0, 10**6))
def test_stopped_and_resumed_runs_are_the_same(parts: dict[str, Any], seed: int) -> None:
    from stopping import NUMPY, resumed_otherwise

    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(netcdf_sink, "EVERY_S", 0.0)
        patch.setattr(netcdf_sink, "SHARE", 0)
        patch.setitem(NetcdfSink.__init__.__kwdefaults__, "first_s", 0.0)
        try:
            found, _ = resumed_otherwise(parts, Path(folder), random.Random(seed), engines=[NUMPY])
        except pbdkit.ExperimentError:  # no scene
            return
    assert found == []


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every state is kept."""
    monkeypatch.setattr(netcdf_sink, "EVERY_S", 0.0)
    monkeypatch.setattr(netcdf_sink, "SHARE", 0)
    monkeypatch.setattr(OverlappingSink, "due", lambda self: True)
    monkeypatch.setitem(NetcdfSink.__init__.__kwdefaults__, "first_s", 0.0)


def before_keeping(patch: pytest.MonkeyPatch, number: int, act: Any) -> None:
    """Does something before the run is kept for that time."""
    keep, left = UnfinishedRun.keep, [number]

    def keeping(*args: Any) -> None:
        left[0] -= 1
        if left[0] == 0:
            act()
        keep(*args)

    patch.setattr(UnfinishedRun, "keep", keeping)


def whole(call: Any) -> Any:
    """The positions of the run of e.json in one go."""
    assert call("run", "e.json", "-o", "whole.nc").code == 0
    return pbdkit.open("whole.nc")["position"].values


def is_whole(right: Any, *left: str) -> bool:
    """Return whether the output is complete, and nothing else is in the folder, apart from `left`,
    which must be there."""
    with pbdkit.open(OUT) as dataset:
        same = np.array_equal(dataset["position"].values, right)
    return same and names() == {"e.json", "whole.nc", "out.nc", *left}


@pytest.mark.parametrize(
    ("name", "code"), [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129), ("SIGUSR1", 138)]
)
def test_run_ended_by_a_signal_can_be_resumed(
    call: Any, often: None, monkeypatch: pytest.MonkeyPatch, name: str, code: int
) -> None:
    right, number = whole(call), getattr(signal, name)
    inherited = signal.getsignal(number)
    if inherited is signal.SIG_IGN:  # as under nohup, where the program ignores it, too
        signal.signal(number, signal.SIG_DFL)
    try:
        with monkeypatch.context() as patch:
            before_keeping(patch, 3, lambda: os.kill(os.getpid(), number))
            found = call("run", "e.json", "-o", str(OUT))
    finally:
        signal.signal(number, inherited)
    assert found.code == code
    assert "pbdkit resume out.nc" in found.err
    assert call("resume", str(OUT)).code == 0
    assert is_whole(right)


FAILING = {
    "a large write": "disk",
    "a commit": "commit",
    "a new name": "link",
    "the sync": "fsync",
}


@pytest.mark.parametrize("what", FAILING)
def test_full_disk_is_named_and_the_run_can_be_resumed(
    call: Any, often: None, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """At the fourth commit, or what comes after it; tests/reliability/full_disk.py fills a real
    one at each write."""
    right = whole(call)

    def full(*args: Any, **more: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:

        def fill() -> None:
            if FAILING[what] == "disk":
                patch.setattr(netcdf_sink.PagedFile, "finalize", full)
            elif FAILING[what] == "commit":
                patch.setattr(RunStore, "commit", full)
            elif FAILING[what] == "link":
                patch.setattr(os, "link", full)
                patch.setattr(Path, "rename", full)
            else:
                patch.setattr(os, "fsync", full)

        before_keeping(patch, 4, fill)
        found = call("run", "e.json", "-o", str(OUT))
    assert found.code == 6
    assert "the disk is full" in found.err
    assert "pbdkit resume out.nc" in found.err
    assert call("resume", str(OUT)).code == 0
    assert is_whole(right)


def test_read_only_directory_is_refused_before_the_first_step(
    call: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    class ReadOnly(io.FileIO):
        def __init__(self, file: Any, mode: str = "r") -> None:
            if "x" in mode:
                raise OSError(errno.EROFS, os.strerror(errno.EROFS))
            super().__init__(file, mode)

    monkeypatch.setattr(io, "FileIO", ReadOnly)
    found = call("run", "e.json", "-o", str(OUT))
    assert (found.code, "Read-only file system" in found.err) == (6, True)
    assert names() == {"e.json"}


def names() -> set[str]:
    """Return the names of the files in the current folder."""
    return {path.name for path in Path.cwd().iterdir()}


class FailingError(Exception):
    """An error that a plugin may raise."""


def stopped(call: Any, patch: pytest.MonkeyPatch) -> None:
    """An unfinished run of e.json."""

    def fail() -> None:
        raise FailingError("at last")

    with patch.context() as inner:
        before_keeping(inner, 5, fail)
        assert call("run", "e.json", "-o", str(OUT)).code == 1


def test_any_exception_in_a_run_keeps_the_records(
    call: Any, often: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = whole(call)
    stopped(call, monkeypatch)
    assert call("status", str(OUT)).code == 0
    assert call("resume", str(OUT)).code == 0
    assert is_whole(right)


def test_clock_changes_affect_no_timing(
    call: Any, often: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    stopped(call, monkeypatch)
    monkeypatch.setattr(time, "time", lambda: 0.0)
    found = status_of(OUT)
    assert found is not None
    assert found["age_s"] == 0.0
    assert found["left_s"] is None or 0.0 <= found["left_s"] < 100.0


def put(key: str, data: bytes) -> None:
    """Something else in the store, as if it had been written so."""
    with RunStore(store_of(OUT), mode="rw") as store:
        store.commit([(key, data)])


def test_piece_that_was_deleted_can_be_stored_again(tmp_path: Path) -> None:
    """Batches of equal values are committed, written to the file, and filled again."""
    piece = ("array/waiting.broken/0", b"zeros")
    with RunStore(tmp_path / "out.nc.run", mode="rwc") as store:
        store.commit([piece])
        store.commit([], [piece[0]])
        store.commit([piece])
    with RunStore(tmp_path / "out.nc.run") as store:
        assert store.piece(piece[0]) == piece[1]


def test_a_newer_store_is_refused_with_its_version(
    call: Any, often: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    stopped(call, monkeypatch)
    with RunStore(store_of(OUT)) as store:
        about = store.facts("about")
    put("about", json.dumps(about | {"format": "4"}).encode())
    for command in ("resume", "status", "plot"):
        found = call(command, str(OUT))
        assert (found.code, "has the format 4" in found.err) == (6, True), found


def test_incomplete_store_of_a_killed_process_is_ignored(call: Any) -> None:
    Path("out.nc.run").touch()
    Path("out.nc.run-records").touch()
    assert call("status", str(OUT)).code == 2
    assert call("run", "e.json", "-o", str(OUT)).code == 0
    assert names() == {"e.json", "out.nc"}


KEPT = "out.nc.run", "out.nc.run-records", "out.nc.run-wal"


def killed(call: Any, patch: pytest.MonkeyPatch, *more: str, number: int = 6) -> dict[str, bytes]:
    """Return the files that a run of e.json leaves if it is killed at this commit; nothing else is
    left."""
    found: dict[str, bytes] = {}
    with patch.context() as inner:
        copying = lambda: found.update({name: Path(name).read_bytes() for name in KEPT})  # noqa: E731
        before_keeping(inner, number, copying)
        assert call("run", "e.json", "-o", str(OUT), *more).code == 0
    OUT.unlink()
    return found


def lay(files: dict[str, bytes]) -> None:
    """These files, and no others of the run."""
    for path in Path.cwd().glob("out.nc*"):
        path.unlink()
    for name, data in files.items():
        Path(name).write_bytes(data)


def kept() -> dict[str, bytes]:
    """Return the files of the run, except those that SQLite creates for reading."""
    found = {path.name: path.read_bytes() for path in Path.cwd().glob("out.nc*")}
    return {name: data for name, data in found.items() if data and not name.endswith("-shm")}


def flipped(data: bytes, at: int) -> bytes:
    """With one bit changed."""
    return data[:at] + bytes([data[at] ^ 4]) + data[at + 1 :]


def test_damaged_log_of_a_store_is_named_and_the_rest_is_kept(
    call: Any, often: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bit of its head, or of its first frame, or all of it: what the log held is lost, and known
    to be."""
    right, files = whole(call), killed(call, monkeypatch)
    log = files["out.nc.run-wal"]
    for damage in (flipped(log, 17), flipped(log, 2000), None):
        damaged = {**files, "out.nc.run-wal": damage} if damage else dict(files)
        if damage is None:
            del damaged["out.nc.run-wal"]
        lay(damaged)
        for command in ("status", "resume", "plot", "run e.json -o"):
            found = call(*command.split(), str(OUT))
            assert found.code == (2 if command.startswith("run") else 6), (command, found)
            assert kept() == damaged, command
        assert "--anyway continues from the last commit" in call("status", str(OUT)).err
        assert call("resume", str(OUT), "--anyway").code == 0
        assert is_whole(right)
    lay(files)
    assert call("resume", str(OUT)).code == 0
    assert is_whole(right)


def test_missing_part_of_a_store_is_named_and_the_rest_is_kept(
    call: Any, often: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    right, files = whole(call), killed(call, monkeypatch)
    records = files["out.nc.run-records"]
    for changed in (
        {"out.nc.run": None},
        {"out.nc.run": b""},
        {"out.nc.run": files["out.nc.run"][:100]},
        {"out.nc.run-records": None},
        {"out.nc.run-records": bytes(len(records))},
        {"out.nc.run-records": flipped(records, 30)},
    ):
        damaged = {name: data for name, data in (files | changed).items() if data is not None}
        lay(damaged)
        for command in ("status", "resume", "run e.json -o"):
            found = call(*command.split(), str(OUT))
            assert (found.code in (2, 6), "no unfinished run" in found.err) == (True, False), found
            assert "damaged" in found.err or "unfinished" in found.err
            assert kept() == {name: data for name, data in damaged.items() if data}, command
        assert call("resume", str(OUT)).code == 6
    lay(files)
    assert call("resume", str(OUT)).code == 0
    assert is_whole(right)
    lay({"out.nc.run": b"", "out.nc.run-records": records})
    assert call("run", "e.json", "-o", str(OUT), "--force").code == 0
    assert is_whole(right)


def test_store_combined_from_two_is_named(
    call: Any, often: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From another run of the same experiment, and from the same run before. Where the log holds
    all that is in the main file, that is not needed."""
    right, files = whole(call), killed(call, monkeypatch)
    other = killed(call, monkeypatch)
    for name in KEPT:
        damaged = {**files, name: other[name]}
        lay(damaged)
        for command in ("status", "resume"):
            found = call(command, str(OUT))
            if found.code == 0 and name == "out.nc.run":
                assert command == "status" or is_whole(right)
                continue
            assert (found.code, "damaged" in found.err) == (6, True), (name, found)
            assert kept() == damaged
    lay(files)
    with monkeypatch.context() as patch:
        patch.setattr(UnfinishedRun, "keep", stopping(UnfinishedRun.keep, 3))
        assert call("resume", str(OUT)).code == 1
    now = kept()
    assert now.keys() == {"out.nc.run", "out.nc.run-records"}
    lay({**now, "out.nc.run": files["out.nc.run"]})
    header = run_store.header_of(Path("out.nc.run-records"))
    assert header is not None
    assert header.commits > 4
    found = call("resume", str(OUT))
    assert (found.code, f"of {header.commits} commits" in found.err) == (6, True), found
    lay(now)
    assert call("resume", str(OUT)).code == 0
    assert is_whole(right)


def stopping(keep: Any, number: int) -> Any:
    """Keep a number of times, and fail then."""
    left = [number]

    def keeping(*args: Any) -> None:
        keep(*args)
        left[0] -= 1
        if left[0] == 0:
            raise FailingError("at last")

    return keeping


@pytest.mark.parametrize("cut", [0, 100, 4096])
def test_incomplete_store_blocks_no_run(call: Any, cut: int) -> None:
    """The disk was full, or the power failed, while it was written."""
    with RunStore(store_of(OUT), mode="rwc"):
        data = store_of(OUT).read_bytes()
    lay({"out.nc.run": data[:cut], "out.nc.run-records": b""})
    before = kept()
    for command in ("status", "resume"):
        assert call(command, str(OUT)).code == 2
        assert kept() == before
    assert call("run", "e.json", "-o", str(OUT)).code == 0
    assert names() == {"e.json", "out.nc"}


def test_a_journal_that_names_another_file_is_refused(
    call: Any, often: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SQLite would roll it back and remove the file."""
    stopped(call, monkeypatch)
    Path("precious").touch()
    mark, name = run_store.JOURNAL_MARK, str(Path("precious").absolute()).encode()
    end = b"".join(n.to_bytes(4, "big") for n in (len(name), sum(name)))
    header = (mark + bytes(12) + (512).to_bytes(4, "big") + (4096).to_bytes(4, "big")).ljust(512)
    Path("out.nc.run-journal").write_bytes(header + bytes(4) + name + end + mark)
    for command in ("resume", "status"):
        found = call(command, str(OUT))
        assert (found.code, "refers to another file" in found.err) == (6, True), found
    assert Path("precious").exists()


def test_store_is_read_as_of_its_last_commit_after_a_kill_within_a_transaction(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The journal, from which SQLite restores the last commit, remains beside the database."""
    path = tmp_path / "killed" / "out.nc.run"
    path.parent.mkdir()
    monkeypatch.setattr(run_store, "journal_mode", lambda path: "TRUNCATE")
    with RunStore(tmp_path / path.name, mode="rwc") as store:
        store.commit([("a", b"1" * 9000)])
        store._file.execute("PRAGMA cache_size = 1")
        store._file.execute("BEGIN IMMEDIATE")
        store._file.execute("UPDATE pieces SET data = ? WHERE key = 'a'", (b"2" * 90_000,))
        for file in sqlite_file.files_of(tmp_path / path.name):
            if file.exists():
                (path.parent / file.name).write_bytes(file.read_bytes())
    before = {file.name: file.read_bytes() for file in path.parent.iterdir()}
    assert before.keys() == {"out.nc.run", "out.nc.run-journal"}
    for mode in ("ro", "rw"):
        with RunStore(path, mode=mode) as store:
            assert store.piece("a") == b"1" * 9000
        assert ({f.name: f.read_bytes() for f in path.parent.iterdir()} == before) == (mode == "ro")


def test_store_on_a_network_uses_a_journal_without_shared_memory(
    call: Any, often: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    mounts = tmp_path / "mountinfo"
    mounts.write_text("1 0 0:1 / / rw - ext4 /dev/sda rw\n2 1 0:2 / /net rw - nfs4 host:/ rw\n")
    assert is_local(Path("/home/a.nc"), str(mounts))
    assert not is_local(Path("/net/a.nc"), str(mounts))
    mounts.write_text("1 0 0:1 / / rw - nfs4 host:/ rw\n")
    monkeypatch.setattr(sqlite_file, "is_local", lambda path: is_local(path, str(mounts)))
    right = whole(call)
    stopped(call, monkeypatch)
    assert names() >= {"out.nc.run", "out.nc.run-records"}
    assert not Path("out.nc.run-wal").exists()
    assert call("resume", str(OUT)).code == 0
    assert is_whole(right)


def test_store_is_kept_if_the_name_of_the_result_cannot_be_synced(
    call: Any, often: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    right, settle, unsynced = whole(call), os.fsync, list[str]()
    stopped(call, monkeypatch)

    def sync(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            unsynced.append("folder")
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        settle(descriptor)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", sync)
        found = call("resume", str(OUT))
    assert (found.code, unsynced) == (6, ["folder"])
    assert "out.nc: is complete, but its name may be lost in a power cut" in found.err
    assert is_whole(right, "out.nc.run")
    assert call("resume", str(OUT)).code == 2  # All steps are made.
    assert is_whole(right)


def test_removal_of_the_store_outlasts_a_power_cut(
    call: Any, often: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    settle, synced = os.fsync, [set[str]()]

    def sync(descriptor: int) -> None:
        settle(descriptor)
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            synced.append({path.name for path in Path.cwd().iterdir()})

    stopped(call, monkeypatch)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", sync)
        assert call("resume", str(OUT)).code == 0
    assert synced[-1] == {"e.json", "out.nc"}


@pytest.mark.parametrize("name", ["out.nc.run", "out.nc.run-records"])
def test_file_of_a_finished_run_that_cannot_be_removed_is_named(
    call: Any, often: None, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    right, unlink, failures = whole(call), Path.unlink, [1 if name == "out.nc.run" else 2]
    stopped(call, monkeypatch)

    def fail(path: Path, missing_ok: bool = False) -> None:
        if path.name == name and failures[0]:
            failures[0] -= 1
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        unlink(path, missing_ok)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", fail)
        found = call("resume", str(OUT))
    assert found.code == 0
    assert f"warning: {name}: cannot be removed; out.nc is complete without it" in found.err
    assert is_whole(right, name)
    assert call("run", "e.json", "-o", str(OUT), "--force", "--quiet").code == 0
    assert is_whole(right)


def test_named_result_of_a_killed_process_is_finished(
    call: Any, often: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = whole(call)
    with monkeypatch.context() as patch:
        patch.setattr(UnfinishedRun, "remove", lambda self: self.close())
        assert call("run", "e.json", "-o", str(OUT)).code == 0
    assert store_of(OUT).exists()
    assert "is finished" in call("status", str(OUT)).err
    assert "is finished" in call("resume", str(OUT)).err
    assert is_whole(right)
