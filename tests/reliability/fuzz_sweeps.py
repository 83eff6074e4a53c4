"""Check a number of fuzzed sweeps, up to the run of the first member.

    python tests/reliability/fuzz_sweeps.py [--count N] [--seed S] [--only NUMBER]

Each ends in a documented error, or its members are all valid; soon, and in bounded memory.
"""

# ruff: noqa: E501  (rows of words)

from __future__ import annotations

import argparse
import gc
import os
import random
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # others' threads take their time, too
sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent.parent)]
import fuzz_experiments
from fuzz_experiments import MEMORY, PATIENCE_S, bases, marks, undocumented
from hostile_input import mutant
from hostile_text import hostile_text, to_yaml
from isolation import Outcome, forget_peak, outcomes, report, resident, serve

from pbdkit.errors import PbdkitError
from pbdkit.scene import memory_estimate as sizes
from pbdkit.sweeps import execute as outlook
from pbdkit.sweeps.execute import validated
from pbdkit.sweeps.specification import SweepPlan, read_sweep

MEMBER_S = 0.2
"""Further bound for each of the members, of which there are a few dozen."""
HUGE = [10**5, 10**9, 2**63, 10**40]
PATHS = ["solver.relaxation", "solver.memory", "steps", "seed", "rule.K", "rule", "lattice.a", "body",
         "body.columns", "leaders.0.until", "leaders.7", "name", "x", "", ".", "steps.x", "fracture",
         "../x", "diagnostics", "record", "a" * 300]  # fmt: skip
VALUES = [0, 1, -1, 2.5, 1e-300, 1e300, float("nan"), float("inf"), None, True, "x", "", [], {}, [[]],
          "../../etc/passwd", "x" * 5000, {"type": "barycentre"}, {"type": "none"}, [1, 2], 10**30,
          {"from": 0}, *HUGE]  # fmt: skip
NAMES = ["paper/a", "paper/b", "../e.yaml", "/etc/passwd", "/dev/zero", "e.yaml", ".", "", 3, None]


def case(seed: int, number: int) -> bytes:
    """The file of that number."""
    draw = random.Random(f"{seed}/{number}")
    data: dict[str, Any] = {"version": 1, "experiment": draw.choice(NAMES)}
    if draw.random() < 0.6:
        data["experiment"] = draw.choice([draw.choice(bases()), mutant(draw, bases())])
    for section in draw.choice([["vary"], ["together"], ["vary", "together"], []]):
        data[section] = {draw.choice(PATHS): _values(draw) for _ in range(draw.randint(1, 3))}
    if draw.random() < 0.3:
        data["replicates"] = draw.choice([1, 3, 0, *VALUES])
    if draw.random() < 0.4:
        kept = {"variables": draw.choice([["position"], ["pe1"], ["x"], *VALUES])}
        data["keep"] = kept | {"times": draw.choice(["last", "all", [0, 3], *VALUES])}
    if draw.random() < 0.1:
        data[draw.choice(["vari", "keep", "version", "experiment"])] = draw.choice(VALUES)
    text = to_yaml(draw, data)
    if draw.random() < 0.3:
        return hostile_text(draw, text)
    return text.encode("utf-8", "surrogatepass")


def _values(draw: random.Random) -> Any:
    if draw.random() < 0.6:
        return [draw.choice(VALUES) for _ in range(draw.randint(0, 3))]
    ends = {"from": draw.choice(VALUES), "to": draw.choice(VALUES)}
    count = draw.choice([2, 3, 4, 0, -1, *HUGE])
    return ends | {"count": count, "scale": draw.choice(["linear", "log", "x"])}


def tried(content: bytes) -> Outcome:
    """Return the outcome of a case, with its cost."""
    sizes.machine_memory = outlook.machine_memory = lambda processes=1: MEMORY
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "s.yaml")
        path.write_bytes(content)
        gc.collect()
        forget_peak()
        before, _ = resident()
        begun = time.process_time()
        outcome = _checked(path)
        seconds = time.process_time() - begun
        _, peak = resident()
        left = sorted(p.name for p in Path(folder).iterdir() if p != path)
    if left:
        outcome |= {"how": "undocumented error", "said": f"wrote {left}"}
    sizes_of_it = {"text_mb": len(content) / 1e6, "marks": marks(content)}
    return outcome | sizes_of_it | {"seconds": seconds, "mb": max(0.0, (peak - before) / 1e6)}


def _checked(path: Path) -> Outcome:
    try:
        specified, base, source = read_sweep(path)
        members = validated(SweepPlan(specified, base, source), lambda *said: None)[1]
    except PbdkitError as error:
        told = {"status": error.exit_status, "length": len(str(error)), "said": str(error)[:150]}
        return {"how": f"refused ({error.exit_status}), sweep"} | told
    except Exception as error:
        return undocumented(error)
    return {"how": "valid", "members": len(members)}


def faults(outcome: Outcome, slack: float = 1.0) -> list[str]:
    """Return the faults of the outcome of a case."""
    return fuzz_experiments.faults(outcome, slack + MEMBER_S * outcome.get("members", 24))


def main() -> None:
    """The command, and the child that it starts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=2_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", type=int)
    parser.add_argument("role", nargs="?", choices=["serve"])
    given = parser.parse_args()
    if given.role:
        fuzz_experiments.warm_up()
        serve(lambda number: tried(case(given.seed, number)))
    elif given.only is not None:
        content = case(given.seed, given.only)
        print(content[:20_000].decode(errors="backslashreplace"))
        print(outcome := tried(content), faults(outcome))
    else:
        command = [__file__, "--seed", str(given.seed)]
        found = outcomes(command, range(given.count), PATIENCE_S, 2)
        sys.exit(report(found, given.seed, faults) > 0)


if __name__ == "__main__":
    main()
