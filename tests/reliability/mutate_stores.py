"""Stores of unfinished runs that were changed: flipped bits, cut, zeroed, swapped, rows of others.

    python tests/reliability/mutate_stores.py [--trials N] [--seed S] [--only NUMBER]

Each is asked for its status, opened with all its values, drawn, and gone on with. Each call ends in
a documented error or gives what the unchanged one gives, soon, and touches nothing but the output.
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
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.pyplot  # noqa: F401  # the children find it loaded
import numpy as np
from trials import (
    EXPERIMENTS,
    OUTPUT,
    called,
    differences,
    done,
    ended,
    recorded,
    reference,
    row,
    started,
    write_experiment,
)

import pbdkit
from pbdkit import cli
from pbdkit.errors import PbdkitError
from pbdkit.storage import run_store

KINDS = ("breaking", "settling", "increments", "large")
DOCUMENTED = (0, 2, 3, 4, 6)
PATIENCE_S = 20.0
BLOCK = 512


def unfinished(kind: str, folder: Path) -> None:
    """A run that was killed after some commits, in a folder of its own."""
    folder.mkdir()
    os.chdir(folder)
    write_experiment(EXPERIMENTS[kind], folder)
    wait_s = 0.15
    while True:
        pid = called("run", "e.json", "-o", OUTPUT, log=Path("log"))
        end = time.monotonic() + 20.0
        while not Path(OUTPUT + ".run-wal").exists() and time.monotonic() < end:
            time.sleep(0.002)
        time.sleep(wait_s)
        os.kill(pid, signal.SIGKILL)
        ended(pid)
        if done("status", OUTPUT, log=Path("log"))[0] == 0:
            return
        wait_s *= 0.5 if Path(OUTPUT).exists() else 1.5  # it was done already, or had hardly begun
        for path in folder.glob("*out.nc*"):
            path.unlink()


def flip(draw: random.Random, data: bytearray) -> None:
    for _ in range(draw.choice([1, 1, 3, 50])):
        data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)


def cut(draw: random.Random, data: bytearray) -> None:
    del data[draw.randrange(len(data)) :]


def zero(draw: random.Random, data: bytearray) -> None:
    at = draw.randrange(0, len(data), BLOCK)
    length = min(len(data) - at, BLOCK * draw.choice([1, 8, 64]))
    data[at : at + length] = bytes(length)


def swap(draw: random.Random, data: bytearray) -> None:
    size = draw.choice([BLOCK, 4096])
    one, two = (draw.randrange(0, max(1, len(data) - size), size) for _ in range(2))
    data[one : one + size], data[two : two + size] = (
        data[two : two + size],
        data[one : one + size],
    )


def lengthen(draw: random.Random, data: bytearray) -> None:
    data += draw.randbytes(draw.choice([1, 4096]))


def damage_file(draw: random.Random, others: list[Path]) -> str:
    path = draw.choice(sorted(p for p in Path.cwd().glob(OUTPUT + ".run*") if p.stat().st_size))
    how = draw.choice([flip, flip, cut, zero, swap, lengthen])
    data = bytearray(path.read_bytes())
    how(draw, data)
    path.write_bytes(data)
    return f"{how.__name__} {path.name}"


def remove_file(draw: random.Random, others: list[Path]) -> str:
    path = draw.choice(sorted(Path.cwd().glob(OUTPUT + ".run*")))
    path.unlink()
    return f"removed {path.name}"


def of_other(draw: random.Random, others: list[Path]) -> str:
    other = draw.choice(others)
    path = draw.choice(sorted(other.glob(OUTPUT + ".run*")))
    shutil.copy(path, path.name)
    return f"other run's {path.name}"


def rows(draw: random.Random, others: list[Path]) -> str:
    """Rows with their digests right, as somebody would write them who knows how."""
    with sqlite3.connect(OUTPUT + ".run") as file:
        table = dict(file.execute("SELECT key, data FROM pieces").fetchall())
        key = draw.choice(sorted(table))
        with sqlite3.connect(others[0] / (OUTPUT + ".run")) as other:
            theirs = dict(other.execute("SELECT key, data FROM pieces").fetchall())
        choices: list[bytes | None] = [None, b"", b"{}", b"[" * 100_000, b"1e999", table[key][:-1]]
        choices += [theirs.get(key), theirs[draw.choice(sorted(theirs))], bytes(len(table[key]))]
        data = draw.choice(choices)
        if draw.random() < 0.5:
            key, data = draw.choice(["about", "facts", "file"]), None
        if data is None and key in ("about", "facts", "file"):
            data = changed_fact(draw, table[key].decode()).encode()
        if data is None:
            file.execute("DELETE FROM pieces WHERE key = ?", (key,))
        else:
            digest = run_store._digest(key, data)
            file.execute("REPLACE INTO pieces VALUES (?, ?, ?)", (key, data, digest))
    file.close()
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
    """What SQLite would carry out, or write elsewhere."""
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
    with sqlite3.connect(OUTPUT + ".run") as file:
        if what == "trigger":
            sql = "CREATE TRIGGER t AFTER INSERT ON pieces BEGIN DELETE FROM pieces; END"
            file.execute(sql)
        elif what == "view":
            file.execute("ALTER TABLE pieces RENAME TO p")
            file.execute("CREATE VIEW pieces AS SELECT key, zeroblob(1e9) data, digest FROM p")
        elif what == "attach":
            file.execute("CREATE TABLE more (x DEFAULT (load_extension('precious')))")
        else:
            about = file.execute("SELECT data FROM pieces WHERE key = 'about'").fetchone()[0]
            data = about.replace(b'"format": "2"', b'"format": "3"')
            digest = run_store._digest("about", data)
            file.execute("REPLACE INTO pieces VALUES ('about', ?, ?)", (data, digest))
    file.close()
    return what


HOW: list[Callable[[random.Random, list[Path]], str]] = [
    *[damage_file] * 8,
    *[rows] * 4,
    remove_file,
    of_other,
    hostile,
]


def read_all() -> None:
    """Every value, and a picture."""
    for name, values in zip(("times", "positions"), recorded(Path(OUTPUT)), strict=True):
        np.save(f"{name}.npy", values)
    with pbdkit.open(OUTPUT) as dataset:
        dataset.load()
    cli.main(["plot", OUTPUT, "-o", "picture.png"])


def tried(whole: Path, others: list[Path], seed: str) -> list[str]:
    """What is wrong with how a changed copy in the current folder is dealt with."""
    draw = random.Random(seed)
    precious = Path("precious")
    precious.write_bytes(b"not yours")
    how = draw.choice(HOW)(draw, others)
    found, told = [], how.startswith(("row", "other"))  # then it is another run, or says it is
    for name, call in (
        ("status", ["status", OUTPUT]),
        ("open", None),
        ("resume", ["resume", OUTPUT]),
    ):
        begun, log = time.monotonic(), Path(f"log-{name}")
        pid = called(*call, log=log) if call else started(reading, log)
        code, said = ended(pid), log.read_text(errors="replace")
        if code == -1000 or time.monotonic() - begun > PATIENCE_S:
            found.append(f"{name} hung")
        elif code not in DOCUMENTED or "Traceback" in said:
            found.append(f"{name} ended with {code}: {said[-1500:]}")
        elif name == "open" and code == 0 and not told and is_other(whole):
            found.append("what was read is not what the run recorded, and nothing said")
        elif name == "resume" and code == 0 and not told and (wrong := result_is_other(whole)):
            found.append(f"gone on with to another result: {wrong}")
    if not precious.exists() or precious.read_bytes() != b"not yours":
        found.append("touched another file")
    return [f"{how}: {finding}" for finding in found]


def is_other(whole: Path) -> bool:
    """Whether what `read_all` saw is not what the run records; an earlier commit is."""
    times, positions = np.load("times.npy"), np.load("positions.npy")
    right_times, right = recorded(whole)
    both = np.isin(times, right_times)
    same = right[np.isin(right_times, times)].tobytes() == positions[both].tobytes()
    return not same or not both[:-1].all()


def result_is_other(whole: Path) -> list[str]:
    """In what the result differs, if it is there."""
    return differences(whole, Path(OUTPUT)) if Path(OUTPUT).exists() else ["there is none"]


def reading() -> None:
    """`read_all`, with errors told as the program does."""
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
    failed = all_tried(given.seed, numbers, given.kinds)
    row("changed stores: crash 0, hang 0, silent difference 0", f"{failed} in {len(numbers)}")
    raise SystemExit(failed > 0)


def all_tried(seed: int, numbers: Any, kinds: list[str]) -> int:
    """With how many something was wrong."""
    failed, here = 0, Path.cwd()
    with tempfile.TemporaryDirectory() as name:
        base = Path(name)
        wholes = {kind: reference(EXPERIMENTS[kind], base / f"whole-{kind}")[0] for kind in kinds}
        for kind in kinds:
            unfinished(kind, base / kind)
        for number in numbers:
            kind = kinds[number % len(kinds)]
            folder = base / str(number)
            shutil.copytree(base / kind, folder)
            os.chdir(folder)
            others = [base / other for other in kinds if other != kind] or [base / kind]
            found = tried(wholes[kind], others, f"{seed}/{number}")
            for finding in found:
                print(f"{number} ({kind}): {finding}", flush=True)
            failed += bool(found)
            os.chdir(here)
            shutil.rmtree(folder)
    return failed


if __name__ == "__main__":
    main()
