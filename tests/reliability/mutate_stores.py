"""Read and resume damaged stores of unfinished runs: bits flipped, files cut, zeroed, swapped,
missing, or put together from two runs or from two moments of one run.

    python tests/reliability/mutate_stores.py [--trials N] [--seed S] [--only NUMBER]

The status of each is read, it is opened with all its values, some are drawn, and some run again
without --force; then it is resumed. Each call ends in a documented error or has the result of the
undamaged store, to the bit, and soon. No file is changed or removed where the damage is refused:
with the undamaged files in the place of the damaged ones the run is resumed to the right result.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import sqlite3
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.pyplot  # noqa: F401  # the children find it loaded
import numpy as np
from damage import damage
from trials import (
    EXPERIMENTS,
    OUTPUT,
    called,
    differences,
    done,
    ended,
    often,
    recorded,
    reference,
    row,
    started,
    warm_up,
    write_experiment,
)

import pbdkit
from pbdkit.errors import PbdkitError
from pbdkit.io.run_store import RunStore, UnfinishedRun, store_of
from pbdkit.io.sinks import OverlappingSink

KINDS = ("breaking", "settling", "increments", "large")
DOCUMENTED = (0, 2, 3, 4, 6)
PATIENCE_S = 20.0


def unfinished(parts: dict[str, Any], folder: Path) -> None:
    """A run that was killed after some commits, in a folder of its own; beside it, under `earlier`,
    what there was of it some commits before."""
    folder.mkdir()
    os.chdir(folder)
    write_experiment(parts, folder)
    for command, commits in ((["run", "e.json", "-o", OUTPUT], 2), (["resume", OUTPUT], 3)):
        code, said = done(*command, log=Path("log"), before=dying(commits))
        assert code == -signal.SIGKILL, said
        if commits == 2:
            shutil.copytree(folder, folder / "earlier")


def dying(commits: int) -> Callable[[], None]:
    """Make a process commit whenever it can, and end after a number of commits."""

    def begin() -> None:
        often()
        OverlappingSink.due = lambda self: True  # type: ignore[method-assign]
        keep, left = UnfinishedRun.keep, [commits]

        def keeping(*args: Any) -> None:
            keep(*args)
            left[0] -= 1
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)

        UnfinishedRun.keep = keeping  # type: ignore[method-assign]

    return begin


def damage_file(draw: random.Random, others: list[Path]) -> str:
    path = draw.choice(sorted(p for p in Path.cwd().glob(OUTPUT + ".run*") if p.stat().st_size))
    return f"{damage(draw, path)} {path.name}"


def damage_two(draw: random.Random, others: list[Path]) -> str:
    return f"{damage_file(draw, others)}, {damage_file(draw, others)}"


def remove_file(draw: random.Random, others: list[Path]) -> str:
    path = draw.choice(sorted(Path.cwd().glob(OUTPUT + ".run*")))
    path.unlink()
    return f"removed {path.name}"


def of_other(draw: random.Random, others: list[Path]) -> str:
    other = draw.choice(others)
    path = draw.choice(sorted(other.glob(OUTPUT + ".run*")))
    shutil.copy(path, path.name)
    return f"{path.name} of {other.name}"


def rows(draw: random.Random, others: list[Path]) -> str:
    """Change rows and their digests, as a deliberate forgery would, and return a description."""
    with RunStore(store_of(Path(OUTPUT))) as store, RunStore(store_of(others[0] / OUTPUT)) as other:
        table = {key: store.piece(key) for key in store.keys("")}
        theirs = {key: other.piece(key) for key in other.keys("")}
    key = draw.choice(sorted(table))
    choices: list[bytes | None] = [None, b"", b"{}", b"[" * 100_000, b"1e999", table[key][:-1]]
    choices += [theirs.get(key), theirs[draw.choice(sorted(theirs))], bytes(len(table[key]))]
    data = draw.choice(choices)
    if draw.random() < 0.5:
        key = draw.choice(["about", "facts", "file"])
        data = changed_fact(draw, table[key].decode()).encode()
    with RunStore(store_of(Path(OUTPUT)), mode="rw") as store:
        store.commit([] if data is None else [(key, data)], [key])
    return f"row {key}: {str(data)[:60]}"


def changed_fact(draw: random.Random, text: str) -> str:
    """One number or word of it is another."""
    facts = json.loads(text)
    place: Any = facts
    while True:
        keys = [*place] if isinstance(place, dict) else [*range(len(place))]
        key = draw.choice(keys)
        if not isinstance(place[key], dict | list) or not place[key] or draw.random() < 0.2:
            break
        place = place[key]
    values = [None, -1, 0, 1, 2**40, 10**400, 1e308, float("nan"), float("inf"), "x", [], {}, True]
    place[key] = draw.choice([*values, {"array": "run.u"}, {"is": "State"}, [2**62, 2**62]])
    return json.dumps(facts)


def hostile(draw: random.Random, others: list[Path]) -> str:
    """Add content that SQLite would execute, or write elsewhere."""
    what = draw.choice(["trigger", "view", "journal", "attach", "newer"])
    if what == "journal":  # one that names a file to be removed once it is rolled back
        name = str(Path("precious").absolute()).encode()
        magic = bytes.fromhex("d9d505f920a163d7")
        header = magic + (0).to_bytes(4, "big") * 3 + (512).to_bytes(4, "big")
        header += (4096).to_bytes(4, "big")
        tail = (1).to_bytes(4, "big") + name + len(name).to_bytes(4, "big")
        tail += (sum(name)).to_bytes(4, "big") + magic
        Path(OUTPUT + ".run-journal").write_bytes(header.ljust(512, b"\0") + tail)
        return what
    if what == "newer":
        with RunStore(store_of(Path(OUTPUT)), mode="rw") as store:
            about = store.facts("about") | {"format": "4"}
            store.commit([("about", json.dumps(about).encode())])
        return what
    with sqlite3.connect(OUTPUT + ".run") as file:
        if what == "trigger":
            sql = "CREATE TRIGGER t AFTER INSERT ON pieces BEGIN DELETE FROM pieces; END"
            file.execute(sql)
        elif what == "view":
            file.execute("ALTER TABLE pieces RENAME TO p")
            file.execute("CREATE VIEW pieces AS SELECT key, zeroblob(1e9) data, digest FROM p")
        else:
            file.execute("CREATE TABLE more (x DEFAULT (load_extension('precious')))")
    file.close()
    return what


HOW: list[Callable[[random.Random, list[Path]], str]] = [
    *[damage_file] * 8,
    *[damage_two] * 2,
    *[remove_file] * 2,
    *[of_other] * 3,
    *[rows] * 2,
    hostile,
]
BY_DESIGN = (rows, hostile)
"""Forgeries of a store: it may be another run, and is not repaired."""


def read_all() -> None:
    """Read every value of the store."""
    for name, values in zip(("times", "positions"), recorded(Path(OUTPUT)), strict=True):
        np.save(f"{name}.npy", values)
    with pbdkit.open(OUTPUT) as dataset:
        dataset.load()


class Trial:
    """A damaged copy of an unfinished run in the current folder, and how it is dealt with."""

    def __init__(self, whole: Path, base: Path, others: list[Path], seed: str) -> None:
        self.whole, self.base, self.draw = whole, base, random.Random(seed)
        self.found: list[str] = []
        self.outcome = ""
        Path("precious").write_bytes(b"not yours")
        how = self.draw.choice(HOW)
        self.by_design = how in BY_DESIGN
        self.how = how(self.draw, others)
        self.files = files()

    def run(self) -> list[str]:
        """Return the faults of the trial."""
        looks = [("status", ["status", OUTPUT]), ("open", None)]
        if self.draw.random() < 0.1:
            looks.append(("plot", ["plot", OUTPUT, "-o", "picture.png"]))
        for name, call in looks:
            code, _ = self.call(name, call)
            if files() != self.files:
                self.found.append(f"{name} changed {changed(self.files, files())}")
            if name == "open" and code == 0 and not self.by_design and is_other(self.whole):
                self.found.append("what was read is not what the run recorded, and nothing said")
        code, said = self.call("resume", ["resume", OUTPUT])
        if code == 0:
            self.outcome = "gone on with"
            if not self.by_design and (wrong := result_is_other(self.whole)):
                self.found.append(f"gone on with to another result: {wrong}")
        elif "there is neither an unfinished run" in said:
            self.found.append(f"forgotten: {said}")
        else:
            self.outcome = "named"
            self.refused(said)
        precious = Path("precious")
        if not precious.exists() or precious.read_bytes() != b"not yours":
            self.found.append("touched another file")
        return [f"{self.how}: {finding}" for finding in self.found]

    def call(self, name: str, call: list[str] | None) -> tuple[int, str]:
        """One command, or the reading of all."""
        begun, log = time.monotonic(), Path(f"log-{name}")
        pid = called(*call, log=log) if call else started(reading, log)
        code, said = ended(pid), log.read_text(errors="replace")
        if code == -1000 or time.monotonic() - begun > PATIENCE_S:
            self.found.append(f"{name} hung")
        elif code not in DOCUMENTED or "Traceback" in said:
            self.found.append(f"{name} ended with {code}: {said[-1500:]}")
        return code, said

    def refused(self, said: str) -> None:
        """After `resume` has refused it."""
        if gone := {*self.files} - {*files()} - {OUTPUT + ".run-wal"}:
            self.found.append(f"resume removed {sorted(gone)}")
        if self.by_design:
            return
        if self.draw.random() < 0.25:
            before = files()
            code, told = self.call("run", ["run", "e.json", "-o", OUTPUT])
            if code == 0 or files() != before:
                what = f"changed {changed(before, files())}"
                self.found.append(f"run ended with {code}, {what}: {told}")
        if "--anyway continues from the last commit" in said:
            self.outcome = "named, gone on with on request"
            code, told = self.call("anyway", ["resume", OUTPUT, "--anyway"])
            if code == 0 and (wrong := result_is_other(self.whole)):
                self.found.append(f"gone on with anyway to another result: {wrong}")
            if code:
                self.outcome = "named"
        if not Path(OUTPUT).exists():
            self.put_right()

    def put_right(self) -> None:
        """Restore the damaged files, and keep all else as the commands left it."""
        for path in Path.cwd().glob(OUTPUT + ".run*"):
            if path.name not in {p.name for p in self.base.iterdir()}:
                path.unlink()
        for path in self.base.glob(OUTPUT + ".run*"):
            if self.files.get(path.name) != path.read_bytes():
                shutil.copy(path, path.name)
        code, said = self.call("resume again", ["resume", OUTPUT])
        if code or (wrong := result_is_other(self.whole)):
            said = said if code else str(wrong)
            self.found.append(f"with the undamaged files again: {code}, {said[-500:]}")


def files() -> dict[str, bytes]:
    """Return all files of the run, except empty files and the memory that SQLite shares."""
    paths = [*Path.cwd().glob(OUTPUT + "*"), *Path.cwd().glob(f".{OUTPUT}.*")]
    found = {path.name: path.read_bytes() for path in paths if not path.name.endswith("-shm")}
    return {name: data for name, data in found.items() if data}


def changed(before: dict[str, bytes], now: dict[str, bytes]) -> list[str]:
    """The names of what is not as it was."""
    return sorted(name for name in before | now if before.get(name) != now.get(name))


def is_other(whole: Path) -> bool:
    """Return whether the values that `read_all` read are not those that the run records; an earlier
    commit is."""
    times, positions = np.load("times.npy"), np.load("positions.npy")
    right_times, right = recorded(whole)
    both = np.isin(times, right_times)
    same = right[np.isin(right_times, times)].tobytes() == positions[both].tobytes()
    return not same or not both[:-1].all()


def result_is_other(whole: Path) -> list[str]:
    """In what the result differs, if it is there."""
    return differences(whole, Path(OUTPUT)) if Path(OUTPUT).exists() else ["there is none"]


def reading() -> None:
    """Call `read_all`, with errors printed as the program does."""
    try:
        read_all()
    except PbdkitError as error:
        print(error)
        raise SystemExit(error.exit_status) from None


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    asked.add_argument("--trials", type=int, default=1000)
    asked.add_argument("--seed", type=int, default=1)
    asked.add_argument("--only", type=int)
    asked.add_argument("--kinds", nargs="+", default=[*KINDS])
    given = asked.parse_args()
    numbers = range(given.trials) if given.only is None else [given.only]
    outcomes = all_tried(given.seed, numbers, given.kinds)
    failed = outcomes.pop("failed", 0)
    told = ", ".join(f"{count} {outcome}" for outcome, count in outcomes.most_common())
    goal = "damaged stores: crash, hang, silent difference, changed or removed while refused: 0"
    row(goal, f"{failed} in {len(numbers)}: {told}")
    raise SystemExit(failed > 0)


def twin(parts: dict[str, Any]) -> dict[str, Any]:
    """Return the same experiment pulled a little faster: every piece has the same key and size."""
    found: dict[str, Any] = json.loads(json.dumps(parts))
    found["leaders"][1]["motion"]["velocity"][0] *= 1.01
    return found


def all_tried(seed: int, numbers: Any, kinds: list[str]) -> Counter[str]:
    """Return the outcomes of the trials; `failed` are those with faults."""
    outcomes, here = Counter[str](), Path.cwd()
    with tempfile.TemporaryDirectory() as name:
        base = Path(name)
        warm_up(base / "warm")
        wholes = {kind: reference(EXPERIMENTS[kind], base / f"whole-{kind}")[0] for kind in kinds}
        for kind in kinds:
            unfinished(EXPERIMENTS[kind], base / kind)
            unfinished(twin(EXPERIMENTS[kind]), base / f"twin-{kind}")
        for number in numbers:
            kind = kinds[number % len(kinds)]
            folder = base / str(number)
            shutil.copytree(base / kind, folder, ignore=shutil.ignore_patterns("earlier"))
            os.chdir(folder)
            others = [base / f"twin-{kind}", base / kind / "earlier"]
            others += [base / other for other in kinds if other != kind]
            trial = Trial(wholes[kind], base / kind, others, f"{seed}/{number}")
            found = trial.run()
            for finding in found:
                print(f"{number} ({kind}): {finding}", flush=True)
            outcomes["failed" if found else trial.outcome] += 1
            os.chdir(here)
            shutil.rmtree(folder)
    return outcomes


if __name__ == "__main__":
    main()
