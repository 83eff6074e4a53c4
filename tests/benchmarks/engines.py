"""Engines, precisions and threads at sizes, by `pbdkit bench` itself; threads; the limit."""

from __future__ import annotations

import json
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bare import Copying, sweeping
from pairing import best_in_turns, ratio, wait_for_quiet
from sheets import DAMAGE, DISTANCE, FRACTURE, RULES, SWUNG, Running, moving

from pbdkit.bench.work_precision import measure

STEPS = {10: 4000, 100: 400, 1000: 20}
SHEETS = {
    "barycentre": ({}, (10, 100, 1000)),
    "distance-weighted": (DISTANCE, (100, 1000)),
    "barycentre with fracture": (FRACTURE, (100, 1000)),
}
WITH = {"": {}, "memory": SWUNG, "fracture": FRACTURE, "damage": DAMAGE}


def engines() -> list[dict[str, Any]]:
    """The measurements of `pbdkit bench` on sheets in which everything moves."""
    found: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for rule, (parts, sizes) in SHEETS.items():
            path = Path(folder) / "sheet.json"
            path.write_text(json.dumps(moving(10, **parts)))
            for size in sizes:
                steps = (f"steps={STEPS[size]}",)
                rows = measure(str(path), steps, size, lambda _: None)
                found += [{"rule": rule} | asdict(row) for row in rows if not row.reason]
    return found


def threads() -> list[dict[str, Any]]:
    """Two threads against one."""
    found = []
    for size, steps in ((30, 200), (100, 200), (300, 100), (1000, 20), (3000, 3)):
        for rule, parts in (("barycentre", {}), ("distance-weighted", DISTANCE)):
            one, two = (Running(moving(size, **parts), steps, threads=n) for n in (1, 2))
            wait_for_quiet()
            r = ratio(one, two, 15)
            ns = [seconds * 1e9 / steps / size**2 for seconds in (r.first_s, r.second_s)]
            found.append({"size": size, "rule": rule, "one_ns": ns[0], "two_ns": ns[1]})
    return found


def limit() -> list[dict[str, Any]]:
    """Compare the sweeps with reading and writing every displacement once."""
    found = []
    for size, steps in ((1000, 32), (3000, 16)):
        copies = max(2, 10**7 // size**2)
        wait_for_quiet()
        works = {
            "copy": (Copying(size, copies), copies),
            "copy_two": (Copying(size, copies, threads=2), copies),
            "bare": (sweeping(size, steps), steps),
            "pbdkit": (Running(moving(size), steps), steps),
            "two_threads": (Running(moving(size), steps, threads=2), steps),
        }
        seconds = best_in_turns([work for work, _ in works.values()], 25)
        counts = (count for _, count in works.values())
        ns = (s * 1e9 / n / size**2 for s, n in zip(seconds, counts, strict=True))
        found.append({"size": size} | dict(zip((f"{w}_ns" for w in works), ns, strict=True)))
    return found


def cache() -> list[dict[str, Any]]:
    """Every rule on 3000², against its own rate on 100², which stays in the cache, in processor
    time of one thread."""
    found = []
    for rule, parts in RULES.items():
        for more, besides in WITH.items():
            if (
                rule == "strain-gradient" and more
            ):  # nothing breaks there, and it needs its own solver
                continue
            sheet = parts | besides
            small, large = Running(moving(100, **sheet), 400), Running(moving(3000, **sheet), 16)
            seconds = best_in_turns([small, large], 5, time.process_time)
            ns = [s * 1e9 / n for s, n in zip(seconds, (400 * 100**2, 16 * 3000**2), strict=True)]
            found.append({"rule": rule, "with": more, "small_ns": ns[0], "large_ns": ns[1]})
    return found
