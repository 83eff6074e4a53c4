"""Kill runs at random moments, and at chosen points of their end, and resume them.

    python tests/reliability/kill_runs.py [--trials N] [--seed S] [--only NUMBER]

Every run of these commits whenever it can. After each kill `pbdkit status` and `pbdkit.open` are
compared with the steps that the run has acknowledged as stored; in the end the result is compared
with that of the uninterrupted run, bit for bit.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import struct
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from faults import arm, load
from trials import (
    EXPERIMENTS,
    OUTPUT,
    called,
    debris,
    differences,
    done,
    ended,
    network,
    often,
    recorded,
    reference,
    row,
    write_experiment,
)

from pbdkit.errors import PbdkitError
from pbdkit.io import run_store as unfinished
from pbdkit.io.run_store import status_of

KINDS = tuple(EXPERIMENTS)
MOST_KILLS = 4
ACKNOWLEDGED = "acknowledged"
NUMBER = struct.Struct("<q")


def acknowledging(then: Callable[[], object] = often) -> Callable[[], None]:
    """Make a process record each step for which a commit returned, with one write."""

    def begin() -> None:
        then()
        before = unfinished.UnfinishedRun.keep
        note = os.open(ACKNOWLEDGED, os.O_WRONLY | os.O_CREAT | os.O_APPEND)

        def keep(self: Any, standing: Any, *rest: Any) -> None:
            before(self, standing, *rest)
            os.write(note, NUMBER.pack(standing.facts["step"]))

        unfinished.UnfinishedRun.keep = keep

    return begin


def dying(library: Any, at: int) -> None:
    """Make this process end at the n-th call on files in the current folder; the calls of SQLite
    within a commit count too."""
    arm(library, Path.cwd(), "kill", at)


class Trial:
    """One run in the current folder, killed and resumed until it has ended."""

    def __init__(
        self, library: Any, seed: str, whole: Path, seconds: float, parts: dict[str, Any]
    ) -> None:
        self.library, self.draw, self.seconds = library, random.Random(seed), seconds
        self.whole, self.found = whole, []
        self.kills = self.lost = self.unreadable = 0
        write_experiment(parts, Path.cwd())

    def run(self) -> list[str]:
        """Return the findings of the run."""
        command = ["run", "e.json", "-o", OUTPUT]
        while True:
            code, said = self.killed(*command)
            if code == 0:
                break
            if code != -signal.SIGKILL:
                self.found.append(f"{command[0]} ended with {code}: {said[-500:]}")
                break
            self.kills += 1
            command = self.looked_at(command)
            if not command:
                break
        if not self.found:
            self.found += differences(self.whole, Path(OUTPUT))
            if left := debris(Path.cwd(), OUTPUT, ACKNOWLEDGED):
                self.found.append(f"left behind: {left}")
        return self.found

    def killed(self, *command: str) -> tuple[int, str]:
        """Carries it out, and kills it on the way, but not for ever."""
        log, begin = Path("log"), acknowledging()
        slow = self.draw.random() < 0.15
        if slow:
            begin = acknowledging(lambda: (often(), network()))
        if self.kills >= MOST_KILLS or self.draw.random() < 0.1:
            return done(*command, log=log, before=begin)
        if self.draw.random() < 0.6:
            pid = called(*command, log=log, before=begin)
            time.sleep(self.draw.uniform(0.0, 1.1 * self.seconds))
            os.kill(pid, signal.SIGKILL)
            return ended(pid), log.read_text()
        number = int(10 ** self.draw.uniform(0.0, 2.7))
        return done(*command, log=log, before=lambda: (begin(), dying(self.library, number)))

    def looked_at(self, before: list[str]) -> list[str]:
        """Return the next command; compares the files with the acknowledged steps."""
        output = Path(OUTPUT)
        noted = Path(ACKNOWLEDGED).read_bytes() if Path(ACKNOWLEDGED).exists() else b""
        steps = [step for (step,) in NUMBER.iter_unpack(noted)]
        try:
            found = status_of(output)
            if output.exists() or found:
                self.compare(output, max(steps, default=-1), found)
            elif steps:
                self.lost += 1
                self.found.append(f"nothing is left, and {max(steps)} steps were acknowledged")
        except PbdkitError as error:
            self.unreadable += 1
            self.found.append(f"unreadable: {error}")
        if self.found:
            return []
        if output.exists() and not found:
            return self.finished()
        if found and self.draw.random() < 0.1:
            code, said = done("run", "e.json", "-o", OUTPUT, log=Path("log"))
            if code != 2 or ("resume" not in said and "exists" not in said):
                self.found.append(f"run over an unfinished one: {code}, {said}")
        return ["resume", OUTPUT] if found else ["run", "e.json", "-o", OUTPUT]

    def finished(self) -> list[str]:
        """Killed after all was done, or all but some removing, which any call does."""
        done("resume", OUTPUT, log=Path("log"))
        done("run", "e.json", "-o", "next.nc", log=Path("log"))
        Path("next.nc").unlink(missing_ok=True)
        self.found += differences(self.whole, Path(OUTPUT))
        if left := debris(Path.cwd(), OUTPUT, ACKNOWLEDGED):
            self.found.append(f"left behind: {left}")
        return []

    def compare(self, output: Path, acknowledged: int, found: dict[str, Any] | None) -> None:
        """Every record up to the last acknowledged step is there, and as it should be."""
        if found and found["step"] < acknowledged:
            self.lost += 1
            self.found.append(f"status says {found['step']}, {acknowledged} was acknowledged")
        times, positions = recorded(output)
        right_times, right = recorded(self.whole)
        wanted = right_times[right_times <= acknowledged]
        if missing := {*wanted.tolist()} - {*times.tolist()}:
            self.lost += len(missing)
            self.found.append(f"acknowledged and gone: {sorted(missing)}")
        both = np.isin(times, right_times)
        same = right[np.isin(right_times, times)]
        if positions[both].tobytes() != same.tobytes():
            self.unreadable += 1
            self.found.append("what was kept is not what the run recorded")


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    asked.add_argument("--trials", type=int, default=200)
    asked.add_argument("--seed", type=int, default=1)
    asked.add_argument("--only", type=int)
    asked.add_argument("--kinds", nargs="+", default=[*KINDS])
    given = asked.parse_args()
    library = load(__file__)
    print(f"seed {given.seed}")
    numbers = range(given.trials) if given.only is None else [given.only]
    failed, kills, lost, unreadable = tried(library, given.seed, numbers, given.kinds)
    row("kill -9: acknowledged records lost 0", f"{lost} in {len(numbers)} runs, {kills} kills")
    row("kill -9: unreadable runs 0", f"{unreadable} in {len(numbers)}")
    row("kill -9: resumed runs that differ in a bit 0", f"{failed} in {len(numbers)}")
    raise SystemExit(failed > 0)


def tried(library: Any, seed: int, numbers: Any, kinds: list[str]) -> tuple[int, int, int, int]:
    """Trials that found something, kills, records lost, runs unreadable."""
    failed = kills = lost = unreadable = 0
    here = Path.cwd()
    with tempfile.TemporaryDirectory() as name:
        wholes = {k: reference(EXPERIMENTS[k], Path(name, k)) for k in kinds}
        for number in numbers:
            kind = kinds[number % len(kinds)]
            folder = Path(name, str(number))
            folder.mkdir()
            os.chdir(folder)
            trial = Trial(library, f"{seed}/{number}", *wholes[kind], EXPERIMENTS[kind])
            for finding in trial.run():
                print(f"{number} ({kind}): {finding}", flush=True)
            failed, kills = failed + bool(trial.found), kills + trial.kills
            lost, unreadable = lost + trial.lost, unreadable + trial.unreadable
        os.chdir(here)
    return failed, kills, lost, unreadable


if __name__ == "__main__":
    main()
