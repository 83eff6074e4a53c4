"""Sweeps: the numbers do not depend on the worker, each member is run once, and no member stops
another."""

import json
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
import warnings
from asyncio import CancelledError
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import xarray
from reliability.sweep_under_fire import under_fire

import pbdkit
from pbdkit.cli.sweep import report_end
from pbdkit.io import sqlite_file
from pbdkit.model.reading import Source
from pbdkit.progress import Stop
from pbdkit.sweeps import store as stores
from pbdkit.sweeps.execute import (
    ClusterExecutor,
    ProcessExecutor,
    SerialExecutor,
    Summary,
    carry_out,
)
from pbdkit.sweeps.specification import Job, Member, SweepPlan, checked, replicate_seeds

VARY = {"solver.relaxation": [0.5, 1.0], "body.columns": [4, 5]}


@pytest.fixture
def small(tensile):
    """The tensile experiment with noise at the start, so that seeds matter."""
    noise = {"type": "noise", "amplitude": 0.1}
    return tensile | {"diagnostics": [{"type": "pe1"}], "initial": noise}


@pytest.fixture
def run_only(monkeypatch):
    """The keys of the members that are run, in this process or by workers."""
    seen = []
    for executor in (SerialExecutor, ProcessExecutor):
        original = executor.work

        def work(self, jobs, stopping, original=original):
            for report in original(self, jobs, stopping):
                seen.extend([report.key] if report else [])
                yield report

        monkeypatch.setattr(executor, "work", work)
    return seen


def swept(experiment, **more):
    return pbdkit.sweep(experiment, progress=False, **({"workers": 1} | more))


def same(one, other):
    """Assert equality bit for bit, NaN too, except the time of day."""
    xarray.testing.assert_identical(*(ds.drop_attrs(deep=False) for ds in (one, other)))
    for name in one.variables:
        if one[name].dtype.kind == "f":
            assert one[name].values.tobytes() == other[name].values.tobytes()


def test_serial_processes_and_dask_agree_bitwise(small):
    from distributed import Client

    asked = {"vary": VARY, "replicates": 2}
    serial = swept(small, **asked)
    same(serial, swept(small, **asked, workers=2))
    with Client(
        processes=False, n_workers=1, threads_per_worker=2, dashboard_address=None
    ) as client:
        same(serial, pbdkit.sweep(small, **asked, client=client, progress=False))


def test_members_equal_the_runs_of_their_experiments(small):
    found = swept(small, vary=VARY)
    assert found.position.dims == ("relaxation", "columns", "time", "particle", "axis")
    for w in (0.5, 1.0):
        for n in (4, 5):
            small["solver"] = {"type": "stepping", "relaxation": w}
            small["body"]["columns"] = n
            alone = pbdkit.run(small, progress=False)
            member = found.sel(relaxation=w, columns=n)
            count = alone.sizes["particle"]
            for name in ("position", "pe1", "kind", "reference"):
                np.testing.assert_array_equal(member[name].isel(particle=slice(count)), alone[name])
                beyond = member[name].isel(particle=slice(count, None)).values
                missing = member[name].attrs.get("fill_value", np.nan)
                np.testing.assert_array_equal(beyond, np.full_like(beyond, missing))


def test_members_are_joined_by_time(small):
    found = swept(small, together={"steps": [6, 8], "record": [{"every": 3}, {"every": 4}]})
    assert found.time.values.tolist() == [0, 3, 4, 6, 8]
    assert found.steps.dims == ("case",)
    has = found.position.notnull().any(["particle", "axis"]).values
    assert has.tolist() == [[True, True, False, True, False], [True, False, True, False, True]]


def test_dimensions_and_their_names(small):
    asked = {
        "vary": {"leaders.0.until": [3], "leaders.1.until": [4],
                 "rule": [{"type": "barycentre"}, {"type": "mean-displacement"}],
                 "initial.amplitude": {"from": 0.1, "to": 0.3, "count": 3}},
        "together": {"solver.memory": [0.0, 0.1], "solver.engine": ["numpy", "auto"]},
        "replicates": 2, "keep": {"variables": ["pe1"], "times": "last"},
    }  # fmt: skip
    found = swept(small, **asked)
    dims = ("leaders_0_until", "leaders_1_until", "rule", "amplitude", "case", "replicate")
    assert found.pe1.dims == (*dims, "time", "particle")
    assert found.status.dims == dims
    assert {*found.data_vars} == {"pe1", "status", "message"}
    assert found.rule.values.tolist() == [0, 1]
    assert found.rule_text.values.tolist() == [json.dumps(value) for value in asked["vary"]["rule"]]
    assert found.amplitude.values.tolist() == [0.1, 0.2, 0.3]
    assert found.engine.dims == found.memory.dims == ("case",)
    assert found.engine.values.tolist() == ["numpy", "auto"]
    assert found.time.values.tolist() == [10]


def test_geometric_and_integer_ranges(small):
    vary = {"solver.relaxation": {"from": 0.1, "to": 1.0, "count": 3, "scale": "log"},
            "steps": {"from": 4, "to": 8, "count": 3}}  # fmt: skip
    found = swept(small, vary=vary, keep={"variables": ["position"], "times": [0, 6]})
    np.testing.assert_allclose(found.relaxation, [0.1, 0.1**0.5, 1.0], rtol=1e-14)
    assert found.steps.values.tolist() == [4, 6, 8]
    assert found.time.values.tolist() == [0, 6]
    assert found.position.sel(steps=4, time=6).isnull().all()


def test_replicates_have_the_documented_seeds(small):
    found = swept(small | {"seed": 7}, replicates=3, keep={"variables": ["position"]})
    spawned = np.random.SeedSequence(7).spawn(3)
    assert found.seed.values.tolist() == [int(s.generate_state(1)[0]) for s in spawned]
    for k, seed in enumerate(replicate_seeds(7, 3)):
        alone = pbdkit.run(small | {"seed": seed}, progress=False)
        np.testing.assert_array_equal(found.position.isel(replicate=k), alone.position)
    assert "replicate" not in swept(small, vary={"steps": [2]}).dims


def test_repeating_runs_nothing_and_extending_runs_only_new_members(small, tmp_path, run_only):
    vary = {"solver.relaxation": [0.5, 1.0]}
    first = swept(small, vary=vary, folder=tmp_path)
    assert len(run_only) == 2
    same(first, swept(small, vary=vary, folder=tmp_path))
    assert len(run_only) == 2
    swept(small, vary={"solver.relaxation": [0.5, 0.7, 1.0]}, folder=tmp_path)
    assert len(run_only) == len(set(run_only)) == 3


def test_failures_are_reported_and_stop_no_other_member(call, small):
    sweep = {"experiment": small | {"steps": 600},
             "vary": {"solver.relaxation": [0.5, 5.0, 1.0]}, "keep": {"times": "last"}}  # fmt: skip
    Path("s.json").write_text(json.dumps(sweep))
    done = call("sweep", "s.json", "--workers", "1")
    assert done.code == 5
    assert "2 of 3 members complete" in done.out
    told = " ".join(done.err.split())
    assert "1 members have no values" in told
    assert "relaxation=5.0" in told
    assert "diverged" in told
    assert " diverged under rule " in told
    with pbdkit.open("s/sweep.nc") as found:
        assert found.status.values.tolist() == ["complete", "diverged", "complete"]
        assert found.position.isnull().all(["time", "particle", "axis"]).values[1]
        assert " diverged under rule " in str(found.message.values[1])
    again = call("sweep", "s.json", "--workers", "1")
    assert again.code == 5
    assert "0 run now, 3 stored before" in again.out
    assert call("verify", "s/sweep.nc").code == 0
    assert "contains all members of a sweep" in call("plot", "s/sweep.nc").err


def test_separated_members_are_printed_apart_from_complete_ones(capsys):
    keys = ["complete", "separated", "settled"]
    members = [
        Member((n,), f"energy={n}", Job(key, "", None, "all", {})) for n, key in enumerate(keys)
    ]
    summary = Summary(members, {key: (key, "") for key in keys}, 3, [], Path("s/sweep.nc"))
    assert report_end(summary, Path("s"), Stop(), quiet=False) == 0
    told = "2 of 3 members complete, 1 separated (energy=1): s/sweep.nc\n"
    assert capsys.readouterr().out == told


def test_exception_in_a_member_is_attributed_to_it(small, probing):
    probing("raise ValueError('no luck')")
    small["diagnostics"] = [{"type": "probe"}]
    with pytest.warns(
        pbdkit.PbdkitWarning, match="1 of 2 members have no values; the first is failed"
    ):
        found = swept(small, vary={"steps": [2, 5]})
    assert found.status.values.tolist() == ["complete", "failed"]
    assert "no luck" in str(found.message.values[1])


def test_member_without_memory_runs_again(small, tmp_path, monkeypatch):
    vary = {"solver.relaxation": [0.5, 1.0]}

    def exhausted(*_):
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr("pbdkit.sweeps.worker._ran", exhausted)
        first = pbdkit.sweep(small, vary=vary, folder=tmp_path / "s", workers=1, progress=False)
    assert set(first.status.values) == {"failed"}
    assert set(first.message.values) == {"out of memory; the same command runs this member again"}
    again = pbdkit.sweep(small, vary=vary, folder=tmp_path / "s", workers=1, progress=False)
    assert set(again.status.values) == {"complete"}


def test_member_that_kills_its_worker_is_lost_and_others_run(small, probing):
    probing("os.kill(os.getpid(), signal.SIGKILL)")
    small["diagnostics"] = [{"type": "probe"}]
    with pytest.warns(pbdkit.PbdkitWarning, match="steps=5: its process was killed"):
        found = swept(small, vary={"steps": [5, 2, 1]}, workers=2)
    assert found.status.values.tolist() == ["lost", "complete", "complete"]


def test_second_sweep_into_the_same_directory_is_refused(small, tmp_path):
    running = pytest.raises(pbdkit.StorageError, match="another sweep is running in this folder")
    with stores.Store(tmp_path), running:
        swept(small, vary={"steps": [2]}, folder=tmp_path)
    swept(small, vary={"steps": [2]}, folder=tmp_path)


def test_flipped_bit_is_named_and_that_member_reruns(small, tmp_path, run_only):
    asked = {"vary": {"steps": [5, 6, 7]}, "folder": tmp_path}
    first = swept(small, **asked)
    for column in ("content", "message", "status", "key", "digest"):
        flip(tmp_path / stores.DATABASE, column)
        run_only.clear()
        with pytest.warns(pbdkit.PbdkitWarning, match=r"sweep\.sqlite: row \d+ has changed since"):
            same(first, swept(small, **asked))
        assert len(run_only) == 1


@pytest.mark.parametrize("column", ["status", "message"])
def test_text_that_became_bytes_is_damage(small, tmp_path, run_only, column):
    """In a record of SQLite, one bit distinguishes both types."""
    asked = {"vary": {"steps": [5, 6]}, "folder": tmp_path}
    first = swept(small, **asked)
    with sqlite3.connect(tmp_path / stores.DATABASE) as database:
        database.execute(f"UPDATE member SET {column} = CAST({column} AS BLOB) WHERE rowid = 2")
    database.close()
    run_only.clear()
    with pytest.warns(pbdkit.PbdkitWarning, match="row 2 has changed since"):
        same(first, swept(small, **asked))
    assert len(run_only) == 1


def flip(path, column):
    """Change one bit of the second row, without a call of SQLite."""
    with sqlite3.connect(path) as database:
        query = f"SELECT rowid, CAST({column} AS BLOB) FROM member ORDER BY rowid"
        row, value = database.execute(query).fetchall()[1]
        changed = bytearray(value or b"\0")
        changed[len(changed) // 2] ^= 128
        kind = "CAST(? AS TEXT)" if column in ("message", "status", "key") else "?"
        update = f"UPDATE member SET {column} = {kind} WHERE rowid = ?"
        database.execute(update, (bytes(changed), row))
    database.close()


def test_large_members_are_files_and_a_flipped_bit_is_named(small, tmp_path, run_only, monkeypatch):
    monkeypatch.setattr(stores, "LARGE_BYTES", 1000)
    asked = {"vary": {"steps": [5, 6]}, "folder": tmp_path}
    first = swept(small, **asked)
    one, other = (tmp_path / stores.LARGE_FOLDER).iterdir()
    content = bytearray(one.read_bytes())
    content[-1] ^= 1
    one.write_bytes(content)
    with pytest.warns(
        pbdkit.PbdkitWarning, match="has changed since it was written; it runs again"
    ):
        same(first, swept(small, **asked))
    other.unlink()
    with pytest.warns(pbdkit.PbdkitWarning, match="cannot be read"):
        same(first, swept(small, **asked))
    assert len(run_only) == 4


def test_store_of_another_program_is_kept(small, tmp_path):
    path = tmp_path / stores.DATABASE
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE ours (x)")
    database.close()
    before = path.read_bytes()
    with pytest.raises(pbdkit.StorageError, match="is not a store of a sweep"):
        swept(small, vary={"steps": [2]}, folder=tmp_path)
    assert path.read_bytes() == before
    path.write_bytes(b"words " * 1000)
    with pytest.raises(pbdkit.StorageError, match="is not a store of a sweep"):
        swept(small, vary={"steps": [2]}, folder=tmp_path)
    assert path.read_bytes() == b"words " * 1000


def test_truncated_database_mixes_no_members(small, tmp_path):
    """SQLite reads zeros there, and takes what follows for row 0."""
    asked = {"vary": {"solver.relaxation": [0.4, 0.7, 1.0]}, "folder": tmp_path}
    small["body"] = {"type": "grid", "columns": 6, "rows": 4}
    asked["keep"] = {"variables": ["pe1"], "times": "last"}
    first, path = swept(small, **asked), tmp_path / stores.DATABASE
    whole = path.read_bytes()
    for left in (156, 500, 900):
        path.write_bytes(whole[: len(whole) - 4096 + left])
        damaged = path.read_bytes()
        with pytest.warns(pbdkit.PbdkitWarning, match="is damaged: .* intact|it runs again"):
            same(first, swept(small, **asked))
        for aside in tmp_path.glob("set-aside-*"):
            assert (aside / stores.DATABASE).read_bytes() == damaged
            shutil.rmtree(aside)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            same(first, swept(small, **asked))


def test_intact_part_of_a_damaged_database_is_kept(small, tmp_path, run_only):
    asked = {"vary": {"steps": [5, 6, 7]}, "folder": tmp_path}
    first, path = swept(small, **asked), tmp_path / stores.DATABASE
    data = bytearray(path.read_bytes())
    data[8192:8704] = bytes(512)  # the index of the keys
    path.write_bytes(data)
    run_only.clear()
    with pytest.warns(pbdkit.PbdkitWarning, match="its 3 intact members are now in a new one"):
        same(first, swept(small, **asked))
    assert run_only == []


@pytest.mark.parametrize(
    ("word", "changed", "words"),
    [
        (b"CREATE TABLE", b"CREATE\xffTABLE", "the schema is damaged"),
        (b"message", b"messag\xff", "Could not decode to UTF-8"),
    ],
    ids=["a keyword", "a name"],
)
def test_schema_that_is_not_text_is_set_aside(word, changed, words, small, tmp_path, run_only):
    """SQLite refuses a damaged keyword, and Python a damaged name."""
    asked = {"vary": {"steps": [5, 6]}, "folder": tmp_path}
    first, path = swept(small, **asked), tmp_path / stores.DATABASE
    path.write_bytes(path.read_bytes().replace(word, changed))
    run_only.clear()
    with pytest.warns(pbdkit.PbdkitWarning, match=f"{words}.* 0 intact members"):
        same(first, swept(small, **asked))
    assert len(run_only) == 2


def test_members_with_a_lost_log_are_reported(small, tmp_path, run_only):
    asked = {"vary": {"steps": [5, 6]}, "folder": tmp_path}
    with stores.Store(tmp_path):
        empty = (tmp_path / stores.DATABASE).read_bytes()
    first = swept(small, **asked)
    for without_log in (empty, None):
        (tmp_path / stores.DATABASE).unlink()
        if without_log:
            (tmp_path / stores.DATABASE).write_bytes(without_log)
        run_only.clear()
        with pytest.warns(pbdkit.PbdkitWarning, match="contains 0 of 2|although 2"):
            same(first, swept(small, **asked))
        assert len(run_only) == 2


def test_incomplete_database_blocks_no_sweep(small, tmp_path):
    """The disk was full, or the power failed, while it was written."""
    path = tmp_path / stores.DATABASE
    with sqlite3.connect(path) as database:
        database.execute("PRAGMA journal_mode = WAL")
    database.close()
    page = path.read_bytes()
    for data in (page, page[:100], b""):
        path.write_bytes(data)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            swept(small, vary={"steps": [2]}, folder=tmp_path).close()
        path.unlink()
        (tmp_path / stores.LOCK).unlink()


@pytest.mark.parametrize("call_fails", range(1, 9))
def test_failed_database_creation_leaves_a_resumable_directory(
    small, tmp_path, monkeypatch, call_fails
):
    """At each statement of its making, and at its new name."""
    real, left = stores.connect, [call_fails]

    class Failing(sqlite3.Connection):
        def execute(self, *args):
            left[0] -= 1
            if left[0] == 0:
                raise sqlite3.OperationalError("database or disk is full")
            return super().execute(*args)

    def connect(path, mode):
        real(path, mode).close()
        return sqlite3.connect(path, isolation_level=None, factory=Failing)

    with monkeypatch.context() as patch:
        patch.setattr(stores, "connect", connect)
        with pytest.raises(pbdkit.StorageError, match="disk is full"):
            swept(small, vary={"steps": [2]}, folder=tmp_path)
    swept(small, vary={"steps": [2]}, folder=tmp_path).close()
    assert {path.name for path in tmp_path.iterdir()} == {"lock", "sweep.nc", "sweep.sqlite"}


def test_leftovers_of_killed_sweeps_are_removed(small, tmp_path):
    (tmp_path / stores.LARGE_FOLDER).mkdir()
    left = [f".host.17.{'0f' * 16}.nc", f"{stores.LARGE_FOLDER}/.host.17.{'0f' * 16}"]
    for name in (*left, ".notes"):
        (tmp_path / name).touch()
    swept(small, vary={"steps": [2]}, folder=tmp_path)
    assert not any((tmp_path / name).exists() for name in left)
    assert (tmp_path / ".notes").exists()


def test_locked_database_is_awaited_and_reported(small, tmp_path, monkeypatch):
    asked = {"vary": {"steps": [2]}, "folder": tmp_path}
    swept(small, **asked).close()
    assert sqlite_file.PATIENCE_S == 60.0
    monkeypatch.setattr(sqlite_file, "PATIENCE_S", 0.1)
    other = sqlite3.connect(tmp_path / stores.DATABASE, isolation_level=None)
    other.execute("BEGIN EXCLUSIVE")
    with pytest.raises(pbdkit.StorageError, match="another program has locked it") as told:
        swept(small, **asked | {"vary": {"steps": [2, 3]}})
    other.close()
    assert "remove" not in str(told.value)
    assert swept(small, **asked).status.values.tolist() == ["complete"]


def meanwhile(monkeypatch, act):
    """Does something once the first member of a sweep has been run."""
    work, left = SerialExecutor.work, [act]

    def working(self, jobs, stopping):
        for report in work(self, jobs, stopping):
            yield report
            if left:
                left.pop()()

    monkeypatch.setattr(SerialExecutor, "work", working)


def test_removed_database_is_reported_during_a_sweep(small, tmp_path, monkeypatch):
    asked = {"vary": {"steps": [2, 3]}, "folder": tmp_path}
    meanwhile(monkeypatch, lambda: (tmp_path / stores.DATABASE).unlink())
    with pytest.warns(pbdkit.PbdkitWarning, match="was removed or replaced during the sweep"):
        first = swept(small, **asked)
    with pytest.warns(
        pbdkit.PbdkitWarning, match="is missing or not a database, although 2 members"
    ):
        same(first, swept(small, **asked))


def test_moved_directory_is_reported_during_a_sweep(small, tmp_path, monkeypatch):
    asked = {"vary": {"steps": [2, 3]}, "folder": tmp_path / "here"}
    meanwhile(monkeypatch, lambda: (tmp_path / "here").rename(tmp_path / "there"))
    with pytest.raises(pbdkit.StorageError, match="here: was moved or removed during"):
        swept(small, **asked)
    (tmp_path / "there").rename(tmp_path / "here")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert swept(small, **asked).sizes["steps"] == 2


WRONG = [
    ({"vary": {"solver.relaxtion": [1.0]}}, "s.json: member solver.relaxtion=1.0: s.json:1:.* "
     "unknown key; did you mean 'relaxation'"),
    ({"varry": {"steps": [1]}}, "varry: unknown key; did you mean 'vary'"),
    ({"vary": {"steps": [2, 0]}}, "member steps=0: .*steps: should be greater than or equal to 1"),
    ({"vary": {"steps": []}}, "vary.steps: expected a list of values"),
    ({"vary": {"steps": 5}}, "vary.steps: expected a list of values"),
    ({"vary": {"body.width": "2 mm"}}, r"vary.body.width: expected .*; write \['2 mm'\]"),
    ({"vary": {"body.width": ["5 mm", 10]}}, "vary.body.width: 10 has no unit, but other values"),
    ({"vary": {"body.width": ["5 mm", "0.5 cm"]}}, "vary.body.width: '5 mm' is listed twice"),
    ({"vary": {"body.width": ["5 mm", "1 kPa"]}}, "vary.body.width: '1 kPa' is not a quantity in "
     "mm as '5 mm'"),
    ({"vary": {"steps": [2, 2]}}, "vary.steps: 2 is listed twice"),
    ({"vary": {"steps": {"from": 1, "to": 2}}}, "vary.steps.count: is missing"),
    ({"vary": {"body.width": {"from": "6 mm", "to": "14 mm", "count": 3}}},
     "vary.body.width: `from` and `to` of a range are numbers without units; list values with"),
    ({"vary": {"steps": {"from": 1, "til": 2, "count": 2}}}, "did you mean 'to'|unknown key"),
    ({"vary": {"solver.relaxation": {"from": 0, "to": 2, "count": 2, "scale": "log"}}}, "above 0"),
    ({"vary": {"rule": [{"type": "barycentre"}], "rule.K": [1]}}, "'rule' is varied twice"),
    ({"vary": {"seed": [1]}, "replicates": 2}, "'seed' is varied twice: also by replicates"),
    ({"together": {"steps": [1, 2], "seed": [1]}}, "equal length.*steps has 2, seed has 1"),
    ({"vary": {"leaders.7.until": [1]}}, "member leaders.7.until=1: .*'7' is not an index"),
    ({"vary": {"steps": {"from": 1, "to": 10**6, "count": 10**5}}, "replicates": 9},
     "900000 members exceed the maximum of 100000"),
    ({"vary": {"steps": [10**9]}}, "the dataset of .* members takes .* GiB"),
    ({"keep": {"variables": ["pe3"]}}, "no variable 'pe3'; did you mean 'pe1'"),
    ({"keep": {"times": [50]}}, "keep.times: 50 exceeds the last step of all members, 10"),
    ({"keep": {"times": "lost"}}, "keep.times"),
    ({"vary": {"body.columns": [10**5], "body.rows": [10**6]}}, "member body.columns=1.*GiB"),
    ({"experiment": "paper/x"}, "experiment: 'paper/x' is neither; did you mean 'paper/"),
    ({"experiment": "../e.json"}, "lies outside the folder; give a shipped name, or"),
    ({"experiment": "/etc/passwd"}, "lies outside the folder"),
    ({"experiment": "link.json"}, "'link.json' lies outside the folder"),
    ({"experiment": 3}, "experiment: expected the name of a shipped experiment"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "message"), WRONG, ids=[str(n) for n in range(len(WRONG))])
def test_errors_are_one_message_before_anything_runs(call, small, run_only, change, message):
    Path("../e.json").write_text(json.dumps(small))
    Path("link.json").symlink_to("../e.json")
    Path("s.json").write_text(json.dumps({"experiment": small} | change))
    done = call("sweep", "s.json")
    assert done.code == 2
    told = " ".join(done.err.split())
    assert re.search(message, told), told
    assert len(told) < 2000
    assert run_only == []
    assert not Path("s").exists()


def test_the_experiment_is_a_file_beside_the_sweep_or_a_shipped_one(call, tmp_path):
    Path("inner").mkdir()
    Path("inner/e.json").write_bytes(Path("e.json").read_bytes())
    for n, name in enumerate(("e.json", "inner/e.json", "paper/a")):
        Path("s.json").write_text(json.dumps({"experiment": name, "vary": {"steps": [10]}}))
        assert call("sweep", "s.json", "-o", f"out{n}", "--workers", "1").code == 0


def test_stopped_sweep_resumes(small, tmp_path):
    """Ctrl-C reaches the program and its workers, as from a terminal."""
    path = tmp_path / "s.json"
    sweep = {"experiment": small | {"steps": 2000}, "vary": {"seed": [*range(30)]},
             "keep": {"variables": ["pe1"], "times": "last"}}  # fmt: skip
    path.write_text(json.dumps(sweep))
    line = [sys.executable, "-m", "pbdkit", "sweep", str(path), "-o", str(tmp_path / "out")]
    line += ["--workers", "2"]
    running = subprocess.Popen(line, stderr=subprocess.PIPE, text=True, start_new_session=True)
    wait_for(lambda: rows(tmp_path / "out"))
    os.killpg(running.pid, signal.SIGINT)
    _, told = running.communicate(timeout=60)
    assert running.returncode == 130
    assert "the same command runs the remaining ones" in told
    assert "Traceback" not in told
    held = rows(tmp_path / "out")
    assert 0 < held < 30
    assert not (tmp_path / "out" / "sweep.nc").exists()


def test_worker_that_hangs_before_it_begins_is_terminated(small, tmp_path, monkeypatch):
    """The process is stopped, or its disk does not respond."""
    (tmp_path / "sitecustomize.py").write_text("import time\ntime.sleep(60)\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    begun, stopped = time.monotonic(), []
    reports = ProcessExecutor(1).work(jobs_of(small, 2), lambda: bool(stopped))
    assert next(reports) is None
    stopped.append(True)
    assert [*reports] == []
    assert time.monotonic() - begun < 20.0


def jobs_of(experiment, count):
    """Jobs of some seeds."""
    base = Source(data=experiment)
    asked = SweepPlan(
        checked({"experiment": experiment, "vary": {"seed": [*range(count)]}}, base), base, base
    )
    return [
        member.job for member, _ in asked.members(asked.grid(asked.experiment()), lambda _: None)
    ]


def test_sweep_can_be_stopped_during_validation(small, tmp_path, monkeypatch):
    asked = []

    def stopping():
        asked.append(1)
        return len(asked) > 3

    base = Source(data=small)
    sweep = checked({"experiment": small, "vary": {"seed": [*range(50)]}}, base)
    summary = carry_out(
        SweepPlan(sweep, base, base),
        tmp_path / "out",
        SerialExecutor(),
        stopping,
        lambda *told: None,
    )
    assert (summary.path, summary.run, len(asked)) == (None, 0, 4)
    assert not (tmp_path / "out").exists()


class Lost:
    """A client of a dask cluster that loses its scheduler at the first request."""

    status = "running"

    def nthreads(self):
        return {"worker": 1}

    def submit(self, *task, **more):
        self.status = "connecting"
        raise CancelledError("scheduler-connection-lost")


def test_lost_scheduler_is_named_with_the_way_to_resume(small):
    with pytest.raises(pbdkit.StorageError, match=r"the scheduler is lost.*are stored, and"):
        [*ClusterExecutor(Lost()).work(jobs_of(small, 2), lambda: False)]


def test_wait_for_a_cluster_worker_can_be_stopped(small):
    from distributed import Client

    with Client(processes=False, n_workers=0, dashboard_address=None) as client:
        begun, stopped = time.monotonic(), []
        reports = ClusterExecutor(client).work(jobs_of(small, 2), lambda: bool(stopped))
        assert next(reports) is None
        stopped.append(True)
        assert [*reports] == []
        assert time.monotonic() - begun < 10.0


def rows(folder):
    """Return the number of members in a store."""
    try:
        with sqlite3.connect(f"file:{folder / stores.DATABASE}?mode=ro", uri=True) as database:
            (count,) = database.execute("SELECT COUNT(*) FROM member").fetchone()
        database.close()
    except sqlite3.OperationalError:
        return 0
    return count


def wait_for(condition, seconds=60):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


class Lazy(pbdkit.FollowerRule):
    type: Literal["lazy"] = "lazy"
    share: float = 0.5

    @staticmethod
    def gather(d, r, w, p):
        return d, 1.0

    @staticmethod
    def apply(total, here, p):
        return p.share * total[0] / total[1]


def test_a_class_from_python_is_swept_in_this_process(small, tmp_path):
    from pbdkit.model.reading import Source

    given = pbdkit.Experiment.build(Source(data=small | {"rule": {"type": "lazy"}}), [Lazy])
    found = pbdkit.sweep(given, vary={"rule.share": [0.3, 0.6]}, progress=False)
    assert found.status.values.tolist() == ["complete"] * 2
    for wrong in ({"workers": 2}, {"folder": tmp_path}):
        with pytest.raises(pbdkit.ExperimentError, match="into a plugin"):
            pbdkit.sweep(given, vary={"rule.share": [0.3]}, progress=False, **wrong)


def test_unresponsive_cluster_is_one_message(call, small, monkeypatch):
    monkeypatch.setattr("pbdkit.cli.sweep.CONNECT_S", 0.5)
    Path("s.json").write_text(json.dumps({"experiment": small}))
    done = call("sweep", "s.json", "--dask", "tcp://127.0.0.1:1")
    assert done.code == 2
    assert "no scheduler responds" in done.err


def test_write_ahead_log_is_used_only_on_local_file_systems(small, tmp_path, monkeypatch):
    for local, journal in ((True, "wal"), (False, "truncate")):
        monkeypatch.setattr(sqlite_file, "is_local", lambda path, local=local: local)
        with stores.Store(tmp_path / journal) as store:
            (found,) = store._database.execute("PRAGMA journal_mode").fetchone()
            (synchronous,) = store._database.execute("PRAGMA synchronous").fetchone()
        assert (found, synchronous) == (journal, 2)


def test_members_of_different_precision_lose_no_digits(small):
    found = swept(small, vary={"record.dtype": ["float32", "float64"]})
    alone = pbdkit.run(small, progress=False)
    np.testing.assert_array_equal(found.position.isel(dtype=1), alone.position)
    assert found.position.dtype == np.float64


def test_bonds_and_measurements_of_every_step_are_joined(small):
    small["diagnostics"] = [{"type": "track", "numbers": [9]}, {"type": "broken"}]
    small["fracture"] = {"type": "threshold", "thresholds": [1.05]}
    found = swept(small, vary={"body.columns": [4, 5], "steps": [4, 6]})
    assert found.status.values.tolist() == [["complete"] * 2] * 2
    assert found.track.dims == ("columns", "steps", "step", "tracked", "axis")
    assert found.track.sel(steps=4, step=6).isnull().all()
    for n in (4, 5):
        small["body"]["columns"] = n
        alone = pbdkit.run(small | {"steps": 6}, progress=False)
        member = found.sel(columns=n, steps=6).isel(bond=slice(alone.sizes["bond"]))
        np.testing.assert_array_equal(member.broken_step, alone.broken_step)
        np.testing.assert_array_equal(member.broken_bonds, alone.broken_bonds)


def test_variables_of_some_members_stay_theirs(small):
    """Though it is the same in all that have it."""
    none, torn = {"type": "none"}, {"type": "threshold", "thresholds": [1.05]}
    small["diagnostics"] = []
    found = swept(small, vary={"fracture": [none, torn]})
    assert found.shell.dims == ("fracture", "bond")
    assert (found.shell[0] == found.shell.attrs["fill_value"]).all()
    assert (found.shell[1] == 1).all()
    assert found.site.dims == ("particle", "index")
    found = swept(small | {"fracture": torn}, vary={"fracture.placement": [1.0, 0.9]})
    assert found.shell.dims == ("bond",)


def test_stress_test(tmp_path):
    for steps in (3200, 9600):  # the first may end before the first commit
        (folder := tmp_path / str(steps)).mkdir()
        found = under_fire(folder, members=6, kills=1, workers=2, steps=steps)
        if found["killed"]:
            break
    assert found == {"exit": 0, "killed": 1, "right": 6, "wrong": 0, "run again": 0}
