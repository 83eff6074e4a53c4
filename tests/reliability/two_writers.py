"""Run two calls that write the same output, at about the same time.

    python tests/reliability/two_writers.py [--trials N] [--seed S] [--only NUMBER]

Run against run, run against resume, resume against resume, some with --force, one with a delay;
`pbdkit status` runs too. In the end the result must be there, whole and right, and nothing else
except another whole result beside it; a call that does not finish must report the reason.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from trials import (
    BASE,
    BREAKING,
    LARGE,
    OUTPUT,
    called,
    debris,
    differences,
    done,
    ended,
    often,
    reference,
    row,
    write_experiment,
)

from pbdkit.io import atomic_file as destination, run_store as unfinished
from pbdkit.io.run_store import has_committed

PARTS = {"small": BASE | BREAKING, "large": BASE | LARGE}
KINDS = tuple(PARTS)
PAIRS = [("run", "run"), ("run", "resume"), ("resume", "resume"), ("run --force", "run --force")]
PAIRS.append(("run --force", "resume"))
REFUSALS = ("being written", "exists", "unfinished", "another run", "appeared while", "is finished")


def hesitating(draw: random.Random, first_s: float) -> Callable[[], None]:
    """Make a process wait now and then when it begins to store, and when it ends."""
    seed = draw.random()

    def begin() -> None:
        own = random.Random(seed)
        often(first_s)

        def slowed(call: Callable[..., Any]) -> Callable[..., Any]:
            def slow(*args: Any, **more: Any) -> Any:
                if own.random() < 0.3:
                    time.sleep(own.uniform(0.0, 0.2))
                return call(*args, **more)

            return slow

        for name in ("link", "unlink", "replace", "fsync"):
            if own.random() < 0.5:
                setattr(os, name, slowed(getattr(os, name)))
        unfinished.remove_unfinished = slowed(unfinished.remove_unfinished)
        destination.lock = slowed(destination.lock)

    return begin


def race(seed: str, whole: Path, seconds: float, parts: dict[str, Any]) -> list[str]:
    """Return the faults after two calls in the current folder."""
    draw = random.Random(seed)
    pair = draw.choice(PAIRS)
    write_experiment(parts, Path.cwd())
    if "resume" in pair:
        pid = called("run", "e.json", "-o", OUTPUT, log=Path("log"))
        end = time.monotonic() + 20.0
        while not has_committed(Path(OUTPUT)) and time.monotonic() < end:
            time.sleep(0.005)
        time.sleep(draw.uniform(0.0, 0.5 * seconds))
        os.kill(pid, signal.SIGKILL)
        ended(pid)
    pids = []
    for n, command in enumerate(pair):
        words = ["resume", OUTPUT] if command == "resume" else ["run", "e.json", "-o", OUTPUT]
        words += command.split()[1:]
        before = hesitating(draw, draw.choice([0.0, 0.0, 1e9]))
        pids.append(called(*words, log=Path(f"log{n}"), before=before))
        if n == 0:
            time.sleep(draw.choice([0.0, draw.uniform(0.0, 1.2 * seconds)]))
    looked, _ = done("status", OUTPUT, log=Path("log"))
    codes = [ended(pid) for pid in pids]
    said = [Path(f"log{n}").read_text() for n in range(2)]
    found = [] if looked in (0, 2) else [f"status: exit {looked}: {Path('log').read_text()}"]
    for command, code, words in zip(pair, codes, said, strict=True):
        if code and (code not in (2, 6) or not any(r in words for r in REFUSALS)):
            found.append(f"{pair}: {command} ended with {code}: {words}")
    nobody = 0 not in codes and not Path(OUTPUT).exists()
    if nobody and done("resume", OUTPUT, log=Path("log"))[0]:
        return [*found, f"{pair}: nobody finished: {said}"]
    others = [p for p in Path.cwd().glob("out*.nc") if p.name != OUTPUT]
    for result in (Path(OUTPUT), *others):
        found += [f"{pair}: {result.name}: {d}" for d in differences(whole, result)]
    for other in others:
        if not any(other.name in words for words in said):
            found.append(f"{other.name} was not spoken of")
    known = [p.name for p in others]
    if left := debris(Path.cwd(), OUTPUT, "log0", "log1", *known):
        found.append(f"{pair}: left behind: {left}; {codes} {said}")
    return found


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    asked.add_argument("--trials", type=int, default=200)
    asked.add_argument("--seed", type=int, default=1)
    asked.add_argument("--only", type=int)
    asked.add_argument("--kinds", nargs="+", default=[*KINDS])
    given = asked.parse_args()
    numbers = range(given.trials) if given.only is None else [given.only]
    failed = tried(given.seed, numbers, given.kinds)
    row("two writers: damaged files 0, runs lost 0", f"{failed} in {len(numbers)} races")
    raise SystemExit(failed > 0)


def tried(seed: int, numbers: Any, kinds: list[str]) -> int:
    """In how many races something was found."""
    failed, here = 0, Path.cwd()
    with tempfile.TemporaryDirectory() as name:
        wholes = {kind: reference(PARTS[kind], Path(name, kind)) for kind in kinds}
        for number in numbers:
            kind = kinds[number % len(kinds)]
            folder = Path(name, str(number))
            folder.mkdir()
            os.chdir(folder)
            try:
                found = race(f"{seed}/{number}", *wholes[kind], PARTS[kind])
            except Exception as error:
                found = [f"{type(error).__name__}: {error}"]
            for finding in found:
                print(f"{number} ({kind}): {finding}", flush=True)
            failed += bool(found)
        os.chdir(here)
    return failed


if __name__ == "__main__":
    main()
