"""The folder of a sweep: its store, and sweeps that run into it one after the other."""

from __future__ import annotations

import pickle
import random
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from hypothesis import strategies as st
from hypothesis.stateful import initialize, precondition, rule
from machines.counted import Counted, contents, damaged, put_back
from machines.run import BASE

import pbdkit
from pbdkit.errors import PbdkitError, StorageError
from pbdkit.io.atomic_file import write
from pbdkit.model.reading import Source
from pbdkit.sweeps import store as stores
from pbdkit.sweeps.execute import RESULT, Executor, Summary, carry_out
from pbdkit.sweeps.specification import Job, SweepPlan, checked
from pbdkit.sweeps.store import Store
from pbdkit.sweeps.worker import LOST, MemberReport, report_of, run_member

KEYS = [f"{n:032x}" for n in range(1, 7)]
SEEDS = st.integers(0, 2**20)
CODE = ("pbdkit/sweeps/store", "pbdkit/sweeps/execute", "pbdkit/io/")
LARGE_BYTES = 100
"""Larger results are files."""
FILES = st.sampled_from(["sweep.sqlite*", "sweep.sqlite*", "members/*", "lock", "*"])


def report(key: str) -> MemberReport:
    """Return the report of a member; those of some keys are files of their own."""
    number = int(key, 16)
    status = ("complete", "settled", "failed")[number % 3]
    return report_of(key, status, f"message {number}", bytes([number]) * 30 * number)


class SweepStoreMachine(Counted):
    """`Store`: results of members by key. What was committed survives a kill; what is damaged is
    reported, and never becomes another result."""

    store: Store | None = None

    @initialize()
    def begin(self) -> None:
        self.now, self.due = 0.0, 0.0
        self.sure: set[str] = set()
        """Keys that are in the store whatever happens, and those that may be there."""
        self.possible: set[str] = set()
        self.is_damaged = False
        self.patch.setattr(stores, "LARGE_BYTES", LARGE_BYTES)
        self.patch.setattr(stores, "time", SimpleNamespace(monotonic=lambda: self.now))

    def teardown(self) -> None:
        self.drop()
        super().teardown()

    def drop(self) -> None:
        """Close the files of a killed process, in a folder that is no longer used."""
        if self.store:
            with suppress(sqlite3.Error):
                self.store._closing.close()
            self.store = None

    def committed(self) -> None:
        self.sure, self.due = {*self.possible}, self.now + stores.COMMIT_S

    def enter(self) -> tuple[Store, dict[str, tuple[str, str]]]:
        store = Store(self.folder)
        store.__enter__()
        return store, store.held()

    def check(self, held: dict[str, tuple[str, str]], faults: list[str]) -> None:
        for key, (status, message) in held.items():
            right = report(key)
            assert (status, message) == (right.status, right.message)
        assert {*held} <= self.possible
        assert {*held} >= self.sure or faults
        assert self.is_damaged or not faults
        self.possible, self.is_damaged = {*held}, False

    @precondition(lambda self: not self.store)
    @rule()
    def open(self) -> None:
        self.store, held = self.enter()
        self.check(held, self.store.faults)
        self.committed()

    @precondition(lambda self: not self.store)
    @rule(line=st.integers(1, 150))
    def open_and_be_killed(self, line: int) -> None:
        opened: list[Any] = []
        reached = self.killed(line, CODE, lambda: opened.extend(self.enter()))
        self.store, held = opened
        if reached:
            self.drop()
            return
        self.check(held, self.store.faults)
        self.committed()

    @precondition(lambda self: self.store)
    @rule(key=st.sampled_from(KEYS))
    def put(self, key: str) -> None:
        assert self.store
        if key not in self.possible:
            self.store.put(report(key))
            self.possible.add(key)
            if self.now >= self.due:
                self.committed()

    @precondition(lambda self: self.store)
    @rule(key=st.sampled_from(KEYS), line=st.integers(1, 60))
    def put_and_be_killed(self, key: str, line: int) -> None:
        assert self.store
        store = self.store
        if key in self.possible:
            return
        if self.killed(line, CODE, lambda: store.put(report(key))):
            self.drop()
            self.possible.add(key)
            return
        self.possible.add(key)
        if self.now >= self.due:
            self.committed()

    @rule(seconds=st.sampled_from([0.1, 0.5, 1.0, 100.0]))
    def wait(self, seconds: float) -> None:
        self.now += seconds

    @precondition(lambda self: self.store)
    @rule()
    def commit(self) -> None:
        assert self.store
        self.store.commit()
        self.committed()

    @precondition(lambda self: self.store)
    @rule(error=st.sampled_from([None, KeyError(), StorageError("disk")]))
    def close(self, error: Exception | None) -> None:
        assert self.store
        self.store.__exit__(type(error), error, None)
        self.store = None
        self.committed()

    @precondition(lambda self: self.store)
    @rule()
    def be_killed(self) -> None:
        self.move_to_copy()
        self.drop()

    @precondition(lambda self: self.store)
    @rule(key=st.sampled_from(KEYS))
    def read(self, key: str) -> None:
        assert self.store
        try:
            assert self.store.report(key)[:5] == report(key)[:5]
        except StorageError:
            assert key not in self.possible

    @precondition(lambda self: self.store)
    @rule()
    def open_a_second_time(self) -> None:
        try:
            Store(self.folder).__enter__()
        except StorageError as error:
            assert "another sweep is running" in str(error)  # noqa: PT017
        else:
            raise AssertionError("two sweeps in one folder")

    @precondition(lambda self: self.store)
    @rule(key=st.sampled_from(KEYS), seed=SEEDS)
    def read_a_changed_row(self, key: str, seed: int) -> None:
        """Read a row that differs from what was written."""
        assert self.store
        if key not in self.possible:
            return
        self.store.commit()
        self.committed()
        column = random.Random(seed).choice(["status", "message", "content", "digest"])
        database = self.store._database
        query = f"SELECT {column} FROM member WHERE key = ?"
        (value,) = database.execute(query, (key,)).fetchone()
        update = f"UPDATE member SET {column} = ? WHERE key = ?"
        with suppress(StorageError):
            database.execute(update, (b"other", key))
            assert self.store.report(key)[:5] == report(key)[:5]
            assert value is None  # The content of this member is in a file.
        database.execute(update, (value, key))

    @precondition(lambda self: not self.store and self.sure)
    @rule(files=FILES, seed=SEEDS)
    def damage(self, files: str, seed: int) -> None:
        before = contents(self.folder)
        how = damaged(self.folder, files, seed)
        after = contents(self.folder)
        try:
            store, held = self.enter()
        except StorageError:
            changed = contents(self.folder)
            assert {n: d for n, d in changed.items() if n != "lock"} == {
                n: d for n, d in after.items() if n != "lock"
            }, how
            put_back(self.folder, before)
            return
        self.store, self.is_damaged = store, True
        for name, data in after.items():  # A damaged database is set aside, or was mended by row.
            if name == stores.DATABASE and any("set-aside" in fault for fault in store.faults):
                aside = [p.read_bytes() for p in self.folder.glob(f"set-aside-*/{name}")]
                assert data in aside, how
        self.check(held, store.faults)
        self.committed()


EXPERIMENT = BASE | {
    "steps": 3,
    "initial": {"type": "noise", "amplitude": 0.1},
    "diagnostics": [{"type": "pe1"}],
}
KEEPS: list[dict[str, Any]] = [
    {"variables": ["position"], "times": "last"},
    {"variables": ["position", "pe1"], "times": "all"},
    {"times": [0, 2]},
]


@cache
def plain(seed: int) -> Any:
    """Return the dataset of the run of a member."""
    return pbdkit.run(EXPERIMENT | {"seed": seed}, progress=False)


def plan_of(seeds: list[int], keep: int) -> SweepPlan:
    """Return a sweep over seeds."""
    base = Source(data=EXPERIMENT)
    data = {"experiment": EXPERIMENT, "vary": {"seed": seeds}, "keep": KEEPS[keep]}
    return SweepPlan(checked(data, base), base, base)


REPORTS: dict[str, MemberReport] = {}
"""Reports of the members that were computed, by key."""


def computed(job: Job) -> MemberReport:
    """Return the report of a member, which is computed once."""
    if job.key not in REPORTS:
        REPORTS[job.key] = run_member(job)
    return REPORTS[job.key]


def write_pickle(dataset: Any, path: Path, *, replace: bool) -> None:
    """Write a dataset in place of `write_dataset`, which takes a tenth of a second."""
    write(path, pickle.dumps(dataset), replace=replace)


def opened(path: Path) -> Any:
    """Open a dataset of either kind."""
    data = path.read_bytes()
    return pbdkit.open(path) if data[:4] == b"\x89HDF" else pickle.loads(data)


def assert_right(folder: Path, seeds: list[int], keep: int, lost: set[int]) -> None:
    """Assert that a dataset is that of the sweep: each member has its own values, and a lost one
    has none."""
    chosen = KEEPS[keep]
    with opened(folder / RESULT) as dataset:
        assert dataset["seed"].values.tolist() == seeds
        times = {"last": [3], "all": [0, 1, 2, 3]}.get(str(chosen["times"]), chosen["times"])
        names = chosen.get("variables") or ["position", "pe1", "u"]
        for place, seed in enumerate(seeds):
            status = str(dataset["status"].values[place])
            assert status == ("lost" if seed in lost else "complete"), (seed, status)
            for name in (name for name in names if name in plain(seed)):
                if lost == {*seeds}:
                    assert name not in dataset
                    continue
                values = dataset[name].isel(seed=place)
                if seed in lost:
                    assert values.isnull().all()
                    continue
                right = plain(seed)[name].sel(time=times).values
                assert dataset["time"].values.tolist() == times
                assert values.values.tobytes() == right.tobytes(), (seed, name)


class Canned(Executor):
    """Executor that returns the reports in any order, loses some members, and stops."""

    def __init__(self, seed: int, losses: float = 0.0) -> None:
        self.draw, self.losses = random.Random(seed), losses
        self.keys: list[str] = []
        self.lost: set[str] = set()

    def work(self, jobs: list[Job], stopping: Callable[[], bool]) -> Iterator[MemberReport | None]:
        """Yield the reports of all jobs, in a random order."""
        for job in self.draw.sample(jobs, len(jobs)):
            if stopping():
                return
            if self.draw.random() < 0.3:
                yield None
            self.keys.append(job.key)
            if self.draw.random() < self.losses:
                self.lost.add(job.key)
                yield report_of(job.key, LOST, "its process was killed", lasting=False)
            else:
                yield computed(job)


MEMBERS = st.lists(st.integers(0, 7), min_size=1, max_size=5, unique=True)


class SweepMachine(Counted):
    """Sweeps with changing members and variables into one folder. No member has the values of
    another one, and none is run again once it has been committed."""

    @initialize(netcdf=st.integers(0, 59))
    def begin(self, netcdf: int) -> None:
        if netcdf < 59:
            self.patch.setattr("pbdkit.sweeps.execute.write_dataset", write_pickle)
        self.now = 0.0
        self.sure: set[str] = set()
        self.possible: set[str] = set()
        self.results: list[tuple[list[int], int, set[int]]] = []
        """Sweeps of which the dataset may be there."""
        self.patch.setattr(stores, "LARGE_BYTES", 1200)
        self.patch.setattr(stores, "time", SimpleNamespace(monotonic=lambda: self.now))
        self.patch.setattr("pbdkit.sweeps.execute.machine_memory", lambda: 2**33)

    def sweep(
        self, executor: Canned, seeds: list[int], keep: int, stopping: Callable[[], bool]
    ) -> Summary:
        return carry_out(plan_of(seeds, keep), self.folder, executor, stopping, lambda *_: None)

    def note(self, summary: Summary, executor: Canned, seeds: list[int], keep: int) -> None:
        """Note what a sweep has stored, and check what it has run."""
        keys = [member.job.key for member in summary.members]
        assert not self.sure & {*executor.keys} or summary.faults
        assert len({*executor.keys}) == len(executor.keys) == summary.run
        stored = ({*keys} & {*summary.ends}) - executor.lost
        self.possible |= stored
        self.sure = self.sure | stored if not summary.faults else stored
        if summary.path:
            assert {*keys} <= {*summary.ends}
            lost = {seed for seed, key in zip(seeds, keys, strict=True) if key in executor.lost}
            self.results = [(seeds, keep, lost)]

    @rule(seeds=MEMBERS, keep=st.integers(0, 2), seed=SEEDS, loses=st.booleans())
    def run(self, seeds: list[int], keep: int, seed: int, loses: bool) -> None:
        executor = Canned(seed, 0.3 * loses)
        summary = self.sweep(executor, seeds, keep, lambda: False)
        assert not summary.faults
        self.note(summary, executor, seeds, keep)

    @rule(seeds=MEMBERS, keep=st.integers(0, 2), seed=SEEDS, count=st.integers(0, 4))
    def run_and_stop(self, seeds: list[int], keep: int, seed: int, count: int) -> None:
        executor = Canned(seed)
        summary = self.sweep(executor, seeds, keep, lambda: len(executor.keys) >= count > 0)
        self.note(summary, executor, seeds, keep)

    @rule(seeds=MEMBERS, keep=st.integers(0, 2), seed=SEEDS, line=st.integers(1, 1500))
    def run_and_be_killed(self, seeds: list[int], keep: int, seed: int, line: int) -> None:
        executor, summaries = Canned(seed), list[Summary]()
        reached = self.killed(
            line,
            CODE,
            lambda: summaries.append(self.sweep(executor, seeds, keep, lambda: self.is_killed)),
        )
        if not reached:
            self.note(summaries[0], executor, seeds, keep)
            return
        assert not self.sure & {*executor.keys}
        self.possible |= {*executor.keys}
        self.results.append((seeds, keep, set()))

    @precondition(lambda self: self.results)
    @rule()
    def read(self) -> None:
        if not (self.folder / RESULT).exists():
            assert len(self.results) == sum(not lost for *_, lost in self.results)
            return
        faults = []
        for seeds, keep, lost in self.results:
            try:
                assert_right(self.folder, seeds, keep, lost)
            except AssertionError as error:
                faults.append(error)
            else:
                return
        raise faults[-1]

    @precondition(lambda self: self.possible)
    @rule(files=FILES, how=SEEDS, seeds=MEMBERS, keep=st.integers(0, 2))
    def run_after_damage(self, files: str, how: int, seeds: list[int], keep: int) -> None:
        before = contents(self.folder)
        said = damaged(self.folder, files, how)
        executor = Canned(how)
        try:
            summary = self.sweep(executor, seeds, keep, lambda: False)
        except PbdkitError:
            put_back(self.folder, before)
            return
        assert not self.sure & {*executor.keys} or summary.faults, said
        self.possible = {member.job.key for member in summary.members}
        self.sure = {*self.possible}
        self.results = [(seeds, keep, set())]
        assert_right(self.folder, seeds, keep, set())
