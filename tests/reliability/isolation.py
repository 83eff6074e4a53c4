"""Run numbered cases in processes of their own: one that hangs or crashes is a finding, and the
others continue."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

SHARE = 500
"""Number of cases of a process, unless it ends before."""
Outcome = dict[str, Any]


def serve(case: Callable[[int], Outcome]) -> None:
    """The child: of every number that is read the outcome is written."""
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print is no outcome
    out.write("ready\n")
    out.flush()
    for line in sys.stdin:
        out.write(json.dumps(case(int(line))) + "\n")
        out.flush()


def outcomes(
    command: list[str], numbers: range, patience_s: float, workers: int
) -> list[tuple[int, Outcome]]:
    """The outcome of every case, `command` with the word "serve" being the child; where there is
    none, "hang" or "crash" stands under "how"."""
    share = min(SHARE, -(-len(numbers) // workers))
    shares = [numbers[n : n + share] for n in range(0, len(numbers), share)]
    with ThreadPoolExecutor(workers) as pool:
        found = pool.map(lambda share: list(_of_share(command, share, patience_s)), shares)
        return [outcome for share in found for outcome in share]


def _started(command: list[str]) -> subprocess.Popen[str]:
    """A child that has imported all that it needs."""
    child = subprocess.Popen(
        [sys.executable, *command, "serve"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert child.stdout.readline() == "ready\n", "the child cannot be started"
    return child


def _of_share(command: list[str], share: range, patience_s: float) -> Iterator[tuple[int, Outcome]]:
    child = None
    for number in share:
        child = child or _started(command)
        watchdog = threading.Timer(patience_s, child.kill)
        watchdog.start()
        begun = time.monotonic()
        child.stdin.write(f"{number}\n")
        child.stdin.flush()
        line = child.stdout.readline()
        watchdog.cancel()
        if line:
            yield number, json.loads(line)
            continue
        child.communicate()
        slow = time.monotonic() - begun >= patience_s
        yield number, {"how": "hang" if slow else "crash", "status": child.returncode}
        child = None
    if child:
        child.communicate()


def resident() -> tuple[int, int]:
    """Bytes of this process in memory, now and at most since `forget_peak`."""
    status = dict(
        line.split(":", 1)
        for line in Path("/proc/self/status").read_text().splitlines()
        if ":" in line
    )
    return tuple(int(status[name].split()[0]) * 1024 for name in ("VmRSS", "VmHWM"))


def forget_peak() -> None:
    """From here on the largest memory counts; Linux."""
    Path("/proc/self/clear_refs").write_text("5")


def report(
    found: list[tuple[int, Outcome]], seed: int, faults: Callable[[Outcome], list[str]]
) -> int:
    """Prints how many cases ended how, the largest figures, and every finding; returns the number
    of findings."""
    for how, count in Counter(outcome["how"] for _, outcome in found).most_common():
        print(f"{count:>8}  {how}")
    for figure in sorted({key for _, o in found for key, v in o.items() if isinstance(v, float)}):
        ranked = sorted(o[figure] for _, o in found if figure in o)
        print(f"{figure:>12}: median {ranked[len(ranked) // 2]:.3g}, largest {ranked[-1]:.3g}")
    findings = [(n, fault) for n, outcome in found for fault in faults(outcome)]
    for number, fault in findings:
        print(f"finding: seed {seed}, number {number}: {fault}")
    print(f"{len(found)} cases, {len(findings)} findings")
    return len(findings)
