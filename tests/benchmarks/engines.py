"""Engines, precisions and threads at sizes, by `pbdkit bench` itself; threads; the limit."""

from __future__ import annotations

import json
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bare import copy_ns, sweeping
from pairing import best, ratio, wait_for_quiet
from sheets import DISTANCE, FRACTURE, Running, moving

from pbdkit.bench.measurement import measure

STEPS = {10: 4000, 100: 400, 1000: 20}
SHEETS = {
    "barycentre": ({}, (10, 100, 1000)),
    "distance-weighted": (DISTANCE, (100, 1000)),
    "barycentre with fracture": (FRACTURE, (100, 1000)),
}


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
    """How near the sweeps come to reading and writing every displacement once."""
    found = []
    for size, steps in ((100, 200), (1000, 32), (3000, 32)):
        wait_for_quiet()
        per_step = 1e9 / steps / size**2
        one, two = (Running(moving(size), steps, threads=n) for n in (1, 2))
        found.append(
            {
                "size": size,
                "copy_ns": copy_ns(size),
                "bare_ns": best(sweeping(size, steps), 9) * per_step,
                "pbdkit_ns": best(one, 9) * per_step,
                "two_threads_ns": best(two, 9) * per_step,
            }
        )
    return found
