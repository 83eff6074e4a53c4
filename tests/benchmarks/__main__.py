"""Make all measurements of the performance page: `python tests/benchmarks`, from the root.

Writes performance.json and the tables of performance.md in docs/validation. `--only goals threads`
measures parts again and keeps the rest.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import document
import numba
import numpy as np
from cost import cost
from elements import elements
from engines import cache, engines, limit, threads
from goals import all_goals
from gpu import gpu
from peers import peers
from ranks import ranks, weak_scaling

from pbdkit.stepping.engine_choice import processors

DOCS = Path(__file__).parents[2] / "docs"


def goals() -> list[dict[str, Any]]:
    found = []
    for goal in all_goals():
        sign = "<=" if goal.at_most else ">="
        verdict = "met" if goal.met else "NOT MET"
        print(f"{goal.name}: {goal.measured:.3g}, goal {sign} {goal.goal:g}: {verdict}", flush=True)
        found.append(asdict(goal) | {"met": goal.met})
    return found


PARTS = {
    "goals": goals,
    "limit": limit,
    "cache": cache,
    "threads": threads,
    "cost": cost,
    "engines": engines,
    "peers": peers,
    "elements": elements,
    "gpu": gpu,
    "ranks": ranks,
    "weak": weak_scaling,
}


def machine() -> dict[str, Any]:
    names = (
        [
            line.partition(":")[2].strip()
            for line in Path("/proc/cpuinfo").read_text().splitlines()
            if line.startswith("model name")
        ]
        if Path("/proc/cpuinfo").exists()
        else [platform.processor()]
    )
    return {
        "date": datetime.date.today().isoformat(),
        "processor": names[0],
        "processors": processors(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "numba": numba.__version__,
        "load": os.getloadavg()[0],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    chosen = parser.parse_args().only
    file, page = DOCS / "validation/performance.json", DOCS / "validation/performance.md"
    data = json.loads(file.read_text()) if file.exists() else {}
    here = machine()
    for name in chosen:
        begun = time.perf_counter()
        found = PARTS[name]()
        if found is None:
            continue
        data[name] = found
        print(f"-- {name}: {time.perf_counter() - begun:.0f} s", flush=True)
        if name != "goals":
            print(document.TABLES[name](data[name]), flush=True)
        data["machine"] = here | {"load_after": os.getloadavg()[0]}
        file.write_text(json.dumps(data, indent=1) + "\n")
    if page.exists():
        document.refresh(page, data, {*document.TABLES} - document.SCALE)
        document.refresh(DOCS / "validation/scale.md", data, document.SCALE)


main()
