"""Run the trials of claims.yaml one after the other, and append the figures of each to
docs/validation/trials.jsonl.

    python tests/reliability/nightly.py [--share 0.1] [--only WORD ...] [--all] [--dry-run]

A record has the date, the commit, the machine, the command, its exit status, its duration and the
last lines of its output, from which the page docs/validation/claims.md is drawn. The seed is the
number of days since 2026-01-01, so that every night tries other cases and every case can be
repeated. Exits with 1 if a trial failed; a trial is left out with a line if its program is missing.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

ROOT = Path(__file__).parents[2]
CLAIMS = Path(__file__).with_name("claims.yaml")
FIGURES = ROOT / "docs/validation/trials.jsonl"
BEGIN = datetime.date(2026, 1, 1)
PATIENCE_S = 4 * 3600
"""Limit of one trial."""
BROWSERS = "chromium", "chromium-browser", "google-chrome"

Claim = dict[str, Any]


def claims() -> list[Claim]:
    """Return the entries of claims.yaml."""
    return list(YAML(typ="safe").load(CLAIMS))


def command(claim: Claim, share: float, seed: int) -> str:
    """Return the command of a trial, with the number of its cases and the seed."""
    count = max(1, round(share * claim.get("count", 1)))
    return str(claim["trial"]).replace("{count}", str(count)).replace("{seed}", str(seed))


def missing(claim: Claim) -> str | None:
    """Return the first program that the trial needs and this machine lacks."""
    for need in claim.get("needs", ()):
        programs = BROWSERS if need == "browser" else (need,)
        if not (os.geteuid() == 0 if need == "mount" else any(map(shutil.which, programs))):
            return str(need)
    return None


def machine() -> dict[str, Any]:
    """Return the processor, the number of usable ones, the system and the versions."""
    info = Path("/proc/cpuinfo")
    names = re.findall(r"model name\s*: (.*)", info.read_text()) if info.exists() else []
    return {
        "processor": names[0] if names else platform.processor(),
        "processors": len(os.sched_getaffinity(0)),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **{name: version(name) for name in ("numpy", "numba", "xarray")},
    }


def commit() -> str:
    """Return the abbreviated commit, with `+` if files differ from it."""
    git = ["git", "-C", str(ROOT)]
    head = subprocess.run([*git, "rev-parse", "--short=10", "HEAD"], capture_output=True, text=True)
    changed = [*git, "status", "--porcelain", "--untracked-files=no", "--", ".", f":!{FIGURES}"]
    status = subprocess.run(changed, capture_output=True, text=True)
    return head.stdout.strip() + ("+" if status.stdout else "")


def run(claim: Claim, share: float, seed: int) -> dict[str, Any]:
    """Run a trial and return its record."""
    asked = command(claim, share, seed)
    path = str(Path(sys.executable).parent) + os.pathsep + os.environ["PATH"]
    places = os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1", "PATH": path}
    begun = time.monotonic()
    try:
        done = subprocess.run(
            ["bash", "-c", asked], cwd=ROOT, env=places, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="backslashreplace",
            timeout=PATIENCE_S,
        )  # fmt: skip
        status, output = done.returncode, done.stdout
    except subprocess.TimeoutExpired:
        status, output = 124, f"not finished after {PATIENCE_S} s"
    if status:
        print(output, flush=True)
    written = [line.strip() for line in output.splitlines() if line.strip()]
    return {
        "claim": claim["claim"],
        "date": datetime.date.today().isoformat(),
        "commit": commit(),
        "command": asked,
        "exit": status,
        "seconds": round(time.monotonic() - begun),
        "figures": written[-claim.get("lines", 1) :],
        "machine": machine(),
    }


def main() -> int:
    """Run the trials and append their figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--share", type=float, default=1.0, help="of the number of cases")
    parser.add_argument("--only", nargs="+", help="trials whose claim or command has one of these")
    parser.add_argument("--all", action="store_true", help="also those that are due another night")
    parser.add_argument("--dry-run", action="store_true", help="show the commands")
    asked = parser.parse_args()
    seed = (datetime.date.today() - BEGIN).days
    failed = []
    for claim in claims():
        name = command(claim, asked.share, seed)
        if asked.only and not any(word in claim["claim"] + name for word in asked.only):
            continue
        if not (asked.only or asked.all) and seed % claim.get("nights", 1):
            print(f"left out, due every {claim['nights']} nights: {name}", flush=True)
        elif need := missing(claim):
            print(f"left out, {need} is missing: {name}", flush=True)
        elif asked.dry_run:
            print(name)
        else:
            record = run(claim, asked.share, seed)
            with FIGURES.open("a", encoding="utf-8") as file:
                file.write(json.dumps(record, ensure_ascii=False) + "\n")
            outcome = "FAILED" if record["exit"] else "held"
            print(f"{outcome}, {record['seconds']} s: {name}", *record["figures"], sep="\n    ")
            failed += [name] * bool(record["exit"])
    print(f"{len(failed)} trials failed", *failed, sep="\n    ", flush=True)
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
