"""Simulation of a sweep in one process: its workers die, and the sweep itself is killed and started
again. A seed determines the order of all events."""

from __future__ import annotations

import random
import shutil
import sqlite3
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from machines.counted import copied_at
from machines.sweeps import REPORTS, assert_right, computed, plan_of, write_pickle

from pbdkit.errors import PbdkitError
from pbdkit.sweeps import execute, store as stores
from pbdkit.sweeps.execute import ProcessExecutor, carry_out
from pbdkit.sweeps.specification import Job
from pbdkit.sweeps.worker import MemberReport

CODE = ("pbdkit/sweeps/store", "pbdkit/sweeps/execute", "pbdkit/io/")
MAX_LINES = 4000
"""Lines of the program within which the process of the sweep is killed."""
MAX_LIVES = 3
"""Number of times that it is killed."""


class World:
    """Clock, and worker processes, of which one does something at each event."""

    def __init__(self, draw: random.Random, *, deadly: bool, poison: str = "") -> None:
        self.draw, self.poison = draw, poison
        self.death = draw.choice([0.02, 0.1, 0.3]) if deadly else 0.0
        self.now = 0.0
        self.pools: list[Pool] = []
        self.deaths = 0

    def pool(self, workers: int, context: object, initializer: object) -> Pool:
        """Start a worker, in place of ProcessPoolExecutor."""
        self.pools.append(Pool(self))
        return self.pools[-1]

    def wait(self, futures: Iterable[Future[Any]], timeout: float, when: object = None) -> Any:
        """Let some events happen, in place of concurrent.futures.wait."""
        for _ in range(self.draw.choice([0, 1, 1, 3])):
            self.now += self.draw.choice([0.0, 0.01, 0.3, 5.0])
            if active := [pool for pool in self.pools if pool.waiting]:
                self.draw.choice(active).act()
        return SimpleNamespace(done={future for future in futures if future.done()})

    def run(self, jobs: list[Job]) -> list[MemberReport]:
        """Run the members of a chunk; they take times of very different length."""
        times = [0.0001, 0.02, 1.0]
        return [computed(job)._replace(seconds=self.draw.choice(times)) for job in jobs]


class Pool:
    """One worker process. It dies before, while or after it does what it has been given."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.waiting: list[tuple[Future[Any], Callable[..., Any], tuple[Any, ...]]] = []
        self.is_dead = self.is_broken = False

    def submit(self, call: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Queue a call. The end of the process may not have been noticed yet."""
        if self.is_broken:
            raise BrokenProcessPool("the process is dead")
        future: Future[Any] = Future()
        self.waiting.append((future, call, arguments))
        return future

    def act(self) -> None:
        """Finish the first call, die, or notice the death."""
        if self.is_dead:
            self.is_broken = True
            for future, *_ in self.waiting:
                future.set_exception(BrokenProcessPool("the process is dead"))
            self.waiting.clear()
            return
        future, _, arguments = self.waiting[0]
        jobs: list[Job] = arguments[0] if arguments else []
        is_poisoned = any(job.key == self.world.poison for job in jobs)
        if is_poisoned or self.world.draw.random() < self.world.death:
            self.world.deaths += 1
            self.is_dead = True
            return
        del self.waiting[0]
        future.set_result(self.world.run(jobs) if arguments else 1)
        if self.world.draw.random() < self.world.death:
            self.world.deaths += 1
            self.is_dead = True

    def kill(self) -> None:
        """End the process without a notice."""
        self.is_dead = True

    def shutdown(self, **options: object) -> None:
        """End the process, and cancel its calls."""
        self.is_dead = True
        for future, *_ in self.waiting:
            future.cancel()
        self.waiting.clear()


def committed(folder: Path) -> dict[str, bytes]:
    """Return key and digest of the members in a store."""
    path = folder / stores.DATABASE
    if not path.exists():
        return {}
    with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as database:
        if not database.execute("SELECT name FROM sqlite_master").fetchall():
            return {}
        return dict(database.execute("SELECT key, digest FROM member"))


class Figures(SimpleNamespace):
    """Numbers of deaths, kills and members of a simulation."""

    deaths: int
    kills: int
    members: int


def simulate(seed: int, base: Path) -> Figures:
    """Run a sweep that is disturbed, and killed some times, to its end. Raises AssertionError where
    a member is lost, run again after it was committed, or has other values than its run.

    Parameters
    ----------
    seed
        Seed of all events.
    base
        Empty folder for the folders that the kills leave.
    """
    draw, figures = random.Random(seed), Figures(deaths=0, kills=0, members=0)
    folder = base / "0"
    folder.mkdir()
    for life in range(1 + draw.randrange(MAX_LIVES + 1)):
        target = base / str(life + 1)
        folder = _one_life(draw, folder, target, figures)
    _last_life(draw, folder, figures)
    return figures


def _patched(patch: pytest.MonkeyPatch, world: World, ran: list[str]) -> None:
    def run_members(jobs: list[Job]) -> list[MemberReport]:
        raise AssertionError("members are run by the world")

    original = stores.Store.put

    def put(store: stores.Store, report: MemberReport) -> None:
        ran.append(report.key)
        original(store, report)

    patch.setattr(execute, "ProcessPoolExecutor", world.pool)
    patch.setattr(execute, "wait", world.wait)
    patch.setattr(execute, "active_children", lambda: list(world.pools))
    patch.setattr(execute, "run_members", run_members)
    patch.setattr(execute, "write_dataset", write_pickle)
    patch.setattr(execute, "machine_memory", lambda: 2**33)
    patch.setattr(stores, "LARGE_BYTES", 1200)
    patch.setattr(stores, "time", SimpleNamespace(monotonic=lambda: world.now))
    patch.setattr(stores.Store, "put", put)


def _one_life(draw: random.Random, folder: Path, target: Path, figures: Figures) -> Path:
    """A sweep that is killed, unless it ends before; return the folder that it leaves."""
    seeds = draw.sample(range(8), draw.randint(1, 6))
    keep, line = draw.randrange(3), draw.randint(1, MAX_LINES)
    world, ran, before = World(draw, deadly=True), list[str](), committed(folder)
    is_killed: list[bool] = []

    def copy() -> None:
        shutil.copytree(folder, target)
        is_killed.append(True)

    def sweep() -> None:
        executor = ProcessExecutor(draw.randint(1, 3))
        stopping = lambda: bool(is_killed)  # noqa: E731  # what follows has no effect
        carry_out(plan_of(seeds, keep), folder, executor, stopping, lambda *_: None)

    with pytest.MonkeyPatch.context() as patch:
        _patched(patch, world, ran)
        try:
            reached = copied_at(line, CODE, copy, sweep)
        except PbdkitError as error:  # Workers that die while they start, ten times.
            assert "worker processes ended while they were starting" in str(error)  # noqa: PT017
            reached = bool(is_killed)
    figures.deaths += world.deaths
    figures.kills += reached
    after = target if reached else folder
    assert not {*before} & {*ran}, "a committed member was run again"
    now = committed(after)
    assert before.items() <= now.items(), "a committed member is lost"
    return after


def _last_life(draw: random.Random, folder: Path, figures: Figures) -> None:
    """A sweep to its end, with a member that kills each process that runs it, or without."""
    seeds, keep = draw.sample(range(8), draw.randint(1, 6)), draw.randrange(3)
    before, ran = committed(folder), list[str]()
    jobs = {seed: plan_of([seed], keep) for seed in seeds}
    keys = {
        seed: next(plan.members(plan.grid(plan.experiment()), lambda _: None))[0].job.key
        for seed, plan in jobs.items()
    }
    poison = draw.choice(seeds) if draw.random() < 0.3 else -1
    is_poisoned = poison >= 0 and keys[poison] not in before
    world = World(draw, deadly=False, poison=keys[poison] if is_poisoned else "")
    with pytest.MonkeyPatch.context() as patch:
        _patched(patch, world, ran)
        executor, quiet = ProcessExecutor(draw.randint(1, 3)), lambda *_: None
        summary = carry_out(plan_of(seeds, keep), folder, executor, lambda: False, quiet)
    lost = {poison} if is_poisoned else set[int]()
    assert summary.path, "the sweep was not completed"
    assert not summary.faults, summary.faults
    assert sorted(ran) == sorted({keys[s] for s in seeds if s not in lost} - {*before})
    assert {member.job.key for member, *_ in summary.failures} & {*keys.values()} == {
        keys[seed] for seed in lost
    }
    assert {*committed(folder)} == {*before, *ran}
    for key, digest in committed(folder).items():
        assert REPORTS[key].digest == digest, "a member has other values"
    assert_right(folder, seeds, keep, lost)
    figures.deaths += world.deaths
    figures.members += len(seeds)
