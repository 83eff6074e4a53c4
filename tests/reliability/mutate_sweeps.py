"""Rerun sweeps in damaged folders: bits flipped, files cut, zeroed, swapped, missing, or put
together from two sweeps or from two moments of one sweep.

    python tests/reliability/mutate_sweeps.py [--trials N] [--seed S] [--only NUMBER]

The same command is run again. It ends in a documented error, or writes the dataset of an undamaged
folder, to the bit. Every stored member is still stored, is reported, or lies untouched in a folder
aside; and the command after that finds all members stored and prints no message.
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
from collections import Counter
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
from damage import damage
from trials import done, row

import pbdkit
import pbdkit.cli.sweep
import pbdkit.sweeps.execute
from pbdkit.cli import main as main_of_pbdkit
from pbdkit.io import sqlite_file
from pbdkit.sweeps import store

EXPERIMENT = {
    "name": "tiny",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "grid", "columns": 6, "rows": 4},
    "rule": {"type": "barycentre"},
    "leaders": [
        {"select": {"edge": "left"}, "motion": {"type": "hold"}},
        {
            "select": {"edge": "right"},
            "motion": {"type": "velocity", "velocity": [0.1, 0.0], "steps": 10},
        },
    ],
    "steps": 20,
    "solver": {"type": "stepping", "engine": "numpy"},
    "diagnostics": [{"type": "pe1"}],
}
KEEP = {"variables": ["pe1", "position"], "times": "last"}
RELAXATIONS = [0.4, 0.5, 0.6, 0.7, 0.8]
COMMAND = ["sweep", "s.json", "-o", "s", "--workers", "1"]
LARGE_BYTES = 1700
"""Larger members are files here: those of more particles."""
DATABASE = store.DATABASE
KINDS = ("finished", "killed", "network")


def small() -> None:
    """In a process: what is larger than a few hundred bytes is a file beside the database, and each
    member is committed when it is there."""
    store.LARGE_BYTES, store.COMMIT_S = LARGE_BYTES, 0.0


def network() -> None:
    """Takes the disk for one of another machine: no write-ahead log."""
    small()
    sqlite_file.is_local = lambda path: False


def dying(members: int, begin: Callable[[], None]) -> Callable[[], None]:
    """Make a process end once a number of members is stored."""

    def begin_to_die() -> None:
        begin()
        put, left = store.Store.put, [members]

        def putting(*args: Any) -> None:
            put(*args)
            left[0] -= 1
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)

        store.Store.put = putting  # type: ignore[method-assign]

    return begin_to_die


def write_sweep(folder: Path, velocity: float, relaxations: list[float]) -> None:
    """The sweep as a file."""
    experiment = json.loads(json.dumps(EXPERIMENT))
    experiment["leaders"][1]["motion"]["velocity"][0] = velocity
    vary = {"solver.relaxation": relaxations, "body.columns": [6, 9]}
    sweep = {"version": 1, "experiment": experiment, "vary": vary, "keep": KEEP}
    (folder / "s.json").write_text(json.dumps(sweep))


def prepared(kind: str, folder: Path, velocity: float) -> None:
    """Make a folder with a sweep that is finished, or was killed after seven of ten members; and
    its state after three, under `earlier`. The command there runs eight members."""
    folder.mkdir()
    os.chdir(folder)
    begin = network if kind == "network" else small
    write_sweep(folder, velocity, RELAXATIONS)
    called(dying(3, begin), -signal.SIGKILL)
    shutil.copytree("s", "earlier")
    if kind == "finished":
        called(begin, 0)
    else:
        called(dying(4, begin), -signal.SIGKILL)
    write_sweep(folder, velocity, RELAXATIONS[1:])


def called(before: Callable[[], None], code: int) -> str:
    """Return the output of the command, which must end with that code."""
    found, said = done(*COMMAND, log=Path("log"), before=before)
    assert found == code, said
    return said


def content(path: Path) -> dict[str, Any]:
    """Return all content of a dataset, except the time of its creation."""
    with pbdkit.open(path) as dataset:
        found: dict[str, Any] = {"": {k: v for k, v in dataset.attrs.items() if k != "created"}}
        for name, variable in dataset.variables.items():
            values = np.asarray(variable.values)
            kept = values.tolist() if values.dtype.kind in "OU" else values.tobytes()
            attributes = {k: np.asarray(v).tolist() for k, v in variable.attrs.items()}
            found[str(name)] = (variable.dims, kept, attributes)
        return found


def held(path: Path) -> set[tuple[Any, ...]]:
    """Keys and digests in a sound database."""
    with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as database:
        return {*database.execute("SELECT key, digest FROM member")}


def files(folder: Path) -> dict[str, bytes]:
    """Return the files of the database."""
    paths = folder.glob(DATABASE + "*")
    return {p.name: p.read_bytes() for p in paths if not p.name.endswith("-shm")}


def damage_file(draw: random.Random, others: list[Path]) -> str:
    names = [f"{DATABASE}*"] * 3 + ["members/*", "lock", "*"]
    found = [p for p in Path("s").glob(draw.choice(names)) if p.is_file() and p.stat().st_size]
    path = draw.choice(sorted(found) or [Path("s", DATABASE)])
    return f"{damage(draw, path)} {path}"


def damage_two(draw: random.Random, others: list[Path]) -> str:
    return f"{damage_file(draw, others)}, {damage_file(draw, others)}"


def remove_file(draw: random.Random, others: list[Path]) -> str:
    path = draw.choice(sorted(p for p in Path("s").rglob("*") if p.is_file()))
    path.unlink()
    return f"removed {path}"


def of_other(draw: random.Random, others: list[Path]) -> str:
    other = draw.choice(others)
    path = draw.choice(sorted(p for p in other.rglob("*") if p.is_file()))
    target = Path("s", path.relative_to(other))
    if target.parent.name == "members" and draw.random() < 0.5:
        target = draw.choice(sorted(Path("s", "members").iterdir()))
    shutil.copy(path, target)
    return f"{target} of {path.relative_to(other.parent.parent)}"


HOW = [*[damage_file] * 7, *[damage_two] * 2, remove_file, *[of_other] * 3]


def tried(kind: str, right: dict[str, Any], base: Path, others: list[Path], seed: str) -> Any:
    """Return the outcome of the command on a damaged copy in the current folder, and its faults."""
    draw = random.Random(seed)
    before = held(base / "s" / DATABASE)
    how = draw.choice(HOW)(draw, others)
    if how.startswith(f"s/{DATABASE} of"):  # a whole one, which holds what it holds
        before = set()
    damaged, found = files(Path("s")), []
    begin = network if kind == "network" else small
    code, said = done(*COMMAND, log=Path("log"), before=begin)
    outcome = "right, and said so" if "warning:" in said else "right"
    if code != 0:
        outcome = "named"
        if code not in (2, 6) or "Traceback" in said:
            found.append(f"ended with {code}: {said[-1500:]}")
        if files(Path("s")) != damaged:
            found.append("refused, and changed")
        return outcome, [f"{how}: {finding}" for finding in found]
    if (now := content(Path("s/sweep.nc"))) != right:
        found.append(f"other values: {[k for k in now | right if now.get(k) != right.get(k)]}")
    missing = before - held(Path("s", DATABASE))
    aside = Path("s", "set-aside-1")
    if missing and not aside.exists() and said.count("it runs again") < len(missing):
        found.append(f"{len(missing)} members of other sweeps are gone: {said}")
    if aside.exists() and files(aside) != {n: b for n, b in damaged.items() if ".new" not in n}:
        found.append(f"what was set aside is not what was there: {said}")
    code, said = done(*COMMAND, log=Path("log"), before=begin)
    if code or "warning" in said or "0 run now, 8 stored before" not in said:
        found.append(f"the next call: {code}, {said[-1500:]}")
    elif content(Path("s/sweep.nc")) != right:
        found.append("the next call: other values")
    return outcome, [f"{how}: {finding}" for finding in found]


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    asked.add_argument("--trials", type=int, default=300)
    asked.add_argument("--seed", type=int, default=1)
    asked.add_argument("--only", type=int)
    given = asked.parse_args()
    numbers = range(given.trials) if given.only is None else [given.only]
    outcomes = all_tried(given.seed, numbers)
    failed = outcomes.pop("failed", 0)
    told = ", ".join(f"{count} {outcome}" for outcome, count in outcomes.most_common())
    goal = "damaged folders of sweeps: wrong values, crashes, members lost unsaid: 0"
    row(goal, f"{failed} in {len(numbers)}: {told}")
    raise SystemExit(failed > 0)


def all_tried(seed: int, numbers: Any) -> Counter[str]:
    """Return the outcomes of the trials; `failed` are those with faults."""
    outcomes, here = Counter[str](), Path.cwd()
    with tempfile.TemporaryDirectory() as name:
        base, whole = Path(name), Path(name, "whole")
        whole.mkdir()
        os.chdir(whole)
        write_sweep(whole, 0.1, RELAXATIONS[1:])
        with suppress(SystemExit):  # so that the processes that are forked find all modules loaded
            main_of_pbdkit([*COMMAND, "--quiet"])
        for kind in sorted({KINDS[number % len(KINDS)] for number in numbers}):
            prepared(kind, base / kind, 0.1)
            prepared(kind, base / f"twin-{kind}", 0.101)
        right = content(whole / "s" / "sweep.nc")
        for number in numbers:
            kind = KINDS[number % len(KINDS)]
            folder = base / str(number)
            shutil.copytree(base / kind, folder, ignore=shutil.ignore_patterns("earlier"))
            os.chdir(folder)
            others = [base / f"twin-{kind}" / "s", base / kind / "earlier", whole / "s"]
            outcome, found = tried(kind, right, base / kind, others, f"{seed}/{number}")
            for finding in found:
                print(f"{number} ({kind}): {finding}", flush=True)
            outcomes["failed" if found else outcome] += 1
            os.chdir(here)
            shutil.rmtree(folder)
    return outcomes


if __name__ == "__main__":
    main()
