"""Kill the workers of a sweep at random: ``python tests/reliability/sweep_under_fire.py``.

1000 small runs while 20 workers are killed. Goal: every member is there with the digest that it has
in an undisturbed process, and none is run again once it has been reported.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import pbdkit

SHEET = {
    "name": "sheet",
    "lattice": {"type": "square", "a": 1.0},
    "body": {"type": "grid", "columns": 6, "rows": 6},
    "rule": {"type": "barycentre"},
    "initial": {"type": "noise", "amplitude": 0.1},
    "leaders": [{"select": {"edge": "left"}, "motion": {"type": "hold"}}],
}
KEEP = {"variables": ["position"], "times": "last"}
WORKERS, PATIENCE_S = 4, 0.01


def children(pid: int) -> list[int]:
    """The workers of a sweep: those of its children that have loaded pbdkit's program."""
    found = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        found += [int(child) for child in task.read_text().split()]
    return [
        child for child in found if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()
    ]


def digests(folder: Path) -> Counter[tuple[str, str, bytes]]:
    """Return the members that a store contains, and how often it contains each."""
    database = sqlite3.connect(f"file:{folder / 'sweep.sqlite'}?mode=ro", uri=True)
    with closing(database):
        rows = database.execute("SELECT key, status, digest FROM member").fetchall()
    return Counter(rows)


def held(folder: Path) -> int:
    """Return the number of members in a store; 0 if there is none."""
    try:
        return digests(folder).total()
    except sqlite3.OperationalError:
        return 0


def under_fire(
    folder: Path, members: int, kills: int, workers: int, steps: int = 1000
) -> dict[str, Any]:
    """Sweeps twice, disturbed and not; what came of it."""
    chance, vary = random.Random(0), {"seed": list(range(members))}
    sheet = SHEET | {"steps": steps}
    sweep = {"version": 1, "experiment": sheet, "vary": vary, "keep": KEEP}
    path = folder / "sweep.json"
    path.write_text(json.dumps(sweep))
    line = [sys.executable, "-m", "pbdkit", "sweep", str(path), "-o", str(folder / "fire")]
    running = subprocess.Popen([*line, "--workers", str(workers), "--quiet"])
    killed, due = 0, sorted(chance.sample(range(members // 2), kills))
    while running.poll() is None and killed < kills:
        time.sleep(chance.uniform(0, 2 * PATIENCE_S))
        if held(folder / "fire") < due[killed]:
            continue
        with suppress(IndexError, OSError):  # there is none just now
            os.kill(chance.choice(children(running.pid)), signal.SIGKILL)
            killed += 1
    code = running.wait()
    pbdkit.sweep(sheet, vary=vary, keep=KEEP, folder=folder / "calm", workers=1, progress=False)
    disturbed, calm = digests(folder / "fire"), digests(folder / "calm")
    return {
        "exit": code,
        "killed": killed,
        "right": len(disturbed.keys() & calm.keys()),
        "wrong": len(disturbed.keys() - calm.keys()),
        "run again": disturbed.total() - len(disturbed),
    }


def main() -> None:
    """Prints goal and measured."""
    with tempfile.TemporaryDirectory() as folder:
        found = under_fire(Path(folder), members=1000, kills=20, workers=WORKERS)
    goal = {"exit": 0, "killed": 20, "right": 1000, "wrong": 0, "run again": 0}
    for what, wanted in goal.items():
        print(f"{what:<10} goal {wanted:>5}  measured {found[what]:>5}")
    sys.exit(found != goal)


if __name__ == "__main__":
    main()
