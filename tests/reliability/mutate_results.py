"""Open, load, draw and verify a number of mutated results.

    python tests/reliability/mutate_results.py [--count N] [--seed S] [--only NUMBER]

None may crash, hang, or show other values without a message. `--only` prints one case.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import sys
import tempfile
import time
import warnings
from contextlib import redirect_stdout
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path[:0] = [str(Path(__file__).parent)]
from isolation import Outcome, outcomes, report, serve

import pbdkit
from pbdkit.cli import main as program
from pbdkit.errors import PbdkitError
from pbdkit.io.open import reading
from pbdkit.plotting.data import Trajectory

PATIENCE_S, LONGEST_S = 120.0, 20.0
"""Seconds after which a case is ended, and seconds that it may take."""
TORN = ["--set=leaders.1.motion.velocity=[1.2, 0.0]", "--set=steps=12"]
SUBJECTS = ("sealed", "sealed-zlib", "rewritten", "rewritten-zlib")


KINDS = ("bit", "bit", "bits", "cut", "zeros", "swap", "noise", "append", "foot", "same")


def make_subject(name: str, folder: Path) -> Path:
    """A sound file of that kind: of a run in which bonds broke."""
    path = folder / f"{name}.nc"
    if not path.exists():
        zlib = ["--set=record.compression=zlib"] if "zlib" in name else []
        _call("run", "paper/d1", "-o", str(path), "--quiet", *TORN, *zlib)
        if name.startswith("rewritten"):
            with pbdkit.open(path) as dataset:
                encoding = {v: {"zlib": bool(zlib)} for v in dataset.data_vars}
                values = dataset.load()
            values.to_netcdf(path, engine="netcdf4", encoding=encoding)
    return path


def read_subject(path: Path) -> dict[str, Any]:
    """Return all that a user sees of it, to be compared: values, attributes, and the data of a
    plot."""
    with reading(path) as dataset:
        dataset.load()
        seen = {name: variable.values.tobytes() for name, variable in dataset.variables.items()}
        seen |= {f"attribute {name}": str(value) for name, value in dataset.attrs.items()}
        recording = Trajectory(dataset, "pe1")
        seen["snapshot"] = repr([*recording.snapshots([recording.row(None)])])
    return seen


@cache
def seen_of_sound(path: Path) -> dict[str, Any]:
    """Return the same for a sound file, read once."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return read_subject(path)


def verified(path: Path) -> bool:
    """Return whether `pbdkit verify` finds no fault."""
    return _call("verify", str(path)) == 0


def _call(*arguments: str) -> int:
    with redirect_stdout(StringIO()):
        try:
            program(list(arguments))
        except SystemExit as end:
            return int(end.code or 0)
    return 0


def mutated(content: bytes, draw: random.Random) -> tuple[str, bytes]:
    """Return a description of the mutation, and its result."""
    data, size = bytearray(content), len(content)

    def place() -> int:
        """Return a place anywhere, or in the metadata of HDF5, or in the seal."""
        return draw.choice(
            [draw.randrange(size), draw.randrange(8192), size - 1 - draw.randrange(400)]
        )

    length, at, other = draw.choice([1, 8, 512, 65536]), place(), place()
    kind = draw.choice(
        ["bit", "bit", "bits", "cut", "zeros", "swap", "noise", "append", "foot", "same"]
    )
    match kind:
        case "bit":
            data[at] ^= 1 << draw.randrange(8)
        case "bits":
            for _ in range(draw.choice([2, 20, 200])):
                data[place()] ^= 1 << draw.randrange(8)
        case "cut":
            del data[at:]
        case "zeros":
            data[at : at + length] = bytes(len(data[at : at + length]))
        case "swap":
            data[at : at + length], data[other : other + length] = (
                data[other : other + length],
                data[at : at + length],
            )
        case "noise":
            data[at : at + length] = draw.randbytes(len(data[at : at + length]))
        case "append":
            data += draw.choice([bytes(length), draw.randbytes(length), content[-length:]])
        case "foot":
            for _ in range(draw.choice([1, 4])):
                data[-1 - draw.randrange(64)] = draw.randrange(256)
    return kind, bytes(data)


def tried(seed: int, number: int, folder: Path) -> Outcome:
    """Return the outcome of the case of that number."""
    draw = random.Random(f"{seed}/{number}")
    name = SUBJECTS[number % len(SUBJECTS)]
    sound = make_subject(name, folder)
    kind, content = mutated(sound.read_bytes(), draw)
    changed = content != sound.read_bytes()
    path = folder / f"{os.getpid()}.nc"
    path.write_bytes(content)
    begun = time.monotonic()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            seen, how = read_subject(path), "read"
        except PbdkitError as error:
            seen, how = {}, f"refused ({error.exit_status})"
        except Exception as error:
            seen, how = {}, f"undocumented error: {type(error).__name__}: {error}"[:200]
    passes = verified(path)
    told = any(issubclass(w.category, pbdkit.PbdkitWarning) for w in caught)
    if how == "read":
        same = seen == seen_of_sound(sound)
        how = (
            f"read, {'the same' if same else 'differs'}, {'with a warning' if told else 'silently'}"
        )
    return {
        "how": how,
        "what": f"{name}, {kind}",
        "passes": passes,
        "changed": changed,
        "seconds": time.monotonic() - begun,
    }


def faults(outcome: Outcome, slack: float = 1.0) -> list[str]:
    """Return the faults of the outcome of a case, with `slack` times the time."""
    how, what = outcome["how"], outcome.get("what", "")
    found = []
    if how in ("hang", "crash", "read, differs, silently") or how.startswith("undocumented"):
        found.append(f"{how}: {what}")
    if outcome.get("seconds", 0.0) > LONGEST_S * slack:
        found.append(f"{outcome['seconds']:.1f} s: {what}")
    if outcome.get("passes") and outcome["changed"]:
        found.append(f"verify finds nothing: {what}")
    if not outcome.get("changed", True) and "the same" not in how:
        found.append(f"a sound file: {how}: {what}")
    return found


def mutate(count: int, seed: int, folder: Path, workers: int = 2) -> list[tuple[int, Outcome]]:
    """The outcomes of the first `count` cases of a seed."""
    for name in SUBJECTS:
        make_subject(name, folder)
    command = [__file__, "--seed", str(seed), "--folder", str(folder)]
    return outcomes(command, range(count), PATIENCE_S, workers)


def main() -> None:
    """The command, and the child that it starts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--only", type=int)
    parser.add_argument("role", nargs="?", choices=["serve"])
    given = parser.parse_args()
    if given.role:
        serve(lambda number: tried(given.seed, number, given.folder))
        return
    with tempfile.TemporaryDirectory() as folder:
        if given.only is not None:
            print(json.dumps(tried(given.seed, given.only, Path(folder))))
            return
        found = mutate(given.count, given.seed, Path(folder), given.workers)
    sys.exit(report(found, given.seed, faults) > 0)


if __name__ == "__main__":
    main()
