"""Run the checks of `pbdkit check` on a number of fuzzed experiments.

    python tests/reliability/fuzz_experiments.py [--count N] [--seed S] [--only NUMBER]

Each ends in a documented error, soon and in a short text, or is valid and has a forecast soon.
`--only` prints one case.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import random
import sys
import tempfile
import time
import traceback
from functools import cache
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # others' threads take their time, too
sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent.parent)]
from hostile_input import PARTS, mutant
from hostile_text import hostile_setting, hostile_text, to_yaml
from isolation import Outcome, forget_peak, outcomes, report, resident, serve

import pbdkit
from pbdkit.errors import MAX_CHARACTERS, PbdkitError
from pbdkit.model.experiment import Experiment
from pbdkit.model.reading import MAX_NODES, Source, read_text
from pbdkit.model.shipped import shipped_names, shipped_text
from pbdkit.scene import memory_estimate as sizes
from pbdkit.scene.scene import build_scene
from pbdkit.simulation import rehearse
from pbdkit.stability.forecast import forecast

PATIENCE_S = 60.0
MEMORY = 2**29
"""Memory in bytes that the machine reports, whatever this one has."""
ERROR_S, ERROR_MB, TEXT_S, MARK_S = 0.1, 100.0, 1.0, 1e-4
"""Bounds on processor time and memory of an error that is found before the scene; and further
bounds for each megabyte of text and each mark of it that can begin a value, up to the number of
values that is accepted."""
VALID_S, VALID_MB = 5.0, 500.0
"""Bounds on the cost of a forecast, or of an error that only the scene shows; and once more for
each `MEMORY` / 4 that the scene takes."""


def case(seed: int, number: int) -> tuple[bytes, list[str]]:
    """The file of that number, and the settings that go with it."""
    draw = random.Random(f"{seed}/{number}")
    text = to_yaml(draw, mutant(draw, bases())) if draw.random() < 0.5 else draw.choice(TEXTS)
    settings = [hostile_setting(draw)] if draw.random() < 0.1 else []
    if draw.random() < 0.5:
        return hostile_text(draw, text), settings
    return text.encode("utf-8", "surrogatepass"), settings


def tried(content: bytes, settings: list[str], *, quick: bool = False) -> Outcome:
    """Return the outcome of a case, with its cost."""
    sizes.machine_memory = lambda processes=1: MEMORY
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "e.yaml")
        path.write_bytes(content)
        gc.collect()
        forget_peak()
        before, _ = resident()
        begun = time.process_time()
        outcome = _checked(path, settings, quick)
        seconds = time.process_time() - begun
        _, peak = resident()
    text = b"\n".join([content, *(os.fsencode(setting) for setting in settings)])
    return outcome | {
        "text_mb": len(text) / 1e6,
        "marks": marks(text),
        "seconds": seconds,
        "mb": max(0.0, (peak - before) / 1e6),
    }


def marks(content: bytes) -> int:
    """Return the number of values that can be in a text."""
    return min(MAX_NODES, sum(content.count(c) for c in b",:-[{"))


def _checked(path: Path, settings: list[str], quick: bool) -> Outcome:
    stage = "file"
    scene_mb = 0.0
    try:
        loaded = pbdkit.load(path, settings=settings)
        stage = "scene"
        scene = build_scene(loaded)
        stage = "forecast"
        if not quick:
            rehearse(scene)
            scene_mb = forecast(scene).memory_mib * 1.05
    except PbdkitError as error:
        text = str(error)
        how = f"refused ({error.exit_status}), {stage}"
        return {"how": how, "status": error.exit_status, "length": len(text), "said": text[:150]}
    except Exception as error:
        return undocumented(error)
    return {"how": "valid", "scene_mb": scene_mb}


def undocumented(error: Exception) -> Outcome:
    """Return the outcome with the place of the error."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    said = f"{type(error).__name__}: {str(error)[:150]} ({place.filename[-40:]}:{place.lineno})"
    return {"how": "undocumented error", "said": said}


def faults(outcome: Outcome, slack: float = 1.0) -> list[str]:
    """Return the faults of the outcome of a case, with `slack` times the bounds."""
    how = outcome["how"]
    said = outcome.get("said", "")
    if how in ("hang", "crash", "undocumented error"):
        return [f"{how} {said}"]
    found = []
    if how != "valid" and (
        outcome["status"] not in (2, 3) or outcome["length"] > MAX_CHARACTERS + 100
    ):
        found.append(f"status {outcome['status']}, {outcome['length']} characters: {said}")
    at_once = "file" in how
    seconds, mb = (ERROR_S, ERROR_MB) if at_once else (VALID_S, VALID_MB)
    seconds += TEXT_S * outcome["text_mb"] + MARK_S * outcome["marks"]
    share = slack + outcome.get("scene_mb", 0.0) / (MEMORY / 4e6)
    if outcome["seconds"] > seconds * share:
        found.append(f"{how}: {outcome['seconds']:.2f} s: {said}")
    if outcome["mb"] > mb * share:
        found.append(f"{how}: {outcome['mb']:.0f} MB: {said}")
    return found


def warm_up() -> None:
    """Import all modules and build every model before anything is measured."""
    for part in [{}, *({name: part} for name, part in PARTS)]:
        tried(json.dumps(bases()[0] | part).encode(), [])
    for text in TEXTS:
        read_text(text, "shipped")
    for base in bases():
        Experiment.build(Source(data=base))
    gc.collect()
    gc.freeze()  # what is there already is not gone through again and again


@cache
def bases() -> list[Any]:
    """Return the shipped experiments with all defaults."""
    loaded = map(pbdkit.load, shipped_names())
    return [json.loads(experiment.model_dump_json(by_alias=True)) for experiment in loaded]


TEXTS = [shipped_text(name) for name in shipped_names()]


def fuzz(
    count: int, seed: int, workers: int = 2, *, quick: bool = False
) -> list[tuple[int, Outcome]]:
    """Return the outcomes of the first `count` cases of a seed; `quick`: scenes have no forecast,
    and imports are in the figures."""
    command = [__file__, "--seed", str(seed), *(["--quick"] if quick else [])]
    return outcomes(command, range(count), PATIENCE_S, workers)


def main() -> None:
    """The command, and the child that it starts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--only", type=int)
    parser.add_argument("--quick", action="store_true", help="as the sample in the suite")
    parser.add_argument("role", nargs="?", choices=["serve"])
    given = parser.parse_args()
    if (given.role or given.only is not None) and not given.quick:
        warm_up()
    if given.role:
        serve(lambda number: tried(*case(given.seed, number), quick=given.quick))
    elif given.only is not None:
        content, settings = case(given.seed, given.only)
        print(content[:20_000].decode(errors="backslashreplace"), settings)
        print(outcome := tried(content, settings), faults(outcome))
    else:
        found = fuzz(given.count, given.seed, given.workers, quick=given.quick)
        sys.exit(report(found, given.seed, faults) > 0)


if __name__ == "__main__":
    main()
